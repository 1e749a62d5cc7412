//! Property test of a session with random events. The session never panics, counts every byte, and sends no request
//! that writes the EEPROM. Once a healthy scanner is connected, the session streams. A seed reproduces a run.

use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _};
use scanhub_drivers::line::{Control, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::LmsSession;
use scanhub_drivers::lms::Settings;
use scanhub_drivers::lms::command::{EEPROM_WRITES, Request};
use scanhub_drivers::lms::reply::{self, SimulatedStatus};
use scanhub_drivers::lms::telegram::{FRAME_LEN, REPLY, STX, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_lms_configure::eeprom::EepromWrite;
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::machine::{self, StartState};
use scanhub_sim::operating::OperatingMode;

use super::{Bench, SESSION_SETTINGS, sensor_with};

/// A host that reads, writes and calls the session at random times.
struct RandomHost {
    session: LmsSession,
    now: Nanos,
    random: fastrand::Rng,
    read: u64,
    sent_bytes: Vec<u8>,
    telegrams: u64,
}

impl RandomHost {
    fn new(seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let variant = Variant::ALL[random.usize(..Variant::ALL.len())];
        let settings = Settings { variant, baud: any_baud(&mut random), ..SESSION_SETTINGS };
        let now = random.u64(..1_000 * MILLIS);
        let session = LmsSession::new(settings, now);
        RandomHost { session, now, random, read: 0, sent_bytes: Vec::new(), telegrams: 0 }
    }

    fn event(&mut self) {
        match self.random.u32(..20) {
            0..8 => {
                let bytes = self.bytes();
                self.commit(&bytes);
            }
            8..14 => {
                let exponent = self.random.u32(10..32);
                self.now += self.random.u64(..1 << exponent);
                self.session.handle_timeout(self.now);
            }
            14..16 => {
                if let Action::Wait { until, .. } = self.session.poll_action() {
                    self.now = self.now.max(until.min(self.now + 5_000 * MILLIS));
                    self.session.handle_timeout(self.now);
                }
            }
            16 => {
                let all = [Control::Pause, Control::Resume, Control::Resync];
                self.session.control(all[self.random.usize(..3)], self.now);
            }
            17 => self.session.commit(self.now, 0),
            _ => self.session.handle_transmitted(self.now),
        }
        let lazy = self.random.u8(..4) == 0;
        self.drain(lazy);
    }

    fn commit(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let spare = self.session.read_buffer();
            assert!(!spare.is_empty(), "no room");
            let len = spare.len().min(bytes.len()).min(self.random.usize(1..1_000));
            spare[..len].copy_from_slice(&bytes[..len]);
            bytes = &bytes[len..];
            self.now += self.random.u64(..line_time(len, 9_600));
            if self.random.bool() {
                self.session.defer_read(self.now, len);
                self.drain(false);
            }
            self.read += len as u64;
            self.session.commit(self.now, len);
            self.drain(false);
        }
    }

    /// Carries out the actions of the session until the session waits. If `is_partial` is set, it may return early,
    /// before a write.
    fn drain(&mut self, is_partial: bool) {
        loop {
            match self.session.poll_action() {
                Action::Transmit { bytes, not_before } => {
                    if is_partial && self.random.bool() {
                        break;
                    }
                    self.sent_bytes.extend(bytes);
                    self.now = self.now.max(not_before);
                    self.session.handle_transmitted(self.now);
                }
                Action::SetRate(_) => {}
                Action::SetDtr(_) => panic!("an LMS does not use DTR"),
                Action::Event(Event::Scan(_)) => panic!("a telegram is a scan"),
                Action::Event(Event::Telegram(received)) => {
                    assert!(Telegram::check(received.bytes).is_some());
                    self.telegrams += 1;
                }
                Action::SleepUntil(_) | Action::Wait { .. } => break,
            }
        }
        let tally = self.session.framer_counters();
        let known = tally.in_telegrams + tally.acknowledge + tally.discarded + self.session.stats().buffered;
        assert_eq!((tally.read, known), (self.read, self.read), "bytes disappeared");
        assert_eq!(tally.telegrams, self.telegrams);
    }

    /// Returns noise, or a whole or truncated telegram of a scanner.
    fn bytes(&mut self) -> Vec<u8> {
        let random = &mut self.random;
        let address = if random.u8(..8) == 0 { random.u8(..128) } else { 0 };
        let variant = Variant::ALL[random.usize(..Variant::ALL.len())];
        let words =
            |random: &mut fastrand::Rng, count| (0..count).map(|_| random.u16(..)).collect::<Vec<u16>>();
        let telegram = match random.u8(..16) {
            0 => return (0..random.usize(1..2_000)).map(|_| random.u8(..)).collect(),
            1 => return [2, 0x80].repeat(random.usize(1..700)),
            2 => return vec![[6, 0x15][random.usize(..2)]; random.usize(1..4)],
            3..6 => {
                let words = words(random, variant.beams());
                lms::measured::encode(address, Unit::Mm, &words, 0x10)
            }
            6 => {
                let data: Vec<u8> = (0..random.usize(2..700)).map(|_| random.u8(..)).collect();
                let command = [0xB0, 0xB6, 0xB7, 0xBE, 0xBF, 0xC4, 0xF5, 0xF6][random.usize(..8)];
                Writer::new(address | REPLY, command).slice(&data).finish()
            }
            7 => reply::mode_reply(address, random.bool(), 0x10),
            8 => reply::refusal(address, 0x10),
            9 => reply::type_reply(address, b"LMS200;301063;V02.30 ", 0x10),
            10 => reply::configuration_reply(address, Mode(random.u8(..8)), Unit::Cm, 0x10),
            11 => reply::variant_reply(address, random.bool(), variant, 0x10),
            12 => Writer::new(address | REPLY, 0x90).slice(b"LMS200;301063;V02.10 ").byte(0x10).finish(),
            13 => Writer::new(address | REPLY, random.u8(0x80..)).byte(random.u8(..)).finish(),
            _ => {
                let operating_mode = [0x00, 0x10, 0x24, 0x25, 0x2A][random.usize(..5)];
                let baud = any_baud(random);
                let health = SimulatedStatus {
                    software: *b"V02.30 ",
                    operating_mode,
                    mode: Mode(1),
                    variant,
                    unit: Unit::Mm,
                    baud,
                };
                reply::status_reply(address, &health, 0x10)
            }
        };
        let mut bytes = telegram.bytes().to_vec();
        match random.u8(..6) {
            0 => bytes.truncate(random.usize(1..bytes.len())),
            1 => drop(bytes.remove(random.usize(..bytes.len()))),
            2 => bytes.insert(0, 6),
            _ => {}
        }
        bytes
    }
}

fn any_baud(random: &mut fastrand::Rng) -> Baud {
    Baud::ALL[random.usize(..4)]
}

/// Returns the valid telegrams in `bytes`, wherever they start.
fn telegrams(bytes: &[u8]) -> impl Iterator<Item = Telegram<'_>> {
    (0..bytes.len()).filter_map(|at| {
        let [STX, _, low, high, ..] = bytes[at..] else { return None };
        let len = usize::from(u16::from_le_bytes([low, high])) + FRAME_LEN;
        bytes.get(at..at + len).and_then(Telegram::check)
    })
}

