//! Slamtec RPLIDAR scanners, which measure on request, in one of several modes with different packets. The simulated
//! points have no noise, so that each published point can be found among the measured ones. An RPLIDAR has no EEPROM.
//! Only one request changes its permanent settings, and this request counts as an EEPROM write.

use std::rc::Rc;

use scanhub_drivers::rplidar::packet::PacketFormat;
use scanhub_schema::{MILLIS, Nanos, Scan};
use scanhub_sim::device::Device;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::machine::ProtocolQuirks;
use scanhub_sim::room::Changes;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator, RplidarStart};
use scanhub_sim::{Arrival, ChunkSize};

use super::{Family, FirstPoint, PointAccuracy, Scanner, ScannerFault, quirks, still_rooms};
use crate::scenario::Action;

/// An RPLIDAR with its link.
#[derive(Clone)]
pub(super) struct Rplidar {
    settings: RplidarSettings,
    /// Name of the family in the link.
    family: &'static str,
    /// Whether the motor is off at the start.
    is_off: bool,
    /// Whether the link configures the model, and the index of the mode that the link configures.
    is_model_configured: bool,
    mode: Option<usize>,
    beams: Option<usize>,
}

impl Rplidar {
    pub(super) fn draw(random: &mut fastrand::Rng) -> Rplidar {
        let model = DRAWN_MODELS[random.usize(..DRAWN_MODELS.len())];
        let mode = random.usize(..2 * model.modes().len());
        let mode = Some(mode).filter(|&mode| model.modes().get(mode).is_some_and(is_moderate));
        let start = [RplidarStart::Idle, RplidarStart::Streaming, RplidarStart::PowerOn][random.usize(..3)];
        let beams = (random.u8(..4) == 0).then(|| random.usize(200..2_000));
        let status = [0, 0, 0, 1, 2][random.usize(..5)];
        let mut drawn = Rplidar { mode, beams, ..Rplidar::of(model, random) };
        drawn.settings.start = start;
        drawn.settings.health = (if start == RplidarStart::Idle { status } else { status % 2 }, 0x8001);
        drawn
    }

    /// Returns an RPLIDAR of this model that is idle, with the default number of beams and its fastest mode.
    fn of(model: Model, random: &mut fastrand::Rng) -> Rplidar {
        let settings = RplidarSettings {
            speed_variation: random.f64() * 0.01,
            boot_ns: random.u64(100..2_500) * MILLIS,
            chunk: if random.bool() { ChunkSize::Uart } else { ChunkSize::Usb },
            seed: random.u64(..),
            ..RplidarSettings::of(model)
        };
        let is_model_configured = random.bool();
        Rplidar { settings, family: "rplidar", is_off: false, is_model_configured, mode: None, beams: None }
    }

    /// Returns the scanner with this name: `MODEL`, `MODEL:MODE` or `MODEL:MODE:STATE`. Without `MODE`, the scanner has
    /// its fastest mode, and without `STATE`, it is idle.
    pub(super) fn from_name(text: &str, random: &mut fastrand::Rng) -> Option<Rplidar> {
        let mut words = text.split(':');
        let (model, mode, state) = (words.next()?, words.next(), words.next());
        let model = Model::ALL.into_iter().find(|known| known.name() == model)?;
        let mut named = Rplidar::of(model, random);
        if let Some(mode) = mode.filter(|mode| !mode.is_empty()) {
            named.mode = Some(model.modes().iter().position(|known| key(known.name) == mode)?);
        }
        match state {
            None | Some("idle") => {}
            Some("streaming") => named.settings.start = RplidarStart::Streaming,
            Some("off") => named.is_off = true,
            Some("error") => named.settings.health = (2, 0x8001),
            Some(_) => return None,
        }
        words.next().is_none().then_some(named)
    }

