//! Test bench with a session, a simulated RPLIDAR and the line between them, in virtual time; and the invariants of all
//! tests. The scanner replies to requests. The scanner does not simulate a room: the range of each point identifies the
//! point. The packets are encoded according to the description of the formats, independently of the decoder.

mod start;
mod stream;

use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _};
use scanhub_drivers::rplidar::packet::PacketFormat;
use scanhub_drivers::rplidar::{Mode, Model, RplidarSession};
use scanhub_drivers::{Settings, line};
use scanhub_schema::{MILLIS, Nanos, line_time};

use crate::{DamageRates, DamagedLine, SentPacket};

pub(crate) const ONE_SECOND: Nanos = 1_000 * MILLIS;
/// Maximum number of bytes that one read of a tty returns.
const TTY_READ_LEN: usize = 4_095;

/// A revolution as the session returned it.
#[derive(Debug)]
pub(crate) struct DeliveredRevolution {
    /// Clockwise angle in degrees, 0 to 360, and range in mm of each point.
    pub(crate) points: Vec<(f64, u16)>,
    pub(crate) first: Nanos,
    pub(crate) incomplete: bool,
    pub(crate) reasons: u8,
    pub(crate) beams: usize,
}

/// An output of the session in the form that a recorder stores.
#[derive(Clone)]
pub(crate) struct RecordedOutput {
    pub(crate) first: Nanos,
    pub(crate) last: Nanos,
    pub(crate) bytes: Vec<u8>,
    pub(crate) reasons: u8,
}

#[derive(Default)]
pub(crate) struct SessionLog {
    pub(crate) packets: Vec<Vec<u8>>,
    pub(crate) revolutions: Vec<DeliveredRevolution>,
    pub(crate) replies: usize,
    /// All outputs except revolutions.
    pub(crate) outputs: Vec<RecordedOutput>,
    pub(crate) reads: usize,
    pub(crate) bauds: Vec<u32>,
    pub(crate) dtr: Vec<bool>,
}

pub(crate) struct TestBench {
    pub(crate) session: RplidarSession,
    pub(crate) scanner: SimulatedScanner,
    pub(crate) now: Nanos,
    pub(crate) log: SessionLog,
}

impl TestBench {
    pub(crate) fn new(settings: Settings, scanner: SimulatedScanner) -> TestBench {
        TestBench { session: RplidarSession::new(settings, 0), scanner, now: 0, log: SessionLog::default() }
    }

    /// Runs the session until `until`.
    pub(crate) fn run(&mut self, until: Nanos) {
        while self.now < until {
            let (wakes_at, waits) = self.drain();
            let ready = if waits { self.scanner.next(wakes_at.min(until), self.now) } else { Nanos::MAX };
            self.now = wakes_at.min(ready.max(self.now)).min(until).max(self.now);
            self.read(self.now >= wakes_at);
        }
    }

    /// Runs the session until `is_done` returns true, for at most `max_time`. Returns the elapsed time.
    pub(crate) fn run_until(&mut self, max_time: Nanos, is_done: impl Fn(&TestBench) -> bool) -> Nanos {
        let started = self.now;
        while !is_done(self) {
            assert!(self.now < started + max_time, "{:?} {:?}", self.session.state(), self.session.problem());
            self.run(self.now + 5 * MILLIS);
        }
        self.now - started
    }

    pub(crate) fn read(&mut self, is_timeout: bool) {
        let room = self.session.read_buffer().len().min(TTY_READ_LEN);
        let mut bytes = self.scanner.read(self.now, room);
        if self.session.rate() != self.scanner.baud {
            // At a wrong rate, the bytes are noise.
            let made = |byte: &u8| if self.scanner.is_text { b'0' | byte & 15 } else { byte | 0x80 };
            bytes = bytes.iter().step_by(3).map(made).collect();
        }
        self.session.read_buffer()[..bytes.len()].copy_from_slice(&bytes);
        self.session.commit(self.now, bytes.len());
        self.log.reads += 1;
        if bytes.is_empty() && is_timeout {
            self.session.handle_timeout(self.now);
        }
        let stats = self.session.stats();
        assert_eq!(stats.read, stats.in_telegrams + stats.discarded + stats.buffered);
    }

