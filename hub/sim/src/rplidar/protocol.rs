//! Models of RPLIDARs and their wire format: a decoder of requests, and encoders of responses and packets of points.
//!
//! A request is `A5 command`. If the top bit of the command is set, a length, a payload of this length and the XOR of
//! all bytes follow. A response is a descriptor and its data. The encoders round angles and ranges to the resolution of
//! the format. The driver does not use this module but its own description of the protocol, so that tests detect a
//! mistake in one of the two.
//!
//! The times in whole microseconds, the names and the response types of the A1 come from a real A1M8 with firmware
//! 1.29. The values of the other models come from their data sheets and the logs of the vendor's driver, and were not
//! measured.

/// Model of an RPLIDAR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// RPLIDAR A1M8.
    A1,
    /// RPLIDAR A2M8.
    A2m8,
    /// RPLIDAR A2M12.
    A2m12,
    /// RPLIDAR A3M1.
    A3,
    /// RPLIDAR S1.
    S1,
    /// RPLIDAR S2.
    S2,
    /// RPLIDAR S3.
    S3,
    /// RPLIDAR C1.
    C1,
}

/// Format of the packets of a mode. The descriptor of the mode's stream contains it as a type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PacketFormat {
    /// 0x81: one point in 5 bytes.
    Standard,
    /// 0x82: 32 points in 84 bytes, with a correction of each angle.
    Express,
    /// 0x84: 96 points in 132 bytes. Two of three ranges are sent as differences.
    Ultra,
    /// 0x85: 40 points in 84 bytes.
    Dense,
    /// 0x86: 64 points in 170 bytes.
    UltraDense,
}

/// A scan mode, which a host requests by its number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// Name that the scanner reports.
    pub name: &'static str,
    /// Time from one point to the next in microseconds, as the scanner reports it. A real A1 takes 0.7 % longer.
    pub sample_us: f64,
    /// Format of the packets.
    pub form: PacketFormat,
    /// Maximum range that the scanner reports, in meters.
    pub reach_m: f64,
}

/// Control of the motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motor {
    /// The signal DTR switches the motor. A pty does not have this signal, so the motor runs while the power is on.
    Dtr,
    /// An accessory board controls the motor. Requests to the board contain a duty cycle.
    Pwm,
    /// The scanner itself controls the motor. Requests contain revolutions per minute.
    Rpm,
}

impl PacketFormat {
    /// Returns the type in the descriptor of a stream in this format.
    pub fn response_type(self) -> u8 {
        match self {
            PacketFormat::Standard => 0x81,
            PacketFormat::Express => 0x82,
            PacketFormat::Ultra => 0x84,
            PacketFormat::Dense => 0x85,
            PacketFormat::UltraDense => 0x86,
        }
    }

    /// Returns the number of bytes in a packet.
    pub fn packet_len(self) -> usize {
        match self {
            PacketFormat::Standard => 5,
            PacketFormat::Express | PacketFormat::Dense => 84,
            PacketFormat::Ultra => 132,
            PacketFormat::UltraDense => 170,
        }
    }

    /// Returns the number of points in a packet.
    pub fn points(self) -> usize {
        match self {
            PacketFormat::Standard => 1,
            PacketFormat::Express => 32,
            PacketFormat::Ultra => 96,
            PacketFormat::Dense => 40,
            PacketFormat::UltraDense => 64,
        }
    }
}

impl Model {
    /// All models.
    pub const ALL: [Model; 8] =
        [Model::A1, Model::A2m8, Model::A2m12, Model::A3, Model::S1, Model::S2, Model::S3, Model::C1];

