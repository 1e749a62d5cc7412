//! Bad quirks of a sensor, each alone.

use scanhub_drivers::lms::command::{Password, Request};
use scanhub_drivers::lms::operating::Operating;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{ACK, NAK};
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_lms_configure::eeprom::{PowerOn, Write};
use scanhub_schema::{MICROS, MILLIS, line_time};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{ProtocolQuirks, Settings};
use scanhub_sim::{Arrival, Dropped};

use super::bench::Bench;
use super::{fast, reply};

fn with(quirks: ProtocolQuirks) -> Bench {
    Bench::new(Settings { quirks, ..fast() })
}

/// How many of 200 requests for the type get this as the first byte of the answer.
fn answered(quirks: ProtocolQuirks, first: Option<u8>) -> usize {
    let mut bench = with(quirks);
    let request = Request::Type.encode(0);
    (0..200).filter(|_| bench.ask(request.bytes()).first().copied() == first).count()
}

#[test]
fn a_share_of_the_requests_is_overlooked_or_refused_by_nak() {
    let overlooked = answered(ProtocolQuirks { overlooks: 0.3, ..ProtocolQuirks::default() }, None);
    assert!((40..80).contains(&overlooked), "{overlooked}");
    let refused = answered(ProtocolQuirks { naks: 0.3, ..ProtocolQuirks::default() }, Some(NAK));
    assert!((40..80).contains(&refused), "{refused}");
    assert_eq!(answered(ProtocolQuirks { mute: true, ..ProtocolQuirks::default() }, None), 200);
}

#[test]
fn a_command_may_be_refused() {
    let mut bench = with(ProtocolQuirks { refuses: vec![0x3A], ..ProtocolQuirks::default() });
    assert_eq!(reply(&bench.ask(Request::Type.encode(0).bytes())), Reply::Refused);
    assert!(matches!(reply(&bench.ask(Request::Status.encode(0).bytes())), Reply::Status(_)));
    bench.machine.set_quirks(ProtocolQuirks::default());
    assert!(matches!(reply(&bench.ask(Request::Type.encode(0).bytes())), Reply::Type(_)));
}

#[test]
fn replies_come_twice() {
    let mut bench = with(ProtocolQuirks { doubles: 1.0, ..ProtocolQuirks::default() });
    bench.ask(Request::Type.encode(0).bytes());
    let sent = bench.sent();
    assert_eq!((sent.len(), &sent[0].1.telegram), (2, &sent[1].1.telegram));
}

#[test]
fn a_late_reply_comes_though_the_next_request_was_there_before_it() {
    let mut bench = with(ProtocolQuirks { late_reply_ns: 800 * MILLIS, ..ProtocolQuirks::default() });
    assert_eq!(bench.ask(Request::Type.encode(0).bytes()), [ACK]);
    assert_eq!(bench.ask(Request::Stop.encode(0).bytes())[0], ACK);
    bench.run_until(bench.now + 2_000 * MILLIS);
    let commands: Vec<u8> = bench.sent().iter().map(|(_, sent)| sent.telegram[4]).collect();
    assert_eq!(commands, [0xBA, 0xA0]);
    let mut bench = with(ProtocolQuirks { late_acknowledge_ns: 300 * MILLIS, ..ProtocolQuirks::default() });
    bench.say(Request::Type.encode(0).bytes(), 60_000);
    let asked = bench.now;
    bench.run_until(asked + 1_000 * MILLIS);
    assert!(bench.chunks[0].0 >= asked + 300 * MILLIS && bench.chunks[0].1.bytes == [ACK]);
}

#[test]
fn a_mode_is_changed_slowly_and_a_status_told_at_once() {
    let mut bench = with(ProtocolQuirks { late_mode_ns: 2_000 * MILLIS, ..ProtocolQuirks::default() });
    for request in [Request::Stop, Request::Variant(Variant::ALL[0]), Request::Baud(Baud::B500000)] {
        assert_eq!(bench.ask(request.encode(0).bytes()), [ACK]);
        let before = bench.sent().len();
        bench.run_until(bench.now + 2_000 * MILLIS);
        assert_eq!(bench.sent().len(), before + 1, "{request:?}");
    }
    // Whoever does not wait is answered, and never hears that the change was made.
    assert_eq!(bench.ask(Request::Stop.encode(0).bytes()), [ACK]);
    let before = bench.sent().len();
    assert!(matches!(reply(&bench.ask(Request::Status.encode(0).bytes())), Reply::Status(_)));
    bench.run_until(bench.now + 5_000 * MILLIS);
    assert_eq!(bench.sent().len(), before + 1);
}

