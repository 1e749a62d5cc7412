//! Scanners of LDROBOT in simulated rooms: the session reports what they measured. The number of beams of a scanner without a
//! configured model is the number of points that it measures per revolution, whatever happens to its power.

use scanhub_drivers::ld::packet::LEN;
use scanhub_drivers::ld::{Model, Session, Trouble};
use scanhub_drivers::line::Point;
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _, State};
use scanhub_drivers::{Settings, ld, line};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::{Device as _, Part};
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator, recorded};
use scanhub_sim::room::Room;
use scanhub_sim::wire::LineModel;
use scanhub_sim::world::World;

/// A packet that left, and whether nothing happened to it on its way.
struct Sent {
    bytes: Vec<u8>,
    intact: bool,
    at: Nanos,
}

struct Turn {
    points: Vec<Point>,
    first: Nanos,
    incomplete: bool,
    beams: usize,
}

struct Bench {
    session: Session,
    head: LdSimulator,
    settings: LdSettings,
    wire: LineModel,
    now: Nanos,
    inbox: Vec<u8>,
    intact: bool,
    sent: Vec<Sent>,
    packets: Vec<[u8; LEN]>,
    /// Reported time of arrival of each packet.
    stamps: Vec<Nanos>,
    turns: Vec<Turn>,
}

/// A room without noise.
fn still(world: &str) -> World {
    world.parse::<World>().expect("a world").with_noise(NoiseModel::NONE)
}

impl Bench {
    fn new(settings: LdSettings, world: &World, faults: &str, seed: u64) -> Bench {
        Bench::of(settings, LdSimulator::new(settings, Room::new(world, seed)), faults, seed)
    }

    fn of(settings: LdSettings, head: LdSimulator, faults: &str, seed: u64) -> Bench {
        let faults: Faults = faults.parse().expect("faults");
        let session = Session::new(Settings { model: Some(settings.model.name()), ..Settings::default() }, 0);
        Bench {
            session,
            head,
            settings,
            wire: LineModel::new(&faults, seed),
            now: 0,
            inbox: Vec::new(),
            intact: true,
            sent: Vec::new(),
            packets: Vec::new(),
            stamps: Vec::new(),
            turns: Vec::new(),
        }
    }

    fn run(&mut self, until: Nanos) {
        loop {
            let (wakes_at, waits) = self.drain();
            loop {
                let next = self.wire.poll_timeout(&self.head, self.now).unwrap_or(Nanos::MAX).max(self.now);
                let is_ready = waits && !self.inbox.is_empty();
                if is_ready || next > wakes_at.min(until) {
                    break;
                }
                self.now = next;
                self.carry();
            }
            if self.inbox.is_empty() || !waits {
                self.now = self.now.max(wakes_at.min(until));
            }
            if self.now >= until {
                return;
            }
            let is_timeout = self.now >= wakes_at;
            let spare = self.session.spare();
            let len = spare.len().min(self.inbox.len());
            spare[..len].copy_from_slice(&self.inbox[..len]);
            self.inbox.drain(..len);
            self.session.commit(self.now, len);
            if len == 0 && is_timeout {
                self.session.handle_timeout(self.now);
            }
        }
    }

    fn carry(&mut self) {
        while let Some(carried) = self.wire.poll_transmit(&mut self.head, self.now) {
            self.intact &= carried.fault.is_none();
            // Bytes at another rate are of no use.
            if carried.rate == self.session.rate() {
                self.inbox.extend(carried.bytes);
            }
            if let Some(Part::End(sent)) = carried.part {
                let intact = std::mem::replace(&mut self.intact, true);
                self.sent.push(Sent { bytes: sent.telegram, intact, at: self.now });
            }
        }
    }

    /// Returns the end of the session's wait, and whether it waits for bytes.
    fn drain(&mut self) -> (Nanos, bool) {
        loop {
            match self.session.poll_output() {
                Output::Event(Event::Telegram(received)) => {
                    assert!(received.last <= self.now);
                    self.packets.extend(received.bytes.as_chunks().0);
                    self.stamps.push(received.first);
                }
                Output::Event(Event::Scan(turn)) => self.turns.push(Turn {
                    points: turn.points().to_vec(),
                    first: turn.first,
                    incomplete: turn.is_incomplete(),
                    beams: turn.beams(),
                }),
                Output::SetRate(_) => self.inbox.clear(),
                Output::Rest(until) => return (until, false),
                Output::Wait { until, .. } => return (until, true),
                output => panic!("{output:?}"),
            }
        }
    }

