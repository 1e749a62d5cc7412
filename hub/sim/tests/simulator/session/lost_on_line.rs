//! How much of a stream the line loses, as a session finds out from when scans come, beside what was really sent.

use scanhub_drivers::line::{Control, Session as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::{Faults, Loss};

use super::bench::{Bench, sensor};

/// A stream whose questions are all answered.
fn streaming(baud: Baud) -> Bench {
    let mut bench = Bench::wanting(lms::Settings { baud, ..super::bench::WANTED }, sensor(baud), 0);
    bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(3_000 * MILLIS);
    bench
}

/// Scans that were sent after `since`, and those of them that the line damaged.
fn truth(bench: &Bench, since: Nanos) -> (u64, u64) {
    let scans = || bench.sent.iter().filter(|sent| sent.at > since && !sent.is_reply && !sent.aborted);
    (scans().count() as u64, scans().filter(|sent| sent.damaged).count() as u64)
}

#[test]
fn ten_minutes_of_the_bursts_of_the_paper() {
    let mut bench = streaming(Baud::B500000);
    let begun = bench.now;
    let mut loss = Loss::new(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, 3);
    bench.to_host = Box::new(move |_, mut bytes| {
        loss.apply(&mut bytes);
        bytes
    });
    bench.run(600_000 * MILLIS);
    let (sent, lost) = truth(&bench, begun);
    let counted = bench.session.account().lost;
    println!("{lost} of {sent} lost, {counted} counted, {} due", bench.session.account().due);
    assert!(sent > 20_000 && lost * 10 > sent * 3);
    assert!(counted.abs_diff(lost) * 100 <= sent, "{counted} instead of {lost} of {sent}: {bench}");
    assert_eq!(bench.session.account().resyncs, 0);
    let tally = bench.session.tally();
    let share = bench.session.account().damaged as f64 / tally.read as f64;
    assert!((0.3..0.5).contains(&share), "{share} of the bytes");
}

#[test]
fn slower_lines_lose_what_they_lose() {
    // More than that in a row, and the slower one would take it for a silence.
    for (baud, loss, minutes) in [(Baud::B38400, 0.0003, 10), (Baud::B9600, 0.00008, 40)] {
        let mut bench = streaming(baud);
        let begun = bench.now;
        let mut loss = Loss::new(Faults { loss, ..Faults::default() }, 7);
        bench.to_host = Box::new(move |_, mut bytes| {
            loss.apply(&mut bytes);
            bytes
        });
        bench.run(minutes * 60_000 * MILLIS);
        let ((sent, lost), counted) = (truth(&bench, begun), bench.session.account().lost);
        println!("{baud:?}: {counted} of {lost} of {sent}");
        assert!(
            lost > 100 && counted.abs_diff(lost) * 100 <= sent,
            "{baud:?}: {counted} of {lost} of {sent}"
        );
    }
}

#[test]
fn a_line_that_is_well_has_lost_nothing_whatever_is_asked_of_its_sensor() {
    let mut bench = streaming(Baud::B500000);
    let well = |bench: &Bench| (bench.session.account().lost, bench.session.account().damaged) == (0, 0);
    assert!(bench.session.account().due > 60 && well(&bench), "{bench}");
    for control in [Control::Pause, Control::Resume, Control::Resync] {
        bench.session.control(control, bench.now);
        bench.run(5_000 * MILLIS);
        assert!(well(&bench), "{control:?}: {bench}");
    }
    assert!(bench.is_streaming(), "{bench}");
    // A sensor that is silent for longer than a second is no line that loses.
    bench.to_host = Box::new(|_, _| Vec::new());
    bench.run(10_000 * MILLIS);
    bench.to_host = Box::new(|_, bytes| bytes);
    bench.until("streaming", 10_000 * MILLIS, Bench::is_streaming);
    bench.run(5_000 * MILLIS);
    assert!(well(&bench), "{bench}");
    // One telegram less.
    let (begun, due) = (bench.now, bench.session.account().due);
    bench.to_host = Box::new(move |at, bytes| if at < begun + 27 * MILLIS { Vec::new() } else { bytes });
    bench.run(5_000 * MILLIS);
    assert!((1..=2).contains(&bench.session.account().lost), "{}", bench.session.account().lost);
    assert!((185..190).contains(&(bench.session.account().due - due)));
}
