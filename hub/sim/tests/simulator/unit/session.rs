//! Tests of the session for RPLIDARs. They compare the revolutions that the session delivers with the true measurements
//! of the scanner.

use scanhub_drivers::Settings;
use scanhub_drivers::line::NO_RETURN;
use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _, State};
use scanhub_drivers::rplidar::{Mode, Model as Known, Problem, RplidarSession};
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::Device as _;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarStart};
use scanhub_sim::world::World;

use super::{Bench, ONE_SECOND};

/// A revolution as the session delivered it.
struct DeliveredRevolution {
    first: Nanos,
    period: Nanos,
    /// Whether the session marked the revolution as incomplete, or bytes next to it as damaged.
    is_marked: bool,
    /// Clockwise angles in degrees, and ranges in millimeters; 0 means no return.
    points: Vec<(f64, u16)>,
}

struct SessionBench {
    bench: Bench,
    session: RplidarSession,
    /// Number of received bytes that the session has read.
    read: usize,
    revolutions: Vec<DeliveredRevolution>,
}

impl SessionBench {
    fn new(settings: Settings, unit: RplidarSettings, faults: &str) -> SessionBench {
        let world = "corridor".parse::<World>().expect("a world").with_noise(NoiseModel::NONE);
        let bench = Bench::new(unit, &world, faults);
        SessionBench { session: RplidarSession::new(settings, 0), bench, read: 0, revolutions: Vec::new() }
    }

    fn run(&mut self, until: Nanos) {
        while self.bench.now < until {
            let mut wakes_at = self.bench.now + MILLIS;
            loop {
                match self.session.poll_action() {
                    Action::SetRate(_) => self.read = self.bench.received.len(),
                    Action::SetDtr(_) => {}
                    Action::Transmit { bytes, .. } => {
                        let bytes = bytes.to_vec();
                        for byte in bytes {
                            self.bench.run_for(line_time(1, self.bench.unit.rate()));
                            if self.session.rate() == self.bench.unit.rate() {
                                self.bench.send_byte(byte);
                            }
                        }
                        self.session.handle_transmitted(self.bench.now);
                    }
                    Action::Event(Event::Scan(revolution)) => {
                        let degrees = |angle: f32| -f64::from(angle).to_degrees();
                        let range = |range| if range == NO_RETURN { 0 } else { range };
                        let points = revolution.points().iter();
                        self.revolutions.push(DeliveredRevolution {
                            first: revolution.first,
                            period: revolution.period,
                            is_marked: revolution.is_incomplete() || revolution.reasons != 0,
                            points: points.map(|point| (degrees(point.angle), range(point.range))).collect(),
                        });
                    }
                    Action::Event(Event::Telegram(_)) => {}
                    Action::SleepUntil(at) => {
                        wakes_at = at;
                        break;
                    }
                    Action::Wait { until, .. } => {
                        wakes_at = wakes_at.min(until.max(self.bench.now + 1));
                        break;
                    }
                }
            }
            self.bench.run(wakes_at);
            let is_received = self.session.rate() == self.bench.unit.rate();
            let room = self.session.read_buffer();
            let new = &self.bench.received[self.read..];
            let len = new.len().min(room.len());
            room[..len].copy_from_slice(&new[..len]);
            if !is_received {
                room[..len].iter_mut().for_each(|byte| *byte |= 0x80);
            }
            self.read += len;
            self.session.commit(self.bench.now, len);
            if len == 0 {
                self.session.handle_timeout(self.bench.now);
            }
        }
    }

