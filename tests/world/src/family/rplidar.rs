//! Slamtec RPLIDAR: a scanner that is asked and told to measure, in one of several modes whose packets differ. What it
//! measures has no noise, so that each point that is told can be found among those that are true. It has no EEPROM;
//! what it would keep is changed by one request only, and each of these counts as a write.

use std::rc::Rc;

use scanhub_drivers::rplidar::packet::Kind;
use scanhub_schema::{MILLIS, Nanos, Scan};
use scanhub_sim::device::Device;
use scanhub_sim::ld::TruePoint;
use scanhub_sim::machine::ProtocolQuirks;
use scanhub_sim::room::Changes;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Form, Model, RplidarSettings, RplidarSimulator, RplidarStart};
use scanhub_sim::{Arrival, ChunkSize};

use super::{Ailment, Begin, Exactness, Family, Scanner, quirks, still_rooms};
use crate::plan::Action;

/// One of them, and what its link asks for.
#[derive(Clone)]
pub(super) struct Rplidar {
    settings: RplidarSettings,
    /// Name of the family in the link.
    family: &'static str,
    /// Nobody told its motor to turn.
    is_off: bool,
    /// The link says which model it is, and in which of its modes it shall measure.
    is_said: bool,
    mode: Option<usize>,
    beams: Option<usize>,
}

impl Rplidar {
    pub(super) fn draw(random: &mut fastrand::Rng) -> Rplidar {
        let model = DRAWN[random.usize(..DRAWN.len())];
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

    /// One of this model, idle, on its own beams and in its fastest mode.
    fn of(model: Model, random: &mut fastrand::Rng) -> Rplidar {
        let settings = RplidarSettings {
            wander: random.f64() * 0.01,
            boot_ns: random.u64(100..2_500) * MILLIS,
            chunk: if random.bool() { ChunkSize::Uart } else { ChunkSize::Usb },
            seed: random.u64(..),
            ..RplidarSettings::of(model)
        };
        let is_said = random.bool();
        Rplidar { settings, family: "rplidar", is_off: false, is_said, mode: None, beams: None }
    }

    /// The one that is written `MODEL`, `MODEL:MODE` or `MODEL:MODE:STATE`; without a mode it is the fastest, and
    /// without a state it is idle.
    pub(super) fn named(text: &str, random: &mut fastrand::Rng) -> Option<Rplidar> {
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

    /// What these bytes are packets of: by what each begins with, for a wrong checksum does not make them others.
    fn kind(&self, sample: &[u8]) -> Option<Kind> {
        let is_of = |kind: &Kind| {
            let begins = |packet: &[u8]| packet[0] >> 4 == 0xA && packet[1] >> 4 == 0x5;
            sample.len().is_multiple_of(kind.bytes()) && sample.chunks(kind.bytes()).all(begins)
        };
        let alike = if is_triangulating(self.settings.model) { Kind::Express } else { Kind::Dense };
        let checked = [alike, Kind::Ultra, Kind::UltraDense].into_iter().find(is_of);
        checked.or_else(|| sample.len().is_multiple_of(Kind::Standard.bytes()).then_some(Kind::Standard))
    }
}

impl Family for Rplidar {
    fn keys(&self) -> Vec<String> {
        let RplidarSettings { model, .. } = self.settings;
        let said = self.is_said.then(|| format!("model={}", model.name()));
        let mode = self.mode.map(|mode| format!("mode={}", key(model.modes()[mode].name)));
        let beams = self.beams.map(|beams| format!("beams={beams}"));
        [format!("family={}", self.family)].into_iter().chain(said).chain(mode).chain(beams).collect()
    }

    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(Rplidar { family: "auto", is_said: false, mode: None, ..self.clone() })
    }

    fn families(&self) -> Vec<scanhub_schema::Family> {
        vec![scanhub_schema::Family::Rplidar]
    }

    fn rates(&self) -> Vec<u32> {
        alike(self.settings.model).iter().map(|model| model.baud()).collect()
    }

    /// As of any head that turns; whether a turn is over is seen only when the head is well behind its end.
    fn times(&self) -> (Nanos, Nanos) {
        let slowest = alike(self.settings.model).iter().map(|model| model.turns_per_second());
        let slowest = slowest.fold(f64::MAX, f64::min) * super::SLOWEST * (1.0 - self.settings.wander);
        let turn = (1e9 / slowest) as Nanos;
        (turn, 2 * turn + BEHIND)
    }

    fn found(&self, changes: Changes) -> Box<dyn Scanner> {
        let mut scanner = AtLine::new(self.settings.clone(), changes);
        if self.is_off {
            let said = request(0xA8, &[0, 0]);
            said.into_iter().for_each(|byte| scanner.unit.receive(byte, Arrival::at(0)));
        }
        Box::new(scanner)
    }

    fn units<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        match self.kind(sample) {
            Some(kind) if !is_reply(sample) => sample.chunks(kind.bytes()).collect(),
            _ => vec![sample],
        }
    }

