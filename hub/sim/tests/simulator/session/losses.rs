//! Tests of losses on the line, and of delays of the host. The session delivers intact telegrams and counts losses. The
//! stamps are right even if the host did not run for a while, or if it reads only when a telegram is due.

use scanhub_drivers::line::{Control, ScannerSession as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_schema::{MICROS, MILLIS, Nanos};
use scanhub_sim::ChunkSize;
use scanhub_sim::fault::{Faults, Loss};
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::ScanSource;
use scanhub_sim::room::Room;

use super::{Bench, ReceivedTelegram, SESSION_SETTINGS, SentTelegram, make_stream, sensor};

/// Runs with the losses of `faults`, and checks that the session delivers exactly the scans that arrived intact.
fn run_with_losses(faults: Faults, seed: u64, span: Nanos) -> (usize, usize) {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let started = bench.now;
    let mut loss = Loss::new(faults, seed);
    bench.to_host = Box::new(move |at, mut bytes| {
        if at < started + span {
            loss.apply(&mut bytes);
        }
        bytes
    });
    bench.run(span);
    // After damage, the session holds telegrams back until some intact telegrams have followed. It releases the last
    // telegram after a pause.
    bench.run(200 * MILLIS);
    bench.to_host = Box::new(|_, _| Vec::new());
    bench.run(60 * MILLIS);
    let (intact, scans) = (bench.intact_scans(started), bench.received_scans(started));
    assert!(scans == intact, "{} received, {} intact: {bench}", scans.len(), intact.len());
    let sent = bench.sent.iter().filter(|sent| sent.at > started && !sent.is_reply).count();
    assert_eq!(bench.session.stats().resyncs, 0);
    (sent, intact.len())
}

#[test]
fn losses_as_in_the_paper_cost_only_damaged_scans() {
    for seed in 1..=4 {
        let (sent, intact) = run_with_losses(
            Faults { loss: 0.00135, burst: 1.89, ..Faults::default() },
            seed,
            30_000 * MILLIS,
        );
        let share = 1.0 - intact as f64 / sent as f64;
        assert!(sent > 1100 && (0.33..0.47).contains(&share), "{share} of {sent} were damaged");
    }
}

#[test]
fn long_and_single_losses_cost_only_some_scans() {
    for (loss, burst) in [(0.0005, 1.0), (0.002, 3.34), (0.02, 200.0), (0.1, 1000.0)] {
        let (sent, intact) = run_with_losses(Faults { loss, burst, ..Faults::default() }, 9, 20_000 * MILLIS);
        assert!(intact > 0 && intact < sent, "{loss} {burst}: {intact} of {sent}");
    }
}

/// Returns a bench whose session streams and has received the replies to all its requests.
fn streaming(baud: Baud) -> Bench {
    let mut bench = Bench::with_settings(lms::Settings { baud, ..SESSION_SETTINGS }, sensor(baud), 0);
    bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(3_000 * MILLIS);
    bench
}

/// Returns the number of scans that the scanner sent after `since`, and how many of them the line damaged.
fn sent_and_damaged(bench: &Bench, since: Nanos) -> (u64, u64) {
    let scans = || bench.sent.iter().filter(|sent| sent.at > since && !sent.is_reply && !sent.aborted);
    (scans().count() as u64, scans().filter(|sent| sent.damaged).count() as u64)
}

#[test]
fn counts_lost_scans_over_ten_minutes_of_bursts() {
    let mut bench = streaming(Baud::B500000);
    let started = bench.now;
    let mut loss = Loss::new(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, 3);
    bench.to_host = Box::new(move |_, mut bytes| {
        loss.apply(&mut bytes);
        bytes
    });
    bench.run(600_000 * MILLIS);
    let (sent, lost) = sent_and_damaged(&bench, started);
    let counted = bench.session.stats().lost;
    println!("{lost} of {sent} lost, {counted} counted, {} due", bench.session.stats().due);
    assert!(sent > 20_000 && lost * 10 > sent * 3);
    assert!(counted.abs_diff(lost) * 100 <= sent, "{counted} instead of {lost} of {sent}: {bench}");
    assert_eq!(bench.session.stats().resyncs, 0);
    let tally = bench.session.framer_counters();
    let share = bench.session.stats().damaged as f64 / tally.read as f64;
    assert!((0.3..0.5).contains(&share), "{share} of the bytes");
}

#[test]
fn counts_lost_scans_at_slower_rates() {
    // At the lower rate, the share of lost bytes is lower. With the same share, more scans in a row would be lost, and
    // the session would handle them as a silence.
    for (baud, loss, minutes) in [(Baud::B38400, 0.0003, 10), (Baud::B9600, 0.00008, 40)] {
        let mut bench = streaming(baud);
        let started = bench.now;
        let mut loss = Loss::new(Faults { loss, ..Faults::default() }, 7);
        bench.to_host = Box::new(move |_, mut bytes| {
            loss.apply(&mut bytes);
            bytes
        });
        bench.run(minutes * 60_000 * MILLIS);
        let ((sent, lost), counted) = (sent_and_damaged(&bench, started), bench.session.stats().lost);
        println!("{baud:?}: {counted} of {lost} of {sent}");
        assert!(
            lost > 100 && counted.abs_diff(lost) * 100 <= sent,
            "{baud:?}: {counted} of {lost} of {sent}"
        );
    }
}

#[test]
fn control_requests_and_silence_count_no_loss() {
    let mut bench = streaming(Baud::B500000);
    let well = |bench: &Bench| (bench.session.stats().lost, bench.session.stats().damaged) == (0, 0);
    assert!(bench.session.stats().due > 60 && well(&bench), "{bench}");
    for control in [Control::Pause, Control::Resume, Control::Resync] {
        bench.session.control(control, bench.now);
        bench.run(5_000 * MILLIS);
        assert!(well(&bench), "{control:?}: {bench}");
    }
    assert!(bench.is_streaming(), "{bench}");
    // The session does not count scans as lost during a silence of more than a second.
    bench.to_host = Box::new(|_, _| Vec::new());
    bench.run(10_000 * MILLIS);
    bench.to_host = Box::new(|_, bytes| bytes);
    bench.run_until("streaming", 10_000 * MILLIS, Bench::is_streaming);
    bench.run(5_000 * MILLIS);
    assert!(well(&bench), "{bench}");
    // The line loses one telegram.
    let (started, due) = (bench.now, bench.session.stats().due);
    bench.to_host = Box::new(move |at, bytes| if at < started + 27 * MILLIS { Vec::new() } else { bytes });
    bench.run(5_000 * MILLIS);
    assert!((1..=2).contains(&bench.session.stats().lost), "{}", bench.session.stats().lost);
    assert!((185..190).contains(&(bench.session.stats().due - due)));
}

/// Returns a bench whose session has streamed for some seconds, and the time from the first to the last byte of a scan.
fn streaming_variant(baud: Baud, variant: Variant) -> (Bench, Nanos) {
    let settings = Settings { baud, variant, ..Settings::default() };
    let machine = LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 5)));
    let mut bench = Bench::with_settings(lms::Settings { baud, variant, ..SESSION_SETTINGS }, machine, 0);
    bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
    bench.run(10_000 * MILLIS);
    let scan_time_of = |bench: &Bench| {
        let got = bench.received.iter().rev().take(8).filter(|got| !got.estimated);
        got.filter_map(|got| Some(sent_at(bench, &got.telegram)? - got.first)).max()
    };
    let scan_time = scan_time_of(&bench).expect("stamps that are not estimates");
    (bench, scan_time)
}

