//! Tests of LDROBOT scanners in simulated rooms. The session reports the points that the scanner measured. If no model
//! is configured, the session measures how many points a revolution has, and uses this number as the number of beams.
//! The number stays right after power failures.

use scanhub_drivers::ld::packet::PACKET_LEN;
use scanhub_drivers::ld::{LdSession, Model, Problem};
use scanhub_drivers::line::Point;
use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _, State};
use scanhub_drivers::{Settings, ld, line};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::{ChunkKind, Device as _};
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator, recorded_packets};
use scanhub_sim::line_model::LineModel;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// A packet that was sent, and whether it arrived intact.
struct SentPacket {
    bytes: Vec<u8>,
    intact: bool,
    at: Nanos,
}

struct Revolution {
    points: Vec<Point>,
    first: Nanos,
    incomplete: bool,
    beams: usize,
}

struct Bench {
    session: LdSession,
    scanner: LdSimulator,
    settings: LdSettings,
    line: LineModel,
    now: Nanos,
    inbox: Vec<u8>,
    intact: bool,
    sent: Vec<SentPacket>,
    packets: Vec<[u8; PACKET_LEN]>,
    /// Time of arrival that the session reports for each packet.
    stamps: Vec<Nanos>,
    revolutions: Vec<Revolution>,
}

/// Returns a world without noise.
fn noiseless_world(world: &str) -> World {
    world.parse::<World>().expect("a world").with_noise(NoiseModel::NONE)
}

impl Bench {
    fn new(settings: LdSettings, world: &World, faults: &str, seed: u64) -> Bench {
        Bench::with_simulator(settings, LdSimulator::new(settings, Room::new(world, seed)), faults, seed)
    }

    fn with_simulator(settings: LdSettings, head: LdSimulator, faults: &str, seed: u64) -> Bench {
        let faults: Faults = faults.parse().expect("faults");
        let session =
            LdSession::new(Settings { model: Some(settings.model.name()), ..Settings::default() }, 0);
        Bench {
            session,
            scanner: head,
            settings,
            line: LineModel::new(&faults, seed),
            now: 0,
            inbox: Vec::new(),
            intact: true,
            sent: Vec::new(),
            packets: Vec::new(),
            stamps: Vec::new(),
            revolutions: Vec::new(),
        }
    }

    fn run(&mut self, until: Nanos) {
        loop {
            let (wakes_at, waits) = self.drain();
            loop {
                let next =
                    self.line.poll_timeout(&self.scanner, self.now).unwrap_or(Nanos::MAX).max(self.now);
                let is_ready = waits && !self.inbox.is_empty();
                if is_ready || next > wakes_at.min(until) {
                    break;
                }
                self.now = next;
                self.transmit();
            }
            if self.inbox.is_empty() || !waits {
                self.now = self.now.max(wakes_at.min(until));
            }
            if self.now >= until {
                return;
            }
            let is_timeout = self.now >= wakes_at;
            let spare = self.session.read_buffer();
            let len = spare.len().min(self.inbox.len());
            spare[..len].copy_from_slice(&self.inbox[..len]);
            self.inbox.drain(..len);
            self.session.commit(self.now, len);
            if len == 0 && is_timeout {
                self.session.handle_timeout(self.now);
            }
        }
    }

    fn transmit(&mut self) {
        while let Some(carried) = self.line.poll_transmit(&mut self.scanner, self.now) {
            self.intact &= carried.fault.is_none();
            // A host at another rate than the line does not receive the bytes.
            if carried.rate == self.session.rate() {
                self.inbox.extend(carried.bytes);
            }
            if let Some(ChunkKind::End(sent)) = carried.part {
                let intact = std::mem::replace(&mut self.intact, true);
                self.sent.push(SentPacket { bytes: sent.telegram, intact, at: self.now });
            }
        }
    }

    /// Carries out the session's actions until it waits. Returns the end of the wait, and whether the arrival of bytes
    /// ends it.
    fn drain(&mut self) -> (Nanos, bool) {
        loop {
            match self.session.poll_action() {
                Action::Event(Event::Telegram(received)) => {
                    assert!(received.last <= self.now);
                    self.packets.extend(received.bytes.as_chunks().0);
                    self.stamps.push(received.first);
                }
                Action::Event(Event::Scan(revolution)) => self.revolutions.push(Revolution {
                    points: revolution.points().to_vec(),
                    first: revolution.first,
                    incomplete: revolution.is_incomplete(),
                    beams: revolution.beams(),
                }),
                Action::SetRate(_) => self.inbox.clear(),
                Action::SleepUntil(until) => return (until, false),
                Action::Wait { until, .. } => return (until, true),
                output => panic!("{output:?}"),
            }
        }
    }

