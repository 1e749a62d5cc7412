//! A scan as a line of a CARMEN log. The log has no place for reflector levels, field bits, and address and status of the
//! sensor: they are lost. Refuses to know the time of the scan.

use lms::measured::Measured;
use lms::telegram::Telegram;
use lms::variant::{Mode, Unit, Variant};

use crate::carmen::LEFT_OUT;

/// The line of a scan at `at_ns` since 1970, in a log that begins at `first_ns`; `None` if `telegram` is no whole scan. A
/// code is written as the range that its value would be, as logs of the sensor have it.
pub(super) fn line(telegram: &[u8], mode: Mode, at_ns: u64, first_ns: u64) -> Option<String> {
    let measured = Measured::decode(Telegram::check(telegram)?)?;
    if measured.partial().is_some() || Variant::of_beams(measured.count()).is_none() {
        return None;
    }
    let (greatest, unit) = (mode.max_value(), measured.unit());
    let decimals = match unit {
        Unit::Mm => 3,
        Unit::Cm => 2,
        Unit::Dm => 1,
    };
    let ranges: Vec<u16> = measured.words().map(|word| word & greatest).collect();
    let ranges = match &ranges[..] {
        // What came from a log without a last beam has none there either.
        [ranges @ .., last] if *last == greatest - LEFT_OUT && matches!(ranges.len(), 180 | 360) => ranges,
        ranges => ranges,
    };
    let mut line = format!("FLASER {}", ranges.len());
    for &range in ranges {
        line += &format!(" {:.decimals$}", f64::from(range) * f64::from(unit.mm()) / 1000.0);
    }
    // The difference is taken from rounded times, so that a log that is converted and written again has the same one.
    let micros = |ns: u64| ns.saturating_add(500) / 1000;
    let seconds = |micros: u64| format!("{}.{:06}", micros / 1_000_000, micros % 1_000_000);
    let (at, since) = (micros(at_ns), micros(at_ns).saturating_sub(micros(first_ns)));
    line += &format!(" 0 0 0 0 0 0 {} scanhub {}\n", seconds(at), seconds(since));
    Some(line)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Encoding;
    use crate::carmen::Sweep;
    use lms::measured;

    #[test]
    fn a_line_is_read_as_it_was_written() {
        let mut words = vec![1234; 181];
        (words[0], words[1], words[2]) = (0xE000 | 500, 8191, 8183);
        let telegram = measured::encode(0, Unit::Cm, &words, 0x10);
        let line =
            line(telegram.bytes(), Mode(1), 1_071_078_720_123_456_789, 1_071_078_720_000_000_000).unwrap();
        assert!(line.ends_with(" 12.34 0 0 0 0 0 0 1071078720.123457 scanhub 0.123457\n"), "{line}");
        // As with the rounded times of a log: 123 457 - 100 000.
        let first = 1_071_078_720_000_000_000 + 100_000_400;
        let again = super::line(telegram.bytes(), Mode(1), 1_071_078_720_123_456_500, first).unwrap();
        assert!(again.ends_with(" scanhub 0.023457\n"), "{again}");
        let sweep = Sweep::parse(&line).unwrap().unwrap();
        assert_eq!(sweep.ranges_m[..4], [5.0, 81.91, 81.83, 12.34]);
        let cm = Encoding { unit: Unit::Cm, mode: Mode(0) };
        assert_eq!(sweep.words(cm, cm)[..4], [500, 8191, 8183, 1234]);
        words[180] = 8191 - LEFT_OUT;
        let line = super::line(measured::encode(0, Unit::Cm, &words, 0x10).bytes(), Mode(1), 1, 1).unwrap();
        assert!(line.starts_with("FLASER 180 5.00 81.91 81.83 12.34"), "{line}");
    }

    #[test]
    fn what_is_no_whole_scan_has_no_line() {
        assert_eq!(line(lms::reply::mode(0, true, 0x10).bytes(), Mode(0), 1, 0), None);
        let part = measured::encode(0, Unit::Cm, &[7; 61], 0x10);
        assert_eq!(line(part.bytes(), Mode(0), 1, 0), None);
    }
}