/// Returns the time at which the line had carried the last byte of `telegram`, or `None` if the scanner did not send
/// this telegram.
fn sent_at(bench: &Bench, telegram: &[u8]) -> Option<Nanos> {
    bench.sent.iter().rev().find(|sent| sent.telegram == telegram).map(|sent| sent.at)
}

/// Returns the error of the stamp of each scan that arrived after `since`, and whether the stamp is marked as
/// estimated. The line carries a scan in `scan_time`.
fn errors(bench: &Bench, since: Nanos, scan_time: Nanos) -> Vec<(Nanos, bool)> {
    let scans = bench.received.iter().filter(|got| got.at > since && got.telegram.len() > 300);
    let error = |got: &super::ReceivedTelegram| {
        let started = sent_at(bench, &got.telegram).expect("it was sent") - scan_time;
        (got.first.abs_diff(started), got.estimated)
    };
    scans.map(error).collect()
}

fn median(mut values: Vec<Nanos>) -> Nanos {
    values.sort_unstable();
    values[values.len() / 2]
}

#[test]
fn stamps_of_backlogged_scans_are_within_5_ms() {
    for (baud, variant) in
        [(Baud::B500000, Variant::HALF), (Baud::B500000, Variant::ALL[0]), (Baud::B38400, Variant::HALF)]
    {
        let (mut bench, scan_time) = streaming_variant(baud, variant);
        let mut all = Vec::new();
        for span in [300, 700, 1_300, 3_000] {
            let stopped = bench.now;
            bench.stop_host(span * MILLIS + 7 * MILLIS);
            bench.run(2_000 * MILLIS);
            let errors = errors(&bench, stopped, scan_time);
            assert!(errors.len() as u64 * 1_000 > span, "{} scans", errors.len());
            // No byte was lost, so all stamps are right, whether they are marked as estimated or not.
            let maximum = errors.iter().map(|(error, _)| *error).max();
            assert!(maximum <= Some(5 * MILLIS), "{baud:?} {variant:?} {span} ms: {maximum:?}");
            all.extend(errors.into_iter().filter(|(_, estimated)| *estimated).map(|(error, _)| error));
        }
        let (count, median) = (all.len(), median(all));
        println!("{baud:?} {variant:?}: {count} backlogged scans, median error {} us", median / MICROS);
        assert!(count > 15 && median < MILLIS, "{count} {median}");
        assert_eq!((bench.session.stats().resyncs, bench.session.stats().lost), (0, 0));
    }
}

