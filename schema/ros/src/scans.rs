//! Scans as `sensor_msgs/msg/LaserScan`, and points as `sensor_msgs/msg/PointCloud2`. The points come from a scan, from
//! its foreground, or from a sweep in three dimensions.

use std::mem::offset_of;

use scanhub_schema::{CloudPoint, Code, Foreground, Header, Scan};

use crate::BASE_FRAME;
use crate::cdr::Cdr;

/// Appends `scan` in frame `frame` to `message` as a LaserScan.
///
/// - Angles are in radians, counterclockwise from the sensor's x axis (ahead), in ascending order. Angles are in the
///   sensor's own frame, even if the sensor is mounted upside down.
/// - Ranges are in meters (REP 103), each rounded to the nearest float. +inf means no echo within the sensor's range,
///   -inf means an object that is too near, and NaN means an unknown range (REP 117).
/// - The stamp is the time of the message's first beam. A clockwise scanner measures that beam last, and the time
///   between beams is then negative.
pub fn laser_scan(message: &mut Vec<u8>, frame: &str, header: &Header, scan: &Scan) {
    let mut cdr = Cdr::begin(message);
    cdr.header(stamp_ns(header, scan), frame);
    let last = scan.beams().saturating_sub(1);
    // Returns the index that beam `i` of the message has in the scan.
    let beam = |i: usize| if is_clockwise(scan) { last - i } else { i };
    let (first_angle, step) = (scan.first_angle + beam(0) as f64 * scan.step, scan.step.abs());
    for value in [
        first_angle as f32,
        (first_angle + last as f64 * step) as f32,
        step as f32,
        (beam_time_ns(scan) / 1e9) as f32,
        (scan_time_us(header, scan) / 1e6) as f32,
        meters(1, scan),
        meters(scan.valid_to, scan),
    ] {
        cdr.f32(value);
    }
    cdr.floats((0..scan.beams()).map(|i| range_m(scan, beam(i))));
    let intensities = scan.intensities();
    cdr.floats((0..intensities.len()).map(|i| f32::from(intensities.get(beam(i)).unwrap_or_default())));
}

/// Returns the wall-clock time of the message's first beam.
fn stamp_ns(header: &Header, scan: &Scan) -> u64 {
    let first = if is_clockwise(scan) { scan.beams().saturating_sub(1) } else { 0 };
    header.wall_ns.saturating_add_signed(scan.beam_ns(first))
}

fn is_clockwise(scan: &Scan) -> bool {
    scan.step < 0.0
}

/// Returns the time from a beam of the message to the next one.
fn beam_time_ns(scan: &Scan) -> f64 {
    match f64::from(scan.beam_time_ns) {
        // Neighboring beams are measured in different revolutions, so the time between beams is not constant.
        _ if scan.turns > 1 => 0.0,
        time if is_clockwise(scan) => -time,
        time => time,
    }
}

/// Returns the period of scans in microseconds: the period in the header, or the duration of a revolution if the header
/// has no period.
fn scan_time_us(header: &Header, scan: &Scan) -> f64 {
    match header.period_us {
        0 => f64::from(scan.beam_time_ns) * scan.beams() as f64 / 1e3,
        period => period.into(),
    }
}

fn range_m(scan: &Scan, i: usize) -> f32 {
    match (scan.range(i), scan.code(i)) {
        (Some(0), _) | (None, Some(Code::TooNear)) => f32::NEG_INFINITY,
        (Some(range), _) => meters(range, scan),
        (None, Some(Code::NoReturn | Code::Beyond)) => f32::INFINITY,
        (None, _) => f32::NAN,
    }
}

/// Returns the float nearest to `range` in meters.
fn meters(range: u16, scan: &Scan) -> f32 {
    (f64::from(range) * f64::from(scan.unit_um) / 1e6) as f32
}

/// Appends the readings of `scan` in frame `frame` to `message` as a PointCloud2 with the stamp of the LaserScan. The
/// cloud has a point for each reading, in the order of the beams. A point is x, y, z in meters (z is 0) and the
/// intensity that the scanner reports (0 if it reports none), as 32-bit floats.
pub fn scan_cloud(message: &mut Vec<u8>, frame: &str, header: &Header, scan: &Scan) {
    let points = || (0..scan.beams()).filter_map(|i| Some((i, scan.distance_m(i)?)));
    let width = points().count();
    let intensities = scan.intensities();
    let point_len = SCAN_FIELDS.len() as u32 * 4;
    let mut cdr = begin(message, stamp_ns(header, scan), frame, &SCAN_FIELDS, (point_len, width));
    for (i, meters) in points() {
        let (sin, cos) = scan.angle(i).sin_cos();
        let intensity = intensities.get(i).map_or(0.0, f64::from);
        let values = [meters * cos, meters * sin, 0.0, intensity];
        cdr.bytes(values.map(|value| value as f32).map(f32::to_le_bytes).as_flattened());
    }
    cdr.bool(true);
}

