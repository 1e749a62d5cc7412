//! Scanners of LDROBOT in simulated rooms: what a session tells of them is what they measured.

mod beams;
mod bench;

use bench::{Bench, still};
use scanhub_drivers::ld::Model;
use scanhub_drivers::line::{Session as _, State};
use scanhub_drivers::{ld, line};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::ld::{LdSettings, LdSimulator, recorded};
use scanhub_sim::world::World;

const SECOND: Nanos = 1_000 * MILLIS;

#[test]
fn every_point_of_every_turn_is_where_the_head_measured_it() {
    for model in Model::ALL {
        let mut bench = Bench::new(LdSettings::of(model), &still("room"), "", 7);
        bench.run(10 * SECOND);
        let due = 9 * model.turns_per_second() as usize;
        assert!(bench.turns.len() >= due, "{model:?}: {} turns", bench.turns.len());
        assert!(bench.turns.iter().all(|turn| !turn.incomplete));
        // Half a millimetre is what a whole number hides, a hundredth of a degree what a packet does.
        let worst = bench.judge_turns(0, 0.05, 2.0);
        assert!(worst < 2 * MILLIS, "{model:?}: {worst}");
        bench.judge_packets();
        let ranges =
            bench.turns.iter().flat_map(|turn| &turn.points).filter(|point| point.range < line::NO_RETURN);
        let share =
            ranges.count() as f64 / bench.turns.iter().map(|turn| turn.points.len()).sum::<usize>() as f64;
        assert!((0.4..1.0).contains(&share), "{model:?}: {share}");
    }
}

#[test]
fn a_line_that_loses_bytes_costs_no_intact_packet_and_no_truth() {
    for seed in 0..100 {
        let model = Model::ALL[seed as usize % Model::ALL.len()];
        let world = still("wall640");
        let mut bench = Bench::new(LdSettings { seed, ..LdSettings::of(model) }, &world, LOSS, seed);
        bench.run(6 * SECOND);
        bench.judge_packets();
        let worst = bench.judge_turns(0, 0.05, 2.0);
        assert!(worst < 5 * MILLIS, "{seed}: {worst}");
        let account = bench.session.account();
        let lost = bench.sent.iter().filter(|sent| !sent.intact).count() as u64;
        assert!(account.lost.abs_diff(lost) <= 2 + lost / 50, "{seed}: {account:?}, {lost} lost");
        assert!(bench.turns.iter().any(|turn| turn.incomplete));
    }
}

#[test]
fn whatever_else_happens_on_the_line_costs_no_intact_packet_and_no_truth() {
    for (faults, seed) in [
        "flip=0.0005,flip_bits=4",
        "insert=0.001,insert_burst=4",
        "double=0.001",
        "repeat=0.05",
        "truncate=0.05",
        "length=0.05",
        "abort=0.02",
        "flood=200,flood_every=0.3",
        "wall=300,wall_every=0.3",
        "loss=0.004,burst=6,insert=0.001,flip=0.0003,flip_bits=2",
    ]
    .into_iter()
    .flat_map(|faults| (0..5).map(move |seed| (faults, seed)))
    {
        let mut bench = Bench::new(LdSettings::of(Model::Ld19), &still("bare"), faults, seed);
        bench.run(8 * SECOND);
        bench.judge_packets();
        let worst = bench.judge_turns(0, 0.05, 2.0);
        // Here the bytes of a flood come all at once, as on no line: what came before them looks as early as the last read.
        let early = if faults.contains("every") { 5 * MILLIS } else { 0 };
        assert!(worst < 5 * MILLIS + early, "{faults}: {worst}");
        let account = bench.session.account();
        assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
        assert_eq!(bench.session.state(), State::Streaming, "{faults}");
    }
}

#[test]
fn what_a_line_held_back_is_dated_as_it_was_measured() {
    for model in [Model::Ld19, Model::Stl27l] {
        let faults = "stall=0.5,stall_at=2,stall_every=2,delay=0.003";
        let mut bench = Bench::new(LdSettings::of(model), &still("wall640"), faults, 3);
        bench.run(20 * SECOND);
        let worst = bench.judge_turns(0, 0.05, 2.0);
        assert!(worst < 5 * MILLIS, "{model:?}: {worst}");
        assert!(bench.stamps.windows(2).all(|pair| pair[0] <= pair[1] + MILLIS));
        bench.judge_packets();
    }
}

#[test]
fn a_power_cycle_is_a_silence_and_a_new_beginning() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &still("wall640"), "", 3);
    bench.run(3 * SECOND);
    let turns = bench.turns.len();
    bench.cycle_power();
    bench.run(5 * SECOND);
    assert_eq!(bench.session.state(), State::Silent);
    assert!(bench.turns.len() <= turns + 1);
    bench.judge_turns(0, 0.05, 2.0);
    bench.turns.clear();
    bench.run(8 * SECOND);
    assert_eq!((bench.session.state(), bench.session.account().resyncs), (State::Streaming, 1));
    assert!(bench.turns.len() > 25, "{}", bench.turns.len());
    bench.judge_turns(5 * SECOND, 0.05, 2.0);
    assert_eq!((bench.session.account().lost, bench.session.account().restarts), (0, 1));
}

