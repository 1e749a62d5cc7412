//! The session with an LMS: bytes and the time go in; telegrams, bytes to send and the next deadline come out.

use scanhub_schema::{Counter, Counters, Nanos, Status};

use crate::line::{
    self, Account, Control, Event, KnownRate, Output, RawScan, Received, State, Whole, suspect,
};
use crate::lms::arrival::{Arrivals, Rhythm, Stamp};
use crate::lms::cadence::{Cadence, Damage};
use crate::lms::dialogue::Dialogue;
use crate::lms::exchange::{Outgoing, SOON};
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
use crate::lms::header::Reject;
use crate::lms::measured::{FirstValues, MEASURED, nominal_period};
use crate::lms::reply::Reply;
use crate::lms::sensor::{Sensor, Trouble};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{BYTES_PER_TURN, Baud, Mode, Unit, Variant};
use crate::settings;

/// Settings of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Requested angle and resolution. A scanner that refuses them streams what it has.
    pub variant: Variant,
    /// Rate to stream at.
    pub baud: Baud,
    /// Whether nothing can be sent, because the bytes are from a recording.
    pub listen_only: bool,
    /// Whether the port has the rate [`baud`](Self::baud) and no other, as with a serial server on the network.
    pub fixed_rate: bool,
    /// Whether to keep to [`baud`](Self::baud) even if the line cannot carry it. Otherwise, the session streams at
    /// 38,400 baud after two switches to 500,000 baud that the scanner acknowledged and that were followed by silence.
    pub keep_baud: bool,
    /// Measuring mode of a recording that does not contain it.
    pub mode: Option<Mode>,
}

/// The session with one scanner. If the scanner is replaced within a second by one that streams already, with the same
/// number of values and the same address, the session does not notice.
#[derive(Clone, Debug)]
pub struct Session {
    settings: Settings,
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
    /// Mode that the last telegrams of a recording reported.
    recorded_mode: Option<Mode>,
}

impl Session {
    /// Creates a session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        Session {
            settings,
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
            recorded_mode: settings.mode,
        }
    }

    /// Restores the [number of silent switches](Self::silent_switches) that the previous session counted. After two of
    /// them, the session streams at 38,400 baud, unless its settings keep it at 500,000. Call it before the first read.
    pub fn recall_silent_switches(&mut self, count: u8) {
        self.dialogue.restore_silent_switches(count, self.now);
    }

    /// Returns the number of switches to 500,000 baud in a row that the scanner acknowledged and that were followed by
    /// silence, at most 2. It outlives restarts of the scanner.
    pub fn silent_switches(&self) -> u8 {
        self.dialogue.rate.silent_switches()
    }

    /// Returns the rate of the line.
    pub fn baud(&self) -> Baud {
        self.dialogue.rate.baud
    }

    /// Returns what the scanner has reported.
    pub fn sensor(&self) -> &Sensor {
        &self.dialogue.sensor
    }

    /// Returns why the session does not stream.
    pub fn trouble(&self) -> Option<Trouble> {
        self.dialogue.trouble()
    }

    /// Returns the counters of the framer.
    pub fn tally(&self) -> &Tally {
        self.framer.tally()
    }

    /// Stamps a telegram, and passes it to the dialogue.
    fn receive(&mut self, span: TelegramSpan) -> Received<'_> {
        let baud = self.baud().rate();
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
        // A later read may show that bytes were older than their stamps. Those before them were older still, but their
        // stamps are published.
        first.at = due.unwrap_or(first.at).max(self.last_stamp);
        let last = match due.and(self.rhythm.duration) {
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
        let (is_at_rate, is_line_damaged) = (self.is_at_rate(), self.damage.is_recent(self.now));
        self.dialogue.on_telegram(telegram, reply, is_line_damaged, first.at, self.now);
        let mode = self.sensor().mode_of_scans().filter(|_| is_at_rate).or(self.settings.mode);
        let received = received(telegram, reply.as_ref(), mode, self.dialogue.rate.target, span.offset);
        let reasons = received.reasons | framed.reasons | if slow { suspect::SLOW } else { 0 };
        Received { first: first.at, last, estimated, reasons, ..received }
    }

    /// Returns when the first byte arrived that is in no telegram yet.
    fn next_began(&self) -> Nanos {
        let open = self.tally().read - self.framer.buffered() as u64;
        self.arrivals.stamp(open, self.baud().rate()).at
    }

    /// Returns the time between two scans like `telegram`, which decodes to `reply`, if it is part of a stream with a
    /// known period.
    fn period(&self, telegram: Telegram<'_>, reply: Option<&Reply<'_>>) -> Option<Nanos> {
        let Some(Reply::Measured(measured)) = reply.filter(|_| self.is_live()) else { return None };
        let variant = Variant::of_beams(measured.count()).filter(|_| measured.partial().is_none())?;
        Some(variant.period(telegram.bytes().len(), self.baud().rate()))
    }

    /// Returns when the scan of `len` bytes at `offset` began, if it is part of a backlog of a host that did not run.
    /// The time follows from its position in the backlog, limited by the time of the read.
    fn due(&self, first: &Stamp, offset: u64, len: u64) -> Option<Nanos> {
        let latest = first.latest?;
        let slots = (offset - self.last_scan + len / 2) / len;
        self.cadence.after(slots).map(|due| due.clamp(first.at, latest))
    }

    /// Returns whether a scanner streams, and not a recording.
    fn is_live(&self) -> bool {
        self.dialogue.state() == State::Streaming && !self.settings.listen_only
    }

    /// Returns whether the line has the rate of the settings, so that periods and durations are those of that rate.
    fn is_at_rate(&self) -> bool {
        let rate = &self.dialogue.rate;
        !rate.is_changed && rate.baud == rate.target
    }

    /// Returns whether bytes arrive at the pace of a line, unlike those of a recording or a network.
    fn has_pace(&self) -> bool {
        !(self.settings.listen_only || self.settings.fixed_rate)
    }
}

