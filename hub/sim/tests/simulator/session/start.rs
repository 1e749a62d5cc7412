//! A sensor that is idle at one of its rates.

use scanhub_drivers::line::{Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_schema::MILLIS;

use scanhub_sim::machine::{ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, make_stream, sensor, sensor_with};

#[test]
fn from_each_rate_to_a_stream_within_three_seconds() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(sensor(baud), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        let since = bench.now;
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
        let known = bench.session.sensor();
        assert_eq!(
            (known.mode, known.unit, known.variant),
            (Some(Mode(1)), Some(Unit::Mm), Some(Variant::HALF))
        );
        assert_eq!((known.kind(), known.address), (&b"LMS200;301063;V02.30"[..], Some(0x80)));
        assert_eq!((bench.session.trouble(), bench.session.account().resyncs), (None, 0));
        let scans = bench.received_scans(since);
        assert!(scans.len() >= 36 && scans == bench.intact_scans(since)[..scans.len()], "{bench}");
        // A rate is changed only where it has to be.
        assert_eq!(bench.states.contains(&State::Switching), baud != Baud::B500000, "{bench}");
        // Nothing is asked of a sensor whose questions are all answered.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert_eq!(aborted, 0, "{bench}");
    }
}

#[test]
fn a_sensor_with_another_variant_is_set_to_the_wanted_one() {
    let settings = Settings { variant: Variant::ALL[4], baud: Baud::B38400, ..Settings::default() };
    let room = scanhub_sim::room::Room::new(&scanhub_sim::world::World::Random, 3);
    let machine =
        scanhub_sim::machine::LmsSimulator::new(settings, scanhub_sim::operating::Source::Room(room));
    let mut bench = Bench::new(machine, 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.sensor().variant, Some(Variant::HALF));
    assert!(bench.received_scans(0).iter().all(|scan| scan.len() == 732), "{bench}");
}

#[test]
fn nobody_there_is_said_and_the_search_goes_on() {
    // It gets its power at any moment of two rounds and the pauses after them.
    for moment in 0..60 {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.to_sensor = Box::new(|_, _| None);
        bench.until("said", 3_000 * MILLIS, |bench| {
            matches!(bench.session.trouble(), Some(lms::Trouble::NoAnswer { .. }))
        });
        bench.run((10_000 + 100 * moment) * MILLIS);
        assert_eq!(bench.states, [State::Probing]);
        bench.to_sensor = Box::new(|_, byte| Some(byte));
        bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.trouble(), None);
    }
}

/// A sensor that answers 60 ms after its ACK, as the faster half of those captured.
fn prompt(baud: Baud, start: Start) -> Settings {
    let quirks = ProtocolQuirks { answer_ns: 60 * MILLIS, ..ProtocolQuirks::default() };
    Settings { baud, start, quirks, ..Settings::default() }
}

#[test]
fn a_sensor_that_just_got_its_power_streams_soon() {
    // Never seen before, or where it was the last time.
    for (seed, first, within) in (0..20).flat_map(|seed| [(seed, None, 500), (seed, Some(Baud::B9600), 500)])
    {
        let settings = Settings { seed, ..prompt(Baud::B9600, Start::In(Operating::OnRequest)) };
        let mut bench = Bench::new(sensor_with(settings), 0);
        first.into_iter().for_each(|baud| bench.seek_first(baud));
        let took = bench.until("a scan", within * MILLIS, |bench| !bench.received_scans(0).is_empty());
        assert_eq!(bench.found_at(), Some(Baud::B9600));
        assert!(bench.received.last().is_some_and(|got| got.range_bits == Some(13)), "{took}: {bench}");
        let known = bench.session.sensor();
        assert_eq!((known.kind(), known.unit), (&b"LMS200;301063;V02.30"[..], Some(Unit::Mm)));
        // At 9600 nothing long is said: a type and a change of rate.
        let replies: Vec<u8> =
            bench.sent.iter().filter(|sent| sent.is_reply).map(|sent| sent.telegram[4]).collect();
        assert_eq!(replies, [0xBA, 0xA0, 0xB1, 0xA0], "{bench}");
    }
}

#[test]
fn what_does_not_tell_its_type_or_its_status_is_started_all_the_same() {
    for baud in Baud::ALL {
        for start in [Operating::OnRequest, Operating::All, Operating::Installation] {
            for refused in [0x3A, 0x31, 0x74] {
                let settings = prompt(baud, Start::In(start.clone()));
                let quirks = ProtocolQuirks { refuses: vec![refused], ..settings.quirks.clone() };
                let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
                bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
                bench.run(1_500 * MILLIS);
                assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{refused:02x}: {bench}");
                assert_eq!(bench.session.sensor().mode, Some(Mode(1)), "{refused:02x}: {bench}");
            }
        }
    }
}

#[test]
fn where_it_was_the_last_time_is_asked_and_not_believed() {
    for first in Baud::ALL {
        for baud in Baud::ALL {
            let mut bench = Bench::new(sensor_with(prompt(baud, Start::In(Operating::OnRequest))), 0);
            bench.seek_first(first);
            let took = bench.until("streaming", 1_500 * MILLIS, Bench::is_streaming);
            assert!(first != baud || took < 500 * MILLIS, "{first:?}: {took}");
            assert_eq!((bench.found_at(), bench.session.trouble()), (Some(baud), None));
            let mut machine = sensor(baud);
            let now = make_stream(&mut machine);
            let mut bench = Bench::new(machine, now);
            bench.seek_first(first);
            // A stream at the wanted rate is heard before anything is asked.
            let within = if baud == Baud::B500000 { 60 } else { 4_000 };
            bench.until("streaming", within * MILLIS, Bench::is_streaming);
            assert_eq!(bench.found_at().is_none(), baud == Baud::B500000);
        }
    }
}

/// It does not answer at all where others say that they cannot: at every rate it is asked for its status too.
#[test]
fn what_has_no_answer_for_its_type_is_found_by_its_status() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(sensor_with(prompt(baud, Start::In(Operating::OnRequest))), 0);
        let mut heard = Vec::new();
        // Every request for the type is lost.
        bench.to_sensor = Box::new(move |_, byte| {
            heard.push(byte);
            (!heard.ends_with(&[0x02, 0x00, 0x01, 0x00, 0x3A])).then_some(byte)
        });
        bench.until("streaming", 6_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{baud:?}: {bench}");
    }
}

/// Its rate may not be changed in the mode in which it is, which was not asked yet: it is stopped first.
#[test]
fn what_refuses_another_rate_is_stopped_first() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        let settings = prompt(baud, Start::In(Operating::Installation));
        let willing = settings.quirks.clone();
        let quirks = ProtocolQuirks { refuses: vec![0x20], ..willing.clone() };
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.until("refused", 2_000 * MILLIS, |bench| {
            bench.received.iter().any(|got| got.telegram[4] == lms::reply::REFUSED)
        });
        bench.machine.set_quirks(willing);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
        // Whoever refuses it always is told of, and asked again.
        let quirks = ProtocolQuirks { refuses: vec![0x20], ..ProtocolQuirks::default() };
        let settings = prompt(baud, Start::In(Operating::OnRequest));
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.until("said", 4_000 * MILLIS, |bench| {
            matches!(bench.session.trouble(), Some(lms::Trouble::Refused(_)))
        });
        bench.run(5_000 * MILLIS);
        bench.machine.set_quirks(ProtocolQuirks::default());
        bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.trouble(), None);
    }
}