    fn cycle_power(&mut self) {
        self.line.cycle_power(&mut self.scanner, self.now);
    }

    fn brown_out(&mut self) {
        self.scanner.brown_out(self.now);
    }

    /// Checks that the session delivered every intact packet, in order.
    fn check_packets(&self) {
        let mut arrived = self.packets.iter();
        let due = self.sent.iter().filter(|sent| sent.intact && sent.at + 20 * MILLIS < self.now);
        for (number, sent) in due.enumerate() {
            assert!(arrived.any(|bytes| bytes[..] == sent.bytes), "intact packet {number} was lost");
        }
    }

    /// Compares each revolution with the measurements of the head since `start`. The points of a revolution must belong
    /// to one revolution of the head, and must be in order. If the revolution is not marked as incomplete, no point may
    /// be missing, and the errors of each point may be at most `angle_deg` and `range_mm`. Returns the largest error of
    /// a stamp.
    fn check_revolutions(&mut self, start: Nanos, angle_deg: f64, range_mm: f64) -> Nanos {
        let rate = f64::from(self.settings.model.points_per_second());
        let mut worst = 0;
        for revolution in &self.revolutions {
            let about = (revolution.first.saturating_sub(start) as f64 * rate / 1e9) as u64;
            let edge_deg = 180.0 / self.session.beams().expect("known") as f64;
            let clockwise = |point: &Point| -f64::from(point.angle).to_degrees();
            let off = |a: f64, b: f64| (a - b + 540.0).rem_euclid(360.0) - 180.0;
            let first = revolution.points[0];
            let near = (about.saturating_sub(rate as u64 / 50)..about + rate as u64 / 50).min_by(|a, b| {
                let far = |k: &u64| off(self.scanner.clockwise_deg(*k), clockwise(&first)).abs();
                far(a).total_cmp(&far(b))
            });
            let Some(number) = near else { continue };
            let started = self.scanner.truth(number);
            let is_at_edge = off(started.clockwise_deg, -edge_deg) < 1.5;
            assert!(revolution.incomplete || is_at_edge, "begins at {}", started.clockwise_deg);
            if is_at_edge {
                worst = worst.max(started.at_ns.abs_diff(revolution.first));
            }
            let span_deg = clockwise(&revolution.points[revolution.points.len() - 1]) - clockwise(&first);
            assert!(span_deg.rem_euclid(360.0) < 360.0 && revolution.points.len() as f64 <= rate / 4.0);
            let mut last = f64::MIN;
            for point in &revolution.points {
                let angle = (clockwise(point) + edge_deg).rem_euclid(360.0);
                assert!(angle > last, "merged: {angle} after {last}");
                last = angle;
            }
            if revolution.incomplete {
                continue;
            }
            for (point, number) in revolution.points.iter().zip(number..) {
                let truth = self.scanner.truth(number);
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

const ONE_SECOND: Nanos = 1_000 * MILLIS;

#[test]
fn every_point_matches_its_simulated_measurement() {
    for model in Model::ALL {
        let mut bench = Bench::new(LdSettings::of(model), &noiseless_world("room"), "", 7);
        bench.run(10 * ONE_SECOND);
        let due = 9 * model.revolutions_per_second() as usize;
        assert!(bench.revolutions.len() >= due, "{model:?}: {} revolutions", bench.revolutions.len());
        assert!(bench.revolutions.iter().all(|revolution| !revolution.incomplete));
        // Rounding alone causes errors of half a millimeter in a range and a hundredth of a degree in an angle.
        let worst = bench.check_revolutions(0, 0.05, 2.0);
        assert!(worst < 2 * MILLIS, "{model:?}: {worst}");
        bench.check_packets();
        let ranges = bench
            .revolutions
            .iter()
            .flat_map(|revolution| &revolution.points)
            .filter(|point| point.range < line::NO_RETURN);
        let share = ranges.count() as f64
            / bench.revolutions.iter().map(|revolution| revolution.points.len()).sum::<usize>() as f64;
        assert!((0.4..1.0).contains(&share), "{model:?}: {share}");
    }
}

#[test]
fn lost_bytes_cost_no_intact_packet_or_accuracy() {
    for seed in 0..100 {
        let model = Model::ALL[seed as usize % Model::ALL.len()];
        let world = noiseless_world("wall640");
        let mut bench = Bench::new(LdSettings { seed, ..LdSettings::of(model) }, &world, LOSS_FAULTS, seed);
        bench.run(6 * ONE_SECOND);
        bench.check_packets();
        let worst = bench.check_revolutions(0, 0.05, 2.0);
        assert!(worst < 5 * MILLIS, "{seed}: {worst}");
        let stats = bench.session.stats();
        let lost = bench.sent.iter().filter(|sent| !sent.intact).count() as u64;
        assert!(stats.lost.abs_diff(lost) <= 2 + lost / 50, "{seed}: {stats:?}, {lost} lost");
        assert!(bench.revolutions.iter().any(|revolution| revolution.incomplete));
    }
}

#[test]
fn other_line_faults_cost_no_intact_packet() {
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
        let mut bench = Bench::new(LdSettings::of(Model::Ld19), &noiseless_world("bare"), faults, seed);
        bench.run(8 * ONE_SECOND);
        bench.check_packets();
        let worst = bench.check_revolutions(0, 0.05, 2.0);
        // In this simulation, all bytes of a flood arrive at once, which is impossible on a real line. The session
        // computes the stamps of earlier bytes as if the line had carried the flood, so these stamps are too early.
        let early = if faults.contains("every") { 5 * MILLIS } else { 0 };
        assert!(worst < 5 * MILLIS + early, "{faults}: {worst}");
        let stats = bench.session.stats();
        assert_eq!(stats.read, stats.in_telegrams + stats.discarded + stats.buffered);
        assert_eq!(bench.session.state(), State::Streaming, "{faults}");
    }
}

#[test]
fn stamps_stay_right_after_the_line_stalls() {
    for model in [Model::Ld19, Model::Stl27l] {
        let faults = "stall=0.5,stall_at=2,stall_every=2,delay=0.003";
        let mut bench = Bench::new(LdSettings::of(model), &noiseless_world("wall640"), faults, 3);
        bench.run(20 * ONE_SECOND);
        let worst = bench.check_revolutions(0, 0.05, 2.0);
        assert!(worst < 5 * MILLIS, "{model:?}: {worst}");
        assert!(bench.stamps.windows(2).all(|pair| pair[0] <= pair[1] + MILLIS));
        bench.check_packets();
    }
}

#[test]
fn power_cycle_is_a_silence_and_one_restart() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &noiseless_world("wall640"), "", 3);
    bench.run(3 * ONE_SECOND);
    let revolutions = bench.revolutions.len();
    bench.cycle_power();
    bench.run(5 * ONE_SECOND);
    assert_eq!(bench.session.state(), State::Silent);
    assert!(bench.revolutions.len() <= revolutions + 1);
    bench.check_revolutions(0, 0.05, 2.0);
    bench.revolutions.clear();
    bench.run(8 * ONE_SECOND);
    assert_eq!((bench.session.state(), bench.session.stats().resyncs), (State::Streaming, 1));
    assert!(bench.revolutions.len() > 25, "{}", bench.revolutions.len());
    bench.check_revolutions(5 * ONE_SECOND, 0.05, 2.0);
    assert_eq!((bench.session.stats().lost, bench.session.stats().restarts), (0, 1));
}

#[test]
fn every_brown_out_is_a_restart() {
    for model in Model::ALL {
        let mut bench = Bench::new(LdSettings::of(model), &noiseless_world("wall640"), "", 3);
        bench.run(4 * ONE_SECOND);
        for restarts in 1..=12 {
            // Simulate a voltage that falls: the head first becomes slower.
            let revolutions_per_second = f64::from(model.revolutions_per_second());
            for slow in 0..restarts {
                bench.scanner.set_speed(revolutions_per_second * (1.0 - 0.03 * slow as f64));
                bench.run(bench.now + 30 * MILLIS);
            }
            bench.brown_out();
            // Wait for an uneven time, so that the scanner's clock, which wraps after 30 s, has another value at each
            // restart.
            bench.run(bench.now + 2 * ONE_SECOND + restarts * 417 * MILLIS);
            assert_eq!(bench.session.stats().restarts, restarts, "{model:?}");
            assert_eq!(
                (bench.session.state(), bench.session.problem()),
                (State::Streaming, None),
                "{model:?}"
            );
        }
        let revolutions = bench.revolutions.len();
        bench.run(bench.now + 2 * ONE_SECOND);
        assert!(bench.revolutions.len() > revolutions + 10, "{model:?}");
    }
}

#[test]
fn line_faults_are_not_counted_as_restarts() {
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
        // In 100 s, the scanner's clock wraps three times.
        let mut bench = Bench::new(LdSettings::of(Model::Ld19), &noiseless_world("bare"), faults, 11);
        bench.run(100 * ONE_SECOND);
        assert_eq!(bench.session.stats().restarts, 0, "{faults}");
    }
}

