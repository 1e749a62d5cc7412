//! From scans and angles to sweeps: each beam gets the mount's angle at its own time, and what was measured between two turns
//! of the mount is looked at together. Refuses to know how points are sent.

use std::collections::VecDeque;

use schema::Scan;

use crate::angles::{Angle, Angles, At, Step, Withheld};
use crate::background::{Model, Reading, placed};
use crate::mount::Mount;
use crate::obstacles::{Clusters, Obstacle};
use crate::settings::Settings;
use crate::sweep::{Class, Point, Sweep};
use crate::swing::{Swing, Told};

/// Scans that may wait for angles: with one more the oldest is taken at once.
const WAITING: usize = 64;
/// Beams of a sweep, after which it ends though the mount has not turned.
const RAYS: usize = 262_144;
/// A scan so far before the last one is of a clock that was set back.
const JUMP_NS: u64 = 1_000_000_000;
/// Parts of a sweep whose angles are judged each for itself.
const PARTS: usize = 4;
/// With fewer beams on known background nothing can be doubted.
const ENOUGH: usize = 200;

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

/// A beam whose angle is known.
#[derive(Clone, Copy)]
struct Ray {
    time_ns: u64,
    angle_rad: f64,
    beam_rad: f64,
    /// Infinite if nothing came back.
    range_m: f32,
    beam: u16,
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
    mount: Mount,
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
    points: Vec<Point>,
    /// What each beam on a level surface tells of the angles.
    off: Vec<f32>,
    standing: Vec<([f32; 3], u8)>,
    clusters: Clusters,
    model: Model,
    /// Beams, first angle and step of the scans.
    shape: (usize, f64, f64),
    from_ns: u64,
    /// The sweep began at a turn, and nothing of it is missing so far.
    is_whole: bool,
    /// The floor was where the angles say, or they have never jumped.
    is_confirmed: bool,
    /// Sweeps in a row that were doubted.
    doubted: u16,
    counts: Counts,
}