    /// Returns the packet format, derived from the length of `sample` and the first bytes of each packet. A wrong
    /// checksum does not change the format.
    fn kind(&self, sample: &[u8]) -> Option<PacketFormat> {
        let is_of = |kind: &PacketFormat| {
            let begins = |packet: &[u8]| packet[0] >> 4 == 0xA && packet[1] >> 4 == 0x5;
            sample.len().is_multiple_of(kind.byte_len()) && sample.chunks(kind.byte_len()).all(begins)
        };
        let alike =
            if is_triangulating(self.settings.model) { PacketFormat::Express } else { PacketFormat::Dense };
        let checked = [alike, PacketFormat::Ultra, PacketFormat::UltraDense].into_iter().find(is_of);
        checked.or_else(|| {
            sample.len().is_multiple_of(PacketFormat::Standard.byte_len()).then_some(PacketFormat::Standard)
        })
    }
}

impl Family for Rplidar {
    fn keys(&self) -> Vec<String> {
        let RplidarSettings { model, .. } = self.settings;
        let model_key = self.is_model_configured.then(|| format!("model={}", model.name()));
        let mode = self.mode.map(|mode| format!("mode={}", key(model.modes()[mode].name)));
        let beams = self.beams.map(|beams| format!("beams={beams}"));
        [format!("family={}", self.family)].into_iter().chain(model_key).chain(mode).chain(beams).collect()
    }

    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(Rplidar { family: "auto", is_model_configured: false, mode: None, ..self.clone() })
    }

    fn families(&self) -> Vec<scanhub_schema::Family> {
        vec![scanhub_schema::Family::Rplidar]
    }

    fn baud_rates(&self) -> Vec<u32> {
        models_alike(self.settings.model).iter().map(|model| model.baud()).collect()
    }

    /// Returns times like those of an LDROBOT, but with a longer delay: the session detects the end of a revolution
    /// only when the head is well past that end.
    fn scan_times(&self) -> (Nanos, Nanos) {
        let slowest = models_alike(self.settings.model).iter().map(|model| model.revolutions_per_second());
        let slowest =
            slowest.fold(f64::MAX, f64::min) * super::MIN_SPEED * (1.0 - self.settings.speed_variation);
        let revolution_ns = (1e9 / slowest) as Nanos;
        (revolution_ns, 2 * revolution_ns + EDGE_DELAY)
    }

    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner> {
        let mut scanner = RplidarScanner::new(self.settings.clone(), changes);
        if self.is_off {
            let start_request = request(0xA8, &[0, 0]);
            start_request.into_iter().for_each(|byte| scanner.unit.receive(byte, Arrival::at(0)));
        }
        Box::new(scanner)
    }

    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        match self.kind(sample) {
            Some(kind) if !is_reply(sample) => sample.chunks(kind.byte_len()).collect(),
            _ => vec![sample],
        }
    }

    fn max_telegrams(&self) -> usize {
        128
    }

    fn is_data(&self, unit: &[u8]) -> bool {
        !is_reply(unit) && self.kind(unit).is_some_and(|kind| kind.byte_len() == unit.len())
    }

    /// Returns `true`, because the points of a revolution come from many samples.
    fn is_scan_of(&self, _: &Scan, _: &[u8]) -> bool {
        true
    }

    /// Returns whether the checksum of `got` is valid and any packet was damaged. A damaged packet has a valid checksum
    /// in 1 of 256 cases. Standard packets have no checksum.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool {
        let sum = || got[2..].iter().fold(0, |sum, byte| sum ^ byte);
        let is_right = match self.kind(got).filter(|_| !is_reply(got)) {
            Some(kind) if kind.is_checked() => sum() == got[0] & 15 | got[1] << 4,
            _ => true,
        };
        is_right && damaged.next().is_some()
    }

    fn is_rotating(&self) -> bool {
        true
    }

    fn first_point(&self, unit: &[u8]) -> Option<FirstPoint> {
        let kind = self.kind(unit).filter(|kind| !is_reply(unit) && kind.byte_len() == unit.len())?;
        // The first point does not depend on the next packet, so `unit` can take the place of that packet.
        let before = kind.point(unit, unit, 0).before;
        let clockwise_deg = f64::from(kind.start_angle(unit) - before).rem_euclid(360.0);
        Some(FirstPoint {
            clockwise_deg,
            points: kind.points(),
            line_time: line_time(unit, self.settings.model),
        })
    }

    fn point_accuracy(&self, unit: &[u8]) -> PointAccuracy {
        let plain = PointAccuracy { no_return_deg: 9.0, has_clock: false, ..PointAccuracy::default() };
        match self.kind(unit) {
            // Angle offsets are in steps of an eighth of a degree, at most 63 steps.
            Some(PacketFormat::Express) => PointAccuracy { angle_deg: 0.25, points: 12, ..plain },
            // Angles are derived from ranges, whose steps grow with the range.
            Some(PacketFormat::Ultra) => PointAccuracy { angle_deg: 0.4, range_mm: 6.0, points: 16, ..plain },
            Some(PacketFormat::UltraDense) => PointAccuracy { range_mm: 6.0, ..plain },
            Some(PacketFormat::Dense) => plain,
            // A standard packet is one point, so up to 45 packets may be missing from a scan that is not marked as
            // incomplete.
            Some(PacketFormat::Standard) | None => PointAccuracy { points: 45, neighbors: 16, ..plain },
        }
    }
}