#[test]
fn heavy_byte_damage_is_not_reported_as_standstill() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &noiseless_world("room"), "loss=0.08", 5);
    bench.run(4 * ONE_SECOND);
    for _ in 0..100 {
        bench.run(bench.now + 100 * MILLIS);
        assert_ne!(bench.session.problem(), Some(ld::Problem::HeadBlocked));
    }
    let stats = bench.session.stats();
    assert!(stats.damaged > 2 * stats.in_telegrams, "{stats:?}");
}

#[test]
fn points_stay_accurate_when_the_speed_changes() {
    let mut bench = Bench::new(LdSettings::of(Model::Ld19), &noiseless_world("room"), "", 7);
    for step in 0..60 {
        bench.run(2 * ONE_SECOND + step * 100 * MILLIS);
        // The speed falls from 10 revolutions per second to 6, and rises to 12.
        let turns = if step < 20 { 10.0 - 0.2 * step as f64 } else { 6.2 + 0.15 * (step - 20) as f64 };
        bench.scanner.set_speed(turns);
    }
    bench.run(10 * ONE_SECOND);
    bench.check_packets();
    let revolutions = std::mem::take(&mut bench.revolutions);
    assert!(revolutions.iter().all(|revolution| !revolution.incomplete));
    let periods: Vec<_> = revolutions.windows(2).map(|pair| pair[1].first - pair[0].first).collect();
    let (shortest, longest) = (periods.iter().min().unwrap(), periods.iter().max().unwrap());
    assert!(*shortest < 87 * MILLIS && *longest > 155 * MILLIS, "{shortest} {longest}");
    // The simulator returns true points only since the last change of speed, so drop the earlier revolutions.
    let after = revolutions.into_iter().filter(|revolution| revolution.first > 8_100 * MILLIS);
    bench.revolutions = after.collect();
    assert!(bench.revolutions.len() > 18, "{}", bench.revolutions.len());
    assert!(bench.check_revolutions(0, 0.05, 2.0) < 2 * MILLIS);
}

