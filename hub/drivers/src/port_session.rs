//! The session on a port: with a scanner of a configured family, or with the scanner that a [`Search`] finds.
//!
//! A found scanner gets a session of its family. If nothing of the scanner arrives for 10 s, the search begins again,
//! with that family first. The driver handles both like any session, and calls [`PortSession::advance`] at each wait.

use core::fmt;

use scanhub_schema::{Counter, Counters, Family, MILLIS, Nanos, Status};

use crate::families::{Session, Trouble, features};
use crate::line::family::{Features, Model};
use crate::line::{
    self, Account, Control, Identity, Introduction, KnownRate, Notice, Output, Protocol as _, RawScan,
    Received, Session as _, State,
};
use crate::search::{Found, Memory, PortKind, Search};
use crate::settings::Settings;

/// A session on an open port.
#[derive(Debug)]
pub struct PortSession {
    settings: Settings,
    /// Whether the family is searched for.
    is_auto: bool,
    stage: Stage,
    /// Reads of the search that the session of the found scanner has not handled yet, the oldest at the end.
    captured: Vec<(Nanos, Vec<u8>)>,
    memory: Option<Memory>,
    /// Rate at which the scanner was found.
    found_rate: Option<u32>,
    /// Identity that an earlier session has saved, for the first scanner that is found.
    identity: Option<Identity>,
    known_rate: Option<KnownRate>,
    /// Family, model and number of beams of the last scanner.
    last: Option<(Family, Model, usize)>,
    /// Trouble of the last session, until the search has its own.
    trouble: Option<Trouble>,
    /// Whether a user has paused the search.
    is_paused: bool,
    now: Nanos,
    /// Last time that was passed to the session. Captured reads are older than `now`.
    session_now: Nanos,
    /// Time at which something of the found scanner arrived last.
    received_at: Nanos,
    partial_reads: u8,
    /// Bytes that were read by searches that have ended, or during a pause.
    searched: u64,
    /// Counters of sessions that have ended.
    past: Account,
    past_counters: Counters,
}

#[expect(clippy::large_enum_variant, reason = "there is one per open port")]
#[derive(Debug)]
enum Stage {
    Searching(Box<Search>),
    Found(Session),
}

impl PortSession {
    /// Creates a session on a port that was opened at `now`. With a `family`, the port is open at the rate of
    /// `settings`, or else of the model. Without one, it is open at the [rate of the search](Search::opening_rate),
    /// which begins with the scanner in `memory`.
    pub fn begin(
        family: Option<Family>,
        settings: &Settings,
        memory: Option<Memory>,
        now: Nanos,
    ) -> PortSession {
        let stage = match family {
            Some(family) => Stage::Found(Session::begin(family, settings, now)),
            None => Stage::Searching(Box::new(Search::new(port_kind(settings), memory, now))),
        };
        PortSession {
            settings: *settings,
            is_auto: family.is_none(),
            stage,
            captured: Vec::new(),
            memory,
            found_rate: None,
            identity: None,
            known_rate: None,
            last: None,
            trouble: None,
            is_paused: false,
            now,
            session_now: now,
            received_at: now,
            partial_reads: 1,
            searched: 0,
            past: Account::default(),
            past_counters: Counters::default(),
        }
    }

    /// Returns the session with the scanner. `None` while it is searched for.
    fn session(&self) -> Option<&Session> {
        if let Stage::Found(session) = &self.stage { Some(session) } else { None }
    }

    /// Does the same as [`session`](Self::session), to change it.
    fn session_mut(&mut self) -> Option<&mut Session> {
        if let Stage::Found(session) = &mut self.stage { Some(session) } else { None }
    }

    /// Returns the family. `None` while it is searched for.
    pub fn family(&self) -> Option<Family> {
        self.session().map(Session::family)
    }