    /// Returns the name in options.
    pub fn name(self) -> &'static str {
        match self {
            Model::A1 => "a1",
            Model::A2m8 => "a2m8",
            Model::A2m12 => "a2m12",
            Model::A3 => "a3",
            Model::S1 => "s1",
            Model::S2 => "s2",
            Model::S3 => "s3",
            Model::C1 => "c1",
        }
    }

    /// Returns the byte that the scanner reports as its model.
    pub fn id(self) -> u8 {
        match self {
            Model::A1 => 0x18,
            Model::A2m8 => 0x28,
            Model::A2m12 => 0x2C,
            Model::A3 => 0x31,
            Model::S1 => 0x61,
            Model::S2 => 0x71,
            Model::S3 => 0x81,
            Model::C1 => 0x41,
        }
    }

    /// Returns the rate of the line in bits per second.
    pub fn baud(self) -> u32 {
        match self {
            Model::A1 | Model::A2m8 => 115_200,
            Model::A2m12 | Model::A3 | Model::S1 => 256_000,
            Model::S2 | Model::S3 => 1_000_000,
            Model::C1 => 460_800,
        }
    }

    /// Returns the modes. The index of a mode is the number by which a host requests it.
    pub fn modes(self) -> &'static [Mode] {
        match self {
            Model::A1 | Model::A2m8 => &MODES_8K,
            Model::A2m12 => &MODES_A2M12,
            Model::A3 => &MODES_A3,
            Model::S1 => &MODES_S1,
            Model::S2 => &MODES_S3[..2],
            Model::S3 => &MODES_S3,
            Model::C1 => &MODES_C1,
        }
    }

    /// Returns the number of the mode that the scanner recommends.
    pub fn typical(self) -> usize {
        match self {
            Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3 => 3,
            Model::S1 => 2,
            Model::S2 | Model::S3 => 1,
            Model::C1 => 0,
        }
    }

    /// Returns the revolutions per second with factory settings. The value of the A1 follows from a real A1, which sent
    /// 1,954 points per second and 264 to 267 points per revolution.
    pub fn revolutions_per_second(self) -> f64 {
        if self == Model::A1 { 7.36 } else { 10.0 }
    }

    /// Returns the minimum and the maximum range according to the data sheet, in millimeters.
    pub(crate) fn reach_mm(self) -> std::ops::RangeInclusive<f64> {
        match self {
            Model::A1 => 150.0..=12_000.0,
            Model::A2m8 | Model::A2m12 => 200.0..=12_000.0,
            Model::A3 => 200.0..=25_000.0,
            Model::S1 => 100.0..=40_000.0,
            Model::S2 => 50.0..=30_000.0,
            Model::S3 => 50.0..=40_000.0,
            Model::C1 => 50.0..=12_000.0,
        }
    }

    /// Returns whether the scanner triangulates, with a laser next to its lens. In that case, the angle of a point
    /// depends on its range, and weak surfaces have no return. The other scanners measure the time of flight of the
    /// light.
    pub(crate) fn triangulates(self) -> bool {
        matches!(self, Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)
    }

    pub(crate) fn motor(self) -> Motor {
        match self {
            Model::A1 | Model::C1 => Motor::Dtr,
            Model::A2m8 | Model::A2m12 | Model::A3 => Motor::Pwm,
            Model::S1 | Model::S2 | Model::S3 => Motor::Rpm,
        }
    }

    /// Returns the version of the firmware as (major, minor), and the number of the hardware. An A2 or A3 at 256,000
    /// baud must have hardware 6, because the vendor's driver expects this rate from it.
    fn versions(self) -> ([u8; 2], u8) {
        match self {
            Model::A1 => ([1, 29], 5),
            Model::A2m8 => ([1, 29], 5),
            Model::A2m12 | Model::A3 => ([1, 29], 6),
            Model::S1 | Model::S2 | Model::S3 => ([1, 2], 18),
            Model::C1 => ([1, 1], 18),
        }
    }

    /// Returns the duration of a microsecond of the scanner's clock, in microseconds of the host's clock. They differ
    /// for the A1: a real A1 reported 508 us per point, but sent 1,954 points per second.
    pub(crate) fn clock_ratio(self) -> f64 {
        if self == Model::A1 { 1.0 / (508e-6 * 1_954.0) } else { 1.0 }
    }
}

