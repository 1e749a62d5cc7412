//! A sensor that streams something else than what is wanted: means, sub-ranges, partial scans, reflectivity, another
//! variant, at any rate. It is stopped and started as wanted, never waited out.

use scanhub_drivers::line::State;
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{LmsSimulator, Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, WANTED, sensor_with};

fn modes() -> [Operating; 9] {
    [
        Operating::All,
        Operating::Partial,
        Operating::Means(2),
        Operating::Means(250),
        Operating::Range(27, 299),
        Operating::MeanRange(3, 1, 100),
        Operating::MeanRange(250, 1, 100),
        Operating::Fields(1, 100),
        Operating::Reflectivity(vec![(1, 181)]),
    ]
}

/// A sensor that does this since `age`.
fn streaming(settings: Settings, operating: &Operating, age: Nanos) -> (LmsSimulator, Nanos) {
    let mut machine = sensor_with(Settings { start: Start::In(operating.clone()), seed: age, ..settings });
    while let Some(at) = machine.poll_timeout().filter(|&at| at < age) {
        while machine.poll_transmit(at).is_some() {}
    }
    (machine, age)
}

/// The time from the session's begin to the wanted stream, which then goes on.
fn taken_over(bench: &mut Bench, limit: Nanos) -> Nanos {
    let took = bench.until("streaming", limit, Bench::is_streaming);
    let since = bench.now;
    bench.run(500 * MILLIS + 3 * bench.scan_period());
    assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
    assert!(bench.machine.operating() == &Operating::All, "{:?}: {bench}", bench.machine.operating());
    let mut intact = bench.intact_scans(since);
    let scans = bench.received_scans(since);
    intact.truncate(scans.len());
    assert!(scans.len() > 1 && scans == intact, "{} scans: {bench}", scans.len());
    took
}

impl Bench {
    fn scan_period(&self) -> Nanos {
        Variant::HALF.period(734, self.session.baud().rate())
    }
}

#[test]
fn whatever_streams_at_500k_is_the_wanted_stream_within_a_second() {
    for operating in modes() {
        for age in [1_000, 1_019] {
            for (address, availability) in [(0, 0), (5, 2)] {
                let settings = Settings { baud: Baud::B500000, address, availability, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                let limit = if operating == Operating::All { 500 } else { 1_000 };
                let took = taken_over(&mut bench, limit * MILLIS);
                let adopted = bench.states == [State::Probing, State::Streaming];
                assert_eq!(adopted, operating == Operating::All, "{operating:?} in {took} ns: {bench}");
                let scan = bench.received_scans(0).pop().map(|scan| (scan.len(), scan[1]));
                assert_eq!(scan, Some((732 + usize::from(availability), 0x80 + address)), "{bench}");
            }
        }
    }
}

#[test]
fn another_variant_is_switched_within_a_second() {
    for variant in Variant::ALL {
        for operating in [Operating::All, Operating::Partial] {
            let settings = Settings { baud: Baud::B500000, variant, ..Settings::default() };
            let (machine, now) = streaming(settings, &operating, 1_005 * MILLIS);
            let mut bench = Bench::new(machine, now);
            taken_over(&mut bench, 1_000 * MILLIS);
            assert_eq!(bench.session.sensor().variant, Some(Variant::HALF), "{variant:?}: {bench}");
        }
    }
}

#[test]
fn whatever_streams_at_another_rate_is_found_within_five_seconds() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for operating in modes() {
            for age in [1_000, 1_357] {
                let settings = Settings { baud, address: 1, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                taken_over(&mut bench, 5_000 * MILLIS);
            }
        }
    }
}

#[test]
fn a_slow_link_takes_over_what_streams_too() {
    for wanted in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for baud in Baud::ALL {
            for operating in [Operating::All, Operating::Partial, Operating::Means(250)] {
                let (machine, now) =
                    streaming(Settings { baud, ..Settings::default() }, &operating, 1_003 * MILLIS);
                let mut bench = Bench::wanting(lms::Settings { baud: wanted, ..WANTED }, machine, now);
                taken_over(&mut bench, 6_000 * MILLIS);
                assert_eq!(bench.session.baud(), wanted);
            }
        }
    }
}
