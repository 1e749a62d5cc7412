//! A sensor that overlooks requests, says NAK, answers late or twice, refuses: it streams all the same.

use scanhub_drivers::line::{Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Trouble;
use scanhub_drivers::lms::variant::{Baud, Mode, Variant};
use scanhub_schema::MILLIS;
use scanhub_sim::machine::{ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, WANTED, sensor_with};

/// Sensors with these quirks, idle and streaming at each rate, stream as wanted within `limit` ms.
fn all_stream(quirks: ProtocolQuirks, seeds: std::ops::Range<u64>, limit: u64) {
    let mut longest = 0;
    for seed in seeds {
        for baud in Baud::ALL {
            for operating in [Operating::OnRequest, Operating::All, Operating::Partial] {
                let start = Start::In(operating.clone());
                let settings = Settings { baud, start, seed, quirks: quirks.clone(), ..Settings::default() };
                let mut bench = Bench::new(sensor_with(settings), 0);
                longest = longest.max(bench.until("streaming", limit * MILLIS, Bench::is_streaming));
                bench.run(1_500 * MILLIS);
                assert!(bench.is_streaming(), "{seed} {baud:?} {operating:?}: {bench}");
                assert_eq!(bench.session.sensor().variant, Some(Variant::HALF), "{bench}");
                assert_eq!(
                    bench.session.sensor().kind(),
                    b"LMS200;301063;V02.30",
                    "{seed} {operating:?}: {bench}"
                );
            }
        }
    }
    println!("{quirks:?}: the slowest took {} ms", longest / MILLIS);
}

#[test]
fn a_third_of_the_requests_is_overlooked() {
    all_stream(ProtocolQuirks { overlooks: 0.3, ..ProtocolQuirks::default() }, 0..4, 15_000);
}

#[test]
fn a_third_of_the_requests_gets_a_nak() {
    all_stream(ProtocolQuirks { naks: 0.3, ..ProtocolQuirks::default() }, 0..3, 15_000);
}

#[test]
fn replies_come_twice() {
    all_stream(ProtocolQuirks { doubles: 1.0, ..ProtocolQuirks::default() }, 0..1, 5_000);
    all_stream(ProtocolQuirks { doubles: 0.5, overlooks: 0.2, ..ProtocolQuirks::default() }, 0..2, 15_000);
}

#[test]
fn acknowledgements_and_replies_are_late() {
    // As late as the listing allows, and later.
    for late in [52, 100, 300] {
        let late_ns = late * MILLIS;
        all_stream(
            ProtocolQuirks { late_acknowledge_ns: late_ns, ..ProtocolQuirks::default() },
            0..1,
            20_000,
        );
        all_stream(ProtocolQuirks { late_reply_ns: late_ns, ..ProtocolQuirks::default() }, 0..1, 20_000);
        all_stream(
            ProtocolQuirks { late_reply_ns: late_ns, doubles: 0.5, ..ProtocolQuirks::default() },
            0..1,
            20_000,
        );
    }
}

#[test]
fn what_is_refused_is_done_without_or_told() {
    for (command, trouble) in [(0x3A, None), (0x74, None), (0x3B, Some(Trouble::VariantRefused))] {
        let variant = if trouble.is_some() { Variant::ALL[0] } else { Variant::HALF };
        let quirks = ProtocolQuirks { refuses: vec![command], ..ProtocolQuirks::default() };
        let mut bench = Bench::new(sensor_with(Settings { quirks, variant, ..Settings::default() }), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming(), "{command:02X}: {bench}");
        assert_eq!(bench.session.trouble(), trouble, "{command:02X}");
    }
    // Without 20h there is no stream: that is said, and tried again and again, not hastily.
    let quirks = ProtocolQuirks { refuses: vec![0x20], ..ProtocolQuirks::default() };
    let mut bench = Bench::new(sensor_with(Settings { quirks, ..Settings::default() }), 0);
    bench.run(2_000 * MILLIS);
    assert!(matches!(bench.session.trouble(), Some(Trouble::Refused(_))), "{bench}");
    let said = bench.said.len();
    bench.run(60_000 * MILLIS);
    assert!(bench.said.len() - said < 3_000, "{} bytes said in a minute", bench.said.len() - said);
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.trouble(), None);
}

#[test]
fn a_version_s14_streams_but_nobody_knows_its_angles() {
    for start in [Start::In(Operating::OnRequest), Start::In(Operating::All)] {
        let type_name = "LMS291;S14063;X01.27 ".into();
        let (variant, baud) = (Variant::ALL[0], Baud::B500000);
        let settings = Settings { type_name, variant, baud, start, ..Settings::default() };
        let wanted = lms::Settings { variant, ..WANTED };
        let mut bench = Bench::wanting(wanted, sensor_with(settings), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.received_scans(0).len() > 60, "{bench}");
        let mut scans = bench.received.iter().filter(|got| got.telegram[4] == lms::measured::MEASURED);
        assert!(scans.all(|got| got.range_bits.is_none()), "{bench}");
        assert_eq!(bench.session.trouble(), Some(Trouble::AnglesUnknown));
    }
}

#[test]
fn a_mode_without_ranges_gives_no_scans() {
    for start in [Start::In(Operating::OnRequest), Start::In(Operating::All)] {
        let settings = Settings { mode: Mode(0x3F), baud: Baud::B500000, start, ..Settings::default() };
        let mut bench = Bench::new(sensor_with(settings), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.received_scans(0).len() > 30, "{bench}");
        let mut scans = bench.received.iter().filter(|got| got.telegram[4] == lms::measured::MEASURED);
        assert!(scans.all(|got| got.range_bits.is_none()), "{bench}");
        assert_eq!(bench.session.trouble(), Some(Trouble::NoRanges(Mode(0x3F))));
    }
}

#[test]
fn a_stream_of_a_sensor_that_answers_nothing_is_taken() {
    let quirks = ProtocolQuirks { mute: true, ..ProtocolQuirks::default() };
    let start = Start::In(Operating::All);
    let settings = Settings { baud: Baud::B500000, start, quirks, ..Settings::default() };
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(5_000 * MILLIS);
    assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
    assert_eq!(bench.session.trouble(), Some(Trouble::ModeUnknown));
    // Three questions, five times each; then rarely, because without an answer there are no scans.
    assert_eq!(bench.said.len(), 15 * 7);
    bench.run(25_000 * MILLIS);
    assert!(bench.said.len() <= (15 + 3 * 3) * 7, "{} bytes said", bench.said.len());
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.until("mode known", 11_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(500 * MILLIS);
    assert_eq!((bench.session.trouble(), bench.session.account().resyncs), (None, 0));
}

#[test]
fn a_change_of_mode_takes_as_long_as_the_listing_allows() {
    for late in [1_100, 1_500, 2_900] {
        let quirks = ProtocolQuirks { late_mode_ns: late * MILLIS, ..ProtocolQuirks::default() };
        all_stream(quirks, 0..1, 15_000);
    }
}