const fn mode(name: &'static str, sample_us: f64, form: PacketFormat, reach_m: f64) -> Mode {
    Mode { name, sample_us, form, reach_m }
}

/// Returns the modes of a scanner that triangulates. A point takes `us` microseconds in the fastest modes, and
/// `stable_us` in mode Stability. The maximum range is `reach_m` in modes Standard and Express, and `fast_reach_m` in
/// the other modes.
const fn modes(us: f64, stable_us: f64, reach_m: f64, fast_reach_m: f64) -> [Mode; 5] {
    [
        mode("Standard", 4.0 * us, PacketFormat::Standard, reach_m),
        mode("Express", 2.0 * us, PacketFormat::Express, reach_m),
        mode("Boost", us, PacketFormat::Ultra, fast_reach_m),
        mode("Sensitivity", us, PacketFormat::Ultra, fast_reach_m),
        mode("Stability", stable_us, PacketFormat::Ultra, fast_reach_m),
    ]
}

const MODES_8K: [Mode; 5] = modes(127.0, 201.0, 12.0, 12.0);
const MODES_A2M12: [Mode; 5] = modes(63.0, 100.0, 12.0, 12.0);
const MODES_A3: [Mode; 5] = modes(63.0, 100.0, 16.0, 25.0);
/// Modes of the S1. In the standard mode, the time per point is longer, because the line carries no more packets.
const MODES_S1: [Mode; 3] = [
    mode("Standard", 217.0, PacketFormat::Standard, 16.0),
    mode("Express", 108.5, PacketFormat::Express, 16.0),
    mode("DenseBoost", 108.5, PacketFormat::Dense, 40.0),
];
const MODES_S3: [Mode; 3] = [
    mode("Standard", 62.5, PacketFormat::Standard, 16.0),
    mode("DenseBoost", 31.25, PacketFormat::Dense, 40.0),
    mode("UltraDense", 31.25, PacketFormat::UltraDense, 40.0),
];
const MODES_C1: [Mode; 2] = [
    mode("Standard", 200.0, PacketFormat::Standard, 16.0),
    mode("DenseBoost", 200.0, PacketFormat::Dense, 16.0),
];

/// A request of a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Request {
    Stop,
    Reset,
    Scan,
    /// Start the standard mode at any speed of the motor.
    Force,
    /// Start the mode with this number.
    Express(u8),
    Info,
    Health,
    SampleRate,
    /// Report the value of `key` for `mode`.
    Configuration {
        key: u32,
        mode: u16,
    },
    /// Store a value with this key in the scanner.
    SetConfiguration(u32),
    /// Set the duty cycle of the motor, 0 to 1,023.
    Pwm(u16),
    /// Set the revolutions per minute of the motor.
    Rpm(u16),
    /// Report the capabilities of the accessory board.
    Board,
}

/// Decoder of requests. It collects the bytes of one request.
#[derive(Debug, Default)]
pub(crate) struct Decoder {
    bytes: Vec<u8>,
}

impl Decoder {
    /// Adds a byte, and returns the request that the byte completes. Requests with a wrong checksum, a wrong length or
    /// an unknown command are dropped.
    pub(crate) fn receive(&mut self, byte: u8) -> Option<Request> {
        if self.bytes.is_empty() && byte != REQUEST_START {
            return None;
        }
        self.bytes.push(byte);
        let (&command, payload) = match &self.bytes[..] {
            [_] => return None,
            [_, command] if command & PAYLOAD_FLAG == 0 => (command, &[][..]),
            [_, command, len, payload @ ..] if payload.len() == usize::from(*len) + 1 => (command, payload),
            _ => return None,
        };
        let is_right = payload.is_empty() || self.bytes.iter().fold(0, |sum, byte| sum ^ byte) == 0;
        let payload = &payload[..payload.len().saturating_sub(1)];
        let request = if is_right { Request::of(command, payload) } else { None };
        self.bytes.clear();
        request
    }