    fn cycle_power(&mut self) {
        self.wire.cycle_power(&mut self.head, self.now);
    }

    fn brown_out(&mut self) {
        self.head.brown_out(self.now);
    }

    /// Checks that every intact packet arrived once and in order.
    fn judge_packets(&self) {
        let mut came = self.packets.iter();
        let due = self.sent.iter().filter(|sent| sent.intact && sent.at + 20 * MILLIS < self.now);
        for (number, sent) in due.enumerate() {
            assert!(came.any(|bytes| bytes[..] == sent.bytes), "intact packet {number} was lost");
        }
    }

    /// Compares each revolution with the measurements of the head since `zero`. Its points belong to one revolution
    /// and are in order. Without a mark, none is missing, and each is at most `angle_deg` and `range_mm` off. Returns
    /// the largest error of a stamp.
    fn judge_turns(&mut self, zero: Nanos, angle_deg: f64, range_mm: f64) -> Nanos {
        let rate = f64::from(self.settings.model.points_per_second());
        let mut worst = 0;
        for turn in &self.turns {
            let about = (turn.first.saturating_sub(zero) as f64 * rate / 1e9) as u64;
            let edge_deg = 180.0 / self.session.beams().expect("known") as f64;
            let clockwise = |point: &Point| -f64::from(point.angle).to_degrees();
            let off = |a: f64, b: f64| (a - b + 540.0).rem_euclid(360.0) - 180.0;
            let first = turn.points[0];
            let near = (about.saturating_sub(rate as u64 / 50)..about + rate as u64 / 50).min_by(|a, b| {
                let far = |k: &u64| off(self.head.clockwise_deg(*k), clockwise(&first)).abs();
                far(a).total_cmp(&far(b))
            });
            let Some(number) = near else { continue };
            let begun = self.head.truth(number);
            let is_at_edge = off(begun.clockwise_deg, -edge_deg) < 1.5;
            assert!(turn.incomplete || is_at_edge, "begins at {}", begun.clockwise_deg);
            if is_at_edge {
                worst = worst.max(begun.at_ns.abs_diff(turn.first));
            }
            let span_deg = clockwise(&turn.points[turn.points.len() - 1]) - clockwise(&first);
            assert!(span_deg.rem_euclid(360.0) < 360.0 && turn.points.len() as f64 <= rate / 4.0);
            let mut last = f64::MIN;
            for point in &turn.points {
                let angle = (clockwise(point) + edge_deg).rem_euclid(360.0);
                assert!(angle > last, "merged: {angle} behind {last}");
                last = angle;
            }
            if turn.incomplete {
                continue;
            }
            for (point, number) in turn.points.iter().zip(number..) {
                let truth = self.head.truth(number);
                assert!(off(truth.clockwise_deg, clockwise(point)).abs() < angle_deg, "{point:?} {truth:?}");
                let is_right = match truth.range_mm.filter(|_| point.range < line::NO_RETURN) {
                    Some(range) => (range - f64::from(point.range)).abs() < range_mm,
                    None => true,
                };
                assert!(is_right, "{point:?} {truth:?}");
            }
        }
        worst
    }
}

const SECOND: Nanos = 1_000 * MILLIS;

