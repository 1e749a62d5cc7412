//! Tests of scanners that refuse or overlook requests or send wrong replies, of lines that lose requests or replies,
//! and of streams that stop. The session streams anyway, and reports what the scanner reports about its own condition.

use scanhub_drivers::line::{ScannerSession as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::status::StatusByte;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_drivers::lms::{Notice, Problem};
use scanhub_schema::MILLIS;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::{OperatingMode, ScanSource};
use scanhub_sim::room::Room;

use super::{Bench, HostFilter, SESSION_SETTINGS, make_stream, sensor, sensor_with};

#[test]
fn streams_the_current_variant_after_a_refusal() {
    let variant = Variant::ALL[0];
    let scan = |i: u16| lms::measured::encode(0, Unit::Cm, &[700 + i % 50; 181], 0x10).bytes().to_vec();
    let telegrams = Box::new((0..).map(scan));
    let settings = Settings { variant, baud: Baud::B9600, ..Settings::default() };
    let mut bench = Bench::new(LmsSimulator::new(settings, ScanSource::Recorded { variant, telegrams }), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming() && bench.received_scans(0).len() > 60, "{bench}");
    assert_eq!(bench.session.problem(), Some(Problem::VariantRefused));
    assert_eq!(bench.session.sensor().variant, Some(variant));
}

#[test]
fn refused_variant_is_reported_again_after_silence() {
    let variant = Variant::ALL[0];
    let quirks = ProtocolQuirks { refused_commands: vec![0x3B], ..ProtocolQuirks::default() };
    let settings = Settings { variant, quirks, ..Settings::default() };
    let mut bench =
        Bench::new(LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1))), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let cut = bench.now;
    bench.to_host = Box::new(move |at, bytes| if at < cut + 1_050 * MILLIS { Vec::new() } else { bytes });
    bench.run_until("silent", 1_040 * MILLIS, |bench| bench.session.state() == State::Silent);
    assert_eq!(bench.session.problem(), Some(Problem::Silence));
    bench.states.clear();
    // The scanner sends no replies, so the session does not know the measuring mode for some time.
    let mute = ProtocolQuirks { is_mute: true, ..ProtocolQuirks::default() };
    bench.machine.set_quirks(mute);
    bench.run_until("streaming", 200 * MILLIS, Bench::is_streaming);
    bench.run_until("reported", 10_000 * MILLIS, |bench| {
        bench.session.problem() == Some(Problem::ModeUnknown)
    });
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.run_until("mode known", 11_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.problem(), Some(Problem::VariantRefused), "{bench}");
    assert_eq!(bench.states, [State::Silent, State::Streaming], "the session did not take over the stream");
}

#[test]
fn any_byte_of_the_requests_may_be_lost_or_damaged() {
    let sent_count = {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.sent_bytes.len()
    };
    assert!(sent_count >= 30);
    for wrong in 0..sent_count {
        for damage in [None, Some(0x40)] {
            let mut bench = Bench::new(sensor(Baud::B9600), 0);
            bench.to_scanner = Box::new(move |number, byte| match damage {
                _ if number != wrong => Some(byte),
                None => None,
                Some(bits) => Some(byte ^ bits),
            });
            // If the scanner did not receive a change of rate, the session detects this after three attempts and a
            // search.
            bench.run_until("streaming", 6_000 * MILLIS, Bench::is_streaming);
            bench.run(200 * MILLIS);
            assert!(bench.is_streaming(), "byte {wrong} {damage:?}: {bench}");
        }
    }
}

#[test]
fn any_reply_may_be_lost_or_damaged() {
    let replies = {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.sent.iter().filter(|sent| sent.is_reply).count()
    };
    assert!(replies >= 4);
    // Damage each of the first chunks, which are the replies and their acknowledgements.
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
            bench.run_until("streaming", 10_000 * MILLIS, Bench::is_streaming);
            bench.run(200 * MILLIS);
            assert!(bench.is_streaming(), "chunk {wrong} {damage:?}: {bench}");
        }
    }
}

#[test]
fn silence_of_1_s_restarts_with_two_requests() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(300 * MILLIS);
    let (cut, sent_count) = (bench.now, bench.sent_bytes.len());
    bench.to_host = Box::new(move |at, bytes| if at < cut + 1_050 * MILLIS { Vec::new() } else { bytes });
    bench.run_until("silent", 1_040 * MILLIS, |bench| bench.session.state() == State::Silent);
    assert!(bench.now >= cut + 970 * MILLIS, "stopped trying early: {bench}");
    assert_eq!((bench.session.stats().resyncs, bench.session.problem()), (1, Some(Problem::Silence)));
    bench.run_until("streaming", 200 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming(), "{bench}");
    assert_eq!((bench.session.stats().resyncs, bench.session.problem()), (1, None));
    // The session requests the type and the mode again, because another scanner may be connected.
    assert_eq!(bench.sent_bytes.len(), sent_count + 2 * 7);
}

