//! Tests of sessions with LDROBOT scanners, on lines that damage bytes, in virtual time. For any input, the session
//! counts every byte once and does not panic.

use scanhub_drivers::Settings;
use scanhub_drivers::ld::packet::{
    CLOCK_PERIOD_MS, FULL_CIRCLE, HEADER, PACKET_LEN, POINTS_PER_PACKET, PacketContents,
};
use scanhub_drivers::ld::{LdSession, Model, Problem};
use scanhub_drivers::line::{Action, Control, Event, Protocol as _, ScannerSession as _, State};
use scanhub_drivers::line::{Grid, NOT_MEASURED};
use scanhub_schema::{MILLIS, Nanos};

use crate::{DamageRates, DamagedLine, SentPacket};

/// A revolution as the session returned it.
#[derive(Debug)]
struct DeliveredRevolution {
    /// Indices of the scanner's points.
    points: Vec<u64>,
    /// Number of points whose angle does not belong to the point that their range identifies.
    wrong: usize,
    first: Nanos,
    period: Nanos,
    incomplete: bool,
}

/// Outputs of a session.
#[derive(Default)]
struct SessionLog {
    packets: Vec<[u8; PACKET_LEN]>,
    revolutions: Vec<DeliveredRevolution>,
    /// Maximum number of packets in a sample.
    max_packets: usize,
    reads: usize,
    bauds: Vec<u32>,
}

struct TestBench {
    session: LdSession,
    scanner: SimulatedScanner,
    now: Nanos,
    log: SessionLog,
}

impl TestBench {
    fn new(settings: Settings, scanner: SimulatedScanner) -> TestBench {
        TestBench { session: LdSession::new(settings, 0), scanner, now: 0, log: SessionLog::default() }
    }

    /// Runs the session until `until`.
    fn run(&mut self, until: Nanos) {
        while self.now < until {
            let (wakes_at, waits) = match self.drain() {
                (Some(at), _) => (at, false),
                (None, at) => (at, true),
            };
            let ready = if waits && self.session.rate() == self.scanner.model.baud() {
                self.scanner.next()
            } else {
                Nanos::MAX
            };
            self.now = wakes_at.min(ready.max(self.now)).min(until);
            self.read(self.now >= wakes_at);
        }
    }

    fn read(&mut self, is_timeout: bool) {
        let room = self.session.read_buffer().len();
        let mut bytes = self.scanner.read(self.now, room);
        if self.session.rate() != self.scanner.model.baud() {
            // At a wrong rate, the bytes are noise.
            bytes = bytes.iter().step_by(4).map(|byte| byte | 0x80).collect();
        }
        self.session.read_buffer()[..bytes.len()].copy_from_slice(&bytes);
        self.session.commit(self.now, bytes.len());
        self.log.reads += 1;
        if bytes.is_empty() && is_timeout {
            self.session.handle_timeout(self.now);
        }
        let stats = self.session.stats();
        assert_eq!(stats.read, stats.in_telegrams + stats.discarded + stats.buffered);
    }

    /// Returns two times: the end of the session's sleep, if it sleeps, and the end of its wait.
    fn drain(&mut self) -> (Option<Nanos>, Nanos) {
        loop {
            match self.session.poll_action() {
                Action::SetRate(baud) => self.log.bauds.push(baud),
                Action::Transmit { .. } | Action::SetDtr(_) => panic!("nothing is sent to such a scanner"),
                Action::SleepUntil(until) => {
                    assert!(until > self.now && until <= self.now + 5 * MILLIS);
                    return (Some(until), until);
                }
                Action::Wait { until, .. } => return (None, until),
                Action::Event(Event::Telegram(received)) => {
                    assert!(received.first <= received.last && received.last <= self.now);
                    assert!(received.last - received.first <= 10 * MILLIS);
                    let (packets, rest) = received.bytes.as_chunks::<PACKET_LEN>();
                    assert!(rest.is_empty());
                    self.log.max_packets = self.log.max_packets.max(packets.len());
                    self.log.packets.extend(packets);
                }
                Action::Event(Event::Scan(revolution)) => {
                    let head = &self.scanner;
                    let rate = u64::from(head.model.points_per_second());
                    let about = revolution.first.saturating_sub(head.switched_on_at) * rate / 1_000_000_000;
                    let points: Vec<u64> = revolution
                        .points()
                        .iter()
                        .map(|point| SimulatedScanner::point_of(point.range, about))
                        .collect();
                    let wrong = revolution.points().iter().zip(&points).filter(|(delivered, point)| {
                        let right = head.angle(**point) % 36_000.0;
                        let off =
                            (-f64::from(delivered.angle).to_degrees() * 100.0 - right).rem_euclid(36_000.0);
                        // The angles of a packet are truncated to hundredths of a degree.
                        off.min(36_000.0 - off) > 2.0
                    });
                    let wrong = wrong.count();
                    let (first, period, incomplete) =
                        (revolution.first, revolution.period, revolution.is_incomplete());
                    self.log.revolutions.push(DeliveredRevolution {
                        points,
                        wrong,
                        first,
                        period,
                        incomplete,
                    });
                }
            }
        }
    }

