//! Measures the number of points per revolution. While a head spins up, it rotates more slowly, and a revolution has
//! more points than at the final speed. The measurement therefore uses only revolutions at a constant speed.

use scanhub_schema::{MILLIS, Nanos};

use crate::ld::Model;
use crate::ld::packet::{POINTS_PER_PACKET, Packet};
use crate::ld::sequence::PacketPosition;

/// Measurement in progress, updated with every packet.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PointCount {
    /// Number of packets in the current sequence.
    packets: u32,
    revolution: Option<Revolution>,
    steady: Option<SteadySpeed>,
    /// Time of the last packet, in the scanner's clock. `angle` is the angle of this packet's first point, in degrees,
    /// cumulative over all revolutions.
    time: Nanos,
    angle: f64,
}

/// Revolution that is being measured.
#[derive(Clone, Copy, Debug)]
struct Revolution {
    /// Angle at the start of the revolution, in degrees, cumulative over all revolutions.
    angle: f64,
    packets: u32,
    /// Sum of the speeds in the packets that arrived, in degrees per second, and the number of these packets.
    speeds: (f64, u32),
    slowest: u16,
    fastest: u16,
}

/// Consecutive revolutions at a constant speed.
#[derive(Clone, Copy, Debug)]
struct SteadySpeed {
    since: Nanos,
    slowest: f64,
    fastest: f64,
}

/// Result for a complete revolution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CountedRevolution {
    /// Number of packets in the sequence up to the end of the revolution.
    pub(crate) packets: u32,
    pub(crate) points_per_revolution: f64,
    pub(crate) revolutions_per_second: f64,
    /// Time for which the speed has been constant. It is 0 if the speed changed in this revolution.
    pub(crate) steady_time: Nanos,
    /// Time at the end of the revolution, in the scanner's clock.
    pub(crate) at: Nanos,
}

impl PointCount {
    /// Adds a packet that is at `position` in the sequence. Returns the revolution that the packet completes.
    pub(crate) fn note_packet(
        &mut self,
        packet: &Packet<'_>,
        position: PacketPosition,
    ) -> Option<CountedRevolution> {
        match position {
            PacketPosition::Repeated | PacketPosition::Outlier => None,
            PacketPosition::Next { time, angle, missing, .. } if missing <= MAX_MISSING => {
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
            PacketPosition::First { time, angle } | PacketPosition::Next { time, angle, .. } => {
                let revolution = Some(Revolution::begin(packet, angle));
                *self = PointCount { packets: 1, revolution, steady: None, time, angle };
                None
            }
        }
    }

    /// Returns the model and its number of beams once the first packets of a revolution match a model. Packets match a
    /// model if the head rotates constantly at the model's usual speed and the scanner measures the model's usual
    /// number of points per revolution.
    pub(crate) fn typical_model(&self) -> Option<(Model, usize)> {
        let revolution = self.revolution.filter(|revolution| revolution.packets >= MIN_TYPICAL)?;
        let counted = revolution.count_until(self.angle);
        let model = counted.model();
        let is_typical = revolution.is_steady() && counted.is_usual() && counted.beams() == model.beams();
        is_typical.then_some((model, model.beams()))
    }

    fn complete(&mut self, revolution: Revolution, angle: f64, at: Nanos) -> CountedRevolution {
        let counted = revolution.count_until(angle);
        let revolutions_per_second = counted.revolutions_per_second;
        let began_at = at.saturating_sub((1e9 / revolutions_per_second.max(0.1)) as Nanos);
        let single =
            SteadySpeed { since: began_at, slowest: revolutions_per_second, fastest: revolutions_per_second };
        let before = self.steady.unwrap_or(single);
        let slowest = before.slowest.min(revolutions_per_second);
        let fastest = before.fastest.max(revolutions_per_second);
        let is_continued = fastest <= slowest * (1.0 + MAX_SPEED_VARIATION);
        let steady = if is_continued { SteadySpeed { slowest, fastest, ..before } } else { single };
        self.steady = revolution.is_steady().then_some(steady);
        let steady_time = self.steady.map_or(0, |steady| at.saturating_sub(steady.since));
        CountedRevolution { packets: self.packets, steady_time, at, ..counted }
    }
}

impl Revolution {
    /// Creates a revolution that starts with the first point of `packet`, at `angle`.
    fn begin(packet: &Packet<'_>, angle: f64) -> Revolution {
        let speed = packet.speed();
        Revolution { angle, packets: 0, speeds: (f64::from(speed), 1), slowest: speed, fastest: speed }
    }

