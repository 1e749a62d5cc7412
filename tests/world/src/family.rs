//! Scanner families of a world, one file each. A family defines the scanner's state at the start, the configuration of
//! its link, and what the scanner's bytes mean to invariants. The rest of the world does not depend on the family.

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

/// A scanner of a world together with its link, drawn from the seed.
pub(crate) trait Family {
    /// Returns the configuration keys of the link, as `KEY=VALUE`.
    fn keys(&self) -> Vec<String>;

    /// Returns this scanner with a link that configures no family and no key that implies a family.
    fn auto(&self) -> Rc<dyn Family>;

    /// Returns the family. Returns both families if an exchange replaces the scanner with one of another family.
    fn families(&self) -> Vec<scanhub_schema::Family>;

    /// Returns the rates that the line may have, in bits per second.
    fn baud_rates(&self) -> Vec<u32>;

    /// Returns two maximum times. The first one is the time between two scans. The second one is the time from a
    /// measurement until the hub has sent the scan that contains it.
    fn scan_times(&self) -> (Nanos, Nanos);

    /// Returns the scanner in the state in which the hub finds it. `changes` are the changes of its scene.
    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner>;

    /// Splits a sample of topic `telegram` into the telegrams or packets that the scanner sent.
    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]>;

    /// Returns the maximum number of telegrams or packets in a sample.
    fn max_telegrams(&self) -> usize;

    /// Returns whether `unit`, a telegram or packet, contains measured values and is not a reply.
    fn is_data(&self, unit: &[u8]) -> bool;

    /// Returns whether `scan` has the values of `sample`. Only families with one telegram per scan check this; all
    /// other families return `true`.
    fn is_scan_of(&self, scan: &Scan, sample: &[u8]) -> bool;

    /// Returns whether the line may have changed one of the recently `damaged` units into `got`, with a checksum that
    /// is valid by chance. The hub cannot detect such a change.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool;

    /// Returns whether this is a rotating scanner. The simulation records the points of rotating scanners.
    fn is_rotating(&self) -> bool {
        false
    }

    /// Returns the position of the first point of `unit`, or `None` if `unit` has no points or the scanner does not
    /// rotate.
    fn first_point(&self, unit: &[u8]) -> Option<FirstPoint> {
        let _ = unit;
        None
    }

    /// Returns the accuracy of the points in `unit`.
    fn point_accuracy(&self, unit: &[u8]) -> PointAccuracy {
        let _ = unit;
        PointAccuracy::default()
    }
}

/// Position of the points of a packet, which are consecutive.
pub(crate) struct FirstPoint {
    /// Angle of the first point.
    pub(crate) clockwise_deg: f64,
    /// Number of consecutive points.
    pub(crate) points: usize,
    /// Time that the packet still needs on the line after the measurement of its last point.
    pub(crate) line_time: Nanos,
}

/// Accuracy of the points of a packet, and limits for the data that may be missing from a scan that the hub does not
/// mark as incomplete.
#[derive(Clone, Copy)]
pub(crate) struct PointAccuracy {
    pub(crate) angle_deg: f64,
    pub(crate) range_mm: f64,
    /// Tolerance of the angle of a point without a return.
    pub(crate) no_return_deg: f64,
    /// Number of points of a revolution that may be missing although the hub does not mark the scan as incomplete.
    pub(crate) points: usize,
    /// Number of packets before and after damaged bytes that may be lost with these bytes. If packets have a checksum,
    /// only the packet before the damaged bytes may be lost, and only if its points cannot be decoded without the
    /// following packet.
    pub(crate) neighbors: usize,
    /// Whether packets contain a timestamp. Without a timestamp, the session needs a while to estimate the scanner's
    /// clock, and cannot determine the number of packets that are missing in a long gap.
    pub(crate) has_clock: bool,
}

impl Default for PointAccuracy {
    /// Returns the accuracy of packets that contain exact angles and ranges, and that can be decoded without another
    /// packet.
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

/// A simulated scanner. Methods that only some families need do nothing by default.
pub(crate) trait Scanner {
    /// Returns the simulated device.
    fn device(&self) -> &dyn Device;

