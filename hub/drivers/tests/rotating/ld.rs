//! Sessions with heads of LDROBOT scanners that turn, over lines that damage bytes, in virtual time. Whatever arrives, every byte is
//! counted once, and the session does not panic.

use scanhub_drivers::Settings;
use scanhub_drivers::ld::packet::{CLOCK_TURN, Contents, HEADER, LEN, POINTS, TURN};
use scanhub_drivers::ld::{Model, Session, Trouble};
use scanhub_drivers::line::{Control, Event, Output, Protocol as _, Session as _, State};
use scanhub_drivers::line::{Grid, NOT_MEASURED};
use scanhub_schema::{MILLIS, Nanos};

use crate::{Damage, DamagedLine, Sent};

/// A revolution as the session delivered it.
#[derive(Debug)]
struct Told {
    /// Numbers of the head's points.
    points: Vec<u64>,
    /// Number of points whose range and angle do not match.
    wrong: usize,
    first: Nanos,
    period: Nanos,
    incomplete: bool,
}

/// Outputs of a session.
#[derive(Default)]
struct Log {
    packets: Vec<[u8; LEN]>,
    turns: Vec<Told>,
    /// The longest time between two packets of a sample, and the most packets.
    most: usize,
    reads: usize,
    bauds: Vec<u32>,
}

struct Bench {
    session: Session,
    head: Head,
    now: Nanos,
    log: Log,
}

impl Bench {
    fn new(settings: Settings, head: Head) -> Bench {
        Bench { session: Session::new(settings, 0), head, now: 0, log: Log::default() }
    }

    /// Drives the session until `until`.
    fn run(&mut self, until: Nanos) {
        while self.now < until {
            let (wakes_at, waits) = match self.drain() {
                (Some(at), _) => (at, false),
                (None, at) => (at, true),
            };
            let ready = if waits && self.session.rate() == self.head.model.baud() {
                self.head.next()
            } else {
                Nanos::MAX
            };
            self.now = wakes_at.min(ready.max(self.now)).min(until);
            self.read(self.now >= wakes_at);
        }
    }

    fn read(&mut self, is_timeout: bool) {
        let room = self.session.spare().len();
        let mut bytes = self.head.read(self.now, room);
        if self.session.rate() != self.head.model.baud() {
            // A rate four times as fast or slow makes noise of it.
            bytes = bytes.iter().step_by(4).map(|byte| byte | 0x80).collect();
        }
        self.session.spare()[..bytes.len()].copy_from_slice(&bytes);
        self.session.commit(self.now, bytes.len());
        self.log.reads += 1;
        if bytes.is_empty() && is_timeout {
            self.session.handle_timeout(self.now);
        }
        let account = self.session.account();
        assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
    }

    /// Returns the end of the session's rest, if it rests, and the end of its wait.
    fn drain(&mut self) -> (Option<Nanos>, Nanos) {
        loop {
            match self.session.poll_output() {
                Output::SetRate(baud) => self.log.bauds.push(baud),
                Output::Transmit { .. } | Output::SetDtr(_) => panic!("nothing is sent to such a scanner"),
                Output::Rest(until) => {
                    assert!(until > self.now && until <= self.now + 5 * MILLIS);
                    return (Some(until), until);
                }
                Output::Wait { until, .. } => return (None, until),
                Output::Event(Event::Telegram(received)) => {
                    assert!(received.first <= received.last && received.last <= self.now);
                    assert!(received.last - received.first <= 10 * MILLIS);
                    let (packets, rest) = received.bytes.as_chunks::<LEN>();
                    assert!(rest.is_empty());
                    self.log.most = self.log.most.max(packets.len());
                    self.log.packets.extend(packets);
                }
                Output::Event(Event::Scan(turn)) => {
                    let head = &self.head;
                    let rate = u64::from(head.model.points_per_second());
                    let about = turn.first.saturating_sub(head.zero) * rate / 1_000_000_000;
                    let points: Vec<u64> =
                        turn.points().iter().map(|point| Head::point_of(point.range, about)).collect();
                    let wrong = turn.points().iter().zip(&points).filter(|(told, point)| {
                        let right = head.angle(**point) % 36_000.0;
                        let off = (-f64::from(told.angle).to_degrees() * 100.0 - right).rem_euclid(36_000.0);
                        // The packet's own angles are cut off to a hundredth.
                        off.min(36_000.0 - off) > 2.0
                    });
                    let wrong = wrong.count();
                    let (first, period, incomplete) = (turn.first, turn.period, turn.is_incomplete());
                    self.log.turns.push(Told { points, wrong, first, period, incomplete });
                }
            }
        }
    }

