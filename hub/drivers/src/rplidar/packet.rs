//! Formats of the packets that contain points, and the decoders of these formats. Sources: the manufacturer's protocol
//! description and the manufacturer's decoder. A packet of several points contains only the angle of its first point.
//! The angles of the other points follow from the next packet.

/// Format of the packets of a stream. HQ packets (83h) are not supported.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PacketFormat {
    /// One point, without a checksum.
    Standard,
    /// 32 points, each with a compensation of its angle.
    Express,
    /// 96 points. Two of three points are stored as differences.
    Ultra,
    /// 40 points.
    Dense,
    /// 64 points, each with its quality.
    UltraDense,
}

/// Point of a packet.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PacketPoint {
    /// Angle in degrees by which the point lies before its evenly spaced angle, which is the angle that it would have
    /// if all points were evenly spaced. Negative if the point lies after this angle.
    pub before: f32,
    /// Range in millimeters; 0 means no return.
    pub range: u16,
    /// Strength of the echo; 0 if the format does not contain it.
    pub quality: u8,
}

impl PacketFormat {
    /// Every format.
    pub const ALL: [PacketFormat; 5] = [
        PacketFormat::Standard,
        PacketFormat::Express,
        PacketFormat::Ultra,
        PacketFormat::Dense,
        PacketFormat::UltraDense,
    ];
    /// Length of the longest packet, in bytes.
    pub const MAX_LEN: usize = 170;
    /// Maximum number of points in a packet.
    pub const MAX_POINTS: usize = 96;

    /// Returns the format whose type in a descriptor is `answer`.
    pub(crate) fn of(answer: u8) -> Option<PacketFormat> {
        PacketFormat::ALL.into_iter().find(|kind| kind.response_type() == answer)
    }

    /// Returns the type of this format in a descriptor.
    pub(crate) const fn response_type(self) -> u8 {
        match self {
            PacketFormat::Standard => 0x81,
            PacketFormat::Express => 0x82,
            PacketFormat::Ultra => 0x84,
            PacketFormat::Dense => 0x85,
            PacketFormat::UltraDense => 0x86,
        }
    }

    /// Returns the length of a packet, in bytes.
    pub const fn byte_len(self) -> usize {
        match self {
            PacketFormat::Standard => 5,
            PacketFormat::Express | PacketFormat::Dense => 84,
            PacketFormat::Ultra => 132,
            PacketFormat::UltraDense => PacketFormat::MAX_LEN,
        }
    }

    /// Returns the number of points in a packet.
    pub const fn points(self) -> usize {
        match self {
            PacketFormat::Standard => 1,
            PacketFormat::Express => 32,
            PacketFormat::Ultra => PacketFormat::MAX_POINTS,
            PacketFormat::Dense => 40,
            PacketFormat::UltraDense => 64,
        }
    }

    /// Returns whether packets have a checksum.
    pub const fn is_checked(self) -> bool {
        !matches!(self, PacketFormat::Standard)
    }

    /// Returns an upper bound for [`PacketPoint::before`], in degrees, with a margin.
    pub(crate) const fn max_before(self) -> f64 {
        match self {
            PacketFormat::Dense | PacketFormat::UltraDense => 0.5,
            PacketFormat::Standard | PacketFormat::Express | PacketFormat::Ultra => 10.0,
        }
    }

    /// Returns the maximum angle in degrees by which a point lies after its evenly spaced angle.
    pub(crate) const fn max_after(self) -> f64 {
        if matches!(self, PacketFormat::Ultra) { 21.0 } else { 0.0 }
    }

    /// Returns whether `bytes` may be the start of a packet. Returns `true` if `bytes` is empty.
    pub(crate) fn begins(self, bytes: &[u8]) -> bool {
        let fits = |at: usize, is_match: fn(u8) -> bool| bytes.get(at).is_none_or(|byte| is_match(*byte));
        match self {
            // The second bit is the inverse of the first bit, which marks the start of a revolution. The lowest bit of
            // the angle is 1.
            PacketFormat::Standard => {
                fits(0, |byte| (byte ^ byte >> 1) & 1 == 1) && fits(1, |byte| byte & 1 == 1)
            }
            _ => fits(0, |byte| byte >> 4 == 0xA) && fits(1, |byte| byte >> 4 == 0x5),
        }
    }

