//! Sessions with the packets of Slamtec scanners: revolutions, stamps, damage, and sessions of recordings, which have no scanner.
//! Whatever arrives, every byte is counted once, and the session does not panic.

use scanhub_drivers::line::{Control, Event, Output, Protocol as _, RawScan, Session as _};
use scanhub_drivers::rplidar::packet::Kind;
use scanhub_drivers::rplidar::{Mode, Model, Session, Trouble};
use scanhub_drivers::{Settings, line};
use scanhub_schema::{MILLIS, Nanos};

use super::start::of;
use super::{Bench, Head, Kept, SECOND};
use crate::Damage;

#[test]
fn every_mode_of_every_model_is_heard_and_every_turn_of_it() {
    for model in Model::ALL {
        for mode in Mode::ALL {
            let head = Head::new(model, 1);
            if !head.has(mode) {
                continue;
            }
            let mut bench = Bench::new(Settings { mode: Some(mode.name()), ..of(model) }, head);
            bench.run(2 * SECOND);
            let before = bench.log.turns.len();
            bench.run(12 * SECOND);
            let turns = bench.log.turns.len() - before;
            let due = 10.0 * bench.head.hz;
            assert!((due - 2.0..=due + 2.0).contains(&(turns as f64)), "{model:?} {mode:?}: {turns}");
            assert!(bench.log.turns.iter().all(|told| !told.incomplete), "{model:?} {mode:?}");
            let (worst, wrong) = bench.judge(&bench.log.turns);
            assert_eq!(wrong, 0, "{model:?} {mode:?}");
            assert!(worst < 5 * MILLIS, "{model:?} {mode:?}: {worst}");
            bench.intact_packets_came_once_in_order();
            let account = bench.session.account();
            assert_eq!((account.lost, account.damaged, account.resyncs), (0, 0, 0), "{model:?} {mode:?}");
            assert_eq!(account.due as usize, bench.log.packets.len());
        }
    }
}

/// All kinds of packets, each with a model and a mode that has it.
const KINDS: [(Model, Mode); 6] = [
    (Model::A1, Mode::Standard),
    (Model::A1, Mode::Express),
    (Model::A1, Mode::Sensitivity),
    (Model::A3, Mode::Sensitivity),
    (Model::S2, Mode::DenseBoost),
    (Model::S3, Mode::UltraDense),
];

fn in_mode((model, mode): (Model, Mode), seed: u64) -> Bench {
    Bench::new(Settings { mode: Some(mode.name()), ..of(model) }, Head::new(model, seed))
}

#[test]
fn points_that_take_longer_than_the_scanner_says_are_dated_right() {
    for kind in KINDS {
        for drift in [-0.012, 0.007_5, 0.012] {
            let mut bench = in_mode(kind, 1);
            bench.head.drift = drift;
            bench.run(30 * SECOND);
            let turns = &bench.log.turns;
            let (early, wrong) = bench.judge(turns);
            let from = turns.iter().position(|told| told.first > 4 * SECOND).expect("some");
            let (worst, _) = bench.judge(&turns[from..]);
            println!("{kind:?} {drift}: {early} {worst}");
            assert!(early < 12 * MILLIS && worst < 5 * MILLIS, "{kind:?} {drift}: {early} {worst}");
            assert_eq!(wrong, 0);
            assert_eq!(bench.session.account().lost, 0);
        }
    }
}

#[test]
fn a_host_that_stops_dates_what_waited_for_it() {
    for kind in KINDS {
        for drift in [0.0, 0.007_5] {
            let mut bench = in_mode(kind, 3);
            bench.head.drift = drift;
            for stall in 2..20 {
                bench.run(stall * SECOND);
                bench.now += 500 * MILLIS;
                bench.read(true);
            }
            bench.run(20 * SECOND);
            let turns = &bench.log.turns;
            let from = turns.iter().position(|told| told.first > 4 * SECOND).expect("some");
            let (early, wrong) = bench.judge(turns);
            let (worst, _) = bench.judge(&turns[from..]);
            println!("{kind:?} {drift}: {early} {worst}");
            assert!(early < 12 * MILLIS && worst < 5 * MILLIS, "{kind:?} {drift}: {early} {worst}");
            assert_eq!((wrong, bench.session.account().lost), (0, 0));
            let periods = turns[from..].windows(2).map(|pair| pair[1].first - pair[0].first);
            let (least, most) = (periods.clone().min().expect("some"), periods.max().expect("some"));
            assert!(most - least < 10 * MILLIS, "evenly: {least} {most}");
            bench.intact_packets_came_once_in_order();
        }
    }
}

