//! Tests of changes of permanent settings with the user's consent. The host writes the settings once and reads them
//! back, and the stream resumes. If a step fails, the outcome states which step, and which settings the scanner has.

use scanhub_drivers::lms::IdentityProbe;
use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::Configuration;
use scanhub_drivers::lms::telegram::{NAK, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_lms_configure::{Change, ChangeError, Consent, Outcome, Plan, Step, eeprom::PowerOn};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings};
use scanhub_sim::operating::OperatingMode;

use super::{Bench, machine, make_stream, sensor};

/// Requests the scanner's identity and settings. Returns a plan that changes no setting, the scanner, and the time at
/// which the plan was complete.
pub(crate) fn probe_and_plan(machine: LmsSimulator, now: Nanos) -> (Plan, LmsSimulator, Nanos) {
    let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, now), Baud::B500000, machine, now);
    bench.finish(20_000 * MILLIS);
    let plan = Plan::from_report(bench.protocol.report()).expect("a complete report");
    (plan, bench.machine, bench.now)
}

/// Changes `plan` so that it sets unit cm and mode 4.
pub(crate) fn set_other_values(plan: &mut Plan) {
    plan.new.set(5, 4);
    plan.new.set(6, Unit::Cm.code());
}

pub(crate) fn change(plan: Plan, machine: LmsSimulator, now: Nanos) -> Bench<Change> {
    Bench::new(Change::new(Consent::confirmed_by_person(plan), now), plan.baud, machine, now)
}

/// Requests the scanner's current settings.
pub(crate) fn probe_again(bench: Bench<Change>) -> (Plan, LmsSimulator, Nanos) {
    probe_and_plan(bench.machine, bench.now)
}

#[test]
fn configuration_is_written_once_and_stream_resumes() {
    for baud in Baud::ALL {
        for streaming in [false, true] {
            for len in [32, 34] {
                let settings = Settings { baud, configuration_len: len, seed: 3, ..Settings::default() };
                let mut machine = machine(settings);
                let now = if streaming { make_stream(&mut machine) } else { 0 };
                let (mut plan, machine, now) = probe_and_plan(machine, now);
                assert_eq!((plan.is_empty(), plan.old.bytes().len()), (true, len));
                set_other_values(&mut plan);
                let mut bench = change(plan, machine, now);
                let elapsed = bench.finish(60_000 * MILLIS);
                let expected = Outcome {
                    failed: None,
                    written: true,
                    configuration: Some(plan.new),
                    permanent_baud: None,
                    operating_mode: Some(if streaming { 0x24 } else { 0x25 }),
                };
                assert_eq!(*bench.protocol.outcome(), expected, "{baud:?} {streaming} {len}");
                assert_eq!(bench.machine.eeprom_writes(), 1);
                println!("{baud:?}, streaming {streaming}, {len} bytes: {} ms", elapsed / MILLIS);
                assert_eq!(bench.collect_telegrams(2_000 * MILLIS).is_empty(), !streaming);
                let (found, machine, _) = probe_again(bench);
                let configuration = Configuration::new(found.old.bytes()).unwrap();
                assert_eq!((configuration.mode(), configuration.unit()), (Mode(4), Some(Unit::Cm)));
                assert_eq!(machine.eeprom_writes(), 1);
            }
        }
    }
}

