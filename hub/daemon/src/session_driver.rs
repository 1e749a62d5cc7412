//! Driver that runs a session with a scanner on an open port until the port is lost.
//!
//! The path of a scan, from the line to its subscribers, starts here:
//!
//! 1. **Read**: [`SessionDriver::on_wakeup`] reads into the session's buffer when the port is ready.
//! 2. **Frame**: [`SessionDriver::drain`] asks the session for its next action. A telegram stays in the session's
//!    buffer; a revolution is a list of points.
//! 3. **Decode, process, send, ring**: [`LinkOutput`](crate::link_output::LinkOutput) publishes the telegram and the
//!    scan, wakes the subscribers of these two topics and of the zones, and then publishes the other results.
//!
//! Nothing on this path allocates, locks or logs. Opening and reopening the port is up to `reconnect.rs`.

use std::fmt;
use std::io;

use scanhub_drivers::line::{self, Action, Event, Identity, Protocol as _, ScannerSession as _, suspect};
use scanhub_drivers::search::{Memory, Search};
use scanhub_drivers::{Model, PortSession};
use scanhub_port::{LineErrors, PortSpec, ReadBudget};
use scanhub_schema::{MILLIS, Nanos, State, Status, line_time};

use crate::control::PauseTarget;
use crate::link::LinkState;
use crate::link_output::RecordedMetadata;
use crate::platform::{Platform, PortIo, SavedState, WaitSource, WakeReason};
use crate::saved_state::{KnownRate, KnownScanner};

/// State that outlives a session and is used by the next one on the same port.
pub(crate) struct SessionDriver<'a, S: Platform> {
    /// Identity of the scanner, saved for the next hub.
    identity: IdentityCache<'a, S>,
    /// Baud rates that the port has rejected. Each one is logged once.
    rejected_rates: Vec<u32>,
    line_errors: LineErrors,
    /// Time of the last read that may have returned backlogged bytes.
    backlog_read_at: Option<Nanos>,
    /// Latest stamp at which the next scan still counts as consecutive.
    consecutive_until: Nanos,
    /// Rate at which the last search found the scanner.
    found_rate: Option<KnownRate>,
    /// Scanner that the search found last, in this run of the hub or an earlier one.
    scanner: Option<KnownScanner>,
    /// Whether `scanner` was logged.
    is_scanner_logged: bool,
    /// Model and number of beams that an earlier run of the hub has saved, until the port is opened.
    saved_beams: Option<(Model, usize)>,
    /// Number of reads per telegram, updated once per scan: more than 1 while early warnings have a subscriber.
    reads_per_telegram: u8,
}

/// An open line with its session, and what to wait for next.
pub(crate) struct OpenLine<L> {
    pub(crate) line: L,
    pub(crate) session: PortSession,
    /// Read budget of a network port; `None` for a tty, which is never throttled.
    allowance: Option<ReadBudget>,
    /// Bytes that were already buffered when the port was opened, until they have been read.
    backlog: Option<Backlog>,
    settings_check: SettingsCheck,
    /// Whether the arrival of bytes ends the wait.
    waits_for_bytes: bool,
    /// Deadline of the session.
    deadline: Nanos,
    /// Time before which the read budget forbids reading.
    throttled_until: Option<Nanos>,
}

impl<L: PortIo> OpenLine<L> {
    /// Creates the state for `line`, which was opened at `now`. A network port may read at most twice what a line of
    /// `baud` can carry.
    pub(crate) fn new(line: L, session: PortSession, baud: u32, now: Nanos) -> OpenLine<L> {
        OpenLine {
            allowance: line.read_budget(baud),
            backlog: Backlog::new(line.buffered_len().unwrap_or(0), now),
            settings_check: SettingsCheck::default(),
            line,
            session,
            waits_for_bytes: true,
            deadline: 0,
            throttled_until: None,
        }
    }

