//! Read schedule, deadlines and counters of a stream of packets. The deadlines detect a silent stream and a blocked
//! head.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::arrival_time::MAX_TTY_READ;
use crate::line::framing::ByteCounters;
use crate::line::session::{SessionStats, State};
use crate::line::{Action, ReadLog};

/// Schedule of a session's reads. It also creates the stamps of packets and stores the reasons why the next packet is
/// suspect.
#[derive(Clone, Debug)]
pub struct ReadScheduler {
    read_log: ReadLog,
    last_byte: Nanos,
    /// Size of the buffer of the next read, in bytes.
    buffer_len: usize,
    /// Time of the next read. If this time has passed, the session reads as soon as the port has bytes.
    next_read_at: Nanos,
    last_packet: Nanos,
    last_revolution: Nanos,
    /// End offset and reasons of a mark: the next packet that ends after this offset is suspect for these reasons, bits
    /// of [`crate::line::suspect`].
    suspect: (u64, u8),
}

impl ReadScheduler {
    /// Creates the schedule of a session that starts at `now`.
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

    /// Sets the size of the buffer of the next read, in bytes.
    pub fn set_buffer_len(&mut self, buffer_len: usize) {
        self.buffer_len = buffer_len;
    }

    /// Handles a read of `len` bytes at `now`. While a scanner streams, the next read waits, so that it returns several
    /// packets. A backlog is read without a wait, because a full tty drops the bytes that arrive.
    pub fn note_read(&mut self, now: Nanos, len: usize, is_streaming: bool) {
        self.read_log.note_read(now, len);
        let is_drained = (1..self.buffer_len.min(MAX_TTY_READ)).contains(&len);
        self.next_read_at = if is_streaming && is_drained { now + READ_INTERVAL } else { 0 };
        self.last_byte = if len > 0 { now } else { self.last_byte };
    }

    /// Cancels the wait before the next read.
    pub fn cancel_wait(&mut self) {
        self.next_read_at = 0;
    }

    /// Returns the log of reads.
    pub fn read_log(&self) -> &ReadLog {
        &self.read_log
    }

    /// Returns the time at which the last byte arrived. Before the first byte, returns the start of the session.
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

    /// Returns the reasons why packets that end before the byte at `end` are suspect, and clears these reasons. The
    /// framer may have held the packets back: if they were read before the caller marked the reasons, returns 0, and
    /// the reasons stay for later packets.
    pub fn take_suspect(&mut self, end: u64) -> u8 {
        if end > self.suspect.0 { core::mem::take(&mut self.suspect.1) } else { 0 }
    }

    /// Returns the next wait at `now`. The session sleeps until the time of the next read. After this time, it waits
    /// for bytes until the deadline `until`. If the framer holds a packet back, the deadline is at the latest the time
    /// at which the line has been idle for `hold_time`.
    pub fn wait_action<'a>(&self, now: Nanos, until: Nanos, hold_time: Option<Nanos>) -> Action<'a> {
        if self.next_read_at > now {
            return Action::SleepUntil(self.next_read_at);
        }
        let held_until = hold_time.map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Action::Wait { until: until.min(held_until) }
    }

    /// Returns the stamp of a packet that ends at `last`. The stamp is never earlier than the previous packet's stamp.
    pub fn stamp_packet(&mut self, last: Nanos) -> Nanos {
        self.last_packet = last.max(self.last_packet);
        self.last_packet
    }

    /// Returns the stamps of a revolution. The first stamp is not earlier than the start of the previous revolution,
    /// and the second stamp is not earlier than the first one.
    pub fn revolution_stamps(&self, first: Nanos, last: Nanos) -> (Nanos, Nanos) {
        let first = first.max(self.last_revolution);
        (first, last.max(first))
    }

    /// Stores the start of a complete revolution.
    pub fn end_revolution(&mut self, first: Nanos) {
        self.last_revolution = first;
    }
}

/// Interval between the reads of a stream. One read returns several packets, but at most a tenth of the bytes that a
/// tty can buffer.
const READ_INTERVAL: Nanos = 5 * MILLIS;

/// Deadlines of a stream, which start with its first packet.
#[derive(Clone, Copy, Debug)]
pub struct Watchdog {
    silent_at: Nanos,
    /// Start of the deadline for the next revolution: the end of the last revolution, or the start of the stream.
    revolution_at: Nanos,
    has_revolution: bool,
}