    /// Drops the bytes of an incomplete request.
    pub(crate) fn forget(&mut self) {
        self.bytes.clear();
    }
}

impl Request {
    fn of(command: u8, payload: &[u8]) -> Option<Request> {
        let word = |low: u8, high: u8| u16::from_le_bytes([low, high]);
        Some(match (command, payload) {
            (0x25, []) => Request::Stop,
            (0x40, []) => Request::Reset,
            (0x20, []) => Request::Scan,
            (0x21, []) => Request::Force,
            (0x50, []) => Request::Info,
            (0x52, []) => Request::Health,
            (0x59, []) => Request::SampleRate,
            (0x82, [mode, _, _, _, _]) => Request::Express(*mode),
            (0x84, [a, b, c, d, rest @ ..]) => {
                let mode = if let [low, high, ..] = rest { word(*low, *high) } else { 0 };
                Request::Configuration { key: u32::from_le_bytes([*a, *b, *c, *d]), mode }
            }
            (0x85, [a, b, c, d, ..]) => Request::SetConfiguration(u32::from_le_bytes([*a, *b, *c, *d])),
            (0xF0, [low, high]) => Request::Pwm(word(*low, *high)),
            (0xA8, [low, high]) => Request::Rpm(word(*low, *high)),
            (0xFF, [_, _, _, _]) => Request::Board,
            _ => return None,
        })
    }
}

/// Encodes a descriptor: `A5 5A`, the length of a response's data in 30 bits, 2 bits that announce further responses,
/// and the type.
fn descriptor(len: usize, has_more: bool, response_type: u8) -> Vec<u8> {
    let word = len as u32 | u32::from(has_more) << 30;
    [&[0xA5, 0x5A][..], &word.to_le_bytes(), &[response_type]].concat()
}

fn response(data: &[u8], response_type: u8) -> Vec<u8> {
    [descriptor(data.len(), false, response_type), data.to_vec()].concat()
}

/// Encodes the descriptor before the packets of a stream in `mode`.
pub(crate) fn stream_descriptor(mode: &Mode) -> Vec<u8> {
    descriptor(mode.form.packet_len(), true, mode.form.response_type())
}

/// Encodes the response to the request for information: the number `id` of the model, the versions of firmware and
/// hardware, and a serial number that is drawn from `seed`.
pub(crate) fn info(model: Model, id: u8, seed: u64) -> Vec<u8> {
    let ([major, minor], hardware) = model.versions();
    let mut random = fastrand::Rng::with_seed(seed ^ u64::from(model.id()) << 32);
    let serial: [u8; 16] = std::array::from_fn(|_| random.u8(..));
    response(&[&[id, minor, major, hardware][..], &serial].concat(), 0x04)
}

/// Encodes a health status (0 good, 1 warning, 2 error) and a code.
pub(crate) fn health(status: u8, code: u16) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    response(&[status, low, high], 0x06)
}

/// Encodes the times per point in the modes with the numbers 0 and 1, in microseconds.
pub(crate) fn sample_rate(model: Model) -> Vec<u8> {
    let micros = |number: usize| (model.modes()[number].sample_us.round() as u16).to_le_bytes();
    response(&[micros(0), micros(1)].concat(), 0x15)
}