    /// Returns the end of the session's sleep or wait. The flag is true for a wait.
    fn drain(&mut self) -> (Nanos, bool) {
        loop {
            match self.session.poll_action() {
                Action::SetRate(baud) => {
                    self.scanner.read(self.now, usize::MAX);
                    self.log.bauds.push(baud);
                }
                Action::SetDtr(on) => {
                    self.scanner.dtr = on;
                    self.log.dtr.push(on);
                }
                Action::Transmit { bytes, not_before } => {
                    self.now = self.now.max(not_before);
                    assert!(bytes.len() > 1, "a request is one write: {bytes:?}");
                    let bytes = bytes.to_vec();
                    let rate = self.session.rate();
                    bytes.into_iter().for_each(|byte| self.scanner.write(byte, rate, self.now));
                    self.session.handle_transmitted(self.now);
                }
                Action::SleepUntil(until) => {
                    assert!(until > self.now && until <= self.now + 5 * MILLIS);
                    return (until, false);
                }
                Action::Wait { until, .. } => return (until, true),
                Action::Event(Event::Telegram(received)) => {
                    assert!(received.first <= received.last && received.last <= self.now, "{received:?}");
                    self.log.outputs.push(RecordedOutput {
                        first: received.first,
                        last: received.last,
                        bytes: received.bytes.to_vec(),
                        reasons: received.reasons,
                    });
                    if received.is_reply {
                        self.log.replies += 1;
                        continue;
                    }
                    assert!(received.last - received.first <= 12 * MILLIS, "{received:?}");
                    let len = received.bytes.len() / received.count;
                    assert_eq!(received.is_checked, len > 5);
                    self.log.packets.extend(received.bytes.chunks_exact(len).map(<[u8]>::to_vec));
                }
                Action::Event(Event::Scan(scan)) => {
                    let points = scan.points().iter();
                    self.log.revolutions.push(DeliveredRevolution {
                        points: points
                            .map(|point| (-f64::from(point.angle).to_degrees(), point.range))
                            .collect(),
                        first: scan.first,
                        incomplete: scan.is_incomplete(),
                        reasons: scan.reasons,
                        beams: scan.beams(),
                    });
                }
            }
        }
    }

    /// Checks the revolutions of the current stream. Each of them contains points of one revolution of the head, at the
    /// right angles. A revolution that is neither incomplete nor suspect must have all points. Returns the largest
    /// error of a stamp, and the number of wrong points in such revolutions.
    pub(crate) fn check_revolutions(&self, revolutions: &[DeliveredRevolution]) -> (Nanos, usize) {
        let kind = self.scanner.kind().expect("measuring");
        let (step, mut worst, mut wrong) = (self.scanner.step(), 0, 0);
        let started = self.scanner.time(0.0).expect("measuring");
        let per_turn = 360.0 / step;
        let mut last_turn = -1.0;
        for delivered in revolutions.iter().filter(|delivered| delivered.first > started) {
            // The edge of beam 0 is half a beam before the zero.
            let edge = 180.0 / delivered.beams as f64;
            let about =
                (delivered.first - started) as f64 / (self.scanner.time(1.0).unwrap() - started) as f64;
            let revolution = ((about + mean_shift(kind) / -step) / per_turn).round();
            assert!(revolution > last_turn, "two turns are one: {revolution} after {last_turn}");
            last_turn = revolution;
            let zero = (revolution * 360.0 + mean_shift(kind) - edge) / step;
            worst = worst.max(delivered.first.abs_diff(self.scanner.time(zero).expect("measuring")));
            let bad = delivered
                .points
                .iter()
                .filter(|point| !self.is_right(kind, revolution, **point, edge))
                .count();
            assert!(delivered.points.len() as f64 <= per_turn + 12.0, "merged: {}", delivered.points.len());
            if !delivered.incomplete && delivered.reasons == 0 {
                wrong += bad;
                let lacking = per_turn - delivered.points.len() as f64;
                assert!(lacking < 12.0, "{lacking} points lack in turn {revolution}");
            }
        }
        (worst, wrong)
    }