    /// Returns what to wait for, and until when. The loss of the port ends the wait even while bytes are left unread.
    pub(crate) fn wait(&self) -> (WaitSource<'_, L>, Nanos) {
        let for_bytes = self.waits_for_bytes && self.throttled_until.is_none();
        let on = if for_bytes { WaitSource::Bytes(&self.line) } else { WaitSource::Loss(&self.line) };
        (on, self.throttled_until.unwrap_or(self.deadline))
    }
}

impl<'a, S: Platform> SessionDriver<'a, S> {
    /// Creates the state for the port of `core`.
    pub(crate) fn new(core: &LinkState<'a, S>) -> SessionDriver<'a, S> {
        let scanner =
            core.platform.saved_state().and_then(|saved_state| saved_state.scanner(&core.link.port.name()));
        SessionDriver {
            identity: IdentityCache::new(core.platform, &core.link.name, core.link.port.name()),
            rejected_rates: Vec::new(),
            line_errors: LineErrors::default(),
            backlog_read_at: None,
            consecutive_until: Nanos::MAX,
            found_rate: None,
            saved_beams: scanner.as_ref().and_then(KnownScanner::beams_of_model),
            scanner,
            is_scanner_logged: false,
            reads_per_telegram: 1,
        }
    }

    /// Returns the scanner's identity that the previous hub saved for this port, unless it is too old.
    pub(crate) fn saved_identity(&self, now: Nanos) -> Option<Identity> {
        self.identity.load(now)
    }

    /// Starts a session on a line that was just opened.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub(crate) fn begin(
        &mut self,
        core: &mut LinkState<'a, S>,
        open: &mut OpenLine<S::Port>,
    ) -> io::Result<()> {
        self.backlog_read_at = None;
        self.drain(core, open)
    }

    /// Returns the rate to try first when searching for the scanner: the rate at which this hub, or a previous hub,
    /// last found the scanner.
    pub(crate) fn known_rate(&self, core: &LinkState<'a, S>) -> Option<KnownRate> {
        let saved_rate = || saved_rates(core)?.rate(&core.link.port.name());
        self.found_rate.or_else(saved_rate).filter(|_| is_tty(core))
    }

    /// Returns the scanner with which a search begins.
    pub(crate) fn memory(&self, core: &LinkState<'a, S>) -> Option<Memory> {
        self.scanner.as_ref().filter(|_| core.link.family().is_none()).map(|scanner| scanner.memory)
    }

    /// Returns the model and the number of beams that an earlier run of the hub has saved, for the first session on the
    /// port. Later sessions follow a loss of the port, and a different scanner may be connected.
    pub(crate) fn take_saved_beams(&mut self) -> Option<(Model, usize)> {
        self.saved_beams.take()
    }

    /// Returns the rate at which to open the port of `core`.
    pub(crate) fn opening_rate(&self, core: &LinkState<'a, S>) -> u32 {
        match core.link.family() {
            Some(_) => core.link.rate(),
            None => Search::opening_rate(self.memory(core)),
        }
    }

