//! Scans without the distortion by the motion of a sensor, which measures each beam from another position.

use scanhub_schema::{Contents, Scan, ScanHead, ScanWord};

use super::view::is_whole;
use crate::velocity::{Velocity, times};

/// A scan as if the sensor had measured all beams at the scan's stamp.
pub(super) struct UndistortedScan {
    words: Box<[ScanWord]>,
    beams: usize,
}

impl UndistortedScan {
    /// Allocates a scan of at most `beams` beams.
    pub(super) fn new(beams: usize) -> UndistortedScan {
        UndistortedScan { words: vec![ScanWord::default(); beams + Scan::words(0)].into(), beams }
    }

    /// Computes `scan` without the distortion by a sensor that moves with `velocity`. Beams have exact angles. If two are measured in
    /// the same direction, the nearer one remains.
    pub(super) fn compute(&mut self, scan: &Scan, velocity: &Velocity) -> &Scan {
        let count = scan.beams().min(self.beams);
        let [first_s, last_s] = times(scan);
        let first_angle = scan.first_angle + velocity.yaw * (first_s + last_s) / 2.0;
        let farthest_um = f64::from(scan.valid_to) * f64::from(scan.unit_um);
        let unit_um = (farthest_um / f64::from(NO_RETURN)).ceil().max(1.0);
        let head = ScanHead {
            first_angle,
            unit_um: unit_um as u32,
            valid_to: NO_RETURN - 1,
            no_return: NO_RETURN,
            beyond: NO_RETURN,
            count: count as u16,
            contents: Contents::ANGLES,
            turns: 1,
            intensity_bits: 0,
            ..**scan
        };
        let (old_m, new_m) = (1e-6 * f64::from(scan.unit_um), 1e-6 * unit_um);
        let is_whole = is_whole(count, scan.step);
        let arrays = Scan::of_words_mut(&mut self.words).begin(head);
        arrays.angles.fill(f32::NAN);
        arrays.ranges.fill(NO_RETURN);
        for i in 0..count {
            let Some(range) = scan.range(i).filter(|range| *range > 0) else { continue };
            let (x, y, yaw) = velocity.position(1e-9 * scan.beam_ns(i) as f64);
            let range = f64::from(range) * old_m;
            let angle = scan.angle(i) + yaw;
            let (sin, cos) = angle.sin_cos();
            let (along, across) = (range + cos * x + sin * y, cos * y - sin * x);
            let angle = angle + across.atan2(along);
            let range = (along.hypot(across) / new_m).round();
            let slot = (angle - first_angle) / scan.step;
            let beam_of = |slot: f64| {
                let beam = slot.round() as i64;
                let beam = if is_whole { beam.rem_euclid(count as i64) } else { beam };
                usize::try_from(beam).ok().filter(|beam| *beam < count)
            };
            let Some(mut beam) = beam_of(slot).filter(|_| range >= 1.0) else { continue };
            // Revolutions that are measured one after the other may meet the same beams, and leave those next to them empty.
            if arrays.ranges[beam] != NO_RETURN {
                let other = (f64::from(arrays.angles[beam]) - first_angle) / scan.step;
                let next = beam_of(if slot > other { slot.round() + 1.0 } else { slot.round() - 1.0 });
                beam = next.filter(|next| arrays.ranges[*next] == NO_RETURN).unwrap_or(beam);
            }
            if range < f64::from(arrays.ranges[beam]) {
                (arrays.ranges[beam], arrays.angles[beam]) = (range as u16, angle as f32);
            }
        }
        Scan::of_words(&self.words)
    }
}

/// Value of a beam without a reading in an undistorted scan.
const NO_RETURN: u16 = u16::MAX;