    fn is_right(&self, kind: PacketFormat, revolution: f64, (degrees, range): (f64, u16), edge: f64) -> bool {
        let step = self.scanner.step();
        if !(-edge - 0.1..360.0 - edge + 0.1).contains(&degrees) {
            return false;
        }
        let around = (revolution * 360.0 + degrees) / step;
        let (from, to) = (around - 2.0, around + 10.0 / step + 2.0);
        (from.max(0.0) as u64..to.max(0.0) as u64).any(|point| {
            let sample = SimulatedScanner::sample(point);
            let range = if range == line::NO_RETURN { 0 } else { u32::from(range) };
            // An ultra packet contains differences between ranges, and cannot contain the difference to a point without
            // a return.
            let is_unencodable = kind == PacketFormat::Ultra
                && point % 3 == 2
                && SimulatedScanner::sample(point + 1).range == 0;
            let sample = if is_unencodable { TestPoint { range: 0, ..sample } } else { sample };
            let angle = point as f64 * step - SimulatedScanner::angle_before(kind, sample);
            sample.range.abs_diff(range) <= 4 && (angle - revolution * 360.0 - degrees).abs() < 0.1
        })
    }

    pub(crate) fn assert_intact_packets_once_in_order(&self) {
        let mut arrived = self.log.packets.iter();
        for sent in self.scanner.sent.iter().filter(|sent| sent.intact && sent.at + 20 * MILLIS < self.now) {
            assert!(arrived.any(|bytes| *bytes == sent.bytes), "lost: {:?} at {}", sent.bytes, sent.at);
        }
    }
}

/// Mean angle by which points lie before their nominal angles, in degrees.
fn mean_shift(kind: PacketFormat) -> f64 {
    match kind {
        PacketFormat::Express => 4.0,
        PacketFormat::Ultra => 7.2,
        _ => 0.0,
    }
}