    fn most_units(&self) -> usize {
        128
    }

    fn is_data(&self, unit: &[u8]) -> bool {
        !is_reply(unit) && self.kind(unit).is_some_and(|kind| kind.bytes() == unit.len())
    }

    /// A turn has points of many samples.
    fn is_scan_of(&self, _: &Scan, _: &[u8]) -> bool {
        true
    }

    /// One of 256 damaged ones has a right checksum, and single points have none.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool {
        let sum = || got[2..].iter().fold(0, |sum, byte| sum ^ byte);
        let is_right = match self.kind(got).filter(|_| !is_reply(got)) {
            Some(kind) if kind.is_checked() => sum() == got[0] & 15 | got[1] << 4,
            _ => true,
        };
        is_right && damaged.next().is_some()
    }

    fn turns(&self) -> bool {
        true
    }

    fn begin(&self, unit: &[u8]) -> Option<Begin> {
        let kind = self.kind(unit).filter(|kind| !is_reply(unit) && kind.bytes() == unit.len())?;
        // What its first point is depends on nothing that comes behind it.
        let before = kind.point(unit, unit, 0).before;
        let clockwise_deg = f64::from(kind.start(unit) - before).rem_euclid(360.0);
        Some(Begin { clockwise_deg, points: kind.points(), on_line: line_time(unit, self.settings.model) })
    }

    fn exactness(&self, unit: &[u8]) -> Exactness {
        let plain = Exactness { nothing_deg: 9.0, has_clock: false, ..Exactness::default() };
        match self.kind(unit) {
            // Angles are told in eighths of a degree, up to 63.
            Some(Kind::Express) => Exactness { angle_deg: 0.25, points: 12, ..plain },
            // Angles follow from ranges, whose steps get wider.
            Some(Kind::Ultra) => Exactness { angle_deg: 0.4, range_mm: 6.0, points: 16, ..plain },
            Some(Kind::UltraDense) => Exactness { range_mm: 6.0, ..plain },
            Some(Kind::Dense) => plain,
            // So many may be missing without a mark.
            Some(Kind::Standard) | None => Exactness { points: 45, neighbours: 16, ..plain },
        }
    }
}

/// A scanner at a line.
struct AtLine {
    unit: RplidarSimulator,
    settings: RplidarSettings,
    changes: Changes,
    /// The stream of which so many packets' points were told as true: when it began.
    stream: Option<Nanos>,
    told: u64,
    /// The share of its usual speed at which its head shall turn.
    wanted: f64,
    quirks: ProtocolQuirks,
    /// While it measures it hears nothing, not even that it shall stop.
    is_deaf: bool,
}

impl AtLine {
    fn new(settings: RplidarSettings, changes: Changes) -> AtLine {
        let unit = RplidarSimulator::new(settings.clone(), Room::of_series(still_rooms(), changes.clone()));
        let quirks = ProtocolQuirks::default();
        AtLine { unit, settings, changes, stream: None, told: 0, wanted: 1.0, quirks, is_deaf: false }
    }

    /// Brings its head nearer to the speed that it shall have.
    fn turn(&mut self, passed_s: f64) {
        let usual = self.settings.turns_per_second;
        let Some(share) = self.unit.turns_per_second().map(|turns| turns / usual) else { return };
        let most = super::INERTIA * passed_s;
        let next = share + (self.wanted - share).clamp(-most, most);
        if next != share {
            self.unit.set_speed(usual * next);
        }
    }
}

impl Scanner for AtLine {
    fn device(&self) -> &dyn Device {
        &self.unit
    }

