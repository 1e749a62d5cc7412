//! Points as `sensor_msgs/msg/PointCloud2`: a scan, its foreground, and a sweep in three dimensions.

use std::mem::offset_of;

use scanhub_schema::{CloudPoint, Foreground, Header, Scan};

use crate::BASE_FRAME;
use crate::cdr::Cdr;
use crate::laser_scan::stamp_ns;

/// Appends the readings of `scan` in frame `frame` to `message`: a point for each beam with a reading, in the order of the
/// beams, with the stamp of the LaserScan. A point is x, y, z in meters (z is 0) and the intensity that the scanner reports
/// (0 if it reports none), as 32-bit floats.
pub fn scan_cloud(message: &mut Vec<u8>, frame: &str, header: &Header, scan: &Scan) {
    let points = || (0..scan.beams()).filter_map(|i| Some((i, scan.distance_m(i)?)));
    let width = points().count();
    let intensities = scan.intensities();
    let point = OF_SCANS.len() as u32 * 4;
    let mut cdr = begin(message, stamp_ns(header, scan), frame, &OF_SCANS, (point, width));
    for (i, meters) in points() {
        let (sin, cos) = scan.angle(i).sin_cos();
        let intensity = intensities.get(i).map_or(0.0, f64::from);
        let values = [meters * cos, meters * sin, 0.0, intensity];
        cdr.bytes(values.map(|value| value as f32).map(f32::to_le_bytes).as_flattened());
    }
    cdr.bool(true);
}

/// Writes `foreground` of `scan`, of the frame `frame`, to the end of `message`: a point x, y, z (metres, 32-bit floats; z
/// is 0) for each of its beams that has a distance, in the order of the beams, stamped as the scan is.
/// Both must be of the same telegram: the scan says where its beams point.
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
    let mut cdr = begin(message, stamp_ns(header, scan), frame, &AXES, (POINT, width));
    for (i, range) in points() {
        let metres = f64::from(range) * f64::from(foreground.unit_um) / 1e6;
        let (sin, cos) = scan.angle(i).sin_cos();
        cdr.bytes(
            [metres * cos, metres * sin, 0.0].map(|axis| axis as f32).map(f32::to_le_bytes).as_flattened(),
        );
    }
    // No point is without a number.
    cdr.bool(true);
}

/// Writes the `points` of a sweep, of the robot's frame, to the end of `message`: x, y, z (metres, 32-bit floats), beam (its
/// number in the scan, 16 bits) and class (8 bits: 0 unknown, 1 background, 2 foreground, 3 behind it), stamped as `header` is,
/// which is that of the last of them.
pub fn sweep_cloud(message: &mut Vec<u8>, header: &Header, points: &[CloudPoint]) {
    let point = size_of::<CloudPoint>() as u32;
    let mut cdr = begin(message, header.wall_ns, BASE_FRAME, &OF_SWEEPS, (point, points.len()));
    for CloudPoint { at, beam, point_class, .. } in points {
        cdr.bytes(at.map(f32::to_le_bytes).as_flattened());
        cdr.bytes(&beam.to_le_bytes());
        cdr.bytes(&[*point_class, 0]);
    }
    cdr.bool(true);
}

/// Writes all that stands before the points: of each a name, offset and type of its fields, and its bytes.
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

const AXES: [(&str, u32, u8); 3] = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
const OF_SCANS: [(&str, u32, u8); 4] = [AXES[0], AXES[1], AXES[2], ("intensity", 12, FLOAT32)];
/// Bytes of a point of a foreground.
const POINT: u32 = 12;
const OF_SWEEPS: [(&str, u32, u8); 5] = [
    AXES[0],
    AXES[1],
    AXES[2],
    ("beam", offset_of!(CloudPoint, beam) as u32, UINT16),
    ("class", offset_of!(CloudPoint, point_class) as u32, UINT8),
];
/// `PointField.FLOAT32` and others.
const FLOAT32: u8 = 7;
const UINT16: u8 = 4;
const UINT8: u8 = 2;

#[cfg(test)]
mod tests {
    use scanhub_schema::{ForegroundHead, ScanHead};

    use super::*;
    use crate::{POINT_CLOUD, read};