    /// Checks the points of every revolution: they are right, in order, and from one revolution of the head. A
    /// revolution that is not marked as incomplete must have all points. Returns the largest error of a stamp.
    fn check_revolutions(&self) -> Nanos {
        let beams = self.session.beams().expect("known");
        let edge = 18_000.0 / beams as f64;
        let mut worst = 0;
        let turn_of = |point: u64| ((self.scanner.angle(point) + edge) / 36_000.0).floor();
        for revolution in &self.log.revolutions {
            let (first, last) = (revolution.points[0], revolution.points[revolution.points.len() - 1]);
            // Because angles are rounded, a point may appear in the previous or next revolution.
            let is_whole = revolution.points.len() as u64 == last - first + 1;
            assert!(revolution.points.windows(2).all(|pair| pair[0] < pair[1]), "{revolution:?}");
            assert!(
                last - first <= self.scanner.points_per_revolution.ceil() as u64,
                "merged: {revolution:?}"
            );
            assert!((turn_of(first) - turn_of(last)).abs() < 2.0, "merged: {revolution:?}");
            if !revolution.incomplete {
                assert_eq!(revolution.wrong, 0, "{revolution:?}");
                assert!(
                    is_whole && (last - first + 1).abs_diff(self.scanner.points_per_revolution as u64) <= 1,
                    "{revolution:?}"
                );
            }
            let at = (turn_of(last - 1) * 36_000.0 - edge).max(0.0);
            let started =
                self.scanner.time((at / 36_000.0 * self.scanner.points_per_revolution).ceil() as u64);
            worst = worst.max(revolution.first.abs_diff(started));
        }
        worst
    }

    fn assert_intact_packets_once_in_order(&self) {
        let mut arrived = self.log.packets.iter();
        for sent in self.scanner.sent.iter().filter(|sent| sent.intact && sent.at + 10 * MILLIS < self.now) {
            assert!(arrived.any(|bytes| sent.bytes == *bytes), "lost: {:?}", sent.bytes);
        }
    }
}

fn settings_of(model: Model) -> Settings {
    Settings { model: Some(model.name()), ..Settings::default() }
}

fn points_per_revolution(model: Model) -> f64 {
    f64::from(model.points_per_second()) / f64::from(model.revolutions_per_second())
}

const ONE_SECOND: Nanos = 1_000 * MILLIS;

#[test]
fn uneven_speed_does_not_change_the_models_beams() {
    let model = Model::Ld19;
    let mut head = SimulatedScanner::new(model, points_per_revolution(model), 1, DamageRates::default());
    head.jitter = 0.05;
    let mut bench = TestBench::new(Settings::default(), head);
    bench.run(9 * ONE_SECOND);
    assert_eq!((bench.log.revolutions.len(), bench.session.problem()), (0, None), "the head rotates");
    bench.run(15 * ONE_SECOND);
    assert!(bench.log.revolutions.len() > 25, "{}", bench.log.revolutions.len());
    assert_eq!((bench.session.beams(), bench.session.problem()), (Some(model.beams()), None));
}