impl line::Protocol for Session {
    fn reject_rate(&mut self, now: Nanos) {
        self.now = now;
        self.dialogue.reject_rate();
    }

    fn spare(&mut self) -> &mut [u8] {
        let spare = self.framer.spare();
        self.room = spare.len();
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.has_more = len > 0 && len == self.room;
        self.left_until = None;
        self.arrivals.note(now, len, self.has_pace().then_some(self.baud().rate()));
        if len == 0 {
            return;
        }
        let was_empty = self.framer.buffered() == 0;
        self.framer.commit(len);
        self.rhythm.note_read();
        self.last_byte = now;
        self.dialogue.on_bytes();
        if was_empty {
            let begun = self.next_began();
            self.rhythm.begin(begun);
        }
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

    fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        self.dialogue.transmitted(now);
    }

    fn poll_output(&mut self) -> Output<'_> {
        while let Some(found) = self.framer.advance() {
            match found {
                Advance::Telegram(span) => return Output::Event(Event::Telegram(self.receive(span))),
                Advance::Ack => self.dialogue.on_acknowledge(self.now),
                Advance::Nak => self.dialogue.on_nak(self.now),
            }
        }
        if let Some(baud) = self.dialogue.take_rate_change() {
            self.framer.clear();
            self.rhythm.lose();
            return Output::SetRate(baud.rate());
        }
        self.framer.expect(self.dialogue.expect());
        self.framer.await_acknowledge(self.dialogue.open().is_some());
        let next_at = self.dialogue.open().and_then(Outgoing::next_at);
        if let Some(not_before) = next_at.filter(|&at| at <= self.now + SOON) {
            // The sensor skips scans while it answers.
            self.cadence.rest();
            let bytes = self.dialogue.open().map_or(&[][..], Outgoing::next_byte);
            return Output::Transmit { bytes, not_before };
        }
        if let Some(until) = self.left_until {
            return Output::Rest(until);
        }
        if self.framer.buffered() == 0 {
            self.rhythm.lose();
        } else if self.is_live()
            && self.dialogue.open().is_none()
            && !self.has_more
            && let Some(until) = self.rhythm.rest(self.now)
        {
            return Output::Rest(until);
        }
        // A telegram may be held back until the line was idle for a while.
        let held_until = self.framer.hold().map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Output::Wait { until: self.dialogue.deadline().min(held_until) }
    }
}