#[test]
fn stamps_after_overflow_are_right_or_estimated() {
    for room in [4_096, 65_536] {
        let (mut bench, scan_time) = streaming_variant(Baud::B500000, Variant::HALF);
        bench.buffer_len = room;
        for span in (300..=3_000).step_by(330) {
            let stopped = bench.now;
            bench.stop_host(span * MILLIS);
            bench.run(2_000 * MILLIS);
            for (error, estimated) in errors(&bench, stopped, scan_time) {
                assert!(estimated || error <= 5 * MILLIS, "{room} {span} ms: {error}");
            }
            let stamps: Vec<Nanos> = bench.received.iter().map(|got| got.first).collect();
            assert!(stamps.is_sorted(), "stamps decrease");
        }
        bench.run(2_000 * MILLIS);
        let lost = bench.sent.iter().filter(|sent| sent.damaged && !sent.is_reply && !sent.aborted).count();
        let counted = bench.session.stats().lost;
        assert!(counted.abs_diff(lost as u64) <= 2, "{counted} of {lost} with room for {room}");
    }
}

#[test]
fn stop_between_scans_does_not_stamp_backlog_as_new() {
    let (mut bench, _) = streaming_variant(Baud::B500000, Variant::HALF);
    for _ in 0..20 {
        bench.run(100 * MILLIS);
        while !bench.session.can_defer_read() {
            bench.run(MILLIS);
        }
        let stopped = bench.now;
        // Stop the host, but not so long that the buffer of a tty becomes full.
        bench.stop_host(140 * MILLIS);
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

/// Returns whether the end of `telegram` could be the start of another telegram. The framer holds such a telegram until
/// the line is idle (framing, rule 4).
fn is_held(telegram: &[u8]) -> bool {
    (1..=6).any(|len| telegram.ends_with(&telegram[..len]))
}

#[test]
fn telegram_is_delivered_soon_after_its_last_byte() {
    for chunk in [ChunkSize::Uart, ChunkSize::Usb] {
        for variant in [Variant::HALF, Variant::ALL[0]] {
            let settings = Settings { baud: Baud::B500000, variant, chunk, ..Settings::default() };
            let machine =
                LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 5)));
            let mut bench = Bench::new(machine, 0);
            bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run(20_000 * MILLIS);
            let scans: Vec<_> = bench.received.iter().filter(|got| got.telegram.len() > 300).collect();
            let sent: Vec<_> = bench.sent.iter().filter(|sent| !sent.is_reply).collect();
            let pairs: Vec<(&&ReceivedTelegram, &&SentTelegram)> =
                scans.iter().zip(&sent).skip(TELEGRAMS_BEFORE_TIMING).collect();
            assert!(pairs.len() > 600 && pairs.iter().all(|(got, sent)| got.telegram == sent.telegram));
            let late = |(got, sent): &(&&ReceivedTelegram, &&SentTelegram)| got.at - sent.at;
            let prompt: Vec<_> = pairs.iter().filter(|(_, sent)| !is_held(&sent.telegram)).collect();
            assert!(prompt.len() * 10 > pairs.len() * 9);
            let latest = prompt.iter().copied().map(late).max().unwrap_or_default();
            assert!(latest <= 1_500 * MICROS, "{variant:?} {chunk:?}: {latest} ns");
            let latest = pairs.iter().map(late).max().unwrap_or_default();
            assert!(
                latest <= 3_500 * MICROS,
                "{variant:?} {chunk:?}: {latest} ns for one that was held back"
            );
            let maximum = prompt.iter().map(|(got, _)| got.reads_since_last).max().unwrap_or_default();
            assert!((1..=6).contains(&maximum), "{variant:?} {chunk:?}: {maximum} reads for a telegram");
        }
    }
}

