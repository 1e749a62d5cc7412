//! Detection of reflectors. Neighboring beams with a raised intensity become one mark, at their average position
//! weighted by intensity (paper III.B.2).

use std::f64::consts::{PI, TAU};

use scanhub_schema::{ArrayFlags, Family, Intensities, MAX_MARKS, Mark, Marks, Scan, in_degrees};

use crate::directions::exact_angle;
use crate::search::position;

/// Settings of a mark detector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Minimum intensity of a beam in a mark, for scanners whose intensities are reflector levels. 0 counts as 1.
    pub min_level: u8,
    /// Minimum intensity of a beam in a mark, for other scanners. 0 counts as 1. If it is `None`, scans of other
    /// scanners have no marks.
    pub level: Option<u16>,
    /// Maximum difference between the ranges of neighboring beams in a mark, in mm.
    pub max_range_step_mm: u16,
    /// Maximum number of consecutive beams inside a mark that have no range or not enough intensity.
    pub max_gap: u16,
}

impl Settings {
    /// Settings of the paper.
    pub const PAPER: Settings = Settings { min_level: 1, level: None, max_range_step_mm: 100, max_gap: 0 };
}

impl Default for Settings {
    fn default() -> Self {
        Settings::PAPER
    }
}

/// Finds the marks of each scan. The marks of a scan do not depend on earlier scans.
pub struct MarkDetector {
    settings: Settings,
}

impl MarkDetector {
    /// Creates a detector with these `settings`.
    pub const fn new(settings: Settings) -> MarkDetector {
        MarkDetector { settings }
    }

    /// Writes the marks of `scan` into `out`. Writes every byte of `out`.
    pub fn update(&mut self, scan: &Scan, out: &mut Marks) {
        (out.count, out.flags, out.reserved) = (0, 0, 0);
        match self.min_intensity(scan) {
            Ok(min_intensity) => self.find(scan, min_intensity, out),
            Err(unavailable) => out.flags = unavailable,
        }
        out.mark_array[usize::from(out.count)..].fill(Mark::default());
    }

    /// Returns the minimum intensity of a beam in a mark of `scan`. If `scan` cannot have marks, returns the reason as
    /// flags of [`Marks`].
    fn min_intensity(&self, scan: &Scan) -> Result<u16, u8> {
        // The scanner's measuring mode must have intensities, and the scan must contain them.
        if scan.intensity_bits == 0 || scan.contents & (ArrayFlags::UPPER | ArrayFlags::WIDE) == 0 {
            return Err(Marks::UNAVAILABLE);
        }
        if Family::of_number(scan.family).is_some_and(Family::has_reflector_levels) {
            return Ok(u16::from(self.settings.min_level.max(1)));
        }
        self.settings.level.map(|level| level.max(1)).ok_or(Marks::UNAVAILABLE | Marks::NO_LEVEL)
    }

    /// Writes the marks into `out`. Each beam of a mark has at least the intensity `min_intensity`.
    fn find(&self, scan: &Scan, min_intensity: u16, out: &mut Marks) {
        let (mut count, mut overflow) = (0, false);
        let mut push = |open: &OpenMark| match out.mark_array.get_mut(count) {
            Some(mark) => {
                *mark = open.mark(scan);
                count += 1;
            }
            None => overflow = true,
        };
        let unit_um = scan.unit_um;
        let intensities = scan.intensities();
        let mut open: Option<OpenMark> = None;
        let mut next = 0;
        while let Some(i) =
            if open.is_some() { Some(next) } else { first_bright(&intensities, next, min_intensity) }
            && let Some(intensity) = intensities.get(i)
        {
            next = i + 1;
            match (scan.range(i).filter(|_| intensity >= min_intensity), &mut open) {
                (Some(value), Some(mark)) if mark.is_near(value, unit_um, &self.settings) => {
                    mark.join(scan, i, value, intensity);
                }
                (Some(value), _) => {
                    open.replace(OpenMark::at(scan, i, value, intensity)).inspect(&mut push);
                }
                (None, Some(mark)) => {
                    mark.gap += 1;
                    if mark.gap > u32::from(self.settings.max_gap) {
                        open.take().inspect(&mut push);
                    }
                }
                (None, None) => {}
            }
        }
        open.inspect(&mut push);
        out.count = count as u8;
        out.flags = if overflow { Marks::OVERFLOW } else { 0 };
    }
}

