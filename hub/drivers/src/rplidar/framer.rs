//! Finds answers and packets in a stream of bytes of which some are missing, and the greeting of a scanner that booted.
//!
//! A packet of one point has no checksum, and of wrong places 1 in 70 looks like one. So such packets are believed after a
//! run of them with angles near each other, and each only if another one follows it. Knows no clock.

use crate::line::framing::{Format, Verdict, judge};
use crate::line::{Buffer, Tally, suspect};
use schema::{MILLIS, Nanos};

use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Head};

/// What the bytes may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Expect {
    /// Nothing that is wanted.
    Nothing,
    /// Answers, among what is left of a stream.
    Answers,
    /// Packets of this kind.
    Packets(Kind),
    /// Packets of any kind; express and dense ones look alike, these are taken for the given one, if there is one.
    Anything(Option<Kind>),
}

/// What was found.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Found {
    /// An answer, its head and what follows it.
    Reply(Answer, Span),
    /// The head of packets.
    Stream(Span),
    /// Packets without anything between them.
    Packets(Kind, Span),
    /// The text that a scanner sends when it booted. Other bytes may be text too, but hardly ever contain the word `LIDAR`.
    Greeting {
        /// Whether the text contains that word.
        is_named: bool,
    },
}

/// Bytes in the framer's buffer, until the next ones come.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    at: usize,
    pub(crate) len: usize,
    /// How many packets they are.
    pub(crate) packets: usize,
    /// Number of the first byte among all bytes committed, from 0.
    pub(crate) offset: u64,
    /// Bytes between it and the packet before it.
    pub(crate) skipped: u32,
    /// Bits of [`suspect`]; 0 is clean.
    pub(crate) reasons: u8,
}

/// The framer with its buffer.
#[derive(Clone, Debug)]
pub(crate) struct Framer {
    buffer: Buffer<CAPACITY>,
    expect: Expect,
    /// The next packet has to begin where the last one ended.
    is_locked: bool,
    is_held: bool,
    is_released: bool,
    /// Bytes discarded since the last packet.
    skipped: u32,
    /// Printable ones among them, in a row, the last of them, and whether they contain [`NAME`].
    text: usize,
    last_text: [u8; NAME.len()],
    is_named: bool,
    /// There were packets that look alike, and it was not said what they are.
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

/// What to do about the first open bytes.
enum Step {
    Take(usize),
    Discard,
    Wait,
}

impl Framer {
    pub(crate) fn new(expect: Expect) -> Self {
        Framer {
            buffer: Buffer::default(),
            expect,
            is_locked: false,
            is_held: false,
            is_released: false,
            skipped: 0,
            text: 0,
            last_text: [0; NAME.len()],
            is_named: false,
            is_alike: false,
        }
    }

    /// From now on the bytes are this.
    pub(crate) fn expect(&mut self, expect: Expect) {
        self.expect = expect;
        (self.is_locked, self.skipped) = (false, 0);
    }

    /// Room for the next bytes, never empty after [`Framer::advance`] answered `None`.
    pub(crate) fn spare(&mut self) -> &mut [u8] {
        self.buffer.spare()
    }

    /// The first `len` bytes of [`Framer::spare`] are valid now.
    pub(crate) fn commit(&mut self, len: usize) {
        self.buffer.commit(len);
        self.is_released &= len == 0;
    }

