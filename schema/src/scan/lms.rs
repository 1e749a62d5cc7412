//! How a scan of the SICK LMS 2xx is read: its codes, counted down from the greatest value of its measuring mode, and when its
//! beams are measured. Refuses to know its telegrams.

use super::{Code, Contents, Family, ScanHead};

impl ScanHead {
    /// Returns the head of an LMS's scan: beam 0 at `first_angle_mdeg` and one each `step_mdeg`, in 1/1000 degree (1000, 500 or
    /// 250; it measures a degree in as many turns as that has steps), units of `unit_mm`, ranges of `range_bits` bits, whose nine
    /// greatest values are codes. It sends after the last beam of the last turn; that stamps. There are upper bits, which are no
    /// intensities.
    pub fn lms(
        count: usize,
        first_angle_mdeg: i32,
        step_mdeg: u32,
        unit_mm: u32,
        range_bits: u8,
    ) -> ScanHead {
        let in_radians = |mdeg: f64| (mdeg / 1000.0).to_radians();
        let step = in_radians(step_mdeg.into());
        let greatest = ((1_u32 << range_bits.min(16)) - 1) as u16;
        let turns = (1000 / step_mdeg.max(1)).max(1);
        let beam_time_ns = step_mdeg * (TURN_NS / 360) / 1000;
        let age_ns = (turns - 1) * TURN_NS + count.saturating_sub(1) as u32 * beam_time_ns;
        ScanHead {
            first_angle: in_radians(first_angle_mdeg.into()),
            step,
            spacing: step as f32,
            beam_time_ns,
            first_beam_ns: -(age_ns as i32),
            unit_um: 1000 * unit_mm,
            count: count as u16,
            valid_to: greatest.saturating_sub(9),
            no_return: greatest,
            beyond: greatest.saturating_sub(8),
            family: Family::Lms as u8,
            contents: Contents::UPPER,
            turns: turns as u8,
            turn_ns: if turns > 1 { TURN_NS } else { 0 },
            ..ScanHead::default()
        }
    }
}

/// What `value`, which is no range, stands for in a scan with `head` (Telegram listing, B0h); 3, 6 and 7 are reserved.
pub(super) fn code(head: &ScanHead, value: u16) -> Code {
    match head.no_return.checked_sub(value) {
        Some(0) => Code::NoReturn,
        Some(1) => Code::TooBright,
        Some(4) => Code::Weak,
        Some(5) => Code::Error,
        Some(8) => Code::Beyond,
        _ => Code::Overflow,
    }
}

/// One turn of the mirror (75 Hz).
const TURN_NS: u32 = 13_320_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scan;

    #[test]
    fn the_nine_greatest_values_are_codes() {
        for (bits, max) in [(13, 0x1FFF), (14, 0x3FFF), (15, 0x7FFF)] {
            let scan = Scan::of(ScanHead::lms(4, 0, 500, 10, bits), &[max, max - 8, max - 9, 0]);
            assert_eq!(scan.code(0), Some(Code::NoReturn));
            assert_eq!(scan.code(1), Some(Code::Beyond));
            assert_eq!((scan.code(2), scan.range(2)), (None, Some(max - 9)));
            assert_eq!(scan.distance_mm(2), Some(u32::from(max - 9) * 10));
            assert_eq!(scan.range(3), Some(0));
            assert_eq!((scan.range(4), scan.code(4)), (None, None));
        }
    }

    #[test]
    fn half_degrees_are_measured_one_turn_later() {
        let of = |count, step_mdeg| Scan::of(ScanHead::lms(count, 0, step_mdeg, 1, 13), &vec![0; count]);
        let (turn_ns, half) = (i64::from(TURN_NS), of(361, 500));
        assert_eq!(half.beam_ns(360), -turn_ns);
        assert_eq!(half.beam_ns(359), -turn_ns * 500 / 360_000);
        assert_eq!(half.beam_ns(0), -turn_ns - turn_ns / 2);
        assert_eq!(of(181, 1000).beam_ns(180), 0);
        assert_eq!(of(401, 250).beam_ns(398), -turn_ns - turn_ns * 500 / 360_000, "the third of four turns");
    }

    #[test]
    fn intensities_only_where_the_mode_has_them() {
        let mut scan = Scan::of(ScanHead::lms(2, 0, 500, 1, 13), &[1, 2]);
        scan.arrays().upper[1] = 7;
        assert_eq!((scan.upper(), scan.intensities().len()), (&[0, 7][..], 0));
        scan.intensity_bits = 3;
        assert!(scan.intensities().iter().eq([0, 7]));
        scan.contents = 0;
        assert!(scan.intensities().is_empty() && scan.upper().is_empty());
    }
}
