//! A scanner that answers requests and measures, and the line behind it with its damage: small, and without a room. Each
//! point's range says which one it is.

use std::collections::VecDeque;

use scanhub_drivers::rplidar::packet::Kind;
use scanhub_drivers::rplidar::{Mode, Model};
use scanhub_schema::{MILLIS, Nanos, line_time};

use crate::session::encode::{Sample, answer_of, encode};
use crate::session::wire::{Damage, Sent};

/// A mode that it offers.
pub(crate) type Offered = (&'static str, f64, Kind);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Doing {
    Nothing,
    Booting {
        until: Nanos,
    },
    /// From this point on, of which packets were sent.
    Measuring {
        kind: Kind,
        us: f64,
        zero: Nanos,
        packets: u64,
    },
}

pub(crate) struct Head {
    pub(crate) id: u8,
    pub(crate) baud: u32,
    pub(crate) modes: Vec<Offered>,
    pub(crate) typical: u8,
    /// Firmware that cannot list its modes.
    pub(crate) is_old: bool,
    /// Turns in a second.
    pub(crate) hz: f64,
    /// By how much its points take longer than it says.
    pub(crate) drift: f64,
    pub(crate) damage: Damage,
    /// Status and code; whether booting heals it.
    pub(crate) health: (u8, u16),
    pub(crate) heals: bool,
    /// Requests that it does not hear, each as often as it is here.
    pub(crate) deaf_to: Vec<u8>,
    /// Whether it is there.
    pub(crate) is_on: bool,
    /// Bytes that it sends before its greeting.
    pub(crate) junk: Vec<u8>,
    pub(crate) dtr: bool,
    /// What another rate makes of its bytes is text.
    pub(crate) is_text: bool,
    /// The last request for a motor: duty or speed.
    pub(crate) motor: Option<u16>,
    pub(crate) requests: Vec<u8>,
    doing: Doing,
    request: Vec<u8>,
    random: fastrand::Rng,
    burst: bool,
    line: VecDeque<(Nanos, u8)>,
    free_at: Nanos,
    pub(crate) sent: Vec<Sent>,
    /// Points of the streams before this one.
    before: u64,
}

impl Head {
    pub(crate) fn new(model: Model, seed: u64) -> Head {
        let (id, modes): (u8, Vec<Offered>) = match model {
            Model::A1 => (
                0x18,
                vec![
                    ("Standard", 508.0, Kind::Standard),
                    ("Express", 254.0, Kind::Express),
                    ("Boost", 127.0, Kind::Ultra),
                    ("Sensitivity", 127.0, Kind::Ultra),
                    ("Stability", 201.0, Kind::Ultra),
                ],
            ),
            Model::A2m8 => {
                (0x28, vec![("Standard", 500.0, Kind::Standard), ("Sensitivity", 125.0, Kind::Ultra)])
            }
            Model::A2m12 => {
                (0x2C, vec![("Standard", 250.0, Kind::Standard), ("Sensitivity", 62.5, Kind::Ultra)])
            }
            Model::A3 => {
                (0x31, vec![("Standard", 250.0, Kind::Standard), ("Sensitivity", 62.5, Kind::Ultra)])
            }
            Model::S1 => {
                (0x61, vec![("Standard", 217.5, Kind::Standard), ("DenseBoost", 108.75, Kind::Dense)])
            }
            Model::S2 => (0x71, vec![("Standard", 62.5, Kind::Standard), ("DenseBoost", 31.25, Kind::Dense)]),
            Model::S3 => {
                (0x81, vec![("Standard", 62.5, Kind::Standard), ("Ultra Dense", 31.25, Kind::UltraDense)])
            }
            Model::C1 => {
                (0x41, vec![("Standard", 200.0, Kind::Standard), ("DenseBoost", 200.0, Kind::Dense)])
            }
        };
        Head {
            id,
            baud: model.baud(),
            typical: modes.len() as u8 - 1,
            modes,
            is_old: false,
            hz: f64::from(model.turns_per_second()) * 1.000_7,
            drift: 0.0,
            damage: Damage::default(),
            health: (0, 0),
            heals: true,
            deaf_to: Vec::new(),
            is_on: true,
            junk: Vec::new(),
            dtr: true,
            is_text: false,
            motor: None,
            requests: Vec::new(),
            doing: Doing::Nothing,
            request: Vec::new(),
            random: fastrand::Rng::with_seed(seed),
            burst: false,
            line: VecDeque::new(),
            free_at: 0,
            sent: Vec::new(),
            before: 0,
        }
    }

