//! Golden size, offsets and bytes of topics `tilt`, `cloud` and `obstacles`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{
    Cloud, CloudHead, CloudPoint, CloudWord, OBSTACLES, Obstacle, Obstacles, PointClass, Tilt,
};

use super::{golden, shared};

#[test]
fn tilt_layout() {
    assert_eq!((size_of::<Tilt>(), align_of::<Tilt>()), (16, 8));
    assert_eq!((offset_of!(Tilt, angle_rad), offset_of!(Tilt, rate_rad_s)), (0, 8));
}

#[test]
fn tilt_bytes() {
    let tilt = Tilt { angle_rad: -0.5, rate_rad_s: 2.0 };
    let expected = golden(16, &[(6, &[0xE0, 0xBF]), (15, &[0x40])]);
    assert_eq!(bytemuck::bytes_of(&tilt), expected);
    assert_eq!(bytemuck::bytes_of(&tilt), shared("tilt.hex"));
}

#[test]
fn cloud_layout() {
    assert_eq!((size_of::<CloudHead>(), align_of::<CloudHead>(), Cloud::HEAD), (16, 4, 16));
    assert_eq!((size_of::<CloudWord>(), align_of::<CloudWord>()), (8, 8));
    assert_eq!((offset_of!(CloudHead, sweep), offset_of!(CloudHead, generation)), (0, 4));
    assert_eq!((offset_of!(CloudHead, count), offset_of!(CloudHead, flags)), (8, 10));
    assert_eq!(offset_of!(CloudHead, reserved), 11);
    assert_eq!((size_of::<CloudPoint>(), align_of::<CloudPoint>()), (16, 4));
    assert_eq!((offset_of!(CloudPoint, at), offset_of!(CloudPoint, beam)), (0, 12));
    assert_eq!((offset_of!(CloudPoint, point_class), offset_of!(CloudPoint, reserved)), (14, 15));
    assert_eq!(Cloud::len(401), 6432);
}

#[test]
fn cloud_bytes() {
    let head = CloudHead {
        sweep: 0x0102_0304,
        generation: 0x0506_0708,
        flags: Cloud::FIRST | Cloud::LAST | Cloud::COMPLETE | Cloud::DOUBTED,
        ..CloudHead::default()
    };
    let point_class = PointClass::Behind as u8;
    let point = CloudPoint { at: [1.0, -1.0, 0.5], beam: 0x0102, point_class, reserved: 0 };
    let cloud = Cloud::of(head, &[CloudPoint::default(), point]);
    let point = [0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F, 2, 1, 3];
    let expected = golden(48, &[(0, &[4, 3, 2, 1, 8, 7, 6, 5, 2, 0, 15]), (32, &point)]);
    assert_eq!(cloud.bytes(), expected);
    assert_eq!(cloud.bytes(), shared("cloud.hex"));
}

#[test]
fn obstacles_layout() {
    assert_eq!((size_of::<Obstacles>(), align_of::<Obstacles>(), OBSTACLES), (3088, 4, 64));
    assert_eq!((offset_of!(Obstacles, sweep), offset_of!(Obstacles, generation)), (0, 4));
    assert_eq!((offset_of!(Obstacles, left_out), offset_of!(Obstacles, count)), (8, 12));
    assert_eq!((offset_of!(Obstacles, flags), offset_of!(Obstacles, reserved)), (13, 14));
    assert_eq!(offset_of!(Obstacles, obstacle_array), 16);
    assert_eq!((size_of::<Obstacle>(), align_of::<Obstacle>()), (48, 4));
    assert_eq!((offset_of!(Obstacle, middle), offset_of!(Obstacle, low)), (0, 12));
    assert_eq!((offset_of!(Obstacle, high), offset_of!(Obstacle, distance_m)), (24, 36));
    assert_eq!((offset_of!(Obstacle, points), offset_of!(Obstacle, flags)), (40, 44));
    assert_eq!(offset_of!(Obstacle, reserved), 45);
}

#[test]
fn obstacles_bytes() {
    let mut found = Obstacles {
        sweep: 0x0102_0304,
        generation: 0x0506_0708,
        left_out: 0x090A_0B0C,
        count: 63,
        flags: Obstacles::COMPLETE | Obstacles::DOUBTED,
        ..Obstacles::default()
    };
    found.push(Obstacle {
        middle: [1.0, -1.0, 0.5],
        low: [0.5, -2.0, 0.25],
        high: [2.0, -0.5, 4.0],
        distance_m: 0.5,
        points: 0x0D0E_0F10,
        flags: Obstacle::FOREGROUND | Obstacle::NEAR,
        ..Obstacle::default()
    });
    let obstacle = [
        0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F, 0, 0, 0, 0x3F, 0, 0, 0, 0xC0, 0, 0, 0x80, 0x3E, 0,
        0, 0, 0x40, 0, 0, 0, 0xBF, 0, 0, 0x80, 0x40, 0, 0, 0, 0x3F, 0x10, 0x0F, 0x0E, 0x0D, 3,
    ];
    let head = [4, 3, 2, 1, 8, 7, 6, 5, 0x0C, 0x0B, 0x0A, 9, 64, 12];
    let expected = golden(3088, &[(0, &head[..]), (16 + 63 * 48, &obstacle)]);
    assert_eq!(bytemuck::bytes_of(&found), expected);
    assert_eq!(bytemuck::bytes_of(&found), shared("obstacles.hex"));
}
