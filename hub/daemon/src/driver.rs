//! The session on a link's line, whatever family its scanner is of. What all of them have is [`line::Session`]; what only
//! an LMS has is asked of that one, what only scanners whose heads turn have, of those. Refuses to know what is made of
//! what they say.

use std::fmt;

use config::{Link, Scanner};
use port::Source;
use scanhub_drivers::line::Output;
use scanhub_drivers::line::family::Model;
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::lms::{Identity, Settings};
use scanhub_drivers::{line, lms, scanner};
use schema::Nanos;

use crate::early::Begun;
use crate::learned::KnownRate;

/// A session of one of the families.
#[expect(clippy::large_enum_variant, reason = "there is one per open port")]
pub(crate) enum Driver {
    /// With an LMS.
    Lms(lms::Session),
    /// With a scanner whose head turns.
    Turning(scanner::Session),
}

/// What a session hands out.
pub(crate) enum Heard<'a> {
    /// A telegram of an LMS.
    Lms(lms::session::Received<'a>),
    /// Packets of a scanner whose head turns, or a turn that they complete.
    Turning(line::Heard<'a>),
}

/// Why a session is not where it should be; its words are the family's.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Trouble {
    Lms(lms::Trouble),
    Turning(scanner::Trouble),
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::Lms(trouble) => trouble.fmt(f),
            Trouble::Turning(trouble) => trouble.fmt(f),
        }
    }
}

/// Says the same of whatever session it is.
macro_rules! each {
    ($driver:expr, $session:ident => $said:expr) => {
        match $driver {
            Driver::Lms($session) => $said,
            Driver::Turning($session) => $said,
        }
    };
}

impl Driver {
    /// A session on the port of `link`, which is open at its rate; to a recording nobody talks.
    pub(crate) fn new(link: &Link, is_recording: bool, now: Nanos) -> Driver {
        if let Scanner::Turning(turning) = &link.scanner {
            let fixed_rate = !matches!(link.port, Source::Tty(_));
            let wanted = turning.wanted(fixed_rate, is_recording);
            if let Some(session) = scanner::Session::begin(turning.family, wanted, now) {
                return Driver::Turning(session);
            }
        }
        let fixed_rate = matches!(link.port, Source::Tcp { .. });
        let settings = Settings {
            variant: link.variant,
            baud: link.baud,
            listen_only: is_recording,
            fixed_rate,
            keep_baud: link.is_baud_set,
        };
        Driver::Lms(lms::Session::new(settings, now))
    }

    /// The session, if it is one with an LMS.
    pub(crate) fn lms(&self) -> Option<&lms::Session> {
        if let Driver::Lms(session) = self { Some(session) } else { None }
    }

    /// What it is in words, where its head turns; nothing before that is known.
    pub(crate) fn kind(&self) -> Option<String> {
        if let Driver::Turning(session) = self { session.kind() } else { None }
    }

    /// From now on a telegram of an LMS is looked at `pieces` times while it arrives. A turn comes in packets anyway.
    pub(crate) fn look_in(&mut self, pieces: u8) {
        if let Driver::Lms(session) = self {
            session.look_in(pieces);
        }
    }

    /// The scan that is arriving, once nothing is left to be drained.
    pub(crate) fn begun(&self) -> Option<Begun<'_>> {
        match self {
            Driver::Lms(session) => session.begun().map(Begun::Telegram),
            Driver::Turning(session) => session.begun().map(Begun::Turn),
        }
    }

    /// What it turned out to be, where its head turns, if another model is configured.
    pub(crate) fn other_model(&self) -> Option<Model> {
        if let Driver::Turning(session) = self { session.other_model() } else { None }
    }

    /// What is at the other end, where its head turns, and the beams of its scans; nothing before that is known.
    pub(crate) fn model(&self) -> Option<(Model, usize)> {
        let Driver::Turning(session) = self else { return None };
        session.model().zip(session.beams())
    }

    /// Packets of a scanner whose head turns that are handed out next are suspect for these `reasons` too.
    pub(crate) fn doubt(&mut self, reasons: u8) {
        if let Driver::Turning(session) = self {
            session.doubt(reasons);
        }
    }

    /// What a session before this one knew of the scanner a moment ago. To be said before anything is read.
    pub(crate) fn recall(&mut self, known: Identity) {
        if let Driver::Lms(session) = self {
            session.recall(known);
        }
    }

    /// Restores the rate at which an earlier session found the scanner. Call it before the first read.
    pub(crate) fn recall_rate(&mut self, known: KnownRate) {
        if let Driver::Lms(session) = self
            && let Some(baud) = Baud::of_rate(known.baud)
        {
            session.seek_first(baud);
            session.recall_silent_switches(known.silent_switches);
        }
    }

    /// Returns the rate at which the session found the scanner, for the next search. `None` if there was no search.
    pub(crate) fn known_rate(&self) -> Option<KnownRate> {
        let session = self.lms()?;
        let baud = session.found_at()?.rate();
        Some(KnownRate { baud, silent_switches: session.silent_switches() })
    }

    /// What the next session would have to ask if this one ended now; nothing if that is not known.
    pub(crate) fn identity(&self) -> Option<Identity> {
        self.lms()?.identity()
    }
}

impl line::Session for Driver {
    type Heard<'a> = Heard<'a>;
    type Trouble = Trouble;

    scanhub_drivers::delegate_session!(each);

    fn poll_output(&mut self) -> Output<Heard<'_>> {
        match self {
            Driver::Lms(session) => session.poll_output().map(Heard::Lms),
            Driver::Turning(session) => session.poll_output().map(Heard::Turning),
        }
    }

    fn trouble(&self) -> Option<Trouble> {
        match self {
            Driver::Lms(session) => session.trouble().map(Trouble::Lms),
            Driver::Turning(session) => session.trouble().map(Trouble::Turning),
        }
    }
}
