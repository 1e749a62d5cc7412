//! What somebody left behind in a sensor: the installation mode, in which it does not measure, and a rate in its
//! EEPROM, which is none of ours to change.

use scanhub_drivers::lms::Notice;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::MILLIS;
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, sensor_with};

#[test]
fn the_installation_mode_is_left() {
    for baud in Baud::ALL {
        for strict in [false, true] {
            let quirks = ProtocolQuirks { strict, ..ProtocolQuirks::default() };
            let start = Start::In(Operating::Installation);
            let settings = Settings { baud, start, quirks, ..Settings::default() };
            let mut bench = Bench::new(sensor_with(settings), 0);
            bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run(1_000 * MILLIS);
            assert!(bench.is_streaming() && bench.machine.operating() == &Operating::All, "{bench}");
            assert_eq!(bench.session.trouble(), None);
        }
    }
}

#[test]
fn it_is_left_too_by_a_sensor_that_does_not_tell_it() {
    for baud in Baud::ALL {
        let quirks = ProtocolQuirks { refuses: vec![0x31], ..ProtocolQuirks::default() };
        let start = Start::In(Operating::Installation);
        let mut bench = Bench::new(sensor_with(Settings { baud, start, quirks, ..Settings::default() }), 0);
        bench.until("stopped", 3_000 * MILLIS, |bench| bench.machine.operating() == &Operating::OnRequest);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
    }
}

#[test]
fn a_permanent_rate_is_found_worked_with_and_kept() {
    for permanent in Baud::ALL {
        let permanent_baud = (permanent != Baud::B9600).then_some(permanent);
        let settings = Settings { baud: permanent, permanent_baud, ..Settings::default() };
        let mut bench = Bench::new(sensor_with(settings), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        // That is good to know, and no trouble.
        let is_said = bench.session.sensor().notices().eq([Notice::PermanentBaud]);
        assert_eq!(is_said, permanent != Baud::B9600, "{permanent:?}: {bench}");
        assert_eq!(bench.session.sensor().permanent_baud, Some(is_said));
        assert_eq!(bench.session.trouble(), None);
        // It comes back at its own rate, and is found again.
        let now = bench.now;
        bench.machine.power_cycle(now);
        bench.until("silent", 1_200 * MILLIS, |bench| !bench.is_streaming());
        bench.until("streaming", 8_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{permanent:?}: {bench}");
    }
}
