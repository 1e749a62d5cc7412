//! A sensor that some host left doing something else than sending whole scans, and what it tells once when asked.

use scanhub_drivers::lms::measured::Measured;
use scanhub_drivers::lms::telegram::{Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, MIRROR_TURN, Unit, Variant};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::Bench;
use super::fast;

/// What a sensor in `operating` sends within a second, with the times of the last bytes.
fn streamed(operating: Operating, settings: Settings) -> Vec<(Nanos, Vec<u8>)> {
    let code = operating.code();
    let mut bench = Bench::new(Settings { start: Start::In(operating), ..settings });
    bench.run_until(1_000 * MILLIS);
    let sent = bench.sent();
    assert!(sent.iter().all(|(_, sent)| !sent.is_reply && Telegram::check(&sent.telegram).is_some()));
    let status = bench.ask(&[0x02, 0, 1, 0, 0x31, 0x15, 0x12]);
    let at = status.windows(5).position(|five| five == [0x02, 0x80, 0x9A, 0, 0xB1]).expect("a status");
    assert_eq!(status[at + 12], code);
    sent.into_iter().map(|(at, sent)| (at, sent.telegram)).collect()
}

/// All of `telegrams` are as long, have this command, and come every so many mirror turns.
fn holds(telegrams: &[(Nanos, Vec<u8>)], command: u8, len: usize, turns: u64) {
    assert!(telegrams.len() > 3, "{}", telegrams.len());
    for pair in telegrams.windows(2) {
        assert_eq!((pair[0].1[4], pair[0].1.len()), (command, len));
        assert_eq!(pair[1].0 - pair[0].0, turns * MIRROR_TURN);
    }
}

#[test]
fn every_mode_streams_telegrams_of_its_own() {
    holds(&streamed(Operating::All, fast()), 0xB0, 732, 2);
    holds(&streamed(Operating::Means(5), fast()), 0xB6, 733, 10);
    holds(&streamed(Operating::Range(27, 299), fast()), 0xB7, 6 + 1 + 6 + 2 * 273 + 1, 2);
    holds(&streamed(Operating::MeanRange(2, 1, 181), fast()), 0xBF, 6 + 1 + 7 + 2 * 181 + 1, 4);
    holds(&streamed(Operating::Fields(1, 100), fast()), 0xBE, 814, 2);
    holds(&streamed(Operating::Reflectivity(vec![(1, 181)]), fast()), 0xF5, 740, 2);
    assert!(streamed(Operating::OnRequest, fast()).is_empty());
    assert!(streamed(Operating::Installation, fast()).is_empty());
}

#[test]
fn partial_scans_take_turns() {
    for (variant, quarters) in
        [(Variant::ALL[0], &[0u8][..]), (Variant::HALF, &[0, 2]), (Variant::ALL[4], &[0, 1, 2, 3])]
    {
        let telegrams = streamed(Operating::Partial, Settings { variant, ..fast() });
        for (number, (_, telegram)) in telegrams.iter().enumerate() {
            let measured = Measured::decode(Telegram::check(telegram).unwrap()).expect("values");
            let quarter = quarters[number % quarters.len()];
            assert_eq!(measured.partial(), Some(quarter));
            assert_eq!(measured.count(), if quarter == 0 { 181 } else { 180 });
        }
        assert!(telegrams.windows(2).all(|pair| (pair[1].0 - pair[0].0).abs_diff(MIRROR_TURN) <= 40_000));
    }
}

#[test]
fn partial_scans_begin_with_the_first() {
    let mut bench = Bench::new(fast());
    bench.ask(Writer::new(0, 0x30).byte(1).finish().bytes());
    bench.ask(Writer::new(0, 0x20).byte(0x2A).finish().bytes());
    let sent = bench.sent();
    let quarters = sent[2..4].iter().map(|(_, sent)| {
        Measured::decode(Telegram::check(&sent.telegram).unwrap()).and_then(|measured| measured.partial())
    });
    assert_eq!(quarters.collect::<Vec<_>>(), [Some(0), Some(2)]);
}

#[test]
fn indices_count_mirror_turns_and_telegrams() {
    let settings = Settings { availability: 2, baud: Baud::B38400, ..fast() };
    let telegrams = streamed(Operating::All, settings);
    assert!(telegrams.iter().all(|(_, telegram)| telegram.len() == 734));
    let indices: Vec<(u8, u8)> = telegrams
        .iter()
        .map(|(_, telegram)| Measured::decode(Telegram::check(telegram).unwrap()).unwrap().indices().unwrap())
        .collect();
    for pair in indices.windows(2) {
        assert_eq!(pair[1].1, pair[0].1 + 1);
        assert_eq!(pair[1].0.wrapping_sub(pair[0].0), 16, "8 scans of 2 turns each");
    }
}

#[test]
fn one_telegram_may_be_asked_for() {
    let mut bench = Bench::new(Settings { unit: Unit::Cm, ..fast() });
    for (request, command, len) in [
        (Writer::new(0, 0x30).byte(1), 0xB0, 732),
        (Writer::new(0, 0x30).byte(8), 0xB0, 372),
        (Writer::new(0, 0x36).byte(3), 0xB6, 733),
        (Writer::new(0, 0x37).word(1).word(361), 0xB7, 736),
        (Writer::new(0, 0x75).word(1).word(1).word(10), 0xF5, 56),
        (Writer::new(0, 0x75).byte(1).word(1).word(10), 0x92, 8),
        (Writer::new(0, 0x37).word(1).word(362), 0x92, 8),
        (Writer::new(0, 0x3E).word(1).word(101), 0x92, 8),
        (Writer::new(0, 0x75).word(1).word(1).word(361), 0x92, 8),
    ] {
        let answer = bench.ask(request.finish().bytes());
        assert_eq!((answer[5], answer.len() - 1), (command, len));
    }
    // An LMS 211 sees no more than 100 degrees.
    let type_name = "LMS211;301063;V02.30 ".into();
    let mut bench = Bench::new(Settings { type_name, variant: Variant::ALL[3], ..fast() });
    let kept = bench.ask(Writer::new(0, 0x3B).word(180).word(50).finish().bytes());
    assert_eq!(kept[5..11], [0xBB, 0, 100, 0, 50, 0]);
}