impl Tilting {
    /// One that has seen nothing.
    pub fn new(mount: Mount, settings: Settings) -> Tilting {
        Tilting {
            mount,
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
            points: Vec::new(),
            off: Vec::new(),
            standing: Vec::new(),
            clusters: Clusters::default(),
            model: Model::new(0, &settings),
            shape: (0, 0.0, 0.0),
            from_ns: 0,
            is_whole: false,
            is_confirmed: true,
            doubted: 0,
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
            ..self.counts
        }
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
                self.is_confirmed &= self.angles.trouble() != Some(Withheld::Jumped);
                self.tear(before_ns.unwrap_or(angle.stamp_ns));
            }
            Step::On => match self.swing.take(angle.stamp_ns, angle.angle_rad, &self.settings) {
                Told::Nothing => {}
                Told::Turned(stamp_ns) => self.ends.push_back(End { stamp_ns, is_turn: true }),
                Told::Stands(since_ns) => {
                    self.angles.stand_since(since_ns);
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
        (self.taken_ns, self.is_whole) = (0, false);
    }

    /// Scans of another shape have another background.
    fn fit(&mut self, scan: &Scan) {
        let shape = (scan.beams(), scan.first_angle, scan.step);
        if shape != self.shape {
            self.counts.forgotten += u64::from(self.shape.0 > 0);
            self.model = Model::new(shape.0, &self.settings);
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
            if !self.rays.is_empty() {
                self.show(end, show);
            }
            std::mem::swap(&mut self.rays, &mut self.later);
            (self.from_ns, self.is_whole) = (end.stamp_ns, end.is_turn);
        }
    }

    /// Hands out what was measured until `end`.
    fn show(&mut self, end: End, show: &mut impl FnMut(&Sweep<'_>)) {
        let (known, elsewhere) = self.compare();
        let is_elsewhere = known >= ENOUGH && elsewhere as f64 > self.settings.doubt * known as f64;
        let is_contradicted = is_elsewhere || self.is_angle_off();
        // What jumped is believed when the floor is back in its place.
        self.is_confirmed |= !is_contradicted && self.off.len() >= ENOUGH;
        let is_doubted = is_contradicted || !self.is_confirmed;
        let number = self.counts.sweeps as u32;
        self.standing.clear();
        let generation = self.counts.forgotten as u32;
        if is_doubted {
            self.points.iter_mut().for_each(|point| point.class = Class::Unknown);
            self.doubted += 1;
        } else {
            self.learn(number);
            self.pick();
            self.doubted = 0;
        }
        if self.doubted > 2 * self.settings.sweeps {
            self.model.forget();
            self.counts.forgotten += 1;
            (self.doubted, self.is_confirmed) = (0, true);
        }
        let (obstacles, left_out) =
            self.clusters.find(&self.standing, self.settings.cube_m as f32, self.settings.points);
        let is_complete = self.is_whole && end.is_turn;
        self.counts.points += self.points.len() as u64;
        self.counts.sweeps += 1;
        self.counts.incomplete += u64::from(!is_complete);
        self.counts.doubted += u64::from(is_doubted);
        show(&Sweep {
            number,
            from_ns: self.from_ns,
            until_ns: end.stamp_ns,
            is_complete,
            is_doubted,
            generation,
            points: &self.points,
            obstacles,
            left_out,
        });
    }

    /// Returns whether the level surfaces of the background are where they would be if the angles of a part of the sweep were
    /// off.
    fn is_angle_off(&mut self) -> bool {
        let most = self.settings.off_rad as f32;
        let part = (self.off.len() / PARTS).max(ENOUGH);
        let is_off = |part: &mut [f32]| {
            let middle = part.len() / 2;
            part.select_nth_unstable_by(middle, f32::total_cmp).1.abs() > most
        };
        self.off.chunks_exact_mut(part).any(is_off)
    }

    /// Makes points of the rays; returns how many met known background or should have, and how many did not.
    fn compare(&mut self) -> (usize, usize) {
        self.points.clear();
        self.off.clear();
        let threshold_m = self.settings.threshold_m as f32;
        let (mut known, mut elsewhere) = (0, 0);
        for ray in &self.rays {
            let (row, reading) = ray.reading(&self.mount, &self.settings);
            let class = self.model.class(&reading, row, threshold_m);
            self.off.extend(self.model.angle_off(&reading, row, threshold_m));
            if self.model.knows(&reading, row) {
                known += 1;
                elsewhere += usize::from(class != Class::Background);
            }
            if ray.range_m.is_finite() {
                let at = self.mount.point(ray.angle_rad, ray.beam_rad, ray.range_m.into());
                let at = at.map(|value| value as f32);
                self.points.push(Point { at, stamp_ns: ray.time_ns, beam: ray.beam, class });
            }
        }
        (known, elsewhere)
    }

    fn learn(&mut self, number: u32) {
        for ray in &self.rays {
            let (row, reading) = ray.reading(&self.mount, &self.settings);
            self.model.learn(&reading, row, number, &self.settings);
        }
    }

    /// Picks what may be of obstacles.
    fn pick(&mut self) {
        let near = self.settings.near;
        for point in &self.points {
            let within = |near: &[[f64; 2]; 3]| {
                near.iter().zip(point.at).all(|(span, value)| (span[0]..=span[1]).contains(&f64::from(value)))
            };
            let is_foreground = point.class == Class::Foreground;
            let flags = if is_foreground { Obstacle::FOREGROUND } else { 0 }
                | if near.as_ref().is_some_and(within) { Obstacle::NEAR } else { 0 };
            if flags != 0 {
                self.standing.push((point.at, flags));
            }
        }
    }
}

impl Ray {
    /// The row of the background that it is compared with, and how.
    fn reading(&self, mount: &Mount, settings: &Settings) -> (usize, Reading) {
        placed(mount, settings, (self.angle_rad, self.beam_rad), self.beam, self.range_m)
    }
}