    /// Returns the models and settings of the family. `None` while it is searched for.
    pub fn features(&self) -> Option<&'static Features> {
        self.family().map(features)
    }

    /// Returns the scanner that the search has found, for the next search. `None` until it streams.
    pub fn memory(&self) -> Option<Memory> {
        let Stage::Found(session) = &self.stage else { return None };
        if !self.is_auto || session.state() != State::Streaming {
            return None;
        }
        let (family, stream_rate) = (session.family(), session.rate());
        let found_rate = self.found_rate.unwrap_or(stream_rate);
        // A scanner that streamed when it was found has not shown at which rate it starts.
        let before = self.memory.filter(|memory| memory.family == family && found_rate == stream_rate);
        let reply_rate = before.map_or(found_rate, |memory| memory.reply_rate);
        Some(Memory { family, stream_rate, reply_rate })
    }

    /// Continues when [`poll_output`](line::Protocol::poll_output) has returned a wait. Returns whether there is more
    /// to drain: the search has found a scanner, or it begins again.
    pub fn advance(&mut self) -> bool {
        if !self.is_auto {
            return false;
        }
        match &mut self.stage {
            Stage::Searching(search) => {
                let found = search.found().filter(|_| !self.is_paused);
                found.is_some_and(|found| {
                    self.meet(found);
                    true
                })
            }
            Stage::Found(session) => {
                if let Some((at, bytes)) = self.captured.pop() {
                    let spare = session.spare();
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
                let is_lost = self.now >= self.received_at + LOST_AFTER;
                if is_lost {
                    self.lose();
                }
                is_lost
            }
        }
    }

    /// Begins a session with the scanner that the search has found.
    fn meet(&mut self, found: Found) {
        let Stage::Searching(search) = &self.stage else { return };
        let Found { family, rate, model: _ } = found;
        self.captured = search.reads().map(|(at, bytes)| (at, bytes.to_vec())).collect();
        self.captured.reverse();
        self.searched += search.account().discarded;
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
            session.begin_at(rate, begins);
        }
        if let Some((_, model, beams)) = self.last.filter(|(last, ..)| *last == family) {
            session.restore_beams(model, beams);
        }
        session.set_partial_reads(self.partial_reads);
        (self.session_now, self.received_at) = (begins, self.now);
        (self.found_rate, self.trouble) = (rate, None);
        self.stage = Stage::Found(session);
    }

    /// Ends the session, because nothing of its scanner arrives any more, and searches again.
    fn lose(&mut self) {
        let Stage::Found(session) = &self.stage else { return };
        let account = session.account();
        session.add_counters(&mut self.past_counters);
        self.past_counters[Counter::BytesDiscarded] += account.buffered;
        self.past_counters[Counter::BytesBuffered] = 0;
        let ended = Account { discarded: account.discarded + account.buffered, buffered: 0, ..account };
        self.past = sum(self.past, ended);
        self.trouble = session.trouble();
        self.known_rate = session.known_rate().or(self.known_rate);
        let beams = session.model().zip(session.beams());
        self.last = beams.map(|(model, beams)| (session.family(), model, beams)).or(self.last);
        self.search();
    }

    /// Starts a search on a port that is open at any rate.
    fn search(&mut self) {
        if let Stage::Searching(search) = &self.stage {
            self.searched += search.account().read;
        }
        self.captured.clear();
        let search = Search::new(port_kind(&self.settings), self.memory, self.now);
        self.stage = Stage::Searching(Box::new(search.at_another_rate()));
    }
}

impl line::Protocol for PortSession {
    fn spare(&mut self) -> &mut [u8] {
        match &mut self.stage {
            Stage::Searching(search) => search.spare(),
            Stage::Found(session) => session.spare(),
        }
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        (self.now, self.session_now) = (now, now);
        match &mut self.stage {
            Stage::Searching(_) if self.is_paused => self.searched += len as u64,
            Stage::Searching(search) => search.commit(now, len),
            Stage::Found(session) => session.commit(now, len),
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        (self.now, self.session_now) = (now, now);
        match &mut self.stage {
            Stage::Searching(_) if self.is_paused => {}
            Stage::Searching(search) => search.handle_timeout(now),
            Stage::Found(session) => session.handle_timeout(now),
        }
    }

    fn transmitted(&mut self, now: Nanos) {
        (self.now, self.session_now) = (now, now);
        match &mut self.stage {
            Stage::Searching(search) => {
                // A scanner that replies may be another one.
                self.identity = None;
                search.transmitted(now);
            }
            Stage::Found(session) => session.transmitted(now),
        }
    }

    fn reject_rate(&mut self, now: Nanos) {
        self.now = now;
        match &mut self.stage {
            Stage::Searching(search) => search.reject_rate(now),
            Stage::Found(session) => session.reject_rate(now),
        }
    }

    fn poll_output(&mut self) -> Output<'_> {
        match &mut self.stage {
            Stage::Searching(_) if self.is_paused => Output::Wait { until: Nanos::MAX },
            Stage::Searching(search) => search.poll_output(),
            Stage::Found(session) => {
                let may_search = self.is_auto && session.state() != State::Paused;
                let lost_at = if may_search { self.received_at + LOST_AFTER } else { Nanos::MAX };
                match session.poll_output() {
                    Output::Event(event) => {
                        self.received_at = self.now;
                        Output::Event(event)
                    }
                    Output::Wait { until } => Output::Wait { until: until.min(lost_at) },
                    output => output,
                }
            }
        }
    }
}

/// Writes methods that return what the session of the found scanner does, and another value during a search.
macro_rules! found {
    ($(fn $name:ident($($arg:ident: $Arg:ty),*) -> $Ret:ty = $searching:expr;)*) => {
        $(fn $name(&self $(, $arg: $Arg)*) -> $Ret {
            match &self.stage {
                Stage::Searching(_) => $searching,
                Stage::Found(session) => line::Session::$name(session $(, $arg)*),
            }
        })*
    };
}

impl line::Session for PortSession {
    type Trouble = Trouble;

    fn control(&mut self, control: Control, now: Nanos) {
        (self.now, self.session_now, self.received_at) = (now, now, now);
        if let Stage::Found(session) = &mut self.stage {
            return session.control(control, now);
        }
        self.past.resyncs += u64::from(control == Control::Resync);
        self.past_counters[Counter::Resyncs] += u64::from(control == Control::Resync);
        match control {
            Control::Pause => self.is_paused = true,
            Control::Resume if !self.is_paused => {}
            Control::Resume | Control::Resync => {
                (self.is_paused, self.trouble) = (false, None);
                self.search();
            }
        }
    }

