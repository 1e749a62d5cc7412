//! How often the host looks at the line, and how soon it has what it waits for: once a session has learned how long a
//! telegram takes, it lets it come, and is there when it ends.

use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_schema::{MICROS, MILLIS};
use scanhub_sim::ChunkSize;
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;

use super::bench::{Bench, Received, Sent, make_stream, sensor};

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
    // The first questions are overlooked: how long a telegram takes is known by the time of the others.
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
