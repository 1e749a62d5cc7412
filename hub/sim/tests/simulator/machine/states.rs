//! Tests of a simulated LMS in operating modes that a previous host selected, after power cycles and resets, and with
//! protocol quirks.

use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{ACK, NAK, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, MIRROR_PERIOD, Unit, Variant};
use scanhub_lms_configure::eeprom::{EepromWrite, PowerOn};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::{Arrival, DroppedRequest};

use super::{Bench, fast_settings, reply};

/// Returns the telegrams that a scanner in mode `operating` sends within a second, with the times of their last bytes.
fn streamed_telegrams(operating: OperatingMode, settings: Settings) -> Vec<(Nanos, Vec<u8>)> {
    let code = operating.code();
    let mut bench = Bench::new(Settings { start: StartState::Operating(operating), ..settings });
    bench.run_until(1_000 * MILLIS);
    let sent = bench.sent();
    assert!(sent.iter().all(|(_, sent)| !sent.is_reply && Telegram::check(&sent.telegram).is_some()));
    let status = bench.ask(&[0x02, 0, 1, 0, 0x31, 0x15, 0x12]);
    let at = status.windows(5).position(|five| five == [0x02, 0x80, 0x9A, 0, 0xB1]).expect("a status");
    assert_eq!(status[at + 12], code);
    sent.into_iter().map(|(at, sent)| (at, sent.telegram)).collect()
}

/// Checks that all `telegrams` have the command `command` and the length `len`, and that `mirror_turns` revolutions of
/// the mirror pass between two of them.
fn assert_stream(telegrams: &[(Nanos, Vec<u8>)], command: u8, len: usize, mirror_turns: u64) {
    assert!(telegrams.len() > 3, "{}", telegrams.len());
    for pair in telegrams.windows(2) {
        assert_eq!((pair[0].1[4], pair[0].1.len()), (command, len));
        assert_eq!(pair[1].0 - pair[0].0, mirror_turns * MIRROR_PERIOD);
    }
}

#[test]
fn every_operating_mode_streams_its_telegrams() {
    assert_stream(&streamed_telegrams(OperatingMode::All, fast_settings()), 0xB0, 732, 2);
    assert_stream(&streamed_telegrams(OperatingMode::Means(5), fast_settings()), 0xB6, 733, 10);
    assert_stream(
        &streamed_telegrams(OperatingMode::Range(27, 299), fast_settings()),
        0xB7,
        6 + 1 + 6 + 2 * 273 + 1,
        2,
    );
    assert_stream(
        &streamed_telegrams(OperatingMode::MeanRange(2, 1, 181), fast_settings()),
        0xBF,
        6 + 1 + 7 + 2 * 181 + 1,
        4,
    );
    assert_stream(&streamed_telegrams(OperatingMode::Fields(1, 100), fast_settings()), 0xBE, 814, 2);
    assert_stream(
        &streamed_telegrams(OperatingMode::Reflectivity(vec![(1, 181)]), fast_settings()),
        0xF5,
        740,
        2,
    );
    assert!(streamed_telegrams(OperatingMode::OnRequest, fast_settings()).is_empty());
    assert!(streamed_telegrams(OperatingMode::Installation, fast_settings()).is_empty());
}

#[test]
fn partial_scans_alternate() {
    for (variant, quarters) in
        [(Variant::ALL[0], &[0u8][..]), (Variant::HALF, &[0, 2]), (Variant::ALL[4], &[0, 1, 2, 3])]
    {
        let telegrams = streamed_telegrams(OperatingMode::Partial, Settings { variant, ..fast_settings() });
        for (number, (_, telegram)) in telegrams.iter().enumerate() {
            let measured = MeasuredValues::decode(Telegram::check(telegram).unwrap()).expect("values");
            let quarter = quarters[number % quarters.len()];
            assert_eq!(measured.partial(), Some(quarter));
            assert_eq!(measured.count(), if quarter == 0 { 181 } else { 180 });
        }
        assert!(telegrams.windows(2).all(|pair| (pair[1].0 - pair[0].0).abs_diff(MIRROR_PERIOD) <= 40_000));
    }
}