#[test]
fn writing_the_eeprom_takes_its_time() {
    let mut bench = with(ProtocolQuirks { late_write_ns: 6_000 * MILLIS, ..ProtocolQuirks::default() });
    assert_eq!(
        reply(&bench.ask(Request::install(Password::FACTORY).encode(0).bytes())),
        Reply::Mode { done: true }
    );
    for write in [Write::Configuration(&[20, 0]), Write::PowerOn(PowerOn::Baud9600)] {
        let before = bench.sent().len();
        assert_eq!(bench.ask(write.encode(0).expect("short enough").bytes()), [ACK]);
        bench.run_until(bench.now + 5_400 * MILLIS);
        assert_eq!(bench.sent().len(), before, "{write:?}");
        bench.run_until(bench.now + 600 * MILLIS);
        assert_eq!(bench.sent()[before].1.telegram[4], write.command() | 0x80);
    }
}

#[test]
fn a_strict_sensor_does_not_measure_in_installation_mode() {
    for strict in [false, true] {
        let mut bench = with(ProtocolQuirks { strict, ..ProtocolQuirks::default() });
        bench.ask(Request::install(Password::FACTORY).encode(0).bytes());
        let measuring = [
            Request::Operate(Operating::Means(2)),
            Request::Operate(Operating::Partial),
            Request::Values(1),
            Request::Means(2),
            Request::Stream,
        ];
        for request in measuring {
            bench.ask(Request::install(Password::FACTORY).encode(0).bytes());
            let before = bench.sent().len();
            bench.ask(request.encode(0).bytes());
            let reply = bench.sent()[before..]
                .iter()
                .find(|(_, sent)| sent.is_reply)
                .map(|(_, sent)| sent.telegram[4]);
            assert_eq!(reply == Some(0x92), strict, "{request:?}");
        }
        bench.ask(Request::Stop.encode(0).bytes());
        assert_eq!(*bench.machine.operating(), scanhub_sim::operating::Operating::OnRequest);
        let bytes = bench.ask(Request::Stream.encode(0).bytes());
        assert_eq!(bytes[5], 0xA0);
    }
}

/// How many of 100 requests, each written at once or with 55 us between its bytes, get an answer.
fn answered_unspaced(bench: &mut Bench) -> usize {
    let request = Request::Stop.encode(0);
    let mut count = 0;
    for step in [0, 55 * MICROS].repeat(50) {
        let before = bench.sent().len();
        for &byte in request.bytes() {
            bench.run_until(bench.now + step);
            bench.machine.receive(byte, Arrival::at(bench.now));
        }
        bench.run_until(bench.now + 500 * MILLIS);
        count += bench.sent().len() - before;
    }
    count
}

#[test]
fn what_a_host_leaves_to_its_uart_is_heard_unless_the_sensor_is_strict() {
    for (baud, line_ns) in
        [(Baud::B9600, 6 * line_time(1, 9_600)), (Baud::B500000, 6 * line_time(1, 500_000))]
    {
        let slow = Settings { baud, ..fast() };
        let mut bench = Bench::new(slow.clone());
        assert_eq!(answered_unspaced(&mut bench), 100);
        assert_eq!(bench.machine.take_dropped(), None);
        assert!(bench.chunks[0].0 >= line_ns + 2 * MILLIS, "the line carries it first");
        bench.machine.set_quirks(ProtocolQuirks { strict_gap: true, ..ProtocolQuirks::default() });
        assert_eq!(answered_unspaced(&mut bench), 0);
        assert_eq!(bench.machine.take_dropped(), Some(Dropped::ShortGap));
        let strict =
            Settings { quirks: ProtocolQuirks { strict_gap: true, ..ProtocolQuirks::default() }, ..slow };
        assert_eq!(answered_unspaced(&mut Bench::new(strict.clone())), 0);
        assert!(matches!(
            reply(&Bench::new(strict).ask(Request::Status.encode(0).bytes())),
            Reply::Status(_)
        ));
    }
}

#[test]
fn a_sensor_may_think_as_long_each_time() {
    let mut bench = with(ProtocolQuirks { answer_ns: 60 * MILLIS, ..ProtocolQuirks::default() });
    for request in [Request::Type, Request::Stop, Request::Variant(Variant::HALF)] {
        let before = bench.chunks.len();
        bench.ask(request.encode(0).bytes());
        let [(acknowledged, _), (replied, chunk), ..] = &bench.chunks[before..] else {
            panic!("{request:?}")
        };
        let line_ns = line_time(chunk.bytes.len(), 500_000);
        assert_eq!(replied - acknowledged, 60 * MILLIS + line_ns, "{request:?}");
    }
}
