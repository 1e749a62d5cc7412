//! What a mount and its points say.

use scanhub_schema::{Cloud, CloudHead, CloudPoint, Obstacle, Obstacles, PointClass};

pub(super) fn cloud() -> Box<Cloud> {
    let point = |at, beam, class| CloudPoint { at, beam, point_class: class as u8, reserved: 0 };
    let flags = Cloud::FIRST | Cloud::COMPLETE;
    let points = [
        point([1.5, -2.25, 0.125], 0, PointClass::Background),
        point([1.25, 0.0, 0.5], 180, PointClass::Foreground),
        point([-0.5, 3.75, -0.0625], 360, PointClass::Unknown),
    ];
    Cloud::of(CloudHead { sweep: 12, generation: 3, flags, ..CloudHead::default() }, &points)
}

pub(super) fn obstacles() -> Obstacles {
    let mut found = Obstacles {
        sweep: 12,
        generation: 3,
        left_out: 1,
        flags: Obstacles::COMPLETE,
        ..Obstacles::default()
    };
    found.push(Obstacle {
        middle: [1.25, 0.0, 0.5],
        low: [1.125, -0.125, 0.0],
        high: [1.375, 0.125, 1.0],
        distance_m: 1.125,
        points: 120,
        flags: Obstacle::FOREGROUND | Obstacle::NEAR,
        ..Obstacle::default()
    });
    found.push(Obstacle {
        middle: [4.0, -1.5, 0.75],
        low: [3.875, -1.75, 0.0],
        high: [4.25, -1.25, 1.75],
        distance_m: 4.1875,
        points: 64,
        flags: Obstacle::FOREGROUND,
        ..Obstacle::default()
    });
    found
}