    #[test]
    fn points_are_where_the_beams_of_the_foreground_hit() {
        let scan = Scan::of(ScanHead::lms(181, -90_000, 1000, 10, 13), &[500; 181]);
        let mut foreground = Foreground::of(181);
        let head = ForegroundHead { unit_um: 10_000, count: 181, beams: 4, ..ForegroundHead::default() };
        let arrays = foreground.begin(head);
        (arrays.bits[0], arrays.bits[11], arrays.bits[22]) = (1, 0b1100, 0b1_0000);
        arrays.ranges[..4].copy_from_slice(&[100, 0, 200, 300]);
        let header = Header { wall_ns: 7_000_000_000, ..Header::default() };
        let mut message = Vec::new();
        foreground_cloud(&mut message, "front", &header, &scan, &foreground);
        let told = read(&POINT_CLOUD, &message).unwrap();
        // The second of them, ahead and too near, is no point.
        let wanted =
            [[0.0, -1.0], [2.0 * 1_f64.to_radians().cos(), 2.0 * 1_f64.to_radians().sin()], [0.0, 3.0]];
        assert_eq!((told.number("height"), told.number("width")), (Some(1.0), Some(3.0)));
        assert_eq!((told.number("point_step"), told.number("row_step")), (Some(12.0), Some(36.0)));
        assert_eq!((told.text("header.frame_id"), told.number("is_dense")), (Some("front"), Some(1.0)));
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            assert_eq!(told.text(&format!("fields.{axis}.name")), Some(name));
            assert_eq!(told.number(&format!("fields.{axis}.offset")), Some(4.0 * axis as f64));
            assert_eq!(told.number(&format!("fields.{axis}.datatype")), Some(7.0));
        }
        let data: Vec<u8> = (0..36).map(|i| told.number(&format!("data.{i}")).unwrap() as u8).collect();
        for (point, [x, y]) in data.as_chunks::<12>().0.iter().zip(wanted) {
            let [got_x, got_y, got_z] =
                std::array::from_fn(|axis| f32::from_le_bytes(point.as_chunks().0[axis]));
            assert!(
                (f64::from(got_x) - x).abs() < 1e-6 && (f64::from(got_y) - y).abs() < 1e-6,
                "{got_x} {got_y}"
            );
            assert_eq!(got_z, 0.0);
        }
        // As late as the scan's first beam.
        let nanoseconds =
            1e9 * told.number("header.stamp.sec").unwrap() + told.number("header.stamp.nanosec").unwrap();
        assert_eq!(nanoseconds, (7_000_000_000 + scan.beam_ns(0)) as f64);
    }

    #[test]
    fn a_scan_has_a_point_for_each_reading() {
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
        // Beam 90 looks ahead, and is the 89th with a reading.
        let ahead = [0, 4, 8, 12].map(|offset| float(88 * 16 + offset));
        assert!((ahead[0] - 2.0).abs() < 1e-6 && ahead[1].abs() < 1e-6, "{ahead:?}");
        assert_eq!(ahead[2..], [0.0, 0.0]);
    }

    #[test]
    fn a_sweep_has_its_points_with_beams_and_classes() {
        let point = CloudPoint { at: [1.5, -2.0, 0.25], beam: 300, point_class: 2, reserved: 0 };
        let header = Header { wall_ns: 7_000_000_009, ..Header::default() };
        let mut message = Vec::new();
        sweep_cloud(&mut message, &header, &[CloudPoint::default(), point]);
        let told = read(&POINT_CLOUD, &message).unwrap();
        assert_eq!((told.number("width"), told.number("row_step")), (Some(2.0), Some(32.0)));
        assert_eq!(
            (told.text("header.frame_id"), told.number("point_step")),
            (Some("base_link"), Some(16.0))
        );
        assert_eq!(told.number("header.stamp.nanosec"), Some(9.0));
        let fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("beam", 12, 4), ("class", 14, 2)];
        for (i, (name, offset, kind)) in fields.into_iter().enumerate() {
            assert_eq!(told.text(&format!("fields.{i}.name")), Some(name));
            assert_eq!(told.number(&format!("fields.{i}.offset")), Some(offset.into()));
            assert_eq!(told.number(&format!("fields.{i}.datatype")), Some(kind.into()));
        }
        let data: Vec<u8> = (16..32).map(|i| told.number(&format!("data.{i}")).unwrap() as u8).collect();
        assert_eq!(data, [0, 0, 0xC0, 0x3F, 0, 0, 0, 0xC0, 0, 0, 0x80, 0x3E, 44, 1, 2, 0]);
        assert_eq!(told.number("is_dense"), Some(1.0));
    }
}