    /// Returns the number of points in revolutions without a mark, the number of these points that match no true
    /// measurement, and the largest error of a stamp.
    fn check_points(&mut self, from: usize) -> (usize, usize, Nanos) {
        let begin = self.bench.unit.begin_ns().expect("it streams");
        let seconds = (self.bench.now - begin) as f64 / 1e9;
        let us = self.bench.unit.mode().expect("it streams").sample_us;
        let count = (seconds * 1e6 / us) as u64;
        let truth: Vec<_> = (0..count).filter_map(|k| self.bench.unit.truth(k)).collect();
        let at = |time: Nanos| truth.partition_point(|point| point.at_ns < time);
        let off = |a: f64, b: f64| ((a - b + 540.0).rem_euclid(360.0) - 180.0).abs();
        let (mut points, mut wrong, mut worst) = (0, 0, 0);
        for revolution in self.revolutions[from..]
            .iter()
            .filter(|revolution| revolution.first > begin && !revolution.is_marked)
        {
            // Skip points without a return, because their angles are not exact.
            for (deg, mm) in revolution.points.iter().filter(|(_, mm)| *mm > 0) {
                let about = at(revolution.first + (deg / 360.0 * revolution.period as f64).max(0.0) as Nanos);
                let reach = 40.max(revolution.points.len() / 12);
                let near = &truth[about.saturating_sub(reach)..(about + reach).min(truth.len())];
                let is_right = near.iter().any(|true_point| {
                    let range = true_point.range_mm.unwrap_or(0.0);
                    (range - f64::from(*mm)).abs() < 50.0 && off(true_point.clockwise_deg, *deg) < 0.3
                });
                points += 1;
                wrong += usize::from(!is_right);
            }
            let about = at(revolution.first);
            let reach = revolution.points.len() / 6;
            let near = &truth[about.saturating_sub(reach)..(about + reach).min(truth.len())];
            let zero =
                near.iter().min_by(|a, b| off(a.clockwise_deg, 0.0).total_cmp(&off(b.clockwise_deg, 0.0)));
            worst = worst.max(zero.map_or(Nanos::MAX, |zero| zero.at_ns.abs_diff(revolution.first)));
        }
        (points, wrong, worst)
    }
}

/// Returns all modes that a session can request, and `None` for the default mode.
fn selectable_modes(model: Model) -> impl Iterator<Item = Option<Mode>> {
    let named = model.modes().iter().map(|mode| Some(Mode::from_name(mode.name).expect(mode.name)));
    named.chain([None])
}

#[test]
fn session_reads_every_mode_of_every_model() {
    for model in Model::ALL {
        for mode in selectable_modes(model) {
            let known = Known::from_name(model.name()).expect("known");
            let settings =
                Settings { model: Some(known.name()), mode: mode.map(Mode::name), ..Settings::default() };
            let mut bench = SessionBench::new(settings, RplidarSettings::of(model), "");
            bench.run(8 * ONE_SECOND);
            assert_eq!((bench.session.state(), bench.session.problem()), (State::Streaming, None));
            assert_eq!(bench.session.model(), Some(known));
            let streams = bench.bench.unit.mode().expect("it streams");
            assert!(
                mode.is_none_or(|mode| Mode::from_name(streams.name) == Some(mode)),
                "{mode:?}: {streams:?}"
            );
            let (points, wrong, worst) = bench.check_points(0);
            assert!(points > 2_000 && wrong == 0, "{model:?} {mode:?}: {wrong} of {points}");
            assert!(worst < 5 * MILLIS, "{model:?} {mode:?}: {worst}");
            let stats = bench.session.stats();
            assert_eq!((stats.lost, stats.damaged, stats.resyncs), (0, 0, 0), "{model:?} {mode:?}");
            assert_eq!(bench.session.revolution_counts().incomplete, 0, "{model:?} {mode:?}");
            assert_eq!(bench.bench.unit.eeprom_writes(), 0);
        }
    }
}

#[test]
fn abandoned_or_unhealthy_scanner_streams_within_3_s() {
    for model in Model::ALL {
        for (start, health) in
            [(RplidarStart::Streaming, 0), (RplidarStart::Idle, 0), (RplidarStart::Idle, 2)]
        {
            let unit = RplidarSettings { start, health: (health, 0x8001), ..RplidarSettings::of(model) };
            let mut bench = SessionBench::new(Settings::default(), unit, "");
            let started = |bench: &SessionBench| !bench.revolutions.is_empty();
            while !started(&bench) && bench.bench.now < 3 * ONE_SECOND {
                bench.run(bench.bench.now + 10 * MILLIS);
            }
            assert!(started(&bench), "{model:?} {start:?} {health}: {:?}", bench.session.problem());
        }
    }
}

