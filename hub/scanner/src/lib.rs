//! Decodes a telegram of the sensor into a scan: the only file that knows both. Here raw words become ranges; the hub
//! lets it write them directly into the shared memory that consumers read.
#![forbid(unsafe_code)]

use lms::framer::suspect;
use lms::measured::Measured;
use lms::variant::{MAX_BEAMS, MIRROR_TURN, Mode, Variant};
use schema::{BEAMS, CONTENTS_UPPER, Reasons, Scan};

/// Writes `measured` into `scan`, every byte of it, with its values split as `mode` says.
///
/// Beams come as the sensor sends them: counter-clockwise seen from above, the first one right.
pub fn decode(measured: &Measured<'_>, mode: Mode, scan: &mut Scan) {
    let count = measured.count();
    let variant = Variant::of_beams(count);
    let mask = mode.max_value();
    let bits = mode.range_bits();
    scan.count = count as u16;
    scan.unit_mm = measured.unit().mm();
    scan.range_bits = bits;
    scan.first_angle_mdeg = variant.map_or(0, Variant::first_angle_mdeg);
    // A partial scan has 180 or 181 beams, a degree apart.
    scan.step_mdeg = variant.map_or(1000, |variant| variant.resolution_cdeg * 10);
    if let (None, Some(quarters)) = (variant, measured.partial()) {
        scan.first_angle_mdeg = i32::from(quarters) * 250;
    }
    scan.intensity_bits = mode.intensity_bits();
    scan.contents = CONTENTS_UPPER;
    scan.pad = [0];
    let (ranges, unused_ranges) = scan.range_array.split_at_mut(count);
    let (upper, unused_upper) = scan.upper_array.split_at_mut(count);
    for ((range, upper), word) in ranges.iter_mut().zip(upper).zip(measured.words()) {
        *range = word & mask;
        *upper = (word >> bits) as u8;
    }
    unused_ranges.fill(0);
    unused_upper.fill(0);
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

const _: () = assert!(MAX_BEAMS == BEAMS && MIRROR_TURN == schema::TURN_NS);
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
    use lms::variant::Unit;

    #[test]
    fn words_are_split_as_the_mode_says() {
        let words: Vec<u16> = (0..181).map(|i| (i % 8) << 13 | (1000 + i)).collect();
        let encoded = lms::measured::encode(0, Unit::Cm, &words, 0x10);
        let measured = Measured::decode(encoded.telegram()).unwrap();
        let mut scan = Scan { range_array: [7; BEAMS], upper_array: [7; BEAMS], ..Scan::default() };
        decode(&measured, Mode(1), &mut scan);
        assert_eq!((scan.count, scan.unit_mm, scan.range_bits, scan.intensity_bits), (181, 10, 13, 3));
        assert_eq!((scan.first_angle_mdeg, scan.step_mdeg), (0, 1000));
        assert_eq!((scan.ranges()[5], scan.intensities()[5]), (1005, 5));
        assert_eq!((scan.range_array[181], scan.upper_array[400]), (0, 0));
        decode(&measured, Mode(4), &mut scan);
        assert_eq!((scan.range_bits, scan.intensity_bits), (14, 0));
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