#[test]
fn longer_silence_is_followed_by_a_search() {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    let cut = bench.now;
    bench.to_host = Box::new(move |at, bytes| if at < cut + 5_000 * MILLIS { Vec::new() } else { bytes });
    bench.run(5_000 * MILLIS);
    assert!(!bench.is_streaming());
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.problem(), None);
}

#[test]
fn resumes_after_a_power_cycle() {
    let mut machine = sensor(Baud::B500000);
    let started = make_stream(&mut machine);
    let mut bench = Bench::new(machine, started);
    bench.run_until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    bench.machine = sensor(Baud::B9600);
    bench.run_until("silent", 1_100 * MILLIS, |bench| bench.session.state() == State::Silent);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
    assert_eq!((bench.session.stats().resyncs, bench.session.problem()), (1, None));
}

#[test]
fn streams_after_variant_request_fails() {
    let settings =
        Settings { variant: Variant { angle_deg: 180, resolution_cdeg: 100 }, ..Settings::default() };
    let mut bench =
        Bench::new(LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1))), 0);
    // Damage every request to change the variant, so that the scanner answers it with NAK.
    let mut sent = Vec::new();
    bench.to_scanner = Box::new(move |_, byte| {
        sent.push(byte);
        Some(if sent.ends_with(&[0x02, 0x00, 0x05, 0x00, 0x3B]) { byte ^ 1 } else { byte })
    });
    bench.run_until("streaming", 4_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming(), "{bench}");
    assert_eq!(bench.session.problem(), Some(Problem::VariantRefused));
    assert_eq!(bench.received_scans(0)[0].len(), 372);
}

#[test]
fn accepts_replaced_scanner_with_another_address() {
    let at = |address| {
        let settings = Settings { address, ..Settings::default() };
        LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1)))
    };
    let mut bench = Bench::new(at(1), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.machine = at(2);
    bench.run_until("silent", 2_000 * MILLIS, |bench| !bench.is_streaming());
    bench.run_until("streaming again", 4_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.sensor().address, Some(0x82));
}

/// Checks that scanners with `quirks` stream as configured within `limit` milliseconds. At the start, the scanners are
/// idle or streaming, at each rate.
fn assert_all_stream(quirks: ProtocolQuirks, seeds: std::ops::Range<u64>, limit: u64) {
    let mut longest = 0;
    for seed in seeds {
        for baud in Baud::ALL {
            for operating in [OperatingMode::OnRequest, OperatingMode::All, OperatingMode::Partial] {
                let start = StartState::Operating(operating.clone());
                let settings = Settings { baud, start, seed, quirks: quirks.clone(), ..Settings::default() };
                let mut bench = Bench::new(sensor_with(settings), 0);
                longest = longest.max(bench.run_until("streaming", limit * MILLIS, Bench::is_streaming));
                bench.run(1_500 * MILLIS);
                assert!(bench.is_streaming(), "{seed} {baud:?} {operating:?}: {bench}");
                assert_eq!(bench.session.sensor().variant, Some(Variant::HALF), "{bench}");
                assert_eq!(
                    bench.session.sensor().kind(),
                    b"LMS200;301063;V02.30",
                    "{seed} {operating:?}: {bench}"
                );
            }
        }
    }
    println!("{quirks:?}: the slowest took {} ms", longest / MILLIS);
}

#[test]
fn streams_although_30_percent_of_requests_are_lost() {
    assert_all_stream(ProtocolQuirks { overlooked_share: 0.3, ..ProtocolQuirks::default() }, 0..4, 15_000);
}

#[test]
fn streams_although_30_percent_of_requests_get_a_nak() {
    assert_all_stream(ProtocolQuirks { nak_share: 0.3, ..ProtocolQuirks::default() }, 0..3, 15_000);
}

#[test]
fn streams_although_replies_are_repeated() {
    assert_all_stream(ProtocolQuirks { doubled_share: 1.0, ..ProtocolQuirks::default() }, 0..1, 5_000);
    assert_all_stream(
        ProtocolQuirks { doubled_share: 0.5, overlooked_share: 0.2, ..ProtocolQuirks::default() },
        0..2,
        15_000,
    );
}

#[test]
fn streams_although_acks_and_replies_are_late() {
    // The first delay is the maximum that the listing allows. The other delays are longer.
    for late in [52, 100, 300] {
        let late_ns = late * MILLIS;
        assert_all_stream(
            ProtocolQuirks { late_acknowledge_ns: late_ns, ..ProtocolQuirks::default() },
            0..1,
            20_000,
        );
        assert_all_stream(
            ProtocolQuirks { late_reply_ns: late_ns, ..ProtocolQuirks::default() },
            0..1,
            20_000,
        );
        assert_all_stream(
            ProtocolQuirks { late_reply_ns: late_ns, doubled_share: 0.5, ..ProtocolQuirks::default() },
            0..1,
            20_000,
        );
    }
}

