//! Computes three-dimensional points, background and obstacles, sweep by sweep, from the scans of a planar scanner that
//! a mount tilts.
//!
//! A [`Mount`] describes the axis. [`TiltScanner`] takes scans and [`Angle`]s and returns [`Sweep`]s. For each beam,
//! the mount's angle at the time of that beam is used. A beam without a reliable angle produces no point. [`Counts`]
//! has the number of these beams for each reason.
//!
//! The module uses neither a clock nor I/O. All times are stamps of scans and angles, so a recording gives the same
//! points at any speed.

mod angles;
mod background;
mod delay;
mod mount;
mod sweep;

use std::collections::VecDeque;

use scanhub_schema::Scan;
pub use scanhub_schema::{MAX_OBSTACLES, Obstacle, PointClass};
use serde::{Serialize, Serializer};

pub use self::angles::{Angle, DropReason};
use self::angles::{AngleLookup, AngleUpdate, Angles, ReversalDetector, SwingEvent};
use self::delay::{Delay, MAX_DELAY_S};
pub use self::mount::{Floor, Mount, MountCheck, Wall};
use self::sweep::{Ray, SweepAnalyzer};

/// Runs the examples in docs/tilt.md as tests.
#[cfg(doctest)]
#[doc = include_str!("../../../docs/tilt.md")]
struct Page;

/// Maximum number of scans that wait for angles. If one more scan arrives, the oldest scan is processed at once.
const MAX_WAITING_SCANS: usize = 64;
/// Maximum number of beams of a sweep. A sweep that reaches this number ends without a reversal.
const MAX_RAYS: usize = 262_144;
/// Minimum step backward from one scan's stamp to the next that shows that the clock was set back, in ns.
const CLOCK_JUMP_NS: u64 = 1_000_000_000;
/// Counters since the [`TiltScanner`] was created.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Sweeps that were passed to the caller.
    pub sweeps: u64,
    /// Sweeps that were passed to the caller and are not complete.
    pub incomplete: u64,
    /// Sweeps that were passed to the caller and contradict the background.
    pub unreliable: u64,
    /// Resets of the background: the shape of the scans changed, sweeps contradicted the background for too long, or
    /// the delay of the angles was corrected.
    pub background_resets: u64,
    /// Processed scans.
    pub scans: u64,
    /// Scans that were dropped because a later scan had already arrived.
    pub out_of_order: u64,
    /// Created points.
    pub points: u64,
    /// Beams that have a reading but produced no point, counted separately for each [`DropReason`].
    #[serde(serialize_with = "by_reason")]
    pub points_dropped: [u64; DropReason::COUNT],
    /// Accepted angles.
    pub angles: u64,
    /// Angles that were dropped because a later angle had already arrived.
    pub angles_out_of_order: u64,
    /// Angles that were dropped because their stamps are more than 1 s later than the latest scan's stamp.
    pub angles_in_future: u64,
    /// Angles that were dropped because they are not numbers.
    pub angles_invalid: u64,
}

fn by_reason<S: Serializer>(counts: &[u64; DropReason::COUNT], serializer: S) -> Result<S::Ok, S::Error> {
    use DropReason::{Inconsistent, Jumped, Silent, Standing};
    serializer.collect_map([Silent, Jumped, Inconsistent, Standing].into_iter().zip(counts))
}

struct PendingScan {
    stamp_ns: u64,
    /// Stamp of the last beam.
    until_ns: u64,
    scan: Box<Scan>,
}

/// End of a sweep.
#[derive(Clone, Copy)]
struct SweepEnd {
    stamp_ns: u64,
    /// Whether the mount reversed. If false, the mount's angle is unknown after `stamp_ns`, or the sweep has too many
    /// beams.
    is_reversal: bool,
}