#[test]
fn what_a_full_buffer_drops_is_missing_and_told() {
    for kind in KINDS {
        for gap in [60, 250, 700] {
            let mut bench = in_mode(kind, 3);
            bench.run(5 * SECOND);
            let before = bench.session.turn_counts();
            bench.head.cut(5 * SECOND + gap * MILLIS);
            bench.now += gap * MILLIS;
            bench.read(true);
            bench.run(12 * SECOND);
            let counts = bench.session.turn_counts();
            let (worst, wrong) = bench.judge(&bench.log.turns);
            println!("{kind:?} {gap}: {worst} {counts:?}");
            assert!(worst < 5 * MILLIS, "{kind:?} {gap}: {worst}");
            assert_eq!(wrong, 0, "{kind:?} {gap}");
            assert!(counts.incomplete + counts.short > before.incomplete + before.short, "{kind:?} {gap}");
            let lost = bench.session.account().lost;
            let due =
                bench.head.sent.iter().filter(|sent| !sent.intact && sent.at < bench.now - SECOND).count()
                    as u64;
            assert!(lost.abs_diff(due) <= 2 + due / 50, "{kind:?} {gap}: {lost} of {due}");
            assert_eq!(bench.session.account().resyncs, 0);
        }
    }
}

/// The remaining packets start where the last packet before them ended, even if whole revolutions were dropped.
#[test]
fn whole_packets_that_a_full_buffer_drops_are_missing_and_told() {
    for kind in KINDS {
        for (room, more) in [(4_096, 40), (576, 40), (300, 25)] {
            for stall in 0..more {
                let mut bench = in_mode(kind, 3);
                bench.run(4 * SECOND);
                let filled = room as f64 / bytes_per_second(&bench);
                let stall = (filled * 1e9) as u64 + stall * 7 * MILLIS;
                let before = bench.session.turn_counts();
                bench.head.overflow(bench.now + stall, room);
                bench.now += stall;
                bench.read(true);
                bench.run(7 * SECOND);
                let dropped = bench.head.sent.iter().filter(|sent| !sent.intact).count();
                if dropped == 0 || (kind.1 == Mode::Standard && dropped <= 31) {
                    continue;
                }
                let counts = bench.session.turn_counts();
                let (worst, wrong) = bench.judge(&bench.log.turns);
                let what = format!("{kind:?} {room} {} ms: {worst} {wrong} {counts:?}", stall / MILLIS);
                assert!(worst < 5 * MILLIS && wrong == 0, "{what}");
                assert!(counts.incomplete + counts.short > before.incomplete + before.short, "{what}");
            }
        }
    }
}

/// A pty and its driver buffer more: the host reads the buffered bytes in pieces while more arrive.
#[test]
fn a_host_that_stops_for_longer_than_a_pty_has_room_dates_what_comes_behind_the_gap() {
    for kind in [(Model::A3, Mode::Sensitivity), (Model::S2, Mode::DenseBoost), (Model::S3, Mode::UltraDense)]
    {
        for hz in [0.97, 1.03] {
            for stall in (250..650).step_by(25) {
                let mut bench = in_mode(kind, 3);
                bench.head.hz *= hz;
                bench.run(4 * SECOND);
                bench.head.overflow(bench.now + stall * MILLIS, 17_024);
                bench.now += stall * MILLIS;
                bench.read(true);
                bench.run(7 * SECOND);
                let (worst, wrong) = bench.judge(&bench.log.turns);
                assert!(worst < 3 * MILLIS && wrong == 0, "{kind:?} {hz} {stall}: {worst} {wrong}");
            }
        }
    }
}

fn bytes_per_second(bench: &Bench) -> f64 {
    let kind = bench.head.kind().expect("measuring");
    let points = bench.session.points_per_second().expect("known");
    f64::from(points) * kind.bytes() as f64 / kind.points() as f64
}

