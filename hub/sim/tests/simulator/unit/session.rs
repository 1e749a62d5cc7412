//! The hub's session with a scanner of Slamtec: what it makes of the bytes beside what the scanner measured.

use scanhub_drivers::Settings;
use scanhub_drivers::line::NO_RETURN;
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _, State};
use scanhub_drivers::rplidar::{Mode, Model as Known, Session, Trouble};
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::Device as _;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarStart};
use scanhub_sim::world::World;

use super::{Bench, SECOND};

/// A turn as it was handed out.
struct Told {
    first: Nanos,
    period: Nanos,
    /// Whether it says that something is missing, or damaged beside it.
    is_marked: bool,
    /// Degrees clockwise and millimetres, 0 is no return.
    points: Vec<(f64, u16)>,
}

struct Talk {
    bench: Bench,
    session: Session,
    /// Bytes of the line that were read.
    read: usize,
    turns: Vec<Told>,
}

impl Talk {
    fn new(settings: Settings, unit: RplidarSettings, faults: &str) -> Talk {
        let world = "corridor".parse::<World>().expect("a world").with_noise(NoiseModel::NONE);
        let bench = Bench::new(unit, &world, faults);
        Talk { session: Session::new(settings, 0), bench, read: 0, turns: Vec::new() }
    }

    fn run(&mut self, until: Nanos) {
        while self.bench.now < until {
            let mut wakes_at = self.bench.now + MILLIS;
            loop {
                match self.session.poll_output() {
                    Output::SetRate(_) => self.read = self.bench.line.len(),
                    Output::SetDtr(_) => {}
                    Output::Transmit { bytes, .. } => {
                        let bytes = bytes.to_vec();
                        for byte in bytes {
                            self.bench.pass(line_time(1, self.bench.unit.rate()));
                            if self.session.rate() == self.bench.unit.rate() {
                                self.bench.say(byte);
                            }
                        }
                        self.session.transmitted(self.bench.now);
                    }
                    Output::Event(Event::Scan(turn)) => {
                        let degrees = |angle: f32| -f64::from(angle).to_degrees();
                        let range = |range| if range == NO_RETURN { 0 } else { range };
                        let points = turn.points().iter();
                        self.turns.push(Told {
                            first: turn.first,
                            period: turn.period,
                            is_marked: turn.is_incomplete() || turn.reasons != 0,
                            points: points.map(|point| (degrees(point.angle), range(point.range))).collect(),
                        });
                    }
                    Output::Event(Event::Telegram(_)) => {}
                    Output::Rest(at) => {
                        wakes_at = at;
                        break;
                    }
                    Output::Wait { until, .. } => {
                        wakes_at = wakes_at.min(until.max(self.bench.now + 1));
                        break;
                    }
                }
            }
            self.bench.run(wakes_at);
            let is_heard = self.session.rate() == self.bench.unit.rate();
            let room = self.session.spare();
            let new = &self.bench.line[self.read..];
            let len = new.len().min(room.len());
            room[..len].copy_from_slice(&new[..len]);
            if !is_heard {
                room[..len].iter_mut().for_each(|byte| *byte |= 0x80);
            }
            self.read += len;
            self.session.commit(self.bench.now, len);
            if len == 0 {
                self.session.handle_timeout(self.bench.now);
            }
        }
    }

