//! Runs a session with a scanner on an open port until the port is lost.
//!
//! The path of a scan, from the line to its subscribers, starts here:
//!
//! 1. **Read**: [`Drive::turn`] reads into the session's buffer when the port is ready.
//! 2. **Frame**: [`Drive::drain`] asks the session for its next action. A telegram stays in that buffer; a revolution is a
//!    list of points.
//! 3. **Decode, process, send, ring**: [`LinkOutput`](crate::link_output::LinkOutput) publishes the telegram and the scan,
//!    wakes the subscribers of both and of the zones, and then publishes the other results.
//!
//! Nothing on this path allocates, locks or logs. Opening and reopening the port is up to `reconnect.rs`.

use std::fmt;
use std::io;

use port::{Allowance, LineErrors, Source};
use scanhub_drivers::line::{Event, Identity, Output, Protocol as _, Session as _, suspect};
use scanhub_drivers::search::{Memory, Search};
use scanhub_drivers::{Model, PortSession};
use schema::{MILLIS, Nanos, State, Status};

use crate::backlog::Backlog;
use crate::control::Flow;
use crate::identity_cache::IdentityCache;
use crate::link::LinkCore;
use crate::link_output::RecordedMetadata;
use crate::saved_state::{KnownRate, KnownScanner};
use crate::settings_check::SettingsCheck;
use crate::surroundings::{Learned, Line, On, Surroundings, Woken};

/// What outlives a session on a port, for the next one.
pub(crate) struct Drive<'a, S: Surroundings> {
    /// What the next hub would like to know.
    identity: IdentityCache<'a, S>,
    /// Rates that the port could not have, as the log has reported.
    refused: Vec<u32>,
    line_errors: LineErrors,
    /// When something was read last that had waited in the port for an unknown time.
    behind_at: Option<Nanos>,
    /// When the next scan has to be here to follow the last one without a silence, by the stamps of scans.
    follows_by: Nanos,
    /// Where the sensor was found the last time that it had to be sought.
    found: Option<KnownRate>,
    /// The scanner that the search found last, in this run of the hub or an earlier one.
    scanner: Option<KnownScanner>,
    /// Whether the log names that scanner.
    is_named: bool,
    /// Model and number of beams that an earlier run of the hub has saved, until the port is opened.
    beams: Option<(Model, usize)>,
    /// In how many pieces a telegram is read, as of the last scan: as many as who follows early warnings wants.
    pieces: u8,
}

/// A session on an open line, and what it waits for.
pub(crate) struct Open<L> {
    pub(crate) line: L,
    pub(crate) session: PortSession,
    /// What may be read; nothing where all may.
    allowance: Option<Allowance>,
    /// What waited in the port when it was opened, until all of it was read.
    backlog: Option<Backlog>,
    /// When to read the port's settings back.
    settings_check: SettingsCheck,
    /// Whether bytes are waited for.
    watch: bool,
    /// Until when the session waits.
    until: Nanos,
    /// Until when nothing may be read, whatever the session waits for.
    rest: Option<Nanos>,
}

impl<L: Line> Open<L> {
    /// `session` on `line`, which was opened at `now`; at its nominal `baud` it brings no more than twice that.
    pub(crate) fn new(line: L, session: PortSession, baud: u32, now: Nanos) -> Open<L> {
        let allowance = line.allowance(baud);
        let backlog = Backlog::new(line.waiting().unwrap_or(0), now);
        let settings_check = SettingsCheck::default();
        Open { line, session, allowance, backlog, settings_check, watch: true, until: 0, rest: None }
    }

    /// What to wait for, and until when. Also while bytes are left alone the port may go away.
    pub(crate) fn wait(&self) -> (On<'_, L>, Nanos) {
        let watch = self.watch && self.rest.is_none();
        let on = if watch { On::Bytes(&self.line) } else { On::Loss(&self.line) };
        (on, self.rest.unwrap_or(self.until))
    }
}