#[test]
fn same_seed_repeats_and_recording_replays_packets() {
    let world: World = "demo".parse().expect("a world");
    let packets_of = |seed| {
        let mut bench = Bench::new(LdSettings { seed, ..LdSettings::of(Model::Ld06) }, &world, "", seed);
        bench.run(3 * ONE_SECOND);
        bench.packets
    };
    let packets = packets_of(5);
    assert!(packets == packets_of(5) && packets != packets_of(6));
    let path = tempfile::NamedTempFile::new().expect("a file").into_temp_path();
    let mut bytes = packets[0][20..].to_vec();
    packets.iter().for_each(|packet| bytes.extend(packet));
    std::fs::write(&path, &bytes).expect("written");
    let found = recorded_packets(&path, None).expect("packets");
    std::fs::write(&path, b"nothing").expect("written");
    let none = recorded_packets(&path, None).expect_err("no packets");
    assert!(none.message.contains("no packet"), "{none}");
    assert_eq!(found, packets);
    for looped in [false, true] {
        let settings = LdSettings::of(Model::Ld06);
        let head = LdSimulator::repeating(settings, found.clone(), looped);
        let mut bench = Bench::with_simulator(settings, head, "", 1);
        bench.run(7 * ONE_SECOND);
        assert_eq!(bench.packets[..packets.len()], packets);
        assert_eq!(bench.packets.len() > packets.len(), looped);
        let revolutions = bench.revolutions.len();
        assert!(if looped { revolutions > 50 } else { (25..=30).contains(&revolutions) }, "{revolutions}");
    }
}

/// Faults with the loss of bytes that was measured on a real line at 500,000 baud.
const LOSS_FAULTS: &str = "loss=0.00135,burst=1.89";

