//! Finds reflectors: neighbouring beams with a raised intensity become one mark, at their average weighted by
//! intensity (paper III.B.2). Refuses to know what a mark belongs to, and where the robot is.

use schema::{Contents, MARKS, Mark, Marks, Scan, in_degrees};

/// What makes a mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// The least intensity of a beam that belongs to a mark; 0 is 1.
    pub i_min: u8,
    /// Ranges of neighbouring beams of a mark differ by at most so much.
    pub max_range_step_mm: u16,
    /// So many beams without enough intensity or a range, one after the other, do not part a mark.
    pub max_gap: u16,
}

impl Settings {
    /// As the paper has it.
    pub const PAPER: Settings = Settings { i_min: 1, max_range_step_mm: 100, max_gap: 0 };
}

impl Default for Settings {
    fn default() -> Self {
        Settings::PAPER
    }
}

/// Finds the marks of one scan; nothing is kept from one to the next.
pub struct MarkDetector {
    settings: Settings,
}

impl MarkDetector {
    /// A finder that goes by `settings`.
    pub const fn new(settings: Settings) -> MarkDetector {
        MarkDetector { settings }
    }

    /// Writes the marks of `scan` into `out`, every byte of it.
    pub fn update(&mut self, scan: &Scan, out: &mut Marks) {
        let intensities = scan.intensities();
        let mut list = List { scan, out, count: 0, overflow: false };
        let unit_um = scan.unit_um;
        let i_min = u16::from(self.settings.i_min.max(1));
        let mut open: Option<Open> = None;
        for (i, intensity) in intensities.iter().enumerate() {
            if intensity < i_min && open.is_none() {
                continue;
            }
            match (scan.range(i).filter(|_| intensity >= i_min), &mut open) {
                (Some(value), Some(mark)) if mark.is_near(value, unit_um, &self.settings) => {
                    mark.join(i, value, intensity);
                }
                (Some(value), _) => {
                    open.replace(Open::at(i, value, intensity)).inspect(|mark| list.push(mark));
                }
                (None, Some(mark)) => {
                    mark.gap += 1;
                    if mark.gap > u32::from(self.settings.max_gap) {
                        open.take().inspect(|mark| list.push(mark));
                    }
                }
                (None, None) => {}
            }
        }
        open.inspect(|mark| list.push(mark));
        let List { count, overflow, .. } = list;
        out.count = count as u8;
        let unavailable = if is_available(scan) { 0 } else { Marks::UNAVAILABLE };
        out.flags = if overflow { Marks::OVERFLOW } else { 0 } | unavailable;
        out.reserved = 0;
        out.mark_array[count..].fill(Mark::default());
    }
}

/// The sensor's mode has reflector bits, and they came.
fn is_available(scan: &Scan) -> bool {
    scan.intensity_bits != 0 && scan.contents & (Contents::UPPER | Contents::WIDE) != 0
}

/// The marks that were closed.
struct List<'a> {
    scan: &'a Scan,
    out: &'a mut Marks,
    count: usize,
    overflow: bool,
}

impl List<'_> {
    fn push(&mut self, open: &Open) {
        match self.out.mark_array.get_mut(self.count) {
            Some(mark) => {
                *mark = open.mark(self.scan);
                self.count += 1;
            }
            None => self.overflow = true,
        }
    }
}

/// A mark that may go on: sums over its beams, in integers, so that they are the same on every machine.
#[derive(Clone, Copy)]
struct Open {
    /// Sum of w.
    weight: u64,
    /// Sum of w * i.
    beams: u64,
    /// Sum of w * r in device units.
    ranges: u64,
    last_range: u16,
    peak: u16,
    gap: u32,
    first_beam: usize,
    last_beam: usize,
}

impl Open {
    fn at(i: usize, range: u16, intensity: u16) -> Open {
        let mut open = Open {
            weight: 0,
            beams: 0,
            ranges: 0,
            last_range: range,
            peak: 0,
            gap: 0,
            first_beam: i,
            last_beam: i,
        };
        open.join(i, range, intensity);
        open
    }

    fn is_near(&self, range: u16, unit_um: u32, settings: &Settings) -> bool {
        let apart_um = u64::from(range.abs_diff(self.last_range)) * u64::from(unit_um);
        apart_um <= 1000 * u64::from(settings.max_range_step_mm)
    }

    fn join(&mut self, i: usize, range: u16, intensity: u16) {
        let weight = u64::from(intensity);
        self.weight += weight;
        self.beams += weight * i as u64;
        self.ranges += weight * u64::from(range);
        self.peak = self.peak.max(intensity);
        (self.last_range, self.last_beam, self.gap) = (range, i, 0);
    }

    fn mark(&self, scan: &Scan) -> Mark {
        // In integers, so that halves are rounded the same way on every machine; so long that nothing overflows, whatever the
        // scan says.
        let [first_udeg, step_udeg] =
            [scan.first_angle, scan.step].map(|angle| (1e6 * in_degrees(angle)).round() as i128);
        let weight = 1000 * i128::from(self.weight);
        let angle = 2 * (first_udeg * i128::from(self.weight) + step_udeg * i128::from(self.beams)) + weight;
        let last = scan.beams() - 1;
        Mark {
            angle_mdeg: angle.div_euclid(2 * weight) as i32,
            range_dmm: half_up(u128::from(scan.unit_um) * u128::from(self.ranges), 100 * self.weight) as u32,
            weight: u16::try_from(self.weight).unwrap_or(u16::MAX),
            peak: u8::try_from(self.peak).unwrap_or(u8::MAX),
            edge: u8::from(self.first_beam == 0 || self.last_beam == last),
            first_beam: self.first_beam as u16,
            last_beam: self.last_beam as u16,
        }
    }
}

/// The whole number next to `sum / weight`, the greater of two.
fn half_up(sum: u128, weight: u64) -> u128 {
    let weight = u128::from(weight);
    (2 * sum + weight) / (2 * weight)
}

const _: () = assert!(MARKS <= u8::MAX as usize);