#[test]
fn partial_scans_start_with_the_first_part() {
    let mut bench = Bench::new(fast_settings());
    bench.ask(Writer::new(0, 0x30).byte(1).finish().bytes());
    bench.ask(Writer::new(0, 0x20).byte(0x2A).finish().bytes());
    let sent = bench.sent();
    let quarters = sent[2..4].iter().map(|(_, sent)| {
        MeasuredValues::decode(Telegram::check(&sent.telegram).unwrap())
            .and_then(|measured| measured.partial())
    });
    assert_eq!(quarters.collect::<Vec<_>>(), [Some(0), Some(2)]);
}

#[test]
fn indices_count_mirror_turns_and_telegrams() {
    let settings = Settings { availability: 2, baud: Baud::B38400, ..fast_settings() };
    let telegrams = streamed_telegrams(OperatingMode::All, settings);
    assert!(telegrams.iter().all(|(_, telegram)| telegram.len() == 734));
    let indices: Vec<(u8, u8)> = telegrams
        .iter()
        .map(|(_, telegram)| {
            MeasuredValues::decode(Telegram::check(telegram).unwrap()).unwrap().indices().unwrap()
        })
        .collect();
    for pair in indices.windows(2) {
        assert_eq!(pair[1].1, pair[0].1 + 1);
        assert_eq!(pair[1].0.wrapping_sub(pair[0].0), 16, "8 scans of 2 revolutions each");
    }
}

#[test]
fn single_telegrams_can_be_requested() {
    let mut bench = Bench::new(Settings { unit: Unit::Cm, ..fast_settings() });
    for (request, command, len) in [
        (Writer::new(0, 0x30).byte(1), 0xB0, 732),
        (Writer::new(0, 0x30).byte(8), 0xB0, 372),
        (Writer::new(0, 0x36).byte(3), 0xB6, 733),
        (Writer::new(0, 0x37).word(1).word(361), 0xB7, 736),
        (Writer::new(0, 0x75).word(1).word(1).word(10), 0xF5, 56),
        (Writer::new(0, 0x75).byte(1).word(1).word(10), 0x92, 8),
        (Writer::new(0, 0x37).word(1).word(362), 0x92, 8),
        (Writer::new(0, 0x3E).word(1).word(101), 0x92, 8),
        (Writer::new(0, 0x75).word(1).word(1).word(361), 0x92, 8),
    ] {
        let answer = bench.ask(request.finish().bytes());
        assert_eq!((answer[5], answer.len() - 1), (command, len));
    }
    // An LMS 211 refuses 180 degrees, because it measures no more than 100 degrees.
    let type_name = "LMS211;301063;V02.30 ".into();
    let mut bench = Bench::new(Settings { type_name, variant: Variant::ALL[3], ..fast_settings() });
    let kept = bench.ask(Writer::new(0, 0x3B).word(180).word(50).finish().bytes());
    assert_eq!(kept[5..11], [0xBB, 0, 100, 0, 50, 0]);
}

const BOOT_TIME: Nanos = 3_000 * MILLIS;

fn installation_request() -> Vec<u8> {
    Writer::new(0, 0x20).byte(0).slice(b"SICK_LMS").finish().bytes().to_vec()
}

#[test]
fn power_cycle_aborts_resets_and_sends_boot_message() {
    let mut bench = Bench::new(Settings {
        start: StartState::Operating(OperatingMode::All),
        boot_ns: BOOT_TIME,
        unit: Unit::Cm,
        ..fast_settings()
    });
    bench.ask(Request::Variant(Variant::ALL[0]).encode(0).bytes());
    let next = bench.sent().last().unwrap().0 + 10 * MILLIS;
    bench.run_until(next);
    assert!(bench.machine.power_cycle(next), "nothing was on the line");
    let before = bench.chunks.len();
    bench.run_until(next + BOOT_TIME - 1_000 * MILLIS);
    assert!(
        bench.ask(Request::Status.encode(0).bytes()).is_empty(),
        "a request was accepted during the start-up"
    );
    bench.run_until(next + 2 * BOOT_TIME);
    let sent: Vec<_> = bench.sent().into_iter().filter(|(at, _)| *at > next).collect();
    assert_eq!((sent[0].1.aborted, sent[0].1.is_reply, sent.len()), (true, false, 2));
    assert_eq!((sent[1].1.telegram[4], sent[1].1.is_reply), (0x90, true));
    assert!(sent[1].0 >= next + BOOT_TIME);
    let boot_message =
        bench.chunks[before..].iter().rev().find(|(_, chunk)| !chunk.bytes.is_empty()).unwrap();
    assert_eq!((boot_message.1.rate, bench.machine.baud()), (9_600, Baud::B9600));
    let answer = bench.ask(Request::Status.encode(0).bytes());
    let Reply::Status(status) = reply(&answer) else { panic!("no status") };
    assert_eq!(
        (status.operating_mode(), status.variant(), status.unit()),
        (0x25, Some(Variant::HALF), Some(Unit::Cm))
    );
    assert!(!bench.machine.power_cycle(bench.now), "an idle line");
}