    /// Points of whole turns, those of them that are not where one was measured, and the worst error of a stamp.
    fn judge(&mut self, from: usize) -> (usize, usize, Nanos) {
        let begin = self.bench.unit.begin_ns().expect("it streams");
        let seconds = (self.bench.now - begin) as f64 / 1e9;
        let us = self.bench.unit.mode().expect("it streams").sample_us;
        let count = (seconds * 1e6 / us) as u64;
        let truth: Vec<_> = (0..count).filter_map(|k| self.bench.unit.truth(k)).collect();
        let at = |time: Nanos| truth.partition_point(|point| point.at_ns < time);
        let off = |a: f64, b: f64| ((a - b + 540.0).rem_euclid(360.0) - 180.0).abs();
        let (mut points, mut wrong, mut worst) = (0, 0, 0);
        for told in self.turns[from..].iter().filter(|told| told.first > begin && !told.is_marked) {
            // Where a scanner says that nothing was, it does not say exactly where that is.
            for (deg, mm) in told.points.iter().filter(|(_, mm)| *mm > 0) {
                let about = at(told.first + (deg / 360.0 * told.period as f64).max(0.0) as Nanos);
                let reach = 40.max(told.points.len() / 12);
                let near = &truth[about.saturating_sub(reach)..(about + reach).min(truth.len())];
                let is_right = near.iter().any(|true_point| {
                    let range = true_point.range_mm.unwrap_or(0.0);
                    (range - f64::from(*mm)).abs() < 50.0 && off(true_point.clockwise_deg, *deg) < 0.3
                });
                points += 1;
                wrong += usize::from(!is_right);
            }
            let about = at(told.first);
            let reach = told.points.len() / 6;
            let near = &truth[about.saturating_sub(reach)..(about + reach).min(truth.len())];
            let zero =
                near.iter().min_by(|a, b| off(a.clockwise_deg, 0.0).total_cmp(&off(b.clockwise_deg, 0.0)));
            worst = worst.max(zero.map_or(Nanos::MAX, |zero| zero.at_ns.abs_diff(told.first)));
        }
        (points, wrong, worst)
    }
}

/// Every mode by which a session can call it.
fn modes(model: Model) -> impl Iterator<Item = Option<Mode>> {
    let named = model.modes().iter().map(|mode| Some(Mode::named(mode.name).expect(mode.name)));
    named.chain([None])
}

#[test]
fn every_mode_of_every_model_is_understood() {
    for model in Model::ALL {
        for mode in modes(model) {
            let known = Known::named(model.name()).expect("known");
            let settings =
                Settings { model: Some(known.name()), mode: mode.map(Mode::name), ..Settings::default() };
            let mut talk = Talk::new(settings, RplidarSettings::of(model), "");
            talk.run(8 * SECOND);
            assert_eq!((talk.session.state(), talk.session.trouble()), (State::Streaming, None));
            assert_eq!(talk.session.model(), Some(known));
            let streams = talk.bench.unit.mode().expect("it streams");
            assert!(mode.is_none_or(|mode| Mode::named(streams.name) == Some(mode)), "{mode:?}: {streams:?}");
            let (points, wrong, worst) = talk.judge(0);
            assert!(points > 2_000 && wrong == 0, "{model:?} {mode:?}: {wrong} of {points}");
            assert!(worst < 5 * MILLIS, "{model:?} {mode:?}: {worst}");
            let account = talk.session.account();
            assert_eq!((account.lost, account.damaged, account.resyncs), (0, 0, 0), "{model:?} {mode:?}");
            assert_eq!(talk.session.turn_counts().incomplete, 0, "{model:?} {mode:?}");
            assert_eq!(talk.bench.unit.eeprom_writes(), 0);
        }
    }
}

#[test]
fn one_that_somebody_left_streaming_or_unwell_streams_in_three_seconds() {
    for model in Model::ALL {
        for (start, health) in
            [(RplidarStart::Streaming, 0), (RplidarStart::Idle, 0), (RplidarStart::Idle, 2)]
        {
            let unit = RplidarSettings { start, health: (health, 0x8001), ..RplidarSettings::of(model) };
            let mut talk = Talk::new(Settings::default(), unit, "");
            let begun = |talk: &Talk| !talk.turns.is_empty();
            while !begun(&talk) && talk.bench.now < 3 * SECOND {
                talk.run(talk.bench.now + 10 * MILLIS);
            }
            assert!(begun(&talk), "{model:?} {start:?} {health}: {:?}", talk.session.trouble());
        }
    }
}

