//! The foreground of a scan as `sensor_msgs/msg/PointCloud2`. Refuses to know the background.

use schema::{Foreground, Header, Scan};

use crate::cdr::Cdr;
use crate::laser_scan::stamp_ns;

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
    let mut cdr = Cdr::begin(message);
    cdr.header(stamp_ns(header, scan), frame);
    cdr.u32(1);
    cdr.u32(width as u32);
    cdr.u32(AXES.len() as u32);
    for (place, axis) in AXES.into_iter().enumerate() {
        cdr.text(axis);
        cdr.u32(4 * place as u32);
        cdr.u8(FLOAT32);
        cdr.u32(1);
    }
    cdr.bool(false);
    cdr.u32(POINT);
    cdr.u32(POINT * width as u32);
    cdr.u32(POINT * width as u32);
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

const AXES: [&str; 3] = ["x", "y", "z"];
/// Bytes of a point.
const POINT: u32 = 12;
/// `PointField.FLOAT32`.
const FLOAT32: u8 = 7;

#[cfg(test)]
mod tests {
    use schema::{ForegroundHead, ScanHead};

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
}