/// Appends the `foreground` of `scan` in frame `frame` to `message` as a PointCloud2 with the stamp of the LaserScan.
/// The cloud has a point x, y, z (meters, 32-bit floats; z is 0) for each foreground beam that has a range, in the
/// order of the beams. The directions of the beams come from `scan`, which must come from the same telegram as
/// `foreground`.
pub fn foreground_cloud(
    message: &mut Vec<u8>,
    frame: &str,
    header: &Header,
    scan: &Scan,
    foreground: &Foreground,
) {
    let points = || {
        let is_point = |&(i, range): &(usize, u16)| i < scan.beams() && (1..=scan.valid_to).contains(&range);
        foreground.readings().filter(is_point)
    };
    let width = points().count();
    let mut cdr = begin(message, stamp_ns(header, scan), frame, &AXIS_FIELDS, (POINT_LEN, width));
    for (i, range) in points() {
        let meters = f64::from(range) * f64::from(foreground.unit_um) / 1e6;
        let (sin, cos) = scan.angle(i).sin_cos();
        cdr.bytes(
            [meters * cos, meters * sin, 0.0].map(|axis| axis as f32).map(f32::to_le_bytes).as_flattened(),
        );
    }
    // The field `is_dense`: all points have coordinates.
    cdr.bool(true);
}

/// Appends the `points` of a sweep, in the robot's frame, to `message` as a PointCloud2: x, y, z (meters, 32-bit
/// floats), beam (index in the scan, 16 bits) and class (8 bits: 0 unknown, 1 background, 2 foreground, 3 behind the
/// background). The stamp is taken from `header`, which must be the header of the last point's sample.
pub fn sweep_cloud(message: &mut Vec<u8>, header: &Header, points: &[CloudPoint]) {
    let point_len = size_of::<CloudPoint>() as u32;
    let mut cdr = begin(message, header.wall_ns, BASE_FRAME, &SWEEP_FIELDS, (point_len, points.len()));
    for CloudPoint { at, beam, point_class, .. } in points {
        cdr.bytes(at.map(f32::to_le_bytes).as_flattened());
        cdr.bytes(&beam.to_le_bytes());
        cdr.bytes(&[*point_class, 0]);
    }
    cdr.bool(true);
}

/// Starts a PointCloud2 of `count` points of `point` bytes each. The caller appends the points. `fields` are the name,
/// offset and type of each field of a point.
fn begin<'a>(
    message: &'a mut Vec<u8>,
    stamp_ns: u64,
    frame: &str,
    fields: &[(&str, u32, u8)],
    (point, count): (u32, usize),
) -> Cdr<'a> {
    let len = point * count as u32;
    let mut cdr = Cdr::begin(message);
    cdr.header(stamp_ns, frame);
    cdr.u32(1);
    cdr.u32(count as u32);
    cdr.u32(fields.len() as u32);
    for &(name, offset, kind) in fields {
        cdr.text(name);
        cdr.u32(offset);
        cdr.u8(kind);
        cdr.u32(1);
    }
    cdr.bool(false);
    cdr.u32(point);
    cdr.u32(len);
    cdr.u32(len);
    cdr
}

const AXIS_FIELDS: [(&str, u32, u8); 3] = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
const SCAN_FIELDS: [(&str, u32, u8); 4] =
    [AXIS_FIELDS[0], AXIS_FIELDS[1], AXIS_FIELDS[2], ("intensity", 12, FLOAT32)];
/// Size of a foreground point in bytes.
const POINT_LEN: u32 = 12;
const SWEEP_FIELDS: [(&str, u32, u8); 5] = [
    AXIS_FIELDS[0],
    AXIS_FIELDS[1],
    AXIS_FIELDS[2],
    ("beam", offset_of!(CloudPoint, beam) as u32, UINT16),
    ("class", offset_of!(CloudPoint, point_class) as u32, UINT8),
];
/// Types of fields, as in `PointField`.
const FLOAT32: u8 = 7;
const UINT16: u8 = 4;
const UINT8: u8 = 2;

#[cfg(test)]
mod tests {
    use scanhub_schema::{Family, ForegroundHead, ScanHead};

    use super::*;
    use crate::{POINT_CLOUD, read};

    fn scan(ranges: &[u16], step_mdeg: u32) -> Box<Scan> {
        Scan::of(ScanHead::lms(ranges.len(), -90_000, step_mdeg, 10, 13), ranges)
    }

