//! A simulated LDROBOT scanner, without I/O. Its head rotates and measures one point after the other, each at its own
//! time and angle. A packet has twelve points. The scanner ignores bytes from the host. Instead of measuring, it can
//! send recorded packets.

use std::path::Path;

pub use scanhub_drivers::ld::Model;
use scanhub_drivers::ld::packet::{
    CLOCK_PERIOD_MS, FULL_CIRCLE, PACKET_LEN, POINTS_PER_PACKET, Packet, PacketContents,
};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::{Encoding, Recording};
use scanhub_schema::{Failure, Family, Kind, MILLIS, Nanos};

use crate::device::ChunkSize;
use crate::device::TxQueue;
use crate::device::{Chunk, Device};
use crate::request_decoder::Arrival;
use crate::room::Room;
use crate::rotating::{BeamSampler, Rotation, counterclockwise_deg};

pub use crate::rotating::TruePoint;

/// Settings of a scanner.
#[derive(Clone, Copy, Debug)]
pub struct LdSettings {
    /// The model.
    pub model: Model,
    /// Mean revolutions per second. The default depends on `model`.
    pub revolutions_per_second: f64,
    /// Points per second. The default depends on `model`.
    pub points_per_second: f64,
    /// Maximum deviation of the speed from its mean, as a share of the mean. Real scanners stay within 1 %.
    pub speed_variation: f64,
    /// Time constant of the spin-up after power-on, in seconds. With 0, the head has its full speed at once.
    pub spin_up_s: f64,
    /// Time from power-on to the first packet.
    pub boot_ns: Nanos,
    /// Number of bytes that the host's hardware delivers at once.
    pub chunk: ChunkSize,
    /// Seed of the angle at the start and of the variation of the speed.
    pub seed: u64,
}

impl LdSettings {
    /// Returns the factory settings of `model`. After a power cycle, such a scanner sends its first packet two seconds
    /// later, and its head has its full speed at once.
    pub fn of(model: Model) -> LdSettings {
        LdSettings {
            model,
            revolutions_per_second: f64::from(model.revolutions_per_second()),
            points_per_second: f64::from(model.points_per_second()),
            speed_variation: 0.005,
            spin_up_s: 0.0,
            boot_ns: 2_000 * MILLIS,
            chunk: ChunkSize::Uart,
            seed: 0,
        }
    }
}

/// A simulated LDROBOT scanner.
pub struct LdSimulator {
    settings: LdSettings,
    source: Source,
    /// Time of power-on.
    power_ns: Nanos,
    /// Time at which the head starts to rotate.
    rotates_from_ns: Nanos,
    /// Number of packets that were queued for transmission since the head started to rotate.
    sent: u64,
    rotation: Rotation,
    tx_queue: TxQueue,
}

/// Source of the packets that a scanner sends.
enum Source {
    /// The scanner measures a room.
    Room(BeamSampler),
    /// The scanner repeats recorded packets.
    Recorded {
        packets: Vec<[u8; PACKET_LEN]>,
        /// Whether the packets restart after the last one.
        is_looped: bool,
        /// Time since the first packet by the clock of the recorded scanner, in milliseconds.
        elapsed_ms: u64,
    },
}

impl LdSimulator {
    /// Creates the scanner with `settings` in `room`, at time 0. Its head already rotates.
    pub fn new(settings: LdSettings, room: Room) -> LdSimulator {
        LdSimulator::of(settings, Source::Room(BeamSampler::new(room)))
    }

    /// Creates a scanner that sends recorded `packets` instead of measuring. If `looped` is set, they restart at their
    /// end.
    pub fn repeating(settings: LdSettings, packets: Vec<[u8; PACKET_LEN]>, looped: bool) -> LdSimulator {
        LdSimulator::of(settings, Source::Recorded { packets, is_looped: looped, elapsed_ms: 0 })
    }

    fn of(settings: LdSettings, source: Source) -> LdSimulator {
        let LdSettings { revolutions_per_second, speed_variation: wander, seed, .. } = settings;
        let rotation = Rotation::new(revolutions_per_second, wander, 0.0, seed);
        let tx_queue = TxQueue::new(settings.model.baud(), settings.chunk);
        LdSimulator { settings, source, power_ns: 0, rotates_from_ns: 0, sent: 0, rotation, tx_queue }
    }

