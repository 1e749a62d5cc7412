//! Session on a port, with a scanner of the configured family or with a scanner that a [`Search`] finds.
//!
//! After the search, a session of the scanner's family takes over. If this session receives nothing for 10 s, the
//! search starts again, with the same family first. The driver handles a search like a session, and calls
//! [`PortSession::advance`] at each wait.

use core::fmt;

use scanhub_schema::{Counter, Counters, Family, MILLIS, Nanos, Status};

use crate::families::{Problem, Session, features};
use crate::line::family::{Features, Model};
use crate::line::{
    self, Action, Control, DeviceInfo, Identity, KnownRate, Notice, Protocol as _, RawScan, ReceivedTelegram,
    ScannerSession as _, SessionStats, State,
};
use crate::search::{FoundScanner, Memory, PortKind, Search};
use crate::settings::Settings;

/// Session on an open port.
#[derive(Debug)]
pub struct PortSession {
    settings: Settings,
    /// Whether the family is `auto`, so that the session searches for the scanner.
    is_auto: bool,
    phase: Phase,
    /// Reads of the search that the session has not processed yet. The last element is the oldest read.
    captured: Vec<(Nanos, Vec<u8>)>,
    memory: Option<Memory>,
    /// Baud rate at which the search found the scanner, in bits per second.
    found_rate: Option<u32>,
    /// Identity that an earlier session saved, for the first scanner that the search finds.
    identity: Option<Identity>,
    known_rate: Option<KnownRate>,
    /// Family, model and number of beams of the last scanner.
    last: Option<(Family, Model, usize)>,
    /// Problem of the last session. It is reported until the search has its own problem.
    problem: Option<Problem>,
    /// Whether a user has paused the search.
    is_paused: bool,
    now: Nanos,
    /// Last time that was passed to the session. While the session processes captured reads, this time is earlier than
    /// `now`.
    session_now: Nanos,
    /// Time at which the session last returned an event.
    received_at: Nanos,
    partial_reads: u8,
    /// Number of bytes that were read by completed searches, or during a pause.
    searched: u64,
    /// Counters of the sessions that have ended.
    past_stats: SessionStats,
    past_counters: Counters,
}

#[expect(clippy::large_enum_variant, reason = "there is one per open port")]
#[derive(Debug)]
enum Phase {
    Searching(Box<Search>),
    Found(Session),
}

impl PortSession {
    /// Creates a session on a port that was opened at `now`. If `family` is set, the port is open at the baud rate in
    /// `settings`, or, without such a rate, at the default rate of the model. If `family` is `None`, the port is open
    /// at the [rate of the search](Search::opening_rate), and the search first tries to find the scanner in `memory`.
    pub fn begin(
        family: Option<Family>,
        settings: &Settings,
        memory: Option<Memory>,
        now: Nanos,
    ) -> PortSession {
        let phase = match family {
            Some(family) => Phase::Found(Session::begin(family, settings, now)),
            None => Phase::Searching(Box::new(Search::new(port_kind(settings), memory, now))),
        };
        PortSession {
            settings: *settings,
            is_auto: family.is_none(),
            phase,
            captured: Vec::new(),
            memory,
            found_rate: None,
            identity: None,
            known_rate: None,
            last: None,
            problem: None,
            is_paused: false,
            now,
            session_now: now,
            received_at: now,
            partial_reads: 1,
            searched: 0,
            past_stats: SessionStats::default(),
            past_counters: Counters::default(),
        }
    }

    /// Returns the session with the scanner. Returns `None` during a search.
    fn session(&self) -> Option<&Session> {
        if let Phase::Found(session) = &self.phase { Some(session) } else { None }
    }

    /// Returns the session with the scanner as a mutable reference. Returns `None` during a search.
    fn session_mut(&mut self) -> Option<&mut Session> {
        if let Phase::Found(session) = &mut self.phase { Some(session) } else { None }
    }

    /// Returns the scanner's family. Returns `None` during a search.
    pub fn family(&self) -> Option<Family> {
        self.session().map(Session::family)
    }