    /// Handles the end of a wait, for the reason `wake_reason`.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub(crate) fn on_wakeup(
        &mut self,
        core: &mut LinkState<'a, S>,
        open: &mut OpenLine<S::Port>,
        wake_reason: WakeReason,
    ) -> io::Result<()> {
        if wake_reason == WakeReason::Request {
            core.handle_requests(PauseTarget::Session(&mut open.session));
        } else {
            self.read(core, open)?;
        }
        self.drain(core, open)
    }

    /// Sends the session's last requests before the hub exits, such as the request that stops an RPLIDAR's motor.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub(crate) fn end(&self, core: &LinkState<'a, S>, open: &mut OpenLine<S::Port>) -> io::Result<()> {
        let OpenLine { line, session, .. } = open;
        if !session.end(core.platform.now()) {
            return Ok(());
        }
        loop {
            match session.poll_action() {
                Action::SetDtr(on) => line.set_dtr(on)?,
                Action::Transmit { bytes, not_before } => {
                    core.platform.pause(not_before);
                    line.write(bytes)?;
                    session.handle_transmitted(core.platform.now());
                }
                // The hub is shutting down, so nothing is published any more.
                Action::SetRate(_) | Action::Event(_) => {}
                Action::SleepUntil(_) | Action::Wait { .. } => return Ok(()),
            }
        }
    }

    fn read(&mut self, core: &mut LinkState<'a, S>, open: &mut OpenLine<S::Port>) -> io::Result<()> {
        let OpenLine { line, session, allowance, backlog, settings_check, waits_for_bytes, deadline, .. } =
            open;
        let platform = core.platform;
        if !*waits_for_bytes && session.features().is_some_and(|features| features.has_whole_telegrams) {
            // The telegram ends soon. Prepare now what its publication needs, so that less work is left at its end.
            // Packets end too often for this.
            core.output.prepare();
        }
        if *waits_for_bytes
            && session.can_defer_read()
            && let Some(waiting) = line.buffered_len()
            && session.defer_read(platform.now(), waiting)
        {
            return Ok(());
        }
        let mut buffer = session.read_buffer();
        if let Some(allowance) = &allowance {
            let max_len = buffer.len().min(allowance.bytes(platform.now()).max(1));
            buffer = &mut buffer[..max_len];
        }
        let room = buffer.len();
        let len = line.read(buffer)?;
        let now = platform.now();
        session.commit(now, len);
        if len > 0 {
            settings_check.note_bytes(now);
        }
        if let Some(pending) = backlog {
            if pending.note_read(len, session.rate(), now) {
                self.backlog_read_at = Some(now);
            } else {
                *backlog = None;
            }
        }
        if let Some(allowance) = allowance {
            allowance.record_read(len, room, now);
            self.backlog_read_at = allowance.is_backlogged(now).then_some(now);
            core.diagnosis.note_flood(allowance.is_flooded(now));
        }
        if len == 0 && now >= *deadline {
            session.handle_timeout(now);
        }
        Ok(())
    }

    /// Carries out the session's actions until it asks to wait.
    fn drain(&mut self, core: &mut LinkState<'a, S>, open: &mut OpenLine<S::Port>) -> io::Result<()> {
        let OpenLine { line, session, .. } = open;
        let platform = core.platform;
        let recorded = RecordedMetadata::default();
        let (mut published, mut has_reply, mut is_new_scan) = (false, false, !core.stats.is_streaming());
        (open.waits_for_bytes, open.deadline) = loop {
            match session.poll_action() {
                Action::SetRate(baud) => {
                    self.change_rate(core, line, session, baud)?;
                    // Changing the rate discards buffered input.
                    open.backlog = None;
                    open.settings_check.reset();
                }
                Action::SetDtr(on) => line.set_dtr(on)?,
                Action::Transmit { bytes, not_before } => {
                    platform.pause(not_before);
                    line.write(bytes)?;
                    session.handle_transmitted(platform.now());
                }
                Action::Event(Event::Telegram(mut received)) => {
                    let new_errors = line.line_errors();
                    core.stats.line_errors += new_errors;
                    let may_be_damaged = self.line_errors.note_telegram(new_errors);
                    let is_backlogged = self.is_backlogged(received.last);
                    received.estimated |= is_backlogged;
                    received.reasons |= if may_be_damaged { suspect::LINE_ERROR } else { 0 };
                    if received.contents.is_some() {
                        self.note_silence(core, received.last, is_backlogged);
                        is_new_scan = true;
                    }
                    has_reply |= received.is_reply;
                    if let Some(lifetime) = core.publish(&received, &recorded, is_backlogged) {
                        // On a tty, the time from a backlogged scan to the next one is unknown, so the next scan never
                        // counts as consecutive. On a network port, the stamp of the next scan decides.
                        let is_tty_backlog = is_backlogged && open.allowance.is_none();
                        self.consecutive_until =
                            if is_tty_backlog { 0 } else { received.last.saturating_add(lifetime) };
                    }
                    published = true;
                }
                Action::Event(Event::Scan(scan)) => {
                    let is_backlogged = self.is_backlogged(scan.last);
                    self.note_silence(core, scan.last, is_backlogged);
                    let lifetime = core.publish_scan(&scan, &recorded, is_backlogged);
                    self.consecutive_until =
                        if is_backlogged { 0 } else { scan.last.saturating_add(lifetime) };
                    (published, is_new_scan) = (true, true);
                }
                Action::SleepUntil(until) => break (false, until),
                Action::Wait { until, .. } => {
                    if !session.advance() {
                        break (true, until);
                    }
                    core.output.topics.set_family(session.family());
                }
            }
        };
        let now = platform.now();
        if published {
            self.line_errors.note_read();
            open.settings_check.reset();
            core.diagnosis.note_telegram(now);
        }
        let is_altered =
            open.settings_check.is_due(session.state(), now) && restore(core, line, session.rate())?;
        if is_altered {
            open.backlog = None;
        }
        // The number of reads changes only between two scans.
        if is_new_scan {
            self.reads_per_telegram = core.output.reads_per_telegram();
        }
        session.set_partial_reads(self.reads_per_telegram);
        if self.reads_per_telegram > 1 || core.output.has_warned() {
            match session.partial_scan() {
                // A backlogged scan is too old to warn of anything.
                Some(partial) if self.is_backlogged(partial.first) => {
                    core.output.withdraw(Some(partial.number));
                }
                partial => core.output.update_early_warning(partial.as_ref()),
            }
        }
        let is_streaming = session.state() == line::State::Streaming && core.stats.is_streaming();
        // While scans arrive, only a reply or another process changes what the status reports. The few changes of the
        // status that a scan can cause are detected as soon as the history is due.
        if has_reply || is_altered || !is_streaming || core.is_due(now) || core.diagnosis.is_outdated() {
            self.report(core, open, now);
        }
        open.throttled_until = open
            .allowance
            .as_mut()
            .and_then(|allowance| allowance.throttled_until(platform.now(), open.deadline));
        Ok(())
    }

    /// Examines the session, and publishes and saves what has changed or is due.
    #[inline(never)]
    fn report(&mut self, core: &mut LinkState<'a, S>, open: &mut OpenLine<S::Port>, now: Nanos) {
        let platform = core.platform;
        let session = &mut open.session;
        self.identity.save_once_known(session);
        let (state, has_changed) = core.diagnosis.update(session, now);
        if has_changed && let Some(rate) = session.known_rate() {
            self.found_rate = Some(rate);
            saved_rates(core).iter().for_each(|rates| rates.save_rate(&core.link.port.name(), rate));
        }
        if (has_changed || core.is_due(now)) && core.publish_session_status(session, state) {
            self.identity.save(session, platform.now());
            self.note_scanner(core, session, now);
            if core.stops_when_idle() {
                session.set_has_subscribers(platform.now(), core.output.topics.has_data_subscribers());
                // Poll again at once, so that the session can stop or start the motor.
                open.deadline = platform.now();
            }
        }
        // While telegrams arrive, each one checks whether a status is due, so no extra wake-up is needed.
        let status_due = if state == State::Streaming { Nanos::MAX } else { core.next_status() };
        open.deadline = open.deadline.min(status_due);
    }

    /// Returns whether bytes that arrived at `at` may have been buffered for an unknown time.
    fn is_backlogged(&self, at: Nanos) -> bool {
        self.backlog_read_at.is_some_and(|read_at| at <= read_at)
    }

    /// Handles a scan or reply whose last byte arrived at `last`. If the hub itself was stopped, it could not report
    /// the silence before this scan or reply, so this function detects the silence by the stamps.
    fn note_silence(&self, core: &mut LinkState<'a, S>, last: Nanos, is_backlogged: bool) {
        if !is_backlogged && last > self.consecutive_until {
            core.output.note_silence();
        }
    }

    /// Sets the rate to `baud`. A search continues without a rate that the port rejects.
    #[cold]
    fn change_rate(
        &mut self,
        core: &mut LinkState<'a, S>,
        line: &S::Port,
        session: &mut PortSession,
        baud: u32,
    ) -> io::Result<()> {
        // Check first whether another process has changed the settings, because setting the rate would hide the change.
        restore(core, line, baud)?;
        if let Some(error) = line.set_baud(baud)? {
            self.log_rejected_rate(core, baud, &error);
            session.reject_rate(core.platform.now());
        }
        Ok(())
    }

    /// Logs why the port rejects `baud`, once for each rate.
    pub(crate) fn log_rejected_rate(&mut self, core: &LinkState<'a, S>, baud: u32, error: &dyn fmt::Display) {
        if !self.rejected_rates.contains(&baud) {
            self.rejected_rates.push(baud);
            tracing::warn!("{}: {error}", core.link.name);
        }
    }

    /// Saves the scanner that a search has found and that streams, and logs it once its model is known.
    #[cold]
    fn note_scanner(&mut self, core: &LinkState<'a, S>, session: &PortSession, now: Nanos) {
        let Some(memory) = session.memory() else { return };
        let (link, status) = (core.link, core.stats.last());
        let before = self.scanner.as_ref();
        let beams = session.beams().filter(|_| link.scanner.settings.beams.is_none());
        let is_same = |known: &KnownScanner| {
            let model = known.model.as_deref();
            let is_model = |reported: &str| model.is_some_and(|model| model.eq_ignore_ascii_case(reported));
            (known.memory, known.beams) == (memory, beams) && status.reported_model().is_none_or(is_model)
        };
        if self.is_scanner_logged && before.is_some_and(is_same) {
            return;
        }
        let is_same_family = before.is_some_and(|before| before.memory.family == memory.family);
        let known_model = before.filter(|_| is_same_family).and_then(|before| before.model.clone());
        let reported = status.model();
        let is_reported = reported.is_some() || now >= status.since_ns + MODEL_TIMEOUT;
        let scanner = KnownScanner { memory, model: reported.or_else(|| known_model.clone()), beams };
        let is_exchanged =
            before.is_some() && (!is_same_family || known_model.is_some() && known_model != scanner.model);
        if is_reported && (is_exchanged || !self.is_scanner_logged) {
            self.is_scanner_logged = true;
            let name = scanner_name(&scanner);
            match before.filter(|_| is_exchanged) {
                Some(before) => tracing::info!("{}: was {}, is now {name}", link.name, scanner_name(before)),
                None if is_tty(core) => {
                    tracing::info!("{}: found {name} at {} baud", link.name, session.rate());
                }
                None => tracing::info!("{}: found {name}", link.name),
            }
            let has_own_beams = session.features().is_some_and(|features| features.models.is_empty());
            if has_own_beams && link.scanner.settings.beams.is_some() {
                tracing::info!(
                    "{}: {name} has its own number of beams: link.{}.beams is not used",
                    link.name,
                    link.name
                );
            }
        } else if !is_reported && is_exchanged {
            // The exchange is logged later, when the model of this scanner is known and the message can name both
            // scanners.
            return;
        }
        if self.scanner.as_ref() != Some(&scanner) {
            if let Some(saved_state) = core.platform.saved_state() {
                saved_state.save_scanner(&link.port.name(), scanner.clone());
            }
            self.scanner = Some(scanner);
        }
    }
}

