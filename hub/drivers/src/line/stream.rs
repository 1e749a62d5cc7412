//! A stream of packets: when to read and what is suspect, the deadlines after which the stream is silent or its head is
//! blocked, and the counters of its session.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::arrival_time::MAX_TTY_READ;
use crate::line::framing::ByteCounters;
use crate::line::session::{SessionStats, State};
use crate::line::{Action, ReadLog};

/// The reads of one session.
#[derive(Clone, Debug)]
pub struct ReadScheduler {
    read_log: ReadLog,
    last_byte: Nanos,
    /// Size of the buffer of the next read.
    buffer_len: usize,
    /// Time of the next read.
    next_read_at: Nanos,
    last_packet: Nanos,
    last_revolution: Nanos,
    /// Number of the byte from which on the next packet is suspect, and the reasons.
    suspect: (u64, u8),
}

impl ReadScheduler {
    /// Creates the reads of a session that begins at `now`.
    pub fn new(now: Nanos) -> ReadScheduler {
        ReadScheduler {
            read_log: ReadLog::default(),
            last_byte: now,
            buffer_len: 0,
            next_read_at: 0,
            last_packet: 0,
            last_revolution: 0,
            suspect: (0, 0),
        }
    }

    /// Sets the size of the buffer of the next read.
    pub fn set_buffer_len(&mut self, buffer_len: usize) {
        self.buffer_len = buffer_len;
    }

    /// Handles a read of `len` bytes at `now`. While a scanner streams, some packets are read at once. A backlog is
    /// read without pauses: while a tty is full, it drops bytes that arrive.
    pub fn note_read(&mut self, now: Nanos, len: usize, is_streaming: bool) {
        self.read_log.note_read(now, len);
        let is_drained = (1..self.buffer_len.min(MAX_TTY_READ)).contains(&len);
        self.next_read_at = if is_streaming && is_drained { now + READ_INTERVAL } else { 0 };
        self.last_byte = if len > 0 { now } else { self.last_byte };
    }

    /// Cancels the wait for the next read.
    pub fn cancel_wait(&mut self) {
        self.next_read_at = 0;
    }

    /// Returns the arrival times of bytes.
    pub fn read_log(&self) -> &ReadLog {
        &self.read_log
    }

    /// Returns when the last byte arrived, or the session began.
    pub fn last_byte(&self) -> Nanos {
        self.last_byte
    }

    /// Marks the next packet as suspect for these `reasons`, bits of [`crate::line::suspect`].
    pub fn mark_suspect(&mut self, reasons: u8) {
        if reasons != 0 {
            let from = if self.suspect.1 == 0 { self.read_log.total() } else { self.suspect.0 };
            self.suspect = (from, self.suspect.1 | reasons);
        }
    }

    /// Returns the marked reasons for packets that end before byte number `end`. The mark may belong to later ones,
    /// because the framer may hold packets back.
    pub fn take_suspect(&mut self, end: u64) -> u8 {
        if end > self.suspect.0 { core::mem::take(&mut self.suspect.1) } else { 0 }
    }

    /// Returns what to wait for at `now`: the end of a rest, or bytes until the deadline `until`. If the framer holds a
    /// packet back until the line was idle for `hold`, the deadline is the end of that time, if it comes first.
    pub fn wait_action<'a>(&self, now: Nanos, until: Nanos, hold: Option<Nanos>) -> Action<'a> {
        if self.next_read_at > now {
            return Action::SleepUntil(self.next_read_at);
        }
        let held_until = hold.map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Action::Wait { until: until.min(held_until) }
    }

    /// Returns the stamp of the end of a packet: `last`, but not before that of the previous packet.
    pub fn stamp_packet(&mut self, last: Nanos) -> Nanos {
        self.last_packet = last.max(self.last_packet);
        self.last_packet
    }

    /// Returns the stamps of a revolution: `first` and `last`, but not before the beginning of the previous revolution.
    pub fn revolution_stamps(&self, first: Nanos, last: Nanos) -> (Nanos, Nanos) {
        let first = first.max(self.last_revolution);
        (first, last.max(first))
    }

    /// Stores the beginning of a complete revolution.
    pub fn end_revolution(&mut self, first: Nanos) {
        self.last_revolution = first;
    }
}

/// Interval between reads of a stream: for some packets at once, and a tenth of the bytes that a tty keeps.
const READ_INTERVAL: Nanos = 5 * MILLIS;

/// Deadlines of a stream, from its first packet on.
#[derive(Clone, Copy, Debug)]
pub struct Watchdog {
    silent_at: Nanos,
    /// Time from which the wait for a revolution counts: the end of the last one, or the beginning of the stream.
    revolution_at: Nanos,
    has_revolution: bool,
}

