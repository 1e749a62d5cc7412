//! Framer of RPLIDAR responses, packets and boot messages, in a stream that may lack bytes.
//!
//! A packet of one point has no checksum, and 1 in 70 wrong positions looks like such a packet. The framer starts to
//! accept such packets only when several consecutive packets have similar angles. Even then, it accepts a packet only
//! if another packet follows.

use crate::line::framing::{Format, FrameCheck};
use crate::line::{Buffer, suspect};
use scanhub_schema::{MILLIS, Nanos};

use crate::rplidar::packet::PacketFormat;
use crate::rplidar::request::{ResponseDescriptor, ResponseType};

/// Contents that the framer expects in the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ExpectedBytes {
    /// No contents. The framer discards all bytes, except for boot messages.
    Nothing,
    /// Responses, possibly after the rest of a stream.
    Responses,
    /// Packets of this format.
    Packets(PacketFormat),
    /// Packets of any format. Express and dense packets look alike, so the framer treats both as packets of the given
    /// format. The given format is `None` if it is unknown.
    AnyPackets(Option<PacketFormat>),
}

/// Contents that the framer has found.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FramerEvent {
    /// Response, with its descriptor.
    Reply(ResponseType, Span),
    /// Descriptor before a stream of packets.
    Stream(Span),
    /// Consecutive packets without other bytes between them.
    Packets(PacketFormat, Span),
    /// Boot message, which is text. Other bytes may look like text, but they rarely contain the word `LIDAR`.
    BootMessage {
        /// Whether the text contains the word `LIDAR`.
        is_named: bool,
    },
}

/// Range of bytes in the framer's buffer. The range is valid until the next bytes are committed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    at: usize,
    pub(crate) len: usize,
    /// Number of packets.
    pub(crate) packets: usize,
    /// Offset of the first byte, counted from the first committed byte.
    pub(crate) offset: u64,
    /// Number of discarded bytes between the previous packet and the first byte of this range.
    pub(crate) skipped: u32,
    /// Reasons why the first packet is suspect: bits of [`suspect`]; 0 means clean.
    pub(crate) reasons: u8,
}

/// Framer with its buffer.
#[derive(Clone, Debug)]
pub(crate) struct Framer {
    pub(crate) buffer: Buffer<CAPACITY>,
    expect: ExpectedBytes,
    /// Whether the next packet must start where the last packet ended.
    is_locked: bool,
    /// Whether a packet has arrived since the last descriptor of a stream.
    has_packet: bool,
    /// Number of bytes discarded since the last packet.
    skipped: u32,
    /// Number of consecutive printable bytes. `last_text` contains the last of these bytes, and `is_named` is whether
    /// the bytes contain [`BOOT_MESSAGE_NAME`].
    text_len: usize,
    last_text: [u8; BOOT_MESSAGE_NAME.len()],
    is_named: bool,
    /// Whether packets have arrived that may be express or dense packets, so that their format is unknown.
    is_ambiguous: bool,
}

impl Format for PacketFormat {
    type Reject = ();

    fn packet_len(&self) -> usize {
        PacketFormat::byte_len(*self)
    }

    fn begins(&self, bytes: &[u8]) -> bool {
        PacketFormat::begins(*self, bytes)
    }

    fn check(&self, packet: &[u8]) -> Result<(), ()> {
        if self.is_valid(packet) { Ok(()) } else { Err(()) }
    }
}

/// Action of the framer for the first open bytes.
enum FramerStep {
    Take(usize),
    Discard,
    Wait,
}

impl Framer {
    pub(crate) fn new(expect: ExpectedBytes) -> Self {
        Framer {
            buffer: Buffer::new(HOLD_TIME),
            expect,
            is_locked: false,
            has_packet: false,
            skipped: 0,
            text_len: 0,
            last_text: [0; BOOT_MESSAGE_NAME.len()],
            is_named: false,
            is_ambiguous: false,
        }
    }

    /// Sets the contents that the framer expects in the open bytes and in all later bytes.
    pub(crate) fn expect(&mut self, expect: ExpectedBytes) {
        self.expect = expect;
        (self.is_locked, self.skipped) = (false, 0);
    }

