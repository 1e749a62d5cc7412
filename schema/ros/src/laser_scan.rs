//! A scan as `sensor_msgs/msg/LaserScan`. Refuses to know where the sensor sits.

use scanhub_schema::{Code, Header, Scan};

use crate::cdr::Cdr;

/// Writes `scan`, of the frame `frame`, to the end of `message`: x ahead, angles in radians counter-clockwise from there as
/// the sensor itself counts them, also if it is mounted upside down, in ascending order; ranges in metres (REP 103), each the
/// float nearest to the sensor's value. +inf: no echo within the sensor's range; -inf: something is too near; NaN: not known
/// (REP 117). Stamped when its first beam was measured: of a scanner that turns clockwise that is the one it measured last,
/// and the time from beam to beam is negative.
pub fn laser_scan(message: &mut Vec<u8>, frame: &str, header: &Header, scan: &Scan) {
    let mut cdr = Cdr::begin(message);
    cdr.header(stamp_ns(header, scan), frame);
    let last = scan.beams().saturating_sub(1);
    // The beam at place `i` of the message.
    let beam = |i: usize| if is_clockwise(scan) { last - i } else { i };
    let (first_angle, step) = (scan.first_angle + beam(0) as f64 * scan.step, scan.step.abs());
    for value in [
        first_angle as f32,
        (first_angle + last as f64 * step) as f32,
        step as f32,
        (beam_time_ns(scan) / 1e9) as f32,
        (scan_time_us(header, scan) / 1e6) as f32,
        metres(1, scan),
        metres(scan.valid_to, scan),
    ] {
        cdr.f32(value);
    }
    cdr.floats((0..scan.beams()).map(|i| range_m(scan, beam(i))));
    let intensities = scan.intensities();
    cdr.floats((0..intensities.len()).map(|i| f32::from(intensities.get(beam(i)).unwrap_or_default())));
}

/// When the first beam of the message was measured, by the wall clock.
pub(crate) fn stamp_ns(header: &Header, scan: &Scan) -> u64 {
    let first = if is_clockwise(scan) { scan.beams().saturating_sub(1) } else { 0 };
    header.wall_ns.saturating_add_signed(scan.beam_ns(first))
}

fn is_clockwise(scan: &Scan) -> bool {
    scan.step < 0.0
}

/// From a beam of the message to the next.
fn beam_time_ns(scan: &Scan) -> f64 {
    match f64::from(scan.beam_time_ns) {
        // Beams that stand between others are measured a turn later: then no one time lies between two.
        _ if scan.turns > 1 => 0.0,
        time if is_clockwise(scan) => -time,
        time => time,
    }
}

/// The time between two scans: that of a turn where the header does not tell.
fn scan_time_us(header: &Header, scan: &Scan) -> f64 {
    match header.period_us {
        0 => f64::from(scan.beam_time_ns) * scan.beams() as f64 / 1e3,
        period => period.into(),
    }
}

fn range_m(scan: &Scan, i: usize) -> f32 {
    match (scan.range(i), scan.code(i)) {
        (Some(0), _) | (None, Some(Code::TooNear)) => f32::NEG_INFINITY,
        (Some(range), _) => metres(range, scan),
        (None, Some(Code::NoReturn | Code::Beyond)) => f32::INFINITY,
        (None, _) => f32::NAN,
    }
}

/// The nearest float.
fn metres(range: u16, scan: &Scan) -> f32 {
    (f64::from(range) * f64::from(scan.unit_um) / 1e6) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{Family, ScanHead};

    fn scan(ranges: &[u16], step_mdeg: u32) -> Box<Scan> {
        Scan::of(ScanHead::lms(ranges.len(), -90_000, step_mdeg, 10, 13), ranges)
    }

    /// The numbers behind a frame of four letters, whose end makes three bytes of padding.
    fn numbers(message: &[u8]) -> Vec<f32> {
        let body = &message[4..];
        assert_eq!(body[8..20], [5, 0, 0, 0, b'r', b'e', b'a', b'r', 0, 0, 0, 0]);
        body[20..].chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect()
    }

    #[test]
    fn a_scan_is_these_numbers() {
        let header = Header { wall_ns: 1_700_000_001_000_000_000, period_us: 13_320, ..Header::default() };
        let mut message = Vec::new();
        let mut it = scan(&[100, 0x1FFF, 0x1FF7, 0x1FFE, 0, 0x1FF6], 1000);
        it.intensity_bits = 3;
        it.arrays().upper[1] = 7;
        laser_scan(&mut message, "rear", &header, &it);
        assert_eq!(message[..4], [0, 1, 0, 0]);
        // The first of six beams of a degree each was measured five 360ths of a turn before the last, which stamps.
        let nanosec = 1_000_000_000 - 5 * 37_000;
        assert_eq!(message[4..8], 1_700_000_000_i32.to_le_bytes());
        assert_eq!(message[8..12], (nanosec as u32).to_le_bytes());
        let told = numbers(&message);
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(near(told[0], -std::f32::consts::FRAC_PI_2) && near(told[1], 5_f32.to_radians() + told[0]));
        assert!(near(told[2], 1_f32.to_radians()) && near(told[3], 37e-6) && near(told[4], 0.01332));
        // The greatest range is within what the message says is the greatest.
        assert_eq!((told[5], told[6], told[13]), (0.01, 81.82, 81.82));
        assert_eq!(told[7].to_bits(), 6);
        assert_eq!(
            (told[8], told[9], told[10], told[12]),
            (1.0, f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY)
        );
        assert!(told[11].is_nan());
        assert_eq!(told[14].to_bits(), 6);
        assert_eq!(told[15..], [0.0, 7.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn beams_of_several_turns_have_no_one_time_between_them() {
        let mut message = Vec::new();
        let between = scan(&[100; 9], 500);
        laser_scan(&mut message, "rear", &Header { wall_ns: 1 << 60, ..Header::default() }, &between);
        let told = numbers(&message);
        assert_eq!((told[3], told[7].to_bits(), told[17].to_bits(), told.len()), (0.0, 9, 0, 18));
    }

    #[test]
    fn angles_ascend_also_of_a_scanner_that_turns_clockwise() {
        let mut head = ScanHead::turning(Family::Ld, 4);
        (head.beam_time_ns, head.first_beam_ns) = (25_000_000, 0);
        let mut it = Scan::of(head, &[1000, 2000, 3000, 4000]);
        it.arrays().upper.copy_from_slice(&[1, 2, 3, 4]);
        let mut message = Vec::new();
        laser_scan(&mut message, "rear", &Header { wall_ns: 5_000_000_000, ..Header::default() }, &it);
        let told = numbers(&message);
        let quarter = std::f32::consts::FRAC_PI_2;
        // The grid begins ahead and turns to the right; its last beam looks left and was measured 75 ms after the first.
        assert_eq!(message[4..12], [5, 0, 0, 0, 0xC0, 0x68, 0x78, 0x04]);
        assert_eq!(told[..5], [-3.0 * quarter, 0.0, quarter, -0.025, 0.1]);
        assert_eq!(told[8..12], [4.0, 3.0, 2.0, 1.0]);
        assert_eq!(told[13..], [4.0, 3.0, 2.0, 1.0]);
    }
}
