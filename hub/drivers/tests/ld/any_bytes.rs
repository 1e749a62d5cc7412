//! Whatever comes down the line: every byte is counted once, and nothing panics.

use scanhub_drivers::Settings;
use scanhub_drivers::ld::Session;
use scanhub_drivers::ld::packet::{Contents, HEADER, LEN, POINTS};
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _};
use scanhub_schema::MILLIS;

/// A packet with a right checksum that says anything.
fn wild(random: &mut fastrand::Rng) -> [u8; LEN] {
    let angle = |random: &mut fastrand::Rng| random.u16(..=36_000);
    let start = angle(random);
    let end = if random.bool() { angle(random) } else { (start + random.u16(..4_500)) % 36_000 };
    let speed = if random.bool() { random.u16(..) } else { 3_600 };
    let points = std::array::from_fn(|_| (random.u16(..), random.u8(..)));
    Contents { speed, start, points, end, millis: random.u16(..) }.encode()
}

#[test]
fn every_byte_is_counted_once() {
    for seed in 0..300 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut session = Session::new(Settings::default(), 0);
        let (mut now, mut told) = (0, 0);
        for _ in 0..400 {
            let mut bytes = Vec::new();
            while bytes.len() < 300 {
                match random.u8(..5) {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(HEADER.iter().cycle().take(random.usize(..100))),
                    2 => bytes.extend(&wild(&mut random)[..random.usize(..LEN)]),
                    _ => bytes.extend(wild(&mut random)),
                }
            }
            bytes.truncate(session.spare().len());
            session.spare()[..bytes.len()].copy_from_slice(&bytes);
            now += random.u64(..400 * MILLIS);
            session.commit(now, bytes.len());
            loop {
                match session.poll_output() {
                    Output::Event(Event::Telegram(received)) => {
                        told += received.bytes.len() as u64;
                        assert!(received.bytes.len() % LEN == 0 && received.first <= received.last);
                    }
                    Output::Event(Event::Scan(turn)) => assert!(turn.points().len() >= POINTS),
                    Output::SetRate(_) => {}
                    Output::Transmit { .. } | Output::SetDtr(_) => panic!("nothing is sent"),
                    Output::Rest(_) | Output::Wait { .. } => break,
                }
            }
            let account = session.account();
            assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
            assert_eq!(account.in_telegrams, told);
            assert!(account.buffered < 2 * LEN as u64, "{account:?}");
        }
        assert!(session.account().telegrams > 500);
    }
}
