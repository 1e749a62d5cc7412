//! A scanner on RS-232, which carries nothing at 500,000 baud: after a switch to that rate, the scanner is lost until its
//! power is cycled.

use scanhub_drivers::line::{Control, Session as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Trouble;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::fault::Faults;
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;
use scanhub_sim::wire::LineModel;

use super::bench::{Bench, WANTED, make_stream, sensor, sensor_with};

/// Maximum time from a boot message to a stream or to a lost scanner.
const LIMIT: Nanos = 5_000 * MILLIS;
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