impl line::Session for Session {
    type Trouble = Trouble;

    fn can_defer_read(&self) -> bool {
        let begins = self.framer.buffered() == 0 && !self.has_more && self.left_until.is_none();
        // A reply takes less time than a scan.
        let is_silent = self.dialogue.open().is_none();
        begins && is_silent && self.rhythm.duration.is_some() && self.has_pace() && self.is_live()
    }

    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        self.now = now;
        // If the bytes of more than a revolution wait, the host did not run. Then the read has to find out since when
        // they wait.
        if (1..=BYTES_PER_TURN).contains(&waiting) && self.can_defer_read() {
            self.arrivals.sense(now, waiting);
            let begun = self.next_began();
            self.rhythm.begin(begun);
            self.left_until = self.rhythm.rest(now);
        }
        self.left_until.is_some()
    }

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        self.left_until = None;
        self.dialogue.control(control, now);
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
        self.baud().rate()
    }

    /// The number of scans that the scanner must have sent follows from their period, after the first scan of each
    /// stream. A stream ends when no scan arrives for a second, and when a request is sent. Nothing is due of a stream
    /// without a known period, of partial scans, and of a recording. A loss is counted a second later. A scan that the
    /// scanner aborts to reply is not damage. The session resynchronizes when no measured data arrive for a second,
    /// when the scanner reports power-on, and when a user requests it.
    fn account(&self) -> Account {
        let tally = self.framer.tally();
        Account {
            read: tally.read,
            in_telegrams: tally.in_telegrams,
            acknowledge: tally.acknowledge,
            discarded: tally.discarded,
            buffered: self.framer.buffered() as u64,
            telegrams: tally.telegrams,
            due: self.cadence.due,
            lost: self.cadence.lost,
            damaged: self.damage.damaged(tally),
            rejected_checksum: tally.rejected[Reject::Crc as usize],
            resyncs: self.dialogue.resyncs,
            restarts: self.dialogue.restarts(),
            began_with_a_cut: self.cut,
        }
    }

    fn restore_identity(&mut self, identity: line::Identity) {
        self.dialogue.restore_identity(identity);
    }

    fn identity(&self) -> Option<line::Identity> {
        self.dialogue.identity()
    }

    /// The search tries it in place of 9,600 baud if no stream arrives.
    fn hint_rate(&mut self, known: KnownRate) {
        if let Some(baud) = Baud::of_rate(known.baud) {
            self.dialogue.restore_rate(baud);
            self.recall_silent_switches(known.silent_switches);
        }
    }

    fn begin_at(&mut self, rate: u32, now: Nanos) {
        if let Some(baud) = Baud::of_rate(rate) {
            self.dialogue.begin_at(baud, now);
        }
    }

    /// For a line that cannot carry 500,000 baud, it is the rate in use.
    fn known_rate(&self) -> Option<KnownRate> {
        self.dialogue.rate.known()
    }

    fn set_partial_reads(&mut self, count: u8) {
        self.rhythm.look_in(count);
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        if !self.is_live() || !self.is_at_rate() {
            return None;
        }
        let begun = self.framer.begun()?;
        let values = FirstValues::of(begun.bytes)?;
        let scan = values.scan(self.sensor().mode_of_scans()?);
        let (baud, bytes) = (self.baud().rate(), begun.bytes.len());
        let first = self.arrivals.stamp(begun.offset, baud);
        let last = self.arrivals.stamp(begun.offset + bytes as u64 - 1, baud);
        Some(RawScan {
            number: begun.offset,
            first: first.at.max(self.last_stamp),
            last: last.at.max(first.at).max(self.last_stamp),
            period: nominal_period(scan.beams(), self.dialogue.rate.target.rate()),
            reasons: begun.reasons,
            bytes,
            ..scan
        })
    }

    fn unit_mm(&self) -> Option<u8> {
        self.sensor().unit.map(Unit::mm)
    }

    fn notice(&self) -> Option<line::Notice> {
        let notice = self.sensor().notices().next()?;
        Some(line::Notice { text: notice.text(), is_fault: notice.is_fault() })
    }

    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<Received<'a>> {
        let telegram = Telegram::check(telegram)?;
        let reply = Reply::decode(telegram);
        let reported = reply.as_ref().and_then(Reply::mode);
        self.recorded_mode = reported.unwrap_or(self.recorded_mode);
        let mode = self.recorded_mode.filter(|_| is_readable);
        if let Some(status) = status {
            status.mode = mode.map_or(Status::MODE_UNKNOWN, |mode| mode.0);
            match reply {
                Some(Reply::Measured(measured)) => {
                    status.unit_mm = measured.unit().mm();
                    if let Some(variant) = Variant::of_beams(measured.count()) {
                        status.angle_deg = variant.angle_deg;
                        status.resolution_cdeg = variant.resolution_cdeg;
                    }
                }
                Some(Reply::Type(name)) => status.set_sensor_type(&String::from_utf8_lossy(name)),
                _ => {}
            }
        }
        Some(received(telegram, reply.as_ref(), mode, self.dialogue.rate.target, 0))
    }

    fn describe(&self, status: &mut Status) {
        let sensor = self.sensor();
        status.mode = sensor.mode.map_or(Status::MODE_UNKNOWN, |mode| mode.0);
        status.unit_mm = sensor.unit.map_or(0, |unit| unit.mm());
        let Variant { angle_deg, resolution_cdeg } =
            sensor.variant.unwrap_or(Variant { angle_deg: 0, resolution_cdeg: 0 });
        status.angle_deg = angle_deg;
        status.resolution_cdeg = resolution_cdeg;
        status.set_sensor_type(&String::from_utf8_lossy(sensor.kind()));
    }

    fn add_counters(&self, counters: &mut Counters) {
        self.account().add_to(counters);
        let tally = self.framer.tally();
        counters[Counter::Aborted] += tally.aborted;
        for (reject, counter) in REJECTS {
            counters[counter] += tally.rejected[reject as usize];
        }
    }
}