/// A scan mode of the scanner: name, microseconds per point, packet format.
pub(crate) type OfferedMode = (&'static str, f64, PacketFormat);

#[derive(Clone, Copy, Debug, PartialEq)]
enum ScannerState {
    Nothing,
    Booting {
        until: Nanos,
    },
    /// The scanner sends packets of format `kind`. `us` is the time per point in microseconds, and `packets` is the
    /// number of packets sent in this stream.
    Measuring {
        kind: PacketFormat,
        us: f64,
        first_point_at: Nanos,
        packets: u64,
    },
}

pub(crate) struct SimulatedScanner {
    pub(crate) id: u8,
    pub(crate) baud: u32,
    pub(crate) modes: Vec<OfferedMode>,
    pub(crate) typical: u8,
    /// Whether the firmware cannot list its modes.
    pub(crate) is_old: bool,
    /// Revolutions per second.
    pub(crate) hz: f64,
    /// Additional time from the request that starts a stream to the first point of the stream.
    pub(crate) spin_up: Nanos,
    /// Fraction by which the scanner's points take longer than the scanner reports.
    pub(crate) drift: f64,
    /// Health status and error code.
    pub(crate) health: (u8, u16),
    /// Whether a reboot clears the error.
    pub(crate) clears_on_reboot: bool,
    /// Requests that the scanner ignores. Each entry applies to one request.
    pub(crate) ignored_requests: Vec<u8>,
    /// Whether the scanner has power.
    pub(crate) is_on: bool,
    /// Bytes that the scanner sends before its boot message.
    pub(crate) junk: Vec<u8>,
    pub(crate) dtr: bool,
    /// Whether the scanner's bytes look like text at another rate.
    pub(crate) is_text: bool,
    /// The last value for the motor: duty cycle or speed.
    pub(crate) motor: Option<u16>,
    pub(crate) requests: Vec<u8>,
    state: ScannerState,
    request: Vec<u8>,
    random: fastrand::Rng,
    pub(crate) line: DamagedLine,
    free_at: Nanos,
    pub(crate) sent: Vec<SentPacket>,
    /// Number of points of all streams before this one.
    earlier_points: u64,
}

impl SimulatedScanner {
    pub(crate) fn new(model: Model, seed: u64) -> SimulatedScanner {
        let (id, modes): (u8, Vec<OfferedMode>) = match model {
            Model::A1 => (
                0x18,
                vec![
                    ("Standard", 508.0, PacketFormat::Standard),
                    ("Express", 254.0, PacketFormat::Express),
                    ("Boost", 127.0, PacketFormat::Ultra),
                    ("Sensitivity", 127.0, PacketFormat::Ultra),
                    ("Stability", 201.0, PacketFormat::Ultra),
                ],
            ),
            Model::A2m8 => (
                0x28,
                vec![
                    ("Standard", 500.0, PacketFormat::Standard),
                    ("Sensitivity", 125.0, PacketFormat::Ultra),
                ],
            ),
            Model::A2m12 => (
                0x2C,
                vec![("Standard", 250.0, PacketFormat::Standard), ("Sensitivity", 62.5, PacketFormat::Ultra)],
            ),
            Model::A3 => (
                0x31,
                vec![("Standard", 250.0, PacketFormat::Standard), ("Sensitivity", 62.5, PacketFormat::Ultra)],
            ),
            Model::S1 => (
                0x61,
                vec![
                    ("Standard", 217.5, PacketFormat::Standard),
                    ("DenseBoost", 108.75, PacketFormat::Dense),
                ],
            ),
            Model::S2 => (
                0x71,
                vec![("Standard", 62.5, PacketFormat::Standard), ("DenseBoost", 31.25, PacketFormat::Dense)],
            ),
            Model::S3 => (
                0x81,
                vec![
                    ("Standard", 62.5, PacketFormat::Standard),
                    ("Ultra Dense", 31.25, PacketFormat::UltraDense),
                ],
            ),
            Model::C1 => (
                0x41,
                vec![("Standard", 200.0, PacketFormat::Standard), ("DenseBoost", 200.0, PacketFormat::Dense)],
            ),
        };
        SimulatedScanner {
            id,
            baud: model.baud(),
            typical: modes.len() as u8 - 1,
            modes,
            is_old: false,
            hz: f64::from(model.revolutions_per_second()) * 1.000_7,
            spin_up: 0,
            drift: 0.0,
            health: (0, 0),
            clears_on_reboot: true,
            ignored_requests: Vec::new(),
            is_on: true,
            junk: Vec::new(),
            dtr: true,
            is_text: false,
            motor: None,
            requests: Vec::new(),
            state: ScannerState::Nothing,
            request: Vec::new(),
            random: fastrand::Rng::with_seed(seed),
            line: DamagedLine::new(DamageRates::default()),
            free_at: 0,
            sent: Vec::new(),
            earlier_points: 0,
        }
    }

    /// Starts the first mode with this packet format, as another program may have done before the session.
    pub(crate) fn start_before(&mut self, kind: PacketFormat, now: Nanos) {
        let us = self.modes.iter().find(|(.., of)| *of == kind).map_or(254.0, |(_, us, _)| *us);
        self.state = ScannerState::Measuring { kind, us, first_point_at: now, packets: 0 };
        self.dtr = false;
    }

    /// Puts this number of unread bytes on the line.
    pub(crate) fn fill_line(&mut self, bytes: usize) {
        self.line.bytes.extend((0..bytes).map(|n| (0, (n * 31 % 256) as u8)));
    }

    /// Cycles the power: the scanner boots.
    pub(crate) fn boot(&mut self, now: Nanos) {
        self.end(now);
        self.state = ScannerState::Booting { until: now + 671 * MILLIS };
    }

    pub(crate) fn is_measuring(&self) -> bool {
        matches!(self.state, ScannerState::Measuring { .. })
    }

    fn us(&self) -> Option<(Nanos, f64)> {
        match self.state {
            ScannerState::Measuring { first_point_at: zero, us, .. } => {
                Some((zero, us * 1e3 * (1.0 + self.drift)))
            }
            _ => None,
        }
    }

    /// Returns the time of the point with index `point` of this stream.
    pub(crate) fn time(&self, point: f64) -> Option<Nanos> {
        self.us().map(|(zero, ns)| zero + (point * ns) as Nanos)
    }

    /// Returns the nominal angle from one point to the next, in degrees.
    pub(crate) fn step(&self) -> f64 {
        self.us().map_or(0.0, |(_, ns)| 360.0 * self.hz * ns / 1e9)
    }

    /// Returns the point with index `point`.
    pub(crate) fn sample(point: u64) -> TestPoint {
        let range = if point % 7 == 3 { 0 } else { 1_500 + (point * 7_919 % 997) as u32 };
        TestPoint { range, eighths: (point * 13 % 64) as u32, quality: 1 + (point % 60) as u32 }
    }

    /// Returns the angle in degrees by which a point lies before its nominal angle.
    pub(crate) fn angle_before(kind: PacketFormat, sample: TestPoint) -> f64 {
        match kind {
            // One in eight points is out of order, by up to five positions.
            PacketFormat::Standard if sample.eighths < 8 => f64::from(sample.eighths),
            PacketFormat::Express => f64::from(sample.eighths) / 8.0,
            PacketFormat::Ultra if sample.range < 50 => 7.5,
            PacketFormat::Ultra => {
                let k2 = f64::from(98_361 / (4 * sample.range));
                8.0 - (k2 / 1024.0 + k2.powi(3) / 6_442_450_944.0).to_degrees()
            }
            _ => 0.0,
        }
    }

    /// Handles a byte that the host sent at `rate` and that left the line at `now`.
    pub(crate) fn write(&mut self, byte: u8, rate: u32, now: Nanos) {
        self.send_until(now);
        if !self.is_on || rate != self.baud || matches!(self.state, ScannerState::Booting { .. }) {
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
            self.handle_request(command, &payload, now);
        }
    }

    fn handle_request(&mut self, command: u8, payload: &[u8], now: Nanos) {
        if let Some(at) = self.ignored_requests.iter().position(|ignored| *ignored == command) {
            self.ignored_requests.swap_remove(at);
            return;
        }
        if self.is_measuring() && !matches!(command, 0x25 | 0x40 | 0xA8 | 0xF0) {
            return;
        }
        let word = |at: usize| u16::from_le_bytes([payload[at], payload[at + 1]]);
        match command {
            0x25 => self.end(now),
            0x40 => {
                if self.clears_on_reboot {
                    self.health = (0, 0);
                }
                self.boot(now);
            }
            0x50 => {
                let mut info = vec![self.id, 29, 1, 7];
                info.extend((0..16).map(|n| n * 17));
                self.reply(0x04, 0, &info, now);
            }
            0x52 => {
                let [low, high] = self.health.1.to_le_bytes();
                self.reply(0x06, 0, &[self.health.0, low, high], now);
            }
            0x59 => {
                let us = |n: usize| (self.modes.get(n).map_or(0.0, |mode| mode.1) as u16).to_le_bytes();
                self.reply(0x15, 0, &[us(0), us(1)].concat(), now);
            }
            0x84 if self.is_old => {}
            0x84 => {
                let mode = payload.get(4).map_or(0, |mode| usize::from(*mode));
                let (name, us, kind) = self.modes[mode.min(self.modes.len() - 1)];
                let data = match payload[0] {
                    0x70 => (self.modes.len() as u16).to_le_bytes().to_vec(),
                    0x71 => ((us * 256.0) as u32).to_le_bytes().to_vec(),
                    0x75 => vec![descriptor_type(kind)],
                    0x7C => vec![self.typical, 0],
                    0x7F => [name.as_bytes(), &[0]].concat(),
                    key => panic!("{key:02X} is not asked for"),
                };
                self.reply(0x20, 0, &[&payload[..4], &data[..]].concat(), now);
            }
            0xFF => self.reply(0xFF, 0, &[u8::from(self.id >> 4 == 2), 0, 0, 0], now),
            0xF0 | 0xA8 => self.motor = Some(word(0)),
            0x20 | 0x82 => {
                let mode = if command == 0x20 { 0 } else { usize::from(payload[0]) };
                let (_, us, kind) = match self.is_old {
                    true if command == 0x82 => self.modes[1],
                    _ => self.modes[mode],
                };
                let len = kind.byte_len() as u8;
                self.reply(descriptor_type(kind), 0x40, &[len], now);
                let zero = now + self.spin_up + 10 * MILLIS + (self.earlier_points % 7_777) * 10_000;
                self.state = ScannerState::Measuring { kind, us, first_point_at: zero, packets: 0 };
            }
            command => panic!("{command:02X} must not be sent"),
        }
    }

    /// Sends a descriptor, followed by `data` as a single reply. If `times` is not 0, the descriptor announces packets
    /// whose length is `data[0]`, and nothing else is sent.
    fn reply(&mut self, answer: u8, times: u8, data: &[u8], now: Nanos) {
        let len = if times > 0 { data[0] } else { data.len() as u8 };
        let mut at = (now + 2 * MILLIS).max(self.free_at);
        let head = [0xA5, 0x5A, len, 0, 0, times, answer];
        let data = if times > 0 { &[][..] } else { data };
        for byte in head.iter().chain(data) {
            at += line_time(1, self.baud);
            self.line.bytes.push_back((at, *byte));
        }
        self.free_at = at;
    }

    fn end(&mut self, now: Nanos) {
        self.send_until(now);
        if let ScannerState::Measuring { kind, packets, .. } = self.state {
            self.earlier_points += packets * kind.points() as u64;
        }
        self.state = ScannerState::Nothing;
    }

    /// Returns the bytes that have arrived by `now`, at most `room`.
    pub(crate) fn read(&mut self, now: Nanos, room: usize) -> Vec<u8> {
        self.send_until(now);
        self.line.read(now, room)
    }

    /// Returns the time at which the next byte arrives, at most `until`.
    pub(crate) fn next(&mut self, until: Nanos, now: Nanos) -> Nanos {
        let mut at = now;
        while self.line.bytes.is_empty() && at < until {
            at = until.min(at + MILLIS);
            self.send_until(at);
        }
        self.line.bytes.front().map_or(until, |(at, _)| *at)
    }

    fn send_until(&mut self, now: Nanos) {
        if let ScannerState::Booting { until } = self.state
            && now >= until
        {
            self.state = ScannerState::Nothing;
            let text = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n......";
            let text = [&self.junk[..], &text[..64]].concat();
            for (n, byte) in text.iter().enumerate() {
                self.line.bytes.push_back((until + line_time(n + 1, self.baud), *byte));
            }
        }
        while let ScannerState::Measuring { kind, packets, .. } = self.state {
            let points = kind.points() as u64;
            let first = packets * points;
            let Some(done) = self.time((first + points - 1) as f64).filter(|done| *done <= now && self.is_on)
            else {
                return;
            };
            let samples: Vec<_> = (first..first + points).map(SimulatedScanner::sample).collect();
            let late = if kind == PacketFormat::Standard {
                SimulatedScanner::angle_before(kind, samples[0])
            } else {
                0.0
            };
            let start = first as f64 * self.step() - late;
            let bytes = encode(kind, start, &samples, SimulatedScanner::sample(first + points));
            self.put_on_line(&bytes, done);
            if let ScannerState::Measuring { packets, .. } = &mut self.state {
                *packets += 1;
            }
        }
    }

    fn put_on_line(&mut self, bytes: &[u8], done: Nanos) {
        let sent = self.line.transmit(bytes, done.max(self.free_at), self.baud, &mut self.random);
        self.free_at = sent.at;
        self.sent.push(sent);
    }

    /// Sends the rest of a packet, which looks like text.
    pub(crate) fn send_rest_as_text(&mut self, now: Nanos) {
        self.send_until(now);
        for _ in 0..60 {
            self.free_at = self.free_at.max(now) + line_time(1, self.baud);
            self.line.bytes.push_back((self.free_at, b'0'));
        }
    }

    /// Drops the bytes that are on the line, and all bytes that follow until `until`.
    pub(crate) fn lose_until(&mut self, until: Nanos) {
        self.send_until(until);
        let oldest = self.line.bytes.front().map_or(until, |(at, _)| *at);
        self.line.bytes.retain(|(at, _)| *at > until);
        let is_hit = |sent: &&mut SentPacket| sent.at >= oldest && sent.at <= until + 10 * MILLIS;
        self.sent.iter_mut().filter(is_hit).for_each(|sent| sent.intact = false);
    }

    /// Drops complete packets, as if the host does not read until `until` and the buffer has room for only about `room`
    /// bytes.
    pub(crate) fn overflow(&mut self, until: Nanos, room: usize) {
        self.send_until(until);
        let Some(kind) = self.kind() else { return };
        let dropped = self.line.bytes.len().saturating_sub(room) / kind.byte_len();
        self.line.bytes.truncate(self.line.bytes.len() - dropped * kind.byte_len());
        self.sent.iter_mut().rev().take(dropped).for_each(|sent| sent.intact = false);
    }

    /// Returns the format of the packets that the scanner sends.
    pub(crate) fn kind(&self) -> Option<PacketFormat> {
        if let ScannerState::Measuring { kind, .. } = self.state { Some(kind) } else { None }
    }

    /// Returns whether the scanner has this mode.
    pub(crate) fn has_mode(&self, mode: Mode) -> bool {
        self.modes.iter().any(|(name, ..)| name.replace(' ', "").eq_ignore_ascii_case(mode.name()))
    }
}

/// A point before it is encoded. The nominal angle of the point follows from its index.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct TestPoint {
    /// Range in mm; 0 for no return.
    pub(crate) range: u32,
    /// Eighths of a degree by which the point lies before its nominal angle. Only express packets have this value.
    pub(crate) eighths: u32,
    pub(crate) quality: u32,
}

