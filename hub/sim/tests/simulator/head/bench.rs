//! A head, its line with faults and a session, in virtual time; what the session tells is judged by what the head really
//! measured.

use scanhub_drivers::Settings;
use scanhub_drivers::ld::Session;
use scanhub_drivers::ld::packet::LEN;
use scanhub_drivers::line;
use scanhub_drivers::line::Point;
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::device::{Device as _, Part};
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::room::Room;
use scanhub_sim::wire::LineModel;
use scanhub_sim::world::World;

/// A packet that left, and whether nothing happened to it on its way.
pub(crate) struct Sent {
    pub(crate) bytes: Vec<u8>,
    pub(crate) intact: bool,
    pub(crate) at: Nanos,
}

pub(crate) struct Turn {
    pub(crate) points: Vec<Point>,
    pub(crate) first: Nanos,
    pub(crate) incomplete: bool,
    pub(crate) beams: usize,
}

pub(crate) struct Bench {
    pub(crate) session: Session,
    pub(crate) head: LdSimulator,
    settings: LdSettings,
    wire: LineModel,
    pub(crate) now: Nanos,
    inbox: Vec<u8>,
    intact: bool,
    pub(crate) sent: Vec<Sent>,
    pub(crate) packets: Vec<[u8; LEN]>,
    /// When each of them arrived, as it was told.
    pub(crate) stamps: Vec<Nanos>,
    pub(crate) turns: Vec<Turn>,
}

/// A room without noise.
pub(crate) fn still(world: &str) -> World {
    world.parse::<World>().expect("a world").with_noise(NoiseModel::NONE)
}

impl Bench {
    pub(crate) fn new(settings: LdSettings, world: &World, faults: &str, seed: u64) -> Bench {
        Bench::of(settings, LdSimulator::new(settings, Room::new(world, seed)), faults, seed)
    }

    pub(crate) fn of(settings: LdSettings, head: LdSimulator, faults: &str, seed: u64) -> Bench {
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

    pub(crate) fn run(&mut self, until: Nanos) {
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

    /// Until when the session wants to wait, and whether for bytes.
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

    pub(crate) fn cycle_power(&mut self) {
        self.wire.cycle_power(&mut self.head, self.now);
    }

    pub(crate) fn brown_out(&mut self) {
        self.head.brown_out(self.now);
    }

    /// Every intact packet came once and in order.
    pub(crate) fn judge_packets(&self) {
        let mut came = self.packets.iter();
        let due = self.sent.iter().filter(|sent| sent.intact && sent.at + 20 * MILLIS < self.now);
        for (number, sent) in due.enumerate() {
            assert!(came.any(|bytes| bytes[..] == sent.bytes), "intact packet {number} was lost");
        }
    }

    /// Judges each turn by what the head measured since `zero`: its points are of one turn and in order; where it is not
    /// marked all of them are there, at most `angle_deg` and `range_mm` off. Returns the worst error of a stamp.
    pub(crate) fn judge_turns(&mut self, zero: Nanos, angle_deg: f64, range_mm: f64) -> Nanos {
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
