//! Session with one LMS. Its inputs are bytes and the time. Its outputs are telegrams, bytes to send and the next
//! deadline.

use scanhub_schema::{Counter, Counters, Nanos, Status};

use crate::line::{
    self, Action, Control, Event, KnownRate, RawScan, ReceivedTelegram, SessionStats, State,
    TelegramContents, suspect,
};
use crate::lms::arrival_time::{ArrivalEstimator, TelegramTiming, Timestamp};
use crate::lms::framer::{FoundItem, Framer, FramerCounters, TelegramSpan};
use crate::lms::header::Reject;
use crate::lms::measured::{MEASURED, PartialValues, nominal_period};
use crate::lms::protocol_state::ProtocolState;
use crate::lms::reply::Reply;
use crate::lms::request_channel::{PendingRequest, SEND_AHEAD};
use crate::lms::scan_schedule::{LineDamage, ScanSchedule};
use crate::lms::sensor::{Problem, Sensor};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{BYTES_PER_REVOLUTION, Baud, Mode, Unit, Variant};
use crate::settings;

/// Settings of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Requested angle and resolution. A scanner that refuses them streams with its own angle and resolution.
    pub variant: Variant,
    /// Baud rate for the stream.
    pub baud: Baud,
    /// Whether the session cannot send, because the bytes come from a recording.
    pub listen_only: bool,
    /// Whether [`baud`](Self::baud) is the only rate of the port, as with a serial server on the network.
    pub fixed_rate: bool,
    /// Whether the session keeps [`baud`](Self::baud) even if the line cannot carry it. Otherwise, the session streams
    /// at 38,400 baud after two switches to 500,000 baud that the scanner acknowledged and after which the line was
    /// silent.
    pub keep_baud: bool,
    /// Measuring mode for a recording that does not contain the mode.
    pub mode: Option<Mode>,
}

/// Session with one scanner. The session does not detect that a user has replaced the scanner, if this took less than a
/// second and the new scanner already streams with the same number of values and the same address.
#[derive(Clone, Debug)]
pub struct LmsSession {
    settings: Settings,
    framer: Framer,
    protocol: ProtocolState,
    arrivals: ArrivalEstimator,
    timing: TelegramTiming,
    schedule: ScanSchedule,
    damage: LineDamage,
    /// Offset of the first byte of the last scan.
    last_scan: u64,
    now: Nanos,
    last_byte: Nanos,
    /// Stamp of the last byte of the last telegram.
    last_stamp: Nanos,
    first_frame_truncated: bool,
    /// Length of the buffer of the next read, in bytes.
    buffer_len: usize,
    /// Whether the last read filled its buffer, so that the port may have more bytes.
    has_more: bool,
    /// Time until which the session leaves bytes unread.
    deferred_until: Option<Nanos>,
    /// Measuring mode in the last telegrams of a recording.
    recorded_mode: Option<Mode>,
}

