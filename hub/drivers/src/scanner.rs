//! What families speak and what consumers read meet here alone: the list of the families, and decoders of their telegrams
//! and turns into scans. Here raw words become ranges; the hub lets them be written directly into the shared memory that
//! consumers read.

mod families;
pub mod recognize;
mod turning;

use crate::line::suspect;
use crate::lms;
use crate::lms::measured::{FirstValues, Measured};
use crate::lms::variant::{Mode, Variant};
use schema::{Contents, Reasons, Scan, ScanArrays, ScanHead};

pub use families::{Introduction, Session, Trouble, features};
pub use recognize::family_of;
pub use turning::Turning;

/// Bytes of the scan that `measured` makes.
pub fn len(measured: &Measured<'_>) -> usize {
    Scan::len(measured.count(), Contents::UPPER)
}

/// Writes `measured` into `scan`, every byte that it uses, with its values split as `mode` says.
///
/// Beams come as the sensor sends them: counter-clockwise seen from above, the first one right. Their angles are counted
/// from ahead (REP 103); what other code knows of angles follows from here.
///
/// # Panics
///
/// If `scan` has less memory than [`len`] says.
pub fn decode(measured: &Measured<'_>, mode: Mode, scan: &mut Scan) {
    let (mask, bits) = (mode.max_value(), mode.range_bits());
    let ScanArrays { ranges, upper, .. } = scan.begin(head(measured, mode));
    for ((range, upper), word) in ranges.iter_mut().zip(upper).zip(measured.words()) {
        *range = word & mask;
        *upper = (word >> bits) as u8;
    }
}

/// Writes the ranges of the first values of a telegram that is not complete to the beginning of `ranges`, with the values split
/// as `mode` says; how many there are.
pub fn decode_first(values: &FirstValues<'_>, mode: Mode, ranges: &mut [u16]) -> usize {
    let words = values.words();
    let count = words.len().min(ranges.len());
    for (range, word) in ranges.iter_mut().zip(words) {
        *range = word & mode.max_value();
    }
    count
}

/// Micrometres of a unit of these values.
pub fn unit_um(values: &FirstValues<'_>) -> u32 {
    1000 * u32::from(values.unit().mm())
}

fn head(measured: &Measured<'_>, mode: Mode) -> ScanHead {
    let count = measured.count();
    let variant = Variant::of_beams(count);
    // A partial scan has 180 or 181 beams, a degree apart.
    let step_mdeg = variant.map_or(1000, |variant| variant.resolution_cdeg * 10);
    let first_angle_mdeg = match (variant, measured.partial()) {
        (None, Some(quarters)) => i32::from(quarters) * 250 - 90_000,
        (variant, _) => variant.map_or(-90_000, Variant::first_angle_mdeg),
    };
    let unit_mm = measured.unit().mm().into();
    ScanHead {
        intensity_bits: mode.intensity_bits(),
        ..ScanHead::lms(count, first_angle_mdeg, step_mdeg.into(), unit_mm, mode.range_bits())
    }
}

/// Whether a value of `measured` has bits set that `mode` never sets.
pub fn is_forbidden(measured: &Measured<'_>, mode: Mode) -> bool {
    mode.forbidden() != 0 && measured.words().any(|word| word & mode.forbidden() != 0)
}

/// Nominal time between two scans of `variant` at `baud`, in microseconds; 0 if the variant is not known.
pub fn period_us(variant: Option<Variant>, baud: u32) -> u32 {
    // STX to count word, status and checksum: 10 bytes beside the values.
    variant.map_or(0, |variant| (variant.period(2 * variant.beams() + 10, baud) / 1000) as u32)
}

const _: () = assert!(lms::telegram::MAX_TELEGRAM == schema::Telegram::MAX);
const _: () = assert!(
    suspect::LINE_ERROR == Reasons::LINE_ERROR
        && suspect::NEIGHBOUR == Reasons::NEIGHBOUR
        && suspect::SLOW == Reasons::SLOW
        && suspect::FORBIDDEN_BITS == Reasons::FORBIDDEN_BITS
        && suspect::HEADER_INSIDE == Reasons::HEADER_INSIDE
);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::variant::Unit;

    #[test]
    fn words_are_split_as_the_mode_says() {
        let words: Vec<u16> = (0..181).map(|i| (i % 8) << 13 | (1000 + i)).collect();
        let encoded = lms::measured::encode(0, Unit::Cm, &words, 0x10);
        let measured = Measured::decode(encoded.telegram()).unwrap();
        let mut scan = Scan::zeroed(len(&measured));
        decode(&measured, Mode(1), &mut scan);
        assert_eq!(
            (scan.beams(), scan.unit_um, scan.valid_to, scan.intensity_bits),
            (181, 10_000, 0x1FF6, 3)
        );
        assert_eq!((scan.angle_deg(0), scan.angle_deg(90), scan.angle_deg(180)), (-90.0, 0.0, 90.0));
        assert_eq!((scan.ranges()[5], scan.intensities().get(5)), (1005, Some(5)));
        decode(&measured, Mode(4), &mut scan);
        assert_eq!((scan.no_return, scan.intensity_bits), (0x3FFF, 0));
        assert_eq!((scan.ranges()[3], scan.upper()[3]), ((3 << 13 | 1003) & 0x3FFF, 1));
        assert!(is_forbidden(&measured, Mode(0x0F)) && !is_forbidden(&measured, Mode(4)));
    }

    #[test]
    fn a_status_knows_the_modes_with_reflector_bits() {
        for mode in 0..schema::Status::MODE_UNKNOWN {
            let status = schema::Status { mode, ..schema::Status::default() };
            assert_eq!(status.has_reflector_bits(), Some(Mode(mode).intensity_bits() > 0), "{mode}");
        }
    }

    #[test]
    fn periods() {
        assert_eq!(period_us(Some(Variant::HALF), 500_000), 26_640);
        assert_eq!(period_us(None, 500_000), 0);
    }
}