    /// Changes the speed from the next packet on. The caller has to simulate the inertia of a real head, whose speed
    /// differs by at most 5 % between two consecutive packets.
    pub fn set_speed(&mut self, revolutions_per_second: f64) {
        self.rotation.set_speed(self.seconds(self.sent * POINTS_PER_PACKET as u64), revolutions_per_second);
    }

    /// Returns the number of packets since the head started to rotate, including the packet on the line. Each packet
    /// has twelve points.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Returns time, angle and range of a point, without noise. `point` is its index since the head started to rotate.
    /// The point must not be earlier than the last call of [`set_speed`](Self::set_speed). For a recording, the range
    /// is `None`.
    pub fn truth(&mut self, point: u64) -> TruePoint {
        let (at_ns, clockwise_deg) = self.time_and_angle(point);
        let range_mm = match &mut self.source {
            Source::Room(beams) => beams.measure(at_ns, counterclockwise_deg(clockwise_deg)).exact_mm,
            Source::Recorded { .. } => None,
        };
        TruePoint { at_ns, clockwise_deg, range_mm }
    }

    /// Returns the clockwise angle of the point with index `point` from the head's zero, 0 to 360 degrees.
    pub fn clockwise_deg(&self, point: u64) -> f64 {
        self.time_and_angle(point).1
    }

    /// Returns time and clockwise angle of the point with index `point`.
    fn time_and_angle(&self, point: u64) -> (Nanos, f64) {
        let seconds = self.seconds(point);
        (self.rotates_from_ns + (seconds * 1e9) as Nanos, self.rotation.revolutions(seconds).fract() * 360.0)
    }

    /// Returns the time of the point with index `point`, in seconds since the head started to rotate.
    fn seconds(&self, point: u64) -> f64 {
        point as f64 / self.settings.points_per_second
    }

    /// Restarts the scanner at `now`. Its head starts to rotate after `boot_ns`. Returns whether a packet was aborted.
    fn restart(&mut self, now: Nanos, boot_ns: Nanos, spin_up_s: f64) -> bool {
        let broken = self.tx_queue.abort(now);
        self.power_ns = now;
        self.rotates_from_ns = now + boot_ns;
        let LdSettings { revolutions_per_second, speed_variation: wander, seed, .. } = self.settings;
        (self.rotation, self.sent) = (Rotation::new(revolutions_per_second, wander, spin_up_s, seed), 0);
        if let Source::Recorded { elapsed_ms: passed_ms, .. } = &mut self.source {
            *passed_ms = 0;
        }
        broken
    }

    /// Measures the points of packet number `number` in the room, and returns the packet.
    fn measure(&mut self, number: u64) -> [u8; PACKET_LEN] {
        let first = number * POINTS_PER_PACKET as u64;
        let times_and_angles: [(Nanos, f64); POINTS_PER_PACKET] =
            std::array::from_fn(|i| self.time_and_angle(first + i as u64));
        let model = self.settings.model;
        let Source::Room(beams) = &mut self.source else { return [0; PACKET_LEN] };
        let points = times_and_angles.map(|(at_ns, clockwise_deg)| {
            let beam = beams.measure(at_ns, counterclockwise_deg(clockwise_deg));
            match beam.range_mm.filter(|range_mm| reach_mm(model).contains(range_mm)) {
                Some(range_mm) => (range_mm.round() as u16, beam.intensity),
                None => (0, 0),
            }
        });
        let hundredths = |degrees: f64| (degrees / 360.0 * f64::from(FULL_CIRCLE)) as u16;
        let (last_ns, last_deg) = times_and_angles[POINTS_PER_PACKET - 1];
        let millis = (last_ns - self.power_ns) / MILLIS % Nanos::from(CLOCK_PERIOD_MS);
        let speed = (360.0 * self.rotation.speed(self.seconds(first))).round() as u16;
        let (start, end) = (hundredths(times_and_angles[0].1), hundredths(last_deg));
        PacketContents { speed, start, points, end, millis: millis as u16 }.encode()
    }

