//! A turn of points that fall where they like becomes a constant number of beams. Knows no family and no time: a turn is a
//! slice of points, the result goes into plain slices.

use core::f32::consts::TAU;

/// One measurement of a scanner whose head turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Radians, 0 ahead, counter-clockwise positive seen from above: a head that turns clockwise goes from 0 to -2 pi.
    pub angle: f32,
    /// Millimetres, or [`NO_RETURN`].
    pub range: u16,
    /// How strong the echo was, in the scanner's own counts.
    pub intensity: u8,
}

/// The range of a beam of which nothing came back: farther than any range.
pub const NO_RETURN: u16 = 0xFFFE;
/// The range of a beam at which nothing was measured in this turn.
pub const NOT_MEASURED: u16 = 0xFFFF;
/// Beams that a turn may have.
pub const BEAMS: core::ops::RangeInclusive<usize> = 2..=8_192;

/// Equal bins all around for a head that turns clockwise. Beam 0 is ahead, and beam `i` at `-i` times the step, so beams
/// are in the order of measuring. The bin of beam 0 begins half a step before the scanner's zero: 0 and 360 degrees are
/// one beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    beams: usize,
}

/// What became of the points of a turn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Placed {
    /// Points that found their bin taken: all but one of each bin.
    pub collapsed: u32,
    /// Bins without a point.
    pub not_measured: u32,
}

impl Grid {
    /// A grid of so many beams, at least and at most [`BEAMS`].
    pub const fn new(beams: usize) -> Grid {
        let (least, most) = (*BEAMS.start(), *BEAMS.end());
        let beams = if beams < least { least } else { beams };
        Grid { beams: if beams > most { most } else { beams } }
    }

    /// How many beams it has.
    pub const fn beams(&self) -> usize {
        self.beams
    }

    /// Radians from one beam to the next; negative.
    pub fn step(&self) -> f64 {
        -core::f64::consts::TAU / self.beams as f64
    }