/// Returns the name of the model, or of the family if the model is unknown. A model that scanhub does not know has only
/// a number.
fn scanner_name(scanner: &KnownScanner) -> String {
    let family = scanner.memory.family.name();
    match &scanner.model {
        Some(number) if Status::is_model_number(number) => format!("{family} model {number} (unknown)"),
        Some(model) => model.clone(),
        None => family.to_owned(),
    }
}

/// Restores the hub's settings of `line`, at `baud`, if another process has changed them. Returns whether the settings
/// were changed.
#[cold]
fn restore<S: Platform>(core: &mut LinkState<'_, S>, line: &S::Port, baud: u32) -> io::Result<bool> {
    let Some(alteration) = line.alteration()? else { return Ok(false) };
    line.restore(baud)?;
    let program = || core.platform.altering_program(&core.link.port);
    core.diagnosis.note_settings_change(alteration, program, core.platform.now());
    Ok(true)
}

/// Returns the store of baud rates, if the link has one.
fn saved_rates<'a, S: Platform>(core: &LinkState<'a, S>) -> Option<&'a dyn SavedState> {
    core.platform.saved_state().filter(|_| is_tty(core))
}

/// Returns whether the port is a tty, whose rate can be changed.
fn is_tty<S: Platform>(core: &LinkState<'_, S>) -> bool {
    matches!(core.link.port, PortSpec::Tty(_))
}

