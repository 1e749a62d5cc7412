//! Keeps a link connected to its port. It streams while the port exists, polls for it while it is missing, and opens it
//! again under the same name, whatever device it is then. While another process publishes under the sensor's name, the
//! link leaves the port alone and waits for the name. The log has each reason once.

use std::io;

use port::{PortError, Source};
use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Control, Identity, Protocol as _, Session as _};
use schema::{Failure, Flags, Kind, MILLIS, Nanos, State};

use crate::control::{ControlQueue, Flow};
use crate::drive::{Drive, Open};
use crate::link::LinkCore;
use crate::surroundings::{Line, On, Surroundings, Wait, Woken};

/// A link whose other end is a port that comes and goes: told why a wait is over, it says for what to wait next.
pub struct LiveLink<'a, S: Surroundings> {
    core: LinkCore<'a, S>,
    drive: Drive<'a, S>,
    phase: Phase<S::Line>,
    /// Times in a row that the port was there and went without a byte.
    futile: u32,
    has_begun: bool,
    /// Whether another process has had the sensor's name since the link exists.
    lacks_name: bool,
}

/// A line that was just opened.
struct OpenLine<L> {
    line: L,
    /// Whether it has the rate that the session wants first.
    has_rate: bool,
    /// Whether a service manager kept the line of a killed hub open, with the bytes that it has received.
    is_kept: bool,
}

/// Where the port is.
enum Phase<L> {
    /// There.
    Open(Box<Open<L>>),
    /// Away until it is looked for again, and what to wait for until then.
    Away { away: Away, look_at: Nanos, until: Nanos },
    /// Being opened.
    Opening { away: Away, until: Nanos },
}

impl<'a, S: Surroundings> LiveLink<'a, S> {
    /// Takes the name of `link`, number `number` in the configuration, and creates its topics for the run `boot` of the hub.
    /// Publishes the first status, and looks for the port. The caller then calls [`turn`](Self::turn) with a timeout.
    ///
    /// # Errors
    ///
    /// Returns an error of kind [`PortNotTty`](schema::Kind::PortNotTty) if the port is not a serial line at all, an error
    /// of kind [`Short`](schema::Kind::Short) if descriptors or memory run out, and those of [`Surroundings::medium`]. The
    /// link waits for a port that is missing, in use or forbidden, or that cannot have the rate, and for a name that
    /// another process has.
    pub fn new(
        link: &'a config::Link,
        number: u8,
        boot: u64,
        around: &'a S,
        control: ControlQueue,
    ) -> Result<Self, Failure> {
        // Before the topics: a subscriber that finds a topic sleeps at the doorbell.
        let taken = match around.take_name() {
            Ok(()) => None,
            Err(failure) if failure.kind == Kind::NameHeld => Some(failure),
            Err(failure) => return Err(failure),
        };
        let mut core = LinkCore::new(link, number, boot, around, control)?;
        core.begin();
        let drive = Drive::new(&core);
        let known = drive.recall(around.now());
        let phase = Phase::away(Away::default(), 0);
        let lacks_name = taken.is_some();
        let mut live = LiveLink { core, drive, phase, futile: 0, has_begun: false, lacks_name };
        if let Some(failure) = taken {
            live.leave(Away::for_lack_of_the_name(failure));
            return Ok(live);
        }
        match live.first_line() {
            Ok(Some(line)) => {
                // On a line that was closed meanwhile it may be another sensor, or the same in another mode.
                let known = known.filter(|_| line.is_kept);
                live.open(line, known);
                Ok(live)
            }
            Ok(None) => {
                let words = format!("{}: not connected yet", link.port.name());
                live.leave(Away { words, ..Away::default() });
                Ok(live)
            }
            // Only a hub plays recordings.
            Err(error @ PortError::NotTty) => {
                let failure = around.explain(&error, &link.port);
                let hint = format!("{}, or file:PATH for a recording", failure.hint);
                Err(Failure { hint, ..failure })
            }
            Err(error @ PortError::Short(_)) => Err(around.explain(&error, &link.port)),
            Err(error) => {
                let mut away = Away::default();
                away.learn(&error, around.now(), |error| said(around.explain(error, &link.port)));
                live.leave(away);
                Ok(live)
            }
        }
    }

