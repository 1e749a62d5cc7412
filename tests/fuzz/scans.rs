//! Scans from the bytes of a fuzzing input.

use scanhub_schema::{ArrayFlags, Family, MAX_BEAMS, Pose, Scan, ScanArrays, ScanHead};

/// Changes the layout of the scan: the number and angles of its beams, its unit and its longest range. Some of the
/// possible layouts are those of real scanners.
pub(super) fn layout(bytes: &mut Bytes<'_>, scan: &mut Scan) {
    let variant =
        [(361, -90_000, 500), (181, -90_000, 1000), (401, -50_000, 250)].get(usize::from(bytes.u8()));
    let (count, first_angle_mdeg, step_mdeg) =
        variant.copied().unwrap_or_else(|| (bytes.u16(), bytes.i32(), bytes.u16() as i16));
    let in_radians = |mdeg: i32| (f64::from(mdeg) / 1000.0).to_radians();
    let (unit_mm, range_bits) = (bytes.u8(), bytes.u8());
    let greatest = ((1_u32 << (range_bits % 17)) - 1) as u16;
    let head = ScanHead {
        first_angle: in_radians(first_angle_mdeg),
        step: in_radians(step_mdeg.into()),
        unit_um: 1000 * u32::from(unit_mm),
        count: count.min(MAX_BEAMS as u16),
        valid_to: greatest.saturating_sub(9),
        no_return: greatest,
        beyond: greatest.saturating_sub(8),
        family: if range_bits & 0x80 == 0 { Family::Lms } else { Family::Ld } as u8,
        intensity_bits: bytes.u8(),
        contents: bytes.u8() & ArrayFlags::ALL,
        ..ScanHead::default()
    };
    scan.begin(head);
}

/// Fills the scan with groups of neighboring beams that have the same reading. Stops when all beams are set or no bytes
/// are left.
pub(super) fn fill(bytes: &mut Bytes<'_>, scan: &mut Scan) {
    let ScanArrays { angles, ranges, wide, upper } = scan.arrays();
    let mut end = 0;
    while end < ranges.len() && !bytes.is_empty() {
        let start = end;
        end = (start + 1 + usize::from(bytes.u8())).min(ranges.len());
        ranges[start..end].fill(bytes.u16());
        upper.get_mut(start..end).unwrap_or_default().fill(bytes.u8());
        if let Some(wide) = wide.get_mut(start..end) {
            wide.fill(bytes.u16());
        }
        if let Some(angles) = angles.get_mut(start..end) {
            angles.fill(bytes.number() as f32);
        }
    }
}

/// The bytes of the input that were not used yet. When no bytes are left, all values are zero.
pub(super) struct Bytes<'a>(pub(super) &'a [u8]);

impl Bytes<'_> {
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn pose(&mut self) -> Pose {
        Pose {
            x_m: self.number(),
            y_m: self.number(),
            yaw_rad: self.number(),
            upside_down: self.u8(),
            ..Pose::default()
        }
    }

    fn take<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.0.split_off_first().copied().unwrap_or(0))
    }

    pub(super) fn u8(&mut self) -> u8 {
        let [byte] = self.take();
        byte
    }

    pub(super) fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }

    pub(super) fn i32(&mut self) -> i32 {
        i32::from_le_bytes(self.take())
    }

    /// Returns a number from the input, which may be infinite or NaN. Most numbers are in the range of a sensor's
    /// coordinates.
    pub(super) fn number(&mut self) -> f64 {
        match self.u8() {
            0 => f64::from_bits(u64::from_le_bytes(self.take())),
            _ => f64::from(i16::from_le_bytes(self.take())) / 1000.0,
        }
    }
}
