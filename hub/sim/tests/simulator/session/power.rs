//! Power cycles and restarts, in a scan, in the start of a session, and of a scanner that takes a minute to boot. A scanner on
//! RS-232, which carries nothing at 500,000 baud: after a switch to that rate, the scanner is lost until its power is cycled.

use scanhub_drivers::line::{Control, Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Trouble;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::fault::Faults;
use scanhub_sim::machine::{ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;
use scanhub_sim::wire::LineModel;

use super::{Bench, WANTED, make_stream, sensor, sensor_with};

/// What a session has to stream within after the banner.
const LIMIT: Nanos = 5_000 * MILLIS;

/// The same where the change of a mode is waited for that the sensor has forgotten, and then the rate is sought.
const SEARCHING: Nanos = 6_000 * MILLIS;

fn booting(boot_ns: Nanos) -> Settings {
    Settings { boot_ns, ..Settings::default() }
}

#[test]
fn in_the_middle_of_a_scan() {
    let mut slowest = 0;
    for boot in [50, 300, 1_000, 1_500, 2_000, 3_333, 7_777, 20_000, 59_000] {
        for phase in [0, 5, 14, 22] {
            let mut bench = Bench::new(sensor_with(booting(boot * MILLIS)), 0);
            bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run((500 + phase) * MILLIS);
            let off = bench.now;
            bench.machine.power_cycle(off);
            bench.run(boot * MILLIS);
            let took = bench.until("streaming", LIMIT, |bench| {
                bench.is_streaming() && bench.received.last().is_some_and(|got| got.at > off + boot * MILLIS)
            });
            slowest = slowest.max(took);
            bench.run(500 * MILLIS);
            assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
            assert_eq!(
                (bench.session.account().resyncs, bench.session.trouble()),
                (1, None),
                "{boot} {phase}"
            );
            assert_eq!(bench.session.account().restarts, 1, "{boot} {phase}");
        }
    }
    println!("streaming within {} ms of the banner", slowest / MILLIS);
}

#[test]
fn at_any_moment_of_the_conversation() {
    let mut slowest = 0;
    for baud in [Baud::B9600, Baud::B500000] {
        for at in 0..20 {
            for boot in [20, 3_100] {
                let mut bench = Bench::new(sensor_with(Settings { baud, ..booting(boot * MILLIS) }), 0);
                bench.run(at * 63 * MILLIS);
                let off = bench.now;
                bench.machine.power_cycle(off);
                bench.run(boot * MILLIS);
                let took = bench.until("streaming", SEARCHING, |bench| {
                    bench.is_streaming()
                        && bench.received.last().is_some_and(|got| got.at > off + boot * MILLIS)
                });
                slowest = slowest.max(took);
                bench.run(300 * MILLIS);
                assert!(bench.is_streaming(), "{baud:?} {at} {boot} after {took} ns: {bench}");
            }
        }
    }
    println!("streaming within {} ms", slowest / MILLIS);
}

#[test]
fn a_banner_that_is_heard_is_answered_at_once() {
    // In a stream at 9600, and in the search, where the pauses between its rounds are spent at 9600.
    let wanted = lms::Settings { baud: Baud::B9600, ..super::WANTED };
    let mut bench = Bench::wanting(wanted, sensor_with(booting(300 * MILLIS)), 0);
    bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    let (now, said) = (bench.now, bench.said.len());
    bench.machine.power_cycle(now);
    bench.run(300 * MILLIS);
    bench.until("asked", 100 * MILLIS, |bench| bench.said.len() > said);
    assert_eq!((bench.session.account().resyncs, bench.session.account().restarts), (1, 1));
    bench.until("streaming", 3_000 * MILLIS, |bench| bench.is_streaming());

    let settings = Settings { start: Start::PowerOn, ..booting(60_000 * MILLIS) };
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.run(59_990 * MILLIS);
    assert_eq!(bench.states, [State::Probing]);
    assert!(
        matches!(bench.session.trouble(), Some(Trouble::NoAnswer { seconds: 30..=59, baud: None })),
        "{bench}"
    );
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!((bench.session.trouble(), bench.session.account().restarts), (None, 0), "first contact");
}

#[test]
fn a_mute_line_is_asked_rarely_and_for_ever() {
    let settings = Settings {
        quirks: ProtocolQuirks { mute: true, ..ProtocolQuirks::default() },
        ..Settings::default()
    };
    let mut bench = Bench::new(sensor_with(settings), 0);
    let mut told = Vec::new();
    for _ in 0..7_300 {
        bench.run(1_000 * MILLIS);
        if told.last() != Some(&bench.session.trouble()) {
            told.push(bench.session.trouble());
        }
    }
    let seconds: Vec<u32> = told
        .iter()
        .filter_map(|trouble| match trouble {
            Some(Trouble::NoAnswer { seconds, .. }) => Some(*seconds),
            _ => None,
        })
        .collect();
    assert_eq!(seconds, [1, 3, 10, 30, 60, 300, 600, 1_800, 3_600, 7_200]);
    let requests = bench.said.len() as u64 / 7;
    assert!((7_300..4 * 7_300).contains(&requests), "{requests} requests in 7300 s");
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.until("streaming", LIMIT, Bench::is_streaming);
}

#[test]
fn a_pause_outlasts_the_power() {
    let wanted = lms::Settings { baud: Baud::B9600, ..super::WANTED };
    let mut bench = Bench::wanting(wanted, sensor_with(booting(300 * MILLIS)), 0);
    bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.session.control(Control::Pause, bench.now);
    bench.run(2_000 * MILLIS);
    let (now, said) = (bench.now, bench.said.len());
    bench.machine.power_cycle(now);
    bench.run(5_000 * MILLIS);
    assert_eq!((bench.session.state(), bench.said.len()), (State::Paused, said));
    bench.session.control(Control::Resume, bench.now);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!(bench.session.account().restarts, 1);
}

#[test]
fn a_restart_is_counted_once_at_every_rate_and_however_long_it_takes() {
    for baud in [Baud::B9600, Baud::B38400, Baud::B500000] {
        for boot in [50, 900, 1_700, 2_500, 4_100, 20_000] {
            let wanted = lms::Settings { baud, ..super::WANTED };
            let mut bench = Bench::wanting(wanted, sensor_with(booting(boot * MILLIS)), 0);
            for restarts in 1..=3 {
                bench.until("streaming", SEARCHING, Bench::is_streaming);
                bench.run(2_000 * MILLIS);
                let now = bench.now;
                bench.machine.brown_out(now);
                bench.run((boot + 1_100) * MILLIS);
                bench.until("streaming", SEARCHING, Bench::is_streaming);
                assert_eq!(bench.session.account().restarts, restarts, "{baud:?} {boot}: {bench}");
            }
        }
    }
}

#[test]
fn a_cable_and_a_user_do_not_restart_a_sensor() {
    let mut bench = Bench::new(sensor_with(Settings::default()), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.wire = LineModel::new(&"silence=3,silence_every=6".parse().expect("faults"), 1);
    bench.run(40_000 * MILLIS);
    bench.wire = LineModel::new(&Faults::default(), 1);
    bench.until("streaming", SEARCHING, Bench::is_streaming);
    assert!(bench.session.account().resyncs > 3);
    for control in [Control::Resync, Control::Pause, Control::Resume] {
        bench.session.control(control, bench.now);
        bench.run(3_000 * MILLIS);
    }
    bench.until("streaming", SEARCHING, Bench::is_streaming);
    assert_eq!(bench.session.account().restarts, 0);
}

#[test]
fn a_reset_by_somebody_else_is_a_power_cycle() {
    let wanted = lms::Settings { baud: Baud::B9600, ..super::WANTED };
    let mut bench = Bench::wanting(wanted, sensor_with(booting(500 * MILLIS)), 0);
    bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(100 * MILLIS);
    let now = bench.now;
    for (i, &byte) in Request::Reset.encode(0).bytes().iter().enumerate() {
        bench.machine.receive(byte, scanhub_sim::Arrival::at(now + 1_200_000 * i as u64));
    }
    bench.run(1_000 * MILLIS);
    bench.until("streaming", LIMIT, |bench| bench.is_streaming());
    let scans = bench.received.len();
    bench.run(2_000 * MILLIS);
    assert!(bench.is_streaming() && bench.received.len() > scans, "{bench}");
    assert_eq!(bench.session.account().restarts, 1);
}

const FALLS_BACK: Option<Trouble> = Some(Trouble::NeedsRs422 { instead: Some(Baud::B38400) });
const KEEPS: Option<Trouble> = Some(Trouble::NeedsRs422 { instead: None });

fn on_rs232(wanted: lms::Settings, settings: Settings) -> Bench {
    let mut bench = Bench::wanting(wanted, sensor_with(settings), 0);
    bench.wire = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
    bench
}

/// Returns how many times `request` was sent.
fn count(bench: &Bench, request: Request) -> usize {
    let said: Vec<u8> = bench.said.iter().map(|&(_, byte)| byte).collect();
    let encoded = request.encode(0);
    said.windows(encoded.bytes().len()).filter(|window| *window == encoded.bytes()).count()
}

/// Runs until the scanner has switched to 500,000 baud and is lost.
fn lose(bench: &mut Bench) {
    let is_fast = |bench: &Bench| bench.machine.baud() == Baud::B500000;
    bench.until("switched", LIMIT, is_fast);
    bench.run(LIMIT);
    assert!(is_fast(bench) && !bench.is_streaming(), "{bench}");
}

fn cycle_power(bench: &mut Bench, off: Nanos) {
    bench.run(off);
    let now = bench.now;
    bench.machine.power_cycle(now);
}

#[test]
fn streams_at_38400_after_exactly_two_switches() {
    for (seed, start) in
        [(1, Start::In(Operating::OnRequest)), (2, Start::PowerOn), (3, Start::In(Operating::All))]
    {
        for boot in [50, 2_000, 20_000] {
            let mut bench = on_rs232(
                WANTED,
                Settings { boot_ns: boot * MILLIS, seed, start: start.clone(), ..Settings::default() },
            );
            bench.run(boot * MILLIS);
            lose(&mut bench);
            assert_eq!(bench.session.silent_switches(), 1);
            assert!(bench.found_at().is_some(), "the count is saved with the rate");
            assert!(!matches!(bench.session.trouble(), FALLS_BACK | KEEPS), "{bench}");
            cycle_power(&mut bench, 700 * MILLIS);
            bench.run(boot * MILLIS);
            lose(&mut bench);
            assert_eq!((bench.session.silent_switches(), bench.session.trouble()), (2, FALLS_BACK));
            assert_eq!(bench.found_at(), Some(Baud::B38400), "remembered before the scanner is back");
            bench.run(20_000 * MILLIS);
            assert_eq!(bench.session.trouble(), FALLS_BACK, "the search reports nothing else");
            cycle_power(&mut bench, 0);
            bench.run(boot * MILLIS);
            bench.until("streaming", LIMIT, Bench::is_streaming);
            bench.run(2_000 * MILLIS);
            assert!(bench.is_streaming() && bench.received_scans(0).len() >= 8, "{bench}");
            assert_eq!((bench.session.baud(), bench.machine.baud()), (Baud::B38400, Baud::B38400));
            assert_eq!((bench.session.trouble(), bench.found_at()), (FALLS_BACK, Some(Baud::B38400)));
            assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 2, "{bench}");
        }
    }
}

#[test]
fn count_outlives_session_and_next_session_uses_38400_first() {
    let mut bench = on_rs232(WANTED, Settings::default());
    lose(&mut bench);
    let counted = bench.session.silent_switches();
    let mut bench = on_rs232(WANTED, Settings::default());
    bench.seek_first(Baud::B9600);
    bench.session.recall_silent_switches(counted);
    lose(&mut bench);
    let (rate, counted) = (bench.found_at(), bench.session.silent_switches());
    assert_eq!((rate, counted), (Some(Baud::B38400), 2));
    // The scanner still streams for the previous hub, is idle at that rate, or has had a power cycle.
    let streaming = || {
        let mut machine = sensor(Baud::B38400);
        let now = make_stream(&mut machine);
        (machine, now)
    };
    for ((machine, now), within) in
        [(streaming(), 500), ((sensor(Baud::B38400), 0), 1_500), ((sensor(Baud::B9600), 0), 2_500)]
    {
        let mut bench = Bench::new(machine, now);
        bench.wire = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
        bench.seek_first(Baud::B38400);
        bench.session.recall_silent_switches(counted);
        bench.until("streaming", within * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert_eq!((bench.session.baud(), bench.session.trouble()), (Baud::B38400, FALLS_BACK), "{bench}");
        assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 0, "{bench}");
        assert_eq!((bench.found_at(), bench.session.silent_switches()), (Some(Baud::B38400), 2));
    }
}

#[test]
fn configured_rate_is_kept_and_message_names_rs422() {
    let mut bench = on_rs232(lms::Settings { keep_baud: true, ..WANTED }, Settings::default());
    lose(&mut bench);
    for _ in 0..3 {
        cycle_power(&mut bench, 500 * MILLIS);
        lose(&mut bench);
        assert_eq!((bench.session.trouble(), bench.found_at()), (KEEPS, Some(Baud::B9600)));
    }
    // The line was rewired.
    bench.wire = LineModel::new(&Faults::default(), 0);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!((bench.session.trouble(), bench.session.silent_switches()), (None, 0));
    assert_eq!(bench.session.baud(), Baud::B500000);
}

#[test]
fn telegram_at_500000_resets_count_and_limit() {
    // One switch was silent because the power failed at that moment.
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.session.recall_silent_switches(1);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!((bench.session.silent_switches(), bench.session.baud()), (0, Baud::B500000));
    // A stream that is received without a search resets it, too, and reports a rate to save it with.
    let mut machine = sensor(Baud::B500000);
    let now = make_stream(&mut machine);
    let mut bench = Bench::new(machine, now);
    bench.seek_first(Baud::B9600);
    bench.session.recall_silent_switches(1);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!((bench.session.silent_switches(), bench.found_at()), (0, Some(Baud::B9600)));
    // A scanner that answers at 500,000 baud proves that the line was rewired.
    for streams in [false, true] {
        let mut machine = sensor(Baud::B500000);
        let now = if streams { make_stream(&mut machine) } else { 0 };
        let mut bench = Bench::new(machine, now);
        bench.seek_first(Baud::B38400);
        bench.session.recall_silent_switches(2);
        bench.until("streaming", LIMIT, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert_eq!((bench.session.silent_switches(), bench.session.trouble()), (0, None), "{bench}");
        assert_eq!((bench.session.baud(), count(&bench, Request::Baud(Baud::B38400))), (Baud::B500000, 0));
    }
}

#[test]
fn other_rates_and_servers_are_not_limited() {
    for (baud, fixed_rate) in [(Baud::B19200, false), (Baud::B500000, true)] {
        let wanted = lms::Settings { baud, fixed_rate, ..WANTED };
        let mut bench = Bench::wanting(wanted, sensor(baud), 0);
        bench.session.recall_silent_switches(2);
        bench.until("streaming", LIMIT, Bench::is_streaming);
        assert_eq!(bench.session.baud(), baud);
        assert!(bench.session.trouble().is_none(), "{bench}");
    }
}

#[test]
fn pause_and_silence_keep_the_limit() {
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.wire = LineModel::new(&Faults { rs232: 1.0, ..Faults::default() }, 0);
    bench.session.recall_silent_switches(2);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    bench.session.control(Control::Pause, bench.now);
    bench.run(2_000 * MILLIS);
    bench.session.control(Control::Resume, bench.now);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    cycle_power(&mut bench, 0);
    bench.run(3_000 * MILLIS);
    bench.until("streaming", LIMIT, Bench::is_streaming);
    assert_eq!((bench.session.baud(), bench.session.trouble()), (Baud::B38400, FALLS_BACK), "{bench}");
    assert_eq!(count(&bench, Request::Baud(Baud::B500000)), 0, "{bench}");
}

#[test]
fn messages_fit_into_a_status() {
    for trouble in [FALLS_BACK, KEEPS] {
        let text = trouble.map(|trouble| trouble.to_string()).unwrap_or_default();
        assert!(text.contains("RS-422") && text.len() <= scanhub_schema::Status::MAX_ERROR_LEN, "{text}");
    }
}
