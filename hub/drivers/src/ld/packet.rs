//! Packet format of LDROBOT scanners, with its encoder, its decoder and its framer. Every packet has 47 bytes and 12
//! points (source: the manuals of LD06 and LD19, "data packet format"). The framer finds packets in a stream that may
//! lack bytes, and never discards an intact packet.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::framing::FrameCheck;
use crate::line::{self, Buffer, Point, suspect};

/// Length of a packet, in bytes.
pub const PACKET_LEN: usize = 47;
/// Number of points in a packet.
pub const POINTS_PER_PACKET: usize = 12;
/// First two bytes of every packet. The first byte marks the start. The second byte contains the kind of packet and the
/// number of points.
pub const HEADER: [u8; 2] = [0x54, 0x2C];
/// Full circle in hundredths of a degree, the unit of angles in a packet.
pub const FULL_CIRCLE: u16 = 36_000;
/// Time after which the clock in packets restarts at 0, in milliseconds.
pub const CLOCK_PERIOD_MS: u16 = 30_000;
/// Maximum angle from the first to the last point of a packet, in hundredths of a degree. Bytes with a larger angle are
/// not a packet.
const MAX_SPAN: u16 = 4_500;
/// Maximum range in millimeters. Greater values are codes.
pub const MAX_RANGE: u16 = 0xFFEF;

/// Packet whose checksum is right and whose angles are valid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet<'a> {
    bytes: &'a [u8; PACKET_LEN],
}

/// Reason why bytes that begin with a header are not a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reject {
    /// The checksum is wrong.
    Checksum,
    /// An angle is greater than 360 degrees, or the angle from the first to the last point is too large.
    Angle,
}

impl<'a> Packet<'a> {
    /// Creates a packet from `bytes`.
    ///
    /// # Errors
    ///
    /// Returns the reason why `bytes` are not a packet.
    pub fn check(bytes: &'a [u8; PACKET_LEN]) -> Result<Packet<'a>, Reject> {
        let packet = Packet { bytes };
        if bytes[..2] != HEADER || crc(&bytes[..PACKET_LEN - 1]) != bytes[PACKET_LEN - 1] {
            return Err(Reject::Checksum);
        }
        let (start, end) = (packet.start(), packet.word(END_OFFSET));
        if start > FULL_CIRCLE || end > FULL_CIRCLE || packet.span() > MAX_SPAN {
            Err(Reject::Angle)
        } else {
            Ok(packet)
        }
    }

    /// Creates a packet from bytes that [`Packet::check`] has accepted before.
    pub(crate) fn assume_valid(bytes: &'a [u8; PACKET_LEN]) -> Packet<'a> {
        debug_assert!(Packet::check(bytes).is_ok());
        Packet { bytes }
    }

    /// Returns the bytes of the packet.
    pub fn bytes(&self) -> &'a [u8; PACKET_LEN] {
        self.bytes
    }

    /// Returns the speed of the head in degrees per second.
    pub fn speed(&self) -> u16 {
        self.word(2)
    }

    /// Returns the angle of the first point in hundredths of a degree, clockwise.
    pub fn start(&self) -> u16 {
        self.word(4)
    }

    /// Returns the angle from the first point to the last point, in hundredths of a degree.
    pub fn span(&self) -> u16 {
        ((u32::from(self.word(END_OFFSET)) + u32::from(FULL_CIRCLE) - u32::from(self.start()))
            % u32::from(FULL_CIRCLE)) as u16
    }

    /// Returns the time of the scanner's clock in milliseconds, modulo [`CLOCK_PERIOD_MS`].
    pub fn millis(&self) -> u16 {
        self.word(END_OFFSET + 2) % CLOCK_PERIOD_MS
    }

    /// Returns the angle of point `i` in hundredths of a degree, clockwise. The angle may exceed [`FULL_CIRCLE`]. A
    /// packet contains only the angles of its first and last point. The points between them are evenly spaced.
    pub fn angle(&self, i: usize) -> f32 {
        f32::from(self.start()) + f32::from(self.span()) * i as f32 / (POINTS_PER_PACKET - 1) as f32
    }

    /// Returns the range in millimeters and the intensity of point `i`. A range of 0 means no return.
    pub fn measured(&self, i: usize) -> (u16, u8) {
        let at = FIRST_POINT_OFFSET + 3 * i;
        (self.word(at), self.bytes[at + 2])
    }

    /// Returns point `i`, with its angle in radians, counterclockwise.
    pub fn point(&self, i: usize) -> Point {
        let (range, intensity) = self.measured(i);
        // Values above the maximum range are codes.
        let range = if (1..=MAX_RANGE).contains(&range) { range } else { line::NO_RETURN };
        Point { angle: self.angle(i) * -RADIANS_PER_UNIT, range, intensity }
    }

    fn word(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.bytes[at], self.bytes[at + 1]])
    }
}