/// Bytes that were already buffered in a tty when the hub opened it, for example because the previous hub was killed.
/// Their age is unknown.
///
/// A driver reports only part of its backlog, so the end is detected by speed: buffered bytes arrive faster than the
/// line can carry them.
#[derive(Clone, Debug)]
struct Backlog {
    /// Time of the last read.
    read_at: Nanos,
    /// Time since when the bytes have arrived no faster than the line can carry them.
    idle_since: Option<Nanos>,
    /// Maximum number of buffered bytes that are left.
    remaining: usize,
}

impl Backlog {
    /// Creates the backlog of a port that is opened at `now`, whose driver reports `waiting` buffered bytes. `None` if
    /// no byte is buffered.
    fn new(waiting: usize, now: Nanos) -> Option<Backlog> {
        (waiting > 0).then_some(Backlog { read_at: now, idle_since: None, remaining: MAX_BACKLOG })
    }

    /// Notes that `len` bytes were read at `now` from a line of `baud`. Returns whether they may have been buffered, or
    /// more buffered bytes may follow.
    fn note_read(&mut self, len: usize, baud: u32, now: Nanos) -> bool {
        let elapsed = now.saturating_sub(std::mem::replace(&mut self.read_at, now));
        self.remaining = self.remaining.saturating_sub(len);
        if line_time(len, baud) > elapsed + MAX_BURST_TIME {
            self.idle_since = None;
        }
        let calm_since = *self.idle_since.get_or_insert(now);
        self.remaining > 0 && now < calm_since + IDLE_TIME
    }
}