#[test]
fn every_point_of_every_turn_is_where_the_head_measured_it() {
    for model in Model::ALL {
        let mut bench = Bench::new(LdSettings::of(model), &still("room"), "", 7);
        bench.run(10 * SECOND);
        let due = 9 * model.turns_per_second() as usize;
        assert!(bench.turns.len() >= due, "{model:?}: {} turns", bench.turns.len());
        assert!(bench.turns.iter().all(|turn| !turn.incomplete));
        // Rounding hides half a millimeter of a range and a hundredth of a degree of an angle.
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
        // Here, the bytes of a flood arrive at once, as on no real line. Bytes before them look as early as the last
        // read.
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
    // The measurements since the last change are known.
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

const SPIN_UPS: [f64; 4] = [0.0, 0.5, 1.5, 3.0];

/// A scanner and a session that does not know its model.
fn bench_of(settings: LdSettings, seed: u64) -> Bench {
    let mut bench = Bench::new(LdSettings { seed, ..settings }, &still("wall640"), "", seed);
    bench.session = Session::new(Settings::default(), 0);
    bench
}

/// Different numbers of beams of the revolutions, in their order.
fn numbers_of_beams(bench: &Bench) -> Vec<usize> {
    let mut numbers: Vec<usize> = bench.turns.iter().map(|turn| turn.beams).collect();
    numbers.dedup();
    numbers
}

#[test]
fn a_power_cycle_does_not_change_the_number_of_beams() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UPS {
            for seed in 0..2 {
                let mut bench = bench_of(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.run(3 * SECOND);
                for cycle in 1..=2 {
                    let before = bench.turns.len();
                    bench.cycle_power();
                    bench.run((3 + 20 * cycle) * SECOND);
                    assert!(bench.turns.len() > before + 50, "{model:?} {spin_up_s}: streams again");
                }
                assert_eq!(numbers_of_beams(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
                assert_eq!(
                    (bench.session.model().map(Model::beams), bench.session.trouble()),
                    (Some(model.beams()), None)
                );
            }
        }
    }
}

#[test]
fn a_scanner_that_gets_power_later_has_its_beams_from_the_first_scan_on() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UPS {
            for seed in 0..2 {
                let mut bench = bench_of(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.cycle_power();
                bench.run(20 * SECOND);
                assert_eq!(numbers_of_beams(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
            }
        }
    }
}

#[test]
fn beams_are_the_points_that_a_revolution_has() {
    let sold = LdSettings { points_per_second: 5_000.0, ..LdSettings::of(Model::Stl19p) };
    let slow = LdSettings { turns_per_second: 4.0, ..LdSettings::of(Model::Ld14p) };
    for (settings, beams) in [(sold, 500), (slow, 1_000)] {
        for seed in 0..2 {
            let mut bench = bench_of(settings, seed);
            bench.run(10 * SECOND);
            let numbers = numbers_of_beams(&bench);
            assert!(numbers.len() == 1 && numbers[0].abs_diff(beams) * 100 <= beams, "{numbers:?}");
            // A configured number stays.
            let configured = Settings { beams: Some(300), ..Settings::default() };
            let mut bench = bench_of(settings, seed);
            bench.session = Session::new(configured, 0);
            bench.run(5 * SECOND);
            assert_eq!(numbers_of_beams(&bench), [300]);
        }
    }
}

#[test]
fn another_speed_changes_the_beams_after_ten_seconds_and_says_so() {
    let mut bench = bench_of(LdSettings::of(Model::Ld19), 1);
    bench.run(3 * SECOND);
    for (speed, span) in [(8.0, 5), (10.0, 5), (8.0, 25)] {
        bench.head.set_speed(speed);
        let end = bench.now + span * SECOND;
        bench.run(end);
    }
    let numbers = numbers_of_beams(&bench);
    assert!(numbers.len() == 2 && numbers[0] == 450 && numbers[1].abs_diff(562) < 8, "{numbers:?}");
    let trouble = bench.session.trouble().expect("reported");
    assert_eq!(trouble, Trouble::BeamsChanged { from: 450, to: numbers[1] });
    assert!(trouble.to_string().contains("instead of 450"));
}

#[test]
fn a_typical_scanner_has_its_beams_within_a_revolution() {
    for model in Model::ALL.into_iter().filter(|model| model.baud() == 230_400) {
        let mut bench = bench_of(LdSettings::of(model), 1);
        bench.run(SECOND);
        assert_eq!(numbers_of_beams(&bench), [model.beams()]);
        let revolution = SECOND / Nanos::from(model.turns_per_second());
        assert!(bench.turns[0].first < revolution + 100 * MILLIS, "{model:?}");
    }
}
