//! Tests of sessions with packets of RPLIDAR scanners. They cover revolutions, stamps, damage, and sessions on
//! recordings, which have no scanner. For any input, the session counts every byte once and does not panic.

use scanhub_drivers::line::{Action, Control, Event, Protocol as _, RawScan, ScannerSession as _};
use scanhub_drivers::rplidar::packet::PacketFormat;
use scanhub_drivers::rplidar::{Mode, Model, Problem, RplidarSession};
use scanhub_drivers::{Settings, line};
use scanhub_schema::{MILLIS, Nanos};

use super::start::settings_of;
use super::{ONE_SECOND, RecordedOutput, SimulatedScanner, TestBench};
use crate::DamageRates;

#[test]
fn receives_every_revolution_in_every_mode() {
    for model in Model::ALL {
        for mode in Mode::ALL {
            let head = SimulatedScanner::new(model, 1);
            if !head.has_mode(mode) {
                continue;
            }
            let mut bench = TestBench::new(Settings { mode: Some(mode.name()), ..settings_of(model) }, head);
            bench.run(2 * ONE_SECOND);
            let before = bench.log.revolutions.len();
            bench.run(12 * ONE_SECOND);
            let revolutions = bench.log.revolutions.len() - before;
            let due = 10.0 * bench.scanner.hz;
            assert!(
                (due - 2.0..=due + 2.0).contains(&(revolutions as f64)),
                "{model:?} {mode:?}: {revolutions}"
            );
            assert!(
                bench.log.revolutions.iter().all(|delivered| !delivered.incomplete),
                "{model:?} {mode:?}"
            );
            let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
            assert_eq!(wrong, 0, "{model:?} {mode:?}");
            assert!(worst < 5 * MILLIS, "{model:?} {mode:?}: {worst}");
            bench.assert_intact_packets_once_in_order();
            let stats = bench.session.stats();
            assert_eq!((stats.lost, stats.damaged, stats.resyncs), (0, 0, 0), "{model:?} {mode:?}");
            assert_eq!(stats.due as usize, bench.log.packets.len());
        }
    }
}

/// All packet formats, each with a model and a mode that uses it.
const PACKET_KINDS: [(Model, Mode); 6] = [
    (Model::A1, Mode::Standard),
    (Model::A1, Mode::Express),
    (Model::A1, Mode::Sensitivity),
    (Model::A3, Mode::Sensitivity),
    (Model::S2, Mode::DenseBoost),
    (Model::S3, Mode::UltraDense),
];

fn in_mode((model, mode): (Model, Mode), seed: u64) -> TestBench {
    TestBench::new(
        Settings { mode: Some(mode.name()), ..settings_of(model) },
        SimulatedScanner::new(model, seed),
    )
}

#[test]
fn stamps_stay_right_if_point_time_is_misreported() {
    for kind in PACKET_KINDS {
        for drift in [-0.012, 0.007_5, 0.012] {
            let mut bench = in_mode(kind, 1);
            bench.scanner.drift = drift;
            bench.run(30 * ONE_SECOND);
            let revolutions = &bench.log.revolutions;
            let (early, wrong) = bench.check_revolutions(revolutions);
            let from =
                revolutions.iter().position(|revolution| revolution.first > 4 * ONE_SECOND).expect("some");
            let (worst, _) = bench.check_revolutions(&revolutions[from..]);
            println!("{kind:?} {drift}: {early} {worst}");
            assert!(early < 12 * MILLIS && worst < 5 * MILLIS, "{kind:?} {drift}: {early} {worst}");
            assert_eq!(wrong, 0);
            assert_eq!(bench.session.stats().lost, 0);
        }
    }
}

#[test]
fn stamps_after_host_stall_are_within_5_ms() {
    for kind in PACKET_KINDS {
        for drift in [0.0, 0.007_5] {
            let mut bench = in_mode(kind, 3);
            bench.scanner.drift = drift;
            for stall in 2..20 {
                bench.run(stall * ONE_SECOND);
                bench.now += 500 * MILLIS;
                bench.read(true);
            }
            bench.run(20 * ONE_SECOND);
            let revolutions = &bench.log.revolutions;
            let from =
                revolutions.iter().position(|revolution| revolution.first > 4 * ONE_SECOND).expect("some");
            let (early, wrong) = bench.check_revolutions(revolutions);
            let (worst, _) = bench.check_revolutions(&revolutions[from..]);
            println!("{kind:?} {drift}: {early} {worst}");
            assert!(early < 12 * MILLIS && worst < 5 * MILLIS, "{kind:?} {drift}: {early} {worst}");
            assert_eq!((wrong, bench.session.stats().lost), (0, 0));
            let periods = revolutions[from..].windows(2).map(|pair| pair[1].first - pair[0].first);
            let (shortest, longest) = (periods.clone().min().expect("some"), periods.max().expect("some"));
            assert!(longest - shortest < 10 * MILLIS, "evenly: {shortest} {longest}");
            bench.assert_intact_packets_once_in_order();
        }
    }
}