#[test]
fn every_brown_out_is_a_restart_and_so_is_a_power_cycle() {
    for model in Model::ALL {
        let settings = Settings { model: Some(model.name()), ..Settings::default() };
        let mut talk = Talk::new(settings, RplidarSettings::of(model), "brownout_at=4,brownout_every=5");
        talk.run(30 * SECOND);
        let banners = talk.bench.sent.iter().filter(|sent| sent.bytes.starts_with(b"RP LIDAR"));
        // A banner that completes the bytes of a packet is recognized once the stream is silent for a second.
        let recognized =
            banners.clone().filter(|sent| sent.at + 1_100 * MILLIS < talk.bench.now).count() as u64;
        let restarts = talk.session.account().restarts;
        assert!(recognized >= 3, "{model:?}: {recognized}");
        // One of 256 completes them to a packet with a right checksum, and is lost.
        assert!((recognized - 1..=banners.count() as u64).contains(&restarts), "{model:?}: {restarts}");

        // A power cycle takes longer than the silence after which the session searches.
        let mut talk = Talk::new(settings, RplidarSettings::of(model), "");
        for restarts in 1..=4 {
            talk.run(talk.bench.now + 7 * SECOND + restarts * 130 * MILLIS);
            assert_eq!(talk.session.state(), State::Streaming, "{model:?}");
            talk.bench.cycle_power();
            talk.run(talk.bench.now + 3 * SECOND);
            assert_eq!(talk.session.account().restarts, restarts, "{model:?}");
        }
    }
}

#[test]
fn what_only_looks_like_a_restart_is_none() {
    for model in Model::ALL {
        for faults in [
            "silence=0.5,silence_every=3",
            "silence=3,silence_every=8",
            "stall=1.5,stall_every=4",
            "loss=0.002",
        ] {
            let settings = Settings { model: Some(model.name()), ..Settings::default() };
            let mut talk = Talk::new(settings, RplidarSettings::of(model), faults);
            talk.run(30 * SECOND);
            assert_eq!(talk.session.account().restarts, 0, "{model:?} {faults}");
        }
    }
}

#[test]
fn a_line_that_damages_most_bytes_does_not_accuse_the_head() {
    let mut talk = Talk::new(Settings::default(), RplidarSettings::of(Model::S2), "loss=0.02");
    talk.run(6 * SECOND);
    for _ in 0..100 {
        talk.run(talk.bench.now + 100 * MILLIS);
        assert_ne!(talk.session.trouble(), Some(Trouble::StandsStill));
    }
    let account = talk.session.account();
    assert!(account.damaged > 2 * account.in_telegrams, "{account:?}");
}

#[test]
fn no_point_of_an_unmarked_turn_is_wrong_on_a_line_that_loses_bytes() {
    let kinds = [(Model::A1, Mode::Express), (Model::A1, Mode::Boost), (Model::S1, Mode::DenseBoost)];
    for (model, mode) in kinds {
        for seed in 0..3 {
            let settings =
                Settings { model: Some(model.name()), mode: Some(mode.name()), ..Settings::default() };
            let unit = RplidarSettings { seed, ..RplidarSettings::of(model) };
            let mut talk = Talk::new(settings, unit, "loss=0.0002,burst=4");
            talk.run(12 * SECOND);
            assert_eq!(talk.session.state(), State::Streaming, "{model:?}: {:?}", talk.session.trouble());
            let (points, wrong, worst) = talk.judge(0);
            let counts = talk.session.turn_counts();
            assert!(points > 1_000 && wrong == 0, "{model:?} {seed}: {wrong} of {points}");
            assert!(worst < 8 * MILLIS, "{model:?} {seed}: {worst}");
            assert!(counts.incomplete > 0 && talk.session.account().lost > 0, "{counts:?}");
        }
    }
}