/// Returns the first beam from `from` on that has at least the intensity `min_intensity`, or `None` if there is none.
fn first_bright(intensities: &Intensities<'_>, from: usize, min_intensity: u16) -> Option<usize> {
    match intensities {
        Intensities::Narrow(values) => {
            let min_intensity = u8::try_from(min_intensity).ok()?;
            position(values, from, |value| value >= min_intensity)
        }
        Intensities::Wide(values) => position(values, from, |value| value >= min_intensity),
    }
}

/// Mark to which more beams may be added, as sums over its beams. The sums are integers, so that they are the same on
/// every machine. The weight of a beam is its intensity.
#[derive(Clone, Copy, Default)]
struct OpenMark {
    /// Sum of the weights.
    weight: u64,
    /// Sum of the products of weight and index of each beam.
    beams: u64,
    /// Sum of the products of weight and [`offset_udeg`] of each beam, in millionths of a degree.
    offset_udeg: i64,
    /// Sum of the products of weight and range of each beam, in device units.
    ranges: u64,
    last_range: u16,
    peak: u16,
    gap: u32,
    first_beam: usize,
    last_beam: usize,
}

impl OpenMark {
    fn at(scan: &Scan, i: usize, range: u16, intensity: u16) -> OpenMark {
        let mut open = OpenMark { first_beam: i, ..OpenMark::default() };
        open.join(scan, i, range, intensity);
        open
    }

    fn is_near(&self, range: u16, unit_um: u32, settings: &Settings) -> bool {
        let apart_um = u64::from(range.abs_diff(self.last_range)) * u64::from(unit_um);
        apart_um <= 1000 * u64::from(settings.max_range_step_mm)
    }

    fn join(&mut self, scan: &Scan, i: usize, range: u16, intensity: u16) {
        let weight = u64::from(intensity);
        self.weight += weight;
        self.beams += weight * i as u64;
        self.offset_udeg += i64::from(intensity) * offset_udeg(scan, i);
        self.ranges += weight * u64::from(range);
        self.peak = self.peak.max(intensity);
        (self.last_range, self.last_beam, self.gap) = (range, i, 0);
    }

    fn mark(&self, scan: &Scan) -> Mark {
        // Integer arithmetic rounds halves the same way on every machine. The integers are so wide that no scan can
        // overflow them.
        let [first_udeg, step_udeg] =
            [scan.first_angle, scan.step].map(|angle| (1e6 * in_degrees(angle)).round() as i128);
        let weight = 1000 * i128::from(self.weight);
        let of_beams = first_udeg * i128::from(self.weight) + step_udeg * i128::from(self.beams);
        let angle = 2 * (of_beams + i128::from(self.offset_udeg)) + weight;
        let last = scan.beams() - 1;
        Mark {
            angle_mdeg: in_range_mdeg(angle.div_euclid(2 * weight)),
            range_dmm: half_up(u128::from(scan.unit_um) * u128::from(self.ranges), 100 * self.weight) as u32,
            weight: u16::try_from(self.weight).unwrap_or(u16::MAX),
            peak: u8::try_from(self.peak).unwrap_or(u8::MAX),
            edge: u8::from(self.first_beam == 0 || self.last_beam == last),
            first_beam: self.first_beam as u16,
            last_beam: self.last_beam as u16,
        }
    }
}

/// Removes whole revolutions from an angle in 1/1000 degree. The result is at least -180,000 and below 180,000.
fn in_range_mdeg(mdeg: i128) -> i32 {
    ((mdeg + 180_000).rem_euclid(360_000) - 180_000) as i32
}

/// Returns the difference between the exact angle of beam `i` and its angle at equal steps, in millionths of a degree,
/// without whole revolutions. Returns 0 if the beam has no exact angle.
fn offset_udeg(scan: &Scan, i: usize) -> i64 {
    let Some(exact) = exact_angle(scan.exact_angles(), i) else { return 0 };
    let off = exact - (scan.first_angle + i as f64 * scan.step);
    let off = (off + PI).rem_euclid(TAU) - PI;
    (1e6 * in_degrees(off)).round() as i64
}

/// Returns `sum / weight`, rounded to a whole number. Halves are rounded up.
fn half_up(sum: u128, weight: u64) -> u128 {
    let weight = u128::from(weight);
    (2 * sum + weight) / (2 * weight)
}

const _: () = assert!(MAX_MARKS <= u8::MAX as usize);