    /// As somebody left it: measuring in its first mode of this kind.
    pub(crate) fn left_in(&mut self, kind: Kind, now: Nanos) {
        let us = self.modes.iter().find(|(.., of)| *of == kind).map_or(254.0, |(_, us, _)| *us);
        self.doing = Doing::Measuring { kind, us, zero: now, packets: 0 };
        self.dtr = false;
    }

    /// So many bytes were not read while nobody was there.
    pub(crate) fn line_is_full(&mut self, bytes: usize) {
        self.line.extend((0..bytes).map(|n| (0, (n * 31 % 256) as u8)));
    }

    /// The power is gone and back: it boots.
    pub(crate) fn boot(&mut self, now: Nanos) {
        self.end(now);
        self.doing = Doing::Booting { until: now + 671 * MILLIS };
    }

    pub(crate) fn is_measuring(&self) -> bool {
        matches!(self.doing, Doing::Measuring { .. })
    }

    fn us(&self) -> Option<(Nanos, f64)> {
        match self.doing {
            Doing::Measuring { zero, us, .. } => Some((zero, us * 1e3 * (1.0 + self.drift))),
            _ => None,
        }
    }

    /// When point number `point` of this stream is measured.
    pub(crate) fn time(&self, point: f64) -> Option<Nanos> {
        self.us().map(|(zero, ns)| zero + (point * ns) as Nanos)
    }

    /// Raw degrees from one point to the next.
    pub(crate) fn step(&self) -> f64 {
        self.us().map_or(0.0, |(_, ns)| 360.0 * self.hz * ns / 1e9)
    }

    /// What point number `point` is.
    pub(crate) fn sample(point: u64) -> Sample {
        let range = if point % 7 == 3 { 0 } else { 1_500 + (point * 7_919 % 997) as u32 };
        Sample { range, eighths: (point * 13 % 64) as u32, quality: 1 + (point % 60) as u32 }
    }

    /// Degrees by which it lies before its place.
    pub(crate) fn before(kind: Kind, sample: Sample) -> f64 {
        match kind {
            // One in eight comes out of order, by up to five places.
            Kind::Standard if sample.eighths < 8 => f64::from(sample.eighths),
            Kind::Express => f64::from(sample.eighths) / 8.0,
            Kind::Ultra if sample.range < 50 => 7.5,
            Kind::Ultra => {
                let k2 = f64::from(98_361 / (4 * sample.range));
                8.0 - (k2 / 1024.0 + k2.powi(3) / 6_442_450_944.0).to_degrees()
            }
            _ => 0.0,
        }
    }

    /// A byte that the host wrote at `rate` was through at `now`.
    pub(crate) fn write(&mut self, byte: u8, rate: u32, now: Nanos) {
        self.send_until(now);
        if !self.is_on || rate != self.baud || matches!(self.doing, Doing::Booting { .. }) {
            return;
        }
        if self.request.is_empty() && byte != 0xA5 {
            return;
        }
        self.request.push(byte);
        let request = match self.request[..] {
            [_, command] if command < 0x80 => Some((command, Vec::new())),
            [_, command, len, ..] if self.request.len() == usize::from(len) + 4 => {
                let sum = self.request.iter().fold(0, |sum, byte| sum ^ byte);
                assert_eq!(sum, 0, "{:02X?}", self.request);
                Some((command, self.request[3..self.request.len() - 1].to_vec()))
            }
            _ => None,
        };
        if let Some((command, payload)) = request {
            self.request.clear();
            self.requests.push(command);
            self.obey(command, &payload, now);
        }
    }

