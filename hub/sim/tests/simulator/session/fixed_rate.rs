//! A line whose rate somebody set by hand, as that of a serial server: it is talked to at that rate and no other.

use scanhub_drivers::line::State;
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::lms::{Settings, Trouble};
use scanhub_schema::MILLIS;

use super::bench::{Bench, WANTED, make_stream, sensor};

fn wanted(baud: Baud) -> Settings {
    Settings { baud, fixed_rate: true, ..WANTED }
}

#[test]
fn a_sensor_at_that_rate_streams() {
    for baud in Baud::ALL {
        let mut bench = Bench::wanting(wanted(baud), sensor(baud), 0);
        bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
        assert!(!bench.states.contains(&State::Switching), "{bench}");
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::wanting(wanted(baud), machine, now);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
    }
}

#[test]
fn a_sensor_at_another_rate_is_said_to_be_mute_and_not_sought_elsewhere() {
    let mut bench = Bench::wanting(wanted(Baud::B38400), sensor(Baud::B9600), 0);
    bench.until("said", 10_000 * MILLIS, |bench| {
        matches!(bench.session.trouble(), Some(Trouble::NoAnswer { baud: Some(Baud::B38400), .. }))
    });
    for _ in 0..100 {
        bench.run(100 * MILLIS);
        assert_eq!(bench.session.baud(), Baud::B38400, "{bench}");
    }
    assert_eq!(bench.states, [State::Probing]);
}
