//! A sensor behind a line, driven from outside as [`line::Session`] says: bytes and the time go in, bytes and telegrams and
//! the next deadline come out.

mod beat;
mod begun;

use crate::line;
use crate::line::{Account, Control, Output, State, suspect};
use crate::lms::arrival::{Arrivals, Rhythm};
use crate::lms::cadence::Cadence;
use crate::lms::damage::Damage;
use crate::lms::dialogue::Dialogue;
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
use crate::lms::header::Reject;
use crate::lms::identity::Identity;
use crate::lms::measured::MEASURED;
use crate::lms::outgoing::SOON;
use crate::lms::phase::{Phase, Settings};
use crate::lms::reply::Reply;
use crate::lms::sensor::{Sensor, Trouble};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{BYTES_PER_TURN, Baud, Mode};
use schema::Nanos;

pub use begun::Begun;

/// What a telegram says.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a> {
    /// The telegram, in the session's buffer.
    pub telegram: Telegram<'a>,
    /// What it says; `None` if it cannot be read.
    pub reply: Option<Reply<'a>>,
    /// How measured values are split; `None` while the sensor has not reported it, if the angles of the values are not
    /// known, or if they came at another rate than the wanted one, by which their period and their age are judged.
    pub mode: Option<Mode>,
    /// Number of its first byte among all bytes of the session, from 0.
    pub offset: u64,
}

/// A telegram with its stamps.
pub type Received<'a> = line::Received<'a, Message<'a>>;

/// One sensor's session. A sensor that is exchanged within a second for one that streams already, with the same number
/// of values and the same address, is taken for the same one.
#[derive(Clone, Debug)]
pub struct Session {
    framer: Framer,
    dialogue: Dialogue,
    arrivals: Arrivals,
    rhythm: Rhythm,
    cadence: Cadence,
    damage: Damage,
    /// Number of the first byte of the last scan.
    last_scan: u64,
    now: Nanos,
    last_byte: Nanos,
    /// Of the last byte of the last telegram.
    last_stamp: Nanos,
    cut: bool,
    /// What the next read has room for, and whether the last one left none: then more may be there already.
    room: usize,
    has_more: bool,
    /// Until when bytes that are there are not read.
    left_until: Option<Nanos>,
}