#[test]
fn reset_sends_a_reply_and_a_boot_message() {
    let errors = vec![(0x84, 22), (1, 49)];
    let mut bench = Bench::new(Settings { boot_ns: BOOT_TIME, errors, ..fast_settings() });
    let errors_reply = bench.ask(&[0x02, 0, 1, 0, 0x32, 0x16, 0x12]);
    assert_eq!(errors_reply[5..10], [0xB2, 0x84, 22, 1, 49]);
    let bytes = bench.ask(&[0x02, 0, 1, 0, 0x10, 0x34, 0x12]);
    assert_eq!(bytes[..9], [ACK, 0x02, 0x80, 2, 0, 0x91, 0x10, 0x79, 0x30]);
    assert_eq!(bytes.len(), 9);
    let before = bench.chunks.len();
    bench.run_until(bench.now + 2 * BOOT_TIME);
    let boot_message = bench.bytes_from(before);
    assert_eq!(
        (Telegram::check(&boot_message).unwrap().command(), bench.machine.baud()),
        (0x90, Baud::B9600)
    );
    assert_eq!(bench.ask(&[0x02, 0, 1, 0, 0x32, 0x16, 0x12])[5..7], [0xB2, 0x10], "faults were not cleared");
}

#[test]
fn scanner_can_power_on_at_simulation_start() {
    let mut bench =
        Bench::new(Settings { start: StartState::PowerOn, boot_ns: BOOT_TIME, ..Settings::default() });
    bench.run_until(BOOT_TIME - 1);
    assert!(bench.chunks.is_empty());
    bench.run_until(BOOT_TIME + 100 * MILLIS);
    assert_eq!(Telegram::check(&bench.bytes_from(0)).unwrap().command(), 0x90);
}

#[test]
fn permanent_rate_needs_installation_mode_and_stays() {
    let mut bench = Bench::new(fast_settings());
    let keep = Writer::new(0, 0x66).byte(1).finish();
    assert_eq!(reply(&bench.ask(keep.bytes())), Reply::Refused);
    bench.ask(&installation_request());
    assert_eq!(bench.ask(keep.bytes())[5], 0xE6);
    assert_eq!((bench.machine.eeprom_writes(), bench.machine.operating()), (2, &OperatingMode::Installation));
    bench.machine.power_cycle(bench.now);
    bench.run_until(bench.now + 10_000 * MILLIS);
    assert_eq!((bench.machine.baud(), bench.machine.operating()), (Baud::B500000, &OperatingMode::OnRequest));
    let status = bench.ask(Request::Status.encode(0).bytes());
    assert_eq!(status[5 + 119], 1);
    bench.ask(&installation_request());
    bench.ask(Writer::new(0, 0x66).byte(0).finish().bytes());
    bench.machine.power_cycle(bench.now);
    assert_eq!(bench.machine.baud(), Baud::B9600);
}