    /// Returns the time at which packet number `number` is complete; `None` at the end of a recording.
    fn due_ns(&self, number: u64) -> Option<Nanos> {
        match &self.source {
            Source::Room(_) => Some(self.time_and_angle((number + 1) * POINTS_PER_PACKET as u64).0),
            Source::Recorded { packets, is_looped: looped, elapsed_ms: passed_ms } => {
                let exists = (number as usize) < packets.len() || *looped && !packets.is_empty();
                exists.then(|| (self.rotates_from_ns + passed_ms * MILLIS).max(self.tx_queue.free_ns()))
            }
        }
    }

    /// Returns packet number `number` for transmission: the next recorded packet, or a packet that is measured in the
    /// room.
    fn take(&mut self, number: u64) -> [u8; PACKET_LEN] {
        let Source::Recorded { packets, elapsed_ms: passed_ms, .. } = &mut self.source else {
            return self.measure(number);
        };
        let at = number as usize % packets.len();
        let millis = |at: usize| Packet::check(&packets[at]).map_or(0, |packet| packet.millis());
        let next = (at + 1) % packets.len();
        let passed = (millis(next) + CLOCK_PERIOD_MS - millis(at)) % CLOCK_PERIOD_MS;
        // The recorded clock does not define the time from the last packet to the first packet of the next lap, so use
        // 1 ms.
        *passed_ms += if next == 0 { 1 } else { u64::from(passed.min(1_000)) };
        packets[at]
    }
}

impl Device for LdSimulator {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        if self.tx_queue.next_ns().is_none() {
            let start_ns = self.due_ns(self.sent).filter(|&at| at <= now)?;
            let packet = self.take(self.sent);
            self.sent += 1;
            self.tx_queue.send(packet.to_vec(), start_ns, false);
        }
        self.tx_queue.take(now)
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        self.tx_queue.next_ns().or_else(|| self.due_ns(self.sent))
    }

    fn receive(&mut self, _: u8, _: Arrival) {}

    fn power_cycle(&mut self, now: Nanos) -> bool {
        self.restart(now, self.settings.boot_ns, self.settings.spin_up_s)
    }

    /// Restarts the scanner. Its clock restarts at 0. Its head has its full speed, because inertia kept it rotating.
    fn brown_out(&mut self, now: Nanos) -> bool {
        self.restart(now, RESTART_NS, 0.0)
    }

    fn abort(&mut self, now: Nanos) {
        self.tx_queue.abort(now);
    }

    fn rate(&self) -> u32 {
        self.tx_queue.rate()
    }

    fn streams(&self) -> bool {
        true
    }

    fn telegram_len(&self) -> Option<usize> {
        Some(PACKET_LEN)
    }
}

/// Returns the intact packets in the recording at `path`. If the recording has several sensors, `sensor` selects one of
/// them.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the recording cannot be read or has no packet, and the errors of [`Recording::of`].
pub fn recorded_packets(path: &Path, sensor: Option<&str>) -> Result<Vec<[u8; PACKET_LEN]>, Failure> {
    let whole = Recording::open_stream(path, Some(Family::Ld))?;
    let recording = sensor.map_or(Ok(whole.clone()), |sensor| whole.of(sensor))?;
    // Packets are sent unchanged, so the encoding is not used.
    let frames = recording.telegrams(Encoding { unit: Unit::Mm, mode: Mode(1) })?;
    let of_family = frames.filter(|frame| frame.family == Family::Ld as u8);
    let packets: Vec<_> = of_family
        .flat_map(|frame| frame.telegram.as_chunks().0.to_vec())
        .filter(|packet| Packet::check(packet).is_ok())
        .collect();
    if packets.is_empty() {
        let message =
            format!("cannot replay {}: it contains no packet of an LDROBOT scanner", path.display());
        let hint = "name a recording of an LDROBOT scanner, or a stream file with its bytes";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    Ok(packets)
}

/// Time from a dip of the voltage to the restart of the measurement. The value is invented, because LDROBOT does not
/// publish it.
const RESTART_NS: Nanos = 300 * MILLIS;

/// Returns the minimum and the maximum range of `model` according to its data sheet, in millimeters.
fn reach_mm(model: Model) -> std::ops::RangeInclusive<f64> {
    match model {
        Model::Ld06 | Model::Ld19 | Model::Stl19p => 20.0..=12_000.0,
        Model::Stl27l => 30.0..=25_000.0,
        Model::Ld14p => 100.0..=8_000.0,
    }
}
