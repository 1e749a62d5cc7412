//! Golden size, offsets and bytes of topic `motion`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{Motion, MotionMethod};

use super::{golden, shared};

#[test]
fn motion_layout() {
    assert_eq!((size_of::<Motion>(), align_of::<Motion>()), (120, 8));
    assert_eq!((offset_of!(Motion, x_m), offset_of!(Motion, y_m), offset_of!(Motion, yaw_rad)), (0, 8, 16));
    assert_eq!(
        (offset_of!(Motion, dx_m), offset_of!(Motion, dy_m), offset_of!(Motion, dyaw_rad)),
        (24, 28, 32)
    );
    assert_eq!((offset_of!(Motion, covariance), offset_of!(Motion, overlap)), (36, 72));
    assert_eq!(
        (offset_of!(Motion, method), offset_of!(Motion, flags), offset_of!(Motion, breaks)),
        (76, 77, 78)
    );
    assert_eq!((offset_of!(Motion, pose_covariance), offset_of!(Motion, reserved)), (80, 116));
    let names = MotionMethod::ALL.map(MotionMethod::name);
    assert_eq!(names.join(" "), "first refused beams points lines both");
}

#[test]
fn motion_bytes() {
    let motion = Motion {
        x_m: 1.0,
        y_m: -2.0,
        yaw_rad: 0.5,
        dx_m: 0.25,
        dy_m: -0.125,
        dyaw_rad: -0.0625,
        covariance: std::array::from_fn(|i| (i + 1) as f32 / 64.0),
        overlap: 0.75,
        method: MotionMethod::Both as u8,
        flags: Motion::DEGENERATE,
        breaks: 0x0102,
        pose_covariance: std::array::from_fn(|i| -((i + 1) as f32) / 32.0),
        reserved: 0,
    };
    let [x, y, yaw] = [1.0_f64, -2.0, 0.5].map(f64::to_le_bytes);
    let step = [0.25_f32, -0.125, -0.0625].map(f32::to_le_bytes);
    let covariance: [f32; 9] = std::array::from_fn(|i| (i + 1) as f32 / 64.0);
    let covariance = covariance.map(f32::to_le_bytes);
    let of_pose: [f32; 9] = std::array::from_fn(|i| -((i + 1) as f32) / 32.0);
    let of_pose = of_pose.map(f32::to_le_bytes);
    let expected = golden(
        120,
        &[
            (0, &x),
            (8, &y),
            (16, &yaw),
            (24, step.as_flattened()),
            (36, covariance.as_flattened()),
            (72, &0.75_f32.to_le_bytes()),
            (76, &[5, 1, 2, 1]),
            (80, of_pose.as_flattened()),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&motion), expected);
    assert_eq!(shared("motion.hex"), expected);
}