#[test]
fn a_line_that_damages_bytes_costs_the_packets_that_it_damages() {
    let (mut points, mut wrong_points) = ([0; 6], [0; 6]);
    for seed in 0..60 {
        let mut random = fastrand::Rng::with_seed(!seed);
        let which = seed as usize % 6;
        let kind = KINDS[which];
        let mut bench = in_mode(kind, seed);
        bench.head.hz *= 0.9 + 0.2 * random.f64();
        bench.head.line.damage = Damage {
            lost: random.f64() * 0.001,
            inserted: random.f64() * 0.000_3,
            flipped: random.f64() * 0.000_3,
        };
        bench.run(8 * SECOND);
        let (worst, wrong) = bench.judge(&bench.log.turns);
        points[which] += bench.log.turns.iter().map(|told| told.points.len()).sum::<usize>();
        wrong_points[which] += wrong;
        let account = bench.session.account();
        let packets = bench.head.sent.iter().filter(|sent| sent.at < bench.now);
        let (sent, broken) =
            (packets.clone().count() as i64, packets.filter(|sent| !sent.intact).count() as i64);
        println!(
            "{seed} {kind:?}: {worst} {wrong} {account:?} {sent} {broken} {:?}",
            bench.session.turn_counts()
        );
        if which > 0 {
            bench.intact_packets_came_once_in_order();
            assert_eq!(wrong, 0, "{seed}");
            assert!(
                (account.lost as i64 - broken).abs() <= 4 + broken / 100,
                "{seed}: {} of {broken}",
                account.lost
            );
        }
        assert!(worst < 8 * MILLIS, "{seed}: {worst}");
        let off = (account.due as i64 - sent).abs();
        assert!(off <= 4 + sent / 200, "{seed}: {account:?} of {sent}");
        assert!(account.damaged > 0);
        assert!(which == 0 || bench.session.turn_counts().incomplete > 0, "{seed}");
    }
    println!("{wrong_points:?} of {points:?}");
    assert!(wrong_points[0] * 500 < points[0], "{wrong_points:?} of {points:?}");
}

#[test]
fn a_head_that_stood_still_turns_on_and_so_do_its_turns() {
    for kind in KINDS {
        let mut bench = in_mode(kind, 1);
        bench.run(20 * SECOND);
        let hz = std::mem::replace(&mut bench.head.hz, 0.0);
        bench.run(21 * SECOND);
        bench.head.hz = hz;
        bench.run(23 * SECOND);
        let before = bench.log.turns.len();
        bench.run(26 * SECOND);
        let turns = (bench.log.turns.len() - before) as f64;
        assert!(turns >= 3.0 * hz - 2.0, "{kind:?}: {turns}");
        let most = (360.0 / bench.head.step()) as usize + 60;
        assert!(bench.log.turns.iter().all(|told| told.points.len() <= most), "{kind:?}: more than a turn");
        assert!(bench.log.turns.iter().all(|told| told.beams == bench.log.turns[0].beams), "{kind:?}");
    }
}

/// Turns of a recording: stamp, points a second, beams, and how many points each has.
#[derive(Debug, PartialEq)]
struct Seen {
    first: Nanos,
    points: usize,
    beams: usize,
    incomplete: bool,
}

/// Returns a session with these `settings` after it has read `heard`, and its revolutions.
fn replay(settings: Settings, heard: &[Kept]) -> (Session, Vec<Seen>) {
    let settings = Settings { fixed_rate: true, listen_only: true, ..settings };
    let mut session = Session::new(settings, heard[0].first);
    let mut turns = Vec::new();
    for Kept { last, bytes, reasons, .. } in heard {
        session.mark_suspect(*reasons);
        session.spare()[..bytes.len()].copy_from_slice(bytes);
        session.commit(*last, bytes.len());
        loop {
            match session.poll_output() {
                Output::Event(Event::Scan(turn)) => turns.push(seen(&turn)),
                Output::Event(Event::Telegram(_)) => {}
                Output::Rest(_) | Output::Wait { .. } => break,
                output => panic!("{output:?}"),
            }
        }
    }
    (session, turns)
}

fn seen(turn: &RawScan<'_>) -> Seen {
    Seen {
        first: turn.first,
        points: turn.points().len(),
        beams: turn.beams(),
        incomplete: turn.is_incomplete(),
    }
}

const MODES: [(Model, Mode); 7] = [
    (Model::A1, Mode::Standard),
    (Model::A1, Mode::Express),
    (Model::A1, Mode::Sensitivity),
    (Model::A1, Mode::Stability),
    (Model::S1, Mode::DenseBoost),
    (Model::S2, Mode::DenseBoost),
    (Model::S3, Mode::UltraDense),
];

fn recorded(model: Model, mode: Mode, seconds: u64) -> Bench {
    let mut live = Bench::new(Settings { mode: Some(mode.name()), ..of(model) }, Head::new(model, 1));
    live.run(seconds * SECOND);
    live
}

