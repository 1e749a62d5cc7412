//! A sensor that streams already when the session begins: left by a hub that was killed, or by another program.

use scanhub_drivers::line::{Control, Session as _, State};
use scanhub_drivers::lms::Settings;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_schema::{MICROS, MILLIS};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{self, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, WANTED, make_stream, sensor, sensor_with};

#[test]
fn at_the_wanted_rate_it_is_taken_as_it_streams() {
    // Begun at any moment of a scan's period.
    for phase in 0..28 {
        let mut machine = sensor(Baud::B500000);
        let begun = make_stream(&mut machine) + phase * 970 * MICROS;
        let mut bench = Bench::new(machine, begun);
        bench.until("streaming", 60 * MILLIS, Bench::is_streaming);
        bench.run(2_000 * MILLIS);
        assert!(bench.said.iter().all(|(at, _)| *at >= bench.received[0].at), "spoke before it listened");
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        // Two questions, for measuring mode and type.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 2, "{aborted} scans were broken off");
        assert!(bench.session.sensor().mode.is_some() && !bench.session.sensor().kind().is_empty());
        // The scan in flight when it began is no telegram of ours, all others are.
        let (scans, intact) = (bench.received_scans(0), bench.intact_scans(begun));
        let skipped = intact.iter().position(|scan| scans.first() == Some(scan)).expect("was sent");
        assert_eq!(scans, intact[skipped..][..scans.len()], "{bench}");
        assert!(skipped <= 1 && intact.len() - skipped - scans.len() <= 1, "{bench}");
        assert_eq!(bench.session.account().began_with_a_cut, skipped == 1, "{bench}");
    }
}

#[test]
fn at_another_rate_it_is_found_and_brought_to_the_wanted_one() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for phase in 0..30 {
            let mut machine = sensor(baud);
            let begun = make_stream(&mut machine) + phase * 27 * MILLIS;
            let mut bench = Bench::new(machine, begun);
            let took = bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
            bench.run(500 * MILLIS);
            assert_eq!((bench.session.baud(), bench.machine.baud()), (Baud::B500000, Baud::B500000));
            assert!(bench.is_streaming() && bench.received_scans(0).len() > 15, "{took} ns: {bench}");
            assert_eq!(bench.session.trouble(), None);
        }
    }
}

#[test]
fn what_comes_at_another_rate_gives_no_scans() {
    let mut machine = sensor(Baud::B9600);
    let begun = make_stream(&mut machine);
    let mut bench = Bench::new(machine, begun);
    bench.seek_first(WANTED.baud);
    // It is asked at the wanted rate and at its own, tells its status, and is deaf from then on: it cannot be stopped.
    let asked = 2 * Request::Status.encode(0).bytes().len();
    bench.to_sensor = Box::new(move |number, byte| (number < asked).then_some(byte));
    // The host stands still at times, so that several scans wait where it changes its rate.
    for pause in 1..60 {
        bench.run(pause * 70 * MILLIS);
        bench.stop(1_700 * MILLIS);
    }
    assert!(bench.session.sensor().mode.is_some() && bench.received_scans(begun).len() > 20, "{bench}");
    assert!(bench.received.iter().all(|received| received.range_bits.is_none()), "{bench}");
    assert!(!bench.states.contains(&State::Streaming), "{bench}");
    bench.to_sensor = Box::new(|_, byte| Some(byte));
    bench.until("streaming", 10_000 * MILLIS, Bench::is_streaming);
    bench.until("scans", 1_000 * MILLIS, |bench| {
        bench.received.last().is_some_and(|last| last.range_bits.is_some())
    });
}

#[test]
fn on_a_slow_line_it_is_waited_for() {
    // A telegram takes 0.19 s at 38400 and 0.76 s at 9600, the next one comes 0.21 and 0.77 s later.
    for baud in [Baud::B9600, Baud::B38400] {
        let mut machine = sensor(baud);
        let begun = make_stream(&mut machine) + 100 * MILLIS;
        let mut bench = Bench::wanting(Settings { baud, ..WANTED }, machine, begun);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        let first = bench.received[0].at;
        assert!(bench.said.iter().all(|(at, _)| *at >= first), "spoke before it listened: {bench}");
        bench.run(10_000 * MILLIS);
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
    }
}