    /// Checks every revolution: its points belong to one revolution of the head, in order, and are right. Without a
    /// mark, none is missing. Returns the largest error of a stamp.
    fn judge(&self) -> Nanos {
        let beams = self.session.beams().expect("known");
        let edge = 18_000.0 / beams as f64;
        let mut worst = 0;
        let turn_of = |point: u64| ((self.head.angle(point) + edge) / 36_000.0).floor();
        for told in &self.log.turns {
            let (first, last) = (told.points[0], told.points[told.points.len() - 1]);
            // The rounding of angles may put a point into another packet.
            let is_whole = told.points.len() as u64 == last - first + 1;
            assert!(told.points.windows(2).all(|pair| pair[0] < pair[1]), "{told:?}");
            assert!(last - first <= self.head.points.ceil() as u64, "merged: {told:?}");
            assert!((turn_of(first) - turn_of(last)).abs() < 2.0, "merged: {told:?}");
            if !told.incomplete {
                assert_eq!(told.wrong, 0, "{told:?}");
                assert!(is_whole && (last - first + 1).abs_diff(self.head.points as u64) <= 1, "{told:?}");
            }
            let at = (turn_of(last - 1) * 36_000.0 - edge).max(0.0);
            let begun = self.head.time((at / 36_000.0 * self.head.points).ceil() as u64);
            worst = worst.max(told.first.abs_diff(begun));
        }
        worst
    }

    fn intact_packets_came_once_in_order(&self) {
        let mut came = self.log.packets.iter();
        for sent in self.head.sent.iter().filter(|sent| sent.intact && sent.at + 10 * MILLIS < self.now) {
            assert!(came.any(|bytes| sent.bytes == *bytes), "lost: {:?}", sent.bytes);
        }
    }
}

fn of(model: Model) -> Settings {
    Settings { model: Some(model.name()), ..Settings::default() }
}

fn points(model: Model) -> f64 {
    f64::from(model.points_per_second()) / f64::from(model.turns_per_second())
}

const SECOND: Nanos = 1_000 * MILLIS;

#[test]
fn scanner_with_uneven_speed_has_the_beams_of_its_model() {
    let model = Model::Ld19;
    let mut head = Head::new(model, points(model), 1, Damage::default());
    head.jitter = 0.05;
    let mut bench = Bench::new(Settings::default(), head);
    bench.run(9 * SECOND);
    assert_eq!((bench.log.turns.len(), bench.session.trouble()), (0, None), "the head rotates");
    bench.run(15 * SECOND);
    assert!(bench.log.turns.len() > 25, "{}", bench.log.turns.len());
    assert_eq!((bench.session.beams(), bench.session.trouble()), (Some(model.beams()), None));
}

