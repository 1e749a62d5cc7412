//! Golden size, offsets and bytes of a scan, and what its codes stand for.

use std::mem::{offset_of, size_of};

use scanhub_schema::{BEAMS, Code, Contents, Family, Scan, ScanHead, ScanWord};

use super::{golden, shared};

#[test]
fn scan_layout() {
    assert_eq!((size_of::<ScanHead>(), align_of::<ScanHead>(), Scan::HEAD, BEAMS), (64, 8, 64, 8192));
    assert_eq!((size_of::<ScanWord>(), align_of::<ScanWord>()), (8, 8));
    assert_eq!((offset_of!(ScanHead, first_angle), offset_of!(ScanHead, step)), (0, 8));
    assert_eq!((offset_of!(ScanHead, spacing), offset_of!(ScanHead, beam_time_ns)), (16, 20));
    assert_eq!((offset_of!(ScanHead, first_beam_ns), offset_of!(ScanHead, unit_um)), (24, 28));
    assert_eq!((offset_of!(ScanHead, count), offset_of!(ScanHead, valid_to)), (32, 34));
    assert_eq!((offset_of!(ScanHead, no_return), offset_of!(ScanHead, beyond)), (36, 38));
    assert_eq!((offset_of!(ScanHead, collapsed), offset_of!(ScanHead, family)), (40, 42));
    assert_eq!((offset_of!(ScanHead, flags), offset_of!(ScanHead, contents)), (43, 44));
    assert_eq!((offset_of!(ScanHead, intensity_bits), offset_of!(ScanHead, turns)), (45, 46));
    assert_eq!((offset_of!(ScanHead, reserved), offset_of!(ScanHead, turn_ns)), (47, 48));
    assert_eq!(offset_of!(ScanHead, reserved2), 52);
    assert_eq!([Contents::UPPER, Contents::WIDE, Contents::ANGLES, Scan::INCOMPLETE], [1, 2, 4, 1]);
    assert_eq!([0, 1, 2, 4, 7].map(|contents| Scan::len(100, contents)), [264, 364, 464, 664, 964]);
}

#[test]
fn the_bytes_of_a_scan_of_the_lms() {
    let head = ScanHead { intensity_bits: 3, ..ScanHead::lms(401, -50_000, 250, 10, 13) };
    let mut scan = Scan::of(head, &[0; 401]);
    let arrays = scan.arrays();
    (arrays.ranges[0], arrays.ranges[400]) = (0x1234, 0x1FFF);
    (arrays.upper[0], arrays.upper[400]) = (7, 6);
    let expected = golden(
        1267,
        &[
            (0, &(-0.872_664_625_997_164_8_f64).to_le_bytes()),
            (8, &0.004_363_323_129_985_824_f64.to_le_bytes()),
            (16, &0.004_363_323_f32.to_le_bytes()),
            (20, &[0x22, 0x24, 0, 0]),
            (24, &[0x20, 0xCD, 0x65, 0xFD]),
            (28, &[0x10, 0x27, 0, 0]),
            (32, &[0x91, 0x01, 0xF6, 0x1F, 0xFF, 0x1F, 0xF7, 0x1F]),
            (44, &[1, 3, 4, 0, 0x40, 0x3F, 0xCB, 0]),
            (64, &[0x34, 0x12]),
            (864, &[0xFF, 0x1F, 7]),
            (1266, &[6]),
        ],
    );
    assert_eq!(scan.bytes(), expected);
    assert_eq!(shared("scan.hex"), expected);
}

/// Clockwise, with exact angles, a missing packet, and all that can be said of a beam.
#[test]
fn the_bytes_of_a_scan_of_a_turn() {
    let head = ScanHead {
        first_angle: -0.25,
        step: -1.5,
        spacing: 0.75,
        beam_time_ns: 0x0102_0304,
        first_beam_ns: -2,
        unit_um: 250,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::Beyond.value(),
        collapsed: 0x0506,
        family: Family::Ld as u8,
        flags: Scan::INCOMPLETE,
        contents: Contents::ANGLES | Contents::WIDE,
        intensity_bits: 12,
        turns: 1,
        ..ScanHead::default()
    };
    let mut scan = Scan::of(head, &[0x1234, 0xFFEF, 0xFFFE, 0xFFFF, 0xFFFD]);
    let arrays = scan.arrays();
    arrays.angles.copy_from_slice(&[-0.125, -1.5, -3.25, f32::NAN, -6.5]);
    arrays.wide.copy_from_slice(&[0x0ABC, 1, 0, 0, 0x0FFF]);
    let expected = golden(
        104,
        &[
            (0, &(-0.25_f64).to_le_bytes()),
            (8, &(-1.5_f64).to_le_bytes()),
            (16, &0.75_f32.to_le_bytes()),
            (20, &[4, 3, 2, 1]),
            (24, &[0xFE, 0xFF, 0xFF, 0xFF, 250, 0, 0, 0]),
            (32, &[5, 0, 0xEF, 0xFF, 0xFE, 0xFF, 0xFD, 0xFF]),
            (40, &[6, 5, 1, 1, 6, 12, 1]),
            (64, &[0, 0, 0, 0xBE, 0, 0, 0xC0, 0xBF, 0, 0, 0x50, 0xC0, 0, 0, 0xC0, 0x7F, 0, 0, 0xD0, 0xC0]),
            (84, &[0x34, 0x12, 0xEF, 0xFF, 0xFE, 0xFF, 0xFF, 0xFF, 0xFD, 0xFF]),
            (94, &[0xBC, 0x0A, 1, 0, 0, 0, 0, 0, 0xFF, 0x0F]),
        ],
    );
    assert_eq!(scan.bytes(), expected);
    assert_eq!(shared("scan_turn.hex"), expected);
}

/// What a value above the ranges stands for: an LMS's own, and those of all others.
#[test]
fn codes() {
    let word = |code: Option<Code>| code.map(Code::name);
    let lms =
        Scan::of(ScanHead::lms(9, 0, 1000, 10, 13), &[8191, 8190, 8189, 8188, 8187, 8186, 8185, 8184, 8183]);
    let words: Vec<_> = (0..9).map(|i| word(lms.code(i)).unwrap()).collect();
    let expected = "no_return too_bright overflow overflow weak error overflow overflow beyond";
    assert_eq!(words.join(" "), expected);
    let head = ScanHead { family: Family::Ld as u8, valid_to: 0xFFEF, ..ScanHead::default() };
    let ranges: Vec<u16> = (0xFFEF..=0xFFFF).rev().collect();
    let other = Scan::of(head, &ranges);
    let words: Vec<_> = (0..16).map(|i| word(other.code(i)).unwrap()).collect();
    let expected = "not_measured no_return beyond too_near too_bright weak overflow error";
    assert_eq!(words[..8].join(" "), expected);
    assert!(words[8..].iter().all(|word| *word == "error"));
    assert_eq!((other.code(16), other.range(16)), (None, Some(0xFFEF)));
    assert_eq!(
        Family::ALL.map(|family| (family as u8, family.name())),
        [(0, "lms"), (1, "ld"), (2, "rplidar")]
    );
}
