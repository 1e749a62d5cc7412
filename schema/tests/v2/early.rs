//! Golden size, offsets and bytes of topic `early`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{Early, Verdict};

use super::{golden, shared};

#[test]
fn early_layout() {
    assert_eq!((size_of::<Early>(), align_of::<Early>()), (12, 4));
    assert_eq!((offset_of!(Early, verdict), offset_of!(Early, flags), offset_of!(Early, beam)), (0, 1, 2));
    assert_eq!(
        (offset_of!(Early, distance_mm), offset_of!(Early, bytes_seen), offset_of!(Early, beams_seen)),
        (4, 8, 10)
    );
}

#[test]
fn early_bytes() {
    let early = Early {
        verdict: Verdict::Stop as u8,
        flags: Early::WITHDRAWN,
        beam: 0x0102,
        distance_mm: 0x0304_0506,
        bytes_seen: 0x0708,
        beams_seen: 0x090A,
    };
    let expected = golden(12, &[(0, &[2, 1, 2, 1, 6, 5, 4, 3, 8, 7, 0x0A, 9])]);
    assert_eq!(bytemuck::bytes_of(&early), expected);
    assert_eq!(bytemuck::bytes_of(&early), shared("early.hex"));
}