impl Session {
    /// A session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        Session {
            framer: Framer::default(),
            dialogue: Dialogue::new(settings, now),
            arrivals: Arrivals::new(now),
            rhythm: Rhythm::new(),
            cadence: Cadence::new(),
            damage: Damage::default(),
            last_scan: 0,
            now,
            last_byte: now,
            last_stamp: 0,
            cut: false,
            room: 0,
            has_more: false,
            left_until: None,
        }
    }

    /// What a session before this one knew of the sensor a moment ago: scans begin at once if the sensor streams on as it did
    /// then, and what its status says is asked all the same. To be said before anything is read.
    pub fn recall(&mut self, known: Identity) {
        self.dialogue.recalled = Some(known);
    }

    /// The rate that is asked first if nobody streams, in place of 9600: where a sensor that did not stream was
    /// [found](Self::found_at) the last time. To be said before anything is read.
    pub fn seek_first(&mut self, baud: Baud) {
        self.dialogue.rest_at = baud;
        self.dialogue.first = baud;
    }

    /// The rate at which a sensor that was sought answered; nothing if none had to be sought.
    pub fn found_at(&self) -> Option<Baud> {
        self.dialogue.found_at
    }

    /// What the next session would have to ask if this one ended now; nothing if the sensor does not stream, or has not told
    /// all of it.
    pub fn identity(&self) -> Option<Identity> {
        match self.dialogue.phase {
            Phase::Streaming { header, .. } => self.sensor().identity(header),
            _ => None,
        }
    }

    /// The rate at which it listens and talks.
    pub fn baud(&self) -> Baud {
        self.dialogue.baud
    }

    /// What it knows of the sensor.
    pub fn sensor(&self) -> &Sensor {
        &self.dialogue.sensor
    }

    /// Why it is not where it should be.
    pub fn trouble(&self) -> Option<Trouble> {
        self.dialogue.trouble()
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    fn receive(&mut self, span: TelegramSpan) -> Received<'_> {
        let baud = self.dialogue.baud.rate();
        let framed = self.framer.view(span);
        let telegram = framed.telegram;
        let reply = Reply::decode(telegram);
        let (len, is_scan) = (telegram.bytes().len() as u64, telegram.command() == MEASURED);
        let period = self.period(telegram, reply.as_ref());
        let mut first = self.arrivals.stamp(span.offset, baud);
        let last = self.arrivals.stamp(span.offset + len - 1, baud);
        // A line may have held back only the end of a telegram.
        let estimated = first.estimated || last.estimated;
        let due = period.and(self.due(&first, span.offset, len));
        // What is read later may tell that bytes were older than was thought; those before them were older still, but
        // that has been said.
        first.at = due.unwrap_or(first.at).max(self.last_stamp);
        let last = match due.and(self.rhythm.duration()) {
            Some(usual) => (first.at + usual).min(last.latest.unwrap_or(last.at)),
            None => last.at,
        };
        let last = last.max(first.at);
        self.last_stamp = last;
        match period {
            Some(period) => self.cadence.note(first.at, first.estimated, period),
            None => self.cadence.rest(),
        }
        if self.is_live() {
            self.damage.note(self.framer.tally(), self.now);
        } else {
            self.damage.end();
        }
        self.last_scan = if is_scan { span.offset } else { self.last_scan };
        self.cut |= is_scan && self.tally().telegrams == 1 && self.tally().discarded > 0;
        // Replies follow requests, and a recording has the pace of its reader.
        let has_rhythm = is_scan && self.is_live() && !first.estimated;
        let took = last.saturating_sub(first.at);
        let slow = has_rhythm && self.rhythm.is_slow(took);
        if has_rhythm {
            self.rhythm.complete(took);
        } else {
            self.rhythm.lose();
        }
        if self.framer.buffered() > 0 {
            let begun = self.next_began();
            self.rhythm.begin(begun);
        }
        self.dialogue.sensor.doubt(self.damage.is_recent(self.now));
        let is_at_rate = self.is_at_rate();
        self.dialogue.on_telegram(telegram, reply, first.at, self.now);
        let mode = self.dialogue.sensor.mode_of_scans().filter(|_| is_at_rate);
        Received {
            bytes: telegram.bytes(),
            message: Message { telegram, reply, mode, offset: span.offset },
            first: first.at,
            last,
            estimated,
            reasons: framed.reasons | if slow { suspect::SLOW } else { 0 },
        }
    }

    /// When the first byte arrived that is in no telegram yet.
    fn next_began(&self) -> Nanos {
        let open = self.tally().read - self.framer.buffered() as u64;
        self.arrivals.stamp(open, self.dialogue.baud.rate()).at
    }
}

impl line::Session for Session {
    type Heard<'a> = Received<'a>;
    type Trouble = Trouble;

    fn spare(&mut self) -> &mut [u8] {
        let spare = self.framer.spare();
        self.room = spare.len();
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.has_more = len > 0 && len == self.room;
        self.left_until = None;
        self.arrivals.note(now, len, self.has_pace().then_some(self.dialogue.baud.rate()));
        if len == 0 {
            return;
        }
        let was_empty = self.framer.buffered() == 0;
        self.framer.commit(len);
        self.last_byte = now;
        self.dialogue.hear();
        if was_empty {
            let begun = self.next_began();
            self.rhythm.begin(begun);
        }
    }

    fn may_leave(&self) -> bool {
        let begins = self.framer.buffered() == 0 && !self.has_more && self.left_until.is_none();
        // An answer takes less time than a scan.
        let is_silent = self.dialogue.open.is_none();
        begins && is_silent && self.rhythm.duration().is_some() && self.has_pace() && self.is_live()
    }