#[test]
fn counts_packets_lost_in_a_full_buffer() {
    for kind in PACKET_KINDS {
        for gap in [60, 250, 700] {
            let mut bench = in_mode(kind, 3);
            bench.run(5 * ONE_SECOND);
            let before = bench.session.revolution_counts();
            bench.scanner.lose_until(5 * ONE_SECOND + gap * MILLIS);
            bench.now += gap * MILLIS;
            bench.read(true);
            bench.run(12 * ONE_SECOND);
            let counts = bench.session.revolution_counts();
            let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
            println!("{kind:?} {gap}: {worst} {counts:?}");
            assert!(worst < 5 * MILLIS, "{kind:?} {gap}: {worst}");
            assert_eq!(wrong, 0, "{kind:?} {gap}");
            assert!(counts.incomplete + counts.short > before.incomplete + before.short, "{kind:?} {gap}");
            let lost = bench.session.stats().lost;
            let due = bench
                .scanner
                .sent
                .iter()
                .filter(|sent| !sent.intact && sent.at < bench.now - ONE_SECOND)
                .count() as u64;
            assert!(lost.abs_diff(due) <= 2 + due / 50, "{kind:?} {gap}: {lost} of {due}");
            assert_eq!(bench.session.stats().resyncs, 0);
        }
    }
}

/// Checks that the session counts dropped packets. Only complete packets are dropped. The bytes of the next packet
/// therefore follow directly after the bytes of the previous packet, even if whole revolutions were dropped.
#[test]
fn counts_loss_of_whole_packets_in_a_full_buffer() {
    for kind in PACKET_KINDS {
        for (room, more) in [(4_096, 40), (576, 40), (300, 25)] {
            for stall in 0..more {
                let mut bench = in_mode(kind, 3);
                bench.run(4 * ONE_SECOND);
                let filled = room as f64 / bytes_per_second(&bench);
                let stall = (filled * 1e9) as u64 + stall * 7 * MILLIS;
                let before = bench.session.revolution_counts();
                bench.scanner.overflow(bench.now + stall, room);
                bench.now += stall;
                bench.read(true);
                bench.run(7 * ONE_SECOND);
                let dropped = bench.scanner.sent.iter().filter(|sent| !sent.intact).count();
                if dropped == 0 || (kind.1 == Mode::Standard && dropped <= 31) {
                    continue;
                }
                let counts = bench.session.revolution_counts();
                let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
                let context = format!("{kind:?} {room} {} ms: {worst} {wrong} {counts:?}", stall / MILLIS);
                assert!(worst < 5 * MILLIS && wrong == 0, "{context}");
                assert!(counts.incomplete + counts.short > before.incomplete + before.short, "{context}");
            }
        }
    }
}

/// A pty and its driver buffer more bytes than one read returns. The host reads the bytes in pieces while more bytes
/// arrive.
#[test]
fn stamps_after_pty_overflow_are_within_3_ms() {
    for kind in [(Model::A3, Mode::Sensitivity), (Model::S2, Mode::DenseBoost), (Model::S3, Mode::UltraDense)]
    {
        for hz in [0.97, 1.03] {
            for stall in (250..650).step_by(25) {
                let mut bench = in_mode(kind, 3);
                bench.scanner.hz *= hz;
                bench.run(4 * ONE_SECOND);
                bench.scanner.overflow(bench.now + stall * MILLIS, 17_024);
                bench.now += stall * MILLIS;
                bench.read(true);
                bench.run(7 * ONE_SECOND);
                let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
                assert!(worst < 3 * MILLIS && wrong == 0, "{kind:?} {hz} {stall}: {worst} {wrong}");
            }
        }
    }
}

fn bytes_per_second(bench: &TestBench) -> f64 {
    let kind = bench.scanner.kind().expect("measuring");
    let points = bench.session.points_per_second().expect("known");
    f64::from(points) * kind.byte_len() as f64 / kind.points() as f64
}