/// A scanner on a mount.
pub struct TiltScanner {
    settings: Settings,
    angles: Angles,
    reversals: ReversalDetector,
    waiting: VecDeque<PendingScan>,
    spare_scans: Vec<Box<Scan>>,
    /// First stamp of the last scan, in ns.
    scan_ns: Option<u64>,
    /// Stamp of the last processed beam.
    taken_ns: u64,
    ends: VecDeque<SweepEnd>,
    rays: Vec<Ray>,
    next_rays: Vec<Ray>,
    analyzer: SweepAnalyzer,
    delay: Delay,
    /// Shape of the scans: number of beams, first angle, and angle between two beams.
    shape: (usize, f64, f64),
    from_ns: u64,
    /// Whether the sweep started at a reversal and has all beams so far.
    is_whole: bool,
    counts: Counts,
}

impl TiltScanner {
    /// Creates a tilted scanner without scans and angles.
    pub fn new(mount: Mount, settings: Settings) -> TiltScanner {
        TiltScanner {
            settings,
            angles: Angles::new(),
            reversals: ReversalDetector::default(),
            waiting: VecDeque::with_capacity(MAX_WAITING_SCANS + 1),
            spare_scans: Vec::new(),
            scan_ns: None,
            taken_ns: 0,
            ends: VecDeque::new(),
            rays: Vec::new(),
            next_rays: Vec::new(),
            analyzer: SweepAnalyzer::new(mount, settings),
            delay: Delay::default(),
            shape: (0, 0.0, 0.0),
            from_ns: 0,
            is_whole: false,
            counts: Counts::default(),
        }
    }

    /// Returns the counters.
    pub fn counts(&self) -> Counts {
        Counts { background_resets: self.analyzer.background_resets, ..self.counts }
    }

    /// Returns the estimated delay of the mount's stamps in ns. All angles are corrected by this delay, which is
    /// computed from the difference between up and down sweeps.
    pub fn late_ns(&self) -> i64 {
        self.angles.late_ns()
    }

    /// Returns the reason why the beams of new scans produce no points; `None` if they produce points.
    pub fn problem(&self) -> Option<DropReason> {
        let late_ns = self.scan_ns.unwrap_or(0).saturating_sub(self.settings.delay_ns);
        let is_silent = self.angles.last_ns().is_none_or(|last_ns| last_ns < late_ns);
        if is_silent { Some(DropReason::Silent) } else { self.angles.problem() }
    }

