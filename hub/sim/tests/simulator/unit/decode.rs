//! A second, slow decoder of what the scanners send, straight from the published formulas: judges what the simulator
//! packs.

/// A point as the wire has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Point {
    /// Degrees, clockwise, 0 to 360.
    pub(crate) deg: f64,
    /// 0: no return.
    pub(crate) mm: f64,
    /// Where the wire has one.
    pub(crate) quality: Option<u8>,
    /// The flag of a new turn, where the wire has one.
    pub(crate) begins: bool,
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn turned(deg: f64) -> f64 {
    deg.rem_euclid(360.0)
}

/// Type 0x81.
pub(crate) fn standard(packet: &[u8]) -> Point {
    assert_eq!(packet.len(), 5);
    let begins = packet[0] & 1 == 1;
    assert_eq!(packet[0] & 2 == 2, !begins, "the flag and its inverse");
    assert_eq!(packet[1] & 1, 1, "the check bit");
    let deg = f64::from(word(packet, 1) >> 1) / 64.0;
    Point { deg, mm: f64::from(word(packet, 3)) / 4.0, quality: Some(packet[0] >> 2), begins }
}

/// The points of all packets but the last one, of the type `answer`.
pub(crate) fn capsules(answer: u8, packets: &[Vec<u8>]) -> Vec<Point> {
    packets.windows(2).flat_map(|pair| capsule(answer, &pair[0], &pair[1])).collect()
}

fn capsule(answer: u8, packet: &[u8], next: &[u8]) -> Vec<Point> {
    let (len, count, at) = match answer {
        0x82 => (84, 32, 2),
        0x84 => (132, 96, 2),
        0x85 => (84, 40, 2),
        0x86 => (170, 64, 8),
        _ => panic!("{answer:#x}"),
    };
    for packet in [packet, next] {
        assert_eq!(packet.len(), len);
        assert_eq!((packet[0] >> 4, packet[1] >> 4), (0xA, 0x5));
        let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
        assert_eq!((packet[0] & 15, packet[1] & 15), (sum & 15, sum >> 4));
    }
    let start = |packet: &[u8]| f64::from(word(packet, at) & 0x7FFF) / 64.0;
    let step = turned(start(next) - start(packet)) / f64::from(count);
    let body = &packet[at + 2..];
    let of = |k: usize| match answer {
        0x82 => {
            let cabin = &body[k / 2 * 5..][..5];
            let value = word(cabin, k % 2 * 2);
            let low = if k.is_multiple_of(2) { cabin[4] & 15 } else { cabin[4] >> 4 };
            let behind = f64::from(u16::from(low) | (value & 3) << 4) / 8.0;
            (f64::from(value >> 2), behind, None)
        }
        0x84 => {
            let mm = ultra(body, &next[at + 2..], k);
            (mm, shift(mm), None)
        }
        0x85 => (f64::from(word(body, 2 * k)), 0.0, None),
        _ => {
            let cabin = &body[k / 2 * 5..][..5];
            let high = if k.is_multiple_of(2) { cabin[4] & 15 } else { cabin[4] >> 4 };
            let value = u32::from(word(cabin, k % 2 * 2)) | u32::from(high) << 16;
            let (mm, quality) = match value & 3 {
                0 => (2 * (value >> 2 & 0x3FF), value >> 12),
                1 => (3 * (value >> 2 & 0x7FF) + 2_046, value >> 13 << 1),
                2 => (4 * (value >> 2 & 0xFFF) + 8_187, value >> 14 << 2),
                _ => (5 * (value >> 2 & 0x1FFF) + 24_567, value >> 15 << 3),
            };
            (f64::from(mm), 0.0, Some(quality as u8))
        }
    };
    let point = |k: usize| {
        let (mm, behind, quality) = of(k);
        Point { deg: turned(start(packet) + step * k as f64 - behind), mm, quality, begins: false }
    };
    (0..count as usize).map(point).collect()
}

/// Range number `k` of a packet of 32 words.
fn ultra(body: &[u8], next: &[u8], k: usize) -> f64 {
    let at = |cabin: usize| if cabin < 32 { &body[4 * cabin..] } else { next };
    let bits = |cabin: usize| u32::from_le_bytes(at(cabin)[..4].try_into().expect("four bytes"));
    let major = |cabin: usize| {
        let v = (bits(cabin) & 0xFFF) as i32;
        match v {
            3_328.. => ((1 << 14) + 16 * (v - 3_328), 4),
            1_792.. => ((1 << 12) + 8 * (v - 1_792), 3),
            1_280.. => ((1 << 11) + 4 * (v - 1_280), 2),
            512.. => ((1 << 9) + 2 * (v - 512), 1),
            _ => (v, 0),
        }
    };
    let cabin = k / 3;
    let (here, there) = (major(cabin), major(cabin + 1));
    let signed = |shift: u32| ((bits(cabin) >> shift) as i32) << 22 >> 22;
    let predict = |steps: i32, (base, level): (i32, u32)| match steps {
        -512 | 511 => 0,
        _ => base + (steps << level),
    };
    f64::from(match k % 3 {
        0 => here.0,
        1 => predict(signed(12), if here.0 == 0 { there } else { here }),
        _ => predict(signed(22), there),
    })
}

/// By how many degrees the vendor's decoder of type 0x84 takes a point's angle back.
fn shift(mm: f64) -> f64 {
    if mm < 50.0 {
        return 7.5;
    }
    let k = (98_361.0 / (4.0 * mm)).floor();
    8.0 - (k / 1_024.0).to_degrees() - (k * k * k / 6_442_450_944.0).to_degrees()
}