#[test]
fn damaged_bytes_cost_only_damaged_packets() {
    let (mut points, mut wrong_points) = ([0; 6], [0; 6]);
    for seed in 0..60 {
        let mut random = fastrand::Rng::with_seed(!seed);
        let which = seed as usize % 6;
        let kind = PACKET_KINDS[which];
        let mut bench = in_mode(kind, seed);
        bench.scanner.hz *= 0.9 + 0.2 * random.f64();
        bench.scanner.line.damage = DamageRates {
            lost: random.f64() * 0.001,
            inserted: random.f64() * 0.000_3,
            flipped: random.f64() * 0.000_3,
        };
        bench.run(8 * ONE_SECOND);
        let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
        points[which] +=
            bench.log.revolutions.iter().map(|revolution| revolution.points.len()).sum::<usize>();
        wrong_points[which] += wrong;
        let stats = bench.session.stats();
        let packets = bench.scanner.sent.iter().filter(|sent| sent.at < bench.now);
        let (sent, broken) =
            (packets.clone().count() as i64, packets.filter(|sent| !sent.intact).count() as i64);
        println!(
            "{seed} {kind:?}: {worst} {wrong} {stats:?} {sent} {broken} {:?}",
            bench.session.revolution_counts()
        );
        if which > 0 {
            bench.assert_intact_packets_once_in_order();
            assert_eq!(wrong, 0, "{seed}");
            assert!(
                (stats.lost as i64 - broken).abs() <= 4 + broken / 100,
                "{seed}: {} of {broken}",
                stats.lost
            );
        }
        assert!(worst < 8 * MILLIS, "{seed}: {worst}");
        let off = (stats.due as i64 - sent).abs();
        assert!(off <= 4 + sent / 200, "{seed}: {stats:?} of {sent}");
        assert!(stats.damaged > 0);
        assert!(which == 0 || bench.session.revolution_counts().incomplete > 0, "{seed}");
    }
    println!("{wrong_points:?} of {points:?}");
    assert!(wrong_points[0] * 500 < points[0], "{wrong_points:?} of {points:?}");
}

#[test]
fn revolutions_resume_after_a_head_standstill() {
    for kind in PACKET_KINDS {
        let mut bench = in_mode(kind, 1);
        bench.run(20 * ONE_SECOND);
        let hz = std::mem::replace(&mut bench.scanner.hz, 0.0);
        bench.run(21 * ONE_SECOND);
        bench.scanner.hz = hz;
        bench.run(23 * ONE_SECOND);
        let before = bench.log.revolutions.len();
        bench.run(26 * ONE_SECOND);
        let revolutions = (bench.log.revolutions.len() - before) as f64;
        assert!(revolutions >= 3.0 * hz - 2.0, "{kind:?}: {revolutions}");
        let maximum = (360.0 / bench.scanner.step()) as usize + 60;
        assert!(
            bench.log.revolutions.iter().all(|revolution| revolution.points.len() <= maximum),
            "{kind:?}: more than a turn"
        );
        assert!(
            bench.log.revolutions.iter().all(|revolution| revolution.beams == bench.log.revolutions[0].beams),
            "{kind:?}"
        );
    }
}

/// A revolution of a replayed recording.
#[derive(Debug, PartialEq)]
struct ReplayedRevolution {
    first: Nanos,
    points: usize,
    beams: usize,
    incomplete: bool,
}

/// Runs a session with these `settings` on `outputs`. Returns the session and its revolutions.
fn replay(settings: Settings, outputs: &[RecordedOutput]) -> (RplidarSession, Vec<ReplayedRevolution>) {
    let settings = Settings { fixed_rate: true, listen_only: true, ..settings };
    let mut session = RplidarSession::new(settings, outputs[0].first);
    let mut revolutions = Vec::new();
    for RecordedOutput { last, bytes, reasons, .. } in outputs {
        session.mark_suspect(*reasons);
        session.read_buffer()[..bytes.len()].copy_from_slice(bytes);
        session.commit(*last, bytes.len());
        loop {
            match session.poll_action() {
                Action::Event(Event::Scan(revolution)) => revolutions.push(replayed_revolution(&revolution)),
                Action::Event(Event::Telegram(_)) => {}
                Action::SleepUntil(_) | Action::Wait { .. } => break,
                output => panic!("{output:?}"),
            }
        }
    }
    (session, revolutions)
}