#[test]
fn streams_despite_refused_requests_or_reports_them() {
    for (command, problem) in [(0x3A, None), (0x74, None), (0x3B, Some(Problem::VariantRefused))] {
        let variant = if problem.is_some() { Variant::ALL[0] } else { Variant::HALF };
        let quirks = ProtocolQuirks { refused_commands: vec![command], ..ProtocolQuirks::default() };
        let mut bench = Bench::new(sensor_with(Settings { quirks, variant, ..Settings::default() }), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming(), "{command:02X}: {bench}");
        assert_eq!(bench.session.problem(), problem, "{command:02X}");
    }
    // A scanner that refuses 20h does not stream. The session reports the refusal, and repeats the request at long
    // intervals.
    let quirks = ProtocolQuirks { refused_commands: vec![0x20], ..ProtocolQuirks::default() };
    let mut bench = Bench::new(sensor_with(Settings { quirks, ..Settings::default() }), 0);
    bench.run(2_000 * MILLIS);
    assert!(matches!(bench.session.problem(), Some(Problem::Refused(_))), "{bench}");
    let sent_count = bench.sent_bytes.len();
    bench.run(60_000 * MILLIS);
    assert!(
        bench.sent_bytes.len() - sent_count < 3_000,
        "{} bytes sent in a minute",
        bench.sent_bytes.len() - sent_count
    );
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    assert_eq!(bench.session.problem(), None);
}

#[test]
fn version_s14_streams_with_unknown_angles() {
    for start in [StartState::Operating(OperatingMode::OnRequest), StartState::Operating(OperatingMode::All)]
    {
        let type_name = "LMS291;S14063;X01.27 ".into();
        let (variant, baud) = (Variant::ALL[0], Baud::B500000);
        let settings = Settings { type_name, variant, baud, start, ..Settings::default() };
        let variant_settings = lms::Settings { variant, ..SESSION_SETTINGS };
        let mut bench = Bench::with_settings(variant_settings, sensor_with(settings), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.received_scans(0).len() > 60, "{bench}");
        let mut scans = bench.received.iter().filter(|got| got.telegram[4] == lms::measured::MEASURED);
        assert!(scans.all(|got| got.range_bits.is_none()), "{bench}");
        assert_eq!(bench.session.problem(), Some(Problem::AnglesUnknown));
    }
}

#[test]
fn mode_without_ranges_gives_no_scans() {
    for start in [StartState::Operating(OperatingMode::OnRequest), StartState::Operating(OperatingMode::All)]
    {
        let settings = Settings { mode: Mode(0x3F), baud: Baud::B500000, start, ..Settings::default() };
        let mut bench = Bench::new(sensor_with(settings), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.received_scans(0).len() > 30, "{bench}");
        let mut scans = bench.received.iter().filter(|got| got.telegram[4] == lms::measured::MEASURED);
        assert!(scans.all(|got| got.range_bits.is_none()), "{bench}");
        assert_eq!(bench.session.problem(), Some(Problem::NoRanges(Mode(0x3F))));
    }
}

#[test]
fn takes_over_the_stream_of_a_mute_scanner() {
    let quirks = ProtocolQuirks { is_mute: true, ..ProtocolQuirks::default() };
    let start = StartState::Operating(OperatingMode::All);
    let settings = Settings { baud: Baud::B500000, start, quirks, ..Settings::default() };
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.run_until("streaming", 100 * MILLIS, Bench::is_streaming);
    bench.run(5_000 * MILLIS);
    assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
    assert_eq!(bench.session.problem(), Some(Problem::ModeUnknown));
    // The session sends three requests five times each. Afterwards, it repeats them at long intervals. It never stops
    // trying, because the hub cannot publish scans without a reply.
    assert_eq!(bench.sent_bytes.len(), 15 * 7);
    bench.run(25_000 * MILLIS);
    assert!(bench.sent_bytes.len() <= (15 + 3 * 3) * 7, "{} bytes sent", bench.sent_bytes.len());
    bench.machine.set_quirks(ProtocolQuirks::default());
    bench.run_until("mode known", 11_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(500 * MILLIS);
    assert_eq!((bench.session.problem(), bench.session.stats().resyncs), (None, 0));
}

#[test]
fn streams_even_if_mode_changes_take_2_9_s() {
    for late in [1_100, 1_500, 2_900] {
        let quirks = ProtocolQuirks { late_mode_ns: late * MILLIS, ..ProtocolQuirks::default() };
        assert_all_stream(quirks, 0..1, 15_000);
    }
}

fn streaming_bench(settings: Settings) -> Bench {
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming() && bench.session.problem().is_none(), "{bench}");
    bench
}

