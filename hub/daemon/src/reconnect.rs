//! The life of a port: streamed from while it is there, looked for while it is away, taken back when it returns under
//! its name, whatever device that is then. Looking costs next to nothing; why it is away is said once, not at each look.

use std::os::fd::AsFd;
use std::sync::atomic::AtomicBool;

use lms::{Control, Identity, MILLIS, Nanos, Session};
use port::{Port, PortError, Source, clock};
use rustix::event::PollFlags;
use schema::{Failure, Flags, Kind, State};

use crate::control::Flow;
use crate::drive::Driver;
use crate::link::{LinkThread, Woken};

/// Streams from the port of `link`, and takes it back whenever it was away, until the hub ends. `report` is called once, when
/// it is clear whether the link can work: an absent port can, one that is busy, forbidden or no tty cannot.
pub(crate) fn run(mut link: LinkThread<'_>, report: impl FnOnce(Result<(), Failure>)) {
    link.begin();
    match first_port(&link) {
        Ok(found) => {
            report(Ok(()));
            let driver = Driver::new(&link);
            let mut reconnect = Reconnect { link, driver };
            reconnect.run(found);
            reconnect.link.end();
        }
        Err(failure) => {
            report(Err(failure));
            link.end();
        }
    }
}

/// The port at the hub's start.
enum Found {
    Open {
        port: Port,
        /// It is the one that a killed hub had and somebody kept, with what lies in it.
        is_kept: bool,
    },
    Away(Away),
}

/// A link whose other end is a port that comes and goes.
struct Reconnect<'a> {
    link: LinkThread<'a>,
    driver: Driver,
}

/// The port of `link` as it is now; a connection is not made yet.
fn first_port(link: &LinkThread<'_>) -> Result<Found, Failure> {
    if let Source::Tcp { .. } = link.link.port {
        let words = format!("{}: not connected yet", link.link.port.name());
        return Ok(Found::Away(Away::for_lack_of_a_port(words)));
    }
    match take_over(link) {
        Ok((port, is_kept)) => Ok(Found::Open { port, is_kept }),
        // Only a hub plays recordings.
        Err(failure) if failure.kind == Kind::PortNotTty => {
            let hint = format!("{}, or file:PATH for a recording", failure.hint);
            Err(Failure { hint, ..failure })
        }
        Err(failure) if failure.kind != Kind::PortMissing => Err(failure),
        Err(failure) => Ok(Found::Away(Away::for_lack_of_a_port(said(failure)))),
    }
}

/// The tty of `link`, and whether it was kept for this hub.
fn take_over(link: &LinkThread<'_>) -> Result<(Port, bool), Failure> {
    let (service, link) = (link.around.service, link.link);
    let mut adopted = None;
    while let Some(line) = service.take(&link.name) {
        match Port::adopt(line, &link.port, link.baud.rate()).filter(|_| adopted.is_none()) {
            Some(port) => adopted = Some(port),
            // One that hung up: whoever keeps it would have it handed over again.
            None => service.forget(&link.name),
        }
    }
    if let Some(port) = adopted {
        tracing::info!(
            "{}: continues with {}, which the service manager kept open",
            link.name,
            link.port.name()
        );
        return Ok((port, true));
    }
    Port::open(&link.port, link.baud.rate(), &AtomicBool::new(false)).map(|port| (port, false))
}

