//! From scans and angles to sweeps: each beam gets the mount's angle at its own time, and what was measured between two turns
//! of the mount is looked at together. Refuses to know how points are sent.

use std::collections::VecDeque;

use scanhub_schema::Scan;

use crate::tilt::angles::{Angle, Angles, At, Step, Withheld};
use crate::tilt::delay::{Delay, MOST_S};
use crate::tilt::mount::Mount;
use crate::tilt::scenery::{Ray, Scenery};
use crate::tilt::settings::Settings;
use crate::tilt::sweep::Sweep;
use crate::tilt::swing::{Swing, Told};

/// Scans that may wait for angles: with one more the oldest is taken at once.
const WAITING: usize = 64;
/// Beams of a sweep, after which it ends though the mount has not turned.
const RAYS: usize = 262_144;
/// A scan so far before the last one is of a clock that was set back.
const JUMP_NS: u64 = 1_000_000_000;
/// What was taken, made and left out, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Scans that were taken.
    pub scans: u64,
    /// Scans that came after later ones; they were left out.
    pub unordered: u64,
    /// Points that were made.
    pub points: u64,
    /// Beams with a reading that became no points, by [`Withheld`].
    pub withheld: [u64; Withheld::COUNT],
    /// Angles that were taken.
    pub angles: u64,
    /// Angles that came after later ones; they were left out.
    pub angles_unordered: u64,
    /// Angles with stamps ahead of all scans; they were left out.
    pub angles_ahead: u64,
    /// Angles that are no numbers.
    pub angles_unfit: u64,
    /// Sweeps that were handed out.
    pub sweeps: u64,
    /// Of these, those that are not complete.
    pub incomplete: u64,
    /// Of these, those that contradict the background.
    pub doubted: u64,
    /// How often the background was forgotten, because scans changed or sweeps contradicted it too long.
    pub forgotten: u64,
}

struct Waiting {
    stamp_ns: u64,
    /// When its last beam was measured.
    until_ns: u64,
    scan: Box<Scan>,
}

/// Where a sweep ends.
#[derive(Clone, Copy)]
struct End {
    stamp_ns: u64,
    /// The mount turned; else its way is not known from here.
    is_turn: bool,
}

/// A scanner on a mount.
pub struct Tilting {
    settings: Settings,
    angles: Angles,
    swing: Swing,
    waiting: VecDeque<Waiting>,
    spare: Vec<Box<Scan>>,
    /// Stamp of the last scan.
    scan_ns: Option<u64>,
    /// When the last beam of those that were looked at was measured.
    taken_ns: u64,
    ends: VecDeque<End>,
    rays: Vec<Ray>,
    later: Vec<Ray>,
    scenery: Scenery,
    delay: Delay,
    /// Beams, first angle and step of the scans.
    shape: (usize, f64, f64),
    from_ns: u64,
    /// The sweep began at a turn, and nothing of it is missing so far.
    is_whole: bool,
    counts: Counts,
}

impl Tilting {
    /// One that has seen nothing.
    pub fn new(mount: Mount, settings: Settings) -> Tilting {
        Tilting {
            settings,
            angles: Angles::new(),
            swing: Swing::default(),
            waiting: VecDeque::with_capacity(WAITING + 1),
            spare: Vec::new(),
            scan_ns: None,
            taken_ns: 0,
            ends: VecDeque::new(),
            rays: Vec::new(),
            later: Vec::new(),
            scenery: Scenery::new(mount, settings),
            delay: Delay::default(),
            shape: (0, 0.0, 0.0),
            from_ns: 0,
            is_whole: false,
            counts: Counts::default(),
        }
    }

    /// Returns what was taken, made and left out.
    pub fn counts(&self) -> Counts {
        let dropped = self.angles.dropped;
        Counts {
            angles_unordered: dropped.unordered,
            angles_ahead: dropped.ahead,
            angles_unfit: dropped.unfit,
            forgotten: self.scenery.forgotten,
            ..self.counts
        }
    }

    /// Returns how much later than its angles the stamps of the mount are, in ns, as up and down sweeps show. All angles are
    /// corrected by it.
    pub fn late_ns(&self) -> i64 {
        self.angles.late_ns()
    }

    /// Returns why beams that are measured now will make no points; nothing if they will.
    pub fn trouble(&self) -> Option<Withheld> {
        let late_ns = self.scan_ns.unwrap_or(0).saturating_sub(self.settings.delay_ns);
        let is_silent = self.angles.last_ns().is_none_or(|last_ns| last_ns < late_ns);
        if is_silent { Some(Withheld::Silent) } else { self.angles.trouble() }
    }