fn replayed_revolution(revolution: &RawScan<'_>) -> ReplayedRevolution {
    ReplayedRevolution {
        first: revolution.first,
        points: revolution.points().len(),
        beams: revolution.beams(),
        incomplete: revolution.is_incomplete(),
    }
}

const STREAM_MODES: [(Model, Mode); 7] = [
    (Model::A1, Mode::Standard),
    (Model::A1, Mode::Express),
    (Model::A1, Mode::Sensitivity),
    (Model::A1, Mode::Stability),
    (Model::S1, Mode::DenseBoost),
    (Model::S2, Mode::DenseBoost),
    (Model::S3, Mode::UltraDense),
];

fn record(model: Model, mode: Mode, seconds: u64) -> TestBench {
    let mut live = TestBench::new(
        Settings { mode: Some(mode.name()), ..settings_of(model) },
        SimulatedScanner::new(model, 1),
    );
    live.run(seconds * ONE_SECOND);
    live
}

/// The recording contains the replies with the time per point and the packet format.
#[test]
fn replayed_recording_yields_the_same_revolutions() {
    for (model, mode) in STREAM_MODES {
        let live = record(model, mode, 6);
        for settings in [Settings::default(), Settings { mode: Some(mode.name()), ..settings_of(model) }] {
            let (session, revolutions) = replay(settings, &live.log.outputs);
            let per_second = session.points_per_second().expect("measured");
            assert_eq!(Some(per_second), live.session.points_per_second(), "{model:?} {mode:?}");
            assert_eq!(session.model(), Some(model));
            // Without the configured mode, the first quarter of a second may belong to another mode.
            let missing = if settings.mode.is_some() { 0 } else { 3 };
            assert!(
                revolutions.len() + missing >= live.log.revolutions.len(),
                "{model:?} {mode:?}: {}",
                revolutions.len()
            );
            let behind = live.log.revolutions.len() - revolutions.len();
            for (replayed, delivered) in revolutions.iter().zip(&live.log.revolutions[behind..]) {
                assert_eq!(replayed.incomplete, delivered.incomplete, "{model:?} {mode:?}");
                // Without the mode, the grid of beams is different and starts at a different angle.
                let off = if settings.mode.is_some() { 0 } else { 2 };
                assert!(replayed.points.abs_diff(delivered.points.len()) <= off, "{model:?} {mode:?}");
                assert!(settings.mode.is_none() || replayed.beams == delivered.beams);
                assert!(
                    replayed.first.abs_diff(delivered.first) < 15 * MILLIS,
                    "{model:?} {mode:?}: {replayed:?} {}",
                    delivered.first
                );
            }
        }
    }
}

#[test]
fn recording_from_mid_stream_has_revolutions_soon() {
    for (model, mode) in STREAM_MODES {
        let live = record(model, mode, 8);
        let from = live.log.outputs.iter().position(|output| output.first > 3 * ONE_SECOND).expect("some");
        let (session, revolutions) =
            replay(Settings { mode: Some(mode.name()), ..settings_of(model) }, &live.log.outputs[from..]);
        let first = revolutions.first().expect("some").first;
        assert!(first < 3 * ONE_SECOND + ONE_SECOND * 6 / 10, "{model:?} {mode:?}: {first}");
        let is = session.points_per_second().expect("measured")
            / live.session.points_per_second().expect("measured");
        assert!((is - 1.0).abs() < 0.005, "{model:?} {mode:?}: {is}");
        assert!(revolutions.iter().all(|replayed| !replayed.incomplete), "{model:?} {mode:?}");
        let worst = stamp_errors(&live, &revolutions).into_iter().max().expect("some");
        assert!(worst < 2 * MILLIS, "{model:?} {mode:?}: {worst}");
        assert!(session.stats().lost == 0);
    }
}

/// Returns, for each of `revolutions`, the difference between its stamp and the nearest stamp of a revolution of the
/// live session.
fn stamp_errors(live: &TestBench, revolutions: &[ReplayedRevolution]) -> Vec<Nanos> {
    let off = |replayed: &ReplayedRevolution| {
        live.log.revolutions.iter().map(|delivered| delivered.first.abs_diff(replayed.first)).min()
    };
    revolutions.iter().map(|replayed| off(replayed).expect("some")).collect()
}