const SPIN_UP_TIMES_S: [f64; 4] = [0.0, 0.5, 1.5, 3.0];

/// Creates a scanner with a session for which no model is configured.
fn new_bench(settings: LdSettings, seed: u64) -> Bench {
    let mut bench = Bench::new(LdSettings { seed, ..settings }, &noiseless_world("wall640"), "", seed);
    bench.session = LdSession::new(Settings::default(), 0);
    bench
}

/// Returns the numbers of beams of the revolutions in order. Equal consecutive numbers are listed once.
fn beam_counts(bench: &Bench) -> Vec<usize> {
    let mut numbers: Vec<usize> = bench.revolutions.iter().map(|revolution| revolution.beams).collect();
    numbers.dedup();
    numbers
}

#[test]
fn power_cycle_does_not_change_the_number_of_beams() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UP_TIMES_S {
            for seed in 0..2 {
                let mut bench = new_bench(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.run(3 * ONE_SECOND);
                for cycle in 1..=2 {
                    let before = bench.revolutions.len();
                    bench.cycle_power();
                    bench.run((3 + 20 * cycle) * ONE_SECOND);
                    assert!(bench.revolutions.len() > before + 50, "{model:?} {spin_up_s}: streams again");
                }
                assert_eq!(beam_counts(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
                assert_eq!(
                    (bench.session.model().map(Model::beams), bench.session.problem()),
                    (Some(model.beams()), None)
                );
            }
        }
    }
}

#[test]
fn scanner_powered_on_later_has_its_beams_at_once() {
    for model in Model::ALL {
        for spin_up_s in SPIN_UP_TIMES_S {
            for seed in 0..2 {
                let mut bench = new_bench(LdSettings { spin_up_s, ..LdSettings::of(model) }, seed);
                bench.cycle_power();
                bench.run(20 * ONE_SECOND);
                assert_eq!(beam_counts(&bench), [model.beams()], "{model:?} {spin_up_s}, seed {seed}");
            }
        }
    }
}

#[test]
fn beam_count_matches_points_per_revolution() {
    let sold = LdSettings { points_per_second: 5_000.0, ..LdSettings::of(Model::Stl19p) };
    let slow = LdSettings { revolutions_per_second: 4.0, ..LdSettings::of(Model::Ld14p) };
    for (settings, beams) in [(sold, 500), (slow, 1_000)] {
        for seed in 0..2 {
            let mut bench = new_bench(settings, seed);
            bench.run(10 * ONE_SECOND);
            let numbers = beam_counts(&bench);
            assert!(numbers.len() == 1 && numbers[0].abs_diff(beams) * 100 <= beams, "{numbers:?}");
            // A configured number of beams does not change.
            let configured = Settings { beams: Some(300), ..Settings::default() };
            let mut bench = new_bench(settings, seed);
            bench.session = LdSession::new(configured, 0);
            bench.run(5 * ONE_SECOND);
            assert_eq!(beam_counts(&bench), [300]);
        }
    }
}

#[test]
fn lasting_speed_change_changes_beams_and_is_reported() {
    let mut bench = new_bench(LdSettings::of(Model::Ld19), 1);
    bench.run(3 * ONE_SECOND);
    for (speed, span) in [(8.0, 5), (10.0, 5), (8.0, 25)] {
        bench.scanner.set_speed(speed);
        let end = bench.now + span * ONE_SECOND;
        bench.run(end);
    }
    let numbers = beam_counts(&bench);
    assert!(numbers.len() == 2 && numbers[0] == 450 && numbers[1].abs_diff(562) < 8, "{numbers:?}");
    let problem = bench.session.problem().expect("reported");
    assert_eq!(problem, Problem::BeamsChanged { from: 450, to: numbers[1] });
    assert!(problem.to_string().contains("instead of 450"));
}

#[test]
fn typical_scanner_has_beams_within_one_revolution() {
    for model in Model::ALL.into_iter().filter(|model| model.baud() == 230_400) {
        let mut bench = new_bench(LdSettings::of(model), 1);
        bench.run(ONE_SECOND);
        assert_eq!(beam_counts(&bench), [model.beams()]);
        let revolution = ONE_SECOND / Nanos::from(model.revolutions_per_second());
        assert!(bench.revolutions[0].first < revolution + 100 * MILLIS, "{model:?}");
    }
}