#[test]
fn receives_every_revolution_of_every_model() {
    for model in Model::ALL {
        // At this speed, the points of any two revolutions have different angles.
        let head =
            SimulatedScanner::new(model, points_per_revolution(model) * 1.000_7, 1, DamageRates::default());
        let mut bench = TestBench::new(settings_of(model), head);
        // The session reads byte by byte until it has identified the stream.
        bench.run(2 * ONE_SECOND);
        bench.log.reads = 0;
        bench.run(11 * ONE_SECOND);
        let hz = u64::from(model.revolutions_per_second());
        let revolutions = bench.log.revolutions.len() as u64;
        assert!((10 * hz - 3..=10 * hz).contains(&revolutions), "{model:?}: {revolutions}");
        assert!(bench.log.revolutions.iter().all(|revolution| !revolution.incomplete));
        let worst = bench.check_revolutions();
        assert!(worst < 2 * MILLIS, "{model:?}: {worst}");
        bench.assert_intact_packets_once_in_order();
        let stats = bench.session.stats();
        assert_eq!((stats.lost, stats.discarded), (0, 0));
        assert_eq!(stats.due, stats.telegrams);
        assert_eq!(bench.session.state(), State::Streaming);
        assert_eq!(bench.session.beams(), Some(model.beams()));
        // The session reads about once every 5 ms, and not once per byte.
        assert!(bench.log.reads < 1_900, "{model:?}: {} reads", bench.log.reads);
        assert!(bench.log.max_packets <= 17 && bench.log.bauds.is_empty());
    }
}

#[test]
fn finds_unconfigured_model_by_rate_and_points() {
    for (model, found) in
        [(Model::Ld06, Model::Ld19), (Model::Stl27l, Model::Stl27l), (Model::Ld14p, Model::Ld14p)]
    {
        let mut bench = TestBench::new(
            Settings::default(),
            SimulatedScanner::new(model, points_per_revolution(model), 1, DamageRates::default()),
        );
        bench.run(4 * ONE_SECOND);
        assert_eq!(bench.session.model(), Some(found));
        assert_eq!(bench.session.state(), State::Streaming, "{model:?}: {:?}", bench.log.bauds);
        assert_eq!(bench.session.beams(), Some(found.beams()));
        assert!(bench.log.revolutions.len() > 10);
        bench.check_revolutions();
    }
}

#[test]
fn damaged_bytes_cost_only_damaged_packets() {
    for seed in 0..100 {
        let mut random = fastrand::Rng::with_seed(!seed);
        let damage = DamageRates {
            lost: random.f64() * 0.004,
            inserted: random.f64() * 0.001,
            flipped: random.f64() * 0.001,
        };
        let model = Model::ALL[seed as usize % 5];
        let head = SimulatedScanner::new(
            model,
            points_per_revolution(model) * (0.9 + 0.2 * random.f64()),
            seed,
            damage,
        );
        let mut bench = TestBench::new(settings_of(model), head);
        bench.run(6 * ONE_SECOND);
        bench.assert_intact_packets_once_in_order();
        bench.check_revolutions();
        let counts = bench.session.revolution_counts();
        assert!(counts.returned > 4 * u64::from(model.revolutions_per_second()), "{seed}: {counts:?}");
        assert!(counts.incomplete > 0 && counts.returned == bench.log.revolutions.len() as u64);
        let stats = bench.session.stats();
        let sent = bench.scanner.sent.iter().filter(|sent| sent.at < bench.now).count() as u64;
        let off = (stats.due as i64 - sent as i64).abs();
        assert!(off <= 8 + sent as i64 / 500, "{seed}: {stats:?} of {sent}");
        assert!(stats.lost > 0 && stats.damaged > 0);
    }
}

#[test]
fn stamps_after_host_stall_are_within_5_ms() {
    for model in [Model::Ld19, Model::Stl27l] {
        for drift in [0.0, 0.000_2, -0.001] {
            let mut head =
                SimulatedScanner::new(model, points_per_revolution(model), 3, DamageRates::default());
            head.drift = drift;
            let mut bench = TestBench::new(settings_of(model), head);
            for stall in 2..20 {
                bench.run(stall * ONE_SECOND);
                bench.now += 500 * MILLIS;
                bench.read(true);
            }
            bench.run(20 * ONE_SECOND);
            let worst = bench.check_revolutions();
            assert!(worst < 5 * MILLIS, "{model:?} {drift}: {worst}");
            assert_eq!((bench.session.stats().lost, bench.session.stats().restarts), (0, 0));
            bench.assert_intact_packets_once_in_order();
        }
    }
}