#[test]
fn brown_outs_and_power_cycles_count_as_restarts() {
    for model in Model::ALL {
        let settings = Settings { model: Some(model.name()), ..Settings::default() };
        let mut bench =
            SessionBench::new(settings, RplidarSettings::of(model), "brownout_at=4,brownout_every=5");
        bench.run(30 * ONE_SECOND);
        let banners = bench.bench.sent.iter().filter(|sent| sent.bytes.starts_with(b"RP LIDAR"));
        // If the bytes of a boot message complete a packet, the session recognizes the restart only after the stream
        // was silent for a second.
        let recognized =
            banners.clone().filter(|sent| sent.at + 1_100 * MILLIS < bench.bench.now).count() as u64;
        let restarts = bench.session.stats().restarts;
        assert!(recognized >= 3, "{model:?}: {recognized}");
        // One of 256 boot messages completes a packet with a valid checksum. The session then handles it as a part of
        // this packet, and does not detect the restart.
        assert!((recognized - 1..=banners.count() as u64).contains(&restarts), "{model:?}: {restarts}");

        // After a power cycle, the scanner is silent for longer than the time after which the session searches for it.
        let mut bench = SessionBench::new(settings, RplidarSettings::of(model), "");
        for restarts in 1..=4 {
            bench.run(bench.bench.now + 7 * ONE_SECOND + restarts * 130 * MILLIS);
            assert_eq!(bench.session.state(), State::Streaming, "{model:?}");
            bench.bench.cycle_power();
            bench.run(bench.bench.now + 3 * ONE_SECOND);
            assert_eq!(bench.session.stats().restarts, restarts, "{model:?}");
        }
    }
}

#[test]
fn line_faults_are_not_counted_as_restarts() {
    for model in Model::ALL {
        for faults in [
            "silence=0.5,silence_every=3",
            "silence=3,silence_every=8",
            "stall=1.5,stall_every=4",
            "loss=0.002",
        ] {
            let settings = Settings { model: Some(model.name()), ..Settings::default() };
            let mut bench = SessionBench::new(settings, RplidarSettings::of(model), faults);
            bench.run(30 * ONE_SECOND);
            assert_eq!(bench.session.stats().restarts, 0, "{model:?} {faults}");
        }
    }
}

#[test]
fn heavy_byte_damage_is_not_reported_as_standstill() {
    let mut bench = SessionBench::new(Settings::default(), RplidarSettings::of(Model::S2), "loss=0.02");
    bench.run(6 * ONE_SECOND);
    for _ in 0..100 {
        bench.run(bench.bench.now + 100 * MILLIS);
        assert_ne!(bench.session.problem(), Some(Problem::HeadBlocked));
    }
    let stats = bench.session.stats();
    assert!(stats.damaged > 2 * stats.in_telegrams, "{stats:?}");
}

#[test]
fn complete_revolutions_on_a_lossy_line_are_right() {
    let kinds = [(Model::A1, Mode::Express), (Model::A1, Mode::Boost), (Model::S1, Mode::DenseBoost)];
    for (model, mode) in kinds {
        for seed in 0..3 {
            let settings =
                Settings { model: Some(model.name()), mode: Some(mode.name()), ..Settings::default() };
            let unit = RplidarSettings { seed, ..RplidarSettings::of(model) };
            let mut bench = SessionBench::new(settings, unit, "loss=0.0002,burst=4");
            bench.run(12 * ONE_SECOND);
            assert_eq!(bench.session.state(), State::Streaming, "{model:?}: {:?}", bench.session.problem());
            let (points, wrong, worst) = bench.check_points(0);
            let counts = bench.session.revolution_counts();
            assert!(points > 1_000 && wrong == 0, "{model:?} {seed}: {wrong} of {points}");
            assert!(worst < 8 * MILLIS, "{model:?} {seed}: {worst}");
            assert!(counts.incomplete > 0 && bench.session.stats().lost > 0, "{counts:?}");
        }
    }
}