    /// What is next, of packets `most` at most; `None` until more bytes come.
    pub(crate) fn advance(&mut self, most: usize) -> Option<Found> {
        self.is_held = false;
        loop {
            let open = self.buffer.open();
            if open.is_empty() {
                return None;
            }
            // What begins where the last packet ended is the next one, though it may look like an answer.
            if !self.is_locked && self.expect != Expect::Nothing && Head::begins(open) {
                match Head::parse(open) {
                    Some(Head::Reply(_, len)) if open.len() < Head::LEN + len => return None,
                    Some(Head::Reply(answer, len)) => {
                        return Some(Found::Reply(answer, self.take(Head::LEN + len, 1)));
                    }
                    Some(Head::Stream(kind)) => {
                        let span = self.take(Head::LEN, 1);
                        self.expect(Expect::Packets(kind));
                        self.is_locked = true;
                        return Some(Found::Stream(span));
                    }
                    None if open.len() < Head::LEN => return None,
                    None => {}
                }
            }
            match self.step(most) {
                Step::Take(packets) => {
                    let Expect::Packets(kind) = self.expect else { return None };
                    self.is_locked = true;
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

    /// The bytes at a span that [`Framer::advance`] answered last.
    pub(crate) fn bytes(&self, span: Span) -> &[u8] {
        self.buffer.taken(span.at, span.len)
    }

    /// Of `span`, which [`Framer::advance`] answered last, the packets from number `packets` on are to come once more.
    pub(crate) fn cut(&mut self, span: &mut Span, packets: usize) {
        let len = span.len / span.packets;
        self.buffer.give_back((span.packets - packets) * len, span.packets - packets);
        (span.len, span.packets) = (packets * len, packets);
    }

    /// How long the line must be idle until [`Framer::release`] may let pass what waits; `None` if nothing does.
    pub(crate) fn hold(&self) -> Option<Nanos> {
        self.is_held.then_some(HOLD)
    }

    /// A read found nothing, and no byte came for `idle`.
    pub(crate) fn release(&mut self, idle: Nanos) {
        self.is_released |= self.is_held && idle >= HOLD;
    }

    /// Gives up all bytes that are still open.
    pub(crate) fn clear(&mut self) {
        self.buffer.clear();
        (self.is_held, self.is_released, self.text) = (false, false, 0);
    }

    /// The kind of packets that are expected.
    pub(crate) fn kind(&self) -> Option<Kind> {
        if let Expect::Packets(kind) = self.expect { Some(kind) } else { None }
    }

    /// Whether there were packets of which it was not said what they are.
    pub(crate) fn is_alike(&self) -> bool {
        self.is_alike
    }

    /// Returns the number of bytes that were discarded since the last packet.
    pub(crate) fn skipped(&self) -> u32 {
        self.skipped
    }

    pub(crate) fn tally(&self) -> &Tally {
        self.buffer.tally()
    }

    pub(crate) fn buffered(&self) -> usize {
        self.buffer.open().len()
    }

    fn step(&mut self, most: usize) -> Step {
        match self.expect {
            Expect::Nothing | Expect::Answers => Step::Discard,
            Expect::Anything(alike) => self.seek(alike),
            Expect::Packets(Kind::Standard) => self.nodes(most),
            Expect::Packets(kind) => {
                let mut packets = 0;
                while packets < most {
                    match judge(&kind, &self.buffer.open()[packets * kind.bytes()..], self.is_released) {
                        Verdict::Packet => packets += 1,
                        _ if packets > 0 => break,
                        Verdict::Open => return Step::Wait,
                        Verdict::Held => {
                            self.is_held = true;
                            return Step::Wait;
                        }
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

    /// Packets of one point, `most` at most, as far as they are believed.
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

    /// Looks for two packets of any kind, one behind the other.
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

    /// Gives up the first open byte. Returns whether a greeting is found with it.
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
        // Text may precede the greeting, so that its name comes late.
        self.text == GREETING || is_name && self.text > GREETING
    }
}

/// How many packets of one point are here in a row, of `most`, and whether more bytes could make it longer.
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

/// What a tty keeps for a reader who is late, and two packets.
const CAPACITY: usize = 4_096 + 2 * Kind::LONGEST;
/// After so long without a byte nothing is under way: an adapter hands bytes on by the packet, in the slowest stream each 6 ms.
const HOLD: Nanos = 10 * MILLIS;
/// Packets of one point that are believed together: wrong places give as many once in millions.
const RUN: usize = 6;
/// Degrees between two points of one head, one after the other, even if some are missing between them.
const NEAR: f32 = 30.0;
/// A scanner that booted sends 64 bytes of text, of which some may be missing.
const GREETING: usize = 40;
/// Part of that text, near its beginning.
const NAME: &[u8; 5] = b"LIDAR";