#[test]
fn changes_the_rate_after_power_on() {
    let (mut first, machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
    first.power_on = Some(PowerOn::KeepBaud);
    let mut bench = change(first, machine, now);
    bench.finish(60_000 * MILLIS);
    let outcome = *bench.protocol.outcome();
    assert_eq!((outcome.failed, outcome.permanent_baud), (None, Some(true)));
    let (mut second, machine, now) = probe_again(bench);
    second.power_on = Some(PowerOn::Baud9600);
    let mut bench = change(second, machine, now);
    bench.finish(60_000 * MILLIS);
    assert_eq!(
        (bench.protocol.outcome().failed, bench.protocol.outcome().permanent_baud),
        (None, Some(false))
    );
    assert_eq!(bench.machine.eeprom_writes(), 2);
}

#[test]
fn does_not_write_to_a_different_scanner() {
    let (mut plan, _, _) = probe_and_plan(sensor(Baud::B9600), 0);
    set_other_values(&mut plan);
    let other = machine(Settings { mode: Mode(3), seed: 9, ..Settings::default() });
    let mut bench = change(plan, other, 0);
    bench.finish(60_000 * MILLIS);
    let outcome = bench.protocol.outcome();
    assert_eq!((outcome.failed, outcome.written), (Some((Step::Compare, ChangeError::Mismatch)), false));
    assert!(bench.sent_requests.iter().all(|telegram| telegram[4] == 0x74), "{:02X?}", bench.sent_requests);
    assert_eq!(bench.machine.eeprom_writes(), 0);
}

#[test]
fn wrong_password_writes_nothing_and_keeps_stream() {
    let mut machine = sensor(Baud::B500000);
    let now = make_stream(&mut machine);
    let (mut plan, machine, now) = probe_and_plan(machine, now);
    set_other_values(&mut plan);
    plan.password = Password(*b"mistaken");
    let mut bench = change(plan, machine, now);
    bench.finish(60_000 * MILLIS);
    let outcome = bench.protocol.outcome();
    assert_eq!(outcome.failed, Some((Step::Enter, ChangeError::Refused)));
    assert_eq!((outcome.written, outcome.configuration), (false, Some(plan.old)));
    assert_eq!((outcome.operating_mode, bench.machine.eeprom_writes()), (Some(0x24), 0));
    assert!(!bench.collect_telegrams(1_000 * MILLIS).is_empty());
}

#[test]
fn refused_write_keeps_the_old_configuration() {
    let (mut plan, mut machine, now) = probe_and_plan(sensor(Baud::B19200), 0);
    set_other_values(&mut plan);
    machine.set_quirks(ProtocolQuirks { refused_commands: vec![0x77], ..ProtocolQuirks::default() });
    let mut bench = change(plan, machine, now);
    bench.finish(60_000 * MILLIS);
    let outcome = bench.protocol.outcome();
    assert_eq!(outcome.failed, Some((Step::Write, ChangeError::Refused)));
    assert_eq!((outcome.configuration, outcome.operating_mode), (Some(plan.old), Some(0x25)));
}

#[test]
fn write_that_takes_seven_seconds_succeeds() {
    let (mut plan, mut machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
    set_other_values(&mut plan);
    machine.set_quirks(ProtocolQuirks { late_write_ns: 6_000 * MILLIS, ..ProtocolQuirks::default() });
    let mut bench = change(plan, machine, now);
    let elapsed = bench.finish(60_000 * MILLIS);
    assert!(elapsed > 7_000 * MILLIS, "{elapsed}");
    assert_eq!((bench.protocol.outcome().failed, bench.machine.eeprom_writes()), (None, 1));
    assert_eq!(bench.protocol.outcome().configuration, Some(plan.new));
}

#[test]
fn lost_write_reply_causes_no_second_write() {
    let (mut plan, machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
    set_other_values(&mut plan);
    let mut bench = change(plan, machine, now);
    // The line loses all bytes of the reply to the write, including the ACK before it.
    let mut received = 0;
    bench.to_host = Box::new(move |bytes| {
        received += bytes.len();
        // Before the loss, the scanner sends an ACK and F4h with 42 bytes, and an ACK and A0h with 9 bytes. The lost
        // bytes are an ACK and F7h with 43 bytes.
        if received > 53 && received <= 53 + 44 { Vec::new() } else { bytes }
    });
    bench.finish(120_000 * MILLIS);
    assert_eq!((bench.protocol.outcome().failed, bench.machine.eeprom_writes()), (None, 1));
    assert_eq!(bench.protocol.outcome().configuration, Some(plan.new));
}

#[test]
fn silent_scanner_has_an_unknown_operating_mode() {
    let (mut plan, machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
    set_other_values(&mut plan);
    let mut bench = change(plan, machine, now);
    let mut received = 0;
    bench.to_host = Box::new(move |bytes| {
        received += bytes.len();
        if received > 53 { Vec::new() } else { bytes }
    });
    let elapsed = bench.finish(180_000 * MILLIS);
    let outcome = bench.protocol.outcome();
    assert_eq!(outcome.failed, Some((Step::Check, ChangeError::Unanswered)));
    assert_eq!((outcome.written, outcome.configuration, outcome.operating_mode), (true, None, None));
    println!("silence: {} ms", elapsed / MILLIS);
}

#[test]
fn outcome_is_right_despite_quirks_and_losses() {
    let mut done = 0;
    for seed in 0..60 {
        let baud = Baud::ALL[seed as usize % 4];
        let mut machine = sensor(baud);
        let now = if seed % 3 == 0 { make_stream(&mut machine) } else { 0 };
        let (mut plan, mut machine, now) = probe_and_plan(machine, now);
        set_other_values(&mut plan);
        let quirks = ProtocolQuirks {
            overlooked_share: 0.2,
            nak_share: 0.1,
            doubled_share: 0.2,
            ..ProtocolQuirks::default()
        };
        machine.set_quirks(quirks);
        let mut bench = change(plan, machine, now);
        let mut random = fastrand::Rng::with_seed(seed);
        bench.to_host = Box::new(move |bytes| bytes.into_iter().filter(|_| random.f64() > 0.001).collect());
        bench.finish(300_000 * MILLIS);
        let outcome = *bench.protocol.outcome();
        let writes = bench.machine.eeprom_writes();
        assert!(writes <= 3, "{writes} writes, seed {seed}");
        assert!(outcome.written || writes == 0, "seed {seed}");
        bench.machine.set_quirks(ProtocolQuirks::default());
        let (found, _, _) = probe_again(bench);
        if outcome.failed.is_none() {
            done += 1;
            assert_eq!((found.old, outcome.configuration), (plan.new, Some(plan.new)), "seed {seed}");
            assert_eq!(Some(found.operating_mode), outcome.operating_mode, "seed {seed}");
        }
        if let Some(kept) = outcome.configuration {
            assert_eq!(found.old, kept, "seed {seed}");
        }
        if outcome.operating_mode.is_some() {
            assert_ne!(found.operating_mode, 0x00, "left in installation mode, seed {seed}: {outcome:?}");
        }
    }
    println!("{done} of 60 done");
    assert!(done >= 45, "{done} of 60");
}

/// Returns a filter for bytes from the host that drops the end of the first `count` requests to stop the stream.
fn losing_stops(mut count: usize) -> Box<dyn FnMut(Vec<u8>) -> Vec<u8>> {
    let mut last = [0; 6];
    Box::new(move |bytes| {
        for &byte in &bytes {
            last.rotate_left(1);
            last[5] = byte;
        }
        let is_lost = count > 0 && last == [0x02, 0x00, 0x02, 0x00, 0x20, 0x25];
        count -= usize::from(is_lost);
        if is_lost { Vec::new() } else { bytes }
    })
}

#[test]
fn leaves_installation_mode_although_stops_are_lost() {
    for (lost, streaming) in [(4, false), (4, true), (7, false), (7, true)] {
        let mut machine = sensor(Baud::B38400);
        let now = if streaming { make_stream(&mut machine) } else { 0 };
        let (mut plan, machine, now) = probe_and_plan(machine, now);
        set_other_values(&mut plan);
        let mut bench = change(plan, machine, now);
        bench.to_scanner = losing_stops(lost);
        bench.finish(60_000 * MILLIS);
        let outcome = *bench.protocol.outcome();
        let failed = (lost > 4).then_some((Step::Leave, ChangeError::Unanswered));
        assert_eq!((outcome.failed, outcome.configuration), (failed, Some(plan.new)), "{lost} {streaming}");
        let expected = if streaming { OperatingMode::All } else { OperatingMode::OnRequest };
        assert_eq!(*bench.machine.operating(), expected, "{lost} {streaming}");
        assert_eq!(outcome.operating_mode, Some(expected.code()));
    }
}

#[test]
fn stray_nak_does_not_repeat_an_eeprom_write() {
    // In the first case, a NAK arrives before the first reply. In the second case, it arrives while the scanner writes:
    // after an ACK and F4h with 42 bytes, and an ACK and A0h with 9 bytes.
    for after in [0, 53] {
        let (mut plan, mut machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
        set_other_values(&mut plan);
        machine.set_quirks(ProtocolQuirks { late_write_ns: 5_000 * MILLIS, ..ProtocolQuirks::default() });
        let mut bench = change(plan, machine, now);
        let mut received = 0;
        bench.to_host = Box::new(move |mut bytes| {
            received += bytes.len();
            if received == after + 1 {
                bytes.push(NAK);
            }
            bytes
        });
        bench.finish(60_000 * MILLIS);
        assert_eq!((bench.protocol.outcome().failed, bench.machine.eeprom_writes()), (None, 1), "{after}");
        let commands: Vec<u8> = bench.sent_requests.iter().map(|telegram| telegram[4]).collect();
        assert_eq!(commands, [0x74, 0x20, 0x77, 0x20, 0x74], "{after}: no request was repeated");
    }
}

#[test]
fn unreadable_write_reply_is_no_refusal() {
    let (mut plan, machine, now) = probe_and_plan(sensor(Baud::B38400), 0);
    set_other_values(&mut plan);
    let mut bench = change(plan, machine, now);
    let (mut received, short) =
        (0, Writer::new(0x80, 0xF7).byte(1).slice(&plan.new.bytes()[..7]).byte(0x10).finish());
    bench.to_host = Box::new(move |bytes| {
        let before = received;
        received += bytes.len();
        // The first 54 bytes are an ACK and F4h with 42 bytes, an ACK and A0h with 9 bytes, and an ACK. Replace the
        // next telegram, F7h with 43 bytes.
        match before {
            54 => short.bytes().to_vec(),
            55..97 => Vec::new(),
            _ => bytes,
        }
    });
    bench.finish(60_000 * MILLIS);
    let outcome = *bench.protocol.outcome();
    assert_eq!((outcome.failed, outcome.configuration), (None, Some(plan.new)));
    assert_eq!(bench.machine.eeprom_writes(), 1);
}