    /// Returns the next contents, with at most `max_packets` packets. Returns `None` if the framer needs more bytes.
    pub(crate) fn advance(&mut self, max_packets: usize) -> Option<FramerEvent> {
        self.buffer.begin_check();
        loop {
            let open = self.buffer.open_bytes();
            if open.is_empty() {
                return None;
            }
            if self.expect != ExpectedBytes::Nothing
                && ResponseDescriptor::begins(open)
                && !self.is_at_packet()
            {
                match ResponseDescriptor::parse(open) {
                    Some(ResponseDescriptor::Reply(_, len)) if open.len() < ResponseDescriptor::LEN + len => {
                        return None;
                    }
                    Some(ResponseDescriptor::Reply(answer, len)) => {
                        return Some(FramerEvent::Reply(answer, self.take(ResponseDescriptor::LEN + len, 1)));
                    }
                    Some(ResponseDescriptor::Stream(kind)) => {
                        let span = self.take(ResponseDescriptor::LEN, 1);
                        self.expect(ExpectedBytes::Packets(kind));
                        (self.is_locked, self.has_packet) = (true, false);
                        return Some(FramerEvent::Stream(span));
                    }
                    None if open.len() < ResponseDescriptor::LEN => return None,
                    None => {}
                }
            }
            match self.step(max_packets) {
                FramerStep::Take(packets) => {
                    let ExpectedBytes::Packets(kind) = self.expect else { return None };
                    (self.is_locked, self.has_packet) = (true, true);
                    return Some(FramerEvent::Packets(kind, self.take(packets * kind.byte_len(), packets)));
                }
                FramerStep::Wait => return None,
                FramerStep::Discard => {
                    if self.discard() {
                        return Some(FramerEvent::BootMessage { is_named: self.is_named });
                    }
                }
            }
        }
    }

    /// Returns the bytes of `span`, which [`Framer::advance`] returned last.
    pub(crate) fn bytes(&self, span: Span) -> &[u8] {
        self.buffer.taken_bytes(span.at, span.len)
    }

    /// Shortens `span`, which [`Framer::advance`] returned last, to its first `packets` packets. The framer returns the
    /// other packets again.
    pub(crate) fn shorten(&mut self, span: &mut Span, packets: usize) {
        let len = span.len / span.packets;
        self.buffer.unread((span.packets - packets) * len, span.packets - packets);
        (span.len, span.packets) = (packets * len, packets);
    }

    /// Discards all open bytes.
    pub(crate) fn clear(&mut self) {
        self.buffer.clear();
        self.text_len = 0;
    }

    /// Returns the format of the expected packets.
    pub(crate) fn kind(&self) -> Option<PacketFormat> {
        if let ExpectedBytes::Packets(kind) = self.expect { Some(kind) } else { None }
    }

    /// Returns whether packets have arrived that may be express or dense packets, so that their format is unknown.
    pub(crate) fn is_ambiguous(&self) -> bool {
        self.is_ambiguous
    }

    /// Returns the number of bytes discarded since the last packet.
    pub(crate) fn skipped(&self) -> u32 {
        self.skipped
    }

    /// Returns whether the open bytes follow a packet and may be the next packet. The framer then treats them as a
    /// packet even if they look like a response. Returns `false` before the first packet of a stream, because a scanner
    /// may then respond to a repeated request.
    fn is_at_packet(&self) -> bool {
        let may_be = |kind: PacketFormat| match self.buffer.open_bytes().get(..kind.byte_len()) {
            Some(packet) => kind.is_valid(packet),
            None => kind.begins(self.buffer.open_bytes()),
        };
        self.is_locked && self.has_packet && self.kind().is_some_and(may_be)
    }

    fn step(&mut self, max_packets: usize) -> FramerStep {
        match self.expect {
            ExpectedBytes::Nothing | ExpectedBytes::Responses => FramerStep::Discard,
            ExpectedBytes::AnyPackets(alike) => self.search_packets(alike),
            ExpectedBytes::Packets(PacketFormat::Standard) => self.check_points(max_packets),
            ExpectedBytes::Packets(kind) => {
                let mut packets = 0;
                while packets < max_packets {
                    match self.buffer.check_frame(&kind, packets * kind.byte_len()) {
                        FrameCheck::Packet => packets += 1,
                        _ if packets > 0 => break,
                        FrameCheck::Incomplete | FrameCheck::Held => return FramerStep::Wait,
                        FrameCheck::NoPacket(rejected) => {
                            if rejected.is_some() {
                                self.buffer.reject_checksum();
                            }
                            return FramerStep::Discard;
                        }
                    }
                }
                FramerStep::Take(packets)
            }
        }
    }

    /// Checks for packets of one point, at most `max_packets`.
    fn check_points(&self, max_packets: usize) -> FramerStep {
        let open = self.buffer.open_bytes();
        let (run_len, is_open) = count_run(open, max_packets.max(MIN_RUN) + 1);
        if self.is_locked {
            match run_len.saturating_sub(1).min(max_packets) {
                0 if is_open => FramerStep::Wait,
                0 => FramerStep::Discard,
                packets => FramerStep::Take(packets),
            }
        } else if run_len >= MIN_RUN {
            FramerStep::Take((run_len - 1).min(max_packets))
        } else if is_open {
            FramerStep::Wait
        } else {
            FramerStep::Discard
        }
    }