    /// Takes the next angle, and hands each sweep that is over to `show`.
    pub fn take_angle(&mut self, angle: Angle, mut show: impl FnMut(&Sweep<'_>)) {
        let before_ns = self.angles.last_ns();
        match self.angles.take(angle, self.scan_ns, &self.settings) {
            Step::Dropped => return,
            Step::Torn => {
                self.swing.forget();
                if self.angles.trouble() == Some(Withheld::Jumped) {
                    self.scenery.distrust();
                }
                self.tear(before_ns.unwrap_or(self.angles.true_ns(angle.stamp_ns)));
            }
            Step::On => match self.swing.take(angle.stamp_ns, angle.angle_rad, &self.settings) {
                Told::Nothing => {}
                Told::Turned(stamp_ns) => {
                    self.ends.push_back(End { stamp_ns: self.angles.true_ns(stamp_ns), is_turn: true });
                }
                Told::Stands(stamp_ns) => {
                    self.angles.stand_since(stamp_ns);
                    let since_ns = self.angles.true_ns(stamp_ns);
                    let before = self.rays.len();
                    self.rays.retain(|ray| ray.time_ns <= since_ns);
                    self.counts.withheld[Withheld::Standing as usize] += (before - self.rays.len()) as u64;
                    self.tear(since_ns);
                }
            },
        }
        self.counts.angles += 1;
        self.advance(&mut show);
    }

    /// Takes the next scan with its header's first stamp, and hands each sweep that is over to `show`.
    pub fn take_scan(&mut self, stamp_ns: u64, scan: &Scan, mut show: impl FnMut(&Sweep<'_>)) {
        if let Some(last_ns) = self.scan_ns.filter(|&last_ns| stamp_ns <= last_ns) {
            if last_ns - stamp_ns < JUMP_NS {
                self.counts.unordered += 1;
                return;
            }
            self.begin_anew();
        }
        self.fit(scan);
        self.scan_ns = Some(stamp_ns);
        let mut copy = self.spare.pop().unwrap_or_else(|| scan.boxed());
        Scan::grow(&mut copy, scan.bytes().len());
        copy.copy_from(scan.bytes());
        let times = (0..scan.beams()).map(|beam| stamp_ns.saturating_add_signed(scan.beam_ns(beam)));
        self.waiting.push_back(Waiting { stamp_ns, until_ns: times.max().unwrap_or(stamp_ns), scan: copy });
        self.advance(&mut show);
    }

    /// The time is another one.
    fn begin_anew(&mut self) {
        self.spare.extend(self.waiting.drain(..).map(|one| one.scan));
        self.rays.clear();
        self.ends.clear();
        self.swing.forget();
        self.delay.forget();
        (self.taken_ns, self.is_whole) = (0, false);
    }

    /// Scans of another shape have another background.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams(), scan.first_angle, scan.step);
        if shape != self.shape {
            self.scenery.begin(shape.0, self.shape.0 == 0);
            self.delay.forget();
            // Beams of the old shape have other directions.
            self.rays.clear();
            self.spare.extend(self.waiting.drain(..).map(|one| one.scan));
            self.is_whole = false;
            self.shape = shape;
        }
    }

    /// From `stamp_ns` on the way is not known.
    fn tear(&mut self, stamp_ns: u64) {
        if self.ends.back().is_none_or(|end| end.is_turn || end.stamp_ns < stamp_ns) {
            self.ends.push_back(End { stamp_ns, is_turn: false });
        }
    }

    fn advance(&mut self, show: &mut impl FnMut(&Sweep<'_>)) {
        while let Some(first) = self.waiting.front() {
            let newest_ns = self.scan_ns.unwrap_or(first.stamp_ns);
            let is_over = newest_ns - first.stamp_ns > self.settings.delay_ns || self.waiting.len() > WAITING;
            if !is_over && self.angles.at(first.until_ns) == At::Open {
                break;
            }
            if let Some(one) = self.waiting.pop_front() {
                self.look_at(&one);
                self.spare.push(one.scan);
            }
            self.finish(show);
        }
        self.finish(show);
    }

    /// Gives the beams of a scan their angles.
    fn look_at(&mut self, one: &Waiting) {
        let unit_m = f64::from(one.scan.unit_um) * 1e-6;
        for (beam, &value) in one.scan.ranges().iter().enumerate() {
            let is_far = value == one.scan.no_return || value == one.scan.beyond;
            let range_m = match one.scan.range(beam) {
                Some(range) => (f64::from(range) * unit_m) as f32,
                None if is_far => f32::INFINITY,
                None => continue,
            };
            let time_ns = one.stamp_ns.saturating_add_signed(one.scan.beam_ns(beam));
            let why = match self.angles.at(time_ns) {
                At::Known(angle_rad) => {
                    let beam_rad = one.scan.angle(beam);
                    self.rays.push(Ray { time_ns, angle_rad, beam_rad, range_m, beam: beam as u16 });
                    continue;
                }
                At::Never(why) => why,
                At::Open => Withheld::Silent,
            };
            self.is_whole = false;
            self.counts.withheld[why as usize] += u64::from(!is_far);
        }
        self.counts.scans += 1;
        self.taken_ns = self.taken_ns.max(one.until_ns);
        if self.rays.len() > RAYS {
            self.tear(self.taken_ns);
        } else if self.angles.last_ns().is_some_and(|last_ns| last_ns < one.until_ns) {
            // It waited for angles that did not come.
            self.tear(self.angles.last_ns().unwrap_or(0));
        }
    }

    /// Ends the sweeps that are over.
    fn finish(&mut self, show: &mut impl FnMut(&Sweep<'_>)) {
        while let Some(end) = self.ends.front().copied().filter(|end| end.stamp_ns <= self.taken_ns) {
            self.ends.pop_front();
            let Tilting { rays, later, .. } = self;
            later.clear();
            later.extend(rays.iter().filter(|ray| ray.time_ns > end.stamp_ns));
            rays.retain(|ray| ray.time_ns <= end.stamp_ns);
            let is_next_whole = self.rays.is_empty() || self.show(end, show);
            std::mem::swap(&mut self.rays, &mut self.later);
            (self.from_ns, self.is_whole) = (end.stamp_ns, end.is_turn && is_next_whole);
        }
    }

    /// Adds `more_ns` to the delay of the angles' stamps, and gives the beams of this sweep and the next one their corrected
    /// angles. Returns whether each of the two still has all beams: the angles of the first ones may be forgotten, and those of
    /// the last ones may not have arrived.
    fn correct(&mut self, more_ns: i64) -> [bool; 2] {
        self.angles.correct(more_ns);
        let Tilting { angles, rays, later, ends, counts, .. } = self;
        let is_whole = [rays, later].map(|rays| {
            let before = rays.len();
            rays.retain_mut(|ray| match angles.at(ray.time_ns) {
                At::Known(angle_rad) => {
                    ray.angle_rad = angle_rad;
                    true
                }
                _ => false,
            });
            counts.withheld[Withheld::Silent as usize] += (before - rays.len()) as u64;
            before == rays.len()
        });
        ends.iter_mut().for_each(|end| end.stamp_ns = end.stamp_ns.saturating_add_signed(-more_ns));
        self.delay.forget();
        self.scenery.correct();
        is_whole
    }

    /// Passes the sweep until `end` to `show`. Returns whether the next sweep has all beams so far.
    fn show(&mut self, end: End, show: &mut impl FnMut(&Sweep<'_>)) -> bool {
        let mut is_next_whole = true;
        let mut sweep = Sweep {
            number: self.counts.sweeps as u32,
            from_ns: self.from_ns,
            until_ns: end.stamp_ns,
            is_complete: self.is_whole && end.is_turn,
            ..Sweep::default()
        };
        let span = (sweep.from_ns, sweep.until_ns);
        if let Some(late_s) = self.delay.take(&self.rays, self.shape.0, span, sweep.is_complete) {
            let more_ns = (late_s * 1e9) as i64;
            let all_s = 1e-9 * (self.angles.late_ns() + more_ns) as f64;
            if all_s.abs() < MOST_S {
                let [is_whole, is_whole_next] = self.correct(more_ns);
                (sweep.is_complete, is_next_whole) = (sweep.is_complete && is_whole, is_whole_next);
            }
        }
        sweep.late_ns = self.angles.late_ns();
        let sweep = self.scenery.look(&self.rays, sweep);
        self.counts.points += sweep.points.len() as u64;
        self.counts.sweeps += 1;
        self.counts.incomplete += u64::from(!sweep.is_complete);
        self.counts.doubted += u64::from(sweep.is_doubted);
        show(&sweep);
        is_next_whole
    }
}