#[test]
fn counts_packets_lost_in_a_full_buffer() {
    let mut bench = TestBench::new(
        settings_of(Model::Ld19),
        SimulatedScanner::new(Model::Ld19, points_per_revolution(Model::Ld19), 3, DamageRates::default()),
    );
    bench.run(3 * ONE_SECOND);
    let before = bench.session.revolution_counts();
    bench.scanner.lose_until(3 * ONE_SECOND + 250 * MILLIS);
    bench.now += 250 * MILLIS;
    bench.read(true);
    bench.run(6 * ONE_SECOND);
    let counts = bench.session.revolution_counts();
    assert!(bench.check_revolutions() < 5 * MILLIS);
    assert!(counts.incomplete > before.incomplete && counts.missed + counts.short >= 1, "{counts:?}");
    let lost = bench.session.stats().lost;
    assert!((92..=95).contains(&lost), "{lost}");
    assert_eq!((bench.session.state(), bench.session.stats().restarts), (State::Streaming, 0));
}

#[test]
fn long_host_stall_is_not_a_scanner_restart() {
    for stall in [2, 9, 29, 30, 31, 64] {
        let head = SimulatedScanner::new(Model::Ld19, 450.0, 3, DamageRates::default());
        let mut bench = TestBench::new(settings_of(Model::Ld19), head);
        bench.run(3 * ONE_SECOND);
        // The tty keeps the first bytes and has no room for the others.
        bench.now += stall * ONE_SECOND;
        bench.scanner.lose_until(bench.now);
        bench.read(true);
        bench.run(bench.now + 3 * ONE_SECOND);
        assert_eq!((bench.session.state(), bench.session.stats().restarts), (State::Streaming, 0), "{stall}");
    }
}

#[test]
fn revolution_cut_by_a_gap_keeps_previous_period() {
    let mut bench = TestBench::new(
        settings_of(Model::Ld19),
        SimulatedScanner::new(Model::Ld19, 450.0, 3, DamageRates::default()),
    );
    // In the twentieth revolution, the head slows down. At the end of the gap, the head has the same angle as at the
    // start of the gap, one revolution later.
    bench.run(ONE_SECOND + 1_970 * MILLIS);
    bench.scanner.points_per_revolution = 450.0 * 19.7 / 18.7;
    bench.scanner.lose_until(bench.now + 200 * MILLIS);
    bench.now += 200 * MILLIS;
    bench.read(true);
    bench.run(4 * ONE_SECOND);
    assert_eq!(bench.session.stats().resyncs, 0);
    let revolution =
        bench.log.revolutions.iter().find(|revolution| revolution.incomplete).expect("one with a gap");
    assert!(revolution.period.abs_diff(100 * MILLIS) < MILLIS, "{}", revolution.period);
}

#[test]
fn session_recovers_from_a_second_without_packets() {
    let mut bench = TestBench::new(
        settings_of(Model::Ld19),
        SimulatedScanner::new(Model::Ld19, 450.0, 3, DamageRates::default()),
    );
    bench.run(3 * ONE_SECOND);
    bench.scanner.lose_until(5 * ONE_SECOND);
    bench.run(4 * ONE_SECOND + 50 * MILLIS);
    assert_eq!((bench.session.state(), bench.session.problem()), (State::Silent, Some(Problem::Silence)));
    bench.run(6 * ONE_SECOND);
    assert_eq!((bench.session.state(), bench.session.problem()), (State::Streaming, None));
    assert_eq!((bench.session.stats().resyncs, bench.session.stats().lost), (1, 0));
    assert_eq!(bench.session.stats().restarts, 0, "its clock went on");
    bench.check_revolutions();
}

#[test]
fn reports_a_silent_line_in_steps() {
    let mut session = LdSession::new(Settings::default(), 0);
    let (mut now, mut troubles, mut bauds) = (0, Vec::new(), Vec::new());
    while now < 20 * ONE_SECOND {
        match session.poll_action() {
            Action::SetRate(baud) => bauds.push(baud),
            Action::Wait { until, .. } => {
                now = until;
                session.read_buffer();
                session.commit(now, 0);
                session.handle_timeout(now);
            }
            output => panic!("{output:?}"),
        }
        if troubles.last() != Some(&session.problem()) {
            troubles.push(session.problem());
        }
    }
    assert_eq!(bauds[..3], [921_600, 230_400, 921_600]);
    let steps = [1, 2, 4, 8, 16].map(|seconds| Problem::NoPackets { baud: None, seconds });
    assert_eq!(troubles[1..], steps.map(Some));
    assert!(steps[0].to_string().contains("230400 and 921600"));
}