    fn obey(&mut self, command: u8, payload: &[u8], now: Nanos) {
        if let Some(at) = self.deaf_to.iter().position(|unheard| *unheard == command) {
            self.deaf_to.swap_remove(at);
            return;
        }
        if self.is_measuring() && !matches!(command, 0x25 | 0x40 | 0xA8 | 0xF0) {
            return;
        }
        let word = |at: usize| u16::from_le_bytes([payload[at], payload[at + 1]]);
        match command {
            0x25 => self.end(now),
            0x40 => {
                if self.heals {
                    self.health = (0, 0);
                }
                self.boot(now);
            }
            0x50 => {
                let mut info = vec![self.id, 29, 1, 7];
                info.extend((0..16).map(|n| n * 17));
                self.answer(0x04, 0, &info, now);
            }
            0x52 => {
                let [low, high] = self.health.1.to_le_bytes();
                self.answer(0x06, 0, &[self.health.0, low, high], now);
            }
            0x59 => {
                let us = |n: usize| (self.modes.get(n).map_or(0.0, |mode| mode.1) as u16).to_le_bytes();
                self.answer(0x15, 0, &[us(0), us(1)].concat(), now);
            }
            0x84 if self.is_old => {}
            0x84 => {
                let mode = payload.get(4).map_or(0, |mode| usize::from(*mode));
                let (name, us, kind) = self.modes[mode.min(self.modes.len() - 1)];
                let data = match payload[0] {
                    0x70 => (self.modes.len() as u16).to_le_bytes().to_vec(),
                    0x71 => ((us * 256.0) as u32).to_le_bytes().to_vec(),
                    0x75 => vec![answer_of(kind)],
                    0x7C => vec![self.typical, 0],
                    0x7F => [name.as_bytes(), &[0]].concat(),
                    key => panic!("{key:02X} is not asked for"),
                };
                self.answer(0x20, 0, &[&payload[..4], &data[..]].concat(), now);
            }
            0xFF => self.answer(0xFF, 0, &[u8::from(self.id >> 4 == 2), 0, 0, 0], now),
            0xF0 | 0xA8 => self.motor = Some(word(0)),
            0x20 | 0x82 => {
                let mode = if command == 0x20 { 0 } else { usize::from(payload[0]) };
                let (_, us, kind) = match self.is_old {
                    true if command == 0x82 => self.modes[1],
                    _ => self.modes[mode],
                };
                let len = kind.bytes() as u8;
                self.answer(answer_of(kind), 0x40, &[len], now);
                let zero = now + 10 * MILLIS + (self.before % 7_777) * 10_000;
                self.doing = Doing::Measuring { kind, us, zero, packets: 0 };
            }
            command => panic!("{command:02X} must not be said"),
        }
    }

    /// `data`, or packets of as many bytes as it says.
    fn answer(&mut self, answer: u8, times: u8, data: &[u8], now: Nanos) {
        let len = if times > 0 { data[0] } else { data.len() as u8 };
        let mut at = (now + 2 * MILLIS).max(self.free_at);
        let head = [0xA5, 0x5A, len, 0, 0, times, answer];
        let data = if times > 0 { &[][..] } else { data };
        for byte in head.iter().chain(data) {
            at += line_time(1, self.baud);
            self.line.push_back((at, *byte));
        }
        self.free_at = at;
    }

    fn end(&mut self, now: Nanos) {
        self.send_until(now);
        if let Doing::Measuring { kind, packets, .. } = self.doing {
            self.before += packets * kind.points() as u64;
        }
        self.doing = Doing::Nothing;
    }

    /// Bytes that have arrived by `now`, `room` at most.
    pub(crate) fn read(&mut self, now: Nanos, room: usize) -> Vec<u8> {
        self.send_until(now);
        let count = self.line.iter().take(room).take_while(|(at, _)| *at <= now).count();
        self.line.drain(..count).map(|(_, byte)| byte).collect()
    }