impl Watchdog {
    /// After this time without a packet, a stream is silent.
    pub const SILENCE_TIMEOUT: Nanos = 1_000 * MILLIS;
    /// After this time without a revolution, the head is blocked. The slowest head rotates twice per second.
    const REVOLUTION_TIMEOUT: Nanos = 2_000 * MILLIS;

    /// Creates the deadlines of a stream that begins at `now`.
    pub fn new(now: Nanos) -> Watchdog {
        Watchdog { silent_at: now + Watchdog::SILENCE_TIMEOUT, revolution_at: now, has_revolution: false }
    }

    /// Handles packets that arrived at `now`.
    pub fn note_packets(&mut self, now: Nanos) {
        self.silent_at = now + Watchdog::SILENCE_TIMEOUT;
    }

    /// Handles a revolution that was complete at `now`.
    pub fn note_revolution(&mut self, now: Nanos) {
        (self.revolution_at, self.has_revolution) = (now, true);
    }

    /// Starts to wait for a revolution at `now`, whatever was before.
    pub fn await_revolution(&mut self, now: Nanos) {
        self.revolution_at = now;
    }

    /// Extends both deadlines for a head that may need until `until` to reach its speed, and measures only then.
    pub fn await_spin_up(&mut self, until: Nanos) {
        (self.revolution_at, self.silent_at) = (until, until);
    }

    /// Returns when the stream is silent if no packet arrives.
    pub fn silent_at(&self) -> Nanos {
        self.silent_at
    }

    /// Returns whether the stream is silent at `now`.
    pub fn is_silent(&self, now: Nanos) -> bool {
        now >= self.silent_at
    }

    /// Returns whether a revolution is overdue at `now`.
    pub fn is_revolution_overdue(&self, now: Nanos) -> bool {
        now >= self.revolution_at + Watchdog::REVOLUTION_TIMEOUT
    }

    /// Returns the state of a session whose stream this is.
    pub fn state(&self) -> State {
        if self.has_revolution { State::Streaming } else { State::Starting }
    }
}

/// Counters of a session, in addition to those of its framer.
#[derive(Clone, Copy, Debug, Default)]
pub struct StreamCounters {
    /// Discarded bytes of streams.
    damaged: u64,
    /// All discarded bytes when `damaged` was updated.
    discarded: u64,
    /// Discarded bytes of streams and bytes of packets, when the last revolution ended.
    revolution_start: (u64, u64),
    resyncs: u64,
    restarts: u64,
    first_frame_truncated: bool,
}

impl StreamCounters {
    /// Handles the beginning of a stream. Bytes that were discarded before it are not damage.
    pub fn begin_stream(&mut self, tally: &ByteCounters) {
        self.discarded = tally.discarded;
        self.await_revolution(tally);
    }

    /// Handles packets of a stream that has begun before.
    pub fn continue_stream(&mut self, tally: &ByteCounters) {
        self.damaged += tally.discarded - self.discarded;
        self.discarded = tally.discarded;
    }

    /// Handles `packets` packets that can be assigned to revolutions. Bytes before the first ones are a cut packet.
    pub fn note_packets(&mut self, tally: &ByteCounters, packets: usize) {
        self.first_frame_truncated |= tally.packets == packets as u64 && tally.discarded > 0;
    }

    /// Starts to count for the next revolution.
    pub fn await_revolution(&mut self, tally: &ByteCounters) {
        self.revolution_start = (self.damaged, tally.in_packets);
    }

    /// Returns whether most bytes since the last revolution were damaged, so that the next one may be missing because
    /// of that.
    pub fn is_mostly_damaged(&self, tally: &ByteCounters) -> bool {
        let (damaged, in_packets) = self.revolution_start;
        self.damaged - damaged > tally.in_packets - in_packets
    }

    /// Counts a restart of the session.
    pub fn note_resync(&mut self) {
        self.resyncs += 1;
    }

    /// Counts a restart of the scanner that the session did not request.
    pub fn note_restart(&mut self) {
        self.restarts += 1;
    }

    /// Returns all counters. `received_and_lost` are packets.
    pub fn stats(
        &self,
        tally: &ByteCounters,
        buffered: usize,
        received_and_lost: (u64, u64),
    ) -> SessionStats {
        let (received, lost) = received_and_lost;
        SessionStats {
            read: tally.read,
            in_telegrams: tally.in_packets,
            acknowledge: 0,
            discarded: tally.discarded,
            buffered: buffered as u64,
            telegrams: tally.packets,
            due: received + lost,
            lost,
            damaged: self.damaged,
            rejected_checksum: tally.rejected_checksum,
            resyncs: self.resyncs,
            restarts: self.restarts,
            first_frame_truncated: self.first_frame_truncated,
        }
    }
}