#[test]
fn short_configuration_changes_only_leading_bytes() {
    for (configuration_len, length) in [(34, 0x24), (32, 0x22)] {
        let mut bench = Bench::new(Settings { configuration_len, availability: 2, ..fast_settings() });
        let before = bench.ask(Request::Configuration.encode(0).bytes());
        assert_eq!(before[3], length);
        bench.ask(&installation_request());
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
fn status_reply_reports_errors_and_pollution() {
    let errors = vec![(4, 22)];
    let mut bench =
        Bench::new(Settings { status: 0x94, errors, pollution_percent: 60, address: 7, ..fast_settings() });
    let bytes = bench.ask(Request::Status.encode(7).bytes());
    let telegram = Telegram::check(&bytes[1..]).unwrap();
    let Reply::Status(report) = Reply::decode(telegram).unwrap() else { panic!("no status") };
    assert!(report.is_defective() && telegram.status() == Some(0x94));
    let word = |at: usize| u16::from_le_bytes([telegram.data()[at - 1], telegram.data()[at]]);
    assert_eq!((word(19), word(33), word(43), word(57)), (600, 600, 1000, 1000));
    assert_eq!(telegram.data()[119], 7);
}

fn bench_with_quirks(quirks: ProtocolQuirks) -> Bench {
    Bench::new(Settings { quirks, ..fast_settings() })
}

/// Sends 200 requests for the type to a scanner with `quirks`. Returns the number of replies that start with the byte
/// `first`, or of missing replies if `first` is `None`.
fn replies_of_200(quirks: ProtocolQuirks, first: Option<u8>) -> usize {
    let mut bench = bench_with_quirks(quirks);
    let request = Request::Type.encode(0);
    (0..200).filter(|_| bench.ask(request.bytes()).first().copied() == first).count()
}

#[test]
fn share_of_requests_is_ignored_or_gets_a_nak() {
    let overlooked =
        replies_of_200(ProtocolQuirks { overlooked_share: 0.3, ..ProtocolQuirks::default() }, None);
    assert!((40..80).contains(&overlooked), "{overlooked}");
    let refused = replies_of_200(ProtocolQuirks { nak_share: 0.3, ..ProtocolQuirks::default() }, Some(NAK));
    assert!((40..80).contains(&refused), "{refused}");
    assert_eq!(replies_of_200(ProtocolQuirks { is_mute: true, ..ProtocolQuirks::default() }, None), 200);
}

#[test]
fn configured_command_is_refused() {
    let mut bench =
        bench_with_quirks(ProtocolQuirks { refused_commands: vec![0x3A], ..ProtocolQuirks::default() });
    assert_eq!(reply(&bench.ask(Request::Type.encode(0).bytes())), Reply::Refused);
    assert!(matches!(reply(&bench.ask(Request::Status.encode(0).bytes())), Reply::Status(_)));
    bench.machine.set_quirks(ProtocolQuirks::default());
    assert!(matches!(reply(&bench.ask(Request::Type.encode(0).bytes())), Reply::Type(_)));
}

#[test]
fn repeated_replies_are_equal() {
    let mut bench = bench_with_quirks(ProtocolQuirks { doubled_share: 1.0, ..ProtocolQuirks::default() });
    bench.ask(Request::Type.encode(0).bytes());
    let sent = bench.sent();
    assert_eq!((sent.len(), &sent[0].1.telegram), (2, &sent[1].1.telegram));
}

#[test]
fn late_reply_is_sent_after_the_next_request() {
    let mut bench =
        bench_with_quirks(ProtocolQuirks { late_reply_ns: 800 * MILLIS, ..ProtocolQuirks::default() });
    assert_eq!(bench.ask(Request::Type.encode(0).bytes()), [ACK]);
    assert_eq!(bench.ask(Request::Stop.encode(0).bytes())[0], ACK);
    bench.run_until(bench.now + 2_000 * MILLIS);
    let commands: Vec<u8> = bench.sent().iter().map(|(_, sent)| sent.telegram[4]).collect();
    assert_eq!(commands, [0xBA, 0xA0]);
    let mut bench =
        bench_with_quirks(ProtocolQuirks { late_acknowledge_ns: 300 * MILLIS, ..ProtocolQuirks::default() });
    bench.send(Request::Type.encode(0).bytes(), 60_000);
    let requested_at = bench.now;
    bench.run_until(requested_at + 1_000 * MILLIS);
    assert!(bench.chunks[0].0 >= requested_at + 300 * MILLIS && bench.chunks[0].1.bytes == [ACK]);
}

#[test]
fn mode_change_is_slow_but_status_is_immediate() {
    let mut bench =
        bench_with_quirks(ProtocolQuirks { late_mode_ns: 2_000 * MILLIS, ..ProtocolQuirks::default() });
    for request in [Request::Stop, Request::Variant(Variant::ALL[0]), Request::Baud(Baud::B500000)] {
        assert_eq!(bench.ask(request.encode(0).bytes()), [ACK]);
        let before = bench.sent().len();
        bench.run_until(bench.now + 2_000 * MILLIS);
        assert_eq!(bench.sent().len(), before + 1, "{request:?}");
    }
    // If a host does not wait for the confirmation of a change and sends another request, it receives the reply to this
    // request, but never the confirmation.
    assert_eq!(bench.ask(Request::Stop.encode(0).bytes()), [ACK]);
    let before = bench.sent().len();
    assert!(matches!(reply(&bench.ask(Request::Status.encode(0).bytes())), Reply::Status(_)));
    bench.run_until(bench.now + 5_000 * MILLIS);
    assert_eq!(bench.sent().len(), before + 1);
}

#[test]
fn eeprom_write_delays_the_reply() {
    let mut bench =
        bench_with_quirks(ProtocolQuirks { late_write_ns: 6_000 * MILLIS, ..ProtocolQuirks::default() });
    assert_eq!(
        reply(&bench.ask(Request::install(Password::FACTORY).encode(0).bytes())),
        Reply::Mode { done: true }
    );
    for write in [EepromWrite::Configuration(&[20, 0]), EepromWrite::PowerOn(PowerOn::Baud9600)] {
        let before = bench.sent().len();
        assert_eq!(bench.ask(write.encode(0).expect("short enough").bytes()), [ACK]);
        bench.run_until(bench.now + 5_400 * MILLIS);
        assert_eq!(bench.sent().len(), before, "{write:?}");
        bench.run_until(bench.now + 600 * MILLIS);
        assert_eq!(bench.sent()[before].1.telegram[4], write.command() | 0x80);
    }
}

#[test]
fn installation_mode_blocks_measuring_if_strict() {
    for strict in [false, true] {
        let mut bench = bench_with_quirks(ProtocolQuirks { is_strict: strict, ..ProtocolQuirks::default() });
        bench.ask(Request::install(Password::FACTORY).encode(0).bytes());
        let measuring = [
            Request::Operate(lms::operating::Operating::Means(2)),
            Request::Operate(lms::operating::Operating::Partial),
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
        assert_eq!(*bench.machine.operating(), OperatingMode::OnRequest);
        let bytes = bench.ask(Request::Stream.encode(0).bytes());
        assert_eq!(bytes[5], 0xA0);
    }
}

/// Sends 100 requests, half of them at once and half of them with one byte every 55 us. Returns the number of requests
/// to which the scanner replies.
fn unspaced_replies_of_100(bench: &mut Bench) -> usize {
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
fn strict_scanner_ignores_requests_without_byte_gaps() {
    for (baud, line_ns) in
        [(Baud::B9600, 6 * line_time(1, 9_600)), (Baud::B500000, 6 * line_time(1, 500_000))]
    {
        let slow = Settings { baud, ..fast_settings() };
        let mut bench = Bench::new(slow.clone());
        assert_eq!(unspaced_replies_of_100(&mut bench), 100);
        assert_eq!(bench.machine.take_dropped(), None);
        assert!(bench.chunks[0].0 >= line_ns + 2 * MILLIS, "the line carries it first");
        bench.machine.set_quirks(ProtocolQuirks { checks_gaps: true, ..ProtocolQuirks::default() });
        assert_eq!(unspaced_replies_of_100(&mut bench), 0);
        assert_eq!(bench.machine.take_dropped(), Some(DroppedRequest::ShortGap));
        let strict =
            Settings { quirks: ProtocolQuirks { checks_gaps: true, ..ProtocolQuirks::default() }, ..slow };
        assert_eq!(unspaced_replies_of_100(&mut Bench::new(strict.clone())), 0);
        assert!(matches!(
            reply(&Bench::new(strict).ask(Request::Status.encode(0).bytes())),
            Reply::Status(_)
        ));
    }
}

#[test]
fn reply_delay_is_constant() {
    let mut bench =
        bench_with_quirks(ProtocolQuirks { reply_delay_ns: 60 * MILLIS, ..ProtocolQuirks::default() });
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
