//! What becomes of packets: turns, stamps, damage.

use scanhub_drivers::Settings;
use scanhub_drivers::line::Session as _;
use scanhub_drivers::rplidar::{Mode, Model};
use scanhub_schema::MILLIS;

use crate::session::bench::{Bench, SECOND};
use crate::session::head::Head;
use crate::session::start::of;
use crate::session::wire::Damage;

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

/// What is left begins where the last packet before it ended, and if whole turns were dropped, at its angle.
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

/// A pty and what is behind it keep more: what waits is read in pieces, while more comes.
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
        bench.head.damage = Damage {
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