impl LmsSession {
    /// Creates a session on a port that is open at the rate of `settings`.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        LmsSession {
            settings,
            framer: Framer::default(),
            protocol: ProtocolState::new(settings, now),
            arrivals: ArrivalEstimator::new(now),
            timing: TelegramTiming::new(),
            schedule: ScanSchedule::new(),
            damage: LineDamage::default(),
            last_scan: 0,
            now,
            last_byte: now,
            last_stamp: 0,
            first_frame_truncated: false,
            buffer_len: 0,
            has_more: false,
            deferred_until: None,
            recorded_mode: settings.mode,
        }
    }

    /// Restores the [number of silent switches](Self::silent_switches) that the previous session counted. After two
    /// silent switches, the session streams at 38,400 baud, unless its settings require 500,000 baud. Call this before
    /// the first read.
    pub fn restore_silent_switches(&mut self, count: u8) {
        self.protocol.restore_silent_switches(count, self.now);
    }

    /// Returns the number of consecutive switches to 500,000 baud that the scanner acknowledged and after which the
    /// line was silent, at most 2. A restart of the scanner does not change this number.
    pub fn silent_switches(&self) -> u8 {
        self.protocol.rate.silent_switches()
    }

    /// Returns the baud rate of the line.
    pub fn baud(&self) -> Baud {
        self.protocol.rate.baud
    }

    /// Returns the state that the scanner has reported.
    pub fn sensor(&self) -> &Sensor {
        &self.protocol.sensor
    }

    /// Returns the reason why the session does not stream as requested.
    pub fn problem(&self) -> Option<Problem> {
        self.protocol.problem()
    }

    /// Returns the counters of the framer.
    pub fn framer_counters(&self) -> &FramerCounters {
        self.framer.counters()
    }

    /// Stamps a telegram and passes it to the protocol state.
    fn receive(&mut self, span: TelegramSpan) -> ReceivedTelegram<'_> {
        let baud = self.baud().rate();
        let framed = self.framer.telegram_at(span);
        let telegram = framed.telegram;
        let reply = Reply::decode(telegram);
        let (len, is_scan) = (telegram.bytes().len() as u64, telegram.command() == MEASURED);
        let period = self.period(telegram, reply.as_ref());
        let mut first = self.arrivals.stamp(span.offset, baud);
        let last = self.arrivals.stamp(span.offset + len - 1, baud);
        // The line may have delayed only the end of a telegram, so check both stamps.
        let estimated = first.estimated || last.estimated;
        let due = period.and(self.due_time(&first, span.offset, len));
        // A later read may show that bytes are older than estimated. Stamps of earlier bytes are already published, so
        // a stamp is never earlier than the previous stamp.
        first.at = due.unwrap_or(first.at).max(self.last_stamp);
        let last = match due.and(self.timing.duration) {
            Some(duration) => (first.at + duration).min(last.latest.unwrap_or(last.at)),
            None => last.at,
        };
        let last = last.max(first.at);
        self.last_stamp = last;
        match period {
            Some(period) => self.schedule.note_scan(first.at, first.estimated, period),
            None => self.schedule.end_stream(),
        }
        if self.is_live() {
            self.damage.note_bytes(self.framer.counters(), self.now);
        } else {
            self.damage.end_stream();
        }
        self.last_scan = if is_scan { span.offset } else { self.last_scan };
        self.first_frame_truncated |=
            is_scan && self.framer_counters().telegrams == 1 && self.framer_counters().discarded > 0;
        // Measure only scans of a live stream. The duration of a reply depends on its request, and the duration of a
        // recorded telegram depends on the reader of the recording.
        let is_measurable = is_scan && self.is_live() && !first.estimated;
        let elapsed = last.saturating_sub(first.at);
        let is_slow = is_measurable && self.timing.is_slow(elapsed);
        if is_measurable {
            self.timing.end_telegram(elapsed);
        } else {
            self.timing.reset();
        }
        if self.framer.buffered() > 0 {
            let start = self.next_start();
            self.timing.begin_telegram(start);
        }
        let (is_at_rate, is_line_damaged) = (self.is_at_rate(), self.damage.is_recent(self.now));
        self.protocol.on_telegram(telegram, reply, is_line_damaged, first.at, self.now);
        let mode = self.sensor().mode_of_scans().filter(|_| is_at_rate).or(self.settings.mode);
        let received = to_received(telegram, reply.as_ref(), mode, self.protocol.rate.target, span.offset);
        let reasons = received.reasons | framed.reasons | if is_slow { suspect::SLOW } else { 0 };
        ReceivedTelegram { first: first.at, last, estimated, reasons, ..received }
    }

    /// Returns the arrival time of the first byte that does not belong to a telegram yet.
    fn next_start(&self) -> Nanos {
        let open = self.framer_counters().read - self.framer.buffered() as u64;
        self.arrivals.stamp(open, self.baud().rate()).at
    }

    /// Returns the time between two scans of the same length as `telegram`. `reply` is the decoded telegram. Returns
    /// `None` if `telegram` is not a complete scan of a live stream, or if no variant has this number of beams.
    fn period(&self, telegram: Telegram<'_>, reply: Option<&Reply<'_>>) -> Option<Nanos> {
        let Some(Reply::Measured(measured)) = reply.filter(|_| self.is_live()) else { return None };
        let variant = Variant::of_beams(measured.count()).filter(|_| measured.partial().is_none())?;
        Some(variant.period(telegram.bytes().len(), self.baud().rate()))
    }

    /// Returns the time at which a scan in a backlog began. The scan has `len` bytes and starts at `offset`. The time
    /// follows from the scan's position in the backlog, and is limited by the time of the read. Returns `None` if the
    /// scan was not in a backlog.
    fn due_time(&self, first: &Timestamp, offset: u64, len: u64) -> Option<Nanos> {
        let latest = first.latest?;
        let slots = (offset - self.last_scan + len / 2) / len;
        self.schedule.due_after(slots).map(|due| due.clamp(first.at, latest))
    }

    /// Returns whether a scanner streams. A recording is not live.
    fn is_live(&self) -> bool {
        self.protocol.state() == State::Streaming && !self.settings.listen_only
    }

    /// Returns whether the line has the target rate. Only then are periods and durations valid for the target rate.
    fn is_at_rate(&self) -> bool {
        let rate = &self.protocol.rate;
        !rate.needs_change && rate.baud == rate.target
    }

    /// Returns whether bytes arrive at the rate of the line. Bytes of a recording or a network do not.
    fn has_line_rate(&self) -> bool {
        !(self.settings.listen_only || self.settings.fixed_rate)
    }
}