/// Schedule for reading back the settings of an open port. If bytes arrive but no telegram, another process may have
/// changed the settings. The hub's lock on the port does not keep out a program of root, or a program that had opened
/// the port before the hub.
#[derive(Clone, Copy, Debug, Default)]
struct SettingsCheck {
    /// Time at which the first bytes arrived after the last telegram, the last change of the rate, or the last check;
    /// the latest of these counts.
    bytes_since: Option<Nanos>,
    was_silent: bool,
}

impl SettingsCheck {
    /// Notes bytes that were read at `now`.
    fn note_bytes(&mut self, now: Nanos) {
        self.bytes_since.get_or_insert(now);
    }

    /// Notes a telegram, or that the session has set the rate: the port has the hub's settings.
    fn reset(&mut self) {
        self.bytes_since = None;
    }

    /// Returns whether to read the settings back at `now`: after 300 ms of bytes without a telegram, or when the stream
    /// has just stopped according to the `state` of the session.
    fn is_due(&mut self, state: line::State, now: Nanos) -> bool {
        let is_silent = state == line::State::Silent;
        let has_stopped = is_silent && !self.was_silent;
        self.was_silent = is_silent;
        let is_due = has_stopped || self.bytes_since.is_some_and(|since| now >= since + TELEGRAM_TIMEOUT);
        if is_due {
            self.bytes_since = None;
        }
        is_due
    }
}

