//! Packets as a scanner encodes them, written from the description of the formats and not from the decoder.

use scanhub_drivers::rplidar::packet::Kind;

/// A point as it is encoded: its raw angle is that of its place.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sample {
    /// Millimetres; 0 is no return.
    pub(crate) range: u32,
    /// Eighths of a degree by which it lies before its place; express packets only.
    pub(crate) eighths: u32,
    pub(crate) quality: u32,
}

/// A packet that begins at `start` degrees; `next` is the first point behind it.
pub(crate) fn encode(kind: Kind, start: f64, samples: &[Sample], next: Sample) -> Vec<u8> {
    let word = ((start.rem_euclid(360.0) * 64.0) as u16).to_le_bytes();
    let mut bytes = match kind {
        Kind::Standard => {
            let Sample { range, quality, .. } = samples[0];
            let angle = ((start.rem_euclid(360.0) * 64.0) as u16) << 1 | 1;
            let quality = if range == 0 { 0 } else { quality as u8 & 63 };
            let head = quality << 2 | if start.rem_euclid(360.0) < 2.0 { 1 } else { 2 };
            let mut bytes = vec![head];
            bytes.extend(angle.to_le_bytes());
            bytes.extend((range as u16 * 4).to_le_bytes());
            return bytes;
        }
        Kind::UltraDense => [vec![0, 0, 1, 2, 3, 4, 0, 0], word.to_vec()].concat(),
        _ => [vec![0, 0], word.to_vec()].concat(),
    };
    match kind {
        Kind::Standard => unreachable!("encoded above"),
        Kind::Express => {
            for two in samples.chunks(2) {
                for sample in two {
                    bytes.extend((((sample.range << 2) | sample.eighths >> 4) as u16).to_le_bytes());
                }
                bytes.push((two[0].eighths & 15 | (two[1].eighths & 15) << 4) as u8);
            }
        }
        Kind::Ultra => {
            for (n, three) in samples.chunks(3).enumerate() {
                let behind = samples.get(3 * n + 3).copied().unwrap_or(next);
                let ((stored, base, level), (_, base_behind, level_behind)) =
                    (major(three[0].range), major(behind.range));
                let differs = |range: u32, base: i64, level: u32| {
                    let difference = (i64::from(range) - base) >> level;
                    let is_told = range > 0 && (-511..511).contains(&difference);
                    (if is_told { difference } else { -512 } & 0x3FF) as u32
                };
                let (first_base, first_level) =
                    if stored == 0 { (base_behind, level_behind) } else { (base, level) };
                let first = differs(three[1].range, first_base, first_level);
                let second = differs(three[2].range, base_behind, level_behind);
                bytes.extend((stored | first << 12 | second << 22).to_le_bytes());
            }
        }
        Kind::Dense => samples.iter().for_each(|sample| bytes.extend((sample.range as u16).to_le_bytes())),
        Kind::UltraDense => {
            for two in samples.chunks(2) {
                let [a, b] = [two[0], two[1]].map(twenty_bits);
                bytes.extend((a as u16).to_le_bytes());
                bytes.extend((b as u16).to_le_bytes());
                bytes.push((a >> 16 | b >> 16 << 4) as u8);
            }
        }
    }
    let sum = bytes[2..].iter().fold(0, |sum, byte| sum ^ byte);
    (bytes[0], bytes[1]) = (0xA0 | sum & 15, 0x50 | sum >> 4);
    bytes
}

/// What is stored of a range with steps of its own width, what that means, and how many bits the steps are wider.
fn major(range: u32) -> (u32, i64, u32) {
    let (from, base, level) = match range {
        0x4000.. => (3328, 0x4000, 4),
        0x1000.. => (1792, 0x1000, 3),
        0x800.. => (1280, 0x800, 2),
        0x200.. => (512, 0x200, 1),
        _ => (0, 0, 0),
    };
    let steps = (range - base) >> level;
    (from + steps, i64::from(base + (steps << level)), level)
}

fn twenty_bits(sample: Sample) -> u32 {
    let Sample { range, quality, .. } = sample;
    match range {
        0 => 0,
        1..=2046 => (range / 2) << 2 | quality << 12,
        2047..=8187 => 1 | ((range - 2046) / 3) << 2 | quality >> 1 << 13,
        8188..=24567 => 2 | ((range - 8187) / 4) << 2 | quality >> 2 << 14,
        _ => 3 | ((range - 24567) / 5) << 2 | quality >> 3 << 15,
    }
}

/// What a scanner says of packets of this kind.
pub(crate) fn answer_of(kind: Kind) -> u8 {
    match kind {
        Kind::Standard => 0x81,
        Kind::Express => 0x82,
        Kind::Ultra => 0x84,
        Kind::Dense => 0x85,
        Kind::UltraDense => 0x86,
    }
}
