//! The meaning of one beam's value, written as the design states it. Tests compare the background's faster code for
//! whole scans with it.

use scanhub_schema::{Code, Scan};

/// The reading of one beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reading {
    /// Something at this range in mm.
    Valid(u32),
    /// Nothing within reach.
    Far,
    /// Nothing is known: dazzled, too weak a signal, a reading error.
    Invalid,
}

impl Reading {
    /// What beam `i` of `scan` tells. That nothing came back is the most frequent code in real rooms; whether it means
    /// [`Reading::Far`] or [`Reading::Invalid`] is for each processor to say.
    pub(crate) fn of(scan: &Scan, i: usize, no_return_is_far: bool) -> Reading {
        match (scan.distance_mm(i), scan.code(i)) {
            (Some(range_mm), _) => Reading::Valid(range_mm),
            (None, Some(Code::Beyond)) => Reading::Far,
            (None, Some(Code::NoReturn)) if no_return_is_far => Reading::Far,
            _ => Reading::Invalid,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::ScanHead;

    #[test]
    fn codes_and_ranges() {
        let mut ranges: Vec<u16> = (0..10).map(|code| 0x1FFF - code).collect();
        ranges.push(0);
        let scan = Scan::of(ScanHead::lms(11, 0, 500, 10, 13), &ranges);
        let all = |far| (0..12).map(|i| Reading::of(&scan, i, far)).collect::<Vec<_>>();
        let mut expected = vec![Reading::Invalid; 12];
        expected[8] = Reading::Far;
        expected[9] = Reading::Valid(81_820);
        expected[10] = Reading::Valid(0);
        assert_eq!(all(false), expected);
        expected[0] = Reading::Far;
        assert_eq!(all(true), expected, "and a beam that is not there tells nothing");
    }
}
