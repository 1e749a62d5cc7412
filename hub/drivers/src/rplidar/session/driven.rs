//! The session as its driver sees it: what goes in, and what is wanted next.

use crate::line;
use crate::line::{Account, Control, Heard, Output, Packets, Received, State};
use schema::Nanos;

use super::reply::Reply;
use super::{Phase, Session};
use crate::rplidar::framer::{Found, Span};
use crate::rplidar::request::Head;
use crate::rplidar::told::{Health, Trouble};

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
            if let Phase::Draining { until, .. } = &mut self.phase {
                *until = now + super::dialogue::QUIET;
            }
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => self.rest(false),
            (Control::Resume, Phase::Paused { is_resting: false }) => self.begin(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.trouble = None;
                self.begin(State::Probing);
            }
        }
    }

    fn followed(&mut self, now: Nanos, is_followed: bool) {
        self.now = now;
        if !is_followed {
            self.idle_since.get_or_insert(now);
            return;
        }
        self.idle_since = None;
        if let Phase::Paused { is_resting: true } = self.phase {
            self.begin(State::Starting);
        }
    }

    fn end(&mut self, now: Nanos) -> bool {
        self.now = now;
        let is_at_work = !self.settings.listen_only && !matches!(self.phase, Phase::Paused { .. });
        if is_at_work {
            self.rest(false);
        }
        is_at_work
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        if self.outgoing.advance() {
            self.sent();
        }
    }

    fn poll_output(&mut self) -> Output<Heard<'_>> {
        loop {
            if let Some(on) = self.change_dtr.take() {
                return Output::SetDtr(on);
            }
            if core::mem::take(&mut self.change_baud) {
                self.framer.clear();
                return Output::SetRate(self.baud);
            }
            if let Some(byte) = self.outgoing.next() {
                return Output::Transmit { byte, not_before: 0 };
            }
            if let Some(closed) = self.advance_turns() {
                return Output::Heard(Heard::Turn(self.show(closed)));
            }
            let most = self.framer.kind().map_or(1, |kind| self.most_together(kind));
            let Some(found) = self.framer.advance(most) else { break };
            match found {
                Found::Reply(answer, span) => {
                    let data = Reply::new(&self.framer.bytes(span)[Head::LEN..]);
                    self.answered(answer, data);
                    return Output::Heard(Heard::Packets(self.reply(span)));
                }
                Found::Stream(span) => {
                    self.stream_begins();
                    return Output::Heard(Heard::Packets(self.reply(span)));
                }
                Found::Packets(kind, span) => {
                    return Output::Heard(Heard::Packets(self.receive(kind, span)));
                }
                Found::Greeting { is_named } => self.booted(is_named),
            }
        }
        self.expire();
        if self.change_dtr.is_some() || self.change_baud || self.outgoing.next().is_some() {
            return self.poll_output();
        }
        self.reads.wait(self.now, self.deadline(), self.framer.hold())
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Hearing { has_turned: false, .. } => State::Starting,
            Phase::Hearing { .. } => State::Streaming,
            Phase::Paused { .. } => State::Paused,
            _ => self.shown,
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        let is_paused = matches!(self.phase, Phase::Paused { .. });
        let warning = self.health.filter(|health| matches!(health, Health::Warning(_))).map(Trouble::Unwell);
        self.trouble.or(self.no_mode.map(Trouble::NoMode)).or(warning).filter(|_| !is_paused)
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoAnswer { .. })).then_some("RPLIDAR replies")
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
            resyncs: self.resyncs,
            restarts: self.restarts,
            began_with_a_cut: self.cut,
            rejected_checksum: tally.rejected_checksum,
        }
    }
}

impl Session {
    fn reply(&self, span: Span) -> Received<'_, Packets> {
        Received {
            bytes: self.framer.bytes(span),
            message: Packets { count: span.packets, is_checked: false, is_reply: true },
            first: self.reads.last_byte(),
            last: self.reads.last_byte(),
            estimated: true,
            reasons: 0,
        }
    }
}
