//! What a scanner with a head that turns has to send, one thing after the other at the pace of its line. Knows nothing
//! of a family, and not what is lost on the way.

use std::collections::VecDeque;

use schema::Nanos;

use crate::device::{Chunk, Part, Sent};
use crate::transmission::{ChunkSize, Transmission};

/// The scanner's end of the line.
#[derive(Debug)]
pub(crate) struct Outlet {
    /// With each whether it is a reply.
    queue: VecDeque<Transmission<bool>>,
    chunk: ChunkSize,
    rate: u32,
    free_ns: Nanos,
}

impl Outlet {
    /// One at `rate` bits per second, whose bytes arrive as `chunk` says.
    pub(crate) fn new(rate: u32, chunk: ChunkSize) -> Outlet {
        Outlet { queue: VecDeque::new(), chunk, rate, free_ns: 0 }
    }

    /// Sends `telegram` as soon as everything before it is through, at `at_ns` at the earliest.
    pub(crate) fn send(&mut self, telegram: Vec<u8>, at_ns: Nanos, is_reply: bool) {
        let start_ns = at_ns.max(self.free_ns);
        let transmission = Transmission::new(telegram, start_ns, self.rate, self.chunk, is_reply);
        self.free_ns = transmission.end_ns();
        self.queue.push_back(transmission);
    }

    /// The next bytes that are through at `now`.
    pub(crate) fn take(&mut self, now: Nanos) -> Option<Chunk> {
        let rate = self.rate;
        let front = self.queue.front_mut()?;
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        if !front.is_done() {
            return Some(Chunk { bytes, rate, idle_after, part: Part::Telegram });
        }
        let front = self.queue.pop_front()?;
        let aborted = front.is_broken();
        let (telegram, is_reply) = front.into_parts();
        Some(Chunk { bytes, rate, idle_after, part: Part::End(Sent { is_reply, telegram, aborted }) })
    }

    /// When the next bytes are through; nothing if there is nothing to send.
    pub(crate) fn next_ns(&self) -> Option<Nanos> {
        self.queue.front().map(Transmission::next_chunk_ns)
    }

    /// When everything is through that it was given.
    pub(crate) fn free_ns(&self) -> Nanos {
        self.free_ns
    }

    /// Breaks off what is on the line and forgets what has not begun. Returns whether anything was broken off.
    pub(crate) fn break_off(&mut self, now: Nanos) -> bool {
        self.queue.retain(|transmission| transmission.start_ns() <= now);
        let mut broken = false;
        self.free_ns = now;
        for transmission in &mut self.queue {
            transmission.break_off(now);
            broken |= transmission.is_broken();
            self.free_ns = transmission.end_ns().max(now);
        }
        broken
    }

    /// Forgets the data that has not begun to leave.
    pub(crate) fn forget_data(&mut self, now: Nanos) {
        self.queue.retain(|transmission| transmission.tag || transmission.start_ns() <= now);
        self.free_ns = self.queue.back().map_or(now, Transmission::end_ns);
    }

    /// Bits per second.
    pub(crate) fn rate(&self) -> u32 {
        self.rate
    }
}