    /// Returns the models and settings of the scanner's family. Returns `None` during a search.
    pub fn features(&self) -> Option<&'static Features> {
        self.family().map(features)
    }

    /// Returns the scanner that the search has found, for the next search. Returns `None` until the scanner streams.
    pub fn memory(&self) -> Option<Memory> {
        let Phase::Found(session) = &self.phase else { return None };
        if !self.is_auto || session.state() != State::Streaming {
            return None;
        }
        let (family, stream_rate) = (session.family(), session.rate());
        let found_rate = self.found_rate.unwrap_or(stream_rate);
        // If the scanner streamed when the search found it, the baud rate of its replies is still unknown.
        let before = self.memory.filter(|memory| memory.family == family && found_rate == stream_rate);
        let reply_rate = before.map_or(found_rate, |memory| memory.reply_rate);
        Some(Memory { family, stream_rate, reply_rate })
    }

    /// Continues after [`poll_action`](line::Protocol::poll_action) has returned a wait. Returns whether the driver
    /// must drain the session again. The driver must do so if the search has found a scanner or has restarted, or if
    /// the session has processed captured bytes.
    pub fn advance(&mut self) -> bool {
        if !self.is_auto {
            return false;
        }
        match &mut self.phase {
            Phase::Searching(search) => {
                let found = search.found().filter(|_| !self.is_paused);
                found.is_some_and(|found| {
                    self.begin_session(found);
                    true
                })
            }
            Phase::Found(session) => {
                if let Some((at, bytes)) = self.captured.pop() {
                    let spare = session.read_buffer();
                    let len = bytes.len().min(spare.len());
                    spare[..len].copy_from_slice(&bytes[..len]);
                    self.session_now = self.session_now.max(at);
                    session.commit(self.session_now, len);
                    if len < bytes.len() {
                        self.captured.push((at, bytes[len..].to_vec()));
                    }
                    return true;
                }
                if session.state() == State::Paused {
                    self.received_at = self.now;
                }
                self.memory = self.memory().or(self.memory);
                let is_lost = self.now >= self.received_at + LOSS_TIMEOUT;
                if is_lost {
                    self.restart_search();
                }
                is_lost
            }
        }
    }

    /// Starts a session with the scanner that the search has found.
    fn begin_session(&mut self, found: FoundScanner) {
        let Phase::Searching(search) = &self.phase else { return };
        let FoundScanner { family, rate, model: _ } = found;
        self.captured = search.reads().map(|(at, bytes)| (at, bytes.to_vec())).collect();
        self.captured.reverse();
        self.searched += search.stats().discarded;
        let begins = self.captured.last().map_or(self.now, |(at, _)| *at);
        let settings = Settings { is_found: true, ..self.settings };
        let mut session = Session::begin(family, &settings, begins);
        if let Some(known) = self.known_rate {
            session.hint_rate(known);
        }
        if let Some(identity) = self.identity.take()
            && self.memory.is_some_and(|memory| memory.family == family)
        {
            session.restore_identity(identity);
        }
        if let Some(rate) = rate {
            session.set_start_rate(rate, begins);
        }
        if let Some((_, model, beams)) = self.last.filter(|(last, ..)| *last == family) {
            session.restore_beams(model, beams);
        }
        session.set_partial_reads(self.partial_reads);
        (self.session_now, self.received_at) = (begins, self.now);
        (self.found_rate, self.problem) = (rate, None);
        self.phase = Phase::Found(session);
    }

    /// Ends the session, because it no longer receives anything from its scanner, and starts a search.
    fn restart_search(&mut self) {
        let Phase::Found(session) = &self.phase else { return };
        let stats = session.stats();
        session.add_counters(&mut self.past_counters);
        self.past_counters[Counter::BytesDiscarded] += stats.buffered;
        self.past_counters[Counter::BytesBuffered] = 0;
        let past = SessionStats { discarded: stats.discarded + stats.buffered, buffered: 0, ..stats };
        self.past_stats = sum(self.past_stats, past);
        self.problem = session.problem();
        self.known_rate = session.known_rate().or(self.known_rate);
        let beams = session.model().zip(session.beams());
        self.last = beams.map(|(model, beams)| (session.family(), model, beams)).or(self.last);
        self.search();
    }

    /// Starts a search. The port may be open at any baud rate, so the search first sets the baud rate.
    fn search(&mut self) {
        if let Phase::Searching(search) = &self.phase {
            self.searched += search.stats().read;
        }
        self.captured.clear();
        let search = Search::new(port_kind(&self.settings), self.memory, self.now);
        self.phase = Phase::Searching(Box::new(search.with_rate_change()));
    }
}