    /// Returns whether `packet` is valid. Checks the first bytes, the angle and, if the format has one, the checksum.
    pub(crate) fn is_valid(self, packet: &[u8]) -> bool {
        let is_sum_valid = || {
            let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
            sum == packet[0] & 15 | packet[1] << 4
        };
        self.begins(packet) && (!self.is_checked() || is_sum_valid()) && self.start_angle(packet) <= 360.0
    }

    /// Returns the angle of the first point of `packet`, in degrees clockwise.
    pub fn start_angle(self, packet: &[u8]) -> f32 {
        match self {
            PacketFormat::Standard => f32::from(word(packet, 1) >> 1) / 64.0,
            PacketFormat::UltraDense => f32::from(word(packet, 8) & 0x7FFF) / 64.0,
            _ => f32::from(word(packet, 2) & 0x7FFF) / 64.0,
        }
    }

    /// Returns point `i` of `packet`. `next` is the packet that follows.
    pub fn point(self, packet: &[u8], next: &[u8], i: usize) -> PacketPoint {
        match self {
            PacketFormat::Standard => {
                let (quality, range) = (packet[0] >> 2, word(packet, 3) / 4);
                PacketPoint { before: 0.0, range: if quality == 0 { 0 } else { range }, quality }
            }
            PacketFormat::Express => {
                let cabin = &packet[4 + i / 2 * 5..][..5];
                let half = i % 2;
                let (word, low) = (word(cabin, 2 * half), cabin[4] >> (4 * half) & 15);
                let eighths = u16::from(low) | (word & 3) << 4;
                PacketPoint { before: f32::from(eighths) / 8.0, range: word >> 2, quality: 0 }
            }
            PacketFormat::Ultra => ultra(packet, next, i),
            PacketFormat::Dense => PacketPoint { before: 0.0, range: word(packet, 4 + 2 * i), quality: 0 },
            PacketFormat::UltraDense => ultra_dense(packet, i),
        }
    }
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

/// Decodes point `i` of an ultra packet. Points form groups of three. The first point of a group has an absolute range.
/// The second point is a difference from the first point. The third point is a difference from the first point of the
/// next group. If the first point has no return, the second point is also a difference from the first point of the next
/// group.
fn ultra(packet: &[u8], next: &[u8], i: usize) -> PacketPoint {
    let triple = |packet: &[u8], n: usize| {
        u32::from(word(packet, 4 + 4 * n)) | u32::from(word(packet, 6 + 4 * n)) << 16
    };
    let (n, cabins) = (i / 3, PacketFormat::Ultra.points() / 3);
    let this_triple = triple(packet, n);
    let next_triple = if n + 1 < cabins { triple(packet, n + 1) } else { triple(next, 0) };
    let ((major, level), (next_major, next_level)) = (major(this_triple), major(next_triple));
    // A triple also contains two signed numbers of ten bits.
    let (first, second) = ((this_triple << 10) as i32 >> 22, this_triple as i32 >> 22);
    let differs = |difference: i32, base: i32, level: u32| {
        if matches!(difference, -512 | 511) { 0 } else { base + (difference << level) }
    };
    let mm = match i % 3 {
        0 => major,
        1 if major == 0 => differs(first, next_major, next_level),
        1 => differs(first, major, level),
        _ => differs(second, next_major, next_level),
    };
    let range = u16::try_from(mm).unwrap_or(0);
    PacketPoint { before: before(range), range, quality: 0 }
}

/// Decodes an absolute range, whose resolution is coarser for longer ranges. Returns the range in millimeters, and the
/// number of bits by which a difference from this range is shifted.
fn major(three: u32) -> (i32, u32) {
    let stored = (three & 0xFFF) as i32;
    const SCALES: [(i32, i32, u32); 4] =
        [(3328, 1 << 14, 4), (1792, 1 << 12, 3), (1280, 1 << 11, 2), (512, 1 << 9, 1)];
    let scale = SCALES.into_iter().find(|(from, ..)| stored >= *from);
    scale.map_or((stored, 0), |(from, base, level)| (base + ((stored - from) << level), level))
}

/// Returns the angle in degrees by which a point at `range` millimeters lies before its evenly spaced angle. The angle
/// depends on the range because the light does not return along the path on which it was sent.
fn before(range: u16) -> f32 {
    if range < 50 {
        return 7.5;
    }
    let k = f32::from(u16::try_from(98_361 / (4 * u32::from(range))).unwrap_or(0));
    let radians = k / 1_024.0 + k * k * k / 6_442_450_944.0;
    8.0 - radians.to_degrees()
}

/// Decodes point `i` of an ultra-dense packet. A point has 20 bits, with range and quality in one of four scales.
fn ultra_dense(packet: &[u8], i: usize) -> PacketPoint {
    let cabin = &packet[10 + i / 2 * 5..][..5];
    let half = i % 2;
    let bits = u32::from(word(cabin, 2 * half)) | u32::from(cabin[4] >> (4 * half) & 15) << 16;
    let (range, quality) = match bits & 3 {
        0 => (2 * (bits >> 2 & 0x3FF), bits >> 12),
        1 => (3 * (bits >> 2 & 0x7FF) + 2_046, bits >> 13 << 1),
        2 => (4 * (bits >> 2 & 0xFFF) + 8_187, bits >> 14 << 2),
        _ => (5 * (bits >> 2 & 0x1FFF) + 24_567, bits >> 15 << 3),
    };
    PacketPoint { before: 0.0, range: range as u16, quality: quality as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(kind: PacketFormat, body: &[u8]) -> [u8; PacketFormat::MAX_LEN] {
        let mut bytes = [0; PacketFormat::MAX_LEN];
        bytes[2..2 + body.len()].copy_from_slice(body);
        let sum = bytes[2..kind.byte_len()].iter().fold(0, |sum, byte| sum ^ byte);
        (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
        bytes
    }

    #[test]
    fn decodes_standard_points() {
        // This point has quality 15, angle 90 degrees and range 2 m.
        let node = [0x3D, 0x01, 0x2D, 0x40, 0x1F];
        assert!(PacketFormat::Standard.is_valid(&node));
        assert_eq!(PacketFormat::Standard.start_angle(&node), 90.0);
        let point = PacketFormat::Standard.point(&node, &node, 0);
        assert_eq!(point, PacketPoint { before: 0.0, range: 2_000, quality: 15 });
        // A quality of 0 means no return.
        assert_eq!(PacketFormat::Standard.point(&[0x01, 1, 0x2D, 0x40, 0x1F], &node, 0).range, 0);
        for wrong in
            [[0x3F, 1, 0x2D, 0, 0], [0x3C, 1, 0x2D, 0, 0], [0x3D, 0, 0x2D, 0, 0], [0x3D, 0xFF, 0xFF, 0, 0]]
        {
            assert!(!PacketFormat::Standard.is_valid(&wrong), "{wrong:02X?}");
        }
    }

    #[test]
    fn express_points_have_angle_corrections() {
        // The first point has 1,234 mm and 37/8 degrees. The second point has 40 mm and 26/8 degrees.
        let [a, b] = [1_234 << 2 | 2u16, 40 << 2 | 1].map(u16::to_le_bytes);
        let bytes = packet(PacketFormat::Express, &[0x80, 0x16, a[0], a[1], b[0], b[1], 0xA5]);
        assert!(PacketFormat::Express.is_valid(&bytes[..84]));
        assert_eq!(PacketFormat::Express.start_angle(&bytes), 90.0);
        let points = [0, 1, 2].map(|i| PacketFormat::Express.point(&bytes, &bytes, i));
        assert_eq!(points[0], PacketPoint { before: 4.625, range: 1_234, quality: 0 });
        assert_eq!(points[1], PacketPoint { before: 3.25, range: 40, quality: 0 });
        assert_eq!(points[2], PacketPoint::default());
    }

    #[test]
    fn ultra_ranges_have_five_scales() {
        let scales = [
            (0, (0, 0)),
            (511, (511, 0)),
            (512, (512, 1)),
            (513, (514, 1)),
            (1_279, (2_046, 1)),
            (1_280, (2_048, 2)),
            (1_791, (4_092, 2)),
            (1_792, (4_096, 3)),
            (3_327, (16_376, 3)),
            (3_328, (16_384, 4)),
            (4_095, (28_656, 4)),
        ];
        for (stored, meant) in scales {
            assert_eq!(major(0xFFFF_F000 | stored), meant, "{stored}");
        }
    }

    #[test]
    fn ultra_points_are_differences_from_major_points() {
        let three = |major: u32, first: i32, second: i32| {
            (major | (first as u32 & 0x3FF) << 12 | (second as u32 & 0x3FF) << 22).to_le_bytes()
        };
        // The groups begin with these ranges: 688 mm with differences in steps of 2 mm, 2,128 mm with differences in
        // steps of 4 mm, no return, and 2,128 mm.
        let threes = [three(600, 10, -3), three(1_300, -512, 511), three(0, 5, -1), three(1_300, 0, 0)];
        let mut body = [0; 18];
        body[2..].copy_from_slice(threes.as_flattened());
        let bytes = packet(PacketFormat::Ultra, &body);
        let ranges: [u16; 9] = core::array::from_fn(|i| PacketFormat::Ultra.point(&bytes, &bytes, i).range);
        assert_eq!(ranges, [688, 708, 2_116, 2_128, 0, 0, 0, 2_148, 2_124]);
        // The last point is a difference from the first point of the next packet.
        let mut body = [0; 130];
        body[126..].copy_from_slice(&three(100, 0, 7));
        let (last, next) =
            (packet(PacketFormat::Ultra, &body), packet(PacketFormat::Ultra, &[0, 0, 0x14, 0x05, 0, 0]));
        assert_eq!(PacketFormat::Ultra.point(&last, &next, 95).range, 2_128 + 7 * 4);
    }

    #[test]
    fn ultra_angles_depend_on_the_range() {
        assert_eq!((before(0), before(49)), (7.5, 7.5));
        // k is 491, so the two terms of the angle are 0.479492 and 0.018374 radians.
        assert!((before(50) + 20.525_6).abs() < 1e-3, "{}", before(50));
        // k is 24, so the two terms of the angle are 0.0234375 and 0.000002 radians.
        assert!((before(1_000) - 6.657).abs() < 1e-3, "{}", before(1_000));
        assert_eq!(before(25_000), 8.0);
        let kinds = PacketFormat::ALL.map(|kind| (kind.max_before(), kind.max_after()));
        let ultra = (0..u16::MAX).map(before).map(f64::from);
        assert!(ultra.clone().all(|before| before < kinds[2].0 && -before < kinds[2].1));
    }

    #[test]
    fn dense_ranges_are_in_millimeters() {
        let bytes = packet(PacketFormat::Dense, &[0, 0, 0x10, 0x27, 0, 0]);
        let ranges = [0, 1].map(|i| PacketFormat::Dense.point(&bytes, &bytes, i).range);
        assert_eq!((ranges, PacketFormat::Dense.start_angle(&bytes)), ([10_000, 0], 0.0));
    }

    #[test]
    fn ultra_dense_points_have_four_scales() {
        let v = [
            0x9A << 12 | 42 << 2,
            0x4D << 13 | 100 << 2 | 1,
            0x26 << 14 | 1_000 << 2 | 2,
            0x13 << 15 | 3_000 << 2 | 3u32,
        ];
        let mut body = [0; 18];
        body[6..8].copy_from_slice(&[0x80, 0x16]);
        for (two, place) in v.chunks(2).zip(body[8..].chunks_mut(5)) {
            place[..2].copy_from_slice(&(two[0] as u16).to_le_bytes());
            place[2..4].copy_from_slice(&(two[1] as u16).to_le_bytes());
            place[4] = (two[0] >> 16 | two[1] >> 16 << 4) as u8;
        }
        let bytes = packet(PacketFormat::UltraDense, &body);
        assert!(
            PacketFormat::UltraDense.is_valid(&bytes) && PacketFormat::UltraDense.start_angle(&bytes) == 90.0
        );
        let points = [0, 1, 2, 3].map(|i| PacketFormat::UltraDense.point(&bytes, &bytes, i));
        assert_eq!(points.map(|point| point.range), [84, 2_346, 12_187, 39_567]);
        assert_eq!(points.map(|point| point.quality), [0x9A, 0x9A, 0x98, 0x98]);
    }

    #[test]
    fn checksum_detects_every_flipped_bit() {
        for kind in PacketFormat::ALL.into_iter().filter(|kind| kind.is_checked()) {
            let right = packet(kind, &[0x80, 0x16, 1, 2, 3, 4, 0x80, 0x16, 7, 8, 9]);
            assert!(kind.is_valid(&right[..kind.byte_len()]));
            for bit in 0..kind.byte_len() * 8 {
                let mut bytes = right;
                bytes[bit / 8] ^= 1 << (bit % 8);
                assert!(!kind.is_valid(&bytes[..kind.byte_len()]), "{kind:?} {bit}");
            }
        }
    }
}