/// A simulated RPLIDAR.
struct RplidarScanner {
    unit: RplidarSimulator,
    settings: RplidarSettings,
    changes: Changes,
    /// Start time of the current stream, and number of packets of this stream whose points have been reported as
    /// measured.
    stream: Option<Nanos>,
    reported: u64,
    /// Target speed, as a share of the usual speed.
    target_speed: f64,
    quirks: ProtocolQuirks,
    /// Whether the scanner ignores all requests while it measures, even the request to stop.
    ignores_requests: bool,
}

impl RplidarScanner {
    fn new(settings: RplidarSettings, changes: Changes) -> RplidarScanner {
        let unit = RplidarSimulator::new(settings.clone(), Room::of_series(still_rooms(), changes.clone()));
        let quirks = ProtocolQuirks::default();
        RplidarScanner {
            unit,
            settings,
            changes,
            stream: None,
            reported: 0,
            target_speed: 1.0,
            quirks,
            ignores_requests: false,
        }
    }

    /// Changes the speed of the head toward the target speed, after `passed_s` seconds have passed.
    fn change_speed(&mut self, passed_s: f64) {
        let usual = self.settings.revolutions_per_second;
        let Some(share) = self.unit.revolutions_per_second().map(|turns| turns / usual) else { return };
        let maximum = super::MAX_SPEED_CHANGE * passed_s;
        let next = share + (self.target_speed - share).clamp(-maximum, maximum);
        if next != share {
            self.unit.set_speed(usual * next);
        }
    }
}

impl Scanner for RplidarScanner {
    fn device(&self) -> &dyn Device {
        &self.unit
    }

    fn device_mut(&mut self) -> &mut dyn Device {
        if self.ignores_requests {
            let mute = self.quirks.is_mute || self.unit.streams();
            self.unit.set_quirks(ProtocolQuirks { is_mute: mute, ..self.quirks.clone() });
        }
        &mut self.unit
    }

    /// Replaces the scanner. The new scanner may be another model that measures in the same way. Its power is turned on
    /// at `now`, or it streams already.
    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8> {
        let models = models_alike(self.settings.model);
        let at = models.iter().position(|model| *model == self.settings.model).unwrap_or(0);
        let model = models[(at + action.value("rate") as usize) % models.len()];
        let RplidarSettings { speed_variation: wander, boot_ns, chunk, seed, .. } = self.settings;
        let seed = seed.wrapping_add(1);
        let settings =
            RplidarSettings { speed_variation: wander, boot_ns, chunk, seed, ..RplidarSettings::of(model) };
        *self = RplidarScanner {
            target_speed: self.target_speed,
            ..RplidarScanner::new(settings, self.changes.clone())
        };
        if action.value("streams") == 0 {
            self.unit.power_cycle(now);
            return Vec::new();
        }
        let mode = self.settings.typical as u8;
        [request(0xF0, &[0x94, 0x02]), request(0x82, &[mode, 0, 0, 0, 0])].concat()
    }