/// Values from which [`PacketContents::encode`] creates a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketContents {
    /// Speed of the head in degrees per second.
    pub speed: u16,
    /// Angle of the first point in hundredths of a degree, clockwise.
    pub start: u16,
    /// Range in millimeters and intensity of each point.
    pub points: [(u16, u8); POINTS_PER_PACKET],
    /// Angle of the last point in hundredths of a degree, clockwise.
    pub end: u16,
    /// Time of the scanner's clock in milliseconds.
    pub millis: u16,
}

impl PacketContents {
    /// Returns the bytes of the packet, including its checksum.
    pub fn encode(&self) -> [u8; PACKET_LEN] {
        let mut bytes = [0; PACKET_LEN];
        bytes[..2].copy_from_slice(&HEADER);
        bytes[2..4].copy_from_slice(&self.speed.to_le_bytes());
        bytes[4..6].copy_from_slice(&self.start.to_le_bytes());
        for (slot, (range, intensity)) in
            bytes[FIRST_POINT_OFFSET..END_OFFSET].chunks_exact_mut(3).zip(self.points)
        {
            slot[..2].copy_from_slice(&range.to_le_bytes());
            slot[2] = intensity;
        }
        bytes[END_OFFSET..END_OFFSET + 2].copy_from_slice(&self.end.to_le_bytes());
        bytes[END_OFFSET + 2..END_OFFSET + 4].copy_from_slice(&self.millis.to_le_bytes());
        bytes[PACKET_LEN - 1] = crc(&bytes[..PACKET_LEN - 1]);
        bytes
    }
}

/// Returns the CRC-8 of `bytes`. The polynomial is 4Dh and the initial value is 0. Bits are not reflected.
pub fn crc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |crc, byte| CRC_TABLE[usize::from(crc ^ byte)])
}

const CRC_TABLE: [u8; 256] = {
    let mut table = [0; 256];
    let mut i = 0;
    while i < 256 {
        let (mut crc, mut bit) = (i as u8, 0);
        while bit < 8 {
            crc = if crc & 0x80 != 0 { crc << 1 ^ 0x4D } else { crc << 1 };
            bit += 1;
        }
        table[i] = crc;
        i += 1;
    }
    table
};

const FIRST_POINT_OFFSET: usize = 6;
const END_OFFSET: usize = FIRST_POINT_OFFSET + 3 * POINTS_PER_PACKET;
/// Radians per hundredth of a degree.
const RADIANS_PER_UNIT: f32 = core::f32::consts::PI / 18_000.0;

/// Consecutive packets without other bytes between them. The packets stay in the framer's buffer until the caller
/// commits more bytes.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    at: usize,
    /// Number of packets.
    pub packets: usize,
    /// Offset of the first byte, counted from the first committed byte.
    pub offset: u64,
    /// Reasons why the first packet is suspect: bits of [`suspect`]; 0 means clean.
    pub reasons: u8,
}

/// Framer of LDROBOT packets, with its buffer.
#[derive(Clone, Debug)]
pub struct Framer {
    pub(crate) buffer: Buffer<CAPACITY>,
    /// Whether bytes were discarded since the last packet.
    is_damaged: bool,
}

impl Default for Framer {
    fn default() -> Self {
        Framer { buffer: Buffer::new(HOLD_TIME), is_damaged: false }
    }
}

struct Format;

impl line::framing::Format for Format {
    type Reject = Reject;

    fn packet_len(&self) -> usize {
        PACKET_LEN
    }

    fn begins(&self, bytes: &[u8]) -> bool {
        let len = bytes.len().min(HEADER.len());
        bytes[..len] == HEADER[..len]
    }

    fn check(&self, packet: &[u8]) -> Result<(), Reject> {
        packet.first_chunk().map_or(Err(Reject::Checksum), Packet::check).map(|_| ())
    }
}