    fn state(&self) -> State {
        match &self.stage {
            Stage::Searching(_) if self.is_paused => State::Paused,
            Stage::Searching(_) => State::Probing,
            Stage::Found(session) => session.state(),
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        match &self.stage {
            Stage::Searching(_) if self.is_paused => None,
            Stage::Searching(search) => search.trouble().map(Trouble::Search).or(self.trouble),
            Stage::Found(session) => session.trouble(),
        }
    }

    fn rate(&self) -> u32 {
        match &self.stage {
            Stage::Searching(search) => search.rate().unwrap_or(SLOWEST),
            Stage::Found(session) => session.rate(),
        }
    }

    fn account(&self) -> Account {
        let now = match &self.stage {
            Stage::Searching(search) => search.account(),
            Stage::Found(session) => {
                let account = session.account();
                let captured = self.captured.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>();
                Account { read: account.read + captured, buffered: account.buffered + captured, ..account }
            }
        };
        let searched = Account { read: self.searched, discarded: self.searched, ..Account::default() };
        sum(sum(self.past, searched), now)
    }

    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        match &mut self.stage {
            Stage::Searching(_) => false,
            Stage::Found(session) => {
                (self.now, self.session_now) = (now, now);
                session.defer_read(now, waiting)
            }
        }
    }

    fn set_has_subscribers(&mut self, now: Nanos, has_subscribers: bool) {
        if let Stage::Found(session) = &mut self.stage {
            session.set_has_subscribers(now, has_subscribers);
        }
    }

    fn end(&mut self, now: Nanos) -> bool {
        self.session_mut().is_some_and(|session| session.end(now))
    }

    fn restore_identity(&mut self, identity: Identity) {
        match &mut self.stage {
            Stage::Searching(_) => self.identity = Some(identity),
            Stage::Found(session) => session.restore_identity(identity),
        }
    }

    fn hint_rate(&mut self, known: KnownRate) {
        match &mut self.stage {
            Stage::Searching(_) => self.known_rate = Some(known),
            Stage::Found(session) => session.hint_rate(known),
        }
    }

    fn restore_beams(&mut self, model: Model, beams: usize) {
        match &mut self.stage {
            Stage::Searching(_) => self.last = self.memory.map(|memory| (memory.family, model, beams)),
            Stage::Found(session) => session.restore_beams(model, beams),
        }
    }

    fn set_partial_reads(&mut self, count: u8) {
        self.partial_reads = count;
        if let Stage::Found(session) = &mut self.stage {
            session.set_partial_reads(count);
        }
    }

    fn mark_suspect(&mut self, reasons: u8) {
        if let Stage::Found(session) = &mut self.stage {
            session.mark_suspect(reasons);
        }
    }

    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<Received<'a>> {
        self.session_mut()?.read_recorded(telegram, is_readable, status)
    }

    found! {
        fn missing() -> Option<&'static str> = None;
        fn can_defer_read() -> bool = false;
        fn identity() -> Option<Identity> = None;
        fn known_rate() -> Option<KnownRate> = None;
        fn partial_scan() -> Option<RawScan<'_>> = None;
        fn model() -> Option<Model> = None;
        fn beams() -> Option<usize> = None;
        fn other_model() -> Option<Model> = None;
        fn unit_mm() -> Option<u8> = None;
        fn notice() -> Option<Notice> = None;
        fn missing_setting() -> Option<&'static str> = None;
        fn write_details(text: &mut dyn fmt::Write) -> () = { let _ = text; };
        fn introduction() -> Option<Introduction> = None;
        fn scanner_time() -> Option<Nanos> = None;
    }

    /// A search removes what an earlier scanner has reported.
    fn describe(&self, status: &mut Status) {
        match &self.stage {
            Stage::Searching(_) => {
                status.mode = Status::MODE_UNKNOWN;
                (status.unit_mm, status.angle_deg, status.resolution_cdeg) = (0, 0, 0);
                status.set_sensor_type("");
            }
            Stage::Found(session) => session.describe(status),
        }
    }

    fn add_counters(&self, counters: &mut Counters) {
        for (counter, past) in counters.0.iter_mut().zip(self.past_counters.0) {
            *counter += past;
        }
        counters[Counter::BytesRead] += self.searched;
        counters[Counter::BytesDiscarded] += self.searched;
        match &self.stage {
            Stage::Searching(search) => search.account().add_to(counters),
            Stage::Found(session) => {
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

fn sum(a: Account, b: Account) -> Account {
    Account {
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
        began_with_a_cut: a.began_with_a_cut || b.began_with_a_cut,
    }
}

/// After this time without anything of a found scanner, the search begins again. Until then, the session of the family
/// handles silence and power cycles.
const LOST_AFTER: Nanos = 10_000 * MILLIS;
/// Stands for an unknown rate of the port, in bits per second.
const SLOWEST: u32 = 9_600;
