//! Finds responses and packets in a stream that may lack bytes, and the boot message of a scanner.
//!
//! A packet of one point has no checksum, and 1 in 70 wrong positions looks like one. So such packets are accepted
//! after a run of them with angles near each other, and each only if another one follows it.

use crate::line::framing::{Format, Verdict};
use crate::line::{Buffer, suspect};
use scanhub_schema::{MILLIS, Nanos};

use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Head};

/// Expected contents of the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Expect {
    /// Nothing: all bytes are discarded.
    Nothing,
    /// Responses, among the rest of a stream.
    Answers,
    /// Packets of this kind.
    Packets(Kind),
    /// Packets of any kind. Express and dense ones look alike, and count as the given kind; `None` if unknown.
    Anything(Option<Kind>),
}

/// Contents that were found.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Found {
    /// A response with its descriptor.
    Reply(Answer, Span),
    /// The descriptor of packets.
    Stream(Span),
    /// Packets without other bytes between them.
    Packets(Kind, Span),
    /// The boot message, which is text. Other bytes may be text too, but hardly ever contain the word `LIDAR`.
    Greeting {
        /// Whether the text contains that word.
        is_named: bool,
    },
}

/// Bytes in the framer's buffer, until the next ones are committed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    at: usize,
    pub(crate) len: usize,
    /// Number of packets.
    pub(crate) packets: usize,
    /// Number of the first byte among all bytes committed, from 0.
    pub(crate) offset: u64,
    /// Number of bytes between it and the packet before.
    pub(crate) skipped: u32,
    /// Bits of [`suspect`]; 0 is clean.
    pub(crate) reasons: u8,
}

/// The framer with its buffer.
#[derive(Clone, Debug)]
pub(crate) struct Framer {
    pub(crate) buffer: Buffer<CAPACITY>,
    expect: Expect,
    /// Whether the next packet must begin at the end of the last one.
    is_locked: bool,
    /// Whether a packet has arrived since the last descriptor of packets.
    has_packet: bool,
    /// Number of bytes discarded since the last packet.
    skipped: u32,
    /// Number of printable ones in a row, the last of them, and whether they contain [`NAME`].
    text: usize,
    last_text: [u8; NAME.len()],
    is_named: bool,
    /// Whether packets that look alike have arrived, and their kind is unknown.
    is_alike: bool,
}

impl Format for Kind {
    type Reject = ();

    fn packet_len(&self) -> usize {
        Kind::bytes(*self)
    }

    fn begins(&self, bytes: &[u8]) -> bool {
        Kind::begins(*self, bytes)
    }

    fn check(&self, packet: &[u8]) -> Result<(), ()> {
        if self.is_right(packet) { Ok(()) } else { Err(()) }
    }
}

/// Action for the first open bytes.
enum Step {
    Take(usize),
    Discard,
    Wait,
}

impl Framer {
    pub(crate) fn new(expect: Expect) -> Self {
        Framer {
            buffer: Buffer::new(HOLD),
            expect,
            is_locked: false,
            has_packet: false,
            skipped: 0,
            text: 0,
            last_text: [0; NAME.len()],
            is_named: false,
            is_alike: false,
        }
    }

    /// Sets the expected contents of the open bytes and those that follow.
    pub(crate) fn expect(&mut self, expect: Expect) {
        self.expect = expect;
        (self.is_locked, self.skipped) = (false, 0);
    }