    /// Puts `points` where their angles say, in whatever order they come: each slice has a place for every beam, and all
    /// of them are written. Of the points of one bin the nearest that has a range wins, and its exact angle stays; where
    /// there is none, the angle is not a number.
    pub fn fill(
        &self,
        points: &[Point],
        ranges: &mut [u16],
        intensities: &mut [u8],
        angles: &mut [f32],
    ) -> Placed {
        let beams = self.beams;
        let (ranges, intensities, angles) =
            (&mut ranges[..beams], &mut intensities[..beams], &mut angles[..beams]);
        ranges.fill(NOT_MEASURED);
        intensities.fill(0);
        angles.fill(f32::NAN);
        let bins_per_radian = -(beams as f32) / TAU;
        let mut collapsed = 0;
        for point in points {
            // Beyond a turn by less than another one on either side, and rounded to the nearest beam.
            let place = point.angle * bins_per_radian + (beams as f32 + 0.5);
            // What is no angle has no place either.
            let mut bin = if place >= 0.0 { place as usize } else { usize::MAX };
            let mut angle = point.angle - TAU;
            for _ in 0..2 {
                if bin >= beams {
                    (bin, angle) = (bin - beams, angle + TAU);
                }
            }
            let Some(range) = ranges.get_mut(bin) else { continue };
            let is_taken = *range != NOT_MEASURED;
            collapsed += u32::from(is_taken);
            // No return is farther than anything.
            if point.range < *range {
                *range = point.range;
                intensities[bin] = point.intensity;
                // Near its beam, from whatever turn it is counted.
                angles[bin] =
                    if (beams..2 * beams).contains(&(place as usize)) { point.angle } else { angle };
            }
        }
        let not_measured = ranges.iter().filter(|range| **range == NOT_MEASURED).count() as u32;
        Placed { collapsed, not_measured }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Point = Point { angle: 0.0, range: NO_RETURN, intensity: 0 };

    fn at(degrees: f32, range: u16) -> Point {
        Point { angle: -degrees.to_radians(), range, intensity: (range % 251) as u8 }
    }

    /// Ranges and the exact angles in degrees, clockwise, of `points` on 8 beams.
    fn eight(points: &[Point]) -> ([u16; 8], [f32; 8], Placed) {
        let (mut ranges, mut intensities, mut angles) = ([7; 8], [7; 8], [7.0; 8]);
        let placed = Grid::new(8).fill(points, &mut ranges, &mut intensities, &mut angles);
        for (range, intensity) in ranges.iter().zip(intensities) {
            let expected = if *range == NOT_MEASURED { 0 } else { (*range % 251) as u8 };
            assert_eq!(intensity, expected);
        }
        (ranges, angles.map(|angle| -angle.to_degrees()), placed)
    }

    #[test]
    fn the_nearest_that_has_a_range_wins_and_keeps_its_angle() {
        let turn = [at(44.0, 900), at(47.0, 300), at(50.0, NO_RETURN), at(89.0, NO_RETURN), at(91.0, 1200)];
        let (ranges, angles, placed) = eight(&turn);
        assert_eq!(ranges[..3], [NOT_MEASURED, 300, 1200]);
        assert!((angles[1] - 47.0).abs() < 1e-3 && (angles[2] - 91.0).abs() < 1e-3 && angles[0].is_nan());
        assert_eq!(placed, Placed { collapsed: 3, not_measured: 6 });
    }

    #[test]
    fn nothing_came_back_is_another_thing_than_nothing_was_measured() {
        let (ranges, angles, placed) = eight(&[at(90.0, NO_RETURN), at(92.0, NO_RETURN)]);
        assert_eq!((ranges[2], ranges[3]), (NO_RETURN, NOT_MEASURED));
        assert!((angles[2] - 90.0).abs() < 1e-3);
        assert_eq!(placed, Placed { collapsed: 1, not_measured: 7 });
    }

    #[test]
    fn zero_and_a_turn_are_one_beam_from_both_sides() {
        for degrees in [-22.0, 0.0, 22.0, 338.0, 360.0, 382.0] {
            let (ranges, ..) = eight(&[at(degrees, 500)]);
            assert_eq!(ranges[0], 500, "{degrees}");
        }
        assert_eq!(eight(&[at(23.0, 5)]).0[1], 5);
        assert_eq!(eight(&[at(337.0, 5)]).0[7], 5);
        assert_eq!(eight(&[at(-23.0, 5)]).0[7], 5);
    }

    #[test]
    fn the_order_of_points_changes_nothing() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut turn = [NONE; 1_000];
        for (number, point) in turn.iter_mut().enumerate() {
            *point = at(number as f32 * 0.36 + random.f32(), random.u16(..4_000));
        }
        let fill = |points: &[Point]| {
            let (mut ranges, mut intensities, mut angles) = ([0; 450], [0; 450], [0.0; 450]);
            let placed = Grid::new(450).fill(points, &mut ranges, &mut intensities, &mut angles);
            (ranges, placed)
        };
        let ordered = fill(&turn);
        random.shuffle(&mut turn);
        assert_eq!(fill(&turn), ordered);
    }

    #[test]
    fn every_angle_has_a_place_even_one_that_is_none() {
        let grid = Grid::new(8_192);
        let (mut ranges, mut intensities, mut angles) = ([0; 8_192], [0; 8_192], [0.0; 8_192]);
        let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 100.0, -100.0, TAU, -TAU, 2.0 * TAU];
        let points = wild.map(|angle| Point { angle, ..NONE });
        let placed = grid.fill(&points, &mut ranges, &mut intensities, &mut angles);
        assert_eq!((ranges[0], placed), (NO_RETURN, Placed { collapsed: 1, not_measured: 8_191 }));
        for beam in 0..8_192 {
            let point = Point { angle: (beam as f64 * grid.step()) as f32, range: 77, intensity: 1 };
            grid.fill(&[point], &mut ranges, &mut intensities, &mut angles);
            assert_eq!(ranges[beam], 77, "{beam}");
        }
        assert_eq!((Grid::new(0).beams(), Grid::new(9_000).beams()), (2, 8_192));
    }
}
