//! A sensor that answers: found at whatever rate, in whatever mode, and left as it was.

use scanhub_drivers::lms::Inquiry;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::telegram::{Encoded, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_schema::MILLIS;
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, machine, make_stream, say, sensor};

/// 20h 00h with the password that every sensor leaves the factory with.
fn installation() -> Encoded {
    Writer::new(0, 0x20).byte(0).slice(b"SICK_LMS").finish()
}

#[test]
fn found_at_each_rate_idle_streaming_and_in_installation_mode() {
    for first in Baud::ALL {
        for baud in Baud::ALL {
            for (word, mode) in [("idle", 0x25), ("streaming", 0x24), ("installation mode", 0x00)] {
                let mut machine = sensor(baud);
                let now = match mode {
                    0x24 => make_stream(&mut machine),
                    0x00 => say(&mut machine, &installation()),
                    _ => 0,
                };
                let mut bench = Bench::new(Inquiry::new(first, now), first, machine, now);
                let took = bench.finish(5_000 * MILLIS);
                let report = bench.talk.report();
                let status =
                    report.status().unwrap_or_else(|| panic!("{first:?} {baud:?} {word}: {report:?}"));
                assert_eq!((report.baud, status.operating_mode()), (Some(baud), mode), "{word}");
                assert_eq!((report.address, report.status_byte), (Some(0), Some(0x10)));
                assert_eq!(report.kind(), Some(&b"LMS200;301063;V02.30"[..]));
                let configuration = report.configuration().expect("was asked");
                assert_eq!((configuration.mode(), configuration.unit()), (Mode(1), Some(Unit::Mm)));
                println!("port at {first:?}, {word} at {baud:?}: {} ms", took / MILLIS);
                // It is as it was.
                assert_eq!((bench.machine.baud(), bench.machine.eeprom_writes()), (baud, 0));
                let scans = bench.overhear(2_000 * MILLIS);
                assert_eq!(scans.is_empty(), mode != 0x24, "{word}");
            }
        }
    }
}

#[test]
fn nothing_is_said_that_changes_anything() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(Inquiry::new(Baud::B500000, 0), Baud::B500000, sensor(baud), 0);
        bench.finish(5_000 * MILLIS);
        for telegram in &bench.said {
            assert!([0x31, 0x32, 0x35, 0x3A, 0x74].contains(&telegram[4]), "{telegram:02X?}");
        }
    }
}

#[test]
fn found_in_every_operating_mode_and_left_in_it() {
    for operating in [
        Operating::All,
        Operating::Partial,
        Operating::Means(3),
        Operating::Range(10, 90),
        Operating::Fields(1, 50),
        Operating::Reflectivity(vec![(1, 40), (60, 80)]),
        Operating::Installation,
    ] {
        for baud in Baud::ALL {
            let start = Start::In(operating.clone());
            let settings = Settings { baud, start, seed: 4, ..Settings::default() };
            let mut bench = Bench::new(Inquiry::new(Baud::B500000, 0), Baud::B500000, machine(settings), 0);
            bench.finish(20_000 * MILLIS);
            let report = bench.talk.report();
            let mode = report.status().map(|status| status.operating_mode());
            assert_eq!((report.baud, mode), (Some(baud), Some(operating.code())), "{operating:?}");
            assert_eq!((report.kind().is_some(), report.errors().is_some()), (true, true), "{operating:?}");
            assert_eq!(*bench.machine.operating(), operating);
            let is_silent = operating == Operating::Installation;
            assert_eq!(bench.overhear(3_000 * MILLIS).is_empty(), is_silent, "{operating:?} {baud:?}");
        }
    }
}

#[test]
fn what_it_suffers_from_and_what_a_former_owner_left() {
    let settings = Settings {
        baud: Baud::B38400,
        permanent_baud: Some(Baud::B38400),
        type_name: "LMS291;S05123;V02.10 ".into(),
        errors: vec![(0x84, 22), (2, 18)],
        status: 0x92,
        configuration_len: 32,
        ..Settings::default()
    };
    let mut bench = Bench::new(Inquiry::new(Baud::B9600, 0), Baud::B9600, machine(settings), 0);
    bench.finish(20_000 * MILLIS);
    let report = bench.talk.report();
    assert_eq!(report.status().map(|status| status.has_permanent_baud()), Some(true));
    assert_eq!(report.configuration().map(|configuration| configuration.bytes().len()), Some(32));
    assert_eq!(report.status_byte, Some(0x92));
    let faults: Vec<_> = report.errors().expect("was asked").iter().map(|fault| fault.number).collect();
    assert_eq!(faults, [22, 18]);
    assert!(report.reply(Request::Counters).is_some(), "an LMS 291 counts its hours");
}

#[test]
fn an_address_of_its_own_is_learned_and_used() {
    let settings = Settings { address: 5, baud: Baud::B19200, ..Settings::default() };
    let mut bench = Bench::new(Inquiry::new(Baud::B9600, 0), Baud::B9600, machine(settings), 0);
    bench.finish(5_000 * MILLIS);
    assert_eq!(bench.talk.report().address, Some(5));
    assert_eq!(bench.said.last().map(|telegram| telegram[1]), Some(5));
}

#[test]
fn a_rate_that_cannot_be_changed_is_not() {
    let mut bench = Bench::new(Inquiry::at(Baud::B38400, 0), Baud::B38400, sensor(Baud::B38400), 0);
    bench.finish(5_000 * MILLIS);
    assert!(bench.talk.report().status().is_some());
    let mut bench = Bench::new(Inquiry::at(Baud::B38400, 0), Baud::B38400, sensor(Baud::B9600), 0);
    bench.finish(5_000 * MILLIS);
    assert!(!bench.talk.report().answers());
    assert_eq!(bench.talk.baud(), Baud::B38400);
}

#[test]
fn the_answers_are_those_to_the_questions() {
    let mut bench = Bench::new(Inquiry::new(Baud::B9600, 0), Baud::B9600, sensor(Baud::B9600), 0);
    bench.finish(5_000 * MILLIS);
    let report = bench.talk.report();
    assert!(report.reply(Request::Type).is_some());
    assert_eq!(report.reply(Request::Stop), None);
}
