//! The session with an LMS: bytes and the time go in; telegrams, bytes to send and the next deadline come out.

use crate::line::{self, Account, Control, Output, State, suspect};
use crate::lms::arrival::{Arrivals, Rhythm, Stamp};
use crate::lms::cadence::Cadence;
use crate::lms::damage::Damage;
use crate::lms::dialogue::Dialogue;
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
use crate::lms::header::Reject;
use crate::lms::identity::Identity;
use crate::lms::measured::{FirstValues, MEASURED};
use crate::lms::outgoing::SOON;
use crate::lms::phase::{Phase, Settings};
use crate::lms::reply::Reply;
use crate::lms::sensor::{Sensor, Trouble};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{BYTES_PER_TURN, Baud, Mode, Variant};
use schema::Nanos;

/// A decoded telegram.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a> {
    /// The telegram, in the session's buffer.
    pub telegram: Telegram<'a>,
    /// The reply that it contains. `None` if it cannot be decoded.
    pub reply: Option<Reply<'a>>,
    /// Mode, which defines how a value is split into range and intensity. `None` while the scanner has not reported it, if the angles of
    /// the values are unknown, or if the telegram arrived at another rate than that of the settings.
    pub mode: Option<Mode>,
    /// Rate at which the session streams.
    pub baud: Baud,
    /// Number of the first byte among all bytes of the session, from 0.
    pub offset: u64,
}

/// A telegram with its stamps.
pub type Received<'a> = line::Received<'a, Message<'a>>;

/// Measured values of a telegram that is not complete yet. It may turn out to be damaged.
#[derive(Clone, Copy, Debug)]
pub struct Begun<'a> {
    /// The values that have arrived.
    pub values: FirstValues<'a>,
    /// Mode, which defines how a value is split into range and intensity.
    pub mode: Mode,
    /// Rate at which the session streams.
    pub baud: Baud,
    /// Number of the first byte of the telegram among all bytes of the session, from 0.
    pub offset: u64,
    /// Bytes that have arrived.
    pub bytes: usize,
    /// Time at which the first byte arrived.
    pub first: Nanos,
    /// Time at which the last of these bytes arrived.
    pub last: Nanos,
    /// Reasons for suspicion so far: bits of [`crate::line::suspect`].
    pub reasons: u8,
}

/// The session with one scanner. If the scanner is replaced within a second by one that streams already, with the same number
/// of values and the same address, the session does not notice.
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
    /// Stamp of the last byte of the last telegram.
    last_stamp: Nanos,
    cut: bool,
    /// Size of the buffer of the next read.
    room: usize,
    /// Whether the last read filled its buffer, so that more bytes may be waiting.
    has_more: bool,
    /// Time until which waiting bytes are not read.
    left_until: Option<Nanos>,
}

impl Session {
    /// Creates a session on a port that is open at the rate of `settings`.
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

    /// Restores the identity that the previous session saved a moment ago. Scans are available at once if the scanner still
    /// streams as it did then. The session still requests the status. Call it before the first read.
    pub fn recall(&mut self, known: Identity) {
        self.dialogue.recalled = Some(known);
    }

    /// Sets the rate that is tried first, in place of 9,600, if no stream arrives: the rate at which the scanner was
    /// [found](Self::found_at) the last time. Call it before the first read.
    pub fn seek_first(&mut self, baud: Baud) {
        self.dialogue.rest_at = baud;
        self.dialogue.first = baud;
    }

    /// Returns the rate to try first the next time: the one at which the search found the scanner, or the one in use if the
    /// line cannot carry 500,000 baud. `None` if there was no search.
    pub fn found_at(&self) -> Option<Baud> {
        self.dialogue.rate_in_place_of_fast().or(self.dialogue.found_at)
    }

    /// Restores the [number of silent switches](Self::silent_switches) that the previous session counted. After two of
    /// them, the session streams at 38,400 baud, unless its settings keep it at 500,000. Call it before the first read.
    pub fn recall_silent_switches(&mut self, count: u8) {
        self.dialogue.fast_switches.restore(count);
        if self.dialogue.limit_rate() {
            self.dialogue.begin(self.now);
        }
    }

    /// Returns the number of switches to 500,000 baud in a row that the scanner acknowledged and that were followed by
    /// silence, at most 2. It outlives restarts of the scanner.
    pub fn silent_switches(&self) -> u8 {
        self.dialogue.fast_switches.silent()
    }

    /// Returns the identity for the next session. `None` if the scanner does not stream, or has not reported all of it.
    pub fn identity(&self) -> Option<Identity> {
        match self.dialogue.phase {
            Phase::Streaming { header, .. } => self.sensor().identity(header),
            _ => None,
        }
    }

    /// Returns the rate of the line.
    pub fn baud(&self) -> Baud {
        self.dialogue.baud
    }