/// The recording has the replies: the time per point and the kind of the packets.
#[test]
fn a_recording_from_the_beginning_has_the_turns_that_were_handed_out() {
    for (model, mode) in MODES {
        let live = recorded(model, mode, 6);
        for settings in [Settings::default(), Settings { mode: Some(mode.name()), ..of(model) }] {
            let (session, turns) = replay(settings, &live.log.heard);
            let per_second = session.points_per_second().expect("told");
            assert_eq!(Some(per_second), live.session.points_per_second(), "{model:?} {mode:?}");
            assert_eq!(session.model(), Some(model));
            // If the configured mode is unknown, the first quarter of a second may be of another mode.
            let missing = if settings.mode.is_some() { 0 } else { 3 };
            assert!(turns.len() + missing >= live.log.turns.len(), "{model:?} {mode:?}: {}", turns.len());
            let behind = live.log.turns.len() - turns.len();
            for (seen, told) in turns.iter().zip(&live.log.turns[behind..]) {
                assert_eq!(seen.incomplete, told.incomplete, "{model:?} {mode:?}");
                // Without the mode it is another grid, which begins elsewhere.
                let off = if settings.mode.is_some() { 0 } else { 2 };
                assert!(seen.points.abs_diff(told.points.len()) <= off, "{model:?} {mode:?}");
                assert!(settings.mode.is_none() || seen.beams == told.beams);
                assert!(
                    seen.first.abs_diff(told.first) < 15 * MILLIS,
                    "{model:?} {mode:?}: {seen:?} {}",
                    told.first
                );
            }
        }
    }
}

#[test]
fn one_that_begins_in_the_midst_has_turns_soon() {
    for (model, mode) in MODES {
        let live = recorded(model, mode, 8);
        let from = live.log.heard.iter().position(|kept| kept.first > 3 * SECOND).expect("some");
        let (session, turns) =
            replay(Settings { mode: Some(mode.name()), ..of(model) }, &live.log.heard[from..]);
        let first = turns.first().expect("some").first;
        assert!(first < 3 * SECOND + SECOND * 6 / 10, "{model:?} {mode:?}: {first}");
        let is =
            session.points_per_second().expect("measured") / live.session.points_per_second().expect("told");
        assert!((is - 1.0).abs() < 0.005, "{model:?} {mode:?}: {is}");
        assert!(turns.iter().all(|seen| !seen.incomplete), "{model:?} {mode:?}");
        let worst = off(&live, &turns).into_iter().max().expect("some");
        assert!(worst < 2 * MILLIS, "{model:?} {mode:?}: {worst}");
        assert!(session.account().lost == 0);
    }
}

/// Returns the difference between the stamp of each of `turns` and the delivered one.
fn off(live: &Bench, turns: &[Seen]) -> Vec<Nanos> {
    let off = |seen: &Seen| live.log.turns.iter().map(|told| told.first.abs_diff(seen.first)).min();
    turns.iter().map(|seen| off(seen).expect("some")).collect()
}

/// A recording does not have damaged packets: only the marks of the packets after them show that they are missing.
#[test]
fn one_that_begins_in_the_midst_of_a_line_that_damages_bytes_is_dated_right() {
    for (model, mode) in MODES {
        let settings = Settings { mode: Some(mode.name()), ..of(model) };
        let mut all = Vec::new();
        for seed in 0..20 {
            let mut live = Bench::new(settings, Head::new(model, seed));
            live.head.line.damage = Damage { lost: 0.000_5, ..Damage::default() };
            live.run(8 * SECOND);
            let from = live.log.heard.iter().position(|kept| kept.first > 3 * SECOND).expect("some");
            let (_, turns) = replay(settings, &live.log.heard[from..]);
            all.extend(off(&live, &turns));
        }
        all.sort_unstable();
        let (most, worst) = (all[all.len() * 98 / 100], all[all.len() - 1]);
        // Points without a checksum are lost without a mark.
        let bound = if mode == Mode::Standard { 15 } else { 10 };
        assert!(most < 5 * MILLIS && worst < bound * MILLIS, "{model:?} {mode:?}: {most} {worst}");
    }
}

