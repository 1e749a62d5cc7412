//! The kinds of packets with points, and what is in each. Sources: the maker's description of the protocol and its own
//! unpacker. A packet of several points tells the angle of its first one only: where the others are, the next one's says.

/// What a stream is made of. HQ packets (83h) are not known here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A point a packet, without a checksum.
    Standard,
    /// 32 points, each with a compensation of its angle.
    Express,
    /// 96 points, of which two in three are differences.
    Ultra,
    /// 40 points.
    Dense,
    /// 64 points with their qualities.
    UltraDense,
}

/// A point of a packet.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// By how many degrees it lies before its place, or if negative behind it, among the evenly spaced points of its packet.
    pub before: f32,
    /// Millimetres; 0 is no return.
    pub range: u16,
    /// How strong the echo was; 0 also where the kind does not tell.
    pub quality: u8,
}

impl Kind {
    /// All of them.
    pub const ALL: [Kind; 5] = [Kind::Standard, Kind::Express, Kind::Ultra, Kind::Dense, Kind::UltraDense];
    /// Bytes of the longest packet.
    pub const LONGEST: usize = 170;
    /// The most points of a packet.
    pub const MOST_POINTS: usize = 96;

    /// The kind of which a scanner says this byte.
    pub(crate) fn of(answer: u8) -> Option<Kind> {
        Kind::ALL.into_iter().find(|kind| kind.answer() == answer)
    }

    /// Returns the type of this kind in a descriptor.
    pub(crate) const fn answer(self) -> u8 {
        match self {
            Kind::Standard => 0x81,
            Kind::Express => 0x82,
            Kind::Ultra => 0x84,
            Kind::Dense => 0x85,
            Kind::UltraDense => 0x86,
        }
    }

    /// Bytes of a packet.
    pub const fn bytes(self) -> usize {
        match self {
            Kind::Standard => 5,
            Kind::Express | Kind::Dense => 84,
            Kind::Ultra => 132,
            Kind::UltraDense => Kind::LONGEST,
        }
    }

    /// Points of a packet.
    pub const fn points(self) -> usize {
        match self {
            Kind::Standard => 1,
            Kind::Express => 32,
            Kind::Ultra => Kind::MOST_POINTS,
            Kind::Dense => 40,
            Kind::UltraDense => 64,
        }
    }

    /// Whether packets have a checksum.
    pub const fn is_checked(self) -> bool {
        !matches!(self, Kind::Standard)
    }

    /// Degrees by which a point may lie before its place, and some.
    pub(crate) const fn most_before(self) -> f64 {
        match self {
            Kind::Dense | Kind::UltraDense => 0.5,
            Kind::Standard | Kind::Express | Kind::Ultra => 10.0,
        }
    }

    /// Degrees by which a point may lie behind its place.
    pub(crate) const fn most_behind(self) -> f64 {
        if matches!(self, Kind::Ultra) { 21.0 } else { 0.0 }
    }

    /// Whether a packet may begin with `bytes`, as far as there are any.
    pub(crate) fn begins(self, bytes: &[u8]) -> bool {
        let fits = |at: usize, holds: fn(u8) -> bool| bytes.get(at).is_none_or(|byte| holds(*byte));
        match self {
            // The bit that a turn begins and its inverse differ; the lowest bit of the angle's word is set.
            Kind::Standard => fits(0, |byte| (byte ^ byte >> 1) & 1 == 1) && fits(1, |byte| byte & 1 == 1),
            _ => fits(0, |byte| byte >> 4 == 0xA) && fits(1, |byte| byte >> 4 == 0x5),
        }
    }

    /// Whether `packet` is one, by its checksum if it has one.
    pub(crate) fn is_right(self, packet: &[u8]) -> bool {
        let is_sum_right = || {
            let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
            sum == packet[0] & 15 | packet[1] << 4
        };
        self.begins(packet) && (!self.is_checked() || is_sum_right()) && self.start(packet) <= 360.0
    }

    /// Degrees, clockwise, of the first point of `packet`.
    pub fn start(self, packet: &[u8]) -> f32 {
        match self {
            Kind::Standard => f32::from(word(packet, 1) >> 1) / 64.0,
            Kind::UltraDense => f32::from(word(packet, 8) & 0x7FFF) / 64.0,
            _ => f32::from(word(packet, 2) & 0x7FFF) / 64.0,
        }
    }