    /// Returns whether the link waits for its port: it could not be opened, or the connection is not made yet.
    pub fn is_waiting(&self) -> bool {
        !matches!(self.phase, Phase::Open(_))
    }

    /// Returns whether the link waits for its name, because another process publishes under it.
    pub fn lacks_name(&self) -> bool {
        self.lacks_name
    }

    /// Returns whether the link has tried to open its port, with any result, or must not because it lacks its name.
    pub fn has_tried(&self) -> bool {
        match &self.phase {
            Phase::Open(_) => true,
            Phase::Away { away, .. } | Phase::Opening { away, .. } => self.lacks_name || away.error.is_some(),
        }
    }

    /// Does what there is to do after a wait that ended as `woken` says, and returns what to wait for next.
    pub fn turn(&mut self, woken: Woken) -> Wait<'_, S::Line> {
        let (_, until) = self.phase.wait();
        if !std::mem::replace(&mut self.has_begun, true) {
            self.begin();
        } else if self.core.is_over(woken, until) {
            match &mut self.phase {
                Phase::Open(open) => {
                    if let Err(error) = self.drive.turn(&mut self.core, open, woken) {
                        self.lose(&error);
                    }
                }
                Phase::Away { look_at, .. } => {
                    let look_at = *look_at;
                    self.pass(woken);
                    if self.core.around.now() >= look_at {
                        self.reach();
                    }
                }
                Phase::Opening { .. } if woken == Woken::Ready => self.reach(),
                Phase::Opening { .. } => self.pass(woken),
            }
        }
        let (on, until) = self.phase.wait();
        let bound = self.core.next_deadline(until, matches!(on, On::Loss(_)));
        Wait { requests: &self.core.control, on, until: bound }
    }

    /// The hub ends: hands on what was learned.
    pub fn end(mut self) {
        if let Phase::Open(open) = &mut self.phase {
            // If the line goes just now, there is nobody to be told.
            let _ = self.drive.end(&self.core, open);
            self.core.close(&open.session);
        }
        self.core.end();
    }

    /// Returns the line at the start of the hub. `None` if a connection has to be made.
    fn first_line(&mut self) -> Result<Option<OpenLine<S::Line>>, PortError> {
        let (source, baud) = (&self.core.link.port, self.drive.opening_rate(&self.core));
        if let Source::Tcp { .. } = source {
            return Ok(None);
        }
        match self.kept_line(baud) {
            Some(line) => Ok(Some(line)),
            None => self.open_line(baud).transpose(),
        }
    }

    /// Returns the line that the service manager kept open while the previous hub was killed.
    fn kept_line(&self, baud: u32) -> Option<OpenLine<S::Line>> {
        let LinkCore { link, around, .. } = self.core;
        let (name, source) = (&link.name, &link.port);
        let line = around.take_kept(name, source, baud)?;
        tracing::info!("{name}: continues with {}, which the service manager kept open", source.name());
        Some(OpenLine { line, has_rate: true, is_kept: true })
    }

    /// Opens the port at `baud`. A search leaves out a rate that the port cannot have, so it then gets a port at
    /// another rate.
    fn open_line(&mut self, baud: u32) -> Option<Result<OpenLine<S::Line>, PortError>> {
        let LinkCore { link, around, .. } = self.core;
        let (opened, has_rate) = match around.open(&link.port, baud) {
            Some(Err(error @ PortError::Rate { .. })) if link.family().is_none() => {
                self.drive.refuse(&self.core, baud, &error);
                (around.open(&link.port, SLOWEST), false)
            }
            opened => (opened, true),
        };
        opened.map(|opened| opened.map(|line| OpenLine { line, has_rate, is_kept: false }))
    }

    /// Tries to open the port; what becomes of it is known at once, or when the wait for it is over.
    fn reach(&mut self) {
        let (link, around) = (self.core.link, self.core.around);
        let mut away = self.phase.take_away();
        if self.lacks_name
            && let Err(failure) = around.take_name()
        {
            return self.leave(Away::for_lack_of_the_name(failure));
        }
        let baud = self.drive.opening_rate(&self.core);
        // While the link had no name, it has not taken the line that was kept for it.
        let kept = if std::mem::take(&mut self.lacks_name) { self.kept_line(baud) } else { None };
        match kept.map(Ok).or_else(|| self.open_line(baud)) {
            Some(Ok(line)) => {
                self.open(line, None);
                self.begin();
            }
            Some(Err(error)) => {
                away.learn(&error, around.now(), |error| said(around.explain(error, &link.port)));
                self.leave(away);
            }
            None => self.phase = Phase::Opening { away, until: around.now() + STILL_AWAY },
        }
    }

    /// Starts a session on an open line. It may continue with the stream of a scanner whose identity is `known`.
    fn open(&mut self, OpenLine { line, has_rate, .. }: OpenLine<S::Line>, known: Option<Identity>) {
        let core = &mut self.core;
        let now = core.around.now();
        core.around.keep(&core.link.name, &line);
        core.diagnosis.open(line.device());
        core.output.topics.set_flags(if line.is_simulated() { Flags::SIMULATED } else { 0 });
        let (family, memory) = (core.link.family(), self.drive.memory(core));
        let mut session = PortSession::begin(family, &core.link.settings(), memory, now);
        core.output.topics.set_family(family);
        if !has_rate {
            session.reject_rate(now);
        }
        if let Some(known) = known {
            session.restore_identity(known);
        }
        if let Some((model, beams)) = self.drive.take_beams() {
            session.restore_beams(model, beams);
        }
        if let Some(rate) = self.drive.last_rate(core) {
            tracing::debug!(
                "{}: the search begins at {} baud, where the scanner was found",
                core.link.name,
                rate.baud
            );
            session.hint_rate(rate);
        }
        if core.control.is_paused() {
            session.control(Control::Pause, now);
        }
        self.phase = Phase::Open(Box::new(Open::new(line, session, core.link.max_rate(), now)));
    }

    /// A session begins, if there is a line.
    fn begin(&mut self) {
        if let Phase::Open(open) = &mut self.phase
            && let Err(error) = self.drive.begin(&mut self.core, open)
        {
            self.lose(&error);
        }
    }

    /// The line is gone, as `error` says.
    fn lose(&mut self, error: &io::Error) {
        let source = &self.core.link.port;
        let Phase::Open(open) = std::mem::replace(&mut self.phase, Phase::away(Away::default(), 0)) else {
            return;
        };
        self.core.close(&open.session);
        let heard = open.session.account().read > 0;
        // Before the port is looked for: it could not be opened while this holds it.
        drop(open);
        self.core.around.release(&self.core.link.name);
        self.core.stats.reconnects += 1;
        self.futile = if heard { 0 } else { self.futile + 1 };
        let words = format!("{} went away: {error}", source.name());
        self.core.diagnosis.note_empty_connection(if heard { String::new() } else { words.clone() });
        self.leave(Away { refused: self.futile, ..Away::for_lack_of_a_port(words) });
    }

    /// The port is away: says so, and looks for it later.
    fn leave(&mut self, away: Away) {
        self.core.diagnosis.end_session();
        self.core.show(None, State::Absent, &away.words);
        let look_at = self.core.around.now() + away.pause();
        let until = look_at.min(self.core.next_status());
        self.phase = Phase::Away { away, look_at, until };
    }

    /// A wait without a port is over.
    fn pass(&mut self, woken: Woken) {
        let core = &mut self.core;
        let (Phase::Away { away, .. } | Phase::Opening { away, .. }) = &self.phase else { return };
        if woken == Woken::Request {
            core.handle_requests(Flow::Away);
        } else {
            core.show(None, State::Absent, &away.words);
        }
        match &mut self.phase {
            Phase::Open(_) => {}
            Phase::Away { look_at, until, .. } => *until = (*look_at).min(core.next_status()),
            Phase::Opening { until, .. } => *until = core.around.now() + STILL_AWAY,
        }
    }
}