#[test]
fn paused_session_delivers_nothing_until_resumed() {
    let mut bench = TestBench::new(
        settings_of(Model::Ld19),
        SimulatedScanner::new(Model::Ld19, 450.0, 3, DamageRates::default()),
    );
    bench.run(3 * ONE_SECOND);
    bench.session.control(Control::Pause, bench.now);
    let (packets, revolutions) = (bench.log.packets.len(), bench.log.revolutions.len());
    bench.run(5 * ONE_SECOND);
    assert_eq!((bench.log.packets.len(), bench.log.revolutions.len()), (packets, revolutions));
    assert_eq!((bench.session.state(), bench.session.problem()), (State::Paused, None));
    bench.session.control(Control::Resume, bench.now);
    bench.run(6 * ONE_SECOND);
    assert_eq!(bench.session.state(), State::Streaming);
    assert!(bench.log.revolutions.len() > revolutions + 5);
    assert_eq!(bench.session.stats().restarts, 0);
    bench.check_revolutions();
}

#[test]
fn revolution_fills_a_grid_of_constant_beams() {
    let mut bench = TestBench::new(
        settings_of(Model::Ld19),
        SimulatedScanner::new(Model::Ld19, 450.3, 3, DamageRates::default()),
    );
    bench.run(2 * ONE_SECOND);
    let grid = Grid::new(bench.session.beams().expect("known"));
    loop {
        let output = bench.session.poll_action();
        let Action::Event(Event::Scan(revolution)) = output else {
            let is_wait = matches!(output, Action::Wait { .. } | Action::SleepUntil(_));
            if is_wait {
                bench.now += MILLIS;
                bench.read(false);
            }
            continue;
        };
        let beams = grid.beams();
        let (mut ranges, mut intensities, mut angles) = (vec![0; beams], vec![0; beams], vec![0.0; beams]);
        let collisions = grid.fill(revolution.points(), &mut ranges, &mut intensities, &mut angles);
        let empty = ranges.iter().filter(|range| **range == NOT_MEASURED).count();
        assert!(empty < 3 && collisions < 3, "{empty} empty beams, {collisions} collisions");
        for (beam, angle) in angles.iter().enumerate().filter(|(_, angle)| !angle.is_nan()) {
            let off = (f64::from(*angle) - beam as f64 * grid.step()).rem_euclid(std::f64::consts::TAU);
            let off = off.min(std::f64::consts::TAU - off);
            assert!(off <= -grid.step() / 2.0 + 1e-4, "beam {beam}: {angle}");
        }
        break;
    }
}

/// A scanner whose head rotates evenly. The range of each point identifies the point.
struct SimulatedScanner {
    model: Model,
    /// Points per revolution.
    points_per_revolution: f64,
    /// Fraction by which the scanner's clock is slow.
    drift: f64,
    /// Fraction by which the speed in every second packet differs from the true speed.
    jitter: f64,
    random: fastrand::Rng,
    line: DamagedLine,
    sent: Vec<SentPacket>,
    /// Time of power-on. `packets` is the number of packets sent since then.
    switched_on_at: Nanos,
    packets: u64,
}

impl SimulatedScanner {
    fn new(model: Model, points_per_revolution: f64, seed: u64, damage: DamageRates) -> SimulatedScanner {
        SimulatedScanner {
            model,
            points_per_revolution,
            drift: 0.0,
            jitter: 0.0,
            random: fastrand::Rng::with_seed(seed),
            line: DamagedLine::new(damage),
            sent: Vec::new(),
            switched_on_at: 1_000 * MILLIS,
            packets: 0,
        }
    }

    /// Returns the time of the point with index `point` on the hub's clock.
    fn time(&self, point: u64) -> Nanos {
        let sensor_s = point as f64 / f64::from(self.model.points_per_second());
        self.switched_on_at + (sensor_s / (1.0 - self.drift) * 1e9) as Nanos
    }

    /// Returns the angle of the point with index `point` in hundredths of a degree, cumulative over all revolutions.
    fn angle(&self, point: u64) -> f64 {
        point as f64 * f64::from(FULL_CIRCLE) / self.points_per_revolution
    }

    /// Returns the range of the point with index `point`. The range identifies the point.
    fn range(point: u64) -> u16 {
        100 + (point % 20_011) as u16
    }

    /// Returns the index of the point with this range that is nearest to `about`.
    fn point_of(range: u16, about: u64) -> u64 {
        let off = (u64::from(range) + 20_011 - 100 - about % 20_011) % 20_011;
        if off > 10_005 { about + off - 20_011 } else { about + off }
    }

    /// Returns the bytes that have arrived by `now`, at most `room`.
    fn read(&mut self, now: Nanos, room: usize) -> Vec<u8> {
        self.send_until(now);
        self.line.read(now, room)
    }