    /// Searches for two consecutive packets of any format.
    fn search_packets(&mut self, assumed: Option<PacketFormat>) -> FramerStep {
        let open = self.buffer.open_bytes();
        let mut is_open = false;
        for kind in PacketFormat::ALL {
            let kind = match (kind, assumed) {
                (PacketFormat::Express, Some(PacketFormat::Dense)) => PacketFormat::Dense,
                (PacketFormat::Dense, _) => continue,
                _ => kind,
            };
            let is_found = if kind == PacketFormat::Standard {
                let (run_len, more) = count_run(open, 2 * MIN_RUN);
                is_open |= more;
                run_len >= 2 * MIN_RUN
            } else if let Some(two) = open.get(..2 * kind.byte_len()) {
                two.chunks_exact(kind.byte_len()).all(|packet| kind.is_valid(packet))
            } else {
                is_open |= kind.begins(open);
                false
            };
            if is_found && kind == PacketFormat::Express && assumed.is_none() {
                self.is_ambiguous = true;
                return FramerStep::Discard;
            }
            if is_found {
                self.expect(ExpectedBytes::Packets(kind));
                self.is_locked = true;
                return self.step(1);
            }
        }
        if is_open { FramerStep::Wait } else { FramerStep::Discard }
    }

    fn take(&mut self, len: usize, packets: usize) -> Span {
        let skipped = core::mem::take(&mut self.skipped);
        let reasons = if skipped > 0 { suspect::NEIGHBOUR } else { 0 };
        self.text_len = 0;
        let offset = self.buffer.offset();
        Span { at: self.buffer.take(len, packets), len, packets, offset, skipped, reasons }
    }

    /// Discards the first open byte. Returns whether this byte completes a boot message.
    fn discard(&mut self) -> bool {
        let byte = self.buffer.open_bytes().first().copied().unwrap_or_default();
        let is_text = matches!(byte, b' '..=b'~' | b'\r' | b'\n');
        self.last_text.rotate_left(1);
        self.last_text[BOOT_MESSAGE_NAME.len() - 1] = byte;
        self.buffer.discard(1);
        self.is_locked = false;
        self.skipped = self.skipped.saturating_add(1);
        self.is_named &= self.text_len > 0;
        self.text_len = if is_text { self.text_len + 1 } else { 0 };
        let is_name = self.last_text == *BOOT_MESSAGE_NAME && !self.is_named;
        self.is_named |= is_name;
        // Other text may precede the boot message, so the name may come after the minimum length.
        self.text_len == MIN_BOOT_MESSAGE_LEN || is_name && self.text_len > MIN_BOOT_MESSAGE_LEN
    }
}

/// Returns the number of consecutive packets of one point at the start of `open`, at most `max_packets`, and whether
/// more bytes could extend this number.
fn count_run(open: &[u8], max_packets: usize) -> (usize, bool) {
    let mut before = None;
    let (points, rest) = open.as_chunks::<5>();
    for (count, point) in points.iter().take(max_packets).enumerate() {
        let angle = PacketFormat::Standard.start_angle(point);
        let difference = before.map_or(0.0, |before: f32| (angle - before).abs());
        if !PacketFormat::Standard.is_valid(point)
            || (MAX_STEP_DEG..360.0 - MAX_STEP_DEG).contains(&difference)
        {
            return (count, false);
        }
        before = Some(angle);
    }
    let is_open = points.len() < max_packets && PacketFormat::Standard.begins(rest);
    (points.len().min(max_packets), is_open)
}

/// Capacity of the buffer, in bytes. The buffer has room for the bytes that a tty can buffer while the hub does not
/// read, and for two packets.
const CAPACITY: usize = 4_096 + 2 * PacketFormat::MAX_LEN;
/// Time without a byte after which the rest of a packet can no longer arrive. In the slowest stream, an adapter
/// forwards a packet every 6 ms.
const HOLD_TIME: Nanos = 10 * MILLIS;
/// Minimum number of consecutive packets of one point before the framer accepts such packets. A wrong position looks
/// like this number of packets only once in millions.
const MIN_RUN: usize = 6;
/// Maximum angle between consecutive points in degrees, even if some points are missing between them.
const MAX_STEP_DEG: f32 = 30.0;
/// Minimum length of the text of a boot message, in bytes. A complete boot message has 64 bytes.
const MIN_BOOT_MESSAGE_LEN: usize = 40;
/// Word near the beginning of the boot message.
const BOOT_MESSAGE_NAME: &[u8; 5] = b"LIDAR";
