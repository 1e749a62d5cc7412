//! A sensor that refuses, a line that loses a request or a reply, a stream that stops: the session streams all the same.

use scanhub_drivers::line::{Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::Trouble;
use scanhub_drivers::lms::variant::{Baud, Unit, Variant};
use scanhub_schema::MILLIS;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;

use super::bench::{Bench, make_stream, sensor};

#[test]
fn a_refused_variant_streams_as_it_is() {
    let variant = Variant::ALL[0];
    let scan = |i: u16| lms::measured::encode(0, Unit::Cm, &[700 + i % 50; 181], 0x10).bytes().to_vec();
    let telegrams = Box::new((0..).map(scan));
    let settings = Settings { variant, baud: Baud::B9600, ..Settings::default() };
    let mut bench = Bench::new(LmsSimulator::new(settings, Source::Recorded { variant, telegrams }), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming() && bench.received_scans(0).len() > 60, "{bench}");
    assert_eq!(bench.session.trouble(), Some(Trouble::VariantRefused));
    assert_eq!(bench.session.sensor().variant, Some(variant));
}

#[test]
fn what_was_refused_is_not_forgotten_in_a_silence() {
    let variant = Variant::ALL[0];
    let quirks = ProtocolQuirks { refuses: vec![0x3B], ..ProtocolQuirks::default() };
    let settings = Settings { variant, quirks, ..Settings::default() };
    let mut bench =
        Bench::new(LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 1))), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let cut = bench.now;
    bench.to_host = Box::new(move |at, bytes| if at < cut + 1_050 * MILLIS { Vec::new() } else { bytes });
    bench.until("silent", 1_040 * MILLIS, |bench| bench.session.state() == State::Silent);
    assert_eq!(bench.session.trouble(), Some(Trouble::Silence));
    bench.states.clear();
    // Nobody tells the mode for some time.
    let mute = ProtocolQuirks { mute: true, ..ProtocolQuirks::default() };
    bench.machine.set_quirks(mute);
    bench.until("streaming", 200 * MILLIS, Bench::is_streaming);
    bench.until("told", 10_000 * MILLIS, |bench| bench.session.trouble() == Some(Trouble::ModeUnknown));
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.until("mode known", 11_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.trouble(), Some(Trouble::VariantRefused), "{bench}");
    assert_eq!(bench.states, [State::Silent, State::Streaming], "it was taken as it is");
}

#[test]
fn any_byte_of_the_requests_may_be_lost_or_damaged() {
    let said = {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.said.len()
    };
    assert!(said >= 30);
    for wrong in 0..said {
        for damage in [None, Some(0x40)] {
            let mut bench = Bench::new(sensor(Baud::B9600), 0);
            bench.to_sensor = Box::new(move |number, byte| match damage {
                _ if number != wrong => Some(byte),
                None => None,
                Some(bits) => Some(byte ^ bits),
            });
            // A change of rate that was not understood is found out after three tries and a search.
            bench.until("streaming", 6_000 * MILLIS, Bench::is_streaming);
            bench.run(200 * MILLIS);
            assert!(bench.is_streaming(), "byte {wrong} {damage:?}: {bench}");
        }
    }
}

#[test]
fn any_reply_may_be_lost_or_damaged() {
    let replies = {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.sent.iter().filter(|sent| sent.is_reply).count()
    };
    assert!(replies >= 4);
    // By the number of the chunk: replies and their acknowledgements are the first ones.
    for wrong in 0..replies * 8 {
        for damage in [None, Some(0x04)] {
            let mut bench = Bench::new(sensor(Baud::B9600), 0);
            let mut number = 0;
            bench.to_host = Box::new(move |_, mut bytes| {
                number += 1;
                match damage {
                    _ if number != wrong + 1 => {}
                    None => bytes.clear(),
                    Some(bits) => bytes[0] ^= bits,
                }
                bytes
            });
            bench.until("streaming", 10_000 * MILLIS, Bench::is_streaming);
            bench.run(200 * MILLIS);
            assert!(bench.is_streaming(), "chunk {wrong} {damage:?}: {bench}");
        }
    }
}

#[test]
fn a_second_of_silence_begins_again_with_two_questions() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(300 * MILLIS);
    let (cut, said) = (bench.now, bench.said.len());
    bench.to_host = Box::new(move |at, bytes| if at < cut + 1_050 * MILLIS { Vec::new() } else { bytes });
    bench.until("silent", 1_040 * MILLIS, |bench| bench.session.state() == State::Silent);
    assert!(bench.now >= cut + 970 * MILLIS, "gave up early: {bench}");
    assert_eq!((bench.session.account().resyncs, bench.session.trouble()), (1, Some(Trouble::Silence)));
    bench.until("streaming", 200 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming(), "{bench}");
    assert_eq!((bench.session.account().resyncs, bench.session.trouble()), (1, None));
    // Who it is, and how its values are split: it might be another one.
    assert_eq!(bench.said.len(), said + 2 * 7);
}

#[test]
fn a_longer_silence_is_followed_by_a_search() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    let cut = bench.now;
    bench.to_host = Box::new(move |at, bytes| if at < cut + 5_000 * MILLIS { Vec::new() } else { bytes });
    bench.run(5_000 * MILLIS);
    assert!(!bench.is_streaming());
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.trouble(), None);
}

#[test]
fn a_sensor_whose_power_was_cycled() {
    let mut machine = sensor(Baud::B500000);
    let begun = make_stream(&mut machine);
    let mut bench = Bench::new(machine, begun);
    bench.until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    bench.machine = sensor(Baud::B9600);
    bench.until("silent", 1_100 * MILLIS, |bench| bench.session.state() == State::Silent);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
    assert_eq!((bench.session.account().resyncs, bench.session.trouble()), (1, None));
}

#[test]
fn a_variant_that_gets_no_answer_is_done_without() {
    let settings =
        Settings { variant: Variant { angle_deg: 180, resolution_cdeg: 100 }, ..Settings::default() };
    let mut bench =
        Bench::new(LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 1))), 0);
    // Every request to switch arrives damaged, and is answered with NAK.
    let mut heard = Vec::new();
    bench.to_sensor = Box::new(move |_, byte| {
        heard.push(byte);
        Some(if heard.ends_with(&[0x02, 0x00, 0x05, 0x00, 0x3B]) { byte ^ 1 } else { byte })
    });
    bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming(), "{bench}");
    assert_eq!(bench.session.trouble(), Some(Trouble::VariantRefused));
    assert_eq!(bench.received_scans(0)[0].len(), 372);
}

#[test]
fn a_sensor_that_was_swapped_may_have_another_address() {
    let at = |address| {
        let settings = Settings { address, ..Settings::default() };
        LmsSimulator::new(settings, Source::Room(Room::new(&"room".parse().unwrap(), 1)))
    };
    let mut bench = Bench::new(at(1), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.machine = at(2);
    bench.until("silent", 2_000 * MILLIS, |bench| !bench.is_streaming());
    bench.until("streaming again", 4_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.sensor().address, Some(0x82));
}