    /// Handles the next angle, and passes each sweep that has ended to `show`.
    pub fn take_angle(&mut self, angle: Angle, mut show: impl FnMut(&Sweep<'_>)) {
        let before_ns = self.angles.last_ns();
        match self.angles.take(angle, self.scan_ns, &self.settings, &mut self.counts) {
            AngleUpdate::Dropped => return,
            AngleUpdate::Interrupted => {
                self.reversals.reset();
                if self.angles.problem() == Some(DropReason::Jumped) {
                    self.analyzer.mark_unreliable();
                }
                self.interrupt_sweep(before_ns.unwrap_or(self.angles.true_ns(angle.stamp_ns)));
            }
            AngleUpdate::Moved => {
                match self.reversals.take(angle.stamp_ns, angle.angle_rad, &self.settings) {
                    SwingEvent::Nothing => {}
                    SwingEvent::Reversed(stamp_ns) => {
                        self.ends.push_back(SweepEnd {
                            stamp_ns: self.angles.true_ns(stamp_ns),
                            is_reversal: true,
                        });
                    }
                    SwingEvent::Standing(stamp_ns) => {
                        self.angles.mark_standing(stamp_ns);
                        let since_ns = self.angles.true_ns(stamp_ns);
                        let before = self.rays.len();
                        self.rays.retain(|ray| ray.time_ns <= since_ns);
                        self.counts.points_dropped[DropReason::Standing as usize] +=
                            (before - self.rays.len()) as u64;
                        self.interrupt_sweep(since_ns);
                    }
                }
            }
        }
        self.counts.angles += 1;
        self.advance(&mut show);
    }

    /// Handles the next scan, and passes each sweep that has ended to `show`. `stamp_ns` is the first stamp in the
    /// scan's header.
    pub fn take_scan(&mut self, stamp_ns: u64, scan: &Scan, mut show: impl FnMut(&Sweep<'_>)) {
        if let Some(last_ns) = self.scan_ns.filter(|&last_ns| stamp_ns <= last_ns) {
            if last_ns - stamp_ns < CLOCK_JUMP_NS {
                self.counts.out_of_order += 1;
                return;
            }
            self.reset();
        }
        self.fit(scan);
        self.scan_ns = Some(stamp_ns);
        let mut copy = self.spare_scans.pop().unwrap_or_else(|| scan.boxed());
        Scan::grow(&mut copy, scan.bytes().len());
        copy.copy_from(scan.bytes());
        let times = (0..scan.beams()).map(|beam| stamp_ns.saturating_add_signed(scan.beam_ns(beam)));
        self.waiting.push_back(PendingScan {
            stamp_ns,
            until_ns: times.max().unwrap_or(stamp_ns),
            scan: copy,
        });
        self.advance(&mut show);
    }

    /// Restarts after the clock was set back.
    fn reset(&mut self) {
        self.spare_scans.extend(self.waiting.drain(..).map(|one| one.scan));
        self.rays.clear();
        self.ends.clear();
        self.reversals.reset();
        self.delay.reset();
        (self.taken_ns, self.is_whole) = (0, false);
    }

    /// Restarts with a new background if the shape of the scans has changed.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams(), scan.first_angle, scan.step);
        if shape != self.shape {
            self.analyzer.begin(shape.0, self.shape.0 == 0);
            self.delay.reset();
            // Drop the beams of earlier scans, because they have other directions.
            self.rays.clear();
            self.spare_scans.extend(self.waiting.drain(..).map(|one| one.scan));
            self.is_whole = false;
            self.shape = shape;
        }
    }

    /// Ends the sweep at `stamp_ns` without a reversal, because the mount's angle is unknown after this time, or
    /// because the sweep has too many beams.
    fn interrupt_sweep(&mut self, stamp_ns: u64) {
        if self.ends.back().is_none_or(|end| end.is_reversal || end.stamp_ns < stamp_ns) {
            self.ends.push_back(SweepEnd { stamp_ns, is_reversal: false });
        }
    }

    fn advance(&mut self, show: &mut impl FnMut(&Sweep<'_>)) {
        while let Some(first) = self.waiting.front() {
            let newest_ns = self.scan_ns.unwrap_or(first.stamp_ns);
            let is_over =
                newest_ns - first.stamp_ns > self.settings.delay_ns || self.waiting.len() > MAX_WAITING_SCANS;
            if !is_over && self.angles.at(first.until_ns) == AngleLookup::Open {
                break;
            }
            if let Some(one) = self.waiting.pop_front() {
                self.assign_angles(&one);
                self.spare_scans.push(one.scan);
            }
            self.finish(show);
        }
        self.finish(show);
    }

    /// Determines the mount's angle for each beam of a scan.
    fn assign_angles(&mut self, one: &PendingScan) {
        let unit_m = f64::from(one.scan.unit_um) * 1e-6;
        for (beam, &value) in one.scan.ranges().iter().enumerate() {
            let is_far = value == one.scan.no_return || value == one.scan.beyond;
            let range_m = match one.scan.range(beam) {
                Some(range) => (f64::from(range) * unit_m) as f32,
                None if is_far => f32::INFINITY,
                None => continue,
            };
            let time_ns = one.stamp_ns.saturating_add_signed(one.scan.beam_ns(beam));
            let reason = match self.angles.at(time_ns) {
                AngleLookup::Known(angle_rad) => {
                    let beam_rad = one.scan.angle(beam);
                    self.rays.push(Ray { time_ns, angle_rad, beam_rad, range_m, beam: beam as u16 });
                    continue;
                }
                AngleLookup::Never(reason) => reason,
                AngleLookup::Open => DropReason::Silent,
            };
            self.is_whole = false;
            self.counts.points_dropped[reason as usize] += u64::from(!is_far);
        }
        self.counts.scans += 1;
        self.taken_ns = self.taken_ns.max(one.until_ns);
        if self.rays.len() > MAX_RAYS {
            self.interrupt_sweep(self.taken_ns);
        } else if self.angles.last_ns().is_some_and(|last_ns| last_ns < one.until_ns) {
            // The scan has waited for angles that did not arrive.
            self.interrupt_sweep(self.angles.last_ns().unwrap_or(0));
        }
    }

    /// Passes all sweeps that have ended to `show`.
    fn finish(&mut self, show: &mut impl FnMut(&Sweep<'_>)) {
        while let Some(end) = self.ends.front().copied().filter(|end| end.stamp_ns <= self.taken_ns) {
            self.ends.pop_front();
            let TiltScanner { rays, next_rays: later, .. } = self;
            later.clear();
            later.extend(rays.iter().filter(|ray| ray.time_ns > end.stamp_ns));
            rays.retain(|ray| ray.time_ns <= end.stamp_ns);
            let is_next_whole = self.rays.is_empty() || self.show(end, show);
            std::mem::swap(&mut self.rays, &mut self.next_rays);
            (self.from_ns, self.is_whole) = (end.stamp_ns, end.is_reversal && is_next_whole);
        }
    }

    /// Adds `more_ns` to the delay of the angles' stamps. Then corrects the beams' angles in this sweep and the next
    /// one. Returns for each of these two sweeps whether it still has all beams. The angles of the first beams may no
    /// longer be stored, and the angles of the last beams may not have arrived yet.
    fn correct(&mut self, more_ns: i64) -> [bool; 2] {
        self.angles.correct(more_ns);
        let TiltScanner { angles, rays, next_rays: later, ends, counts, .. } = self;
        let is_whole = [rays, later].map(|rays| {
            let before = rays.len();
            rays.retain_mut(|ray| match angles.at(ray.time_ns) {
                AngleLookup::Known(angle_rad) => {
                    ray.angle_rad = angle_rad;
                    true
                }
                _ => false,
            });
            counts.points_dropped[DropReason::Silent as usize] += (before - rays.len()) as u64;
            before == rays.len()
        });
        ends.iter_mut().for_each(|end| end.stamp_ns = end.stamp_ns.saturating_add_signed(-more_ns));
        self.delay.reset();
        self.analyzer.correct();
        is_whole
    }

    /// Passes the sweep that ends at `end` to `show`. Returns whether the next sweep has all beams so far.
    fn show(&mut self, end: SweepEnd, show: &mut impl FnMut(&Sweep<'_>)) -> bool {
        let mut is_next_whole = true;
        let mut sweep = Sweep {
            number: self.counts.sweeps as u32,
            from_ns: self.from_ns,
            until_ns: end.stamp_ns,
            is_complete: self.is_whole && end.is_reversal,
            ..Sweep::default()
        };
        let span = (sweep.from_ns, sweep.until_ns);
        if let Some(late_s) = self.delay.take(&self.rays, self.shape.0, span, sweep.is_complete) {
            let more_ns = (late_s * 1e9) as i64;
            let all_s = 1e-9 * (self.angles.late_ns() + more_ns) as f64;
            if all_s.abs() < MAX_DELAY_S {
                let [is_whole, is_whole_next] = self.correct(more_ns);
                (sweep.is_complete, is_next_whole) = (sweep.is_complete && is_whole, is_whole_next);
            }
        }
        sweep.late_ns = self.angles.late_ns();
        let sweep = self.analyzer.analyze(&self.rays, sweep);
        self.counts.points += sweep.points.len() as u64;
        self.counts.sweeps += 1;
        self.counts.incomplete += u64::from(!sweep.is_complete);
        self.counts.unreliable += u64::from(sweep.is_unreliable);
        show(&sweep);
        is_next_whole
    }
}

/// Point at the end of a beam.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// Position in the robot's frame in meters: forward, to the left, above the floor.
    pub at: [f32; 3],
    /// Time of the measurement in ns.
    pub stamp_ns: u64,
    /// Index of the beam in its scan.
    pub beam: u16,
    /// Class of the point, from a comparison with the background as it was before this sweep.
    pub class: PointClass,
}

/// A sweep: the points between two reversals of the mount.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sweep<'a> {
    /// Number of the sweep, starting at 0.
    pub number: u32,
    /// Time of the start in ns.
    pub from_ns: u64,
    /// Time of the end in ns.
    pub until_ns: u64,
    /// Whether the sweep lasts from one reversal to the next, and every beam had a reliable angle.
    pub is_complete: bool,
    /// Whether the angles are unreliable because they contradict the background. All points of an unreliable sweep have
    /// class unknown, and it has no obstacles.
    pub is_unreliable: bool,
    /// Generation of the background with which the points were compared. Each reset increases it by 1.
    pub generation: u32,
    /// Delay of the angles' stamps by which the angles were corrected, in ns.
    pub late_ns: i64,
    /// Points in the order of their scans.
    pub points: &'a [Point],
    /// Obstacles, the nearest first.
    pub obstacles: &'a [Obstacle],
    /// Number of obstacles that were dropped because the sweep has more than [`MAX_OBSTACLES`] of them.
    pub dropped: u32,
}

/// Parameters of sweeps, background and obstacles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Maximum time for which a scan waits for the angles of its beams, in ns. This time is measured by the stamps of
    /// later scans.
    pub delay_ns: u64,
    /// Maximum time between two angles for interpolation, in ns.
    pub gap_ns: u64,
    /// Maximum speed of a mount in rad/s. A faster change counts as a jump of the mount's encoder.
    pub max_speed_rad_s: f64,
    /// Maximum difference between the speed computed from two angles and the rates in the samples of these angles, in
    /// rad/s.
    pub rate_rad_s: f64,
    /// Time without a jump after which angles are reliable again, in ns.
    pub settle_ns: u64,
    /// Minimum change of the angle in the opposite direction that counts as a reversal, in radians.
    pub reversal_rad: f64,
    /// Time in ns after which the mount counts as standing, if its angle changes by less than a tenth of
    /// [`reversal_rad`](Self::reversal_rad).
    pub standing_ns: u64,
    /// Width of a cell of the background, in radians of the mount's angle.
    pub bin_rad: f64,
    /// Minimum distance of foreground from the background, in meters.
    pub threshold_m: f64,
    /// Number of sweeps whose beams must meet a surface before it becomes background.
    pub sweeps: u16,
    /// Maximum share of beams whose range differs from the background, among the beams of a sweep whose background is
    /// known. If the share is larger, the sweep contradicts the background.
    pub max_displaced_share: f64,
    /// Maximum error of the angles in a part of a sweep, in radians, measured on the floor. If the error is larger, the
    /// sweep contradicts the background.
    pub max_error_rad: f64,
    /// Minimum number of points of an obstacle.
    pub points: usize,
    /// Edge length of the cubes that connect the points of an obstacle, in meters.
    pub cube_m: f64,
    /// Box in which every object is an obstacle, even if it is background: minimum and maximum x, y and z in the
    /// robot's frame.
    pub near: Option<[[f64; 2]; 3]>,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            delay_ns: 300_000_000,
            gap_ns: 100_000_000,
            max_speed_rad_s: 180_f64.to_radians(),
            rate_rad_s: 10_f64.to_radians(),
            settle_ns: 500_000_000,
            reversal_rad: 2_f64.to_radians(),
            standing_ns: 400_000_000,
            bin_rad: 1_f64.to_radians(),
            threshold_m: 0.06,
            sweeps: 5,
            max_displaced_share: 0.3,
            max_error_rad: 0.25_f64.to_radians(),
            points: 8,
            cube_m: 0.15,
            near: None,
        }
    }
}
