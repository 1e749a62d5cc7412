//! Tests of probes and changes of settings with random bytes, random sequences of events, and faults of the scanner and
//! the line. Probes and changes never panic, always end, and report what is true. A change writes no more often than
//! permitted, and reports every write.

use scanhub_drivers::line::{Action, Protocol};
use scanhub_drivers::lms::IdentityProbe;
use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::factory_configuration;
use scanhub_drivers::lms::framer::FramerCounters;
use scanhub_drivers::lms::telegram::{FRAME_LEN, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_lms_configure::{Change, Consent, OwnedConfiguration, Plan};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::fault::Faults;
use scanhub_sim::line_model::LineModel;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks};

use super::change::{change, probe_again, probe_and_plan, set_other_values};
use super::{Bench, make_stream, sensor};

/// Drives `protocol` with random events until it is complete. Returns the telegrams that it sent.
fn drive<C: Protocol>(protocol: &mut C, seed: u64) -> Vec<Vec<u8>> {
    let mut random = fastrand::Rng::with_seed(seed);
    let (mut now, mut sent, mut request): (Nanos, Vec<Vec<u8>>, Vec<u8>) = (0, Vec::new(), Vec::new());
    for _ in 0..200_000 {
        match protocol.poll_action() {
            Action::SetRate(_) => request.clear(),
            Action::Transmit { bytes, not_before } => {
                let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                now = now.max(not_before) + if random.u8(..100) == 0 { 20 * MILLIS } else { 0 };
                if protocol.restart_if_late(now) {
                    request.clear();
                    continue;
                }
                request.push(byte);
                if let [_, _, low, high, ..] = request[..]
                    && request.len() == usize::from(u16::from_le_bytes([low, high])) + FRAME_LEN
                {
                    sent.push(std::mem::take(&mut request));
                }
                protocol.handle_transmitted(now);
            }
            Action::Wait { until } => {
                if protocol.is_done() {
                    return sent;
                }
                let last_command = sent.last().map(|telegram| telegram[4]);
                let bytes = random_bytes_or_reply(last_command, &mut random);
                let is_early = random.u8(..3) == 0;
                now = if is_early {
                    now + random.u64(..5 * MILLIS)
                } else {
                    until.clamp(now, now + 10_000_000_000)
                };
                let spare = protocol.read_buffer();
                let len = if random.bool() { bytes.len().min(spare.len()) } else { 0 };
                spare[..len].copy_from_slice(&bytes[..len]);
                protocol.commit(now, len);
                if len == 0 {
                    protocol.handle_timeout(now);
                }
            }
            output => panic!("{output:?}"),
        }
    }
    panic!("no end, seed {seed}");
}

/// Returns noise, acknowledgements, or a telegram that a scanner may send. The telegram is often the reply to
/// `request`.
fn random_bytes_or_reply(request: Option<u8>, random: &mut fastrand::Rng) -> Vec<u8> {
    let noise = |random: &mut fastrand::Rng, maximum| {
        (0..random.usize(..maximum)).map(|_| random.u8(..)).collect::<Vec<u8>>()
    };
    match random.u8(..6) {
        0 => noise(random, 400),
        1 => vec![[0x06, 0x15, 0x02, 0x80][random.usize(..4)]; random.usize(1..4)],
        _ => {
            const COMMANDS: [u8; 12] =
                [0x90, 0x92, 0xA0, 0xB0, 0xB1, 0xB2, 0xB5, 0xB6, 0xBA, 0xE6, 0xF4, 0xF7];
            let any = COMMANDS[random.usize(..COMMANDS.len())];
            let command =
                request.filter(|_| random.u8(..4) > 0).map_or(any, |request_code| request_code | 0x80);
            let data = match command {
                0xA0 => vec![random.u8(..4) / 3],
                0xB1 => (0..152).map(|_| random.u8(..)).collect(),
                0xF4 if random.u8(..4) > 0 => factory_configuration(Mode(1), Unit::Mm).to_vec(),
                0xF4 => (0..34).map(|_| random.u8(..)).collect(),
                0xF7 => (0..35).map(|_| random.u8(..2)).collect(),
                _ => noise(random, 40),
            };
            Writer::new(0x80 | random.u8(..2), command).slice(&data).byte(0x10).finish().bytes().to_vec()
        }
    }
}

fn are_bytes_conserved(tally: &FramerCounters, open: usize) -> bool {
    tally.read == tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64
}

#[test]
fn probe_ends_and_sends_only_queries() {
    for seed in 0..200 {
        let mut probe = IdentityProbe::new(Baud::ALL[seed as usize % 4], 0);
        for telegram in drive(&mut probe, seed) {
            let telegram = Telegram::check(&telegram).unwrap_or_else(|| panic!("{telegram:02X?}"));
            assert!([0x31, 0x32, 0x35, 0x3A, 0x74].contains(&telegram.command()), "{telegram:?}");
        }
        let (tally, open) = probe.byte_counters();
        assert!(are_bytes_conserved(tally, open), "seed {seed}: {tally:?}");
    }
}

#[test]
fn writes_the_plan_and_leaves_installation_mode() {
    let old = OwnedConfiguration::new(&factory_configuration(Mode(1), Unit::Mm)).expect("34 bytes");
    let mut new = old;
    new.set(6, 0);
    let mut maximum = 0;
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
        let mut change = Change::new(Consent::confirmed_by_person(plan), 0);
        let sent = drive(&mut change, seed);
        let commands: Vec<(u8, u8)> = sent
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
        maximum = maximum.max(writes);
        assert_eq!(writes > 0, change.outcome().written, "seed {seed}");
        assert!(commands.iter().all(|(command, _)| [0x20, 0x74, 0x77].contains(command)), "{commands:02X?}");
        let entered = commands.iter().rposition(|command| *command == (0x20, 0x00));
        let left = commands.iter().rposition(|command| *command == (0x20, 0x25));
        assert!(entered.is_none() || left > entered, "seed {seed}: {commands:02X?}");
    }
    assert!((1..=3).contains(&maximum), "{maximum} writes");
}