impl<L: Line> Phase<L> {
    fn away(away: Away, at: Nanos) -> Phase<L> {
        Phase::Away { away, look_at: at, until: at }
    }

    /// What to wait for, and until when.
    fn wait(&self) -> (On<'_, L>, Nanos) {
        match self {
            Phase::Open(open) => open.wait(),
            Phase::Away { until, .. } => (On::Nothing, *until),
            Phase::Opening { until, .. } => (On::Opening, *until),
        }
    }

    /// Why the port was away until now.
    fn take_away(&mut self) -> Away {
        match self {
            Phase::Open(_) => Away::default(),
            Phase::Away { away, .. } | Phase::Opening { away, .. } => std::mem::take(away),
        }
    }
}

/// Why a port is away, for how many looks, and in which words.
#[derive(Default)]
struct Away {
    error: Option<PortError>,
    words: String,
    /// When the words were found.
    since: Nanos,
    /// Looks in a row that found something that cannot be opened, or went again without a byte.
    refused: u32,
}

impl Away {
    /// There is no port, which `words` say: that the next look finds none is no news.
    fn for_lack_of_a_port(words: String) -> Away {
        Away { error: Some(PortError::Missing), words, ..Away::default() }
    }

    /// The link must not open its port, because another process has its name, as `failure` says.
    fn for_lack_of_the_name(failure: Failure) -> Away {
        Away { words: said(failure), ..Away::default() }
    }