    /// Returns what is next, at most `most` packets. `None` until more bytes arrive.
    pub(crate) fn advance(&mut self, most: usize) -> Option<Found> {
        self.buffer.begin_check();
        loop {
            let open = self.buffer.open();
            if open.is_empty() {
                return None;
            }
            if self.expect != Expect::Nothing && Head::begins(open) && !self.is_at_packet() {
                match Head::parse(open) {
                    Some(Head::Reply(_, len)) if open.len() < Head::LEN + len => return None,
                    Some(Head::Reply(answer, len)) => {
                        return Some(Found::Reply(answer, self.take(Head::LEN + len, 1)));
                    }
                    Some(Head::Stream(kind)) => {
                        let span = self.take(Head::LEN, 1);
                        self.expect(Expect::Packets(kind));
                        (self.is_locked, self.has_packet) = (true, false);
                        return Some(Found::Stream(span));
                    }
                    None if open.len() < Head::LEN => return None,
                    None => {}
                }
            }
            match self.step(most) {
                Step::Take(packets) => {
                    let Expect::Packets(kind) = self.expect else { return None };
                    (self.is_locked, self.has_packet) = (true, true);
                    return Some(Found::Packets(kind, self.take(packets * kind.bytes(), packets)));
                }
                Step::Wait => return None,
                Step::Discard => {
                    if self.discard() {
                        return Some(Found::Greeting { is_named: self.is_named });
                    }
                }
            }
        }
    }

    /// Returns the bytes of the span that [`Framer::advance`] returned last.
    pub(crate) fn bytes(&self, span: Span) -> &[u8] {
        self.buffer.taken(span.at, span.len)
    }

    /// Shortens `span`, which [`Framer::advance`] returned last, to the first `packets` packets. The others will be
    /// returned once more.
    pub(crate) fn cut(&mut self, span: &mut Span, packets: usize) {
        let len = span.len / span.packets;
        self.buffer.give_back((span.packets - packets) * len, span.packets - packets);
        (span.len, span.packets) = (packets * len, packets);
    }

    /// Discards all open bytes.
    pub(crate) fn clear(&mut self) {
        self.buffer.clear();
        self.text = 0;
    }

    /// Returns the kind of the expected packets.
    pub(crate) fn kind(&self) -> Option<Kind> {
        if let Expect::Packets(kind) = self.expect { Some(kind) } else { None }
    }

    /// Returns whether packets of an unknown kind have arrived.
    pub(crate) fn is_alike(&self) -> bool {
        self.is_alike
    }

    /// Returns the number of bytes that were discarded since the last packet.
    pub(crate) fn skipped(&self) -> u32 {
        self.skipped
    }

    /// Returns whether the open bytes follow a packet and may be the next one. Then they are, even if they look like a response.
    /// Before the first packet, a scanner may respond to a repeated request.
    fn is_at_packet(&self) -> bool {
        let may_be = |kind: Kind| match self.buffer.open().get(..kind.bytes()) {
            Some(packet) => kind.is_right(packet),
            None => kind.begins(self.buffer.open()),
        };
        self.is_locked && self.has_packet && self.kind().is_some_and(may_be)
    }

    fn step(&mut self, most: usize) -> Step {
        match self.expect {
            Expect::Nothing | Expect::Answers => Step::Discard,
            Expect::Anything(alike) => self.seek(alike),
            Expect::Packets(Kind::Standard) => self.nodes(most),
            Expect::Packets(kind) => {
                let mut packets = 0;
                while packets < most {
                    match self.buffer.judge(&kind, packets * kind.bytes()) {
                        Verdict::Packet => packets += 1,
                        _ if packets > 0 => break,
                        Verdict::Open | Verdict::Held => return Step::Wait,
                        Verdict::Nothing(rejected) => {
                            if rejected.is_some() {
                                self.buffer.reject_checksum();
                            }
                            return Step::Discard;
                        }
                    }
                }
                Step::Take(packets)
            }
        }
    }

    /// Checks for packets of one point, at most `most`.
    fn nodes(&self, most: usize) -> Step {
        let open = self.buffer.open();
        let (run, is_open) = run(open, most.max(RUN) + 1);
        if self.is_locked {
            match run.saturating_sub(1).min(most) {
                0 if is_open => Step::Wait,
                0 => Step::Discard,
                packets => Step::Take(packets),
            }
        } else if run >= RUN {
            Step::Take((run - 1).min(most))
        } else if is_open {
            Step::Wait
        } else {
            Step::Discard
        }
    }

