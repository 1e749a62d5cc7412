//! How the metres of a log become values without loss: it reads all ranges first, and chooses the unit and the bits in
//! which each range is a whole value. A code of the sensor appears in a log as the greatest of these ranges. Refuses to
//! know lines.

use std::fmt;

use lms::variant::{Mode, Unit};

use super::units;
use crate::Encoding;

/// The ranges of a log, counted.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Census {
    /// Ranges that are no whole centimetres, and no whole millimetres.
    finer: [u64; 2],
    /// The farthest one that a value can say.
    farthest_m: f64,
    /// Ranges that no value can say.
    beyond: u64,
}

/// Ranges of a log that no LMS 2xx could have sent together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unfit {
    /// Ranges that are rounded.
    pub rounded: u64,
    /// Ranges that are too far for any value.
    pub beyond: u64,
}

impl Census {
    /// Counts a scan.
    pub(crate) fn note(&mut self, ranges_m: &[f64]) {
        for &range_m in ranges_m.iter().filter(|range_m| range_m.is_finite() && **range_m >= 0.0) {
            if units(range_m, COARSEST.unit) > f64::from(COARSEST.mode.max_value()) {
                self.beyond += 1;
                continue;
            }
            self.farthest_m = self.farthest_m.max(range_m);
            for (finer, unit) in self.finer.iter_mut().zip([Unit::Cm, Unit::Mm]) {
                let range = range_m * 1000.0 / f64::from(unit.mm());
                *finer += u64::from((range - range.round()).abs() > WHOLE);
            }
        }
    }

    /// How the ranges are encoded: as the log says itself (`told`) if they all go into that, else in centimetres if they
    /// are whole ones, else in millimetres, with as few bits as reach the farthest one. And which ranges do not fit.
    pub(crate) fn encoding(&self, told: Option<Encoding>) -> (Encoding, Unfit) {
        let order = if self.finer[0] == 0 { [Unit::Cm, Unit::Mm] } else { [Unit::Mm, Unit::Cm] };
        let of_unit = |unit: Unit| MODES.map(|mode| Encoding { unit, mode });
        let all = told.into_iter().chain(order.into_iter().flat_map(of_unit));
        let fits = |encoding: &Encoding| self.reaches(*encoding) && self.is_whole(encoding.unit);
        let encoding = all.clone().find(fits).or_else(|| all.clone().find(|it| self.reaches(*it)));
        let encoding = encoding.unwrap_or(COARSEST);
        let rounded = self.finer[usize::from(encoding.unit == Unit::Mm)];
        (encoding, Unfit { rounded, beyond: self.beyond })
    }

    fn reaches(&self, encoding: Encoding) -> bool {
        units(self.farthest_m, encoding.unit) <= f64::from(encoding.mode.max_value())
    }

    fn is_whole(&self, unit: Unit) -> bool {
        match unit {
            Unit::Cm => self.finer[0] == 0,
            Unit::Mm => self.finer[1] == 0,
            // Not looked for: who says that values are tenths of metres is believed.
            Unit::Dm => true,
        }
    }
}

impl Unfit {
    /// Whether all ranges fit.
    pub fn is_none(&self) -> bool {
        *self == Unfit::default()
    }
}

/// What is wrong with them.
impl fmt::Display for Unfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = |count: u64, what: &str| (count > 0).then(|| format!("{count} {what}"));
        let parts = [
            counted(self.rounded, "ranges are finer than the unit in which an LMS 2xx reaches that far"),
            counted(self.beyond, "ranges are too long for a value of an LMS 2xx"),
        ];
        f.write_str(&parts.into_iter().flatten().collect::<Vec<_>>().join(", "))
    }
}

/// Measuring modes without reflector levels, by the bits of a range: 13, 14, 15.
pub(super) const MODES: [Mode; 3] = [Mode(0x00), Mode(0x04), Mode(0x06)];
/// What reaches farthest.
const COARSEST: Encoding = Encoding { unit: Unit::Cm, mode: Mode(0x06) };
/// Text has the value itself; what is lost in a double is less.
const WHOLE: f64 = 1e-6;

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(ranges_m: &[f64], told: Option<Encoding>) -> (u8, u8, Unfit) {
        let mut census = Census::default();
        census.note(ranges_m);
        let (encoding, unfit) = census.encoding(told);
        (encoding.unit.mm(), encoding.mode.range_bits(), unfit)
    }

    #[test]
    fn unit_and_bits_are_those_that_lose_nothing() {
        let none = Unfit::default();
        assert_eq!(chosen(&[], None), (10, 13, none));
        assert_eq!(chosen(&[20.0, 0.01, 81.91, f64::NAN, -1.0], None), (10, 13, none));
        assert_eq!(chosen(&[81.92], None), (10, 14, none));
        assert_eq!(chosen(&[163.84], None), (10, 15, none));
        assert_eq!(chosen(&[1.234, 8.191], None), (1, 13, none));
        assert_eq!(chosen(&[1.234, 16.383], None), (1, 14, none));
        assert_eq!(chosen(&[1.234, 16.384], None), (1, 15, none));
        assert_eq!(chosen(&[32.767, 32.763], None), (1, 15, none));
    }

    #[test]
    fn what_no_sensor_sends_is_counted() {
        assert_eq!(chosen(&[1.234, 2.0, 81.91], None), (10, 13, Unfit { rounded: 1, beyond: 0 }));
        assert_eq!(chosen(&[1.23456, 9.0, 9.001], None), (1, 14, Unfit { rounded: 1, beyond: 0 }));
        assert_eq!(chosen(&[1.5, 1e30, 1000.0], None), (10, 13, Unfit { rounded: 0, beyond: 2 }));
        let unfit = Unfit { rounded: 2, beyond: 1 };
        assert!(
            unfit.to_string().contains("2 ranges are finer")
                && unfit.to_string().contains("1 ranges are too long")
        );
    }

    #[test]
    fn what_the_log_says_itself_holds_if_it_can() {
        let mm = |mode| Some(Encoding { unit: Unit::Mm, mode: Mode(mode) });
        assert_eq!(chosen(&[8.185], mm(0x04)), (1, 14, Unfit::default()));
        assert_eq!(chosen(&[8.185], None), (1, 13, Unfit::default()));
        assert_eq!(chosen(&[20.0], mm(0x04)), (10, 13, Unfit::default()));
        assert_eq!(
            chosen(&[1.234], Some(Encoding { unit: Unit::Cm, mode: Mode(0) })),
            (1, 13, Unfit::default())
        );
    }
}