impl<'a, S: Surroundings> Drive<'a, S> {
    /// For the port of `core`.
    pub(crate) fn new(core: &LinkCore<'a, S>) -> Drive<'a, S> {
        let scanner = known_scanner(core);
        let beams = scanner.as_ref().and_then(KnownScanner::beams_of_model);
        Drive {
            identity: IdentityCache::new(core.around, &core.link.name, core.link.port.name()),
            refused: Vec::new(),
            line_errors: LineErrors::default(),
            behind_at: None,
            follows_by: Nanos::MAX,
            found: None,
            scanner,
            is_named: false,
            beams,
            pieces: 1,
        }
    }

    /// What the hub before this one knew of the sensor, if that was just now.
    pub(crate) fn recall(&self, now: Nanos) -> Option<Identity> {
        self.identity.recall(now)
    }

    /// Begins on a line that was just opened; an error says that it is gone.
    pub(crate) fn begin(&mut self, core: &mut LinkCore<'a, S>, open: &mut Open<S::Line>) -> io::Result<()> {
        self.behind_at = None;
        self.drain(core, open)
    }

    /// The rate to begin with where the sensor of `core` has to be sought.
    pub(crate) fn last_rate(&self, core: &LinkCore<'a, S>) -> Option<KnownRate> {
        let kept = || rates(core)?.rate(&core.link.port.name());
        self.found.or_else(kept).filter(|_| is_tty(core))
    }

    /// Returns the scanner with which a search begins.
    pub(crate) fn memory(&self, core: &LinkCore<'a, S>) -> Option<Memory> {
        self.scanner.as_ref().filter(|_| core.link.family().is_none()).map(|scanner| scanner.memory)
    }

    /// Returns the model and the number of beams that an earlier run of the hub has saved, for the first session on the
    /// port. Later sessions follow a loss of the port, and a different scanner may be connected.
    pub(crate) fn take_beams(&mut self) -> Option<(Model, usize)> {
        self.beams.take()
    }

    /// Returns the rate at which to open the port of `core`.
    pub(crate) fn opening_rate(&self, core: &LinkCore<'a, S>) -> u32 {
        match core.link.family() {
            Some(_) => core.link.rate(),
            None => Search::opening_rate(self.memory(core)),
        }
    }

    /// Goes on after a wait that ended as `woken` says; an error says that the line is gone.
    pub(crate) fn turn(
        &mut self,
        core: &mut LinkCore<'a, S>,
        open: &mut Open<S::Line>,
        woken: Woken,
    ) -> io::Result<()> {
        if woken == Woken::Request {
            core.handle_requests(Flow::Session(&mut open.session));
        } else {
            self.read(core, open)?;
        }
        self.drain(core, open)
    }

    /// The hub ends: the scanner is told what it is to be told then.
    pub(crate) fn end(&self, core: &LinkCore<'a, S>, open: &mut Open<S::Line>) -> io::Result<()> {
        let Open { line, session, .. } = open;
        if !session.end(core.around.now()) {
            return Ok(());
        }
        loop {
            match session.poll_output() {
                Output::SetDtr(on) => line.set_dtr(on)?,
                Output::Transmit { bytes, not_before } => {
                    core.around.pause(not_before);
                    line.write(bytes)?;
                    session.transmitted(core.around.now());
                }
                // Nothing is published any more.
                Output::SetRate(_) | Output::Event(_) => {}
                Output::Rest(_) | Output::Wait { .. } => return Ok(()),
            }
        }
    }

    fn read(&mut self, core: &mut LinkCore<'a, S>, open: &mut Open<S::Line>) -> io::Result<()> {
        let Open { line, session, allowance, backlog, settings_check, watch, until, .. } = open;
        let around = core.around;
        if !*watch && session.features().is_some_and(|features| features.has_whole_telegrams) {
            // The end of the telegram is near, so do now what can be done before it. Packets end all the time.
            core.output.prepare();
        }
        if *watch
            && session.can_defer_read()
            && let Some(waiting) = line.waiting()
            && session.defer_read(around.now(), waiting)
        {
            return Ok(());
        }
        let mut spare = session.spare();
        if let Some(allowance) = &allowance {
            let most = spare.len().min(allowance.bytes(around.now()).max(1));
            spare = &mut spare[..most];
        }
        let room = spare.len();
        let len = line.read(spare)?;
        let now = around.now();
        session.commit(now, len);
        if len > 0 {
            settings_check.note_bytes(now);
        }
        if let Some(waited) = backlog {
            if waited.take(len, session.rate(), now) {
                self.behind_at = Some(now);
            } else {
                *backlog = None;
            }
        }
        if let Some(allowance) = allowance {
            allowance.take(len, room, now);
            self.behind_at = allowance.is_behind(now).then_some(now);
            core.diagnosis.note_flood(allowance.is_flooded(now));
        }
        if len == 0 && now >= *until {
            session.handle_timeout(now);
        }
        Ok(())
    }

    /// Does what the session wants, until it wants to wait.
    fn drain(&mut self, core: &mut LinkCore<'a, S>, open: &mut Open<S::Line>) -> io::Result<()> {
        let Open { line, session, .. } = open;
        let around = core.around;
        let recorded = RecordedMetadata::default();
        let (mut published, mut is_scan) = (false, !core.stats.is_streaming());
        (open.watch, open.until) = loop {
            match session.poll_output() {
                Output::SetRate(baud) => {
                    // Setting the rate hides what another process has changed.
                    restore(core, line, baud)?;
                    if !self.set_baud(core, line, baud)? {
                        session.reject_rate(around.now());
                    }
                    // What waited is discarded.
                    open.backlog = None;
                    open.settings_check.pass();
                }
                Output::SetDtr(on) => line.set_dtr(on)?,
                Output::Transmit { bytes, not_before } => {
                    around.pause(not_before);
                    line.write(bytes)?;
                    session.transmitted(around.now());
                }
                Output::Event(Event::Telegram(mut received)) => {
                    let counted = line.line_errors();
                    core.stats.line_errors += counted;
                    let is_hit = self.line_errors.note(counted);
                    let is_behind = self.behind_at.is_some_and(|at| received.last <= at);
                    received.estimated |= is_behind;
                    received.reasons |= if is_hit { suspect::LINE_ERROR } else { 0 };
                    if received.whole.is_some() {
                        self.note_silence(core, received.last, is_behind);
                        is_scan = true;
                    }
                    if let Some(limit) = core.publish(&received, &recorded, is_behind) {
                        // The age of a backlog is unknown, so the next scan may follow after any time. The stamps of a
                        // network show it.
                        let is_of_backlog = is_behind && open.allowance.is_none();
                        self.follows_by = if is_of_backlog { 0 } else { received.last.saturating_add(limit) };
                    }
                    published = true;
                }
                Output::Event(Event::Scan(scan)) => {
                    let is_behind = self.behind_at.is_some_and(|at| scan.last <= at);
                    self.note_silence(core, scan.last, is_behind);
                    let limit = core.publish_scan(&scan, &recorded, is_behind);
                    self.follows_by = if is_behind { 0 } else { scan.last.saturating_add(limit) };
                    (published, is_scan) = (true, true);
                }
                Output::Rest(until) => break (false, until),
                Output::Wait { until, .. } => {
                    if !session.advance() {
                        break (true, until);
                    }
                    core.output.topics.set_family(session.family());
                }
            }
        };
        if published {
            self.line_errors.wait();
            open.settings_check.pass();
        }
        let now = around.now();
        if open.settings_check.is_due(session.state(), now) && restore(core, line, session.rate())? {
            open.backlog = None;
        }
        // Whether anybody follows is asked once a scan: that takes a look at the places of all who might.
        if is_scan {
            self.pieces = core.output.pieces();
        }
        session.set_partial_reads(self.pieces);
        if self.pieces > 1 || core.output.has_warned() {
            match session.partial_scan() {
                // A backlog warns of nothing that is still to come.
                Some(partial) if self.behind_at.is_some_and(|at| partial.first <= at) => {
                    core.output.withdraw(Some(partial.number));
                }
                partial => core.output.update_early_warning(partial.as_ref()),
            }
        }
        self.identity.keep_first(session);
        let (state, is_new) = core.diagnosis.update(session, now);
        if is_new && let Some(found) = session.known_rate() {
            self.found = Some(found);
            rates(core).iter().for_each(|rates| rates.keep_rate(&core.link.port.name(), found));
        }
        if (is_new || core.is_due(now)) && core.show_session(session, state) {
            self.identity.keep(session, around.now());
            self.note_scanner(core, session, now);
            if core.stops_when_idle() {
                session.set_has_subscribers(around.now(), core.output.topics.has_data_subscribers());
                // What follows from it is done at once, after an empty look at the line.
                open.until = around.now();
            }
        }
        // While telegrams come there is no need for wake-ups of the status' own.
        let bound = if state == State::Streaming { Nanos::MAX } else { core.next_status() };
        open.until = open.until.min(bound);
        open.rest = open.allowance.as_mut().and_then(|allowance| allowance.rest(around.now(), open.until));
        Ok(())
    }

    /// Handles a scan or reply whose last byte arrived at `last`. A hub that was stopped could not report the silence
    /// before it, so detect it by the stamps.
    fn note_silence(&self, core: &mut LinkCore<'a, S>, last: Nanos, is_behind: bool) {
        if !is_behind && last > self.follows_by {
            core.output.note_silence();
        }
    }

    /// Sets the rate. Returns whether the port can have it; the search leaves out a rate that it cannot have.
    fn set_baud(&mut self, core: &LinkCore<'a, S>, line: &S::Line, baud: u32) -> io::Result<bool> {
        let error = line.set_baud(baud)?;
        error.iter().for_each(|error| self.refuse(core, baud, error));
        Ok(error.is_none())
    }

    /// Logs once why the port cannot have this rate.
    pub(crate) fn refuse(&mut self, core: &LinkCore<'a, S>, baud: u32, error: &dyn fmt::Display) {
        if !self.refused.contains(&baud) {
            self.refused.push(baud);
            tracing::warn!("{}: {error}", core.link.name);
        }
    }

    /// Saves the scanner that a search has found and that streams, and logs it once its model is known.
    fn note_scanner(&mut self, core: &LinkCore<'a, S>, session: &PortSession, now: Nanos) {
        let Some(memory) = session.memory() else { return };
        let (link, status) = (core.link, core.stats.last());
        let before = self.scanner.as_ref();
        let beams = session.beams().filter(|_| link.scanner.settings.beams.is_none());
        let is_known = |known: &KnownScanner| {
            let model = known.model.as_deref();
            let is_it = |reported: &str| model.is_some_and(|model| model.eq_ignore_ascii_case(reported));
            (known.memory, known.beams) == (memory, beams) && status.reported_model().is_none_or(is_it)
        };
        if self.is_named && before.is_some_and(is_known) {
            return;
        }
        let is_same_family = before.is_some_and(|before| before.memory.family == memory.family);
        let known_model = before.filter(|_| is_same_family).and_then(|before| before.model.clone());
        let reported = status.model();
        let is_reported = reported.is_some() || now >= status.since_ns + UNNAMED;
        let scanner = KnownScanner { memory, model: reported.or_else(|| known_model.clone()), beams };
        let is_other =
            before.is_some() && (!is_same_family || known_model.is_some() && known_model != scanner.model);
        if is_reported && (is_other || !self.is_named) {
            self.is_named = true;
            let name = name_of(&scanner);
            match before.filter(|_| is_other) {
                Some(before) => tracing::info!("{}: was {}, is now {name}", link.name, name_of(before)),
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
        } else if !is_reported && is_other {
            // The log names both scanners once the model of this one is known.
            return;
        }
        if self.scanner.as_ref() != Some(&scanner) {
            if let Some(learned) = core.around.learned() {
                learned.keep_scanner(&link.port.name(), scanner.clone());
            }
            self.scanner = Some(scanner);
        }
    }
}

/// Returns the model, or else the family. A model that scanhub does not know has only a number.
fn name_of(scanner: &KnownScanner) -> String {
    let family = scanner.memory.family.name();
    match &scanner.model {
        Some(number) if Status::is_model_number(number) => format!("{family} model {number} (unknown)"),
        Some(model) => model.clone(),
        None => family.to_owned(),
    }
}

/// Returns the scanner that an earlier run of the hub has found at the port of `core`.
fn known_scanner<S: Surroundings>(core: &LinkCore<'_, S>) -> Option<KnownScanner> {
    core.around.learned().and_then(|learned| learned.scanner(&core.link.port.name()))
}

/// Makes the hub's settings of `line` again, at `baud`, if another process has changed them; returns whether it has.
fn restore<S: Surroundings>(core: &mut LinkCore<'_, S>, line: &S::Line, baud: u32) -> io::Result<bool> {
    let Some(alteration) = line.altered()? else { return Ok(false) };
    line.restore(baud)?;
    let program = || core.around.altering_program(&core.link.port);
    core.diagnosis.note_altered(alteration, program, core.around.now());
    Ok(true)
}

/// Where rates are kept, if anywhere.
fn rates<'a, S: Surroundings>(core: &LinkCore<'a, S>) -> Option<&'a dyn Learned> {
    core.around.learned().filter(|_| is_tty(core))
}

/// Time for which the log waits for the model of a scanner that streams.
const UNNAMED: Nanos = 10_000 * MILLIS;

/// Whether the rate of the line can be changed.
fn is_tty<S: Surroundings>(core: &LinkCore<'_, S>) -> bool {
    matches!(core.link.port, Source::Tty(_))
}
