//! The families of scanners in a world, a file each: how one of them is found, what its link's configuration says, what
//! its bytes mean to the judges. All else in a world knows none of them.

mod either;
mod ld;
mod lms;
mod rplidar;

use std::rc::Rc;
use std::sync::{Arc, LazyLock};

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_schema::{MILLIS, Nanos, Scan};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::Device;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::machine::ProtocolQuirks;
use scanhub_sim::room::Room;
use scanhub_sim::room::{Changes, PrecomputedScans};
use scanhub_sim::world::World as Scene;

use crate::scenario::Action;

/// A scanner of a world and its link, as the seed has them.
pub(crate) trait Family {
    /// The keys of its link, as `KEY=VALUE`.
    fn keys(&self) -> Vec<String>;

    /// Returns this scanner with a link that has no family, and no key that names one.
    fn auto(&self) -> Rc<dyn Family>;

    /// Returns the family, or both families of a scanner that is exchanged for a scanner of another family.
    fn families(&self) -> Vec<scanhub_schema::Family>;

    /// Returns the rates that the line may have, in bits per second.
    fn baud_rates(&self) -> Vec<u32>;

    /// The longest time between two scans, and from when something is measured until the scan that tells it has left.
    fn scan_times(&self) -> (Nanos, Nanos);

    /// The scanner as it is found, whose view changes as `changes` say.
    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner>;

    /// What it sent one by one, of the bytes of a sample of telegrams.
    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]>;

    /// So many of them are in a sample at the most.
    fn max_telegrams(&self) -> usize;

    /// Whether `unit` is measured values, and no reply.
    fn is_data(&self, unit: &[u8]) -> bool;

    /// Whether `scan` has the values of the last `sample` of telegrams, where a sample has those of a scan.
    fn is_scan_of(&self, scan: &Scan, sample: &[u8]) -> bool;

    /// Whether a line may have made `got` of one of the units that it `damaged` lately, so that nobody can know: a
    /// checksum is right once in a while.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool;

    /// Whether its head turns all around, and its scans are turns of points whose truth is known.
    fn is_rotating(&self) -> bool {
        false
    }

    /// Where the points of `unit` begin, if it has any and its head turns.
    fn first_point(&self, unit: &[u8]) -> Option<FirstPoint> {
        let _ = unit;
        None
    }

    /// How exactly `unit` tells points.
    fn point_accuracy(&self, unit: &[u8]) -> PointAccuracy {
        let _ = unit;
        PointAccuracy::default()
    }
}

/// The points of a packet.
pub(crate) struct FirstPoint {
    /// Where the first one is.
    pub(crate) clockwise_deg: f64,
    /// How many there are, one after the other.
    pub(crate) points: usize,
    /// How long the packet is on the line after the last one.
    pub(crate) line_time: Nanos,
}

/// How exactly a packet tells points, and how much may be missing without a mark.
#[derive(Clone, Copy)]
pub(crate) struct PointAccuracy {
    pub(crate) angle_deg: f64,
    pub(crate) range_mm: f64,
    /// Where nothing came back, the angle says little.
    pub(crate) no_return_deg: f64,
    /// Points of a turn.
    pub(crate) points: usize,
    /// Packets before and behind damaged bytes that may be lost with them: of what has a checksum only the one before
    /// them, and only that which follows could tell how its points are.
    pub(crate) neighbors: usize,
    /// Whether packets have a time of their own. Without one it takes a while until it is known how the scanner's clock
    /// goes, and over a long gap nobody can know how many packets there were.
    pub(crate) has_clock: bool,
}

impl Default for PointAccuracy {
    /// Packets that tell angles and ranges as they are, and everything by themselves.
    fn default() -> PointAccuracy {
        PointAccuracy {
            angle_deg: 0.05,
            range_mm: 2.0,
            no_return_deg: 0.05,
            points: 2,
            neighbors: 0,
            has_clock: true,
        }
    }
}

/// A simulated scanner, and what only some of its family can do; of the others it does nothing.
pub(crate) trait Scanner {
    /// The scanner itself.
    fn device(&self) -> &dyn Device;

    /// The same, to be driven.
    fn device_mut(&mut self) -> &mut dyn Device;

    /// Another one is at the line from `now` on, as `action` says; what somebody said to it just before, in bytes.
    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8>;

    /// Lets its voltage dip at `now`.
    fn brown_out(&mut self, now: Nanos) {
        self.device_mut().brown_out(now);
    }

    /// It behaves badly as `action` says, or well again.
    fn misbehave(&mut self, action: Option<&Action>);

    /// Something happens to it that only some scanners know.
    fn inject_fault(&mut self, fault: ScannerFault, now: Nanos) {
        let _ = (fault, now);
    }

    /// Its head turns at this share of its usual speed, as soon as it gets there.
    fn set_speed(&mut self, share: f64) {
        let _ = share;
    }