    fn misbehave(&mut self, action: Option<&Action>) {
        self.quirks = action.map_or_else(ProtocolQuirks::default, quirks);
        self.unit.set_quirks(self.quirks.clone());
    }

    fn inject_fault(&mut self, fault: ScannerFault, now: Nanos) {
        match fault {
            ScannerFault::HeadHeld { span } => self.unit.hold(now, span),
            ScannerFault::Unhealthy { status, is_stubborn } => {
                self.unit.set_health(now, (status, 0x8001), is_stubborn);
            }
            ScannerFault::IgnoresRequests(is_deaf) => {
                self.ignores_requests = is_deaf;
                self.unit.set_quirks(self.quirks.clone());
            }
        }
    }

    fn set_speed(&mut self, share: f64) {
        self.target_speed = share;
    }

    fn measured(&mut self) -> Vec<TruePoint> {
        let (stream, sent) = (self.unit.begin_ns(), self.unit.sent().unwrap_or(0));
        if self.stream != stream || sent < self.reported {
            (self.stream, self.reported) = (stream, 0);
        }
        if sent == self.reported {
            return Vec::new();
        }
        let Some(mode) = self.unit.mode() else { return Vec::new() };
        let per_packet = mode.form.points() as u64;
        let points = self.reported * per_packet..sent * per_packet;
        self.reported = sent;
        let points: Vec<TruePoint> = points.filter_map(|point| self.unit.truth(point)).collect();
        self.change_speed(points.len() as f64 * mode.sample_us / 1e6);
        points
    }
}

/// Returns the models that measure in the same way as `model`. The hub cannot distinguish these models by their
/// packets. All other models have different packets.
fn models_alike(model: Model) -> &'static [Model] {
    if is_triangulating(model) {
        &[Model::A1, Model::A2m8, Model::A2m12, Model::A3]
    } else {
        &[Model::S1, Model::C1, Model::S2, Model::S3]
    }
}

fn is_triangulating(model: Model) -> bool {
    matches!(model, Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)
}

/// Returns whether the mode has few packets per second, so that a world runs fast with this mode.
fn is_moderate(mode: &scanhub_sim::rplidar::Mode) -> bool {
    mode.form != scanhub_sim::rplidar::PacketFormat::Standard || mode.sample_us > 150.0
}

/// Returns the name of a mode as in the configuration of a link.
fn key(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_lowercase()
}

/// Returns whether `bytes` are a response. The start of a packet can look like the descriptor of a response, so the
/// length is checked, too.
fn is_reply(bytes: &[u8]) -> bool {
    let &[0xA5, 0x5A, a, b, c, d, _, ref rest @ ..] = bytes else { return false };
    let word = u32::from_le_bytes([a, b, c, d]);
    let (len, follows) = ((word & 0x3FFF_FFFF) as usize, word >> 30 != 0);
    rest.len() == if follows { 0 } else { len }
}

/// Returns a request with its payload and checksum.
fn request(command: u8, payload: &[u8]) -> Vec<u8> {
    let bytes = [&[0xA5, command, payload.len() as u8], payload].concat();
    let sum = bytes.iter().fold(0, |sum, byte| sum ^ byte);
    [bytes, vec![sum]].concat()
}

fn line_time(unit: &[u8], model: Model) -> Nanos {
    scanhub_schema::line_time(unit.len(), model.baud())
}

/// Models from which a seed draws a scanner, with repetitions. Fast models occur only once, because their points take
/// long to compute.
const DRAWN_MODELS: [Model; 13] = [
    Model::A1,
    Model::A1,
    Model::A1,
    Model::A2m8,
    Model::A2m8,
    Model::A2m12,
    Model::A3,
    Model::S1,
    Model::S1,
    Model::C1,
    Model::C1,
    Model::S2,
    Model::S3,
];
/// Maximum time from the end of a revolution until its scan is published. The head must be ten degrees and two packets
/// past the end, and the hub must receive the last packet.
const EDGE_DELAY: Nanos = 90 * MILLIS;