/// Encodes the value of `key` for mode number `mode`. Returns `None` if the scanner does not have this key or mode.
pub(crate) fn configuration(model: Model, typical: usize, key: u32, mode: u16) -> Option<Vec<u8>> {
    let of = model.modes().get(usize::from(mode));
    let eighths = |value: f64| ((value * 256.0).round() as u32).to_le_bytes().to_vec();
    let value = match key {
        // The recommended revolutions per minute, and the duty cycle that results in this speed.
        0x01 => {
            let rpm = (60.0 * model.revolutions_per_second()).round() as u16;
            [rpm.to_le_bytes(), DEFAULT_PWM.to_le_bytes()].concat()
        }
        0x70 => (model.modes().len() as u16).to_le_bytes().to_vec(),
        0x71 => eighths(of?.sample_us),
        0x74 => eighths(of?.reach_m),
        0x75 => vec![of?.form.response_type()],
        0x7C => (typical as u16).to_le_bytes().to_vec(),
        0x7F => [of?.name.as_bytes(), &[0]].concat(),
        _ => return None,
    };
    Some(response(&[&key.to_le_bytes()[..], &value].concat(), 0x20))
}

/// Encodes the confirmation that a value of the configuration was stored.
pub(crate) fn configuration_stored(key: u32) -> Vec<u8> {
    response(&[key.to_le_bytes(), 0u32.to_le_bytes()].concat(), 0x21)
}

/// Encodes the capabilities of the accessory board: bit 0 means that it controls the motor.
pub(crate) fn accessory_board(controls_motor: bool) -> Vec<u8> {
    response(&[u8::from(controls_motor), 0, 0, 0], 0xFF)
}

/// Encodes the boot message of a scanner that reports `id` as its model: 64 bytes of ASCII.
pub(crate) fn boot_message(model: Model, id: u8) -> Vec<u8> {
    let ([major, minor], hardware) = model.versions();
    let text =
        format!("RP LIDAR System.\r\nFirmware Ver {major}.{minor}, HW Ver {hardware}\r\nModel: {id:02x}");
    let mut bytes = text.into_bytes();
    bytes.resize(BOOT_MESSAGE_LEN - 2, b' ');
    bytes.extend(b"\r\n");
    bytes
}

/// A point before it is encoded, with full resolution.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Reading {
    /// Angle of the head, clockwise from its zero, 0 to 360 degrees.
    pub(crate) head_deg: f64,
    /// Clockwise angle of the point, seen from the middle of the head. It differs from `head_deg` if the laser is
    /// off-center.
    pub(crate) clockwise_deg: f64,
    /// Range in millimeters; 0 means no return.
    pub(crate) range_mm: u16,
    /// Strength of the return, 0 to 255; 0 means no return.
    pub(crate) quality: u8,
    /// Whether the point is the first one of a revolution.
    pub(crate) begins_revolution: bool,
}

/// Encodes a packet of type 0x81. The first byte has the quality, the flag of a new revolution, and the inverse of this
/// flag. The angle in 1/64 degree follows, with a lowest bit that is always 1, and then the range in 1/4 millimeter.
pub(crate) fn standard(reading: &Reading) -> Vec<u8> {
    let flags = if reading.begins_revolution { 0b01 } else { 0b10 };
    let angle = sixty_fourths(reading.clockwise_deg) << 1 | 1;
    let mut packet = vec![reading.quality & 0xFC | flags];
    packet.extend(angle.to_le_bytes());
    packet.extend(quarter_mm(reading.range_mm).to_le_bytes());
    packet
}

/// Encodes a packet of type 0x82: 16 pairs of points. Each point has its range, and its lag behind the head's angle in
/// 1/8 degree. The lag has 6 bits. Its upper two bits are the lowest bits of the word with the range.
pub(crate) fn express(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let mut body = start_angle(is_first, readings);
    for pair in readings.chunks(2) {
        let mut nibbles = 0;
        for (place, reading) in pair.iter().enumerate() {
            let behind_deg = (reading.head_deg - reading.clockwise_deg + 360.0) % 360.0;
            let behind = (behind_deg * 8.0).round().min(63.0) as u16;
            body.extend((quarter_mm(reading.range_mm) | behind >> 4).to_le_bytes());
            nibbles |= (behind as u8 & 0x0F) << (4 * place);
        }
        body.push(nibbles);
    }
    with_checksum(body)
}

