//! A sensor that is idle at one of its rates.

use lms::variant::{Baud, Mode, Unit, Variant};
use lms::{MILLIS, State};

use crate::bench::{Bench, sensor};

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
        assert_eq!((bench.session.trouble(), bench.session.resyncs()), (None, 0));
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
    let settings = sim::machine::Settings {
        variant: Variant::ALL[4],
        baud: Baud::B38400,
        ..sim::machine::Settings::default()
    };
    let room = sim::room::Room::new(&sim::world::World::Random, 3);
    let machine = sim::machine::Machine::new(settings, sim::source::Source::Room(room));
    let mut bench = Bench::new(machine, 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.sensor().variant, Some(Variant::HALF));
    assert!(bench.received_scans(0).iter().all(|scan| scan.len() == 732), "{bench}");
}

#[test]
fn nobody_there_is_said_and_the_search_goes_on() {
    let mut bench = Bench::new(sensor(Baud::B9600), 0);
    bench.to_sensor = Box::new(|_, _| None);
    bench.until("said", 3_000 * MILLIS, |bench| {
        matches!(bench.session.trouble(), Some(lms::Trouble::NoAnswer { .. }))
    });
    bench.run(10_000 * MILLIS);
    assert_eq!(bench.states, [State::Probing]);
    // Power on.
    bench.to_sensor = Box::new(|_, byte| Some(byte));
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.trouble(), None);
}
