//! Tests of power cycles and restarts during a scan and at the start of a session, and of a scanner that takes a minute
//! to boot. They also test a scanner on an RS-232 line, which carries nothing at 500,000 baud. After a switch to this
//! rate, no reply arrives until the power of the scanner is cycled.

use scanhub_drivers::line::{Control, ScannerSession as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Problem;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::fault::Faults;
use scanhub_sim::line_model::LineModel;
use scanhub_sim::machine::{ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::OperatingMode;

use super::{Bench, SESSION_SETTINGS, make_stream, sensor, sensor_with};

/// Time after the boot message within which a session must stream.
const STREAM_TIMEOUT: Nanos = 5_000 * MILLIS;

/// Maximum time until the session streams if it first waits for the reply to a change of mode, which the scanner has
/// dropped because of the restart, and then searches for the rate.
const SEARCH_TIMEOUT: Nanos = 6_000 * MILLIS;

fn booting(boot_ns: Nanos) -> Settings {
    Settings { boot_ns, ..Settings::default() }
}

#[test]
fn recovers_from_power_loss_during_a_scan() {
    let mut slowest = 0;
    for boot in [50, 300, 1_000, 1_500, 2_000, 3_333, 7_777, 20_000, 59_000] {
        for phase in [0, 5, 14, 22] {
            let mut bench = Bench::new(sensor_with(booting(boot * MILLIS)), 0);
            bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run((500 + phase) * MILLIS);
            let off = bench.now;
            bench.machine.power_cycle(off);
            bench.run(boot * MILLIS);
            let elapsed = bench.run_until("streaming", STREAM_TIMEOUT, |bench| {
                bench.is_streaming() && bench.received.last().is_some_and(|got| got.at > off + boot * MILLIS)
            });
            slowest = slowest.max(elapsed);
            bench.run(500 * MILLIS);
            assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
            assert_eq!((bench.session.stats().resyncs, bench.session.problem()), (1, None), "{boot} {phase}");
            assert_eq!(bench.session.stats().restarts, 1, "{boot} {phase}");
        }
    }
    println!("streaming within {} ms of the boot message", slowest / MILLIS);
}

#[test]
fn recovers_from_power_loss_during_startup() {
    let mut slowest = 0;
    for baud in [Baud::B9600, Baud::B500000] {
        for at in 0..20 {
            for boot in [20, 3_100] {
                let mut bench = Bench::new(sensor_with(Settings { baud, ..booting(boot * MILLIS) }), 0);
                bench.run(at * 63 * MILLIS);
                let off = bench.now;
                bench.machine.power_cycle(off);
                bench.run(boot * MILLIS);
                let elapsed = bench.run_until("streaming", SEARCH_TIMEOUT, |bench| {
                    bench.is_streaming()
                        && bench.received.last().is_some_and(|got| got.at > off + boot * MILLIS)
                });
                slowest = slowest.max(elapsed);
                bench.run(300 * MILLIS);
                assert!(bench.is_streaming(), "{baud:?} {at} {boot} after {elapsed} ns: {bench}");
            }
        }
    }
    println!("streaming within {} ms", slowest / MILLIS);
}

#[test]
fn boot_message_causes_a_request_at_once() {
    // In the first case, the power fails during a stream at 9600. In the second case, the scanner boots during the
    // search, which receives at 9600 in the pauses between its rounds.
    let slow_settings = lms::Settings { baud: Baud::B9600, ..super::SESSION_SETTINGS };
    let mut bench = Bench::with_settings(slow_settings, sensor_with(booting(300 * MILLIS)), 0);
    bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    let (now, sent_count) = (bench.now, bench.sent_bytes.len());
    bench.machine.power_cycle(now);
    bench.run(300 * MILLIS);
    bench.run_until("asked", 100 * MILLIS, |bench| bench.sent_bytes.len() > sent_count);
    assert_eq!((bench.session.stats().resyncs, bench.session.stats().restarts), (1, 1));
    bench.run_until("streaming", 3_000 * MILLIS, |bench| bench.is_streaming());

    let settings = Settings { start: StartState::PowerOn, ..booting(60_000 * MILLIS) };
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.run(59_990 * MILLIS);
    assert_eq!(bench.states, [State::Probing]);
    assert!(
        matches!(bench.session.problem(), Some(Problem::NoReply { seconds: 30..=59, baud: None })),
        "{bench}"
    );
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!((bench.session.problem(), bench.session.stats().restarts), (None, 0), "first contact");
}

#[test]
fn mute_scanner_is_queried_rarely_without_end() {
    let settings = Settings {
        quirks: ProtocolQuirks { is_mute: true, ..ProtocolQuirks::default() },
        ..Settings::default()
    };
    let mut bench = Bench::new(sensor_with(settings), 0);
    let mut problems = Vec::new();
    for _ in 0..7_300 {
        bench.run(1_000 * MILLIS);
        if problems.last() != Some(&bench.session.problem()) {
            problems.push(bench.session.problem());
        }
    }
    let seconds: Vec<u32> = problems
        .iter()
        .filter_map(|problem| match problem {
            Some(Problem::NoReply { seconds, .. }) => Some(*seconds),
            _ => None,
        })
        .collect();
    assert_eq!(seconds, [1, 3, 10, 30, 60, 300, 600, 1_800, 3_600, 7_200]);
    let requests = bench.sent_bytes.len() as u64 / 7;
    assert!((7_300..4 * 7_300).contains(&requests), "{requests} requests in 7300 s");
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
}

#[test]
fn pause_survives_a_power_cycle() {
    let settings = lms::Settings { baud: Baud::B9600, ..super::SESSION_SETTINGS };
    let mut bench = Bench::with_settings(settings, sensor_with(booting(300 * MILLIS)), 0);
    bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.session.control(Control::Pause, bench.now);
    bench.run(2_000 * MILLIS);
    let (now, sent_count) = (bench.now, bench.sent_bytes.len());
    bench.machine.power_cycle(now);
    bench.run(5_000 * MILLIS);
    assert_eq!((bench.session.state(), bench.sent_bytes.len()), (State::Paused, sent_count));
    bench.session.control(Control::Resume, bench.now);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!(bench.session.stats().restarts, 1);
}

#[test]
fn counts_each_restart_once_at_every_rate() {
    for baud in [Baud::B9600, Baud::B38400, Baud::B500000] {
        for boot in [50, 900, 1_700, 2_500, 4_100, 20_000] {
            let settings = lms::Settings { baud, ..super::SESSION_SETTINGS };
            let mut bench = Bench::with_settings(settings, sensor_with(booting(boot * MILLIS)), 0);
            for restarts in 1..=3 {
                bench.run_until("streaming", SEARCH_TIMEOUT, Bench::is_streaming);
                bench.run(2_000 * MILLIS);
                let now = bench.now;
                bench.machine.brown_out(now);
                bench.run((boot + 1_100) * MILLIS);
                bench.run_until("streaming", SEARCH_TIMEOUT, Bench::is_streaming);
                assert_eq!(bench.session.stats().restarts, restarts, "{baud:?} {boot}: {bench}");
            }
        }
    }
}

#[test]
fn cable_and_a_user_do_not_restart_a_sensor() {
    let mut bench = Bench::new(sensor_with(Settings::default()), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.line = LineModel::new(&"silence=3,silence_every=6".parse().expect("faults"), 1);
    bench.run(40_000 * MILLIS);
    bench.line = LineModel::new(&Faults::default(), 1);
    bench.run_until("streaming", SEARCH_TIMEOUT, Bench::is_streaming);
    assert!(bench.session.stats().resyncs > 3);
    for control in [Control::Resync, Control::Pause, Control::Resume] {
        bench.session.control(control, bench.now);
        bench.run(3_000 * MILLIS);
    }
    bench.run_until("streaming", SEARCH_TIMEOUT, Bench::is_streaming);
    assert_eq!(bench.session.stats().restarts, 0);
}

#[test]
fn external_reset_counts_as_a_restart() {
    let settings = lms::Settings { baud: Baud::B9600, ..super::SESSION_SETTINGS };
    let mut bench = Bench::with_settings(settings, sensor_with(booting(500 * MILLIS)), 0);
    bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(100 * MILLIS);
    let now = bench.now;
    for (i, &byte) in Request::Reset.encode(0).bytes().iter().enumerate() {
        bench.machine.receive(byte, scanhub_sim::Arrival::at(now + 1_200_000 * i as u64));
    }
    bench.run(1_000 * MILLIS);
    bench.run_until("streaming", STREAM_TIMEOUT, |bench| bench.is_streaming());
    let scans = bench.received.len();
    bench.run(2_000 * MILLIS);
    assert!(bench.is_streaming() && bench.received.len() > scans, "{bench}");
    assert_eq!(bench.session.stats().restarts, 1);
}

const SLOWER_RATE_PROBLEM: Option<Problem> = Some(Problem::NeedsRs422 { fallback: Some(Baud::B38400) });
const KEEPS_RATE: Option<Problem> = Some(Problem::NeedsRs422 { fallback: None });

fn bench_on_rs232(session_settings: lms::Settings, settings: Settings) -> Bench {
    let mut bench = Bench::with_settings(session_settings, sensor_with(settings), 0);
    bench.line = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
    bench
}

/// Returns how many times the session has sent `request`.
fn count(bench: &Bench, request: Request) -> usize {
    let sent: Vec<u8> = bench.sent_bytes.iter().map(|&(_, byte)| byte).collect();
    let encoded = request.encode(0);
    sent.windows(encoded.bytes().len()).filter(|window| *window == encoded.bytes()).count()
}

/// Runs until the scanner has switched to 500,000 baud, and the session receives nothing from it.
fn lose_scanner(bench: &mut Bench) {
    let is_fast = |bench: &Bench| bench.machine.baud() == Baud::B500000;
    bench.run_until("switched", STREAM_TIMEOUT, is_fast);
    bench.run(STREAM_TIMEOUT);
    assert!(is_fast(bench) && !bench.is_streaming(), "{bench}");
}

fn cycle_power(bench: &mut Bench, off_time: Nanos) {
    bench.run(off_time);
    let now = bench.now;
    bench.machine.power_cycle(now);
}

#[test]
fn streams_at_38400_after_exactly_two_switches() {
    for (seed, start) in [
        (1, StartState::Operating(OperatingMode::OnRequest)),
        (2, StartState::PowerOn),
        (3, StartState::Operating(OperatingMode::All)),
    ] {
        for boot in [50, 2_000, 20_000] {
            let mut bench = bench_on_rs232(
                SESSION_SETTINGS,
                Settings { boot_ns: boot * MILLIS, seed, start: start.clone(), ..Settings::default() },
            );
            bench.run(boot * MILLIS);
            lose_scanner(&mut bench);
            assert_eq!(bench.session.silent_switches(), 1);
            assert!(bench.discovered_rate().is_some(), "the count is saved with the rate");
            assert!(!matches!(bench.session.problem(), SLOWER_RATE_PROBLEM | KEEPS_RATE), "{bench}");
            cycle_power(&mut bench, 700 * MILLIS);
            bench.run(boot * MILLIS);
            lose_scanner(&mut bench);
            assert_eq!((bench.session.silent_switches(), bench.session.problem()), (2, SLOWER_RATE_PROBLEM));
            assert_eq!(bench.discovered_rate(), Some(Baud::B38400), "remembered before the scanner is back");
            bench.run(20_000 * MILLIS);
            assert_eq!(bench.session.problem(), SLOWER_RATE_PROBLEM, "the search reports nothing else");
            cycle_power(&mut bench, 0);
            bench.run(boot * MILLIS);
            bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
            bench.run(2_000 * MILLIS);
            assert!(bench.is_streaming() && bench.received_scans(0).len() >= 8, "{bench}");
            assert_eq!((bench.session.baud(), bench.machine.baud()), (Baud::B38400, Baud::B38400));
            assert_eq!(
                (bench.session.problem(), bench.discovered_rate()),
                (SLOWER_RATE_PROBLEM, Some(Baud::B38400))
            );
            assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 2, "{bench}");
        }
    }
}

#[test]
fn restored_switch_count_makes_38400_the_first_rate() {
    let mut bench = bench_on_rs232(SESSION_SETTINGS, Settings::default());
    lose_scanner(&mut bench);
    let counted = bench.session.silent_switches();
    let mut bench = bench_on_rs232(SESSION_SETTINGS, Settings::default());
    bench.set_first_probe_rate(Baud::B9600);
    bench.session.restore_silent_switches(counted);
    lose_scanner(&mut bench);
    let (rate, counted) = (bench.discovered_rate(), bench.session.silent_switches());
    assert_eq!((rate, counted), (Some(Baud::B38400), 2));
    // Test three scanners: one that still streams for the previous hub, one that is idle at 38400, and one that has had
    // a power cycle.
    let streaming = || {
        let mut machine = sensor(Baud::B38400);
        let now = make_stream(&mut machine);
        (machine, now)
    };
    for ((machine, now), within) in
        [(streaming(), 500), ((sensor(Baud::B38400), 0), 1_500), ((sensor(Baud::B9600), 0), 2_500)]
    {
        let mut bench = Bench::new(machine, now);
        bench.line = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
        bench.set_first_probe_rate(Baud::B38400);
        bench.session.restore_silent_switches(counted);
        bench.run_until("streaming", within * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert_eq!(
            (bench.session.baud(), bench.session.problem()),
            (Baud::B38400, SLOWER_RATE_PROBLEM),
            "{bench}"
        );
        assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 0, "{bench}");
        assert_eq!((bench.discovered_rate(), bench.session.silent_switches()), (Some(Baud::B38400), 2));
    }
}

#[test]
fn configured_rate_is_kept_and_message_names_rs422() {
    let mut bench =
        bench_on_rs232(lms::Settings { keep_baud: true, ..SESSION_SETTINGS }, Settings::default());
    lose_scanner(&mut bench);
    for _ in 0..3 {
        cycle_power(&mut bench, 500 * MILLIS);
        lose_scanner(&mut bench);
        assert_eq!((bench.session.problem(), bench.discovered_rate()), (KEEPS_RATE, Some(Baud::B9600)));
    }
    // Replace the line by an RS-422 line, which carries 500,000 baud.
    bench.line = LineModel::new(&Faults::default(), 0);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!((bench.session.problem(), bench.session.silent_switches()), (None, 0));
    assert_eq!(bench.session.baud(), Baud::B500000);
}

#[test]
fn telegram_at_500000_resets_count_and_limit() {
    // One switch to 500,000 baud got no reply, for example because the power failed at that moment.
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.session.restore_silent_switches(1);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!((bench.session.silent_switches(), bench.session.baud()), (0, Baud::B500000));
    // A stream that the session receives without a search resets the count, too. The session then also reports a rate,
    // because the hub saves the count together with a rate.
    let mut machine = sensor(Baud::B500000);
    let now = make_stream(&mut machine);
    let mut bench = Bench::new(machine, now);
    bench.set_first_probe_rate(Baud::B9600);
    bench.session.restore_silent_switches(1);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!((bench.session.silent_switches(), bench.discovered_rate()), (0, Some(Baud::B9600)));
    // If a scanner replies at 500,000 baud, the line carries this rate.
    for streams in [false, true] {
        let mut machine = sensor(Baud::B500000);
        let now = if streams { make_stream(&mut machine) } else { 0 };
        let mut bench = Bench::new(machine, now);
        bench.set_first_probe_rate(Baud::B38400);
        bench.session.restore_silent_switches(2);
        bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert_eq!((bench.session.silent_switches(), bench.session.problem()), (0, None), "{bench}");
        assert_eq!((bench.session.baud(), count(&bench, Request::Baud(Baud::B38400))), (Baud::B500000, 0));
    }
}

#[test]
fn other_rates_and_servers_are_not_limited() {
    for (baud, fixed_rate) in [(Baud::B19200, false), (Baud::B500000, true)] {
        let settings = lms::Settings { baud, fixed_rate, ..SESSION_SETTINGS };
        let mut bench = Bench::with_settings(settings, sensor(baud), 0);
        bench.session.restore_silent_switches(2);
        bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
        assert_eq!(bench.session.baud(), baud);
        assert!(bench.session.problem().is_none(), "{bench}");
    }
}

#[test]
fn pause_and_silence_keep_the_limit() {
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.line = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
    bench.session.restore_silent_switches(2);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    bench.session.control(Control::Pause, bench.now);
    bench.run(2_000 * MILLIS);
    bench.session.control(Control::Resume, bench.now);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    cycle_power(&mut bench, 0);
    bench.run(3_000 * MILLIS);
    bench.run_until("streaming", STREAM_TIMEOUT, Bench::is_streaming);
    assert_eq!(
        (bench.session.baud(), bench.session.problem()),
        (Baud::B38400, SLOWER_RATE_PROBLEM),
        "{bench}"
    );
    assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 0, "{bench}");
}

#[test]
fn rate_messages_fit_into_a_status() {
    for problem in [SLOWER_RATE_PROBLEM, KEEPS_RATE] {
        let text = problem.map(|problem| problem.to_string()).unwrap_or_default();
        assert!(text.contains("RS-422") && text.len() <= scanhub_schema::Status::MAX_ERROR_LEN, "{text}");
    }
}
