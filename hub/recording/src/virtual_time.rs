//! A session with a scanner in the time of a recording: it hears each packet when the hub heard it that recorded it, and
//! what it waits for in between comes when it is due. So it makes of the packets what was made of them then. Refuses to know
//! where they are from, and what becomes of that.

use scanhub_drivers::line::{Event, Output, Protocol};
use schema::Nanos;

/// `S` in a time that its owner tells.
pub struct VirtualTime<S> {
    session: S,
    now: Nanos,
    /// When it wants to be asked again.
    until: Nanos,
}

impl<S: Protocol> VirtualTime<S> {
    /// Begins with `session`, which was made at `now`.
    pub fn new(session: S, now: Nanos) -> VirtualTime<S> {
        VirtualTime { session, now, until: now }
    }

    /// Returns the session.
    pub fn session(&self) -> &S {
        &self.session
    }

    /// Returns the session, to be told something.
    pub fn session_mut(&mut self) -> &mut S {
        &mut self.session
    }

    /// Advances the time to `now`, and then passes `bytes` to the session. `handle` receives the events. Time never goes
    /// back: an earlier `now` counts as the last one.
    pub fn take(&mut self, now: Nanos, bytes: &[u8], mut handle: impl FnMut(Event<'_>)) {
        let now = now.max(self.now);
        while self.until < now {
            self.now = self.until.max(self.now);
            self.session.spare();
            self.session.commit(self.now, 0);
            self.session.handle_timeout(self.now);
            self.drain(&mut handle);
            // What it waits for did not come, and cannot be waited for again in the same moment.
            self.until = self.until.max(self.now + 1);
        }
        self.now = now;
        let mut bytes = bytes;
        while !bytes.is_empty() {
            let room = self.session.spare();
            let (taken, rest) = bytes.split_at(bytes.len().min(room.len()));
            room[..taken.len()].copy_from_slice(taken);
            self.session.commit(now, taken.len());
            self.drain(&mut handle);
            bytes = rest;
        }
    }

    fn drain(&mut self, handle: &mut impl FnMut(Event<'_>)) {
        self.until = loop {
            let is_sent = match self.session.poll_output() {
                Output::Transmit { .. } => true,
                Output::Event(event) => {
                    handle(event);
                    false
                }
                Output::SetRate(_) | Output::SetDtr(_) => false,
                Output::Rest(until) | Output::Wait { until, .. } => break until,
            };
            // Nobody is there who could hear it.
            if is_sent {
                self.session.transmitted(self.now);
            }
        };
    }
}