#[test]
fn every_model_is_heard_and_every_turn_of_it() {
    for model in Model::ALL {
        // A speed at which no two turns have their points at the same places.
        let head = Head::new(model, points(model) * 1.000_7, 1, Damage::default());
        let mut bench = Bench::new(of(model), head);
        // The session reads byte by byte until it knows the stream.
        bench.run(2 * SECOND);
        bench.log.reads = 0;
        bench.run(11 * SECOND);
        let hz = u64::from(model.turns_per_second());
        let turns = bench.log.turns.len() as u64;
        assert!((10 * hz - 3..=10 * hz).contains(&turns), "{model:?}: {turns}");
        assert!(bench.log.turns.iter().all(|told| !told.incomplete));
        let worst = bench.judge();
        assert!(worst < 2 * MILLIS, "{model:?}: {worst}");
        bench.intact_packets_came_once_in_order();
        let account = bench.session.account();
        assert_eq!((account.lost, account.discarded), (0, 0));
        assert_eq!(account.due, account.telegrams);
        assert_eq!(bench.session.state(), State::Streaming);
        assert_eq!(bench.session.beams(), Some(model.beams()));
        // A read each five milliseconds, not one for each byte.
        assert!(bench.log.reads < 1_900, "{model:?}: {} reads", bench.log.reads);
        assert!(bench.log.most <= 17 && bench.log.bauds.is_empty());
    }
}

#[test]
fn a_model_that_is_not_told_is_found_by_its_rate_and_its_points() {
    for (model, found) in
        [(Model::Ld06, Model::Ld19), (Model::Stl27l, Model::Stl27l), (Model::Ld14p, Model::Ld14p)]
    {
        let mut bench =
            Bench::new(Settings::default(), Head::new(model, points(model), 1, Damage::default()));
        bench.run(4 * SECOND);
        assert_eq!(bench.session.model(), Some(found));
        assert_eq!(bench.session.state(), State::Streaming, "{model:?}: {:?}", bench.log.bauds);
        assert_eq!(bench.session.beams(), Some(found.beams()));
        assert!(bench.log.turns.len() > 10);
        bench.judge();
    }
}

#[test]
fn a_line_that_damages_bytes_costs_the_packets_that_it_damages() {
    for seed in 0..100 {
        let mut random = fastrand::Rng::with_seed(!seed);
        let damage = Damage {
            lost: random.f64() * 0.004,
            inserted: random.f64() * 0.001,
            flipped: random.f64() * 0.001,
        };
        let model = Model::ALL[seed as usize % 5];
        let head = Head::new(model, points(model) * (0.9 + 0.2 * random.f64()), seed, damage);
        let mut bench = Bench::new(of(model), head);
        bench.run(6 * SECOND);
        bench.intact_packets_came_once_in_order();
        bench.judge();
        let counts = bench.session.turn_counts();
        assert!(counts.turns > 4 * u64::from(model.turns_per_second()), "{seed}: {counts:?}");
        assert!(counts.incomplete > 0 && counts.turns == bench.log.turns.len() as u64);
        let account = bench.session.account();
        let sent = bench.head.sent.iter().filter(|sent| sent.at < bench.now).count() as u64;
        let off = (account.due as i64 - sent as i64).abs();
        assert!(off <= 8 + sent as i64 / 500, "{seed}: {account:?} of {sent}");
        assert!(account.lost > 0 && account.damaged > 0);
    }
}

#[test]
fn a_host_that_stops_dates_what_waited_for_it() {
    for model in [Model::Ld19, Model::Stl27l] {
        for drift in [0.0, 0.000_2, -0.001] {
            let mut head = Head::new(model, points(model), 3, Damage::default());
            head.drift = drift;
            let mut bench = Bench::new(of(model), head);
            for stall in 2..20 {
                bench.run(stall * SECOND);
                bench.now += 500 * MILLIS;
                bench.read(true);
            }
            bench.run(20 * SECOND);
            let worst = bench.judge();
            assert!(worst < 5 * MILLIS, "{model:?} {drift}: {worst}");
            assert_eq!((bench.session.account().lost, bench.session.account().restarts), (0, 0));
            bench.intact_packets_came_once_in_order();
        }
    }
}