/// A recording contains no damaged packets. Only the suspect marks of the following packets show that packets are
/// missing.
#[test]
fn lossy_recording_from_mid_stream_has_right_stamps() {
    for (model, mode) in STREAM_MODES {
        let settings = Settings { mode: Some(mode.name()), ..settings_of(model) };
        let mut all = Vec::new();
        for seed in 0..20 {
            let mut live = TestBench::new(settings, SimulatedScanner::new(model, seed));
            live.scanner.line.damage = DamageRates { lost: 0.000_5, ..DamageRates::default() };
            live.run(8 * ONE_SECOND);
            let from =
                live.log.outputs.iter().position(|output| output.first > 3 * ONE_SECOND).expect("some");
            let (_, revolutions) = replay(settings, &live.log.outputs[from..]);
            all.extend(stamp_errors(&live, &revolutions));
        }
        all.sort_unstable();
        let (maximum, worst) = (all[all.len() * 98 / 100], all[all.len() - 1]);
        // Points without a checksum are lost without a mark.
        let bound = if mode == Mode::Standard { 15 } else { 10 };
        assert!(maximum < 5 * MILLIS && worst < bound * MILLIS, "{model:?} {mode:?}: {maximum} {worst}");
    }
}

/// While a busy host does not run, packets are queued in its driver. The stamps of these packets are late and close
/// together, and do not depend on the time per point.
#[test]
fn backlogged_packets_do_not_change_time_per_point() {
    for (model, mode) in STREAM_MODES {
        let settings = Settings { mode: Some(mode.name()), ..settings_of(model) };
        let live = record(model, mode, 12);
        let from = live.log.outputs.iter().position(|output| output.first > 2 * ONE_SECOND).expect("some");
        let steady = &live.log.outputs[from..];
        let mut stalled = steady.to_vec();
        let mut free = 0;
        for output in &mut stalled {
            let into = output.last % (300 * MILLIS);
            // The hub needs 0.1 ms for each queued packet.
            let at = if into < 40 * MILLIS { output.last - into + 40 * MILLIS } else { output.last };
            free = at.max(free + MILLIS / 10);
            output.last = free;
        }
        let points = |outputs: &[RecordedOutput]| {
            replay(settings, outputs).1.iter().map(|replayed| replayed.points).collect()
        };
        let [expected, found]: [Vec<usize>; 2] = [points(steady), points(&stalled)];
        assert!(expected.len() > 50 && found == expected, "{model:?} {mode:?}: {expected:?} {found:?}");
    }
}

/// If the ranges of one format are decoded as the other format, they are meaningless.
#[test]
fn refuses_packets_of_ambiguous_format() {
    let live = record(Model::S1, Mode::DenseBoost, 4);
    let from = live.log.outputs.iter().position(|output| output.first > 2 * ONE_SECOND).expect("some");
    let (session, revolutions) = replay(Settings::default(), &live.log.outputs[from..]);
    assert_eq!((session.problem(), revolutions.len()), (Some(Problem::AmbiguousPackets), 0));
    assert!(Problem::AmbiguousPackets.to_string().contains("model or the mode"));
    let (session, revolutions) = replay(settings_of(Model::S1), &live.log.outputs[from..]);
    assert_eq!(session.problem(), None);
    assert!(revolutions.len() > 10);
}

/// Descriptors of replies, of packets of all formats, and of packets of an unknown format.
const REPLY_DESCRIPTORS: [[u8; 7]; 12] = [
    [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04],
    [0xA5, 0x5A, 0x03, 0, 0, 0, 0x06],
    [0xA5, 0x5A, 0x04, 0, 0, 0, 0x15],
    [0xA5, 0x5A, 0x06, 0, 0, 0, 0x20],
    [0xA5, 0x5A, 0x40, 0, 0, 0, 0x20],
    [0xA5, 0x5A, 0x04, 0, 0, 0, 0xFF],
    [0xA5, 0x5A, 0x05, 0, 0, 0x40, 0x81],
    [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x82],
    [0xA5, 0x5A, 0x84, 0, 0, 0x40, 0x84],
    [0xA5, 0x5A, 0x54, 0, 0, 0x40, 0x85],
    [0xA5, 0x5A, 0xAA, 0, 0, 0x40, 0x86],
    [0xA5, 0x5A, 0xFF, 0xFF, 0xFF, 0xFF, 0x83],
];