#[test]
fn embedded_eeprom_write_is_detected() {
    for write in [
        EepromWrite::Configuration(&[7; 34]),
        EepromWrite::Configuration2(&[2; 84]),
        EepromWrite::Field(&[2; 800]),
    ] {
        let write = write.encode(0).expect("short enough");
        let stop = Request::Stop.encode(0);
        let sent = [&stop.bytes()[..3], &[2, 0], stop.bytes(), write.bytes(), &stop.bytes()[..6]].concat();
        let found: Vec<&[u8]> = telegrams(&sent).map(|telegram| telegram.bytes()).collect();
        assert_eq!(found, [stop.bytes(), write.bytes()]);
    }
}

#[test]
fn healthy_scanner_streams_after_any_events() {
    let mut slowest = 0;
    for seed in 0..120 {
        let mut chaos = RandomHost::new(seed);
        for _ in 0..chaos.random.usize(1..60) {
            chaos.event();
        }
        chaos.drain(false);
        let RandomHost { mut session, now, mut random, sent_bytes, .. } = chaos;
        for telegram in telegrams(&sent_bytes) {
            let request = Request::decode(telegram);
            assert!(
                request.is_some_and(|request| !EEPROM_WRITES.contains(&request.command())),
                "{telegram:?}"
            );
        }
        session.control(Control::Resume, now);
        let start = StartState::Operating(match random.u8(..4) {
            0 => OperatingMode::Installation,
            1 => OperatingMode::All,
            2 => OperatingMode::Partial,
            _ => OperatingMode::OnRequest,
        });
        let settings = machine::Settings {
            baud: any_baud(&mut random),
            address: random.u8(..3),
            start,
            seed,
            ..machine::Settings::default()
        };
        let mut bench = Bench::with_session(session, sensor_with(settings), now);
        let is_there = |bench: &Bench| {
            bench.session.state() == State::Streaming
                && bench.sent.iter().any(|sent| !sent.is_reply && !sent.damaged)
        };
        slowest = slowest.max(bench.run_until(&format!("streaming, seed {seed}"), 10_000 * MILLIS, is_there));
    }
    println!("streaming within {} ms", slowest / MILLIS);
}