impl line::Protocol for LmsSession {
    fn reject_rate(&mut self, now: Nanos) {
        self.now = now;
        self.protocol.reject_rate();
    }

    fn read_buffer(&mut self) -> &mut [u8] {
        let spare = self.framer.read_buffer();
        self.buffer_len = spare.len();
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.has_more = len > 0 && len == self.buffer_len;
        self.deferred_until = None;
        self.arrivals.note_read(now, len, self.has_line_rate().then_some(self.baud().rate()));
        if len == 0 {
            return;
        }
        let was_empty = self.framer.buffered() == 0;
        self.framer.commit(len);
        self.timing.count_read();
        self.last_byte = now;
        self.protocol.on_bytes();
        if was_empty {
            let start = self.next_start();
            self.timing.begin_telegram(start);
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.release(now.saturating_sub(self.last_byte));
        if self.is_live() {
            // Count bytes outside telegrams even if the stream has ended.
            self.damage.note_bytes(self.framer.counters(), now);
        }
        self.protocol.handle_timeout(now);
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.now = now;
        self.protocol.on_transmitted(now);
    }

    fn poll_action(&mut self) -> Action<'_> {
        while let Some(found) = self.framer.advance() {
            match found {
                FoundItem::Telegram(span) => return Action::Event(Event::Telegram(self.receive(span))),
                FoundItem::Ack => self.protocol.on_acknowledge(self.now),
                FoundItem::Nak => self.protocol.on_nak(self.now),
            }
        }
        if let Some(baud) = self.protocol.take_rate_change() {
            self.framer.clear();
            self.timing.reset();
            return Action::SetRate(baud.rate());
        }
        self.framer.expect(self.protocol.expected_headers());
        self.framer.expect_acknowledge(self.protocol.open_request().is_some());
        let next_at = self.protocol.open_request().and_then(PendingRequest::next_at);
        if let Some(not_before) = next_at.filter(|&at| at <= self.now + SEND_AHEAD) {
            // The scanner skips scans while it replies.
            self.schedule.end_stream();
            let bytes = self.protocol.open_request().map_or(&[][..], PendingRequest::next_byte);
            return Action::Transmit { bytes, not_before };
        }
        if let Some(until) = self.deferred_until {
            return Action::SleepUntil(until);
        }
        if self.framer.buffered() == 0 {
            self.timing.reset();
        } else if self.is_live()
            && self.protocol.open_request().is_none()
            && !self.has_more
            && let Some(until) = self.timing.sleep_until(self.now)
        {
            return Action::SleepUntil(until);
        }
        // A held telegram is delivered after the line has been idle for a while.
        let held_until = self.framer.hold_time().map_or(Nanos::MAX, |hold| self.last_byte + hold);
        Action::Wait { until: self.protocol.deadline().min(held_until) }
    }
}

impl line::ScannerSession for LmsSession {
    type Problem = Problem;

