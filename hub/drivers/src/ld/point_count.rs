//! Measures how many points a scanner measures per revolution. A head that spins up measures more of them, so only
//! revolutions at a constant speed count.

use scanhub_schema::{MILLIS, Nanos};

use crate::ld::Model;
use crate::ld::packet::{POINTS, Packet};
use crate::ld::sequence::Place;

/// The measurement, from packet to packet.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PointCount {
    /// Packets in sequence.
    packets: u32,
    revolution: Option<Revolution>,
    steady: Option<Steady>,
    /// Time of the last packet, and degrees of its first point over all revolutions.
    time: Nanos,
    angle: f64,
}

/// A revolution that is being measured.
#[derive(Clone, Copy, Debug)]
struct Revolution {
    /// Degrees at its start, over all revolutions.
    angle: f64,
    packets: u32,
    /// Sum of the speeds of those packets that arrived, and their number.
    speeds: (f64, u32),
    slowest: u16,
    fastest: u16,
}

/// Revolutions with a constant speed.
#[derive(Clone, Copy, Debug)]
struct Steady {
    since: Nanos,
    slowest: f64,
    fastest: f64,
}

/// A complete revolution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Counted {
    /// Packets in sequence up to its end.
    pub(crate) packets: u32,
    pub(crate) points_per_turn: f64,
    pub(crate) turns_per_second: f64,
    /// Duration for which the speed has been constant; 0 if it was not in this revolution.
    pub(crate) steady_for: Nanos,
    /// Time of its end, by the scanner's clock.
    pub(crate) at: Nanos,
}

impl PointCount {
    /// Handles a packet at its place in the sequence. Returns the revolution that it completes.
    pub(crate) fn note(&mut self, packet: &Packet<'_>, place: Place) -> Option<Counted> {
        match place {
            Place::Again | Place::Odd => None,
            Place::Next { time, angle, missing, .. } if missing <= MAX_MISSING => {
                self.packets += 1;
                let started_at = core::mem::replace(&mut self.time, time);
                self.angle = angle;
                let Some(revolution) = &mut self.revolution else {
                    self.revolution = Some(Revolution::begin(packet, angle));
                    return None;
                };
                revolution.add(packet, missing);
                if angle - revolution.angle < 360.0 {
                    return None;
                }
                let (revolution, next) = (*revolution, Revolution::begin(packet, angle));
                self.revolution = Some(next);
                Some(self.complete(revolution, angle, started_at))
            }
            Place::First { time, angle } | Place::Next { time, angle, .. } => {
                let revolution = Some(Revolution::begin(packet, angle));
                *self = PointCount { packets: 1, revolution, steady: None, time, angle };
                None
            }
        }
    }

    /// Returns the model and its beams if a part of a revolution already is exactly as the model is sold: at the usual speed,
    /// with the usual number of points.
    pub(crate) fn typical(&self) -> Option<(Model, usize)> {
        let revolution = self.revolution.filter(|revolution| revolution.packets >= MIN_TYPICAL)?;
        let counted = revolution.counted(self.angle);
        let model = counted.model();
        let is_typical = revolution.is_steady() && counted.is_usual() && counted.beams() == model.beams();
        is_typical.then_some((model, model.beams()))
    }

    fn complete(&mut self, revolution: Revolution, angle: f64, at: Nanos) -> Counted {
        let counted = revolution.counted(angle);
        let turns_per_second = counted.turns_per_second;
        let began_at = at.saturating_sub((1e9 / turns_per_second.max(0.1)) as Nanos);
        let alone = Steady { since: began_at, slowest: turns_per_second, fastest: turns_per_second };
        let before = self.steady.unwrap_or(alone);
        let slowest = before.slowest.min(turns_per_second);
        let fastest = before.fastest.max(turns_per_second);
        let is_continued = fastest <= slowest * (1.0 + STEADY);
        let steady = if is_continued { Steady { slowest, fastest, ..before } } else { alone };
        self.steady = revolution.is_steady().then_some(steady);
        let steady_for = self.steady.map_or(0, |steady| at.saturating_sub(steady.since));
        Counted { packets: self.packets, steady_for, at, ..counted }
    }
}

impl Revolution {
    /// Creates the revolution that begins with the first point of `packet`, at `angle`.
    fn begin(packet: &Packet<'_>, angle: f64) -> Revolution {
        let speed = packet.speed();
        Revolution { angle, packets: 0, speeds: (f64::from(speed), 1), slowest: speed, fastest: speed }
    }

    /// Returns the points up to a packet at `angle`.
    fn counted(&self, angle: f64) -> Counted {
        let (sum, count) = self.speeds;
        let points_per_turn =
            f64::from(self.packets) * POINTS as f64 * 360.0 / (angle - self.angle).max(0.01);
        let turns_per_second = sum / f64::from(count) / 360.0;
        Counted { packets: self.packets, points_per_turn, turns_per_second, steady_for: 0, at: 0 }
    }

    fn is_steady(&self) -> bool {
        f64::from(self.fastest) <= f64::from(self.slowest) * (1.0 + STEADY)
    }

    /// Adds a packet that follows after `missing` others. Its points belong to the next packet's interval.
    fn add(&mut self, packet: &Packet<'_>, missing: u32) {
        let speed = packet.speed();
        self.packets += 1 + missing;
        self.speeds = (self.speeds.0 + f64::from(speed), self.speeds.1 + 1);
        (self.slowest, self.fastest) = (self.slowest.min(speed), self.fastest.max(speed));
    }
}

impl Counted {
    /// Returns the model by the points per second, or one of the models that cannot be distinguished.
    pub(crate) fn model(&self) -> Model {
        Model::of_point_rate((self.points_per_turn * self.turns_per_second) as f32)
    }

    /// Returns the number of beams for these points: that of the model, if it is close.
    pub(crate) fn beams(&self) -> usize {
        let of_model = self.model().beams();
        let is_close = (self.points_per_turn / of_model as f64 - 1.0).abs() <= CLOSE;
        if is_close { of_model } else { (self.points_per_turn + 0.5) as usize }
    }

    /// Returns whether the number of points is reliable. At another speed than that of its model, a head may still spin up,
    /// slowly.
    pub(crate) fn is_final(&self) -> bool {
        self.packets >= MIN_PACKETS && self.steady_for >= if self.is_usual() { 1 } else { SLOW_SPIN_UP }
    }

    /// Returns whether the head rotates at the speed at which its model is sold.
    fn is_usual(&self) -> bool {
        let usual = f64::from(self.model().turns_per_second());
        (self.turns_per_second / usual - 1.0).abs() <= USUAL
    }

    /// Returns whether `beams` no longer fits the number of points.
    pub(crate) fn differs_from(&self, beams: usize) -> bool {
        (self.points_per_turn / beams as f64 - 1.0).abs() > CLOSE
    }
}

/// Packets in sequence before a number of points is reliable.
const MIN_PACKETS: u32 = 64;
/// Packets of a revolution that are enough if it is typical.
const MIN_TYPICAL: u32 = 16;
/// More missing packets than these end a sequence: their number is uncertain.
const MAX_MISSING: u32 = 8;
/// Share by which a constant speed may vary. The speed of real heads varies by 1 %.
const STEADY: f64 = 0.02;
/// Share by which a speed may differ from the usual one of the model.
const USUAL: f64 = 0.015;
/// Share by which the number of points may differ from the number of beams.
const CLOSE: f64 = 0.03;
/// Duration for which an unusual speed must be constant.
const SLOW_SPIN_UP: Nanos = 3_000 * MILLIS;