#[test]
fn healthy_scanner_has_full_identity_and_no_notices() {
    for (baud, start) in [(Baud::B9600, OperatingMode::OnRequest), (Baud::B500000, OperatingMode::All)] {
        let bench =
            streaming_bench(Settings { baud, start: StartState::Operating(start), ..Settings::default() });
        let known = bench.session.sensor();
        assert_eq!((known.software(), known.kind()), (&b"V02.30"[..], &b"LMS200;301063;V02.30"[..]));
        assert_eq!((known.status_byte, known.defective), (Some(StatusByte::OK), Some(false)));
        assert_eq!((known.permanent_baud, known.window_percent), (Some(false), Some(100)));
        assert!(known.laser_power_percent.is_some());
        assert_eq!(known.notices().next(), None);
    }
}

#[test]
fn reports_dirty_windows_and_errors() {
    for (status, pollution_percent, notices) in [
        (0x11, 100, &[][..]),
        (0x92, 100, &[Notice::Dirty][..]),
        (0x10, 60, &[Notice::Dirty][..]),
        (0x13, 100, &[Notice::Error][..]),
        (0x94, 20, &[Notice::Fatal, Notice::Dirty][..]),
    ] {
        let bench = streaming_bench(Settings { status, pollution_percent, ..Settings::default() });
        let known = bench.session.sensor();
        assert!(known.notices().eq(notices.iter().copied()), "{status:02X} {pollution_percent}: {known:?}");
        assert_eq!(known.window_percent, Some(pollution_percent));
        assert!(notices.iter().all(|notice| notice.is_fault()));
    }
}

#[test]
fn intermittent_condition_is_reported_continuously() {
    let mut bench = streaming_bench(Settings { baud: Baud::B500000, ..Settings::default() });
    // Every fifth scan reports a dirty window.
    bench.to_host = scan_filter(|count, scan| with_dirty_window(scan, count % 5 == 0));
    bench.run_until("reported", 1_000 * MILLIS, |bench| bench.session.sensor().notices().eq([Notice::Dirty]));
    for _ in 0..200 {
        bench.run(27 * MILLIS);
        assert!(bench.session.sensor().notices().eq([Notice::Dirty]), "{bench}");
    }
    bench.to_host = Box::new(|_, bytes| bytes);
    bench.run_until("cleared", 10_000 * MILLIS, |bench| bench.session.sensor().notices().next().is_none());
}

/// Returns a filter that collects whole scans of 361 beams, and passes them on after `change` has changed them.
/// `change` receives the index and the bytes of a scan. The rest of the scan that is on the line at first is lost.
fn scan_filter(change: impl Fn(u32, Vec<u8>) -> Vec<u8> + 'static) -> HostFilter {
    let mut count = 0;
    let mut held = Vec::new();
    Box::new(move |_, bytes| {
        if held.is_empty() && !bytes.starts_with(&[0x02, 0x80, 0xD6, 0x02]) {
            return Vec::new();
        }
        held.extend(bytes);
        if held.len() < 732 {
            return Vec::new();
        }
        count += 1;
        change(count, std::mem::take(&mut held))
    })
}

/// Returns `scan`. If `is_dirty` is set, the scan is changed so that it reports a dirty window, with a valid checksum.
fn with_dirty_window(mut scan: Vec<u8>, is_dirty: bool) -> Vec<u8> {
    if is_dirty {
        scan[729] |= 0x80;
        let sum = lms::telegram::crc(&scan[..730]).to_le_bytes();
        scan[730..].copy_from_slice(&sum);
    }
    scan
}

#[test]
fn single_report_on_a_damaging_line_is_ignored() {
    let mut bench = streaming_bench(Settings { baud: Baud::B500000, ..Settings::default() });
    bench.to_host = scan_filter(|count, scan| match count % 4 {
        0 => scan[..700].to_vec(),
        _ => with_dirty_window(scan, count == 101 || count == 103),
    });
    for _ in 0..300 {
        bench.run(27 * MILLIS);
        assert_eq!(bench.session.sensor().notices().next(), None, "{bench}");
    }
    // If the scanner reports a condition repeatedly, the session reports it as a notice.
    bench.to_host = scan_filter(|count, scan| match count % 4 {
        0 => scan[..700].to_vec(),
        _ => with_dirty_window(scan, true),
    });
    bench.run_until("reported", 1_000 * MILLIS, |bench| bench.session.sensor().notices().eq([Notice::Dirty]));
}