impl line::Protocol for PortSession {
    fn read_buffer(&mut self) -> &mut [u8] {
        match &mut self.phase {
            Phase::Searching(search) => search.read_buffer(),
            Phase::Found(session) => session.read_buffer(),
        }
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        (self.now, self.session_now) = (now, now);
        match &mut self.phase {
            Phase::Searching(_) if self.is_paused => self.searched += len as u64,
            Phase::Searching(search) => search.commit(now, len),
            Phase::Found(session) => session.commit(now, len),
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        (self.now, self.session_now) = (now, now);
        match &mut self.phase {
            Phase::Searching(_) if self.is_paused => {}
            Phase::Searching(search) => search.handle_timeout(now),
            Phase::Found(session) => session.handle_timeout(now),
        }
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        (self.now, self.session_now) = (now, now);
        match &mut self.phase {
            Phase::Searching(search) => {
                // The scanner that replies may differ from the scanner whose identity was saved.
                self.identity = None;
                search.handle_transmitted(now);
            }
            Phase::Found(session) => session.handle_transmitted(now),
        }
    }

    fn reject_rate(&mut self, now: Nanos) {
        self.now = now;
        match &mut self.phase {
            Phase::Searching(search) => search.reject_rate(now),
            Phase::Found(session) => session.reject_rate(now),
        }
    }

    fn poll_action(&mut self) -> Action<'_> {
        match &mut self.phase {
            Phase::Searching(_) if self.is_paused => Action::Wait { until: Nanos::MAX },
            Phase::Searching(search) => search.poll_action(),
            Phase::Found(session) => {
                let may_search = self.is_auto && session.state() != State::Paused;
                let lost_at = if may_search { self.received_at + LOSS_TIMEOUT } else { Nanos::MAX };
                match session.poll_action() {
                    Action::Event(event) => {
                        self.received_at = self.now;
                        Action::Event(event)
                    }
                    Action::Wait { until } => Action::Wait { until: until.min(lost_at) },
                    output => output,
                }
            }
        }
    }
}

/// Defines methods that call the method with the same name of the session. During a search, a method returns the value
/// after `=`.
macro_rules! found {
    ($(fn $name:ident($($arg:ident: $Arg:ty),*) -> $Ret:ty = $searching:expr;)*) => {
        $(fn $name(&self $(, $arg: $Arg)*) -> $Ret {
            match &self.phase {
                Phase::Searching(_) => $searching,
                Phase::Found(session) => line::ScannerSession::$name(session $(, $arg)*),
            }
        })*
    };
}

impl line::ScannerSession for PortSession {
    type Problem = Problem;

    fn control(&mut self, control: Control, now: Nanos) {
        (self.now, self.session_now, self.received_at) = (now, now, now);
        if let Phase::Found(session) = &mut self.phase {
            return session.control(control, now);
        }
        self.past_stats.resyncs += u64::from(control == Control::Resync);
        self.past_counters[Counter::Resyncs] += u64::from(control == Control::Resync);
        match control {
            Control::Pause => self.is_paused = true,
            Control::Resume if !self.is_paused => {}
            Control::Resume | Control::Resync => {
                (self.is_paused, self.problem) = (false, None);
                self.search();
            }
        }
    }

    fn state(&self) -> State {
        match &self.phase {
            Phase::Searching(_) if self.is_paused => State::Paused,
            Phase::Searching(_) => State::Probing,
            Phase::Found(session) => session.state(),
        }
    }

    fn problem(&self) -> Option<Problem> {
        match &self.phase {
            Phase::Searching(_) if self.is_paused => None,
            Phase::Searching(search) => search.problem().map(Problem::Search).or(self.problem),
            Phase::Found(session) => session.problem(),
        }
    }

    fn rate(&self) -> u32 {
        match &self.phase {
            Phase::Searching(search) => search.rate().unwrap_or(FALLBACK_RATE),
            Phase::Found(session) => session.rate(),
        }
    }