/// Faults, each with the number of probes that must succeed despite the fault, and the number of changes that must
/// succeed. Each test runs 8 probes and 8 changes.
const SCENES: &[(&str, [usize; 2])] = &[
    ("loss=0.001,burst=3", [7, 7]),
    ("flip=0.001", [7, 7]),
    ("insert=0.001,insert_burst=3", [7, 7]),
    ("double=0.001", [7, 7]),
    ("repeat=0.5", [7, 7]),
    ("truncate=0.2", [7, 6]),
    ("length=0.2", [7, 6]),
    ("abort=0.3", [7, 6]),
    ("flood=300,flood_every=0.5", [5, 4]),
    ("wall=300,wall_every=0.5", [5, 2]),
    ("silence=0.2,silence_at=0.3,silence_every=1", [7, 7]),
    ("stall=0.3,stall_at=0.2,stall_every=2", [7, 7]),
    ("delay=0.02", [7, 7]),
    ("power_every=2", [2, 0]),
    ("unplug=0.3,unplug_at=0.2,unplug_every=2", [7, 7]),
    ("late_mode=2.5,late_write=6", [7, 6]),
    ("late=0.3,twice=0.3", [7, 7]),
    ("late_ack=0.052,strict=1", [7, 7]),
    ("overlook=0.2,nak=0.1", [7, 7]),
];

/// Returns a scanner whose rate and state depend on `seed`: its rate, the scanner, the time, and whether it streams.
fn any_scanner(seed: u64) -> (Baud, LmsSimulator, u64, bool) {
    let baud = Baud::ALL[seed as usize % 4];
    let mut machine = sensor(baud);
    let is_streaming = seed % 8 >= 4;
    let now = if is_streaming { make_stream(&mut machine) } else { 0 };
    (baud, machine, now, is_streaming)
}

/// Adds the faults of the scanner and of the line to `bench`.
fn with_faults<C>(mut bench: Bench<C>, faults: &Faults, seed: u64) -> Bench<C> {
    bench.machine.set_quirks(faults.quirks());
    let fresh = LineModel::new(faults, seed);
    bench.line = fresh;
    bench
}

#[test]
fn probe_report_is_right_despite_faults() {
    for (text, [min_found, _]) in SCENES {
        let faults: Faults = text.parse().expect("faults");
        let mut found = 0;
        for seed in 0..SEED_COUNT {
            let (baud, machine, now, is_streaming) = any_scanner(seed);
            let probe = Bench::new(IdentityProbe::new(Baud::B500000, now), Baud::B500000, machine, now);
            let mut bench = with_faults(probe, &faults, seed);
            bench.finish(60_000 * MILLIS);
            let report = bench.protocol.report();
            if let Some(status) = report.status() {
                found += 1;
                // If the faults contain power cycles, the power may have failed after the report.
                if faults.power_every == 0.0 {
                    let mode = if is_streaming { 0x24 } else { 0x25 };
                    assert_eq!((report.baud, status.operating_mode()), (Some(baud), mode), "{text}, {seed}");
                }
            }
            if let Some(kind) = report.kind() {
                assert_eq!(kind, b"LMS200;301063;V02.30", "{text}, {seed}");
            }
            let (tally, open) = bench.protocol.byte_counters();
            let known = tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64;
            assert_eq!((tally.read, bench.machine.eeprom_writes()), (known, 0), "{text}, {seed}");
        }
        println!("{text}: {found} of {SEED_COUNT} found");
        assert!(found >= *min_found, "{text}: {found} of {SEED_COUNT} found");
    }
}

#[test]
fn change_outcome_is_right_despite_faults() {
    for (text, [_, min_done]) in SCENES {
        let faults: Faults = text.parse().expect("faults");
        let mut done = 0;
        for seed in 0..SEED_COUNT {
            let (_, machine, now, _) = any_scanner(seed);
            let (mut plan, machine, now) = probe_and_plan(machine, now);
            set_other_values(&mut plan);
            let mut bench: Bench<Change> = with_faults(change(plan, machine, now), &faults, seed);
            bench.finish(300_000 * MILLIS);
            let outcome = *bench.protocol.outcome();
            let writes = bench.machine.eeprom_writes();
            assert!(writes <= 3 && (outcome.written || writes == 0), "{text}, {seed}: {writes} writes");
            bench.line.set_faults(&Faults::default(), 0);
            bench.machine.set_quirks(ProtocolQuirks::default());
            bench.collect_telegrams(10_000 * MILLIS);
            let (found, _, _) = probe_again(bench);
            if let Some(kept) = outcome.configuration {
                assert_eq!(found.old, kept, "{text}, {seed}: {outcome:?}");
            }
            if outcome.failed.is_none() {
                done += 1;
                assert_eq!((found.old, outcome.configuration), (plan.new, Some(plan.new)), "{text}, {seed}");
            }
            if outcome.operating_mode.is_some() {
                assert_ne!(
                    found.operating_mode, 0x00,
                    "left in installation mode: {text}, {seed}: {outcome:?}"
                );
            }
        }
        println!("{text}: {done} of {SEED_COUNT} done");
        assert!(done >= *min_done, "{text}: {done} of {SEED_COUNT} done");
    }
}

/// Number of seeds. For each of the four rates, one scanner is idle and one streams.
const SEED_COUNT: u64 = 8;
