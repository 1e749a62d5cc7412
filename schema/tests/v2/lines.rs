//! Golden size, offsets and bytes of topic `lines`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{Corner, LINES, Line, Lines};

use super::{golden, shared};

#[test]
fn lines_layout() {
    assert_eq!((size_of::<Lines>(), align_of::<Lines>()), (3340, 4));
    assert_eq!((offset_of!(Lines, count), offset_of!(Lines, corners), offset_of!(Lines, flags)), (0, 1, 2));
    assert_eq!(
        (offset_of!(Lines, readings), offset_of!(Lines, on_lines), offset_of!(Lines, noise_m)),
        (4, 6, 8)
    );
    assert_eq!((offset_of!(Lines, line_array), offset_of!(Lines, corner_array)), (12, 2572));
    assert_eq!((size_of::<Line>(), align_of::<Line>(), LINES), (40, 4, 64));
    assert_eq!((offset_of!(Line, x1_m), offset_of!(Line, y1_m), offset_of!(Line, x2_m)), (0, 4, 8));
    assert_eq!((offset_of!(Line, y2_m), offset_of!(Line, r_m), offset_of!(Line, alpha_rad)), (12, 16, 20));
    assert_eq!(
        (offset_of!(Line, sd_r_m), offset_of!(Line, sd_alpha_rad), offset_of!(Line, first)),
        (24, 28, 32)
    );
    assert_eq!((offset_of!(Line, last), offset_of!(Line, points), offset_of!(Line, reserved)), (34, 36, 38));
    assert_eq!((size_of::<Corner>(), align_of::<Corner>()), (12, 4));
    assert_eq!((offset_of!(Corner, x_m), offset_of!(Corner, y_m)), (0, 4));
    assert_eq!((offset_of!(Corner, first_line), offset_of!(Corner, second_line)), (8, 10));
}

#[test]
fn lines_bytes() {
    let mut lines = Lines {
        count: 64,
        corners: 64,
        flags: Lines::OVERFLOW,
        readings: 0x0102,
        on_lines: 0x0304,
        noise_m: 1.0,
        ..Lines::default()
    };
    lines.line_array[63] = Line {
        x1_m: 1.0,
        y1_m: -1.0,
        x2_m: 2.0,
        y2_m: -2.0,
        r_m: 0.5,
        alpha_rad: -0.5,
        sd_r_m: 0.25,
        sd_alpha_rad: 4.0,
        first: 0x0506,
        last: 0x0708,
        points: 0x090A,
        reserved: 0,
    };
    lines.corner_array[63] = Corner { x_m: 1.0, y_m: -1.0, first_line: 62, second_line: 63 };
    let line = [
        0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x40, 0, 0, 0, 0xC0, 0, 0, 0, 0x3F, 0, 0, 0, 0xBF, 0, 0,
        0x80, 0x3E, 0, 0, 0x80, 0x40, 6, 5, 8, 7, 0x0A, 9,
    ];
    let corner = [0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 62, 0, 63];
    let head = [64, 64, 1, 0, 2, 1, 4, 3, 0, 0, 0x80, 0x3F];
    let expected = golden(3340, &[(0, &head), (12 + 63 * 40, &line), (2572 + 63 * 12, &corner)]);
    assert_eq!(bytemuck::bytes_of(&lines), expected);
    assert_eq!(bytemuck::bytes_of(&lines), shared("lines.hex"));
}
