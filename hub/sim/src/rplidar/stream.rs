//! What a scanner sends unasked: which point is measured when and where the head is then, and when a packet has all its
//! points. Knows neither requests nor the line.

use schema::Nanos;

use super::models::{Form, Mode, Model};
use super::optics::Optics;
use super::packets::{self, Reading};
use crate::turning::Rotation;

/// A motor that turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Motion {
    pub(super) since_ns: Nanos,
    /// From when on it is fast enough to measure.
    pub(super) steady_ns: Nanos,
    pub(super) rotation: Rotation,
}

/// Points of one mode, from the first one on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stream {
    pub(super) mode: Mode,
    /// Whether it does not matter how the motor turns.
    pub(super) forced: bool,
    /// When it was asked for.
    pub(super) asked_ns: Nanos,
    /// When the first point is measured; nothing while the motor rests.
    pub(super) begin_ns: Option<Nanos>,
    /// From one point to the next.
    sample_ns: f64,
    /// Packets sent since then.
    sent: u64,
}

impl Stream {
    /// One of `model` in `mode`, as was asked for at `asked_ns`: as soon as `motor` is steady, or at once if it is `forced`.
    pub(super) fn new(
        model: Model,
        mode: Mode,
        forced: bool,
        asked_ns: Nanos,
        motor: Option<Motion>,
    ) -> Stream {
        let steady_ns = if forced { Some(0) } else { motor.map(|motion| motion.steady_ns) };
        let begin_ns = steady_ns.map(|steady_ns| steady_ns.max(asked_ns));
        let sample_ns = 1e3 * mode.sample_us * model.slowness();
        Stream { mode, forced, asked_ns, begin_ns, sample_ns, sent: 0 }
    }

    /// When point number `point` is measured, and how many degrees clockwise from its zero the head is then.
    pub(super) fn place(&self, point: u64, motor: Option<Motion>) -> Option<(Nanos, f64)> {
        let at_ns = self.begin_ns? + (point as f64 * self.sample_ns) as Nanos;
        let turns = motor
            .map_or(0.0, |motion| motion.rotation.turns(at_ns.saturating_sub(motion.since_ns) as f64 / 1e9));
        Some((at_ns, turns.fract() * 360.0))
    }

    /// Packets that were begun.
    pub(super) fn sent(&self) -> u64 {
        self.sent
    }

    /// When the first point of the next packet is measured.
    pub(super) fn next_ns(&self, motor: Option<Motion>) -> Option<Nanos> {
        self.place(self.sent * self.mode.form.points() as u64, motor).map(|(at_ns, _)| at_ns)
    }

    /// When the next packet has all its points.
    pub(super) fn due_ns(&self, motor: Option<Motion>) -> Option<Nanos> {
        let points = self.mode.form.points() as u64 * (self.sent + 1);
        // What is told as a difference from the next packet's first range waits for it.
        let last = if self.mode.form == Form::Ultra { points } else { points - 1 };
        self.place(last, motor).map(|(at_ns, _)| at_ns)
    }

    /// The next packet, of what `optics` sees.
    pub(super) fn packet(&mut self, motor: Option<Motion>, optics: &mut Optics) -> Option<Vec<u8>> {
        let Mode { form, reach_m, .. } = self.mode;
        let clock_us = (self.due_ns(motor)? / 1_000) as u32;
        let first = self.sent * form.points() as u64;
        let mut readings = Vec::with_capacity(form.points() + 1);
        for point in first..=first + form.points() as u64 {
            let (at_ns, head_deg) = self.place(point, motor)?;
            let before = point.checked_sub(1).and_then(|point| self.place(point, motor));
            let begins_turn = before.is_some_and(|(_, before_deg)| before_deg > head_deg);
            let is_wanted = form == Form::Ultra || readings.len() < form.points();
            let reading =
                if is_wanted { optics.measure(at_ns, head_deg, reach_m) } else { Reading::default() };
            readings.push(Reading { begins_turn, ..reading });
        }
        let next = readings.pop()?;
        let is_first = self.sent == 0;
        self.sent += 1;
        Some(match form {
            Form::Standard => packets::standard(&readings[0]),
            Form::Express => packets::express(is_first, &readings),
            Form::Ultra => packets::ultra(is_first, &readings, &next),
            Form::Dense => packets::dense(is_first, &readings),
            Form::UltraDense => packets::ultra_dense(is_first, clock_us, &readings),
        })
    }
}