    /// Returns the result for the part of the revolution before `angle`, which is the angle of a packet's first point.
    fn count_until(&self, angle: f64) -> CountedRevolution {
        let (sum, count) = self.speeds;
        let points_per_revolution =
            f64::from(self.packets) * POINTS_PER_PACKET as f64 * 360.0 / (angle - self.angle).max(0.01);
        let revolutions_per_second = sum / f64::from(count) / 360.0;
        CountedRevolution {
            packets: self.packets,
            points_per_revolution,
            revolutions_per_second,
            steady_time: 0,
            at: 0,
        }
    }

    fn is_steady(&self) -> bool {
        f64::from(self.fastest) <= f64::from(self.slowest) * (1.0 + MAX_SPEED_VARIATION)
    }

    /// Adds `packet`. `missing` is the number of packets that are missing before `packet`. Counts the previous packet
    /// and the missing packets, because the revolution now extends up to the first point of `packet`.
    fn add(&mut self, packet: &Packet<'_>, missing: u32) {
        let speed = packet.speed();
        self.packets += 1 + missing;
        self.speeds = (self.speeds.0 + f64::from(speed), self.speeds.1 + 1);
        (self.slowest, self.fastest) = (self.slowest.min(speed), self.fastest.max(speed));
    }
}

impl CountedRevolution {
    /// Returns the model that measures this number of points per second. If several models measure this number, returns
    /// one of these models.
    pub(crate) fn model(&self) -> Model {
        Model::of_point_rate((self.points_per_revolution * self.revolutions_per_second) as f32)
    }

    /// Returns the number of beams for this number of points. If the number of points is close to the model's number of
    /// beams, returns the model's number.
    pub(crate) fn beams(&self) -> usize {
        let of_model = self.model().beams();
        let is_close = (self.points_per_revolution / of_model as f64 - 1.0).abs() <= MAX_COUNT_DEVIATION;
        if is_close { of_model } else { (self.points_per_revolution + 0.5) as usize }
    }

    /// Returns whether the number of points is reliable. At a speed that is not usual for the model, the head may still
    /// be spinning up slowly. Such a speed must therefore be constant for a longer time than the usual speed.
    pub(crate) fn is_final(&self) -> bool {
        self.packets >= MIN_PACKETS && self.steady_time >= if self.is_usual() { 1 } else { SLOW_SPIN_UP_TIME }
    }

    /// Returns whether the head rotates at the model's usual speed.
    fn is_usual(&self) -> bool {
        let usual_speed = f64::from(self.model().revolutions_per_second());
        (self.revolutions_per_second / usual_speed - 1.0).abs() <= MAX_SPEED_DEVIATION
    }

    /// Returns whether the number of points no longer fits `beams`.
    pub(crate) fn differs_from(&self, beams: usize) -> bool {
        (self.points_per_revolution / beams as f64 - 1.0).abs() > MAX_COUNT_DEVIATION
    }
}

/// Minimum number of packets in a sequence for a reliable number of points.
const MIN_PACKETS: u32 = 64;
/// Minimum number of packets of a revolution before the revolution is compared with the models.
const MIN_TYPICAL: u32 = 16;
/// Maximum number of consecutive missing packets within a sequence. The count of the missing packets is not exact for a
/// longer gap.
const MAX_MISSING: u32 = 8;
/// Maximum variation of a speed that counts as constant, as a ratio. The speed of real scanners varies by 1 %.
const MAX_SPEED_VARIATION: f64 = 0.02;
/// Maximum deviation from the model's usual speed, as a ratio.
const MAX_SPEED_DEVIATION: f64 = 0.015;
/// Maximum deviation of the number of points from the number of beams, as a ratio.
const MAX_COUNT_DEVIATION: f64 = 0.03;
/// Time for which a speed must be constant if it is not usual for the model.
const SLOW_SPIN_UP_TIME: Nanos = 3_000 * MILLIS;
