//! A scanner of LDROBOT, without a line and without a clock: its head turns and measures point by point, each at its own
//! time, and each twelve of them leave as a packet. It never listens. Or it sends packets that were recorded.

use std::f64::consts::TAU;
use std::path::Path;

use ld::Model;
use ld::framer::Framer;
use ld::packet::{CLOCK_TURN, Contents, LEN, POINTS, Packet, TURN};
use line::{MILLIS, Nanos};
use schema::{Failure, Kind};

use crate::device::{Chunk, Device, Part, Sent};
use crate::request_decoder::{Arrival, Dropped};
use crate::room::{Beams, Room};
use crate::transmission::{ChunkSize, Transmission};

/// How a scanner is.
#[derive(Clone, Copy, Debug)]
pub struct HeadSettings {
    /// Which one.
    pub model: Model,
    /// Turns in a second, on the mean; by default the model's.
    pub turns_per_second: f64,
    /// By which share of that the speed goes up and down; real ones hold it within 1 %.
    pub wander: f64,
    /// From power-on to the first packet.
    pub boot_ns: Nanos,
    /// How many bytes the host's hardware hands over at once.
    pub chunk: ChunkSize,
    /// Of its speed.
    pub seed: u64,
}

impl HeadSettings {
    /// A `model` as it comes out of its box, switched on two seconds ago.
    pub fn of(model: Model) -> HeadSettings {
        HeadSettings {
            model,
            turns_per_second: f64::from(model.turns_per_second()),
            wander: 0.005,
            boot_ns: 2_000 * MILLIS,
            chunk: ChunkSize::Uart,
            seed: 0,
        }
    }
}

/// What a scanner sends.
pub enum Packets {
    /// What it sees of a room.
    Room(Box<Room>),
    /// What another one sent: once, or again and again.
    Recorded {
        /// The packets.
        packets: Vec<[u8; LEN]>,
        /// Whether they begin again at their end.
        looped: bool,
    },
}

/// The scanner.
pub struct Head {
    settings: HeadSettings,
    source: Source,
    /// When its power came on, and when its head turns.
    power_ns: Nanos,
    turns_ns: Nanos,
    /// Packets sent since then.
    sent: u64,
    transmission: Option<Transmission<()>>,
    /// When the next packet may leave at the earliest.
    free_ns: Nanos,
}

enum Source {
    Room(Beams),
    Recorded {
        packets: Vec<[u8; LEN]>,
        looped: bool,
        /// Milliseconds of the clock of the one that sent them, since the first one.
        passed_ms: u64,
    },
}

/// A point of the head, without noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruePoint {
    /// When it is measured.
    pub at_ns: Nanos,
    /// Degrees, clockwise from the head's zero, 0 to 360.
    pub clockwise_deg: f64,
    /// What lies there in millimetres, if anything does.
    pub range_mm: Option<f64>,
}

impl Head {
    /// The scanner that `settings` describe, at time 0, when it turns already.
    pub fn new(settings: HeadSettings, packets: Packets) -> Head {
        let source = match packets {
            Packets::Room(room) => Source::Room(Beams::new(*room)),
            Packets::Recorded { packets, looped } => Source::Recorded { packets, looped, passed_ms: 0 },
        };
        Head { settings, source, power_ns: 0, turns_ns: 0, sent: 0, transmission: None, free_ns: 0 }
    }

    /// Point number `point` since the head turns, as it is; a recording does not tell.
    pub fn truth(&mut self, point: u64) -> TruePoint {
        let (at_ns, turns) = self.place(point);
        let range_mm = match &mut self.source {
            Source::Room(beams) => beams.look(at_ns, ahead_deg(turns)).exact_mm,
            Source::Recorded { .. } => None,
        };
        TruePoint { at_ns, clockwise_deg: turns.fract() * 360.0, range_mm }
    }

    /// Where point number `point` is: degrees clockwise from the head's zero, 0 to 360.
    pub fn clockwise_deg(&self, point: u64) -> f64 {
        self.place(point).1.fract() * 360.0
    }

    /// When point number `point` is measured, and how many turns the head has made by then.
    fn place(&self, point: u64) -> (Nanos, f64) {
        let seconds = point as f64 / f64::from(self.settings.model.points_per_second());
        let (pace, phase) = self.pace();
        let swing = ((pace * seconds + phase).sin() - phase.sin()) / pace;
        let turns = self.settings.turns_per_second * (seconds + self.settings.wander * swing);
        // A head does not begin where its zero is.
        (self.turns_ns + (seconds * 1e9) as Nanos, turns + phase / TAU)
    }

    /// Turns in a second at point number `point`.
    fn speed(&self, point: u64) -> f64 {
        let seconds = point as f64 / f64::from(self.settings.model.points_per_second());
        let (pace, phase) = self.pace();
        self.settings.turns_per_second * (1.0 + self.settings.wander * (pace * seconds + phase).cos())
    }

    /// How fast the speed goes up and down, and where it begins.
    fn pace(&self) -> (f64, f64) {
        let mut random = fastrand::Rng::with_seed(self.settings.seed);
        (TAU / WANDER_S, TAU * random.f64())
    }

    /// Packet number `number` of a room.
    fn measure(&mut self, number: u64) -> [u8; LEN] {
        let first = number * POINTS as u64;
        let places: [(Nanos, f64); POINTS] = std::array::from_fn(|i| self.place(first + i as u64));
        let model = self.settings.model;
        let Source::Room(beams) = &mut self.source else { return [0; LEN] };
        let points = places.map(|(at_ns, turns)| {
            let look = beams.look(at_ns, ahead_deg(turns));
            match look.range_mm.filter(|range_mm| reach_mm(model).contains(range_mm)) {
                Some(range_mm) => (range_mm.round() as u16, look.intensity),
                None => (0, 0),
            }
        });
        let hundredths = |turns: f64| (turns.fract() * f64::from(TURN)) as u16;
        let (last_ns, last_turns) = places[POINTS - 1];
        let millis = (last_ns - self.power_ns) / MILLIS % Nanos::from(CLOCK_TURN);
        let speed = (360.0 * self.speed(first)).round() as u16;
        let (start, end) = (hundredths(places[0].1), hundredths(last_turns));
        Contents { speed, start, points, end, millis: millis as u16 }.encode()
    }

