//! A host that does not run for a while: what waited for it is dated by the beat of the stream, not by when it was read.

use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_schema::{MICROS, MILLIS, Nanos};
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;

use super::bench::{Bench, WANTED};

/// A stream that has gone on for some seconds, and how long its scans take from the first byte to the last.
fn streaming(baud: Baud, variant: Variant) -> (Bench, Nanos) {
    let settings = Settings { baud, variant, ..Settings::default() };
    let machine = LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 5)));
    let mut bench = Bench::wanting(lms::Settings { baud, variant, ..WANTED }, machine, 0);
    bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(10_000 * MILLIS);
    let took = |bench: &Bench| {
        let got = bench.received.iter().rev().take(8).filter(|got| !got.estimated);
        got.filter_map(|got| Some(sent_at(bench, &got.telegram)? - got.first)).max()
    };
    let took = took(&bench).expect("stamps that are no estimates");
    (bench, took)
}

/// When the last byte of `telegram` was through.
fn sent_at(bench: &Bench, telegram: &[u8]) -> Option<Nanos> {
    bench.sent.iter().rev().find(|sent| sent.telegram == telegram).map(|sent| sent.at)
}

/// How far the stamps of scans that came since `since` are from the truth, and whether they are estimates.
fn errors(bench: &Bench, since: Nanos, took: Nanos) -> Vec<(Nanos, bool)> {
    let scans = bench.received.iter().filter(|got| got.at > since && got.telegram.len() > 300);
    let error = |got: &super::bench::Received| {
        let begun = sent_at(bench, &got.telegram).expect("it was sent") - took;
        (got.first.abs_diff(begun), got.estimated)
    };
    scans.map(error).collect()
}

fn median(mut values: Vec<Nanos>) -> Nanos {
    values.sort_unstable();
    values[values.len() / 2]
}

#[test]
fn what_waited_is_dated_by_its_place_among_what_waited() {
    for (baud, variant) in
        [(Baud::B500000, Variant::HALF), (Baud::B500000, Variant::ALL[0]), (Baud::B38400, Variant::HALF)]
    {
        let (mut bench, took) = streaming(baud, variant);
        let mut all = Vec::new();
        for span in [300, 700, 1_300, 3_000] {
            let stopped = bench.now;
            bench.stop(span * MILLIS + 7 * MILLIS);
            bench.run(2_000 * MILLIS);
            let errors = errors(&bench, stopped, took);
            assert!(errors.len() as u64 * 1_000 > span, "{} scans", errors.len());
            // Nothing was lost: all of them are right, whether they are told to be estimates or not.
            let most = errors.iter().map(|(error, _)| *error).max();
            assert!(most <= Some(5 * MILLIS), "{baud:?} {variant:?} {span} ms: {most:?}");
            all.extend(errors.into_iter().filter(|(_, estimated)| *estimated).map(|(error, _)| error));
        }
        let (count, median) = (all.len(), median(all));
        println!("{baud:?} {variant:?}: {count} that waited, median error {} us", median / MICROS);
        assert!(count > 15 && median < MILLIS, "{count} {median}");
        assert_eq!((bench.session.account().resyncs, bench.session.account().lost), (0, 0));
    }
}

#[test]
fn where_the_buffer_was_full_a_stamp_is_right_or_says_that_it_is_none() {
    for room in [4_096, 65_536] {
        let (mut bench, took) = streaming(Baud::B500000, Variant::HALF);
        bench.room = room;
        for span in (300..=3_000).step_by(330) {
            let stopped = bench.now;
            bench.stop(span * MILLIS);
            bench.run(2_000 * MILLIS);
            for (error, estimated) in errors(&bench, stopped, took) {
                assert!(estimated || error <= 5 * MILLIS, "{room} {span} ms: {error}");
            }
            let stamps: Vec<Nanos> = bench.received.iter().map(|got| got.first).collect();
            assert!(stamps.is_sorted(), "stamps run backwards");
        }
        bench.run(2_000 * MILLIS);
        let lost = bench.sent.iter().filter(|sent| sent.damaged && !sent.is_reply && !sent.aborted).count();
        let counted = bench.session.account().lost;
        assert!(counted.abs_diff(lost as u64) <= 2, "{counted} of {lost} with room for {room}");
    }
}

#[test]
fn what_waited_while_a_host_between_two_telegrams_was_stopped_is_no_newer_than_it_is() {
    let (mut bench, _) = streaming(Baud::B500000, Variant::HALF);
    for _ in 0..20 {
        bench.run(100 * MILLIS);
        while !bench.session.can_defer_read() {
            bench.run(MILLIS);
        }
        let stopped = bench.now;
        // As much as a tty has room for.
        bench.stop(140 * MILLIS);
        let continued = bench.now;
        bench.run(5 * MILLIS);
        let waited: Vec<_> = bench.received.iter().filter(|got| got.at >= stopped).collect();
        assert!(waited.len() >= 4, "{} telegrams", waited.len());
        for got in waited.into_iter().filter(|got| got.at < continued + 2 * MILLIS) {
            let sent =
                bench.sent.iter().rev().find(|sent| sent.telegram == got.telegram).expect("it was sent");
            assert!((stopped..sent.at).contains(&got.first), "{} was sent by {}", got.first, sent.at);
        }
    }
}