#[test]
fn what_a_full_buffer_drops_is_missing_and_told() {
    let mut bench =
        Bench::new(of(Model::Ld19), Head::new(Model::Ld19, points(Model::Ld19), 3, Damage::default()));
    bench.run(3 * SECOND);
    let before = bench.session.turn_counts();
    bench.head.cut(3 * SECOND + 250 * MILLIS);
    bench.now += 250 * MILLIS;
    bench.read(true);
    bench.run(6 * SECOND);
    let counts = bench.session.turn_counts();
    assert!(bench.judge() < 5 * MILLIS);
    assert!(counts.incomplete > before.incomplete && counts.missed + counts.short >= 1, "{counts:?}");
    let lost = bench.session.account().lost;
    assert!((92..=95).contains(&lost), "{lost}");
    assert_eq!((bench.session.state(), bench.session.account().restarts), (State::Streaming, 0));
}

#[test]
fn a_host_that_stops_for_long_is_not_a_restart_of_the_scanner() {
    for stall in [2, 9, 29, 30, 31, 64] {
        let head = Head::new(Model::Ld19, 450.0, 3, Damage::default());
        let mut bench = Bench::new(of(Model::Ld19), head);
        bench.run(3 * SECOND);
        // The tty keeps what arrives first, and the rest finds no room.
        bench.now += stall * SECOND;
        bench.head.cut(bench.now);
        bench.read(true);
        bench.run(bench.now + 3 * SECOND);
        assert_eq!(
            (bench.session.state(), bench.session.account().restarts),
            (State::Streaming, 0),
            "{stall}"
        );
    }
}

#[test]
fn a_turn_that_ends_in_a_gap_went_as_fast_as_before_it() {
    let mut bench = Bench::new(of(Model::Ld19), Head::new(Model::Ld19, 450.0, 3, Damage::default()));
    // In the twentieth turn it gets slower, but is where it was, a turn aside.
    bench.run(SECOND + 1_970 * MILLIS);
    bench.head.points = 450.0 * 19.7 / 18.7;
    bench.head.cut(bench.now + 200 * MILLIS);
    bench.now += 200 * MILLIS;
    bench.read(true);
    bench.run(4 * SECOND);
    assert_eq!(bench.session.account().resyncs, 0);
    let told = bench.log.turns.iter().find(|told| told.incomplete).expect("one with a gap");
    assert!(told.period.abs_diff(100 * MILLIS) < MILLIS, "{}", told.period);
}

#[test]
fn a_second_without_a_packet_begins_again() {
    let mut bench = Bench::new(of(Model::Ld19), Head::new(Model::Ld19, 450.0, 3, Damage::default()));
    bench.run(3 * SECOND);
    bench.head.cut(5 * SECOND);
    bench.run(4 * SECOND + 50 * MILLIS);
    assert_eq!((bench.session.state(), bench.session.trouble()), (State::Silent, Some(Trouble::Silence)));
    bench.run(6 * SECOND);
    assert_eq!((bench.session.state(), bench.session.trouble()), (State::Streaming, None));
    assert_eq!((bench.session.account().resyncs, bench.session.account().lost), (1, 0));
    assert_eq!(bench.session.account().restarts, 0, "its clock went on");
    bench.judge();
}

#[test]
fn where_nobody_speaks_it_says_so_in_steps() {
    let mut session = Session::new(Settings::default(), 0);
    let (mut now, mut troubles, mut bauds) = (0, Vec::new(), Vec::new());
    while now < 20 * SECOND {
        match session.poll_output() {
            Output::SetRate(baud) => bauds.push(baud),
            Output::Wait { until, .. } => {
                now = until;
                session.spare();
                session.commit(now, 0);
                session.handle_timeout(now);
            }
            output => panic!("{output:?}"),
        }
        if troubles.last() != Some(&session.trouble()) {
            troubles.push(session.trouble());
        }
    }
    assert_eq!(bauds[..3], [921_600, 230_400, 921_600]);
    let steps = [1, 2, 4, 8, 16].map(|seconds| Trouble::NoPackets { baud: None, seconds });
    assert_eq!(troubles[1..], steps.map(Some));
    assert!(steps[0].to_string().contains("230400 and 921600"));
}