/// Number of telegrams at the start of a stream whose bytes the session reads as they arrive. Afterwards, it defers
/// reads until a telegram is due.
const TELEGRAMS_BEFORE_TIMING: usize = 6;

#[test]
fn reads_a_scan_only_when_it_is_nearly_complete() {
    let settings = Settings { baud: Baud::B500000, ..Settings::default() };
    let machine = LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 5)));
    let mut bench = Bench::new(machine, 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let polls = 2_000;
    let mut exposed = 0;
    for _ in 0..polls {
        bench.run(MILLIS - MILLIS / 7);
        exposed += u32::from(bench.session.stats().buffered > 0);
    }
    // In every period of 26.64 ms, the host polls the line only for 0.6 ms and for the duration of a chunk.
    assert!(exposed * 100 < polls * 6, "{exposed} of {polls}");
}

#[test]
fn replies_during_a_stream_are_received_within_2_ms() {
    let mut machine = sensor(Baud::B500000);
    let now = make_stream(&mut machine);
    let mut bench = Bench::new(machine, now);
    // The line loses the first requests. When the first reply arrives, the session has therefore already estimated the
    // duration of the stream's telegrams, and defers reads.
    bench.to_scanner = Box::new(|number, byte| (number >= 60).then_some(byte));
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(3_000 * MILLIS);
    let replies: Vec<_> = bench.sent.iter().filter(|sent| sent.is_reply && sent.at > now).collect();
    assert!(!replies.is_empty());
    for reply in replies {
        let mut same =
            bench.received.iter().filter(|got| got.telegram == reply.telegram && got.at >= reply.at);
        let received_at = same.next().expect("it was delivered").at;
        assert!(received_at < reply.at + 2 * MILLIS, "{} us late", (received_at - reply.at) / MICROS);
    }
}
