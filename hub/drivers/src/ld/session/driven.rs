//! The session as its driver sees it: what goes in, and what is wanted next.

use crate::line;
use crate::line::{Account, Control, Heard, Output, State};
use schema::Nanos;

use super::{MOST, Phase, Session};
use crate::ld::heard::Trouble;

impl line::Session for Session {
    type Heard<'a> = Heard<'a>;
    type Trouble = Trouble;

    fn spare(&mut self) -> &mut [u8] {
        let spare = self.framer.spare();
        self.reads.offer(spare.len());
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.reads.note(now, len, self.state() == State::Streaming);
        if len > 0 {
            self.framer.commit(len);
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => {
                self.listen(State::Paused);
                self.phase = Phase::Paused;
            }
            (Control::Resume, Phase::Paused) => self.listen(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.trouble = None;
                self.listen(State::Probing);
            }
        }
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
    }

    fn poll_output(&mut self) -> Output<Heard<'_>> {
        if let Some(closed) = self.advance_turns() {
            return Output::Heard(Heard::Turn(self.show(closed)));
        }
        while let Some(span) = self.framer.advance(most_together(self.baud)) {
            if !matches!(self.phase, Phase::Paused) {
                return Output::Heard(Heard::Packets(self.receive(span)));
            }
        }
        self.expire();
        if core::mem::take(&mut self.change_baud) {
            self.framer.clear();
            return Output::SetRate(self.baud);
        }
        let until = match self.phase {
            Phase::Listening { next_at, .. } => next_at,
            Phase::Hearing { silent_at, .. } => silent_at,
            Phase::Paused => Nanos::MAX,
        };
        self.reads.wait(self.now, until, self.framer.hold())
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Listening { shown, .. } => shown,
            Phase::Hearing { has_turned: false, .. } => State::Starting,
            Phase::Hearing { .. } => State::Streaming,
            Phase::Paused => State::Paused,
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        self.trouble.filter(|_| !matches!(self.phase, Phase::Paused))
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoPackets { .. })).then_some("LDROBOT packets")
    }

    fn rate(&self) -> u32 {
        self.baud
    }

    fn account(&self) -> Account {
        let tally = self.framer.tally();
        let (came, lost) = self.sequence.came_and_lost();
        Account {
            read: tally.read,
            in_telegrams: tally.in_packets,
            acknowledge: 0,
            discarded: tally.discarded,
            buffered: self.framer.buffered() as u64,
            telegrams: tally.packets,
            due: came + lost,
            lost,
            damaged: self.damaged.0,
            rejected_checksum: tally.rejected_checksum,
            resyncs: self.resyncs,
            restarts: self.restarts.count(),
            began_with_a_cut: self.cut,
        }
    }
}

/// Packets of one sample: as many as arrive in ten milliseconds.
const fn most_together(baud: u32) -> usize {
    if baud > 500_000 { MOST } else { 3 }
}