impl Framer {
    /// Returns the next packets, at most `max_packets`. Returns `None` if the framer needs more bytes.
    pub fn advance(&mut self, max_packets: usize) -> Option<Span> {
        self.buffer.begin_check();
        loop {
            match self.buffer.check_frame(&Format, 0) {
                FrameCheck::Packet => break,
                FrameCheck::Incomplete | FrameCheck::Held => return None,
                FrameCheck::NoPacket(rejected) => self.discard(rejected),
            }
        }
        let mut packets = 1;
        while packets < max_packets
            && matches!(self.buffer.check_frame(&Format, packets * PACKET_LEN), FrameCheck::Packet)
        {
            packets += 1;
        }
        let is_damaged = core::mem::take(&mut self.is_damaged) && self.buffer.byte_counters().packets > 0;
        let offset = self.buffer.offset();
        let at = self.buffer.take(packets * PACKET_LEN, packets);
        Some(Span { at, packets, offset, reasons: if is_damaged { suspect::NEIGHBOUR } else { 0 } })
    }

    /// Returns the bytes of `span`, which [`Framer::advance`] returned last.
    pub fn bytes(&self, span: Span) -> &[u8] {
        self.buffer.taken_bytes(span.at, span.packets * PACKET_LEN)
    }

    /// Discards all open bytes, for example because the baud rate changes.
    pub fn clear(&mut self) {
        self.buffer.clear();
        self.is_damaged = false;
    }

    /// Discards the first open byte and the bytes after it, up to the next byte that may begin a packet.
    fn discard(&mut self, rejected: Option<Reject>) {
        if rejected == Some(Reject::Checksum) {
            self.buffer.reject_checksum();
        }
        let rest = &self.buffer.open_bytes()[1..];
        let skipped = 1 + rest.iter().position(|&byte| byte == HEADER[0]).unwrap_or(rest.len());
        self.buffer.discard(skipped);
        self.is_damaged = true;
    }
}

/// Capacity of the buffer, in bytes. The buffer has room for the bytes that a tty can buffer while the hub does not
/// read, and for two incomplete packets.
const CAPACITY: usize = 4_096 + 2 * PACKET_LEN;
/// Time without a byte after which the rest of a packet can no longer arrive. A whole packet takes only 2.04 ms at
/// 230,400 baud.
const HOLD_TIME: Nanos = 4 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    /// Example packet from the manual of the LD06.
    const MANUAL: [u8; PACKET_LEN] = [
        0x54, 0x2C, 0x68, 0x08, 0xAB, 0x7E, 0xE0, 0x00, 0xE4, 0xDC, 0x00, 0xE2, 0xD9, 0x00, 0xE5, 0xD5, 0x00,
        0xE3, 0xD3, 0x00, 0xE4, 0xD0, 0x00, 0xE9, 0xCD, 0x00, 0xE4, 0xCA, 0x00, 0xE2, 0xC7, 0x00, 0xE9, 0xC5,
        0x00, 0xE5, 0xC2, 0x00, 0xE5, 0xC0, 0x00, 0xE5, 0xBE, 0x82, 0x3A, 0x1A, 0x50,
    ];

    #[test]
    fn decodes_and_encodes_the_packet_of_the_manual() {
        let packet = Packet::check(&MANUAL).expect("intact");
        assert_eq!((packet.speed(), packet.start(), packet.span()), (2_152, 32_427, 33_470 - 32_427));
        assert_eq!((packet.measured(0), packet.measured(11)), ((224, 228), (192, 229)));
        assert_eq!((packet.millis(), packet.bytes()[46]), (6_714, 0x50));
        let last = packet.point(11);
        assert!((last.angle.to_degrees() + 334.70).abs() < 1e-3, "{last:?}");
        let points = core::array::from_fn(|i| packet.measured(i));
        let contents = PacketContents { speed: 2_152, start: 32_427, points, end: 33_470, millis: 6_714 };
        assert_eq!(contents.encode(), MANUAL);
    }

    #[test]
    fn checksum_detects_every_flipped_bit() {
        for bit in 0..PACKET_LEN * 8 {
            let mut bytes = MANUAL;
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Packet::check(&bytes), Err(Reject::Checksum), "{bit}");
        }
    }

    #[test]
    fn packet_angles_continue_across_zero() {
        let contents = PacketContents {
            speed: 3_600,
            start: 35_560,
            points: [(1_000, 9); POINTS_PER_PACKET],
            end: 440,
            millis: 0,
        };
        let bytes = contents.encode();
        let packet = Packet::check(&bytes).expect("intact");
        assert_eq!((packet.span(), packet.angle(0), packet.angle(11)), (880, 35_560.0, 36_440.0));
        assert!((packet.angle(5) - 35_960.0).abs() < 0.01 && (packet.angle(6) - 36_040.0).abs() < 0.01);
        for (start, end) in [(36_001, 100), (100, 36_001), (100, 90), (0, 4_501)] {
            let bytes = PacketContents { start, end, ..contents }.encode();
            assert_eq!(Packet::check(&bytes), Err(Reject::Angle), "{start} {end}");
        }
    }
}
