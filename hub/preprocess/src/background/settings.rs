//! The settings of a background, and the limits that follow from them for scans of one resolution and unit. Refuses to
//! know where the settings come from.

use std::f64::consts::TAU;

use schema::ScanHead;

/// How a background is learned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// By which method.
    pub method: Method,
    /// Readings at most so far apart, in mm, are of one surface; one unit of the sensor's at least. None: 30, in cm mode
    /// 60, in dm mode 100.
    pub threshold_mm: Option<u16>,
    /// The same for a reading and its candidate (`paper`).
    pub candidate_mm: Option<u16>,
    /// Scans until a surface is background. None: 375 at half degrees, 750 at 1, 188 at a quarter, which are 10 s at
    /// the full rate; `multi` knows a surface well enough after
    /// 5/8 of it. At most 8191, more is taken for that: 3.6 minutes at half degrees.
    pub scans: Option<u32>,
    /// What a candidate is compared with (`paper`).
    pub candidate: Candidate,
    /// What is known at the start.
    pub start: Start,
    /// A beam from which nothing came back has a far background, instead of telling nothing. None: yes with `multi`,
    /// which so finds people before glass and at no cost elsewhere; no with `paper`, whose runs each such beam ends.
    pub no_return_is_far: Option<bool>,
}

/// The ways to learn a background.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// One background a beam, replaced by what was read often enough in a row.
    Paper,
    /// Several surfaces a beam, and neighbours that must agree before something is in the foreground.
    #[default]
    Multi,
    /// A map of what stands around a robot that moves: what ends in space that was seen free is in the foreground. Each scan
    /// needs the robot's place, see [`Model::follow`](super::Model::follow).
    Moving,
}

/// What the readings of a run are compared with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Candidate {
    /// The first one: somebody who walks straight at the sensor never becomes background.
    #[default]
    First,
    /// The one before: drifts along with whatever moves slowly.
    Latest,
}

/// What is known at the start and after each reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// Nothing.
    #[default]
    Empty,
    /// What the first scan shows, as soon as it is over; beams without a reading in it begin empty.
    FirstScan,
}

/// The settings in the units of the scans.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// In device units; so low that no range is near [`schema::Background::FAR`].
    pub(super) threshold: u16,
    /// In device units.
    pub(super) candidate: u16,
    /// 1 to [`MOST_SCANS`].
    pub(super) scans: u16,
    pub(super) latest: bool,
    pub(super) no_return_is_far: bool,
    /// Angle between two beams in 1/1000 degree, whichever way they turn.
    pub(super) step_mdeg: u32,
    /// Micrometres per device unit, at least 1.
    pub(super) unit_um: u32,
}

/// Default of both thresholds: six standard deviations of a range (the paper names no value).
const THRESHOLD_MM: u16 = 30;
/// In cm mode: quantisation comes on top.
const THRESHOLD_CM_MODE_MM: u16 = 60;
/// In dm mode: what lies 30 mm apart is read as at most one unit apart.
const THRESHOLD_DM_MODE_MM: u16 = 100;
/// 750 mirror turns of an LMS: as many scans at 1 degree, half of them at half degrees.
const TEN_SECONDS_NS: f64 = 9.99e9;
/// What the weights of `multi` have room for: eight a scan in 16 bits.
const MOST_SCANS: u32 = 8191;
/// No two ranges are farther apart; [`schema::Background::FAR`] is, from all of them.
const FARTHEST: u32 = 0x7FFF;
/// What a quotient may lose: a whole number stays that number.
const ROUNDING: f64 = 1e-6;

impl Limits {
    pub(super) fn of(settings: &Settings, scan: &ScanHead) -> Limits {
        let unit_um = scan.unit_um.max(1);
        let default_mm = match unit_um {
            ..10_000 => THRESHOLD_MM,
            10_000..100_000 => THRESHOLD_CM_MODE_MM,
            100_000.. => THRESHOLD_DM_MODE_MM,
        };
        // With less than a unit a reading between two of them would be of no surface.
        let units = |mm: Option<u16>| {
            (1000 * u32::from(mm.unwrap_or(default_mm)) / unit_um).clamp(1, FARTHEST) as u16
        };
        let turn_ns = f64::from(scan.beam_time_ns) * TAU / scan.step.abs();
        // What has no turn has none of 10 s either.
        let ten_seconds =
            (TEN_SECONDS_NS / (turn_ns * f64::from(scan.turns.max(1))) - ROUNDING).ceil() as u32;
        Limits {
            threshold: units(settings.threshold_mm),
            candidate: units(settings.candidate_mm),
            scans: settings.scans.unwrap_or(ten_seconds).clamp(1, MOST_SCANS) as u16,
            latest: settings.candidate == Candidate::Latest,
            no_return_is_far: settings.no_return_is_far.unwrap_or(settings.method == Method::Multi),
            step_mdeg: (scan.step.abs().to_degrees() * 1000.0).round() as u32,
            unit_um,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_go_by_unit_and_resolution() {
        let limits = |settings, unit_mm: u32, turns| {
            let step_deg = 1.0 / f64::from(turns);
            let head = ScanHead {
                unit_um: 1000 * unit_mm,
                step: step_deg.to_radians(),
                beam_time_ns: (37_000.0 * step_deg) as u32,
                turns,
                ..ScanHead::default()
            };
            let limits = Limits::of(&settings, &head);
            (limits.threshold, limits.candidate, limits.scans)
        };
        let paper = Settings { method: Method::Paper, ..Settings::default() };
        assert_eq!(limits(paper, 1, 2), (30, 30, 375));
        assert_eq!(limits(paper, 10, 1), (6, 6, 750));
        assert_eq!(limits(paper, 1, 4), (30, 30, 188));
        assert_eq!(limits(paper, 100, 2), (1, 1, 375));
        let own = Settings { threshold_mm: Some(45), candidate_mm: Some(u16::MAX), scans: Some(0), ..paper };
        assert_eq!(limits(own, 10, 2), (4, 6553, 1));
        assert_eq!(limits(own, 0, 2), (32_767, 32_767, 1));
        let turning = ScanHead {
            unit_um: 1000,
            step: -0.8_f64.to_radians(),
            beam_time_ns: 222_222,
            ..ScanHead::default()
        };
        assert_eq!(Limits::of(&paper, &turning).scans, 100, "10 Hz");
        assert_eq!(Limits::of(&paper, &ScanHead::default()).scans, 1);
        assert_eq!(limits(own, 100, 2), (1, 655, 1), "less than a unit is one");
        assert_eq!(limits(Settings { scans: Some(u32::MAX), ..paper }, 1, 2).2, 8191);
    }
}
