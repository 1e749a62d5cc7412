//! What a power cycle, a reset and a former owner do to a sensor.

use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{ACK, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Unit, Variant};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::Bench;
use super::{fast, reply};

const BOOT: Nanos = 3_000 * MILLIS;

fn install() -> Vec<u8> {
    Writer::new(0, 0x20).byte(0).slice(b"SICK_LMS").finish().bytes().to_vec()
}

#[test]
fn a_power_cycle_breaks_off_forgets_and_announces_itself() {
    let mut bench =
        Bench::new(Settings { start: Start::In(Operating::All), boot_ns: BOOT, unit: Unit::Cm, ..fast() });
    bench.ask(Request::Variant(Variant::ALL[0]).encode(0).bytes());
    let next = bench.sent().last().unwrap().0 + 10 * MILLIS;
    bench.run_until(next);
    assert!(bench.machine.power_cycle(next), "nothing was on the line");
    let before = bench.chunks.len();
    bench.run_until(next + BOOT - 1_000 * MILLIS);
    assert!(bench.ask(Request::Status.encode(0).bytes()).is_empty(), "heard while it starts");
    bench.run_until(next + 2 * BOOT);
    let sent: Vec<_> = bench.sent().into_iter().filter(|(at, _)| *at > next).collect();
    assert_eq!((sent[0].1.aborted, sent[0].1.is_reply, sent.len()), (true, false, 2));
    assert_eq!((sent[1].1.telegram[4], sent[1].1.is_reply), (0x90, true));
    assert!(sent[1].0 >= next + BOOT);
    let banner = bench.chunks[before..].iter().rev().find(|(_, chunk)| !chunk.bytes.is_empty()).unwrap();
    assert_eq!((banner.1.rate, bench.machine.baud()), (9_600, Baud::B9600));
    let answer = bench.ask(Request::Status.encode(0).bytes());
    let Reply::Status(status) = reply(&answer) else { panic!("no status") };
    assert_eq!(
        (status.operating_mode(), status.variant(), status.unit()),
        (0x25, Some(Variant::HALF), Some(Unit::Cm))
    );
    assert!(!bench.machine.power_cycle(bench.now), "an idle line");
}

#[test]
fn a_reset_says_that_it_comes_and_that_it_is_over() {
    let errors = vec![(0x84, 22), (1, 49)];
    let mut bench = Bench::new(Settings { boot_ns: BOOT, errors, ..fast() });
    let told = bench.ask(&[0x02, 0, 1, 0, 0x32, 0x16, 0x12]);
    assert_eq!(told[5..10], [0xB2, 0x84, 22, 1, 49]);
    let bytes = bench.ask(&[0x02, 0, 1, 0, 0x10, 0x34, 0x12]);
    assert_eq!(bytes[..9], [ACK, 0x02, 0x80, 2, 0, 0x91, 0x10, 0x79, 0x30]);
    assert_eq!(bytes.len(), 9);
    let before = bench.chunks.len();
    bench.run_until(bench.now + 2 * BOOT);
    let banner = bench.bytes_from(before);
    assert_eq!((Telegram::check(&banner).unwrap().command(), bench.machine.baud()), (0x90, Baud::B9600));
    assert_eq!(bench.ask(&[0x02, 0, 1, 0, 0x32, 0x16, 0x12])[5..7], [0xB2, 0x10], "faults were not cleared");
}

#[test]
fn a_sensor_may_start_with_the_simulation() {
    let mut bench = Bench::new(Settings { start: Start::PowerOn, boot_ns: BOOT, ..Settings::default() });
    bench.run_until(BOOT - 1);
    assert!(bench.chunks.is_empty());
    bench.run_until(BOOT + 100 * MILLIS);
    assert_eq!(Telegram::check(&bench.bytes_from(0)).unwrap().command(), 0x90);
}

#[test]
fn a_permanent_rate_is_written_in_installation_mode_and_stays() {
    let mut bench = Bench::new(fast());
    let keep = Writer::new(0, 0x66).byte(1).finish();
    assert_eq!(reply(&bench.ask(keep.bytes())), Reply::Refused);
    bench.ask(&install());
    assert_eq!(bench.ask(keep.bytes())[5], 0xE6);
    assert_eq!((bench.machine.eeprom_writes(), bench.machine.operating()), (2, &Operating::Installation));
    bench.machine.power_cycle(bench.now);
    bench.run_until(bench.now + 10_000 * MILLIS);
    assert_eq!((bench.machine.baud(), bench.machine.operating()), (Baud::B500000, &Operating::OnRequest));
    let status = bench.ask(Request::Status.encode(0).bytes());
    assert_eq!(status[5 + 119], 1);
    bench.ask(&install());
    bench.ask(Writer::new(0, 0x66).byte(0).finish().bytes());
    bench.machine.power_cycle(bench.now);
    assert_eq!(bench.machine.baud(), Baud::B9600);
}

#[test]
fn a_short_configuration_changes_the_leading_bytes_only() {
    for (configuration_len, length) in [(34, 0x24), (32, 0x22)] {
        let mut bench = Bench::new(Settings { configuration_len, availability: 2, ..fast() });
        let before = bench.ask(Request::Configuration.encode(0).bytes());
        assert_eq!(before[3], length);
        bench.ask(&install());
        let refused = bench.ask(Writer::new(0, 0x77).slice(&[0, 0, 0x70, 0, 2, 0x07]).finish().bytes());
        assert_eq!(
            (refused[5], refused[6], &refused[7..]),
            (0xF7, 0, &[&before[6..before.len() - 2], &refused[refused.len() - 2..]].concat()[..])
        );
        let written = bench.ask(Writer::new(0, 0x77).slice(&[20, 0, 0x46]).finish().bytes());
        assert_eq!((written[6], &written[7..12]), (1, &[20, 0, 0x46, 0, 2][..]));
        bench.machine.power_cycle(bench.now);
        bench.run_until(bench.now + 5_000 * MILLIS);
        let after = bench.ask(Request::Configuration.encode(0).bytes());
        assert_eq!((after.len(), &after[6..11]), (before.len(), &[20, 0, 0x46, 0, 2][..]));
    }
}

#[test]
fn what_ails_it_is_in_the_status() {
    let errors = vec![(4, 22)];
    let mut bench =
        Bench::new(Settings { status: 0x94, errors, pollution_percent: 60, address: 7, ..fast() });
    let bytes = bench.ask(Request::Status.encode(7).bytes());
    let telegram = Telegram::check(&bytes[1..]).unwrap();
    let Reply::Status(report) = Reply::decode(telegram).unwrap() else { panic!("no status") };
    assert!(report.is_defective() && telegram.status() == Some(0x94));
    let word = |at: usize| u16::from_le_bytes([telegram.data()[at - 1], telegram.data()[at]]);
    assert_eq!((word(19), word(33), word(43), word(57)), (600, 600, 1000, 1000));
    assert_eq!(telegram.data()[119], 7);
}
