//! The life of a port: streamed from while it is there, looked for while it is away, taken back when it returns under
//! its name, whatever device that is then. Looking costs next to nothing; why it is away is said once, not at each look.

use std::os::fd::AsFd;
use std::sync::atomic::AtomicBool;

use lms::{Control, Identity, MILLIS, Nanos, Session};
use port::{Port, Refusal, Source, clock};
use rustix::event::PollFlags;
use schema::{Failure, Flags, Kind, State};

use crate::control::Flow;
use crate::last_rate::LastRate;
use crate::link::{LinkThread, Woken};
use crate::memory::Memory;

impl LinkThread<'_> {
    /// Streams from the port, and takes it back whenever it was away. `report` is called once, as in
    /// [`LinkThread::run`].
    pub(crate) fn attend(&mut self, report: impl FnOnce(Result<(), Failure>)) {
        let link = self.link;
        let mut away = Away::default();
        let (mut opened, mut is_kept) = (None, false);
        if let Source::Tcp { .. } = link.port {
            away = Away::for_lack_of_a_port(format!("{}: not connected yet", link.port.name()));
        } else {
            match self.take_over() {
                Ok((port, kept)) => {
                    is_kept = kept;
                    opened = Some(port);
                }
                // Only a hub plays recordings.
                Err(failure) if failure.kind == Kind::PortNotTty => {
                    let hint = format!("{}, or file:PATH for a recording", failure.hint);
                    return report(Err(Failure { hint, ..failure }));
                }
                Err(failure) if failure.kind != Kind::PortMissing => return report(Err(failure)),
                Err(failure) => away = Away::for_lack_of_a_port(said(failure)),
            }
        }
        report(Ok(()));
        let memory = Memory::open(self.around.root, &link.name, &link.port.name());
        // On a line that was closed meanwhile it may be another sensor, or the same in another mode.
        let mut known = memory.recall(clock::now()).filter(|_| is_kept);
        self.memory = Some(memory);
        if let Source::Tty(_) = link.port {
            self.last_rate = Some(LastRate::open(self.around.state, &link.name, &link.port.name()));
        }
        // Times in a row that it was there and went without a byte.
        let mut futile = 0;
        loop {
            if let Some(port) = opened.take() {
                if let Port::Tty(_) = port {
                    self.around.service.keep(&link.name, &port);
                }
                let (heard, end) = self.stay(&port, known.take());
                let Err(error) = end else { return };
                self.around.service.forget(&link.name);
                self.account.reconnects += 1;
                futile = if heard { 0 } else { futile + 1 };
                let words = format!("{} went away: {error}", link.port.name());
                self.doubt = if heard { String::new() } else { words.clone() };
                away = Away { refused: futile, ..Away::for_lack_of_a_port(words) };
            }
            self.forget();
            self.show(None, State::Absent, &away.words);
            let look_at = clock::now() + away.pause();
            while clock::now() < look_at {
                match self.wait(None, look_at.min(self.next_status)) {
                    Woken::Stop => return,
                    Woken::Order => self.obey(Flow::Away),
                    Woken::Ready | Woken::Timeout => self.show(None, State::Absent, &away.words),
                }
            }
            match self.reach(&away.words) {
                None => return,
                Some(Ok(port)) => opened = Some(port),
                Some(Err(refusal)) => away.learn(refusal, &link.port, clock::now()),
            }
        }
    }

    /// The port at the hub's start, and whether it is the one that a killed hub had and somebody kept, with what lies in it.
    fn take_over(&self) -> Result<(Port, bool), Failure> {
        let (link, service) = (self.link, self.around.service);
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

    /// Tries to open the port, however long that takes; nothing if the hub shall end meanwhile.
    fn reach(&mut self, words: &str) -> Option<Result<Port, Refusal>> {
        let link = self.link;
        let dial = match Port::dial(&link.port) {
            None => return Some(Port::attempt(&link.port, link.baud.rate(), &AtomicBool::new(false))),
            Some(Err(refusal)) => return Some(Err(refusal)),
            Some(Ok(dial)) => dial,
        };
        loop {
            match self.wait(Some((dial.as_fd(), PollFlags::IN)), clock::now() + STILL_AWAY) {
                Woken::Stop => return None,
                Woken::Order => self.obey(Flow::Away),
                Woken::Ready => return Some(dial.finish()),
                Woken::Timeout => self.show(None, State::Absent, words),
            }
        }
    }

    /// A session on `port`, until the hub shall end; an error says that the port is gone. Whether a byte came.
    /// It may go on with a stream of a sensor of which something is `known`.
    fn stay(&mut self, port: &Port, known: Option<Identity>) -> (bool, std::io::Result<()>) {
        self.topics.set_flags(if port.simulated() { Flags::SIMULATED } else { 0 });
        let mut session = Session::new(self.settings(false), clock::now());
        if let Some(known) = known {
            session.recall(known);
        }
        if let Some(baud) = self.last_rate.as_ref().and_then(LastRate::baud) {
            session.seek_first(baud);
        }
        if self.orders.is_paused() {
            session.control(Control::Pause, clock::now());
        }
        let end = self.stream(port, &mut session);
        (self.is_flooded, self.is_behind) = (false, false);
        self.account.close(&session);
        (session.tally().read > 0, end)
    }
}

/// Why a port is away, for how many looks, and in which words.
#[derive(Default)]
struct Away {
    refusal: Option<Refusal>,
    words: String,
    /// When the words were found.
    since: Nanos,
    /// Looks in a row that found something that cannot be opened, or went again without a byte.
    refused: u32,
}

impl Away {
    /// There is no port, which `words` say: that the next look finds none is no news.
    fn for_lack_of_a_port(words: String) -> Away {
        Away { refusal: Some(Refusal::Missing), words, ..Away::default() }
    }

    /// The port cannot be opened because of `refusal`.
    fn learn(&mut self, refusal: Refusal, source: &Source, now: Nanos) {
        let is_missing = refusal == Refusal::Missing;
        self.refused = if is_missing { 0 } else { self.refused + 1 };
        let is_news = self.refusal.as_ref() != Some(&refusal);
        // Another process may hold it now than the one that was named.
        if is_news || (!is_missing && now >= self.since + STALE) {
            self.words = said(refusal.explain(source));
            self.since = now;
        }
        self.refusal = Some(refusal);
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
        away.learn(Refusal::Missing, &source, 1);
        assert_eq!((away.words.as_str(), away.pause()), ("it went", LOOK));
        away.learn(Refusal::Busy, &source, 2);
        assert!(away.words.contains("in use by another process; stop it first"), "{}", away.words);
        assert_eq!((away.since, away.pause()), (2, LOOK));
        for look in 3..20 {
            away.learn(Refusal::Busy, &source, look);
        }
        assert_eq!((away.since, away.pause()), (2, 16 * LOOK));
        away.learn(Refusal::Busy, &source, 2 + STALE);
        assert_eq!(away.since, 2 + STALE);
        away.learn(Refusal::Missing, &source, 3 + STALE);
        assert!(away.words.contains("no such port"), "{}", away.words);
        assert_eq!(away.pause(), LOOK);
    }
}