/// Returns `telegram`, which decodes to `reply`, with stamps of 0. Its scan, if it has one, is split as `mode` says.
fn received<'a>(
    telegram: Telegram<'a>,
    reply: Option<&Reply<'a>>,
    mode: Option<Mode>,
    baud: Baud,
    number: u64,
) -> Received<'a> {
    let measured = match reply {
        Some(Reply::Measured(measured)) => Some(*measured),
        _ => None,
    };
    let beams = measured.map_or(0, |measured| measured.count());
    let period = nominal_period(beams, baud.rate());
    // No range is better than a wrong one.
    let split = measured.zip(mode.filter(|mode| mode.has_ranges()));
    let is_forbidden = split.is_some_and(|(measured, mode)| measured.is_forbidden(mode));
    let scan = split.map(|(measured, mode)| RawScan { number, period, ..measured.scan(mode) });
    Received {
        bytes: telegram.bytes(),
        first: 0,
        last: 0,
        estimated: false,
        reasons: if is_forbidden { suspect::FORBIDDEN_BITS } else { 0 },
        count: 1,
        is_checked: true,
        is_reply: telegram.command() != MEASURED,
        whole: Some(Whole { number, beams, period, scan }),
    }
}

impl From<settings::Settings> for Settings {
    fn from(settings: settings::Settings) -> Settings {
        let settings::Settings { view, baud, mode_number, listen_only, fixed_rate, .. } = settings;
        Settings {
            variant: view.and_then(|(angle, step)| Variant::new(angle, step)).unwrap_or(Variant::HALF),
            baud: baud.and_then(Baud::of_rate).unwrap_or(Baud::B500000),
            listen_only,
            fixed_rate,
            keep_baud: baud.is_some(),
            mode: mode_number.map(Mode),
        }
    }
}

/// Counters of rejected telegrams, except for a wrong checksum, which every family has.
const REJECTS: [(Reject, Counter); Reject::COUNT - 1] = [
    (Reject::Address, Counter::RejectedAddress),
    (Reject::Length, Counter::RejectedLength),
    (Reject::Command, Counter::RejectedCommand),
    (Reject::Count, Counter::RejectedCount),
    (Reject::Vetoed, Counter::RejectedVetoed),
    (Reject::Superseded, Counter::RejectedSuperseded),
];