/// Store of the identity of a link's scanner, so that the next hub can publish scans at once if this hub is killed.
/// Without it, the next hub first has to send the scanner two requests, and each reply costs a scan.
///
/// The record is written as soon as the identity is known, and then once a second while the scanner streams.
struct IdentityCache<'a, S> {
    platform: &'a S,
    link: &'a str,
    /// Port that the identity belongs to.
    port: String,
    /// Stamp, identity and port.
    record: Vec<u8>,
    /// Identity in the record.
    identity: Option<Identity>,
}

impl<'a, S: Platform> IdentityCache<'a, S> {
    /// Creates an empty cache for `link` at `port`.
    fn new(platform: &'a S, link: &'a str, port: String) -> Self {
        IdentityCache { platform, link, port, record: Vec::new(), identity: None }
    }

    /// Returns the identity that the previous hub saved, if it is recent and belongs to this port.
    fn load(&self, now: Nanos) -> Option<Identity> {
        // Read one byte more than expected, to detect a longer record, which belongs to another port.
        let mut record = vec![0; STAMP_LEN + size_of::<Identity>() + self.port.len() + 1];
        let len = self.platform.load_record(self.link, &mut record)?;
        read_identity(record.get(..len)?, &self.port, now)
    }

    /// Saves the identity of `session` as of `now`, if it is known.
    fn save(&mut self, session: &PortSession, now: Nanos) {
        let Some(identity) = session.identity() else { return };
        if self.identity != Some(identity) {
            self.identity = Some(identity);
            self.record = identity_record(identity, &self.port);
        }
        self.record[..STAMP_LEN].copy_from_slice(&now.to_le_bytes());
        self.platform.store_record(self.link, &self.record);
    }

    /// Saves the identity as soon as it is known. [`save`](Self::save) then keeps the record recent.
    fn save_once_known(&mut self, session: &PortSession) {
        if self.identity.is_none() {
            self.save(session, self.platform.now());
        }
    }
}

/// Returns the record of a scanner with `identity` at `port`, without a stamp.
fn identity_record(identity: Identity, port: &str) -> Vec<u8> {
    [&[0; STAMP_LEN], &identity[..], port.as_bytes()].concat()
}

/// Returns the identity in `record`, if it belongs to `port` and is recent.
fn read_identity(record: &[u8], port: &str, now: Nanos) -> Option<Identity> {
    let (stamp, rest) = record.split_first_chunk()?;
    let (identity, of) = rest.split_first_chunk()?;
    let age = now.checked_sub(Nanos::from_le_bytes(*stamp))?;
    (age < MAX_IDENTITY_AGE && of == port.as_bytes()).then_some(*identity)
}

