//! Drives a parser along a [`Line`] on the virtual clock and counts what became of each telegram.

use super::{Line, TELEGRAM, sent_at};
use scanhub_drivers::line::suspect;
use scanhub_drivers::lms::framer::{Found, Framer};
use scanhub_drivers::lms::header::Expect;
use scanhub_schema::{MILLIS, Nanos};

/// A frame that a parser accepted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Accepted<'a> {
    /// Number of its first byte among those read.
    pub(crate) offset: usize,
    /// The frame.
    pub(crate) bytes: &'a [u8],
    /// Bits of [`suspect`].
    pub(crate) reasons: u8,
}

/// What a parser must do to be compared.
pub(crate) trait Parser {
    /// Reads `bytes` and hands over every frame that it accepts.
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(Accepted<'_>));

    /// How long the line must be idle until [`Parser::release`] may hand over more.
    fn hold(&self) -> Option<Nanos> {
        None
    }

    /// Nothing came for `idle`.
    fn release(&mut self, _idle: Nanos, _accept: &mut dyn FnMut(Accepted<'_>)) {}
}

impl Parser for Framer {
    fn read(&mut self, mut bytes: &[u8], accept: &mut dyn FnMut(Accepted<'_>)) {
        while !bytes.is_empty() {
            let spare = self.spare();
            let len = bytes.len().min(spare.len());
            spare[..len].copy_from_slice(&bytes[..len]);
            self.commit(len);
            bytes = &bytes[len..];
            drain(self, accept);
        }
    }

    fn hold(&self) -> Option<Nanos> {
        Framer::hold(self)
    }

    fn release(&mut self, idle: Nanos, accept: &mut dyn FnMut(Accepted<'_>)) {
        Framer::release(self, idle);
        drain(self, accept);
    }
}

fn drain(framer: &mut Framer, accept: &mut dyn FnMut(Accepted<'_>)) {
    while let Some(found) = framer.poll() {
        if let Found::Telegram(framed) = found {
            let (offset, bytes) = (framed.offset as usize, framed.telegram.bytes());
            accept(Accepted { offset, bytes, reasons: framed.reasons });
        }
    }
}

/// The framer as the session sets it for this line's stream.
pub(crate) fn framer(line: &Line) -> Framer {
    let mut framer = Framer::default();
    framer.expect(Expect::Stream { header: line.header, reply: None });
    framer
}

/// What became of the telegrams of one or more lines.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Account {
    /// Telegrams sent.
    pub(crate) telegrams: u64,
    /// Of these, lost a byte of their own.
    pub(crate) damaged: u64,
    /// Were not handed over.
    pub(crate) lost: u64,
    /// Were not handed over although every byte arrived.
    pub(crate) intact_lost: u64,
    /// Frames handed over that no telegram was.
    pub(crate) wrong: u64,
    /// Of these, with no reason to be suspected.
    pub(crate) wrong_clean: u64,
    /// Frames that waited for a header inside them to fail.
    pub(crate) held: u64,
    /// Of the other telegrams, the time from the last byte's arrival to the handing over: sum and greatest.
    pub(crate) extra: Nanos,
    /// See `extra`.
    pub(crate) extra_max: Nanos,
}

impl Account {
    /// Lets `parser` read `line` to its end, as a session would let it: every piece when it arrives, and when a read
    /// finds nothing and the hold is over, the release.
    pub(crate) fn take(&mut self, line: &Line, parser: &mut impl Parser) {
        let mut delivered = vec![false; line.telegrams()];
        let mut begin = 0;
        for (number, piece) in line.pieces.iter().enumerate() {
            parser.read(&line.received[begin..piece.end], &mut |accepted| {
                self.enter(line, accepted, piece.at, &mut delivered);
            });
            begin = piece.end;
            let next = line.pieces.get(number + 1).map_or(Nanos::MAX, |next| next.at);
            while let Some(hold) = parser.hold().filter(|hold| piece.at + hold < next) {
                parser.release(hold, &mut |accepted| {
                    self.enter(line, accepted, piece.at + hold, &mut delivered);
                });
            }
        }
        self.telegrams += line.telegrams() as u64;
        for (number, delivered) in delivered.into_iter().enumerate() {
            let intact = line.is_intact(number);
            self.damaged += u64::from(!intact);
            self.lost += u64::from(!delivered);
            self.intact_lost += u64::from(!delivered && intact);
        }
    }

    /// Mean extra latency in ms, over `telegrams - lost - held`.
    pub(crate) fn extra_mean_ms(&self) -> f64 {
        self.extra as f64 / MILLIS as f64 / (self.telegrams - self.lost - self.held).max(1) as f64
    }

    /// Greatest extra latency in ms.
    pub(crate) fn extra_max_ms(&self) -> f64 {
        self.extra_max as f64 / MILLIS as f64
    }

    fn enter(&mut self, line: &Line, accepted: Accepted<'_>, now: Nanos, delivered: &mut [bool]) {
        let Accepted { offset, bytes, reasons } = accepted;
        let last = offset + bytes.len() - 1;
        assert_eq!(bytes, &line.received[offset..=last], "a parser invents nothing");
        let number = line.origin(offset) / TELEGRAM;
        let held = reasons & suspect::HEADER_INSIDE != 0;
        self.held += u64::from(held);
        // Bytes decide: a damaged telegram that equal bytes of the next one completed is what was sent.
        if bytes == line.telegram(number) && !delivered[number] {
            delivered[number] = true;
            let extra = now - line.readable_at(last);
            if !held {
                self.extra += extra;
                self.extra_max = self.extra_max.max(extra);
            }
            return;
        }
        self.wrong += 1;
        // The session adds this reason to those of the framer.
        let took = sent_at(line.origin(last)) - sent_at(line.origin(offset));
        let slow = took > sent_at(TELEGRAM - 1) - sent_at(0) + SLOW;
        self.wrong_clean += u64::from(reasons == 0 && !slow);
    }
}

impl core::ops::AddAssign for Account {
    fn add_assign(&mut self, other: Account) {
        self.telegrams += other.telegrams;
        self.damaged += other.damaged;
        self.lost += other.lost;
        self.intact_lost += other.intact_lost;
        self.wrong += other.wrong;
        self.wrong_clean += other.wrong_clean;
        self.held += other.held;
        self.extra += other.extra;
        self.extra_max = self.extra_max.max(other.extra_max);
    }
}

/// A telegram that took so much longer than usual is suspect.
const SLOW: Nanos = 8 * MILLIS;
