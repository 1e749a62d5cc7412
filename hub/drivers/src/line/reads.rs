//! Reads of a session with packets: the arrival of bytes, the time of the next read, and stamps that never decrease.

use crate::line::arrival::TTY;
use crate::line::{Arrivals, Output};
use scanhub_schema::{MILLIS, Nanos};

/// The reads of one session.
#[derive(Clone, Debug)]
pub struct Reads {
    arrivals: Arrivals,
    last_byte: Nanos,
    /// Size of the buffer of the next read.
    room: usize,
    /// Time of the next read.
    rest_until: Nanos,
    last_packet: Nanos,
    last_turn: Nanos,
    /// Number of the byte from which on the next packet is suspect, and the reasons.
    doubt: (u64, u8),
}

impl Reads {
    /// Creates the reads of a session that begins at `now`.
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

    /// Sets the size of the buffer of the next read.
    pub fn offer(&mut self, room: usize) {
        self.room = room;
    }

    /// Handles a read of `len` bytes at `now`. While a scanner streams, some packets are read at once. A backlog is
    /// read without pauses: while a tty is full, it drops bytes that arrive.
    pub fn note(&mut self, now: Nanos, len: usize, is_streaming: bool) {
        self.arrivals.note(now, len);
        let is_all = (1..self.room.min(TTY)).contains(&len);
        self.rest_until = if is_streaming && is_all { now + REST } else { 0 };
        self.last_byte = if len > 0 { now } else { self.last_byte };
    }

    /// Cancels the wait for the next read.
    pub fn end_rest(&mut self) {
        self.rest_until = 0;
    }

    /// Returns the arrival times of bytes.
    pub fn arrivals(&self) -> &Arrivals {
        &self.arrivals
    }

    /// Returns when the last byte arrived, or the session began.
    pub fn last_byte(&self) -> Nanos {
        self.last_byte
    }

    /// Marks the next packet as suspect for these `reasons`, bits of [`crate::line::suspect`].
    pub fn doubt(&mut self, reasons: u8) {
        if reasons != 0 {
            let from = if self.doubt.1 == 0 { self.arrivals.total() } else { self.doubt.0 };
            self.doubt = (from, self.doubt.1 | reasons);
        }
    }

    /// Returns the marked reasons for packets that end before byte number `end`. The mark may belong to later ones,
    /// because the framer may hold packets back.
    pub fn take_doubt(&mut self, end: u64) -> u8 {
        if end > self.doubt.0 { core::mem::take(&mut self.doubt.1) } else { 0 }
    }

    /// Returns what to wait for at `now`: the end of a rest, or bytes until the deadline `until`. If the framer holds a
    /// packet back until the line was idle for `hold`, the deadline is the end of that time, if it comes first.
    pub fn wait<'a>(&self, now: Nanos, until: Nanos, hold: Option<Nanos>) -> Output<'a> {
        if self.rest_until > now {
            return Output::Rest(self.rest_until);
        }
        let held_until = hold.map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Output::Wait { until: until.min(held_until) }
    }

    /// Returns the stamp of the end of a packet: `last`, but not before that of the previous packet.
    pub fn date_packet(&mut self, last: Nanos) -> Nanos {
        self.last_packet = last.max(self.last_packet);
        self.last_packet
    }

    /// Returns the stamps of a revolution: `first` and `last`, but not before the beginning of the previous revolution.
    pub fn turn_dates(&self, first: Nanos, last: Nanos) -> (Nanos, Nanos) {
        let first = first.max(self.last_turn);
        (first, last.max(first))
    }

    /// Stores the beginning of a complete revolution.
    pub fn end_turn(&mut self, first: Nanos) {
        self.last_turn = first;
    }
}

/// Interval between reads of a stream: for some packets at once, and a tenth of the bytes that a tty keeps.
const REST: Nanos = 5 * MILLIS;