    /// Returns the simulated device, to advance it or send it bytes.
    fn device_mut(&mut self) -> &mut dyn Device;

    /// Replaces the scanner at `now` as `action` specifies. Returns the bytes that another host has just sent to the
    /// new scanner.
    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8>;

    /// Makes the supply voltage dip at `now`.
    fn brown_out(&mut self, now: Nanos) {
        self.device_mut().brown_out(now);
    }

    /// Starts the misbehavior that `action` specifies. With `None`, ends all misbehavior.
    fn misbehave(&mut self, action: Option<&Action>);

    /// Injects a fault that only some scanners can have.
    fn inject_fault(&mut self, fault: ScannerFault, now: Nanos) {
        let _ = (fault, now);
    }

    /// Sets the target speed of the head, as a share of its usual speed.
    fn set_speed(&mut self, share: f64) {
        let _ = share;
    }

    /// Returns the points that the scanner measured since the last call. The list is empty if the simulation does not
    /// record points.
    fn measured(&mut self) -> Vec<TruePoint> {
        Vec::new()
    }
}

/// A fault of a scanner that does not come from its line.
#[derive(Clone, Copy, Debug)]
pub(crate) enum ScannerFault {
    /// The head is blocked for this time.
    HeadHeld { span: Nanos },
    /// The reported health status: good (0), warning (1) or error (2). A stubborn scanner keeps the status after a
    /// restart.
    Unhealthy { status: u8, is_stubborn: bool },
    /// The scanner ignores all requests while it measures.
    IgnoresRequests(bool),
}

/// Draws one or two scanners.
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

/// Returns `first` together with a rotating scanner of another family, which replaces `first` at an exchange. Returns
/// `first` alone if its scanner does not rotate.
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

/// Returns the scanner with this name, with its other settings drawn from `random`, or `None` for an unknown name.
/// Examples are `ld19`, `a1`, `a1:boost` and `a1:boost:streaming`.
pub(crate) fn from_name(text: &str, random: &mut fastrand::Rng) -> Option<Rc<dyn Family>> {
    match scanhub_drivers::ld::Model::from_name(text) {
        Some(model) => Some(Rc::new(ld::Ld::of(model, random))),
        None => Some(Rc::new(rplidar::Rplidar::from_name(text, random)?)),
    }
}

/// Returns the protocol faults that `action` specifies. Shares in an action are in percent.
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

/// Returns the scenes without noise, computed once for all worlds. Only rotating scanners use them.
fn still_rooms() -> Arc<PrecomputedScans> {
    static SCANS: LazyLock<Arc<PrecomputedScans>> = LazyLock::new(|| {
        let rooms = rooms(|scene| scene.with_noise(NoiseModel::NONE));
        Arc::new(PrecomputedScans::new(rooms, 1, Variant::HALF, Unit::Mm, Mode(1)))
    });
    SCANS.clone()
}

/// Lowest speed of a head that is slowed down, as a share of its usual speed.
const MIN_SPEED: f64 = 0.6;
/// Maximum change of speed per second, as a share of the usual speed.
const MAX_SPEED_CHANGE: f64 = 0.4;

/// Returns the scenes of all worlds: a room without near objects, this room with a post 0.8 m ahead, and this room with
/// a post 0.4 m ahead.
fn rooms(layers: impl Fn(Scene) -> Scene) -> Vec<Room> {
    let rooms = [None, Some(800), Some(400)].map(|ahead_mm: Option<u32>| {
        let post =
            ahead_mm.map_or(String::new(), |mm| format!("[[thing]]\nradius_mm = 100\npose = [0, {mm}]\n"));
        let scene = Scene::of_toml("world", &format!("{WORLD_CONFIG}{post}")).expect("a scene");
        Room::new(&layers(scene), 1)
    });
    rooms.to_vec()
}

/// Configuration of a room with four walls. The noise is that of a real scanner but without codes, so that every scan
/// shows a near object.
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