    fn stats(&self) -> SessionStats {
        let current = match &self.phase {
            Phase::Searching(search) => search.stats(),
            Phase::Found(session) => {
                let stats = session.stats();
                let captured = self.captured.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>();
                SessionStats { read: stats.read + captured, buffered: stats.buffered + captured, ..stats }
            }
        };
        let searched =
            SessionStats { read: self.searched, discarded: self.searched, ..SessionStats::default() };
        sum(sum(self.past_stats, searched), current)
    }

    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        match &mut self.phase {
            Phase::Searching(_) => false,
            Phase::Found(session) => {
                (self.now, self.session_now) = (now, now);
                session.defer_read(now, waiting)
            }
        }
    }

    fn set_has_subscribers(&mut self, now: Nanos, has_subscribers: bool) {
        if let Phase::Found(session) = &mut self.phase {
            session.set_has_subscribers(now, has_subscribers);
        }
    }

    fn end(&mut self, now: Nanos) -> bool {
        self.session_mut().is_some_and(|session| session.end(now))
    }

    fn restore_identity(&mut self, identity: Identity) {
        match &mut self.phase {
            Phase::Searching(_) => self.identity = Some(identity),
            Phase::Found(session) => session.restore_identity(identity),
        }
    }

    fn hint_rate(&mut self, known: KnownRate) {
        match &mut self.phase {
            Phase::Searching(_) => self.known_rate = Some(known),
            Phase::Found(session) => session.hint_rate(known),
        }
    }

    fn restore_beams(&mut self, model: Model, beams: usize) {
        match &mut self.phase {
            Phase::Searching(_) => self.last = self.memory.map(|memory| (memory.family, model, beams)),
            Phase::Found(session) => session.restore_beams(model, beams),
        }
    }

    fn set_partial_reads(&mut self, count: u8) {
        self.partial_reads = count;
        if let Phase::Found(session) = &mut self.phase {
            session.set_partial_reads(count);
        }
    }

    fn mark_suspect(&mut self, reasons: u8) {
        if let Phase::Found(session) = &mut self.phase {
            session.mark_suspect(reasons);
        }
    }

    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<ReceivedTelegram<'a>> {
        self.session_mut()?.read_recorded(telegram, is_readable, status)
    }

    found! {
        fn missing_transmission() -> Option<&'static str> = None;
        fn can_defer_read() -> bool = false;
        fn identity() -> Option<Identity> = None;
        fn known_rate() -> Option<KnownRate> = None;
        fn partial_scan() -> Option<RawScan<'_>> = None;
        fn model() -> Option<Model> = None;
        fn beams() -> Option<usize> = None;
        fn unexpected_model() -> Option<Model> = None;
        fn unit_mm() -> Option<u8> = None;
        fn notice() -> Option<Notice> = None;
        fn missing_setting() -> Option<&'static str> = None;
        fn write_details(text: &mut dyn fmt::Write) -> () = { let _ = text; };
        fn device_info() -> Option<DeviceInfo> = None;
        fn scanner_time() -> Option<Nanos> = None;
    }

    /// Clears the status fields during a search, because they describe an earlier scanner.
    fn describe(&self, status: &mut Status) {
        match &self.phase {
            Phase::Searching(_) => {
                status.mode = Status::MODE_UNKNOWN;
                (status.unit_mm, status.angle_deg, status.resolution_cdeg) = (0, 0, 0);
                status.set_sensor_type("");
            }
            Phase::Found(session) => session.describe(status),
        }
    }

    fn add_counters(&self, counters: &mut Counters) {
        for (counter, past) in counters.0.iter_mut().zip(self.past_counters.0) {
            *counter += past;
        }
        counters[Counter::BytesRead] += self.searched;
        counters[Counter::BytesDiscarded] += self.searched;
        match &self.phase {
            Phase::Searching(search) => search.stats().add_to(counters),
            Phase::Found(session) => {
                session.add_counters(counters);
                let captured = self.captured.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>();
                counters[Counter::BytesRead] += captured;
                counters[Counter::BytesBuffered] += captured;
            }
        }
    }
}

/// Returns the kind of the port of a session with these settings.
fn port_kind(settings: &Settings) -> PortKind {
    match settings {
        Settings { listen_only: true, .. } => PortKind::Recording,
        Settings { fixed_rate: true, .. } => PortKind::Server,
        _ => PortKind::Serial,
    }
}

fn sum(a: SessionStats, b: SessionStats) -> SessionStats {
    SessionStats {
        read: a.read + b.read,
        in_telegrams: a.in_telegrams + b.in_telegrams,
        acknowledge: a.acknowledge + b.acknowledge,
        discarded: a.discarded + b.discarded,
        buffered: a.buffered + b.buffered,
        telegrams: a.telegrams + b.telegrams,
        due: a.due + b.due,
        lost: a.lost + b.lost,
        damaged: a.damaged + b.damaged,
        rejected_checksum: a.rejected_checksum + b.rejected_checksum,
        resyncs: a.resyncs + b.resyncs,
        restarts: a.restarts + b.restarts,
        first_frame_truncated: a.first_frame_truncated || b.first_frame_truncated,
    }
}

/// Time without an event from a found scanner after which the search starts again. Before this time has passed, the
/// session itself handles silence and power cycles.
const LOSS_TIMEOUT: Nanos = 10_000 * MILLIS;
/// Baud rate that the session reports while the rate of the port is unknown, in bits per second.
const FALLBACK_RATE: u32 = 9_600;
