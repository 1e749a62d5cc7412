//! Losses and delays of the line and the host. The session delivers intact telegrams and counts losses. Its stamps are
//! right even if the host did not run for a while, or reads only when a telegram is due.

use scanhub_drivers::line::{Control, Session as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_schema::{MICROS, MILLIS, Nanos};
use scanhub_sim::ChunkSize;
use scanhub_sim::fault::{Faults, Loss};
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;

use super::{Bench, Received, Sent, WANTED, make_stream, sensor};

/// Runs with these losses, and compares the received telegrams with the intact ones that were sent.
fn delivered(faults: Faults, seed: u64, span: Nanos) -> (usize, usize) {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let begun = bench.now;
    let mut loss = Loss::new(faults, seed);
    bench.to_host = Box::new(move |at, mut bytes| {
        if at < begun + span {
            loss.apply(&mut bytes);
        }
        bytes
    });
    bench.run(span);
    // Telegrams that were held back after damage are released after some intact ones, and the last one after a pause.
    bench.run(200 * MILLIS);
    bench.to_host = Box::new(|_, _| Vec::new());
    bench.run(60 * MILLIS);
    let (intact, scans) = (bench.intact_scans(begun), bench.received_scans(begun));
    assert!(scans == intact, "{} received, {} intact: {bench}", scans.len(), intact.len());
    let sent = bench.sent.iter().filter(|sent| sent.at > begun && !sent.is_reply).count();
    assert_eq!(bench.session.account().resyncs, 0);
    (sent, intact.len())
}

#[test]
fn the_losses_of_the_paper_cost_only_what_they_damage() {
    for seed in 1..=4 {
        let (sent, intact) =
            delivered(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, seed, 30_000 * MILLIS);
        let share = 1.0 - intact as f64 / sent as f64;
        assert!(sent > 1100 && (0.33..0.47).contains(&share), "{share} of {sent} were damaged");
    }
}

#[test]
fn long_bursts_and_single_bytes_too() {
    for (loss, burst) in [(0.0005, 1.0), (0.002, 3.34), (0.02, 200.0), (0.1, 1000.0)] {
        let (sent, intact) = delivered(Faults { loss, burst, ..Faults::default() }, 9, 20_000 * MILLIS);
        assert!(intact > 0 && intact < sent, "{loss} {burst}: {intact} of {sent}");
    }
}

/// A stream whose questions are all answered.
fn streaming(baud: Baud) -> Bench {
    let mut bench = Bench::wanting(lms::Settings { baud, ..WANTED }, sensor(baud), 0);
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
    // The slower line would treat more in a row as a silence.
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
    // A silence of more than a second does not count as a loss.
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

/// Returns a bench that has streamed for some seconds, and the time of a scan from its first to its last byte.
fn streaming_variant(baud: Baud, variant: Variant) -> (Bench, Nanos) {
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

/// Returns the time at which the last byte of `telegram` left the line.
fn sent_at(bench: &Bench, telegram: &[u8]) -> Option<Nanos> {
    bench.sent.iter().rev().find(|sent| sent.telegram == telegram).map(|sent| sent.at)
}

/// Returns the errors of the stamps of scans that arrived after `since`, and whether they are estimates.
fn errors(bench: &Bench, since: Nanos, took: Nanos) -> Vec<(Nanos, bool)> {
    let scans = bench.received.iter().filter(|got| got.at > since && got.telegram.len() > 300);
    let error = |got: &super::Received| {
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
        let (mut bench, took) = streaming_variant(baud, variant);
        let mut all = Vec::new();
        for span in [300, 700, 1_300, 3_000] {
            let stopped = bench.now;
            bench.stop(span * MILLIS + 7 * MILLIS);
            bench.run(2_000 * MILLIS);
            let errors = errors(&bench, stopped, took);
            assert!(errors.len() as u64 * 1_000 > span, "{} scans", errors.len());
            // No byte was lost, so all stamps are right, with or without the mark of an estimate.
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
        let (mut bench, took) = streaming_variant(Baud::B500000, Variant::HALF);
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
    let (mut bench, _) = streaming_variant(Baud::B500000, Variant::HALF);
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

/// Whether the end of a telegram could be the beginning of the next one: such a telegram is held until the line is
/// idle (framing, rule 4).
fn is_held(telegram: &[u8]) -> bool {
    (1..=6).any(|len| telegram.ends_with(&telegram[..len]))
}

#[test]
fn a_telegram_is_there_soon_after_its_last_byte() {
    for chunk in [ChunkSize::Uart, ChunkSize::Usb] {
        for variant in [Variant::HALF, Variant::ALL[0]] {
            let settings = Settings { baud: Baud::B500000, variant, chunk, ..Settings::default() };
            let machine = LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 5)));
            let mut bench = Bench::new(machine, 0);
            bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run(20_000 * MILLIS);
            let scans: Vec<_> = bench.received.iter().filter(|got| got.telegram.len() > 300).collect();
            let sent: Vec<_> = bench.sent.iter().filter(|sent| !sent.is_reply).collect();
            let pairs: Vec<(&&Received, &&Sent)> = scans.iter().zip(&sent).skip(LESSONS).collect();
            assert!(pairs.len() > 600 && pairs.iter().all(|(got, sent)| got.telegram == sent.telegram));
            let late = |(got, sent): &(&&Received, &&Sent)| got.at - sent.at;
            let prompt: Vec<_> = pairs.iter().filter(|(_, sent)| !is_held(&sent.telegram)).collect();
            assert!(prompt.len() * 10 > pairs.len() * 9);
            let latest = prompt.iter().copied().map(late).max().unwrap_or_default();
            assert!(latest <= 1_500 * MICROS, "{variant:?} {chunk:?}: {latest} ns");
            let latest = pairs.iter().map(late).max().unwrap_or_default();
            assert!(latest <= 3_500 * MICROS, "{variant:?} {chunk:?}: {latest} ns for one that was held");
            let most = prompt.iter().map(|(got, _)| got.looks).max().unwrap_or_default();
            assert!((1..=6).contains(&most), "{variant:?} {chunk:?}: {most} looks for a telegram");
        }
    }
}

/// Telegrams that are read as they come, before the first rest.
const LESSONS: usize = 6;

#[test]
fn what_a_killed_host_would_lose_is_not_read_before_it_is_nearly_complete() {
    let settings = Settings { baud: Baud::B500000, ..Settings::default() };
    let machine = LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 5)));
    let mut bench = Bench::new(machine, 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let looks = 2_000;
    let mut exposed = 0;
    for _ in 0..looks {
        bench.run(MILLIS - MILLIS / 7);
        exposed += u32::from(bench.session.account().buffered > 0);
    }
    // 0.6 ms and a chunk of every 26.64.
    assert!(exposed * 100 < looks * 6, "{exposed} of {looks}");
}

#[test]
fn what_is_asked_of_a_running_stream_is_heard_as_soon_as_it_is_answered() {
    let mut machine = sensor(Baud::B500000);
    let now = make_stream(&mut machine);
    let mut bench = Bench::new(machine, now);
    // The scanner overlooks the first requests. The session knows the duration of a telegram by the time of the
    // others.
    bench.to_sensor = Box::new(|number, byte| (number >= 60).then_some(byte));
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(3_000 * MILLIS);
    let replies: Vec<_> = bench.sent.iter().filter(|sent| sent.is_reply && sent.at > now).collect();
    assert!(!replies.is_empty());
    for reply in replies {
        let mut same =
            bench.received.iter().filter(|got| got.telegram == reply.telegram && got.at >= reply.at);
        let heard = same.next().expect("it was delivered").at;
        assert!(heard < reply.at + 2 * MILLIS, "{} us late", (heard - reply.at) / MICROS);
    }
}