    /// Returns the time at which the next byte arrives.
    fn next(&mut self) -> Nanos {
        let mut until = self.time((self.packets + 2) * POINTS_PER_PACKET as u64);
        while self.line.bytes.is_empty() {
            self.send_until(until);
            until += 10 * MILLIS;
        }
        self.line.bytes[0].0
    }

    fn send_until(&mut self, now: Nanos) {
        loop {
            let first = self.packets * POINTS_PER_PACKET as u64;
            let last = first + POINTS_PER_PACKET as u64 - 1;
            let done = self.time(last);
            if done > now {
                return;
            }
            self.packets += 1;
            let sensor_ms = last as f64 / f64::from(self.model.points_per_second()) * 1e3;
            let hz = f64::from(self.model.points_per_second()) / self.points_per_revolution;
            let word = |angle: f64| (angle % f64::from(FULL_CIRCLE)) as u16;
            let packet = PacketContents {
                speed: (360.0 * hz * (1.0 + self.jitter * (self.packets % 2) as f64)).round() as u16,
                start: word(self.angle(first)),
                points: std::array::from_fn(|i| (SimulatedScanner::range(first + i as u64), (i * 7) as u8)),
                end: word(self.angle(last)),
                millis: ((sensor_ms + 12_345.0) % f64::from(CLOCK_PERIOD_MS)) as u16,
            };
            let (bytes, baud) = (packet.encode(), self.model.baud());
            self.sent.push(self.line.transmit(&bytes, done, baud, &mut self.random));
        }
    }

    /// Drops the bytes that are on the line, and all bytes that follow until `until`.
    fn lose_until(&mut self, until: Nanos) {
        self.send_until(until);
        self.line.bytes.retain(|(at, _)| *at > until);
        let lost = self.sent.iter_mut().rev().take_while(|sent| sent.at + 3 * MILLIS > self.switched_on_at);
        lost.filter(|sent| sent.at <= until + 3 * MILLIS).for_each(|sent| sent.intact = false);
    }
}

/// Returns a packet with random content and a right checksum.
fn random_packet(random: &mut fastrand::Rng) -> [u8; PACKET_LEN] {
    let angle = |random: &mut fastrand::Rng| random.u16(..=36_000);
    let start = angle(random);
    let end = if random.bool() { angle(random) } else { (start + random.u16(..4_500)) % 36_000 };
    let speed = if random.bool() { random.u16(..) } else { 3_600 };
    let points = std::array::from_fn(|_| (random.u16(..), random.u8(..)));
    PacketContents { speed, start, points, end, millis: random.u16(..) }.encode()
}

#[test]
fn every_byte_is_counted_once() {
    for seed in 0..300 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut session = LdSession::new(Settings::default(), 0);
        let (mut now, mut delivered_bytes) = (0, 0);
        for _ in 0..400 {
            let mut bytes = Vec::new();
            while bytes.len() < 300 {
                match random.u8(..5) {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(HEADER.iter().cycle().take(random.usize(..100))),
                    2 => bytes.extend(&random_packet(&mut random)[..random.usize(..PACKET_LEN)]),
                    _ => bytes.extend(random_packet(&mut random)),
                }
            }
            bytes.truncate(session.read_buffer().len());
            session.read_buffer()[..bytes.len()].copy_from_slice(&bytes);
            now += random.u64(..400 * MILLIS);
            session.commit(now, bytes.len());
            loop {
                match session.poll_action() {
                    Action::Event(Event::Telegram(received)) => {
                        delivered_bytes += received.bytes.len() as u64;
                        assert!(received.bytes.len() % PACKET_LEN == 0 && received.first <= received.last);
                    }
                    Action::Event(Event::Scan(revolution)) => {
                        assert!(revolution.points().len() >= POINTS_PER_PACKET)
                    }
                    Action::SetRate(_) => {}
                    Action::Transmit { .. } | Action::SetDtr(_) => panic!("nothing is sent"),
                    Action::SleepUntil(_) | Action::Wait { .. } => break,
                }
            }
            let stats = session.stats();
            assert_eq!(stats.read, stats.in_telegrams + stats.discarded + stats.buffered);
            assert_eq!(stats.in_telegrams, delivered_bytes);
            assert!(stats.buffered < 2 * PACKET_LEN as u64, "{stats:?}");
        }
        assert!(session.stats().telegrams > 500);
    }
}