/// Encodes a packet of type 0x84: 32 words with three ranges each. The first range has 12 bits, on a scale whose steps
/// grow with the range. The second range is sent as its difference from the first range, and the third range as its
/// difference from the first range of the next word. Both differences have 10 bits, in steps of that scale. If a range
/// cannot be encoded as a difference, its point has no return. `next` is the first reading of the next packet.
pub(crate) fn ultra(is_first: bool, readings: &[Reading], next: &Reading) -> Vec<u8> {
    let mut body = start_angle(is_first, readings);
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
    with_checksum(body)
}

/// Encodes a packet of type 0x85: 40 ranges in millimeters.
pub(crate) fn dense(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let mut body = start_angle(is_first, readings);
    body.extend(readings.iter().flat_map(|reading| reading.range_mm.to_le_bytes()));
    with_checksum(body)
}

/// Encodes a packet of type 0x86: the scanner's clock in microseconds, its state, and 32 pairs of points with 20 bits
/// each. The bits of a point have the number of a scale with steps of 2 to 5 mm, the range on this scale, and the upper
/// bits of the quality.
pub(crate) fn ultra_dense(is_first: bool, clock: u32, readings: &[Reading]) -> Vec<u8> {
    let mut body = clock.to_le_bytes().to_vec();
    // The state of the scanner. The vendor's headers have this field, but do not describe its values.
    body.extend([0, 0]);
    body.extend(start_angle(is_first, readings));
    for pair in readings.chunks(2) {
        let values = [twenty_bits(&pair[0]), twenty_bits(&pair[1])];
        values.iter().for_each(|value| body.extend((*value as u16).to_le_bytes()));
        body.push((values[0] >> 16 | values[1] >> 16 << 4) as u8);
    }
    with_checksum(body)
}

/// Encodes the angle of the head at the first point, and the flag of the first packet of a stream.
fn start_angle(is_first: bool, readings: &[Reading]) -> Vec<u8> {
    let start = sixty_fourths(readings[0].head_deg) | u16::from(is_first) << 15;
    start.to_le_bytes().to_vec()
}

/// Returns `body` with its checksum in front. The checksum is the XOR of all bytes of `body`. It takes two bytes: `A`
/// and its lower four bits, and `5` and its upper four bits.
fn with_checksum(body: Vec<u8>) -> Vec<u8> {
    let sum = body.iter().fold(0, |sum, byte| sum ^ byte);
    [vec![0xA0 | sum & 0x0F, 0x50 | sum >> 4], body].concat()
}

/// Converts 0 to 360 degrees to 1/64 degree.
fn sixty_fourths(degrees: f64) -> u16 {
    (degrees * 64.0).round() as u16 % (360 * 64)
}

/// Converts millimeters to 1/4 millimeter. A range that does not fit becomes 0, which means no return.
fn quarter_mm(range_mm: u16) -> u16 {
    range_mm.checked_mul(4).unwrap_or(0)
}

/// Scales of the 12-bit ranges. Each scale has the first 12-bit number on it, the range of this number in millimeters,
/// and the binary logarithm of a step in millimeters.
const SCALES: [(u16, u16, u32); 5] =
    [(3_328, 1 << 14, 4), (1_792, 1 << 12, 3), (1_280, 1 << 11, 2), (512, 1 << 9, 1), (0, 0, 0)];

/// Returns the 12-bit number for `range_mm`, or 0 if the range is too long.
fn scaled(range_mm: u16) -> u16 {
    let scale = SCALES.into_iter().find(|(_, from_mm, _)| range_mm >= *from_mm);
    let (from, from_mm, level) = scale.unwrap_or_default();
    let number = from + ((range_mm - from_mm + half(level) as u16) >> level);
    if number < 1 << 12 { number } else { 0 }
}