#[test]
fn what_the_last_session_knew_is_not_waited_for() {
    for phase in 0..28 {
        let mut last = Bench::new(sensor(Baud::B500000), 0);
        last.until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
        last.run(1_000 * MILLIS + phase * 970 * MICROS);
        let known = last.session.identity().expect("it streams");
        let begun = last.now;
        let mut bench = Bench::new(last.machine, begun);
        bench.session.restore_identity(known);
        bench.until("a scan", 60 * MILLIS, |bench| !bench.received_scans(0).is_empty());
        bench.run(2_000 * MILLIS);
        assert!(bench.scans(0).all(|got| got.range_bits == Some(13)), "{bench}");
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        assert_eq!(bench.session.sensor().kind(), b"LMS200;301063;V02.30");
        assert_eq!((bench.session.sensor().defective, bench.session.identity()), (Some(false), Some(known)));
        // Its status is asked all the same.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 1, "{aborted} scans were broken off");
    }
}

#[test]
fn what_the_last_session_knew_of_another_one_is_not_believed() {
    let mut last = Bench::new(sensor(Baud::B500000), 0);
    last.until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
    let known = last.session.identity().expect("it streams");
    // Its scans begin otherwise.
    let centimetres = machine::Settings {
        baud: Baud::B500000,
        unit: Unit::Cm,
        mode: Mode(4),
        ..machine::Settings::default()
    };
    let mut other = sensor_with(centimetres);
    let begun = make_stream(&mut other);
    let mut bench = Bench::new(other, begun);
    bench.session.restore_identity(known);
    bench.until("its mode", 2_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(200 * MILLIS);
    assert!(bench.received.iter().filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
    // They begin in the same way, and mean something else: its status tells.
    let mut other =
        sensor_with(machine::Settings { baud: Baud::B500000, mode: Mode(4), ..machine::Settings::default() });
    let begun = make_stream(&mut other);
    let mut bench = Bench::new(other, begun);
    bench.session.restore_identity(known);
    bench.until("its mode", 600 * MILLIS, |bench| bench.session.sensor().mode == Some(Mode(4)));
    // Nobody streams: what was known is not known any more once somebody answers.
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.session.restore_identity(known);
    bench.until("an answer", 4_000 * MILLIS, |bench| !bench.received.is_empty());
    assert_eq!(bench.session.sensor().kind(), b"");
}

#[test]
fn another_one_is_not_taken_for_the_first() {
    for resync in [false, true] {
        let mut bench = Bench::new(sensor(Baud::B500000), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.sensor().mode, Some(Mode(1)));
        // It streams as the first one did, but what its values mean is something else.
        let mut other = sensor_with(machine::Settings {
            baud: Baud::B500000,
            start: Start::In(Operating::All),
            mode: Mode(4),
            type_name: "LMS291;S05063;V02.30 ".into(),
            ..machine::Settings::default()
        });
        let now = bench.now;
        let back = now + if resync { 300 * MILLIS } else { 1_050 * MILLIS };
        bench.to_host = Box::new(move |at, bytes| if at < back { Vec::new() } else { bytes });
        bench.run(back - now);
        while other.poll_timeout().is_some_and(|at| at < back) {
            while other.poll_transmit(back).is_some() {}
        }
        bench.machine = other;
        if resync {
            bench.session.control(Control::Resync, bench.now);
        }
        let since = bench.now;
        bench.states.clear();
        bench.until("streaming", 3_000 * MILLIS, |bench| bench.received_scans(since).len() > 4);
        let known = bench.session.sensor();
        assert_eq!((known.mode, known.kind()), (Some(Mode(4)), &b"LMS291;S05063;V02.30"[..]), "{bench}");
        let told = bench.received.iter().filter(|got| got.at > since);
        assert!(told.filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
        assert!(!bench.states.contains(&State::Starting), "it was adopted: {bench}");
    }
}
