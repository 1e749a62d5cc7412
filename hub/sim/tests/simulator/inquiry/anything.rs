//! Random bytes and random orders of events: nothing panics, everything comes to its end, and nothing is said that was
//! not to be.

use scanhub_drivers::line::{Output, Protocol};
use scanhub_drivers::lms::Inquiry;
use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::factory;
use scanhub_drivers::lms::framer::Tally;
use scanhub_drivers::lms::telegram::{FRAME, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_lms_configure::{Change, Consent, OwnedConfiguration, Plan};
use scanhub_schema::{MILLIS, Nanos};

/// Drives `talk` until it is over, by what comes to mind; returns the telegrams that it said.
fn drive<C: Protocol>(talk: &mut C, seed: u64) -> Vec<Vec<u8>> {
    let mut random = fastrand::Rng::with_seed(seed);
    let (mut now, mut said, mut request): (Nanos, Vec<Vec<u8>>, Vec<u8>) = (0, Vec::new(), Vec::new());
    for _ in 0..200_000 {
        match talk.poll_output() {
            Output::SetRate(_) => request.clear(),
            Output::Transmit { bytes, not_before } => {
                let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                now = now.max(not_before) + if random.u8(..100) == 0 { 20 * MILLIS } else { 0 };
                if talk.restart_if_late(now) {
                    request.clear();
                    continue;
                }
                request.push(byte);
                if let [_, _, low, high, ..] = request[..]
                    && request.len() == usize::from(u16::from_le_bytes([low, high])) + FRAME
                {
                    said.push(std::mem::take(&mut request));
                }
                talk.transmitted(now);
            }
            Output::Wait { until } => {
                if talk.is_done() {
                    return said;
                }
                let asked = said.last().map(|telegram| telegram[4]);
                let bytes = anything(asked, &mut random);
                let is_early = random.u8(..3) == 0;
                now = if is_early {
                    now + random.u64(..5 * MILLIS)
                } else {
                    until.clamp(now, now + 10_000_000_000)
                };
                let spare = talk.spare();
                let len = if random.bool() { bytes.len().min(spare.len()) } else { 0 };
                spare[..len].copy_from_slice(&bytes[..len]);
                talk.commit(now, len);
                if len == 0 {
                    talk.handle_timeout(now);
                }
            }
            output => panic!("{output:?}"),
        }
    }
    panic!("no end, seed {seed}");
}

/// Noise, acknowledgements, or a telegram that a sensor may send, often the answer to what it was `asked`.
fn anything(asked: Option<u8>, random: &mut fastrand::Rng) -> Vec<u8> {
    let noise = |random: &mut fastrand::Rng, most| {
        (0..random.usize(..most)).map(|_| random.u8(..)).collect::<Vec<u8>>()
    };
    match random.u8(..6) {
        0 => noise(random, 400),
        1 => vec![[0x06, 0x15, 0x02, 0x80][random.usize(..4)]; random.usize(1..4)],
        _ => {
            const COMMANDS: [u8; 12] =
                [0x90, 0x92, 0xA0, 0xB0, 0xB1, 0xB2, 0xB5, 0xB6, 0xBA, 0xE6, 0xF4, 0xF7];
            let any = COMMANDS[random.usize(..COMMANDS.len())];
            let command = asked.filter(|_| random.u8(..4) > 0).map_or(any, |asked| asked | 0x80);
            let data = match command {
                0xA0 => vec![random.u8(..4) / 3],
                0xB1 => (0..152).map(|_| random.u8(..)).collect(),
                0xF4 if random.u8(..4) > 0 => factory(Mode(1), Unit::Mm).to_vec(),
                0xF4 => (0..34).map(|_| random.u8(..)).collect(),
                0xF7 => (0..35).map(|_| random.u8(..2)).collect(),
                _ => noise(random, 40),
            };
            Writer::new(0x80 | random.u8(..2), command).slice(&data).byte(0x10).finish().bytes().to_vec()
        }
    }
}

fn is_conserved(tally: &Tally, open: usize) -> bool {
    tally.read == tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64
}

#[test]
fn an_inquiry_ends_and_only_asks() {
    for seed in 0..200 {
        let mut inquiry = Inquiry::new(Baud::ALL[seed as usize % 4], 0);
        for telegram in drive(&mut inquiry, seed) {
            let telegram = Telegram::check(&telegram).unwrap_or_else(|| panic!("{telegram:02X?}"));
            assert!([0x31, 0x32, 0x35, 0x3A, 0x74].contains(&telegram.command()), "{telegram:?}");
        }
        let (tally, open) = inquiry.tally();
        assert!(is_conserved(tally, open), "seed {seed}: {tally:?}");
    }
}

#[test]
fn a_change_ends_writes_what_was_shown_and_leaves_the_installation_mode() {
    let old = OwnedConfiguration::new(&factory(Mode(1), Unit::Mm)).expect("34 bytes");
    let mut new = old;
    new.set(6, 0);
    let mut most = 0;
    for seed in 0..200 {
        let plan = Plan {
            baud: Baud::B38400,
            address: 0,
            operating_mode: if seed % 2 == 0 { 0x24 } else { 0x25 },
            old,
            new,
            power_on: None,
            password: Password::FACTORY,
        };
        let mut change = Change::new(Consent::of_a_person(plan), 0);
        let said = drive(&mut change, seed);
        let commands: Vec<(u8, u8)> = said
            .iter()
            .map(|bytes| {
                let telegram = Telegram::check(bytes).unwrap_or_else(|| panic!("{bytes:02X?}"));
                if telegram.command() == 0x77 {
                    assert_eq!(telegram.data(), new.bytes());
                }
                (telegram.command(), telegram.data().first().copied().unwrap_or_default())
            })
            .collect();
        let writes = commands.iter().filter(|(command, _)| *command == 0x77).count();
        most = most.max(writes);
        assert_eq!(writes > 0, change.outcome().written, "seed {seed}");
        assert!(commands.iter().all(|(command, _)| [0x20, 0x74, 0x77].contains(command)), "{commands:02X?}");
        let entered = commands.iter().rposition(|said| *said == (0x20, 0x00));
        let left = commands.iter().rposition(|said| *said == (0x20, 0x25));
        assert!(entered.is_none() || left > entered, "seed {seed}: {commands:02X?}");
    }
    assert!((1..=3).contains(&most), "{most} writes");
}
