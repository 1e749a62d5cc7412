//! Supervision of a stream of packets: the deadlines after which a stream is silent or its head is blocked, and the
//! counters of its session.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::framing::Tally;
use crate::line::session::{Account, State};

/// Deadlines of a stream, from its first packet on.
#[derive(Clone, Copy, Debug)]
pub struct Watchdog {
    silent_at: Nanos,
    /// Time from which the wait for a revolution counts: the end of the last one, or the beginning of the stream.
    turned_at: Nanos,
    has_turned: bool,
}

impl Watchdog {
    /// After this time without a packet, a stream is silent.
    pub const SILENCE: Nanos = 1_000 * MILLIS;
    /// After this time without a revolution, the head is blocked. The slowest head rotates twice per second.
    const STILL: Nanos = 2_000 * MILLIS;

    /// Creates the deadlines of a stream that begins at `now`.
    pub fn new(now: Nanos) -> Watchdog {
        Watchdog { silent_at: now + Watchdog::SILENCE, turned_at: now, has_turned: false }
    }

    /// Handles packets that arrived at `now`.
    pub fn note_packets(&mut self, now: Nanos) {
        self.silent_at = now + Watchdog::SILENCE;
    }

    /// Handles a revolution that was complete at `now`.
    pub fn note_revolution(&mut self, now: Nanos) {
        (self.turned_at, self.has_turned) = (now, true);
    }

    /// Starts to wait for a revolution at `now`, whatever was before.
    pub fn await_revolution(&mut self, now: Nanos) {
        self.turned_at = now;
    }

    /// Extends both deadlines for a head that may need until `until` to reach its speed, and measures only then.
    pub fn await_spin_up(&mut self, until: Nanos) {
        (self.turned_at, self.silent_at) = (until, until);
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
        now >= self.turned_at + Watchdog::STILL
    }

    /// Returns the state of a session whose stream this is.
    pub fn state(&self) -> State {
        if self.has_turned { State::Streaming } else { State::Starting }
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
    at_revolution: (u64, u64),
    resyncs: u64,
    restarts: u64,
    began_with_a_cut: bool,
}

impl StreamCounters {
    /// Handles the beginning of a stream. Bytes that were discarded before it are not damage.
    pub fn begin_stream(&mut self, tally: &Tally) {
        self.discarded = tally.discarded;
        self.await_revolution(tally);
    }

    /// Handles packets of a stream that has begun before.
    pub fn continue_stream(&mut self, tally: &Tally) {
        self.damaged += tally.discarded - self.discarded;
        self.discarded = tally.discarded;
    }

    /// Handles `packets` packets that can be assigned to revolutions. Bytes before the first ones are a cut packet.
    pub fn note_packets(&mut self, tally: &Tally, packets: usize) {
        self.began_with_a_cut |= tally.packets == packets as u64 && tally.discarded > 0;
    }

    /// Starts to count for the next revolution.
    pub fn await_revolution(&mut self, tally: &Tally) {
        self.at_revolution = (self.damaged, tally.in_packets);
    }

    /// Returns whether most bytes since the last revolution were damaged, so that the next one may be missing because
    /// of that.
    pub fn is_mostly_damaged(&self, tally: &Tally) -> bool {
        let (damaged, in_packets) = self.at_revolution;
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
    pub fn account(&self, tally: &Tally, buffered: usize, received_and_lost: (u64, u64)) -> Account {
        let (received, lost) = received_and_lost;
        Account {
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
            began_with_a_cut: self.began_with_a_cut,
        }
    }
}