/// Returns a packet with random content and a right checksum. The angle of the packet may continue from the previous
/// packet.
fn random_packet(random: &mut fastrand::Rng, kind: PacketFormat, angle: &mut u16, jumps: u16) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..kind.byte_len()).map(|_| random.u8(..)).collect();
    *angle = if random.u16(..jumps) == 0 { random.u16(..) } else { (*angle % 23_040 + 1_152) % 23_040 };
    if kind == PacketFormat::Standard {
        bytes[0] = bytes[0] & !3 | 2;
        bytes[1..3].copy_from_slice(&(*angle << 1 | 1).to_le_bytes());
        return bytes;
    }
    let at = if kind == PacketFormat::UltraDense { 8 } else { 2 };
    bytes[at..at + 2].copy_from_slice(&angle.to_le_bytes());
    let sum = bytes[2..].iter().fold(0, |sum, byte| sum ^ byte);
    (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
    bytes
}

fn pick<T: Copy>(random: &mut fastrand::Rng, all: &[T]) -> Option<T> {
    all.get(random.usize(..all.len() + 1)).copied()
}

#[test]
fn every_byte_is_counted_once() {
    let mut count = 0;
    for seed in 0..400 {
        let mut random = fastrand::Rng::with_seed(seed);
        // In half of the runs, the angles mostly continue without jumps.
        let is_calm = seed % 2 == 0;
        let jumps = if is_calm { 1_000 } else { 8 };
        let settings = Settings {
            model: pick(&mut random, &Model::ALL).map(Model::name),
            mode: pick(&mut random, &Mode::ALL).map(Mode::name),
            fixed_rate: random.bool(),
            listen_only: random.bool() || is_calm,
            stop_when_idle: random.bool(),
            ..Settings::default()
        };
        let mut session = RplidarSession::new(settings, 0);
        let kind = PacketFormat::ALL[seed as usize % 5];
        let (mut now, mut delivered_bytes, mut angle) = (0, 0, 0);
        for _ in 0..300 {
            let mut bytes = Vec::new();
            while bytes.len() < 600 {
                match if is_calm && random.u8(..50) > 0 { 15 } else { random.u8(..16) } {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(random.choice(REPLY_DESCRIPTORS).expect("some")),
                    2 => bytes.extend(
                        &random_packet(&mut random, kind, &mut angle, jumps)
                            [..random.usize(..kind.byte_len())],
                    ),
                    3 => bytes.extend(b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"),
                    _ => bytes.extend(random_packet(&mut random, kind, &mut angle, jumps)),
                }
            }
            match random.u16(..if is_calm { 400 } else { 40 }) {
                0 => session.control(Control::Pause, now),
                1 => session.control(Control::Resume, now),
                2 => session.control(Control::Resync, now),
                3 => session.set_has_subscribers(now, random.bool()),
                4 => session.handle_timeout(now),
                _ => {}
            }
            let len = bytes.len().min(session.read_buffer().len()).min(if is_calm {
                usize::MAX
            } else {
                random.usize(..900)
            });
            session.read_buffer()[..len].copy_from_slice(&bytes[..len]);
            now += if is_calm { bytes.len() as u64 * MILLIS / 10 } else { random.u64(..100 * MILLIS) };
            session.commit(now, len);
            loop {
                match session.poll_action() {
                    Action::Event(Event::Telegram(received)) => {
                        delivered_bytes += received.bytes.len() as u64;
                        assert!(received.first <= received.last && received.last <= now);
                        assert_eq!(received.bytes.len() % received.count, 0);
                    }
                    Action::Event(Event::Scan(revolution)) => {
                        assert!(
                            revolution.first <= revolution.last
                                && line::BEAM_RANGE.contains(&revolution.beams())
                        );
                        count += 1;
                    }
                    Action::SetRate(_) => assert!(!settings.fixed_rate && !settings.listen_only),
                    Action::SetDtr(_) => assert!(!settings.listen_only),
                    Action::Transmit { .. } => {
                        assert!(!settings.listen_only, "no scanner is there");
                        session.handle_transmitted(now);
                    }
                    Action::SleepUntil(until) => {
                        assert!(until > now);
                        break;
                    }
                    Action::Wait { .. } => break,
                }
            }
            let stats = session.stats();
            assert_eq!(stats.read, stats.in_telegrams + stats.discarded + stats.buffered);
            assert_eq!(stats.in_telegrams, delivered_bytes);
            assert!(stats.buffered < 2 * PacketFormat::MAX_LEN as u64 + 80, "{stats:?}");
        }
    }
    assert!(count > 100, "{count}");
}
