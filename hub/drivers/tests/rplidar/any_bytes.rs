//! Whatever comes down the line: every byte is counted once, and nothing panics.

use scanhub_drivers::Settings;
use scanhub_drivers::line;
use scanhub_drivers::line::{Control, Event, Output, Protocol as _, Session as _};
use scanhub_drivers::rplidar::packet::Kind;
use scanhub_drivers::rplidar::{Mode, Model, Session};
use scanhub_schema::MILLIS;

/// Heads of answers, of packets of all kinds, and of none.
const HEADS: [[u8; 7]; 12] = [
    [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04],
    [0xA5, 0x5A, 0x03, 0, 0, 0, 0x06],
    [0xA5, 0x5A, 0x04, 0, 0, 0, 0x15],
    [0xA5, 0x5A, 0x06, 0, 0, 0, 0x20],
    [0xA5, 0x5A, 0x40, 0, 0, 0, 0x20],
    [0xA5, 0x5A, 0x04, 0, 0, 0, 0xFF],
    [0xA5, 0x5A, 0x05, 0, 0, 0x40, 0x81],
    [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x82],
    [0xA5, 0x5A, 0x84, 0, 0, 0x40, 0x84],
    [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x85],
    [0xA5, 0x5A, 0xAA, 0, 0, 0x40, 0x86],
    [0xA5, 0x5A, 0xFF, 0xFF, 0xFF, 0xFF, 0x83],
];

/// A packet with a right checksum that says anything, at an angle that may go on from the one before.
fn wild(random: &mut fastrand::Rng, kind: Kind, angle: &mut u16, jumps: u16) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..kind.bytes()).map(|_| random.u8(..)).collect();
    *angle = if random.u16(..jumps) == 0 { random.u16(..) } else { (*angle % 23_040 + 1_152) % 23_040 };
    if kind == Kind::Standard {
        bytes[0] = bytes[0] & !3 | 2;
        bytes[1..3].copy_from_slice(&(*angle << 1 | 1).to_le_bytes());
        return bytes;
    }
    let at = if kind == Kind::UltraDense { 8 } else { 2 };
    bytes[at..at + 2].copy_from_slice(&angle.to_le_bytes());
    let sum = bytes[2..].iter().fold(0, |sum, byte| sum ^ byte);
    (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
    bytes
}

fn pick<T: Copy>(random: &mut fastrand::Rng, all: &[T]) -> Option<T> {
    all.get(random.usize(..all.len() + 1)).copied()
}

#[test]
fn every_byte_is_counted_once() {
    let mut turns = 0;
    for seed in 0..400 {
        let mut random = fastrand::Rng::with_seed(seed);
        // Of some the packets go on for a while.
        let is_calm = seed % 2 == 0;
        let jumps = if is_calm { 1_000 } else { 8 };
        let settings = Settings {
            model: pick(&mut random, &Model::ALL).map(Model::name),
            mode: pick(&mut random, &Mode::ALL).map(Mode::name),
            fixed_rate: random.bool(),
            listen_only: random.bool() || is_calm,
            stop_when_idle: random.bool(),
            ..Settings::default()
        };
        let mut session = Session::new(settings, 0);
        let kind = Kind::ALL[seed as usize % 5];
        let (mut now, mut told, mut angle) = (0, 0, 0);
        for _ in 0..300 {
            let mut bytes = Vec::new();
            while bytes.len() < 600 {
                match if is_calm && random.u8(..50) > 0 { 15 } else { random.u8(..16) } {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(random.choice(HEADS).expect("some")),
                    2 => bytes
                        .extend(&wild(&mut random, kind, &mut angle, jumps)[..random.usize(..kind.bytes())]),
                    3 => bytes.extend(b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"),
                    _ => bytes.extend(wild(&mut random, kind, &mut angle, jumps)),
                }
            }
            match random.u16(..if is_calm { 400 } else { 40 }) {
                0 => session.control(Control::Pause, now),
                1 => session.control(Control::Resume, now),
                2 => session.control(Control::Resync, now),
                3 => session.set_has_subscribers(now, random.bool()),
                4 => session.handle_timeout(now),
                _ => {}
            }
            let len = bytes.len().min(session.spare().len()).min(if is_calm {
                usize::MAX
            } else {
                random.usize(..900)
            });
            session.spare()[..len].copy_from_slice(&bytes[..len]);
            now += if is_calm { bytes.len() as u64 * MILLIS / 10 } else { random.u64(..100 * MILLIS) };
            session.commit(now, len);
            loop {
                match session.poll_output() {
                    Output::Event(Event::Telegram(received)) => {
                        told += received.bytes.len() as u64;
                        assert!(received.first <= received.last && received.last <= now);
                        assert_eq!(received.bytes.len() % received.count, 0);
                    }
                    Output::Event(Event::Scan(turn)) => {
                        assert!(turn.first <= turn.last && line::BEAMS.contains(&turn.beams()));
                        turns += 1;
                    }
                    Output::SetRate(_) => assert!(!settings.fixed_rate && !settings.listen_only),
                    Output::SetDtr(_) => assert!(!settings.listen_only),
                    Output::Transmit { .. } => {
                        assert!(!settings.listen_only, "nobody is there");
                        session.transmitted(now);
                    }
                    Output::Rest(until) => {
                        assert!(until > now);
                        break;
                    }
                    Output::Wait { .. } => break,
                }
            }
            let account = session.account();
            assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
            assert_eq!(account.in_telegrams, told);
            assert!(account.buffered < 2 * Kind::LONGEST as u64 + 80, "{account:?}");
        }
    }
    assert!(turns > 100, "{turns}");
}