    fn leave(&mut self, now: Nanos, waiting: usize) -> bool {
        self.now = now;
        // More than a turn's bytes came while the host did not look: the read has to find out since when.
        if (1..=BYTES_PER_TURN).contains(&waiting) && self.may_leave() {
            self.arrivals.sense(now, waiting);
            let begun = self.next_began();
            self.rhythm.begin(begun);
            self.left_until = self.rhythm.rest(now);
        }
        self.left_until.is_some()
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.release(now.saturating_sub(self.last_byte));
        if self.is_live() {
            // The stream may be over now.
            self.damage.note(self.framer.tally(), now);
        }
        self.dialogue.handle_timeout(now);
    }

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        self.left_until = None;
        self.dialogue.control(control, now);
    }

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        let (baud, is_fixed) = (self.dialogue.baud, self.dialogue.settings.fixed_rate);
        if let Some(outgoing) = self.dialogue.outgoing() {
            outgoing.transmitted(now, baud);
            if is_fixed {
                // From a network the first sign of a reply may be all of it.
                outgoing.hear(baud);
            }
        }
    }

    fn poll_output(&mut self) -> Output<Received<'_>> {
        while let Some(found) = self.framer.advance() {
            match found {
                Advance::Telegram(span) => return Output::Heard(self.receive(span)),
                Advance::Ack => self.dialogue.on_acknowledge(self.now),
                Advance::Nak => self.dialogue.on_nak(self.now),
            }
        }
        if let Some(baud) = self.dialogue.take_change_baud() {
            self.framer.clear();
            self.rhythm.lose();
            return Output::SetRate(baud.rate());
        }
        self.framer.expect(self.dialogue.expect());
        self.framer.await_acknowledge(self.dialogue.awaits_acknowledge());
        let next_byte = self.dialogue.outgoing().and_then(|outgoing| outgoing.byte());
        if let Some((byte, not_before)) = next_byte.filter(|&(_, at)| at <= self.now + SOON) {
            // The sensor skips scans while it answers.
            self.cadence.rest();
            return Output::Transmit { byte, not_before };
        }
        if let Some(until) = self.left_until {
            return Output::Rest(until);
        }
        if self.framer.buffered() == 0 {
            self.rhythm.lose();
        } else if self.is_live()
            && self.dialogue.open.is_none()
            && !self.has_more
            && let Some(until) = self.rhythm.rest(self.now)
        {
            return Output::Rest(until);
        }
        // A telegram may be held back until the line was idle for a while.
        let held_until = self.framer.hold().map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Output::Wait { until: self.dialogue.deadline().min(held_until) }
    }

    fn state(&self) -> State {
        self.dialogue.state()
    }

    fn trouble(&self) -> Option<Trouble> {
        self.trouble()
    }

    fn missing(&self) -> Option<&'static str> {
        matches!(self.trouble(), Some(Trouble::NoAnswer { .. })).then_some("LMS replies")
    }

    fn rate(&self) -> u32 {
        self.dialogue.baud.rate()
    }

    /// What the sensor must have sent is known by its period, after the first scan of each stream. A stream ends when scans
    /// stay out for a second, and where the sensor is asked something; of one whose period is not known, of parts of scans
    /// and of a recording nothing was due. What is lost is known a second later. What the sensor breaks off to answer is no
    /// damage. The session begins again when no measured data came for a second, when the sensor reported power-on, or when
    /// a user asked for it.
    fn account(&self) -> Account {
        let tally = self.framer.tally();
        Account {
            read: tally.read,
            in_telegrams: tally.in_telegrams,
            acknowledge: tally.acknowledge,
            discarded: tally.discarded,
            buffered: self.framer.buffered() as u64,
            telegrams: tally.telegrams,
            due: self.cadence.due(),
            lost: self.cadence.lost(),
            damaged: self.damage.damaged(tally),
            rejected_checksum: tally.rejected[Reject::Crc as usize],
            resyncs: self.dialogue.resyncs,
            restarts: self.dialogue.restarts,
            began_with_a_cut: self.cut,
        }
    }
}
