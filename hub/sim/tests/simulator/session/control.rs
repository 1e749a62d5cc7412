//! Tests of the requests of a user to a running session: pause, resume and resync.

use scanhub_drivers::line::{Control, ScannerSession as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Problem;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::operating::OperatingMode;

use super::{Bench, make_stream, sensor};

impl Bench {
    fn control(&mut self, control: Control) {
        self.session.control(control, self.now);
    }
}

/// Returns the number of telegrams that the scanner sent after `since`.
fn bytes_sent_since(bench: &Bench, since: Nanos) -> usize {
    bench.sent.iter().filter(|sent| sent.at > since).count()
}

#[test]
fn pause_stops_the_stream_and_a_resume_starts_it() {
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    for round in 1..4 {
        bench.control(Control::Pause);
        bench.control(Control::Pause);
        bench.run(200 * MILLIS);
        let (quiet, sent_count) = (bench.now, bench.sent_bytes.len());
        bench.run(20_000 * MILLIS);
        assert_eq!((bench.session.state(), bench.sent_bytes.len()), (State::Paused, sent_count), "{bench}");
        assert_eq!(bytes_sent_since(&bench, quiet), 0, "the scanner still streams: {bench}");
        assert_eq!((bench.session.problem(), bench.session.stats().resyncs), (None, 0));
        bench.control(Control::Resume);
        bench.control(Control::Resume);
        bench.run_until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        bench.run(200 * MILLIS);
        assert!(bench.is_streaming(), "{round}: {bench}");
    }
    // The session delivered all scans except those that the three stops aborted.
    let mut intact = bench.intact_scans(0);
    intact.truncate(bench.received_scans(0).len());
    assert_eq!(bench.received_scans(0), intact, "{bench}");
}

#[test]
fn pause_works_at_any_time() {
    for baud in [Baud::B9600, Baud::B38400, Baud::B500000] {
        for streams in [false, true] {
            for at in 0..60 {
                let mut machine = sensor(baud);
                let started = if streams { make_stream(&mut machine) } else { 0 };
                let mut bench = Bench::new(machine, started);
                bench.run(at * 23 * MILLIS);
                bench.control(Control::Pause);
                assert_eq!(bench.session.state(), State::Paused);
                bench.run(5_000 * MILLIS);
                let (quiet, sent_count) = (bench.now, bench.sent_bytes.len());
                bench.run(2_000 * MILLIS);
                assert_eq!(
                    (bench.session.state(), bench.sent_bytes.len()),
                    (State::Paused, sent_count),
                    "{bench}"
                );
                assert_eq!(bytes_sent_since(&bench, quiet), 0, "{at}: the scanner still streams: {bench}");
                assert_eq!(bench.machine.operating(), &OperatingMode::OnRequest, "{at}: {bench}");
                assert_eq!(bench.session.problem(), None, "{at}: {bench}");
                bench.control(Control::Resume);
                bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
                bench.run(200 * MILLIS);
                assert!(bench.is_streaming() && bench.session.problem().is_none(), "{at}: {bench}");
            }
        }
    }
}

#[test]
fn paused_session_sends_nothing_to_absent_scanner() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.to_scanner = Box::new(|_, _| None);
    bench.control(Control::Pause);
    bench.run(10_000 * MILLIS);
    let sent_count = bench.sent_bytes.len();
    assert!(sent_count <= 8 * 8, "{sent_count} bytes were sent to a line without a scanner");
    bench.run(60_000 * MILLIS);
    assert_eq!((bench.session.state(), bench.sent_bytes.len()), (State::Paused, sent_count));
    assert_eq!(bench.session.problem(), None);
    // The session does not count the duration of the pause as time without a reply.
    bench.control(Control::Resume);
    bench.run_until("reported", 3_000 * MILLIS, |bench| bench.session.problem().is_some());
    assert!(matches!(bench.session.problem(), Some(Problem::NoReply { seconds: 0..=3, .. })), "{bench}");
}

#[test]
fn stream_at_another_rate_is_reported_as_not_stopped() {
    let mut machine = sensor(Baud::B38400);
    let started = make_stream(&mut machine);
    let mut bench = Bench::new(machine, started);
    bench.to_scanner = Box::new(|_, _| None);
    bench.run(300 * MILLIS);
    bench.control(Control::Pause);
    bench.run(20_000 * MILLIS);
    let sent_count = bench.sent_bytes.len();
    bench.run(60_000 * MILLIS);
    assert_eq!((bench.session.state(), bench.sent_bytes.len()), (State::Paused, sent_count));
    assert_eq!(bench.session.problem(), Some(Problem::NotStopped), "{bench}");
}

#[test]
fn delivers_unstoppable_stream_and_limits_stops() {
    let mut machine = sensor(Baud::B500000);
    let started = make_stream(&mut machine);
    let mut bench = Bench::new(machine, started);
    bench.run_until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(300 * MILLIS);
    // The line loses all bytes to the scanner, but carries the bytes from the scanner.
    bench.to_scanner = Box::new(|_, _| None);
    let paused = bench.now;
    bench.control(Control::Pause);
    bench.run(30_000 * MILLIS);
    let sent_count = bench.sent_bytes.len();
    bench.run(10_000 * MILLIS);
    assert_eq!((bench.session.state(), bench.sent_bytes.len()), (State::Paused, sent_count), "{bench}");
    assert_eq!(bench.session.problem(), Some(Problem::NotStopped), "{bench}");
    let mut intact = bench.intact_scans(paused);
    assert!(intact.len() > 1400);
    intact.truncate(bench.received_scans(paused).len());
    assert_eq!(bench.received_scans(paused), intact);
    bench.control(Control::Resume);
    bench.run_until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(5_000 * MILLIS);
    // The session repeats its requests no more often than with any other scanner that does not reply.
    assert!(bench.is_streaming() && bench.sent_bytes.len() <= sent_count + 15 * 7, "{bench}");
}

#[test]
fn resync_restarts_and_is_counted() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let (sent_count, started) = (bench.sent_bytes.len(), bench.now);
    bench.control(Control::Resync);
    assert_eq!((bench.session.state(), bench.session.stats().resyncs), (State::Probing, 1));
    bench.run_until("streaming", 60 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert_eq!(bench.sent_bytes.len(), sent_count + 2 * 7, "a stream that is taken over needs two requests");
    let mut intact = bench.intact_scans(started);
    intact.truncate(bench.received_scans(started).len());
    assert_eq!(bench.received_scans(started), intact, "{bench}");
    // A resync is also possible during a pause.
    bench.control(Control::Pause);
    bench.run(500 * MILLIS);
    bench.control(Control::Resync);
    bench.run_until("streaming", 2_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.stats().resyncs, 2);
}

#[test]
fn recording_ignores_control_requests() {
    let settings = lms::Settings { listen_only: true, ..super::SESSION_SETTINGS };
    let mut machine = sensor(Baud::B500000);
    let started = make_stream(&mut machine);
    let mut bench = Bench::with_settings(settings, machine, started);
    for control in [Control::Pause, Control::Resume, Control::Resync] {
        bench.control(control);
        bench.run(200 * MILLIS);
        assert_eq!((bench.session.state(), bench.session.stats().resyncs), (State::Streaming, 0));
    }
    assert!(bench.sent_bytes.is_empty());
}
