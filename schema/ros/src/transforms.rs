//! The poses of sensors, as `tf2_msgs/msg/TFMessage`. Refuses to know scans.

use scanhub_schema::Pose;

use crate::BASE_FRAME;
use crate::cdr::Cdr;

/// Appends the `poses` of the sensors on the robot, by their frames, to `message`, stamped `stamp_ns` (since 1970). It contains all of them,
/// because a late subscriber gets only the last message of its topic.
///
/// A sensor that is mounted upside down is rotated by half a turn around its x axis, then by its yaw around the robot's z:
/// so the angles of its scans, which it counts as usual, run in the other direction.
pub fn static_transforms(message: &mut Vec<u8>, stamp_ns: u64, poses: &[(String, Pose)]) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(poses.len() as u32);
    for (frame, pose) in poses {
        cdr.header(stamp_ns, BASE_FRAME);
        cdr.text(frame);
        for value in [pose.x_m, pose.y_m, 0.0].into_iter().chain(rotation(pose)) {
            cdr.f64(value);
        }
    }
}

/// The quaternion x, y, z, w that takes a direction in the sensor's frame to one in the robot's.
fn rotation(pose: &Pose) -> [f64; 4] {
    let (sin, cos) = (pose.yaw_rad / 2.0).sin_cos();
    if pose.upside_down == 0 { [0.0, 0.0, sin, cos] } else { [cos, sin, 0.0, 0.0] }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `direction` turned by the quaternion: v + 2 u x (u x v + w v).
    fn turned([x, y, z, w]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let u = [x, y, z];
        let inner = cross(u, v);
        let outer = cross(u, std::array::from_fn(|i| inner[i] + w * v[i]));
        std::array::from_fn(|i| v[i] + 2.0 * outer[i])
    }

    #[test]
    fn a_beam_points_where_its_pose_says() {
        for (yaw_rad, upside_down) in [(0.0, 0), (0.7, 0), (2.9, 1), (-1.2, 1), (0.0, 1)] {
            let pose = Pose { yaw_rad, upside_down, ..Pose::default() };
            for angle_deg in [-90.0_f64, -60.0, 0.0, 55.0, 90.0] {
                let (sin, cos) = angle_deg.to_radians().sin_cos();
                let [x, y, z] = turned(rotation(&pose), [cos, sin, 0.0]);
                let (wanted_x, wanted_y) = pose.direction(angle_deg.to_radians());
                let apart = (x - wanted_x).abs() + (y - wanted_y).abs() + z.abs();
                assert!(apart < 1e-12, "{pose:?} {angle_deg}: {x} {y} {z}, not {wanted_x} {wanted_y}");
            }
        }
    }

    #[test]
    fn a_message_has_all_sensors() {
        let front = Pose { x_m: 0.5, ..Pose::default() };
        let poses = [("front".to_owned(), front), ("rear".to_owned(), Pose::default())];
        let mut message = Vec::new();
        static_transforms(&mut message, 1_700_000_000_000_000_007, &poses);
        assert_eq!(message[4..8], [2, 0, 0, 0]);
        assert_eq!(message[8..12], 1_700_000_000_u32.to_le_bytes());
        assert_eq!(message[12..16], [7, 0, 0, 0]);
        // Stamp, two texts with their ends, up to a multiple of eight: seven numbers.
        let x = 4 + (4 + 8 + 4 + 12 + 4 + 6_usize).next_multiple_of(8);
        assert_eq!(message[x..x + 8], 0.5f64.to_le_bytes());
        assert!(message[x + 56..].windows(5).any(|some| some == b"rear\0"));
    }
}