#[test]
fn a_pause_is_quiet_and_ends() {
    let mut bench = Bench::new(of(Model::Ld19), Head::new(Model::Ld19, 450.0, 3, Damage::default()));
    bench.run(3 * SECOND);
    bench.session.control(Control::Pause, bench.now);
    let (packets, turns) = (bench.log.packets.len(), bench.log.turns.len());
    bench.run(5 * SECOND);
    assert_eq!((bench.log.packets.len(), bench.log.turns.len()), (packets, turns));
    assert_eq!((bench.session.state(), bench.session.trouble()), (State::Paused, None));
    bench.session.control(Control::Resume, bench.now);
    bench.run(6 * SECOND);
    assert_eq!(bench.session.state(), State::Streaming);
    assert!(bench.log.turns.len() > turns + 5);
    assert_eq!(bench.session.account().restarts, 0);
    bench.judge();
}

#[test]
fn a_turn_goes_on_a_grid_of_constant_beams() {
    let mut bench = Bench::new(of(Model::Ld19), Head::new(Model::Ld19, 450.3, 3, Damage::default()));
    bench.run(2 * SECOND);
    let grid = Grid::new(bench.session.beams().expect("known"));
    loop {
        let output = bench.session.poll_output();
        let Output::Event(Event::Scan(turn)) = output else {
            let is_wait = matches!(output, Output::Wait { .. } | Output::Rest(_));
            if is_wait {
                bench.now += MILLIS;
                bench.read(false);
            }
            continue;
        };
        let beams = grid.beams();
        let (mut ranges, mut intensities, mut angles) = (vec![0; beams], vec![0; beams], vec![0.0; beams]);
        let collisions = grid.fill(turn.points(), &mut ranges, &mut intensities, &mut angles);
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

/// A head that rotates evenly. The range of each point identifies it.
struct Head {
    model: Model,
    /// Points in a turn.
    points: f64,
    /// Share by which its clock is slow.
    drift: f64,
    /// Share by which the speed in every other packet differs from the true one.
    jitter: f64,
    random: fastrand::Rng,
    line: DamagedLine,
    sent: Vec<Sent>,
    /// When it was switched on, and how many packets it has sent since.
    zero: Nanos,
    packets: u64,
}

impl Head {
    fn new(model: Model, points: f64, seed: u64, damage: Damage) -> Head {
        Head {
            model,
            points,
            drift: 0.0,
            jitter: 0.0,
            random: fastrand::Rng::with_seed(seed),
            line: DamagedLine::new(damage),
            sent: Vec::new(),
            zero: 1_000 * MILLIS,
            packets: 0,
        }
    }

    /// Returns the time of point number `point` on the hub's clock.
    fn time(&self, point: u64) -> Nanos {
        let sensor_s = point as f64 / f64::from(self.model.points_per_second());
        self.zero + (sensor_s / (1.0 - self.drift) * 1e9) as Nanos
    }

    /// Returns the angle of point number `point` in hundredths of a degree, over all revolutions.
    fn angle(&self, point: u64) -> f64 {
        point as f64 * f64::from(TURN) / self.points
    }

    /// The range of point number `point`: by which it is known again.
    fn range(point: u64) -> u16 {
        100 + (point % 20_011) as u16
    }

    /// The point of this range that is the nearest to number `about`.
    fn point_of(range: u16, about: u64) -> u64 {
        let off = (u64::from(range) + 20_011 - 100 - about % 20_011) % 20_011;
        if off > 10_005 { about + off - 20_011 } else { about + off }
    }

    /// Bytes that have arrived by `now`, `room` at most.
    fn read(&mut self, now: Nanos, room: usize) -> Vec<u8> {
        self.send_until(now);
        self.line.read(now, room)
    }

    /// Returns the time at which the next byte arrives.
    fn next(&mut self) -> Nanos {
        let mut until = self.time((self.packets + 2) * POINTS as u64);
        while self.line.bytes.is_empty() {
            self.send_until(until);
            until += 10 * MILLIS;
        }
        self.line.bytes[0].0
    }

    fn send_until(&mut self, now: Nanos) {
        loop {
            let first = self.packets * POINTS as u64;
            let last = first + POINTS as u64 - 1;
            let done = self.time(last);
            if done > now {
                return;
            }
            self.packets += 1;
            let sensor_ms = last as f64 / f64::from(self.model.points_per_second()) * 1e3;
            let hz = f64::from(self.model.points_per_second()) / self.points;
            let word = |angle: f64| (angle % f64::from(TURN)) as u16;
            let packet = Contents {
                speed: (360.0 * hz * (1.0 + self.jitter * (self.packets % 2) as f64)).round() as u16,
                start: word(self.angle(first)),
                points: std::array::from_fn(|i| (Head::range(first + i as u64), (i * 7) as u8)),
                end: word(self.angle(last)),
                millis: ((sensor_ms + 12_345.0) % f64::from(CLOCK_TURN)) as u16,
            };
            let (bytes, baud) = (packet.encode(), self.model.baud());
            self.sent.push(self.line.carry(&bytes, done, baud, &mut self.random));
        }
    }

    /// Loses the bytes on the line and the next ones up to `until`.
    fn cut(&mut self, until: Nanos) {
        self.send_until(until);
        self.line.bytes.retain(|(at, _)| *at > until);
        let lost = self.sent.iter_mut().rev().take_while(|sent| sent.at + 3 * MILLIS > self.zero);
        lost.filter(|sent| sent.at <= until + 3 * MILLIS).for_each(|sent| sent.intact = false);
    }
}

/// A packet with a right checksum that says anything.
fn wild(random: &mut fastrand::Rng) -> [u8; LEN] {
    let angle = |random: &mut fastrand::Rng| random.u16(..=36_000);
    let start = angle(random);
    let end = if random.bool() { angle(random) } else { (start + random.u16(..4_500)) % 36_000 };
    let speed = if random.bool() { random.u16(..) } else { 3_600 };
    let points = std::array::from_fn(|_| (random.u16(..), random.u8(..)));
    Contents { speed, start, points, end, millis: random.u16(..) }.encode()
}

#[test]
fn every_byte_is_counted_once() {
    for seed in 0..300 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut session = Session::new(Settings::default(), 0);
        let (mut now, mut told) = (0, 0);
        for _ in 0..400 {
            let mut bytes = Vec::new();
            while bytes.len() < 300 {
                match random.u8(..5) {
                    0 => bytes.extend((0..random.usize(..60)).map(|_| random.u8(..))),
                    1 => bytes.extend(HEADER.iter().cycle().take(random.usize(..100))),
                    2 => bytes.extend(&wild(&mut random)[..random.usize(..LEN)]),
                    _ => bytes.extend(wild(&mut random)),
                }
            }
            bytes.truncate(session.spare().len());
            session.spare()[..bytes.len()].copy_from_slice(&bytes);
            now += random.u64(..400 * MILLIS);
            session.commit(now, bytes.len());
            loop {
                match session.poll_output() {
                    Output::Event(Event::Telegram(received)) => {
                        told += received.bytes.len() as u64;
                        assert!(received.bytes.len() % LEN == 0 && received.first <= received.last);
                    }
                    Output::Event(Event::Scan(turn)) => assert!(turn.points().len() >= POINTS),
                    Output::SetRate(_) => {}
                    Output::Transmit { .. } | Output::SetDtr(_) => panic!("nothing is sent"),
                    Output::Rest(_) | Output::Wait { .. } => break,
                }
            }
            let account = session.account();
            assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
            assert_eq!(account.in_telegrams, told);
            assert!(account.buffered < 2 * LEN as u64, "{account:?}");
        }
        assert!(session.account().telegrams > 500);
    }
}
