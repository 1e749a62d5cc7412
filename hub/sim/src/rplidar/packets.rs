//! Points to the bytes of each type of answer, as a scanner packs them: angles and ranges lose here what the wire has no
//! bits for. Knows neither requests nor how points come about.

/// A point as the scanner would tell it if the wire had room for everything.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Reading {
    /// Where the head was, in degrees clockwise from its zero, 0 to 360.
    pub(crate) head_deg: f64,
    /// Where the point is, seen from the middle of the head; the same, but for a laser that sits beside it.
    pub(crate) clockwise_deg: f64,
    /// Millimetres; 0 is no return.
    pub(crate) range_mm: u16,
    /// Strength of the return, 0 to 255; 0 is no return.
    pub(crate) quality: u8,
    /// Whether it is the first one of a turn.
    pub(crate) begins_turn: bool,
}

/// 0x81: quality and the flag of a new turn with its inverse, angle in 1/64 degree with a bit that is always 1, range in
/// 1/4 millimetre.
pub(crate) fn standard(reading: &Reading) -> Vec<u8> {
    let flags = if reading.begins_turn { 0b01 } else { 0b10 };
    let angle = sixty_fourths(reading.clockwise_deg) << 1 | 1;
    let mut packet = vec![reading.quality & 0xFC | flags];
    packet.extend(angle.to_le_bytes());
    packet.extend(quarters(reading.range_mm).to_le_bytes());
    packet
}

/// 0x82: 16 pairs of points; each has its range and by how much its angle lies behind the head's, in 1/8 degree, 6 bits,
/// the upper two of them below the range.
pub(crate) fn express(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let mut body = head(is_first, readings);
    for pair in readings.chunks(2) {
        let mut nibbles = 0;
        for (place, reading) in pair.iter().enumerate() {
            let behind_deg = (reading.head_deg - reading.clockwise_deg + 360.0) % 360.0;
            let behind = (behind_deg * 8.0).round().min(63.0) as u16;
            body.extend((quarters(reading.range_mm) | behind >> 4).to_le_bytes());
            nibbles |= (behind as u8 & 0x0F) << (4 * place);
        }
        body.push(nibbles);
    }
    sealed(body)
}

/// 0x84: 32 words, each with one range on a scale that grows coarser with it (12 bits) and two that are told as a
/// difference from this one and from the next word's, in steps of that scale (10 bits each). A range that no difference
/// reaches is told as no return. `next` is the first range of the packet that follows.
pub(crate) fn ultra(is_first: bool, readings: &[Reading], next: &Reading) -> Vec<u8> {
    let mut body = head(is_first, readings);
    let majors: Vec<u16> =
        readings.iter().step_by(3).chain([next]).map(|first| scaled(first.range_mm)).collect();
    for (cabin, pair) in readings.chunks(3).zip(majors.windows(2)) {
        let (here, there) = (unscaled(pair[0]), unscaled(pair[1]));
        let base = if here.0 == 0 { there } else { here };
        let word = u32::from(pair[0])
            | predicted(cabin[1].range_mm, base) << 12
            | predicted(cabin[2].range_mm, there) << 22;
        body.extend(word.to_le_bytes());
    }
    sealed(body)
}

/// 0x85: 40 ranges in millimetres.
pub(crate) fn dense(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let mut body = head(is_first, readings);
    body.extend(readings.iter().flat_map(|reading| reading.range_mm.to_le_bytes()));
    sealed(body)
}

/// 0x86: the scanner's clock and state, then 32 pairs of 20 bits, each with a scale of 2 to 5 mm, a range on it and as
/// much of the quality as has room.
pub(crate) fn ultra_dense(is_first: bool, clock: u32, readings: &[Reading]) -> Vec<u8> {
    let mut body = clock.to_le_bytes().to_vec();
    // Its state: the vendor's headers name it and say nothing of its values.
    body.extend([0, 0]);
    body.extend(head(is_first, readings));
    for pair in readings.chunks(2) {
        let values = [twenty_bits(&pair[0]), twenty_bits(&pair[1])];
        values.iter().for_each(|value| body.extend((*value as u16).to_le_bytes()));
        body.push((values[0] >> 16 | values[1] >> 16 << 4) as u8);
    }
    sealed(body)
}

/// Where the head was at the first point, and whether the stream begins.
fn head(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let start = sixty_fourths(readings[0].head_deg) | u16::from(is_first) << 15;
    start.to_le_bytes().to_vec()
}

/// `body` behind its checksum: the XOR of all its bytes, four bits each behind the marks A and 5.
fn sealed(body: Vec<u8>) -> Vec<u8> {
    let sum = body.iter().fold(0, |sum, byte| sum ^ byte);
    [vec![0xA0 | sum & 0x0F, 0x50 | sum >> 4], body].concat()
}

/// 0 to 360 degrees in 1/64 degree.
fn sixty_fourths(degrees: f64) -> u16 {
    (degrees * 64.0).round() as u16 % (360 * 64)
}

/// Millimetres in 1/4 millimetre; what has no room is no return.
fn quarters(range_mm: u16) -> u16 {
    range_mm.checked_mul(4).unwrap_or(0)
}

/// Where each scale of the 12-bit ranges begins: the number, the millimetres it stands for, and the logarithm of a step.
const SCALES: [(u16, u16, u32); 5] =
    [(3_328, 1 << 14, 4), (1_792, 1 << 12, 3), (1_280, 1 << 11, 2), (512, 1 << 9, 1), (0, 0, 0)];

/// The number of 12 bits that stands for `range_mm`; 0 for what is beyond.
fn scaled(range_mm: u16) -> u16 {
    let scale = SCALES.into_iter().find(|(_, from_mm, _)| range_mm >= *from_mm);
    let (from, from_mm, level) = scale.unwrap_or_default();
    let number = from + ((range_mm - from_mm + half(level) as u16) >> level);
    if number < 1 << 12 { number } else { 0 }
}

/// What a number of 12 bits stands for in millimetres, and the logarithm of a step there.
fn unscaled(number: u16) -> (i32, u32) {
    let scale = SCALES.into_iter().find(|(from, ..)| number >= *from);
    let (from, from_mm, level) = scale.unwrap_or_default();
    (i32::from(from_mm) + (i32::from(number - from) << level), level)
}

/// Half of a step, so that what is cut off rounds.
fn half(level: u32) -> i32 {
    (1 << level) / 2
}

/// The 10 bits that say how far `range_mm` is from `base`; the least number is no return.
fn predicted(range_mm: u16, (base_mm, level): (i32, u32)) -> u32 {
    const NO_RETURN: i32 = -512;
    let steps = (i32::from(range_mm) - base_mm + half(level)) >> level;
    let is_told = range_mm > 0 && (-511..511).contains(&steps) && base_mm + (steps << level) > 0;
    (if is_told { steps } else { NO_RETURN }) as u32 & 0x3FF
}

/// Scale, range and quality in 20 bits.
fn twenty_bits(reading: &Reading) -> u32 {
    let (mm, quality) = (u32::from(reading.range_mm), u32::from(reading.quality));
    match mm {
        ..=2_046 => mm.div_ceil(2) << 2 | quality << 12,
        2_047..=8_187 => 1 | ((mm - 2_045) / 3) << 2 | (quality >> 1) << 13,
        8_188..=24_567 => 2 | ((mm - 8_185) / 4) << 2 | (quality >> 2) << 14,
        _ => 3 | ((mm - 24_565) / 5).min(0x1FFF) << 2 | (quality >> 3) << 15,
    }
}