#[test]
fn every_brown_out_is_a_restart() {
    for model in Model::ALL {
        let mut bench = Bench::new(LdSettings::of(model), &still("wall640"), "", 3);
        bench.run(4 * SECOND);
        for restarts in 1..=12 {
            // A voltage that falls makes the head slower first.
            let turns_per_second = f64::from(model.turns_per_second());
            for slow in 0..restarts {
                bench.head.set_speed(turns_per_second * (1.0 - 0.03 * slow as f64));
                bench.run(bench.now + 30 * MILLIS);
            }
            bench.brown_out();
            // Odd times, so that the clock of 30 s stands elsewhere each time.
            bench.run(bench.now + 2 * SECOND + restarts * 417 * MILLIS);
            assert_eq!(bench.session.account().restarts, restarts, "{model:?}");
            assert_eq!(
                (bench.session.state(), bench.session.trouble()),
                (State::Streaming, None),
                "{model:?}"
            );
        }
        let turns = bench.turns.len();
        bench.run(bench.now + 2 * SECOND);
        assert!(bench.turns.len() > turns + 10, "{model:?}");
    }
}

#[test]
fn what_only_looks_like_a_restart_is_none() {
    for faults in [
        "",
        "stall=0.5,stall_at=2,stall_every=2,delay=0.003",
        "stall=40,stall_at=5",
        "silence=0.7,silence_at=3,silence_every=3",
        "silence=2.5,silence_at=3,silence_every=6",
        "silence=40,silence_at=5",
        "unplug=2,unplug_at=3,unplug_every=7",
        "loss=0.004,burst=6,insert=0.001,flip=0.001,flip_bits=2",
        "flood=2000,flood_every=0.3",
        "abort=0.1,repeat=0.1",
    ] {
        // The clock wraps three times.
        let mut bench = Bench::new(LdSettings::of(Model::Ld19), &still("bare"), faults, 11);
        bench.run(100 * SECOND);
        assert_eq!(bench.session.account().restarts, 0, "{faults}");
    }
}

#[test]
fn a_line_that_damages_most_bytes_does_not_accuse_the_head() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &still("room"), "loss=0.08", 5);
    bench.run(4 * SECOND);
    for _ in 0..100 {
        bench.run(bench.now + 100 * MILLIS);
        assert_ne!(bench.session.trouble(), Some(ld::Trouble::StandsStill));
    }
    let account = bench.session.account();
    assert!(account.damaged > 2 * account.in_telegrams, "{account:?}");
}

#[test]
fn a_head_that_changes_its_speed_still_tells_the_truth() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &still("room"), "", 7);
    for step in 0..60 {
        bench.run(2 * SECOND + step * 100 * MILLIS);
        // From 10 turns in a second to 6 and back to 12.
        let turns = if step < 20 { 10.0 - 0.2 * step as f64 } else { 6.2 + 0.15 * (step - 20) as f64 };
        bench.head.set_speed(turns);
    }
    bench.run(10 * SECOND);
    bench.judge_packets();
    let turns = std::mem::take(&mut bench.turns);
    assert!(turns.iter().all(|turn| !turn.incomplete));
    let periods: Vec<_> = turns.windows(2).map(|pair| pair[1].first - pair[0].first).collect();
    let (least, most) = (periods.iter().min().unwrap(), periods.iter().max().unwrap());
    assert!(*least < 87 * MILLIS && *most > 155 * MILLIS, "{least} {most}");
    // What was measured since the last change is known.
    let after = turns.into_iter().filter(|turn| turn.first > 8_100 * MILLIS);
    bench.turns = after.collect();
    assert!(bench.turns.len() > 18, "{}", bench.turns.len());
    assert!(bench.judge_turns(0, 0.05, 2.0) < 2 * MILLIS);
}

#[test]
fn the_same_seed_says_the_same_and_what_was_recorded_is_said_again() {
    let world: World = "demo".parse().expect("a world");
    let said = |seed| {
        let mut bench = Bench::new(LdSettings { seed, ..LdSettings::of(Model::Ld06) }, &world, "", seed);
        bench.run(3 * SECOND);
        bench.packets
    };
    let packets = said(5);
    assert!(packets == said(5) && packets != said(6));
    let path = tempfile::NamedTempFile::new().expect("a file").into_temp_path();
    let mut bytes = packets[0][20..].to_vec();
    packets.iter().for_each(|packet| bytes.extend(packet));
    std::fs::write(&path, &bytes).expect("written");
    let found = recorded(&path, None).expect("packets");
    std::fs::write(&path, b"nothing").expect("written");
    let none = recorded(&path, None).expect_err("no packets");
    assert!(none.message.contains("no packet"), "{none}");
    assert_eq!(found, packets);
    for looped in [false, true] {
        let settings = LdSettings::of(Model::Ld06);
        let head = LdSimulator::repeating(settings, found.clone(), looped);
        let mut bench = Bench::of(settings, head, "", 1);
        bench.run(7 * SECOND);
        assert_eq!(bench.packets[..packets.len()], packets);
        assert_eq!(bench.packets.len() > packets.len(), looped);
        let turns = bench.turns.len();
        assert!(if looped { turns > 50 } else { (25..=30).contains(&turns) }, "{turns}");
    }
}

/// Bytes that a real line of 500 kBd lost.
const LOSS: &str = "loss=0.00135,burst=1.89";