/// Time for which the log waits for the model of a scanner that streams.
const MODEL_TIMEOUT: Nanos = 10_000 * MILLIS;
/// Maximum length of a backlog in bytes: more than a native port (64 kB) and its line discipline (4 kB) hold.
const MAX_BACKLOG: usize = 70_000;
/// Maximum time for which an adapter may collect bytes before it delivers them at once. A longer burst proves that
/// bytes were buffered.
const MAX_BURST_TIME: Nanos = 20 * MILLIS;
/// Maximum time that a driver takes to move buffered bytes from one of its buffers to the next.
const IDLE_TIME: Nanos = 10 * MILLIS;
/// Time with bytes but without a telegram after which the settings of the port are read back. It is longer than any
/// scanner takes for a telegram, except for an LMS at 9600 and 19200 baud, at which the check is superfluous.
const TELEGRAM_TIMEOUT: Nanos = 300 * MILLIS;
/// Length of the stamp in a record, in bytes.
const STAMP_LEN: usize = size_of::<Nanos>();
/// Maximum age of a saved identity. After this time, a different scanner may be connected. The record is written every
/// second and read as soon as the next hub starts.
const MAX_IDENTITY_AGE: Nanos = 3_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const BAUD: u32 = 500_000;

    /// Returns the number of bytes that count as backlogged if `waiting` bytes are buffered when the port is opened.
    /// The stream has one telegram every 26 ms and is read in pieces.
    fn backlogged(waiting: usize) -> usize {
        let (mut now, mut left, mut backlogged) = (1_000, waiting, 0);
        let Some(mut backlog) = Backlog::new(waiting.min(4_095), now) else { return 0 };
        for read in 0..1_000 {
            let len = if left > 0 { left.min(1_628) } else { 732 };
            now += if left > 0 { 50_000 } else { 26 * MILLIS };
            left -= left.min(len);
            // A driver that has just moved its buffers returns few bytes for a moment.
            let (len, left_behind) = if read == 2 && left > 0 { (40, len - 40) } else { (len, 0) };
            left += left_behind;
            if !backlog.note_read(len, BAUD, now) {
                return backlogged;
            }
            backlogged += len;
        }
        panic!("the backlog never ends");
    }

    #[test]
    fn detects_backlog_with_little_excess() {
        assert_eq!(backlogged(0), 0);
        for waiting in [1_700, 4_095, 17_024, 65_000] {
            let counted = backlogged(waiting);
            assert!((waiting..=waiting + 3 * 732).contains(&counted), "{waiting}: {counted}");
        }
    }

    #[test]
    fn backlog_of_a_line_faster_than_its_rate_ends() {
        let mut backlog = Backlog::new(100, 0).expect("bytes wait");
        let reads = (1..1_000).take_while(|read| backlog.note_read(1_500, BAUD, read * MILLIS)).count();
        assert!((40..50).contains(&reads), "{reads}");
    }

    #[test]
    fn settings_are_checked_if_bytes_have_no_telegram() {
        let mut check = SettingsCheck::default();
        let mut checks = |range: std::ops::Range<u64>, telegram_every: u64| {
            let due = range.filter(|ms| {
                let now = ms * MILLIS;
                check.note_bytes(now);
                if ms % telegram_every == 0 {
                    check.reset();
                }
                check.is_due(line::State::Streaming, now)
            });
            due.collect::<Vec<_>>()
        };
        assert!(checks(1..10_000, 27).is_empty(), "a stream is never checked");
        // The last telegram arrived at 9,990 ms.
        assert_eq!(checks(10_000..10_700, u64::MAX), [10_291, 10_592]);
    }

    #[test]
    fn settings_are_checked_once_when_a_stream_stops() {
        use line::State::{Probing, Silent, Streaming};
        let mut check = SettingsCheck::default();
        let states = [Streaming, Silent, Silent, Probing, Silent];
        assert_eq!(states.map(|state| check.is_due(state, 1)), [false, true, false, false, true]);
    }

    #[test]
    fn identity_round_trips_for_the_same_port() {
        let (now, port) = (9_000 * MILLIS, "/dev/ttyUSB0");
        let identity: Identity = [2; size_of::<Identity>()];
        let mut record = identity_record(identity, port);
        record[..STAMP_LEN].copy_from_slice(&now.to_le_bytes());
        assert_eq!(read_identity(&record, port, now + MAX_IDENTITY_AGE - 1), Some(identity));
        assert_eq!(read_identity(&record, port, now + MAX_IDENTITY_AGE), None, "too old");
        assert_eq!(read_identity(&record, port, now - 1), None, "from an earlier start of the machine");
        for other in ["/dev/ttyUSB", "/dev/ttyUSB01", ""] {
            assert_eq!(read_identity(&record, other, now), None, "{other}");
        }
        for len in 0..record.len() {
            assert_eq!(read_identity(&record[..len], port, now), None, "cut after {len} bytes");
        }
    }
}