    /// Returns the numbers after a frame ID of four letters, whose end is padded by three bytes.
    fn read_floats(message: &[u8]) -> Vec<f32> {
        let body = &message[4..];
        assert_eq!(body[8..20], [5, 0, 0, 0, b'r', b'e', b'a', b'r', 0, 0, 0, 0]);
        body[20..].chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect()
    }

    #[test]
    fn laser_scan_message_has_the_expected_values() {
        let header = Header { wall_ns: 1_700_000_001_000_000_000, period_us: 13_320, ..Header::default() };
        let mut message = Vec::new();
        let mut it = scan(&[100, 0x1FFF, 0x1FF7, 0x1FFE, 0, 0x1FF6], 1000);
        it.intensity_bits = 3;
        it.arrays().upper[1] = 7;
        laser_scan(&mut message, "rear", &header, &it);
        assert_eq!(message[..4], [0, 1, 0, 0]);
        // The first of six beams, 1 degree apart, was measured 5/360 of a revolution before the last one, which was
        // measured at the stamp.
        let nanosec = 1_000_000_000 - 5 * 37_000;
        assert_eq!(message[4..8], 1_700_000_000_i32.to_le_bytes());
        assert_eq!(message[8..12], (nanosec as u32).to_le_bytes());
        let values = read_floats(&message);
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(
            near(values[0], -std::f32::consts::FRAC_PI_2) && near(values[1], 5_f32.to_radians() + values[0])
        );
        assert!(near(values[2], 1_f32.to_radians()) && near(values[3], 37e-6) && near(values[4], 0.01332));
        // The maximum range is within the limit of the message.
        assert_eq!((values[5], values[6], values[13]), (0.01, 81.82, 81.82));
        assert_eq!(values[7].to_bits(), 6);
        assert_eq!(
            (values[8], values[9], values[10], values[12]),
            (1.0, f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY)
        );
        assert!(values[11].is_nan());
        assert_eq!(values[14].to_bits(), 6);
        assert_eq!(values[15..], [0.0, 7.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn scan_of_several_revolutions_has_no_time_increment() {
        let mut message = Vec::new();
        let between = scan(&[100; 9], 500);
        laser_scan(&mut message, "rear", &Header { wall_ns: 1 << 60, ..Header::default() }, &between);
        let values = read_floats(&message);
        assert_eq!((values[3], values[7].to_bits(), values[17].to_bits(), values.len()), (0.0, 9, 0, 18));
    }

    #[test]
    fn angles_of_a_clockwise_scanner_ascend() {
        let mut head = ScanHead::of_revolution(Family::Ld, 4);
        (head.beam_time_ns, head.first_beam_ns) = (25_000_000, 0);
        let mut it = Scan::of(head, &[1000, 2000, 3000, 4000]);
        it.arrays().upper.copy_from_slice(&[1, 2, 3, 4]);
        let mut message = Vec::new();
        laser_scan(&mut message, "rear", &Header { wall_ns: 5_000_000_000, ..Header::default() }, &it);
        let values = read_floats(&message);
        let quarter = std::f32::consts::FRAC_PI_2;
        // The grid begins ahead and continues clockwise. Its last beam points left and was measured 75 ms after the
        // first one.
        assert_eq!(message[4..12], [5, 0, 0, 0, 0xC0, 0x68, 0x78, 0x04]);
        assert_eq!(values[..5], [-3.0 * quarter, 0.0, quarter, -0.025, 0.1]);
        assert_eq!(values[8..12], [4.0, 3.0, 2.0, 1.0]);
        assert_eq!(values[13..], [4.0, 3.0, 2.0, 1.0]);
    }

    #[test]
    fn foreground_points_lie_on_their_beams() {
        let scan = Scan::of(ScanHead::lms(181, -90_000, 1000, 10, 13), &[500; 181]);
        let mut foreground = Foreground::of(181);
        let head = ForegroundHead { unit_um: 10_000, count: 181, beams: 4, ..ForegroundHead::default() };
        let arrays = foreground.begin(head);
        (arrays.bits[0], arrays.bits[11], arrays.bits[22]) = (1, 0b1100, 0b1_0000);
        arrays.ranges[..4].copy_from_slice(&[100, 0, 200, 300]);
        let header = Header { wall_ns: 7_000_000_000, ..Header::default() };
        let mut message = Vec::new();
        foreground_cloud(&mut message, "front", &header, &scan, &foreground);
        let decoded = read(&POINT_CLOUD, &message).unwrap();
        // The second beam, which points ahead, is too near and therefore not a point.
        let wanted =
            [[0.0, -1.0], [2.0 * 1_f64.to_radians().cos(), 2.0 * 1_f64.to_radians().sin()], [0.0, 3.0]];
        assert_eq!((decoded.number("height"), decoded.number("width")), (Some(1.0), Some(3.0)));
        assert_eq!((decoded.number("point_step"), decoded.number("row_step")), (Some(12.0), Some(36.0)));
        assert_eq!((decoded.text("header.frame_id"), decoded.number("is_dense")), (Some("front"), Some(1.0)));
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            assert_eq!(decoded.text(&format!("fields.{axis}.name")), Some(name));
            assert_eq!(decoded.number(&format!("fields.{axis}.offset")), Some(4.0 * axis as f64));
            assert_eq!(decoded.number(&format!("fields.{axis}.datatype")), Some(7.0));
        }
        let data: Vec<u8> = (0..36).map(|i| decoded.number(&format!("data.{i}")).unwrap() as u8).collect();
        for (point, [x, y]) in data.as_chunks::<12>().0.iter().zip(wanted) {
            let [got_x, got_y, got_z] =
                std::array::from_fn(|axis| f32::from_le_bytes(point.as_chunks().0[axis]));
            assert!(
                (f64::from(got_x) - x).abs() < 1e-6 && (f64::from(got_y) - y).abs() < 1e-6,
                "{got_x} {got_y}"
            );
            assert_eq!(got_z, 0.0);
        }
        // The stamp is the time of the scan's first beam.
        let nanoseconds = 1e9 * decoded.number("header.stamp.sec").unwrap()
            + decoded.number("header.stamp.nanosec").unwrap();
        assert_eq!(nanoseconds, (7_000_000_000 + scan.beam_ns(0)) as f64);
    }

    #[test]
    fn scan_has_a_point_for_each_reading() {
        let mut ranges = [500; 181];
        (ranges[0], ranges[1], ranges[90]) = (0x1FFF, 0x1FFF, 200);
        let scan = Scan::of(ScanHead::lms(181, -90_000, 1000, 10, 13), &ranges);
        let header = Header { wall_ns: 7_000_000_000, ..Header::default() };
        let mut message = Vec::new();
        scan_cloud(&mut message, "front", &header, &scan);
        let message = read(&POINT_CLOUD, &message).unwrap();
        assert_eq!((message.number("width"), message.number("point_step")), (Some(179.0), Some(16.0)));
        assert_eq!(message.text("fields.3.name"), Some("intensity"));
        let float = |at: usize| {
            f32::from_le_bytes(std::array::from_fn(|i| {
                message.number(&format!("data.{}", at + i)).unwrap() as u8
            }))
        };
        // Beam 90 points ahead. Its point has index 88.
        let ahead = [0, 4, 8, 12].map(|offset| float(88 * 16 + offset));
        assert!((ahead[0] - 2.0).abs() < 1e-6 && ahead[1].abs() < 1e-6, "{ahead:?}");
        assert_eq!(ahead[2..], [0.0, 0.0]);
    }

    #[test]
    fn sweep_cloud_has_points_beams_and_classes() {
        let point = CloudPoint { at: [1.5, -2.0, 0.25], beam: 300, point_class: 2, reserved: 0 };
        let header = Header { wall_ns: 7_000_000_009, ..Header::default() };
        let mut message = Vec::new();
        sweep_cloud(&mut message, &header, &[CloudPoint::default(), point]);
        let decoded = read(&POINT_CLOUD, &message).unwrap();
        assert_eq!((decoded.number("width"), decoded.number("row_step")), (Some(2.0), Some(32.0)));
        assert_eq!(
            (decoded.text("header.frame_id"), decoded.number("point_step")),
            (Some("base_link"), Some(16.0))
        );
        assert_eq!(decoded.number("header.stamp.nanosec"), Some(9.0));
        let fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("beam", 12, 4), ("class", 14, 2)];
        for (i, (name, offset, kind)) in fields.into_iter().enumerate() {
            assert_eq!(decoded.text(&format!("fields.{i}.name")), Some(name));
            assert_eq!(decoded.number(&format!("fields.{i}.offset")), Some(offset.into()));
            assert_eq!(decoded.number(&format!("fields.{i}.datatype")), Some(kind.into()));
        }
        let data: Vec<u8> = (16..32).map(|i| decoded.number(&format!("data.{i}")).unwrap() as u8).collect();
        assert_eq!(data, [0, 0, 0xC0, 0x3F, 0, 0, 0, 0xC0, 0, 0, 0x80, 0x3E, 44, 1, 2, 0]);
        assert_eq!(decoded.number("is_dense"), Some(1.0));
    }
}
