//! How far the measured ranges are from what was found: the root of the mean square over the beams that meet it, and the
//! share of the beams that do. Refuses to know who found it.

use schema::{Lines, Scan};

/// Lines that beams of a scan end on, one after the other.
pub(crate) struct Found {
    /// First beam, last beam, and the line: distance from the sensor and direction of its nearest point.
    pub(crate) lines: Vec<(usize, usize, f64, f64)>,
}

/// Of one scan.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Score {
    /// In metres.
    pub(crate) rmse: f64,
    /// Beams that meet a line, of those that have a range.
    pub(crate) share: f64,
}

impl Found {
    /// What the hub found, for a sensor at the robot's centre.
    pub(crate) fn of(lines: &Lines) -> Found {
        let line = |line: &schema::Line| {
            (usize::from(line.first), usize::from(line.last), f64::from(line.r_m), f64::from(line.alpha_rad))
        };
        Found { lines: lines.lines().iter().map(line).collect() }
    }

    pub(crate) fn score(&self, scan: &Scan) -> Score {
        let (mut square, mut met) = (0.0, 0);
        let mut is_met = vec![false; scan.beams()];
        for &(first, last, r, alpha) in &self.lines {
            for (beam, is_met) in is_met.iter_mut().enumerate().take(last + 1).skip(first) {
                let Some(range) = scan.distance_m(beam).filter(|_| !*is_met) else { continue };
                let off = range - r / (scan.angle(beam) - alpha).cos();
                square += off * off;
                met += 1;
                *is_met = true;
            }
        }
        let readings = (0..scan.beams()).filter(|&beam| scan.distance_m(beam).is_some()).count();
        Score {
            rmse: (square / f64::from(met.max(1))).sqrt(),
            share: f64::from(met) / readings.max(1) as f64,
        }
    }
}

/// The means over `scores`.
pub(crate) fn mean(scores: &[Score]) -> Score {
    let mean = |of: fn(&Score) -> f64| scores.iter().map(of).sum::<f64>() / scores.len().max(1) as f64;
    Score { rmse: mean(|score| score.rmse), share: mean(|score| score.share) }
}