    /// Searches for two consecutive packets of any kind.
    fn seek(&mut self, alike: Option<Kind>) -> Step {
        let open = self.buffer.open();
        let mut is_open = false;
        for kind in Kind::ALL {
            let kind = match (kind, alike) {
                (Kind::Express, Some(Kind::Dense)) => Kind::Dense,
                (Kind::Dense, _) => continue,
                _ => kind,
            };
            let is_found = if kind == Kind::Standard {
                let (run, more) = run(open, 2 * RUN);
                is_open |= more;
                run >= 2 * RUN
            } else if let Some(two) = open.get(..2 * kind.bytes()) {
                two.chunks_exact(kind.bytes()).all(|packet| kind.is_right(packet))
            } else {
                is_open |= kind.begins(open);
                false
            };
            if is_found && kind == Kind::Express && alike.is_none() {
                self.is_alike = true;
                return Step::Discard;
            }
            if is_found {
                self.expect(Expect::Packets(kind));
                self.is_locked = true;
                return self.step(1);
            }
        }
        if is_open { Step::Wait } else { Step::Discard }
    }

    fn take(&mut self, len: usize, packets: usize) -> Span {
        let skipped = core::mem::take(&mut self.skipped);
        let reasons = if skipped > 0 { suspect::NEIGHBOUR } else { 0 };
        self.text = 0;
        let offset = self.buffer.offset();
        Span { at: self.buffer.take(len, packets), len, packets, offset, skipped, reasons }
    }

    /// Discards the first open byte. Returns whether a boot message is found with it.
    fn discard(&mut self) -> bool {
        let byte = self.buffer.open().first().copied().unwrap_or_default();
        let is_text = matches!(byte, b' '..=b'~' | b'\r' | b'\n');
        self.last_text.rotate_left(1);
        self.last_text[NAME.len() - 1] = byte;
        self.buffer.discard(1);
        self.is_locked = false;
        self.skipped = self.skipped.saturating_add(1);
        self.is_named &= self.text > 0;
        self.text = if is_text { self.text + 1 } else { 0 };
        let is_name = self.last_text == *NAME && !self.is_named;
        self.is_named |= is_name;
        // Text may precede the boot message, so that its name arrives late.
        self.text == GREETING || is_name && self.text > GREETING
    }
}

/// Returns the number of consecutive packets of one point, at most `most`, and whether more bytes could extend the run.
fn run(open: &[u8], most: usize) -> (usize, bool) {
    let mut before = None;
    let (nodes, rest) = open.as_chunks::<5>();
    for (count, node) in nodes.iter().take(most).enumerate() {
        let angle = Kind::Standard.start(node);
        let off = before.map_or(0.0, |before: f32| (angle - before).abs());
        if !Kind::Standard.is_right(node) || (NEAR..360.0 - NEAR).contains(&off) {
            return (count, false);
        }
        before = Some(angle);
    }
    let is_open = nodes.len() < most && Kind::Standard.begins(rest);
    (nodes.len().min(most), is_open)
}

/// Capacity of a tty for a late reader, and two packets.
const CAPACITY: usize = 4_096 + 2 * Kind::LONGEST;
/// After this time without a byte, no more bytes are in flight: in the slowest stream, an adapter passes on a packet
/// every 6 ms.
const HOLD: Nanos = 10 * MILLIS;
/// Minimum number of packets of one point in a run. A wrong position has as many once in millions.
const RUN: usize = 6;
/// Maximum angle between two consecutive points in degrees, even if some are missing between them.
const NEAR: f32 = 30.0;
/// Minimum length of a boot message. It has 64 bytes of text, and some may be missing.
const GREETING: usize = 40;
/// Part of that text, near its beginning.
const NAME: &[u8; 5] = b"LIDAR";