impl Watchdog {
    /// Time without a packet after which a stream is silent.
    pub const SILENCE_TIMEOUT: Nanos = 1_000 * MILLIS;
    /// Time without a revolution after which the head counts as blocked. The slowest head rotates twice per second.
    const REVOLUTION_TIMEOUT: Nanos = 2_000 * MILLIS;

    /// Creates the deadlines of a stream that starts at `now`.
    pub fn new(now: Nanos) -> Watchdog {
        Watchdog { silent_at: now + Watchdog::SILENCE_TIMEOUT, revolution_at: now, has_revolution: false }
    }

    /// Restarts the deadline for silence after packets that arrived at `now`.
    pub fn note_packets(&mut self, now: Nanos) {
        self.silent_at = now + Watchdog::SILENCE_TIMEOUT;
    }

    /// Restarts the deadline for the next revolution after a revolution that was complete at `now`.
    pub fn note_revolution(&mut self, now: Nanos) {
        (self.revolution_at, self.has_revolution) = (now, true);
    }

    /// Restarts the deadline for the next revolution at `now`, although no revolution was complete.
    pub fn await_revolution(&mut self, now: Nanos) {
        self.revolution_at = now;
    }

    /// Extends the deadline for silence to `until`, and restarts the deadline for the next revolution at `until`.
    /// Before this time, the head may still be spinning up, and the scanner may not measure.
    pub fn await_spin_up(&mut self, until: Nanos) {
        (self.revolution_at, self.silent_at) = (until, until);
    }

    /// Returns the time at which the stream is silent if no packet arrives.
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

    /// Returns the state of the session: `Streaming` after the first revolution, `Starting` before it.
    pub fn state(&self) -> State {
        if self.has_revolution { State::Streaming } else { State::Starting }
    }
}

/// Counters of a session in addition to the counters of its framer.
#[derive(Clone, Copy, Debug, Default)]
pub struct StreamCounters {
    /// Number of bytes that were discarded during streams.
    damaged: u64,
    /// Number of all discarded bytes at the last update of `damaged`.
    discarded: u64,
    /// Number of damaged bytes and number of bytes in packets, at the end of the last revolution.
    revolution_start: (u64, u64),
    resyncs: u64,
    restarts: u64,
    first_frame_truncated: bool,
}

impl StreamCounters {
    /// Handles the start of a stream. Bytes that were discarded before it do not count as damaged.
    pub fn begin_stream(&mut self, tally: &ByteCounters) {
        self.discarded = tally.discarded;
        self.await_revolution(tally);
    }

    /// Handles packets of a stream that has already started. Counts the bytes that were discarded since the last call
    /// as damaged.
    pub fn continue_stream(&mut self, tally: &ByteCounters) {
        self.damaged += tally.discarded - self.discarded;
        self.discarded = tally.discarded;
    }

    /// Handles `packets` packets of a stream. If they are the first packets and bytes were discarded before them, the
    /// first packet counts as truncated.
    pub fn note_packets(&mut self, tally: &ByteCounters, packets: usize) {
        self.first_frame_truncated |= tally.packets == packets as u64 && tally.discarded > 0;
    }

    /// Starts to count bytes for the next revolution.
    pub fn await_revolution(&mut self, tally: &ByteCounters) {
        self.revolution_start = (self.damaged, tally.in_packets);
    }

    /// Returns the problem of a stream whose next revolution is overdue: `blocked` if less than 2 % of the bytes
    /// since the last revolution were damaged, `damaged` if less than 51 % were damaged, and otherwise `None`. The hub itself
    /// reports a line that damages most bytes.
    pub fn overdue_problem<P>(&self, tally: &ByteCounters, blocked: P, damaged: P) -> Option<P> {
        let (damaged_start, intact_start) = self.revolution_start;
        let (damaged_bytes, intact_bytes) = (self.damaged - damaged_start, tally.in_packets - intact_start);
        match 100 * damaged_bytes / (damaged_bytes + intact_bytes).max(1) {
            0 | 1 => Some(blocked),
            2..=50 => Some(damaged),
            _ => None,
        }
    }

    /// Counts a restart of the session.
    pub fn note_resync(&mut self) {
        self.resyncs += 1;
    }

    /// Counts a restart of the scanner that the session did not request.
    pub fn note_restart(&mut self) {
        self.restarts += 1;
    }

    /// Returns all counters of the session. `received_and_lost` are numbers of packets, and `buffered` is a number of
    /// bytes.
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