    /// Returns what the scanner has reported.
    pub fn sensor(&self) -> &Sensor {
        &self.dialogue.sensor
    }

    /// Returns why the session does not stream.
    pub fn trouble(&self) -> Option<Trouble> {
        self.dialogue.trouble()
    }

    /// Sets the number of reads per telegram to `pieces`, so that [`begun`](Self::begun) returns more values each time. With 0
    /// and 1, a telegram is read when it is complete.
    pub fn look_in(&mut self, pieces: u8) {
        self.rhythm.look_in(pieces);
    }

    /// Returns the values of the scan that is arriving. Call it when [`poll_output`](line::Session::poll_output) has returned a wait.
    /// `None` between scans, and while the mode of the scanner is not known.
    pub fn begun(&self) -> Option<Begun<'_>> {
        if !self.is_live() || !self.is_at_rate() {
            return None;
        }
        let begun = self.framer.begun()?;
        let values = FirstValues::of(begun.bytes)?;
        let mode = self.dialogue.sensor.mode_of_scans()?;
        let (baud, bytes) = (self.dialogue.baud.rate(), begun.bytes.len());
        let first = self.arrivals.stamp(begun.offset, baud);
        let last = self.arrivals.stamp(begun.offset + bytes as u64 - 1, baud);
        Some(Begun {
            values,
            mode,
            baud: self.dialogue.settings.baud,
            offset: begun.offset,
            bytes,
            first: first.at.max(self.last_stamp),
            last: last.at.max(first.at).max(self.last_stamp),
            reasons: begun.reasons,
        })
    }

    /// Returns the counters of the framer.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    /// Stamps a telegram, and passes it to the dialogue.
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
        // A later read may show that bytes were older than their stamps. Those before them were older still, but their stamps
        // are published.
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
            message: Message {
                telegram,
                reply,
                mode,
                baud: self.dialogue.settings.baud,
                offset: span.offset,
            },
            first: first.at,
            last,
            estimated,
            reasons: framed.reasons | if slow { suspect::SLOW } else { 0 },
        }
    }

    /// Returns when the first byte arrived that is in no telegram yet.
    fn next_began(&self) -> Nanos {
        let open = self.tally().read - self.framer.buffered() as u64;
        self.arrivals.stamp(open, self.dialogue.baud.rate()).at
    }

    /// Returns the time between two scans like `telegram`, which decodes to `reply`, if it is part of a stream with a known period.
    fn period(&self, telegram: Telegram<'_>, reply: Option<&Reply<'_>>) -> Option<Nanos> {
        let Some(Reply::Measured(measured)) = reply.filter(|_| self.is_live()) else { return None };
        let variant = Variant::of_beams(measured.count()).filter(|_| measured.partial().is_none())?;
        Some(variant.period(telegram.bytes().len(), self.dialogue.baud.rate()))
    }

    /// Returns when the scan of `len` bytes at `offset` began, if it is part of a backlog of a host that did not run. The time follows
    /// from its position in the backlog, limited by the time of the read.
    fn due(&self, first: &Stamp, offset: u64, len: u64) -> Option<Nanos> {
        let latest = first.latest?;
        let slots = (offset - self.last_scan + len / 2) / len;
        self.cadence.after(slots).map(|due| due.clamp(first.at, latest))
    }

    /// Returns whether a scanner streams, and not a recording.
    fn is_live(&self) -> bool {
        self.dialogue.state() == State::Streaming && !self.dialogue.settings.listen_only
    }

    /// Returns whether the line has the rate of the settings, so that periods and durations are those of that rate.
    fn is_at_rate(&self) -> bool {
        // Bytes that were read before a change of the rate arrived at the previous rate.
        self.dialogue.change_baud.is_none() && self.dialogue.baud == self.dialogue.settings.baud
    }

    /// Returns whether bytes arrive at the pace of a line, unlike those of a recording or a network.
    fn has_pace(&self) -> bool {
        !(self.dialogue.settings.listen_only || self.dialogue.settings.fixed_rate)
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
        // A reply takes less time than a scan.
        let is_silent = self.dialogue.open.is_none();
        begins && is_silent && self.rhythm.duration().is_some() && self.has_pace() && self.is_live()
    }

    fn leave(&mut self, now: Nanos, waiting: usize) -> bool {
        self.now = now;
        // If the bytes of more than a revolution wait, the host did not run. Then the read has to find out since when they wait.
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
                // On a network, the first bytes of a reply may be all of it.
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

    /// The number of scans that the scanner must have sent follows from their period, after the first scan of each stream. A stream
    /// ends when no scan arrives for a second, and when a request is sent. Nothing is due of a stream without a known period, of
    /// partial scans, and of a recording. A loss is counted a second later. A scan that the scanner aborts to reply is not damage.
    /// The session resynchronizes when no measured data arrive for a second, when the scanner reports power-on, and when a user
    /// requests it.
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
