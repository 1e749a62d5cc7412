//! LDROBOT scanners, which send packets without a request. The simulated points have no noise, so that each published
//! point can be found among the measured ones.

use std::rc::Rc;

use scanhub_drivers::ld::Model;
use scanhub_drivers::ld::packet::{PACKET_LEN, POINTS_PER_PACKET, Packet};
use scanhub_schema::{MILLIS, Nanos, Scan};
use scanhub_sim::ChunkSize;
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator, TruePoint};
use scanhub_sim::room::Changes;
use scanhub_sim::room::Room;

use super::{Family, FirstPoint, MAX_SPEED_CHANGE, MIN_SPEED, Scanner, still_rooms};
use crate::scenario::Action;

/// An LDROBOT with its link.
#[derive(Clone)]
pub(super) struct Ld {
    settings: LdSettings,
    /// Name of the family in the link.
    family: &'static str,
    /// Whether the link configures the model.
    is_model_configured: bool,
    beams: Option<usize>,
}

impl Ld {
    pub(super) fn draw(random: &mut fastrand::Rng) -> Ld {
        let model = Model::ALL[random.usize(..Model::ALL.len())];
        let beams = (random.u8(..4) == 0).then(|| random.usize(200..900));
        Ld { beams, ..Ld::of(model, random) }
    }

    /// Returns an LDROBOT of this model with its default number of beams.
    pub(super) fn of(model: Model, random: &mut fastrand::Rng) -> Ld {
        let settings = LdSettings {
            speed_variation: random.f64() * 0.01,
            boot_ns: random.u64(100..2_500) * MILLIS,
            chunk: if random.bool() { ChunkSize::Uart } else { ChunkSize::Usb },
            seed: random.u64(..),
            ..LdSettings::of(model)
        };
        Ld { settings, family: "ld", is_model_configured: random.bool(), beams: None }
    }
}

impl Family for Ld {
    fn keys(&self) -> Vec<String> {
        let model = self.is_model_configured.then(|| format!("model={}", self.settings.model.name()));
        let beams = self.beams.map(|beams| format!("beams={beams}"));
        [format!("family={}", self.family)].into_iter().chain(model).chain(beams).collect()
    }

    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(Ld { family: "auto", is_model_configured: false, ..self.clone() })
    }

    fn families(&self) -> Vec<scanhub_schema::Family> {
        vec![scanhub_schema::Family::Ld]
    }

    fn baud_rates(&self) -> Vec<u32> {
        vec![self.settings.model.baud()]
    }

    /// Returns the time of a revolution, and a delay of two revolutions and the last packet. If an object appears just
    /// after the head has passed it, the scanner measures the object one revolution later. The hub publishes that
    /// revolution when it is complete.
    fn scan_times(&self) -> (Nanos, Nanos) {
        let LdSettings { revolutions_per_second, speed_variation: wander, .. } = self.settings;
        let slowest = revolutions_per_second * MIN_SPEED * (1.0 - wander);
        let revolution_ns = (1e9 / slowest) as Nanos;
        (revolution_ns, 2 * revolution_ns + LAST_PACKET_TIME)
    }

    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner> {
        Box::new(LdScanner::new(self.settings, changes))
    }

    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        sample.chunks(PACKET_LEN).collect()
    }

    fn max_telegrams(&self) -> usize {
        17
    }

    fn is_data(&self, _: &[u8]) -> bool {
        true
    }

    /// Returns `true`, because the points of a revolution come from many samples.
    fn is_scan_of(&self, _: &Scan, _: &[u8]) -> bool {
        true
    }

    /// Returns whether any packet was damaged, because a damaged packet has a valid checksum in 1 of 256 cases.
    fn is_collision(&self, _: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool {
        damaged.next().is_some()
    }

    fn is_rotating(&self) -> bool {
        true
    }

    fn first_point(&self, unit: &[u8]) -> Option<FirstPoint> {
        let packet = Packet::check(unit.first_chunk()?).ok()?;
        let on_line = scanhub_schema::line_time(PACKET_LEN, self.settings.model.baud());
        Some(FirstPoint {
            clockwise_deg: f64::from(packet.angle(0)) / 100.0,
            points: POINTS_PER_PACKET,
            line_time: on_line,
        })
    }
}

/// A simulated LDROBOT.
struct LdScanner {
    head: LdSimulator,
    settings: LdSettings,
    changes: Changes,
    /// Number of packets whose points have been reported as measured.
    reported: u64,
    /// Current and target speed, as shares of the usual speed.
    speed: f64,
    target_speed: f64,
}

impl LdScanner {
    fn new(settings: LdSettings, changes: Changes) -> LdScanner {
        let room = Room::of_series(still_rooms(), changes.clone());
        let head = LdSimulator::new(settings, room);
        LdScanner { head, settings, changes, reported: 0, speed: 1.0, target_speed: 1.0 }
    }
}

impl Scanner for LdScanner {
    fn device(&self) -> &dyn Device {
        &self.head
    }

    fn device_mut(&mut self) -> &mut dyn Device {
        &mut self.head
    }

    /// Does nothing. After a restart, the scanner's clock starts at zero. A clock that was not restarted can also be
    /// near zero at that time, by chance. Then the session cannot distinguish the restart from a stall, and stamps are
    /// wrong until the next revolutions. The session's own tests cover restarts.
    fn brown_out(&mut self, _: Nanos) {}

    /// Replaces the scanner with a new one, whose power is turned on at `now`.
    fn exchange(&mut self, _: &Action, now: Nanos) -> Vec<u8> {
        let seed = self.settings.seed.wrapping_add(1);
        *self = LdScanner::new(LdSettings { seed, ..self.settings }, self.changes.clone());
        self.head.power_cycle(now);
        Vec::new()
    }

    fn misbehave(&mut self, _: Option<&Action>) {}

    fn set_speed(&mut self, share: f64) {
        self.target_speed = share;
    }

    fn measured(&mut self) -> Vec<TruePoint> {
        let sent = self.head.sent();
        if std::mem::replace(&mut self.reported, sent) == sent || sent == 0 {
            return Vec::new();
        }
        let first = (sent - 1) * POINTS_PER_PACKET as u64;
        let points = (first..first + POINTS_PER_PACKET as u64).map(|point| self.head.truth(point)).collect();
        if self.speed != self.target_speed {
            let maximum = MAX_SPEED_CHANGE * POINTS_PER_PACKET as f64
                / f64::from(self.settings.model.points_per_second());
            self.speed += (self.target_speed - self.speed).clamp(-maximum, maximum);
            self.head.set_speed(self.settings.revolutions_per_second * self.speed);
        }
        points
    }
}

/// Time until the hub has read the whole last packet of a revolution.
const LAST_PACKET_TIME: Nanos = 20 * MILLIS;