    /// The port cannot be opened because of `error`, which `explain` says in words.
    fn learn(&mut self, error: &PortError, now: Nanos, explain: impl FnOnce(&PortError) -> String) {
        let is_missing = *error == PortError::Missing;
        self.refused = if is_missing { 0 } else { self.refused + 1 };
        let is_news = self.error.as_ref() != Some(error);
        // Another process may hold it now than the one that was named.
        if is_news || (!is_missing && now >= self.since + STALE) {
            self.words = explain(error);
            self.since = now;
        }
        self.error = Some(error.clone());
    }

    /// How long to wait before the next look: what is not there is looked for by name only, what is there and cannot be
    /// opened is left alone for longer each time. The first looks come soon, for udev gives a new device its group.
    fn pause(&self) -> Nanos {
        LOOK << self.refused.saturating_sub(1).min(LONGEST_PAUSE)
    }
}

/// A failure as a line of a status and of a log.
fn said(failure: Failure) -> String {
    format!("{}; {}", failure.message, failure.hint)
}

/// Every port can have this rate, in bits per second.
const SLOWEST: u32 = 9_600;
/// Between two looks for a port that is away.
const LOOK: Nanos = 100 * MILLIS;
/// Times that the pause between two looks doubles.
const LONGEST_PAUSE: u32 = 4;
/// A status is due so often while a connection is being made.
const STILL_AWAY: Nanos = 1_000 * MILLIS;
/// After so long the circumstances of a refusal are looked for again.
const STALE: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn why_it_is_away_is_looked_for_once_per_change() {
        let source = Source::Tty("/dev/no-such-port".into());
        let explain = |error: &PortError| said(error.explain(&source));
        let mut away = Away::for_lack_of_a_port("it went".to_owned());
        away.learn(&PortError::Missing, 1, explain);
        assert_eq!((away.words.as_str(), away.pause()), ("it went", LOOK));
        away.learn(&PortError::Busy, 2, explain);
        assert!(away.words.contains("in use by another process; stop it first"), "{}", away.words);
        assert_eq!((away.since, away.pause()), (2, LOOK));
        for look in 3..20 {
            away.learn(&PortError::Busy, look, explain);
        }
        assert_eq!((away.since, away.pause()), (2, 16 * LOOK));
        away.learn(&PortError::Busy, 2 + STALE, explain);
        assert_eq!(away.since, 2 + STALE);
        away.learn(&PortError::Missing, 3 + STALE, explain);
        assert!(away.words.contains("no such port"), "{}", away.words);
        assert_eq!(away.pause(), LOOK);
    }
}