    /// The points that it measured since this was asked last, if their truth is known.
    fn measured(&mut self) -> Vec<TruePoint> {
        Vec::new()
    }
}

/// What happens to a scanner beside its line.
#[derive(Clone, Copy, Debug)]
pub(crate) enum ScannerFault {
    /// Something holds its head for so long.
    HeadHeld { span: Nanos },
    /// It says that it is well (0), may not be for long (1), or is not (2); if it is stubborn, also after it booted.
    Unhealthy { status: u8, is_stubborn: bool },
    /// While it measures it hears nothing; or it hears again.
    IgnoresRequests(bool),
}

/// The scanners that `random` draws.
pub(crate) fn draw(random: &mut fastrand::Rng) -> Vec<Rc<dyn Family>> {
    let count = random.usize(1..=2);
    let one = |random: &mut fastrand::Rng| -> Rc<dyn Family> {
        match random.u8(..8) {
            0..=3 => Rc::new(lms::Lms::draw(random)),
            4..=5 => Rc::new(ld::Ld::draw(random)),
            _ => Rc::new(rplidar::Rplidar::draw(random)),
        }
    };
    (0..count).map(|_| one(random)).collect()
}

/// Returns `first` together with a rotating scanner of another family, for which it is exchanged. Returns `first` alone
/// if it does not rotate.
pub(crate) fn either(first: Rc<dyn Family>, random: &mut fastrand::Rng) -> Rc<dyn Family> {
    let second: Rc<dyn Family> = match first.families()[..] {
        [scanhub_schema::Family::Ld] => Rc::new(rplidar::Rplidar::draw(random)),
        [scanhub_schema::Family::Rplidar] => Rc::new(ld::Ld::draw(random)),
        _ => return first,
    };
    let second = second.auto();
    Rc::new(either::TwoFamilies { first, second })
}

/// Returns whether these bytes look like a packet of an LDROBOT.
pub(crate) fn is_ld_packet(bytes: &[u8]) -> bool {
    bytes.len() == scanhub_drivers::ld::packet::PACKET_LEN && bytes.starts_with(&[0x54, 0x2C])
}

/// The scanner that a plan calls so, otherwise as `random` draws it; nothing if there is none: `ld19`, `a1`,
/// `a1:boost`, `a1:boost:streaming`.
pub(crate) fn from_name(text: &str, random: &mut fastrand::Rng) -> Option<Rc<dyn Family>> {
    match scanhub_drivers::ld::Model::from_name(text) {
        Some(model) => Some(Rc::new(ld::Ld::of(model, random))),
        None => Some(Rc::new(rplidar::Rplidar::from_name(text, random)?)),
    }
}

/// How a scanner behaves to which `action` happens: shares are in percent.
fn quirks(action: &Action) -> ProtocolQuirks {
    let share = |name| action.value(name) as f64 / 1e2;
    ProtocolQuirks {
        overlooked_share: share("overlooks"),
        nak_share: share("naks"),
        doubled_share: share("doubles"),
        late_reply_ns: action.value("late_ms") * MILLIS,
        is_mute: action.value("mute") > 0,
        ..ProtocolQuirks::default()
    }
}

/// The rooms without any noise, for all worlds. No LMS tells its scans of them.
fn still_rooms() -> Arc<PrecomputedScans> {
    static SCANS: LazyLock<Arc<PrecomputedScans>> = LazyLock::new(|| {
        let rooms = rooms(|scene| scene.with_noise(NoiseModel::NONE));
        Arc::new(PrecomputedScans::new(rooms, 1, Variant::HALF, Unit::Mm, Mode(1)))
    });
    SCANS.clone()
}

/// A head that is slowed down turns at this share of its speed.
const MIN_SPEED: f64 = 0.6;
/// The most by which a head gets faster or slower in a second, as a share of its usual speed.
const MAX_SPEED_CHANGE: f64 = 0.4;

/// What scanners see in all worlds: a room without anything near, the same with a post 0.8 m ahead, and with one 0.4 m
/// ahead.
fn rooms(layers: impl Fn(Scene) -> Scene) -> Vec<Room> {
    let rooms = [None, Some(800), Some(400)].map(|ahead_mm: Option<u32>| {
        let post =
            ahead_mm.map_or(String::new(), |mm| format!("[[thing]]\nradius_mm = 100\npose = [0, {mm}]\n"));
        let scene = Scene::of_toml("world", &format!("{WORLD_CONFIG}{post}")).expect("a scene");
        Room::new(&layers(scene), 1)
    });
    rooms.to_vec()
}

/// Four walls, and noise as a real sensor has it, but no codes: what is near is seen by every scan.
const WORLD_CONFIG: &str = "
[noise]
tail = 0
errors = 0
weak = false
dazzle = false

[[thing]]
line = [[3400, -500], [3400, 5600], [-4100, 5600], [-4100, -500]]

[[thing]]
radius_mm = 50
pose = [2900, 4800]
surface = \"reflector\"
";
