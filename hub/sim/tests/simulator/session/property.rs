//! Whatever happens in whatever order: nothing panics, no byte is unaccounted for, no request writes the EEPROM, and
//! once a healthy sensor is there, its stream is. One seed reproduces a run.

use scanhub_drivers::line::{Control, State};
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Session;
use scanhub_drivers::lms::Settings;
use scanhub_drivers::lms::command::{EEPROM_WRITES, Request};
use scanhub_drivers::lms::reply::{self, Health};
use scanhub_drivers::lms::telegram::{FRAME, REPLY, STX, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_lms_configure::eeprom::Write;
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::machine::{self, Start};
use scanhub_sim::operating::Operating;

use super::{Bench, WANTED, sensor_with};

/// A host without manners: reads when it likes, writes when it likes, calls when it likes.
struct Chaos {
    session: Session,
    now: Nanos,
    random: fastrand::Rng,
    read: u64,
    said: Vec<u8>,
    telegrams: u64,
}

impl Chaos {
    fn new(seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let variant = Variant::ALL[random.usize(..Variant::ALL.len())];
        let settings = Settings { variant, baud: any_baud(&mut random), ..WANTED };
        let now = random.u64(..1_000 * MILLIS);
        let session = Session::new(settings, now);
        Chaos { session, now, random, read: 0, said: Vec::new(), telegrams: 0 }
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
                if let Output::Wait { until, .. } = self.session.poll_output() {
                    self.now = self.now.max(until.min(self.now + 5_000 * MILLIS));
                    self.session.handle_timeout(self.now);
                }
            }
            16 => {
                let all = [Control::Pause, Control::Resume, Control::Resync];
                self.session.control(all[self.random.usize(..3)], self.now);
            }
            17 => self.session.commit(self.now, 0),
            _ => self.session.transmitted(self.now),
        }
        let lazy = self.random.u8(..4) == 0;
        self.drain(lazy);
    }

    fn commit(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let spare = self.session.spare();
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

    /// Until it waits; if the host is `lazy`, only until it wants to write.
    fn drain(&mut self, lazy: bool) {
        loop {
            match self.session.poll_output() {
                Output::Transmit { bytes, not_before } => {
                    if lazy && self.random.bool() {
                        break;
                    }
                    self.said.extend(bytes);
                    self.now = self.now.max(not_before);
                    self.session.transmitted(self.now);
                }
                Output::SetRate(_) => {}
                Output::SetDtr(_) => panic!("there is nothing at this line"),
                Output::Event(Event::Scan(_)) => panic!("a telegram is a scan"),
                Output::Event(Event::Telegram(received)) => {
                    assert!(Telegram::check(received.bytes).is_some());
                    self.telegrams += 1;
                }
                Output::Rest(_) | Output::Wait { .. } => break,
            }
        }
        let tally = self.session.tally();
        let known =
            tally.in_telegrams + tally.acknowledge + tally.discarded + self.session.account().buffered;
        assert_eq!((tally.read, known), (self.read, self.read), "bytes vanished");
        assert_eq!(tally.telegrams, self.telegrams);
    }

    /// Noise, or what a sensor might say, whole or cut.
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
            7 => reply::mode(address, random.bool(), 0x10),
            8 => reply::refused(address, 0x10),
            9 => reply::kind(address, b"LMS200;301063;V02.30 ", 0x10),
            10 => reply::configuration(address, Mode(random.u8(..8)), Unit::Cm, 0x10),
            11 => reply::variant(address, random.bool(), variant, 0x10),
            12 => Writer::new(address | REPLY, 0x90).slice(b"LMS200;301063;V02.10 ").byte(0x10).finish(),
            13 => Writer::new(address | REPLY, random.u8(0x80..)).byte(random.u8(..)).finish(),
            _ => {
                let operating_mode = [0x00, 0x10, 0x24, 0x25, 0x2A][random.usize(..5)];
                let baud = any_baud(random);
                let health = Health {
                    software: *b"V02.30 ",
                    operating_mode,
                    mode: Mode(1),
                    variant,
                    unit: Unit::Mm,
                    baud,
                };
                reply::status(address, &health, 0x10)
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

/// Every telegram that stands anywhere in `said`, whatever it was cut by.
fn telegrams(said: &[u8]) -> impl Iterator<Item = Telegram<'_>> {
    (0..said.len()).filter_map(|at| {
        let [STX, _, low, high, ..] = said[at..] else { return None };
        let len = usize::from(u16::from_le_bytes([low, high])) + FRAME;
        said.get(at..at + len).and_then(Telegram::check)
    })
}

#[test]
fn a_write_would_be_seen() {
    for write in [Write::Configuration(&[7; 34]), Write::Configuration2(&[2; 84]), Write::Field(&[2; 800])] {
        let write = write.encode(0).expect("short enough");
        let stop = Request::Stop.encode(0);
        let said = [&stop.bytes()[..3], &[2, 0], stop.bytes(), write.bytes(), &stop.bytes()[..6]].concat();
        let found: Vec<&[u8]> = telegrams(&said).map(|telegram| telegram.bytes()).collect();
        assert_eq!(found, [stop.bytes(), write.bytes()]);
    }
}

#[test]
fn whatever_happens_a_healthy_sensor_streams_in_the_end() {
    let mut slowest = 0;
    for seed in 0..120 {
        let mut chaos = Chaos::new(seed);
        for _ in 0..chaos.random.usize(1..60) {
            chaos.event();
        }
        chaos.drain(false);
        let Chaos { mut session, now, mut random, said, .. } = chaos;
        for telegram in telegrams(&said) {
            let request = Request::decode(telegram);
            assert!(
                request.is_some_and(|request| !EEPROM_WRITES.contains(&request.command())),
                "{telegram:?}"
            );
        }
        session.control(Control::Resume, now);
        let start = Start::In(match random.u8(..4) {
            0 => Operating::Installation,
            1 => Operating::All,
            2 => Operating::Partial,
            _ => Operating::OnRequest,
        });
        let settings = machine::Settings {
            baud: any_baud(&mut random),
            address: random.u8(..3),
            start,
            seed,
            ..machine::Settings::default()
        };
        let mut bench = Bench::adopting(session, sensor_with(settings), now);
        let is_there = |bench: &Bench| {
            bench.session.state() == State::Streaming
                && bench.sent.iter().any(|sent| !sent.is_reply && !sent.damaged)
        };
        slowest = slowest.max(bench.until(&format!("streaming, seed {seed}"), 10_000 * MILLIS, is_there));
    }
    println!("streaming within {} ms", slowest / MILLIS);
}
