//! What a session of packets keeps of its reads: when bytes came, for how long the line may be left alone, and the stamps
//! before which no later ones go. Refuses to know what a packet is.

use crate::line::arrival::TTY;
use crate::line::{Arrivals, Output};
use schema::{MILLIS, Nanos};

/// The reads of one session.
#[derive(Clone, Debug)]
pub struct Reads {
    arrivals: Arrivals,
    last_byte: Nanos,
    /// Bytes that the next read has room for.
    room: usize,
    /// Until when nothing has to be read.
    rest_until: Nanos,
    last_packet: Nanos,
    last_turn: Nanos,
    /// From which byte on the next packet is suspect, and why.
    doubt: (u64, u8),
}

impl Reads {
    /// Of a session that begins at `now`.
    pub fn new(now: Nanos) -> Reads {
        Reads {
            arrivals: Arrivals::default(),
            last_byte: now,
            room: 0,
            rest_until: 0,
            last_packet: 0,
            last_turn: 0,
            doubt: (0, 0),
        }
    }

    /// The next read has room for so many bytes.
    pub fn offer(&mut self, room: usize) {
        self.room = room;
    }

    /// A read at `now` brought `len` bytes. While a scanner streams, packets are read some at once. What waited is read without
    /// a rest: as long as a tty is full, what comes finds no room.
    pub fn note(&mut self, now: Nanos, len: usize, is_streaming: bool) {
        self.arrivals.note(now, len);
        let is_all = (1..self.room.min(TTY)).contains(&len);
        self.rest_until = if is_streaming && is_all { now + REST } else { 0 };
        self.last_byte = if len > 0 { now } else { self.last_byte };
    }

    /// The line is to be looked at again at once.
    pub fn end_rest(&mut self) {
        self.rest_until = 0;
    }

    /// When which byte was there.
    pub fn arrivals(&self) -> &Arrivals {
        &self.arrivals
    }

    /// When the last byte came, or the session began.
    pub fn last_byte(&self) -> Nanos {
        self.last_byte
    }

    /// The packet that comes next is suspect for these `reasons`, bits of [`crate::line::suspect`].
    pub fn doubt(&mut self, reasons: u8) {
        if reasons != 0 {
            let from = if self.doubt.1 == 0 { self.arrivals.total() } else { self.doubt.0 };
            self.doubt = (from, self.doubt.1 | reasons);
        }
    }

    /// Why packets are suspect of which the last one ends before byte number `end`, beside what is in them: packets may be
    /// held back until the next bytes come.
    pub fn take_doubt(&mut self, end: u64) -> u8 {
        if end > self.doubt.0 { core::mem::take(&mut self.doubt.1) } else { 0 }
    }

    /// Returns what to wait for at `now`: the end of a rest, or bytes until the deadline `until`. If the framer holds a packet
    /// back until the line was idle for `hold`, the deadline is the end of that time, if it comes first.
    pub fn wait<'a>(&self, now: Nanos, until: Nanos, hold: Option<Nanos>) -> Output<'a> {
        if self.rest_until > now {
            return Output::Rest(self.rest_until);
        }
        let held_until = hold.map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Output::Wait { until: until.min(held_until) }
    }

    /// When a packet was over that seems to be over at `last`: not before the one before it.
    pub fn date_packet(&mut self, last: Nanos) -> Nanos {
        self.last_packet = last.max(self.last_packet);
        self.last_packet
    }

    /// From when to when a turn is that seems to be from `first` to `last`: it does not begin before the one before it.
    pub fn turn_dates(&self, first: Nanos, last: Nanos) -> (Nanos, Nanos) {
        let first = first.max(self.last_turn);
        (first, last.max(first))
    }

    /// A turn was over that began at `first`.
    pub fn end_turn(&mut self, first: Nanos) {
        self.last_turn = first;
    }
}

/// A stream is read so late after bytes of it were: some packets at once, and a tenth of what a tty keeps.
const REST: Nanos = 5 * MILLIS;