/// While a busy machine stands still, packets wait in its driver. Then their stamps are late and close together, and have little to
/// do with the time that a point takes.
#[test]
fn packets_that_waited_do_not_change_the_time_per_point() {
    for (model, mode) in MODES {
        let settings = Settings { mode: Some(mode.name()), ..of(model) };
        let live = recorded(model, mode, 12);
        let from = live.log.heard.iter().position(|kept| kept.first > 2 * SECOND).expect("some");
        let steady = &live.log.heard[from..];
        let mut stalled = steady.to_vec();
        let mut free = 0;
        for kept in &mut stalled {
            let into = kept.last % (300 * MILLIS);
            // The hub takes a tenth of a millisecond for each of those that waited.
            let at = if into < 40 * MILLIS { kept.last - into + 40 * MILLIS } else { kept.last };
            free = at.max(free + MILLIS / 10);
            kept.last = free;
        }
        let points = |heard: &[Kept]| replay(settings, heard).1.iter().map(|seen| seen.points).collect();
        let [expected, found]: [Vec<usize>; 2] = [points(steady), points(&stalled)];
        assert!(expected.len() > 50 && found == expected, "{model:?} {mode:?}: {expected:?} {found:?}");
    }
}

/// Ranges of the one kind are nonsense as those of the other one.
#[test]
fn packets_that_may_be_of_two_kinds_are_refused_in_words() {
    let live = recorded(Model::S1, Mode::DenseBoost, 4);
    let from = live.log.heard.iter().position(|kept| kept.first > 2 * SECOND).expect("some");
    let (session, turns) = replay(Settings::default(), &live.log.heard[from..]);
    assert_eq!((session.trouble(), turns.len()), (Some(Trouble::Alike), 0));
    assert!(Trouble::Alike.to_string().contains("model or the mode"));
    let (session, turns) = replay(of(Model::S1), &live.log.heard[from..]);
    assert_eq!(session.trouble(), None);
    assert!(turns.len() > 10);
}

/// Heads of answers, of packets of all kinds, and of none.
const HEADS: [[u8; 7]; 12] = [
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

/// Creates a packet with any content and a right checksum. Its angle may continue from the packet before.
fn wild(random: &mut fastrand::Rng, kind: Kind, angle: &mut u16, jumps: u16) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..kind.bytes()).map(|_| random.u8(..)).collect();
    *angle = if random.u16(..jumps) == 0 { random.u16(..) } else { (*angle % 23_040 + 1_152) % 23_040 };
    if kind == Kind::Standard {
        bytes[0] = bytes[0] & !3 | 2;
        bytes[1..3].copy_from_slice(&(*angle << 1 | 1).to_le_bytes());
        return bytes;
    }
    let at = if kind == Kind::UltraDense { 8 } else { 2 };
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
    let mut turns = 0;
    for seed in 0..400 {
        let mut random = fastrand::Rng::with_seed(seed);
        // In some runs, the packets continue for a while.
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
        let mut session = Session::new(settings, 0);
        let kind = Kind::ALL[seed as usize % 5];
        let (mut now, mut told, mut angle) = (0, 0, 0);
        for _ in 0..300 {
            let mut bytes = Vec::new();
            while bytes.len() < 600 {
                match if is_calm && random.u8(..50) > 0 { 15 } else { random.u8(..16) } {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(random.choice(HEADS).expect("some")),
                    2 => bytes
                        .extend(&wild(&mut random, kind, &mut angle, jumps)[..random.usize(..kind.bytes())]),
                    3 => bytes.extend(b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"),
                    _ => bytes.extend(wild(&mut random, kind, &mut angle, jumps)),
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
            let len = bytes.len().min(session.spare().len()).min(if is_calm {
                usize::MAX
            } else {
                random.usize(..900)
            });
            session.spare()[..len].copy_from_slice(&bytes[..len]);
            now += if is_calm { bytes.len() as u64 * MILLIS / 10 } else { random.u64(..100 * MILLIS) };
            session.commit(now, len);
            loop {
                match session.poll_output() {
                    Output::Event(Event::Telegram(received)) => {
                        told += received.bytes.len() as u64;
                        assert!(received.first <= received.last && received.last <= now);
                        assert_eq!(received.bytes.len() % received.count, 0);
                    }
                    Output::Event(Event::Scan(turn)) => {
                        assert!(turn.first <= turn.last && line::BEAMS.contains(&turn.beams()));
                        turns += 1;
                    }
                    Output::SetRate(_) => assert!(!settings.fixed_rate && !settings.listen_only),
                    Output::SetDtr(_) => assert!(!settings.listen_only),
                    Output::Transmit { .. } => {
                        assert!(!settings.listen_only, "nobody is there");
                        session.transmitted(now);
                    }
                    Output::Rest(until) => {
                        assert!(until > now);
                        break;
                    }
                    Output::Wait { .. } => break,
                }
            }
            let account = session.account();
            assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
            assert_eq!(account.in_telegrams, told);
            assert!(account.buffered < 2 * Kind::LONGEST as u64 + 80, "{account:?}");
        }
    }
    assert!(turns > 100, "{turns}");
}