    fn can_defer_read(&self) -> bool {
        let is_between_telegrams =
            self.framer.buffered() == 0 && !self.has_more && self.deferred_until.is_none();
        // A reply takes less time than a scan, so the measured duration of a telegram does not apply to a reply.
        let has_no_request = self.protocol.open_request().is_none();
        is_between_telegrams
            && has_no_request
            && self.timing.duration.is_some()
            && self.has_line_rate()
            && self.is_live()
    }

    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        self.now = now;
        // If the host has more unread bytes than the scanner sends in a revolution, the host was stopped. The session
        // must then read these bytes at once, because the read determines their age.
        if (1..=BYTES_PER_REVOLUTION).contains(&waiting) && self.can_defer_read() {
            self.arrivals.note_unread(now, waiting);
            let start = self.next_start();
            self.timing.begin_telegram(start);
            self.deferred_until = self.timing.sleep_until(now);
        }
        self.deferred_until.is_some()
    }

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        self.deferred_until = None;
        self.protocol.control(control, now);
    }

    fn state(&self) -> State {
        self.protocol.state()
    }

    fn problem(&self) -> Option<Problem> {
        self.problem()
    }

    fn missing_transmission(&self) -> Option<&'static str> {
        matches!(self.problem(), Some(Problem::NoReply { .. })).then_some("LMS replies")
    }

    fn rate(&self) -> u32 {
        self.baud().rate()
    }

    /// The number of scans that are due follows from their period, counted from the first scan of each stream. A stream
    /// ends when no scan arrives for a second, and when a request is sent. No scans are due in a stream without a known
    /// period, in a stream of partial scans, or in a recording. A loss is counted a second later. A scan that the
    /// scanner aborts for a reply is not damage. The session resynchronizes when no measured data arrive for a second,
    /// when the scanner reports power-on, and when a user requests it.
    fn stats(&self) -> SessionStats {
        let tally = self.framer.counters();
        SessionStats {
            read: tally.read,
            in_telegrams: tally.in_telegrams,
            acknowledge: tally.acknowledge,
            discarded: tally.discarded,
            buffered: self.framer.buffered() as u64,
            telegrams: tally.telegrams,
            due: self.schedule.due,
            lost: self.schedule.lost,
            damaged: self.damage.damaged(tally),
            rejected_checksum: tally.rejected[Reject::Crc as usize],
            resyncs: self.protocol.resyncs,
            restarts: self.protocol.restarts(),
            first_frame_truncated: self.first_frame_truncated,
        }
    }

    fn restore_identity(&mut self, identity: line::Identity) {
        self.protocol.restore_identity(identity);
    }

    fn identity(&self) -> Option<line::Identity> {
        self.protocol.identity()
    }

    /// Makes the search try the rate in `known` instead of 9,600 baud if no stream arrives.
    fn hint_rate(&mut self, known: KnownRate) {
        if let Some(baud) = Baud::of_rate(known.baud) {
            self.protocol.restore_rate(baud);
            self.restore_silent_switches(known.silent_switches);
        }
    }

    fn set_start_rate(&mut self, rate: u32, now: Nanos) {
        if let Some(baud) = Baud::of_rate(rate) {
            self.protocol.set_start_rate(baud, now);
        }
    }

    /// Returns the rate at which a search found the scanner. If the line cannot carry 500,000 baud, returns the rate
    /// that the session uses instead.
    fn known_rate(&self) -> Option<KnownRate> {
        self.protocol.rate.known()
    }

    fn set_partial_reads(&mut self, count: u8) {
        self.timing.set_partial_reads(count);
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        if !self.is_live() || !self.is_at_rate() {
            return None;
        }
        let partial = self.framer.partial_telegram()?;
        let values = PartialValues::of(partial.bytes)?;
        let scan = values.scan(self.sensor().mode_of_scans()?);
        let (baud, bytes) = (self.baud().rate(), partial.bytes.len());
        let first = self.arrivals.stamp(partial.offset, baud);
        let last = self.arrivals.stamp(partial.offset + bytes as u64 - 1, baud);
        Some(RawScan {
            number: partial.offset,
            first: first.at.max(self.last_stamp),
            last: last.at.max(first.at).max(self.last_stamp),
            period: nominal_period(scan.beams(), self.protocol.rate.target.rate()),
            reasons: partial.reasons,
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
    ) -> Option<ReceivedTelegram<'a>> {
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
        Some(to_received(telegram, reply.as_ref(), mode, self.protocol.rate.target, 0))
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
        self.stats().add_to(counters);
        let tally = self.framer.counters();
        counters[Counter::Aborted] += tally.aborted;
        for (reject, counter) in REJECTS {
            counters[counter] += tally.rejected[reject as usize];
        }
    }
}

/// Converts `telegram`, with stamps of 0. `reply` is the decoded telegram. `mode` determines the range bits of a value.
fn to_received<'a>(
    telegram: Telegram<'a>,
    reply: Option<&Reply<'a>>,
    mode: Option<Mode>,
    baud: Baud,
    number: u64,
) -> ReceivedTelegram<'a> {
    let measured = match reply {
        Some(Reply::Measured(measured)) => Some(*measured),
        _ => None,
    };
    let beams = measured.map_or(0, |measured| measured.count());
    let period = nominal_period(beams, baud.rate());
    // Without a valid mode, the result contains no scan, because a wrong range is worse than no range.
    let split = measured.zip(mode.filter(|mode| mode.has_ranges()));
    let is_forbidden = split.is_some_and(|(measured, mode)| measured.is_forbidden(mode));
    let scan = split.map(|(measured, mode)| RawScan { number, period, ..measured.scan(mode) });
    ReceivedTelegram {
        bytes: telegram.bytes(),
        first: 0,
        last: 0,
        estimated: false,
        reasons: if is_forbidden { suspect::FORBIDDEN_BITS } else { 0 },
        count: 1,
        is_checked: true,
        is_reply: telegram.command() != MEASURED,
        contents: Some(TelegramContents { number, beams, period, scan }),
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

/// Counters of rejected telegrams, by reason. The reason "wrong checksum" is missing here, because every family has a
/// counter for it.
const REJECTS: [(Reject, Counter); Reject::COUNT - 1] = [
    (Reject::Address, Counter::RejectedAddress),
    (Reject::Length, Counter::RejectedLength),
    (Reject::Command, Counter::RejectedCommand),
    (Reject::Count, Counter::RejectedCount),
    (Reject::Vetoed, Counter::RejectedVetoed),
    (Reject::Superseded, Counter::RejectedSuperseded),
];