/// Encodes a packet that starts at `start` degrees. `next` is the first point of the next packet.
pub(crate) fn encode(kind: PacketFormat, start: f64, samples: &[TestPoint], next: TestPoint) -> Vec<u8> {
    let word = ((start.rem_euclid(360.0) * 64.0) as u16).to_le_bytes();
    let mut bytes = match kind {
        PacketFormat::Standard => {
            let TestPoint { range, quality, .. } = samples[0];
            let angle = ((start.rem_euclid(360.0) * 64.0) as u16) << 1 | 1;
            let quality = if range == 0 { 0 } else { quality as u8 & 63 };
            let head = quality << 2 | if start.rem_euclid(360.0) < 2.0 { 1 } else { 2 };
            let mut bytes = vec![head];
            bytes.extend(angle.to_le_bytes());
            bytes.extend((range as u16 * 4).to_le_bytes());
            return bytes;
        }
        PacketFormat::UltraDense => [vec![0, 0, 1, 2, 3, 4, 0, 0], word.to_vec()].concat(),
        _ => [vec![0, 0], word.to_vec()].concat(),
    };
    match kind {
        PacketFormat::Standard => unreachable!("encoded above"),
        PacketFormat::Express => {
            for two in samples.chunks(2) {
                for sample in two {
                    bytes.extend((((sample.range << 2) | sample.eighths >> 4) as u16).to_le_bytes());
                }
                bytes.push((two[0].eighths & 15 | (two[1].eighths & 15) << 4) as u8);
            }
        }
        PacketFormat::Ultra => {
            for (n, three) in samples.chunks(3).enumerate() {
                let behind = samples.get(3 * n + 3).copied().unwrap_or(next);
                let ((stored, base, level), (_, base_behind, level_behind)) =
                    (encode_major(three[0].range), encode_major(behind.range));
                let differs = |range: u32, base: i64, level: u32| {
                    let difference = (i64::from(range) - base) >> level;
                    let is_encodable = range > 0 && (-511..511).contains(&difference);
                    (if is_encodable { difference } else { -512 } & 0x3FF) as u32
                };
                let (first_base, first_level) =
                    if stored == 0 { (base_behind, level_behind) } else { (base, level) };
                let first = differs(three[1].range, first_base, first_level);
                let second = differs(three[2].range, base_behind, level_behind);
                bytes.extend((stored | first << 12 | second << 22).to_le_bytes());
            }
        }
        PacketFormat::Dense => {
            samples.iter().for_each(|sample| bytes.extend((sample.range as u16).to_le_bytes()))
        }
        PacketFormat::UltraDense => {
            for two in samples.chunks(2) {
                let [a, b] = [two[0], two[1]].map(twenty_bits);
                bytes.extend((a as u16).to_le_bytes());
                bytes.extend((b as u16).to_le_bytes());
                bytes.push((a >> 16 | b >> 16 << 4) as u8);
            }
        }
    }
    let sum = bytes[2..].iter().fold(0, |sum, byte| sum ^ byte);
    (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
    bytes
}

/// Returns three values: the encoded value of a range, the range that this value decodes to, and the number of bits by
/// which the quantization is coarser.
fn encode_major(range: u32) -> (u32, i64, u32) {
    let (from, base, level) = match range {
        0x4000.. => (3328, 0x4000, 4),
        0x1000.. => (1792, 0x1000, 3),
        0x800.. => (1280, 0x800, 2),
        0x200.. => (512, 0x200, 1),
        _ => (0, 0, 0),
    };
    let steps = (range - base) >> level;
    (from + steps, i64::from(base + (steps << level)), level)
}

fn twenty_bits(sample: TestPoint) -> u32 {
    let TestPoint { range, quality, .. } = sample;
    match range {
        0 => 0,
        1..=2046 => (range / 2) << 2 | quality << 12,
        2047..=8187 => 1 | ((range - 2046) / 3) << 2 | quality >> 1 << 13,
        8188..=24567 => 2 | ((range - 8187) / 4) << 2 | quality >> 2 << 14,
        _ => 3 | ((range - 24567) / 5) << 2 | quality >> 3 << 15,
    }
}

/// Returns the response type in the descriptor of this packet format.
pub(crate) fn descriptor_type(kind: PacketFormat) -> u8 {
    match kind {
        PacketFormat::Standard => 0x81,
        PacketFormat::Express => 0x82,
        PacketFormat::Ultra => 0x84,
        PacketFormat::Dense => 0x85,
        PacketFormat::UltraDense => 0x86,
    }
}