    /// When packet number `number` is complete; nothing if there is none.
    fn due_ns(&self, number: u64) -> Option<Nanos> {
        match &self.source {
            Source::Room(_) => Some(self.place((number + 1) * POINTS as u64).0),
            Source::Recorded { packets, looped, passed_ms } => {
                let is_there = (number as usize) < packets.len() || *looped && !packets.is_empty();
                is_there.then(|| (self.turns_ns + passed_ms * MILLIS).max(self.free_ns))
            }
        }
    }

    /// Packet number `number`, which leaves now.
    fn take(&mut self, number: u64) -> [u8; LEN] {
        let Source::Recorded { packets, passed_ms, .. } = &mut self.source else {
            return self.measure(number);
        };
        let at = number as usize % packets.len();
        let millis = |at: usize| Packet::check(&packets[at]).map_or(0, |packet| packet.millis());
        let next = (at + 1) % packets.len();
        let passed = (millis(next) + CLOCK_TURN - millis(at)) % CLOCK_TURN;
        // From the end to the beginning the clock says nothing.
        *passed_ms += if next == 0 { 1 } else { u64::from(passed.min(1_000)) };
        packets[at]
    }
}

impl Device for Head {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        if self.transmission.is_none() {
            let start_ns = self.due_ns(self.sent).filter(|&at| at <= now)?;
            let packet = self.take(self.sent);
            self.sent += 1;
            let (rate, chunk) = (self.rate(), self.settings.chunk);
            self.transmission = Some(Transmission::new(packet.to_vec(), start_ns, rate, chunk, ()));
        }
        let rate = self.rate();
        let front = self.transmission.as_mut()?;
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        if !front.is_done() {
            return Some(Chunk { bytes, rate, idle_after, part: Part::Telegram });
        }
        let front = self.transmission.take()?;
        self.free_ns = front.end_ns();
        let aborted = front.is_broken();
        let (telegram, ()) = front.into_parts();
        let part = Part::End(Sent { is_reply: false, telegram, aborted });
        Some(Chunk { bytes, rate, idle_after, part })
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        match &self.transmission {
            Some(front) => Some(front.next_chunk_ns()),
            None => self.due_ns(self.sent),
        }
    }

    fn receive(&mut self, _: u8, _: Arrival) {}

    fn power_cycle(&mut self, now: Nanos) -> bool {
        self.break_off(now);
        self.power_ns = now;
        self.turns_ns = now + self.settings.boot_ns;
        self.sent = 0;
        if let Source::Recorded { passed_ms, .. } = &mut self.source {
            *passed_ms = 0;
        }
        self.transmission.as_ref().is_some_and(Transmission::is_broken)
    }

    fn break_off(&mut self, now: Nanos) {
        self.transmission.iter_mut().for_each(|front| front.break_off(now));
    }

    fn rate(&self) -> u32 {
        self.settings.model.baud()
    }

    fn streams(&self) -> bool {
        true
    }

    fn telegram_len(&self) -> Option<usize> {
        Some(LEN)
    }

    fn take_dropped(&mut self) -> Option<Dropped> {
        None
    }

    fn eeprom_writes(&self) -> u64 {
        0
    }
}

/// The packets in the bytes of the file at `path`, damaged ones left out.
///
/// # Errors
///
/// [`Kind::Input`] if it cannot be read, or there are none.
pub fn recorded(path: &Path) -> Result<Vec<[u8; LEN]>, Failure> {
    let wrong = |why: String| {
        let hint = "a file of the bytes that such a scanner sent";
        Failure::new(Kind::Input, format!("cannot replay {}: {why}", path.display()), hint)
    };
    let bytes = std::fs::read(path).map_err(|error| wrong(error.to_string()))?;
    let (mut framer, mut packets, mut rest) = (Framer::default(), Vec::new(), &bytes[..]);
    while !rest.is_empty() {
        let spare = framer.spare();
        let len = spare.len().min(rest.len());
        spare[..len].copy_from_slice(&rest[..len]);
        framer.commit(len);
        rest = &rest[len..];
        if rest.is_empty() {
            framer.release(Nanos::MAX);
        }
        while let Some(span) = framer.advance(usize::MAX) {
            packets.extend_from_slice(framer.bytes(span).as_chunks().0);
        }
    }
    if packets.is_empty() {
        Err(wrong("it holds no packet of an LDROBOT scanner".into()))
    } else {
        Ok(packets)
    }
}

/// The angle of a head that turns clockwise after so many turns: degrees, 0 ahead, counter-clockwise, -180 to 180.
fn ahead_deg(turns: f64) -> f64 {
    let clockwise = turns.fract() * 360.0;
    if clockwise > 180.0 { 360.0 - clockwise } else { -clockwise }
}

/// Between which ranges a model measures, by its data sheet.
fn reach_mm(model: Model) -> std::ops::RangeInclusive<f64> {
    match model {
        Model::Ld06 | Model::Ld19 | Model::Stl19p => 20.0..=12_000.0,
        Model::Stl27l => 30.0..=25_000.0,
        Model::Ld14p => 100.0..=8_000.0,
    }
}

/// The speed goes up and down once in so many seconds.
const WANDER_S: f64 = 7.3;