    fn device_mut(&mut self) -> &mut dyn Device {
        if self.is_deaf {
            let mute = self.quirks.mute || self.unit.streams();
            self.unit.set_quirks(ProtocolQuirks { mute, ..self.quirks.clone() });
        }
        &mut self.unit
    }

    /// Of the same kind, maybe another model; it gets its power then, or somebody has it stream.
    fn exchange(&mut self, action: &Action, now: Nanos) -> Vec<u8> {
        let models = alike(self.settings.model);
        let at = models.iter().position(|model| *model == self.settings.model).unwrap_or(0);
        let model = models[(at + action.value("rate") as usize) % models.len()];
        let RplidarSettings { wander, boot_ns, chunk, seed, .. } = self.settings;
        let seed = seed.wrapping_add(1);
        let settings = RplidarSettings { wander, boot_ns, chunk, seed, ..RplidarSettings::of(model) };
        *self = AtLine { wanted: self.wanted, ..AtLine::new(settings, self.changes.clone()) };
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

    fn suffer(&mut self, ailment: Ailment, now: Nanos) {
        match ailment {
            Ailment::Held { span } => self.unit.hold(now, span),
            Ailment::Unwell { status, is_stubborn } => {
                self.unit.set_health(now, (status, 0x8001), is_stubborn);
            }
            Ailment::Deaf(is_deaf) => {
                self.is_deaf = is_deaf;
                self.unit.set_quirks(self.quirks.clone());
            }
        }
    }

    fn set_pace(&mut self, share: f64) {
        self.wanted = share;
    }

    fn measured(&mut self) -> Vec<TruePoint> {
        let (stream, sent) = (self.unit.begin_ns(), self.unit.sent().unwrap_or(0));
        if self.stream != stream || sent < self.told {
            (self.stream, self.told) = (stream, 0);
        }
        if sent == self.told {
            return Vec::new();
        }
        let Some(mode) = self.unit.mode() else { return Vec::new() };
        let per_packet = mode.form.points() as u64;
        let points = self.told * per_packet..sent * per_packet;
        self.told = sent;
        let points: Vec<TruePoint> = points.filter_map(|point| self.unit.truth(point)).collect();
        self.turn(points.len() as f64 * mode.sample_us / 1e6);
        points
    }
}

/// The models that measure alike: what one of them sends another one may send, and nobody takes one's packets for the
/// other's.
fn alike(model: Model) -> &'static [Model] {
    if is_triangulating(model) {
        &[Model::A1, Model::A2m8, Model::A2m12, Model::A3]
    } else {
        &[Model::S1, Model::C1, Model::S2, Model::S3]
    }
}

fn is_triangulating(model: Model) -> bool {
    matches!(model, Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)
}

/// So many packets a second take long to judge, and need not be in many worlds.
fn is_moderate(mode: &scanhub_sim::rplidar::Mode) -> bool {
    mode.form != Form::Standard || mode.sample_us > 150.0
}

/// The name of a mode as links write it.
fn key(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_lowercase()
}

/// Whether it is an answer: what a packet begins with would also be an answer's head, if its length were that of one.
fn is_reply(bytes: &[u8]) -> bool {
    let &[0xA5, 0x5A, a, b, c, d, _, ref rest @ ..] = bytes else { return false };
    let word = u32::from_le_bytes([a, b, c, d]);
    let (len, follows) = ((word & 0x3FFF_FFFF) as usize, word >> 30 != 0);
    rest.len() == if follows { 0 } else { len }
}

/// A request with a payload, and its checksum.
fn request(command: u8, payload: &[u8]) -> Vec<u8> {
    let bytes = [&[0xA5, command, payload.len() as u8], payload].concat();
    let sum = bytes.iter().fold(0, |sum, byte| sum ^ byte);
    [bytes, vec![sum]].concat()
}

fn line_time(unit: &[u8], model: Model) -> Nanos {
    scanhub_schema::line_time(unit.len(), model.baud())
}

/// The models that are drawn, fast ones seldom: their points take long to measure.
const DRAWN: [Model; 13] = [
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
/// A head is ten degrees and two packets behind the end of a turn before it is over, and the last packet is on the
/// line.
const BEHIND: Nanos = 90 * MILLIS;