/// Returns the range of a 12-bit number in millimeters, and the binary logarithm of a step on the scale of this number.
fn unscaled(number: u16) -> (i32, u32) {
    let scale = SCALES.into_iter().find(|(from, ..)| number >= *from);
    let (from, from_mm, level) = scale.unwrap_or_default();
    (i32::from(from_mm) + (i32::from(number - from) << level), level)
}

/// Returns half of a step whose binary logarithm is `level`. A caller that adds it before a shift rounds to the nearest
/// step.
fn half(level: u32) -> i32 {
    (1 << level) / 2
}

/// Returns the 10 bits of the difference of `range_mm` from a base, which has a range and the binary logarithm of a
/// step. The lowest number means no return.
fn predicted(range_mm: u16, (base_mm, level): (i32, u32)) -> u32 {
    const NO_RETURN: i32 = -512;
    let steps = (i32::from(range_mm) - base_mm + half(level)) >> level;
    let is_encodable = range_mm > 0 && (-511..511).contains(&steps) && base_mm + (steps << level) > 0;
    (if is_encodable { steps } else { NO_RETURN }) as u32 & 0x3FF
}

/// Encodes scale, range and quality in 20 bits.
fn twenty_bits(reading: &Reading) -> u32 {
    let (mm, quality) = (u32::from(reading.range_mm), u32::from(reading.quality));
    match mm {
        ..=2_046 => mm.div_ceil(2) << 2 | quality << 12,
        2_047..=8_187 => 1 | ((mm - 2_045) / 3) << 2 | (quality >> 1) << 13,
        8_188..=24_567 => 2 | ((mm - 8_185) / 4) << 2 | (quality >> 2) << 14,
        _ => 3 | ((mm - 24_565) / 5).min(0x1FFF) << 2 | (quality >> 3) << 15,
    }
}

/// First byte of every request.
const REQUEST_START: u8 = 0xA5;
/// The bit that is set in a command with a payload.
const PAYLOAD_FLAG: u8 = 0x80;
/// Duty cycle for the recommended speed, where 1,023 is the maximum. It is the vendor's default.
pub(crate) const DEFAULT_PWM: u16 = 660;
/// Length of the boot message in bytes.
const BOOT_MESSAGE_LEN: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mode_leaves_5_percent_of_line_free() {
        for model in Model::ALL {
            assert!(model.typical() < model.modes().len());
            for mode in model.modes() {
                let packets = 1e6 / (mode.sample_us * model.clock_ratio() * mode.form.points() as f64);
                let load = packets * mode.form.packet_len() as f64 * 10.0 / f64::from(model.baud());
                assert!(load < 0.95, "{model:?} {}: {load}", mode.name);
            }
        }
    }

    fn received(bytes: &[u8]) -> Vec<Request> {
        let mut decoder = Decoder::default();
        bytes.iter().filter_map(|&byte| decoder.receive(byte)).collect()
    }

    #[test]
    fn decodes_valid_requests_among_other_bytes() {
        assert_eq!(received(&[0x00, 0x25, 0xA5, 0x25, 0xA5, 0x50, 0x52]), [Request::Stop, Request::Info]);
        let express = [0xA5, 0x82, 0x05, 3, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 0x05 ^ 3];
        assert_eq!(received(&express), [Request::Express(3)]);
        for at in 2..express.len() {
            let mut wrong = express;
            wrong[at] ^= 4;
            assert_eq!(received(&wrong), [], "{at}");
        }
        let name = [0xA5, 0x84, 0x06, 0x7F, 0, 0, 0, 2, 0, 0xA5 ^ 0x84 ^ 0x06 ^ 0x7F ^ 2];
        assert_eq!(received(&name), [Request::Configuration { key: 0x7F, mode: 2 }]);
        let pwm = [0xA5, 0xF0, 0x02, 0x94, 0x02, 0xC1];
        assert_eq!(received(&[&pwm[..], &[0xA5, 0x40]].concat()), [Request::Pwm(660), Request::Reset]);
    }
}