    /// When the next byte arrives, if that is before `until`.
    pub(crate) fn next(&mut self, until: Nanos, now: Nanos) -> Nanos {
        let mut at = now;
        while self.line.is_empty() && at < until {
            at = until.min(at + MILLIS);
            self.send_until(at);
        }
        self.line.front().map_or(until, |(at, _)| *at)
    }

    fn send_until(&mut self, now: Nanos) {
        if let Doing::Booting { until } = self.doing
            && now >= until
        {
            self.doing = Doing::Nothing;
            let text = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n......";
            let text = [&self.junk[..], &text[..64]].concat();
            for (n, byte) in text.iter().enumerate() {
                self.line.push_back((until + line_time(n + 1, self.baud), *byte));
            }
        }
        while let Doing::Measuring { kind, packets, .. } = self.doing {
            let points = kind.points() as u64;
            let first = packets * points;
            let Some(done) = self.time((first + points - 1) as f64).filter(|done| *done <= now && self.is_on)
            else {
                return;
            };
            let samples: Vec<_> = (first..first + points).map(Head::sample).collect();
            let late = if kind == Kind::Standard { Head::before(kind, samples[0]) } else { 0.0 };
            let start = first as f64 * self.step() - late;
            let bytes = encode(kind, start, &samples, Head::sample(first + points));
            self.put(bytes, done);
            if let Doing::Measuring { packets, .. } = &mut self.doing {
                *packets += 1;
            }
        }
    }

    fn put(&mut self, bytes: Vec<u8>, done: Nanos) {
        let (mut intact, mut at) = (true, done.max(self.free_at));
        for (place, &byte) in bytes.iter().enumerate() {
            at += line_time(1, self.baud);
            let stays = if self.burst { 0.75 } else { self.damage.lost };
            self.burst = self.random.f64() < stays;
            if self.random.f64() < self.damage.inserted {
                self.line.push_back((at, self.random.u8(..)));
                intact &= place == 0;
            }
            let flip = if self.random.f64() < self.damage.flipped { self.random.u8(1..) } else { 0 };
            intact &= !self.burst && flip == 0;
            if !self.burst {
                self.line.push_back((at, byte ^ flip));
            }
        }
        self.free_at = at;
        self.sent.push(Sent { bytes, intact, at });
    }

    /// What is left of a packet comes next, and is text.
    pub(crate) fn leave_text(&mut self, now: Nanos) {
        self.send_until(now);
        for _ in 0..60 {
            self.free_at = self.free_at.max(now) + line_time(1, self.baud);
            self.line.push_back((self.free_at, b'0'));
        }
    }

    /// What is on the line is lost, and so are the next bytes up to `until`.
    pub(crate) fn cut(&mut self, until: Nanos) {
        self.send_until(until);
        let oldest = self.line.front().map_or(until, |(at, _)| *at);
        self.line.retain(|(at, _)| *at > until);
        let is_hit = |sent: &&mut Sent| sent.at >= oldest && sent.at <= until + 10 * MILLIS;
        self.sent.iter_mut().filter(is_hit).for_each(|sent| sent.intact = false);
    }

    /// Nobody read until `until`, and only about `room` bytes found room; what was dropped are whole packets.
    pub(crate) fn overflow(&mut self, until: Nanos, room: usize) {
        self.send_until(until);
        let Some(kind) = self.kind() else { return };
        let dropped = self.line.len().saturating_sub(room) / kind.bytes();
        self.line.truncate(self.line.len() - dropped * kind.bytes());
        self.sent.iter_mut().rev().take(dropped).for_each(|sent| sent.intact = false);
    }

    /// The kind of packets that it sends.
    pub(crate) fn kind(&self) -> Option<Kind> {
        if let Doing::Measuring { kind, .. } = self.doing { Some(kind) } else { None }
    }

    /// The number of the mode of this name.
    pub(crate) fn has(&self, mode: Mode) -> bool {
        self.modes.iter().any(|(name, ..)| name.replace(' ', "").eq_ignore_ascii_case(mode.name()))
    }
}