impl Reconnect<'_> {
    /// Streams from the port, and takes it back whenever it was away.
    fn run(&mut self, found: Found) {
        let (mut opened, mut away, is_kept) = match found {
            Found::Open { port, is_kept } => (Some(port), Away::default(), is_kept),
            Found::Away(away) => (None, away, false),
        };
        let source = &self.link.link.port;
        // On a line that was closed meanwhile it may be another sensor, or the same in another mode.
        let mut known = self.driver.recall().filter(|_| is_kept);
        // Times in a row that it was there and went without a byte.
        let mut futile = 0;
        loop {
            if let Some(port) = opened.take() {
                if let Port::Tty(_) = port {
                    self.link.around.service.keep(&self.link.link.name, &port);
                }
                let (heard, end) = self.stay(&port, known.take());
                let Err(error) = end else { return };
                self.link.around.service.forget(&self.link.link.name);
                self.link.stats.reconnects += 1;
                futile = if heard { 0 } else { futile + 1 };
                let words = format!("{} went away: {error}", source.name());
                self.link.diagnosis.doubt(if heard { String::new() } else { words.clone() });
                away = Away { refused: futile, ..Away::for_lack_of_a_port(words) };
            }
            self.link.diagnosis.forget();
            self.link.show(None, State::Absent, &away.words);
            let look_at = clock::now() + away.pause();
            while clock::now() < look_at {
                match self.link.wait(None, look_at.min(self.link.next_status())) {
                    Woken::Stop => return,
                    Woken::Request => self.link.handle_requests(Flow::Away),
                    Woken::Ready | Woken::Timeout => {
                        self.link.show(None, State::Absent, &away.words);
                    }
                }
            }
            match self.reach(&away.words) {
                None => return,
                Some(Ok(port)) => opened = Some(port),
                Some(Err(error)) => away.learn(error, source, clock::now()),
            }
        }
    }

    /// Tries to open the port, however long that takes; nothing if the hub shall end meanwhile.
    fn reach(&mut self, words: &str) -> Option<Result<Port, PortError>> {
        let link = self.link.link;
        let dial = match Port::dial(&link.port) {
            None => return Some(Port::attempt(&link.port, link.baud.rate(), &AtomicBool::new(false))),
            Some(Err(error)) => return Some(Err(error)),
            Some(Ok(dial)) => dial,
        };
        loop {
            match self.link.wait(Some((dial.as_fd(), PollFlags::IN)), clock::now() + STILL_AWAY) {
                Woken::Stop => return None,
                Woken::Request => self.link.handle_requests(Flow::Away),
                Woken::Ready => return Some(dial.finish()),
                Woken::Timeout => {
                    self.link.show(None, State::Absent, words);
                }
            }
        }
    }

    /// A session on `port`, until the hub shall end; an error says that the port is gone. Whether a byte came.
    /// It may go on with a stream of a sensor of which something is `known`.
    fn stay(&mut self, port: &Port, known: Option<Identity>) -> (bool, std::io::Result<()>) {
        let link = &mut self.link;
        link.output.topics.set_flags(if port.simulated() { Flags::SIMULATED } else { 0 });
        let mut session = Session::new(link.settings(false), clock::now());
        if let Some(known) = known {
            session.recall(known);
        }
        if let Some(baud) = self.driver.last_rate() {
            session.seek_first(baud);
        }
        if link.control.is_paused() {
            session.control(Control::Pause, clock::now());
        }
        let end = self.driver.stream(link, port, &mut session);
        link.diagnosis.end_flood();
        link.stats.close(&session);
        (session.tally().read > 0, end)
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

    /// The port cannot be opened because of `error`.
    fn learn(&mut self, error: PortError, source: &Source, now: Nanos) {
        let is_missing = error == PortError::Missing;
        self.refused = if is_missing { 0 } else { self.refused + 1 };
        let is_news = self.error.as_ref() != Some(&error);
        // Another process may hold it now than the one that was named.
        if is_news || (!is_missing && now >= self.since + STALE) {
            self.words = said(error.explain(source));
            self.since = now;
        }
        self.error = Some(error);
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
        let mut away = Away::for_lack_of_a_port("it went".to_owned());
        away.learn(PortError::Missing, &source, 1);
        assert_eq!((away.words.as_str(), away.pause()), ("it went", LOOK));
        away.learn(PortError::Busy, &source, 2);
        assert!(away.words.contains("in use by another process; stop it first"), "{}", away.words);
        assert_eq!((away.since, away.pause()), (2, LOOK));
        for look in 3..20 {
            away.learn(PortError::Busy, &source, look);
        }
        assert_eq!((away.since, away.pause()), (2, 16 * LOOK));
        away.learn(PortError::Busy, &source, 2 + STALE);
        assert_eq!(away.since, 2 + STALE);
        away.learn(PortError::Missing, &source, 3 + STALE);
        assert!(away.words.contains("no such port"), "{}", away.words);
        assert_eq!(away.pause(), LOOK);
    }
}