    /// Point `i` of `packet`, which `next` follows.
    pub fn point(self, packet: &[u8], next: &[u8], i: usize) -> Measured {
        match self {
            Kind::Standard => {
                let (quality, range) = (packet[0] >> 2, word(packet, 3) / 4);
                Measured { before: 0.0, range: if quality == 0 { 0 } else { range }, quality }
            }
            Kind::Express => {
                let cabin = &packet[4 + i / 2 * 5..][..5];
                let half = i % 2;
                let (word, low) = (word(cabin, 2 * half), cabin[4] >> (4 * half) & 15);
                let eighths = u16::from(low) | (word & 3) << 4;
                Measured { before: f32::from(eighths) / 8.0, range: word >> 2, quality: 0 }
            }
            Kind::Ultra => ultra(packet, next, i),
            Kind::Dense => Measured { before: 0.0, range: word(packet, 4 + 2 * i), quality: 0 },
            Kind::UltraDense => ultra_dense(packet, i),
        }
    }
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

/// The first of three points has a range of its own, the others differ from it or from the first of the next three.
fn ultra(packet: &[u8], next: &[u8], i: usize) -> Measured {
    let three = |packet: &[u8], n: usize| {
        u32::from(word(packet, 4 + 4 * n)) | u32::from(word(packet, 6 + 4 * n)) << 16
    };
    let (n, cabins) = (i / 3, Kind::Ultra.points() / 3);
    let here = three(packet, n);
    let behind = if n + 1 < cabins { three(packet, n + 1) } else { three(next, 0) };
    let ((major, level), (major_behind, level_behind)) = (major(here), major(behind));
    // Two numbers of ten bits with a sign.
    let (first, second) = ((here << 10) as i32 >> 22, here as i32 >> 22);
    let differs = |difference: i32, base: i32, level: u32| {
        if matches!(difference, -512 | 511) { 0 } else { base + (difference << level) }
    };
    let mm = match i % 3 {
        0 => major,
        1 if major == 0 => differs(first, major_behind, level_behind),
        1 => differs(first, major, level),
        _ => differs(second, major_behind, level_behind),
    };
    let range = u16::try_from(mm).unwrap_or(0);
    Measured { before: before(range), range, quality: 0 }
}

/// A range in millimetres of which the steps get wider, and how many bits they are wider.
fn major(three: u32) -> (i32, u32) {
    let stored = (three & 0xFFF) as i32;
    const SCALES: [(i32, i32, u32); 4] =
        [(3328, 1 << 14, 4), (1792, 1 << 12, 3), (1280, 1 << 11, 2), (512, 1 << 9, 1)];
    let scale = SCALES.into_iter().find(|(from, ..)| stored >= *from);
    scale.map_or((stored, 0), |(from, base, level)| (base + ((stored - from) << level), level))
}

/// Degrees by which a point so far away lies before its place: light comes back beside the way that it went.
fn before(range: u16) -> f32 {
    if range < 50 {
        return 7.5;
    }
    let k = f32::from(u16::try_from(98_361 / (4 * u32::from(range))).unwrap_or(0));
    let radians = k / 1_024.0 + k * k * k / 6_442_450_944.0;
    8.0 - radians.to_degrees()
}

/// 20 bits a point: range and quality in one of four scales.
fn ultra_dense(packet: &[u8], i: usize) -> Measured {
    let cabin = &packet[10 + i / 2 * 5..][..5];
    let half = i % 2;
    let v = u32::from(word(cabin, 2 * half)) | u32::from(cabin[4] >> (4 * half) & 15) << 16;
    let (range, quality) = match v & 3 {
        0 => (2 * (v >> 2 & 0x3FF), v >> 12),
        1 => (3 * (v >> 2 & 0x7FF) + 2_046, v >> 13 << 1),
        2 => (4 * (v >> 2 & 0xFFF) + 8_187, v >> 14 << 2),
        _ => (5 * (v >> 2 & 0x1FFF) + 24_567, v >> 15 << 3),
    };
    Measured { before: 0.0, range: range as u16, quality: quality as u8 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(kind: Kind, body: &[u8]) -> [u8; Kind::LONGEST] {
        let mut bytes = [0; Kind::LONGEST];
        bytes[2..2 + body.len()].copy_from_slice(body);
        let sum = bytes[2..kind.bytes()].iter().fold(0, |sum, byte| sum ^ byte);
        (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
        bytes
    }

    #[test]
    fn a_point_by_itself() {
        // Quality 15, 90 degrees, 2 m.
        let node = [0x3D, 0x01, 0x2D, 0x40, 0x1F];
        assert!(Kind::Standard.is_right(&node));
        assert_eq!(Kind::Standard.start(&node), 90.0);
        let point = Kind::Standard.point(&node, &node, 0);
        assert_eq!(point, Measured { before: 0.0, range: 2_000, quality: 15 });
        // Without a quality nothing came back.
        assert_eq!(Kind::Standard.point(&[0x01, 1, 0x2D, 0x40, 0x1F], &node, 0).range, 0);
        for wrong in
            [[0x3F, 1, 0x2D, 0, 0], [0x3C, 1, 0x2D, 0, 0], [0x3D, 0, 0x2D, 0, 0], [0x3D, 0xFF, 0xFF, 0, 0]]
        {
            assert!(!Kind::Standard.is_right(&wrong), "{wrong:02X?}");
        }
    }

    #[test]
    fn express_points_lie_before_their_places() {
        // 1,234 mm and 37 eighths of a degree, 40 mm and 26.
        let [a, b] = [1_234 << 2 | 2u16, 40 << 2 | 1].map(u16::to_le_bytes);
        let bytes = packet(Kind::Express, &[0x80, 0x16, a[0], a[1], b[0], b[1], 0xA5]);
        assert!(Kind::Express.is_right(&bytes[..84]));
        assert_eq!(Kind::Express.start(&bytes), 90.0);
        let points = [0, 1, 2].map(|i| Kind::Express.point(&bytes, &bytes, i));
        assert_eq!(points[0], Measured { before: 4.625, range: 1_234, quality: 0 });
        assert_eq!(points[1], Measured { before: 3.25, range: 40, quality: 0 });
        assert_eq!(points[2], Measured::default());
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
    fn ultra_points_differ_from_their_neighbours() {
        let three = |major: u32, first: i32, second: i32| {
            (major | (first as u32 & 0x3FF) << 12 | (second as u32 & 0x3FF) << 22).to_le_bytes()
        };
        // 688 mm in steps of 2, 2,128 mm in steps of 4, none, 2,128 mm.
        let threes = [three(600, 10, -3), three(1_300, -512, 511), three(0, 5, -1), three(1_300, 0, 0)];
        let mut body = [0; 18];
        body[2..].copy_from_slice(threes.as_flattened());
        let bytes = packet(Kind::Ultra, &body);
        let ranges: [u16; 9] = core::array::from_fn(|i| Kind::Ultra.point(&bytes, &bytes, i).range);
        assert_eq!(ranges, [688, 708, 2_116, 2_128, 0, 0, 0, 2_148, 2_124]);
        // The last one differs from what the next packet begins with.
        let mut body = [0; 130];
        body[126..].copy_from_slice(&three(100, 0, 7));
        let (last, next) = (packet(Kind::Ultra, &body), packet(Kind::Ultra, &[0, 0, 0x14, 0x05, 0, 0]));
        assert_eq!(Kind::Ultra.point(&last, &next, 95).range, 2_128 + 7 * 4);
    }

    #[test]
    fn ultra_angles_depend_on_the_range() {
        assert_eq!((before(0), before(49)), (7.5, 7.5));
        // k is 491: 0.479492 and 0.018374 radians.
        assert!((before(50) + 20.525_6).abs() < 1e-3, "{}", before(50));
        // k is 24: 0.0234375 and 0.000002 radians.
        assert!((before(1_000) - 6.657).abs() < 1e-3, "{}", before(1_000));
        assert_eq!(before(25_000), 8.0);
        let kinds = Kind::ALL.map(|kind| (kind.most_before(), kind.most_behind()));
        let ultra = (0..u16::MAX).map(before).map(f64::from);
        assert!(ultra.clone().all(|before| before < kinds[2].0 && -before < kinds[2].1));
    }

    #[test]
    fn dense_ranges_are_plain() {
        let bytes = packet(Kind::Dense, &[0, 0, 0x10, 0x27, 0, 0]);
        let ranges = [0, 1].map(|i| Kind::Dense.point(&bytes, &bytes, i).range);
        assert_eq!((ranges, Kind::Dense.start(&bytes)), ([10_000, 0], 0.0));
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
        let bytes = packet(Kind::UltraDense, &body);
        assert!(Kind::UltraDense.is_right(&bytes) && Kind::UltraDense.start(&bytes) == 90.0);
        let points = [0, 1, 2, 3].map(|i| Kind::UltraDense.point(&bytes, &bytes, i));
        assert_eq!(points.map(|point| point.range), [84, 2_346, 12_187, 39_567]);
        assert_eq!(points.map(|point| point.quality), [0x9A, 0x9A, 0x98, 0x98]);
    }

    #[test]
    fn every_bit_of_a_packet_with_a_checksum_counts() {
        for kind in Kind::ALL.into_iter().filter(|kind| kind.is_checked()) {
            let right = packet(kind, &[0x80, 0x16, 1, 2, 3, 4, 0x80, 0x16, 7, 8, 9]);
            assert!(kind.is_right(&right[..kind.bytes()]));
            for bit in 0..kind.bytes() * 8 {
                let mut bytes = right;
                bytes[bit / 8] ^= 1 << (bit % 8);
                assert!(!kind.is_right(&bytes[..kind.bytes()]), "{kind:?} {bit}");
            }
        }
    }
}
