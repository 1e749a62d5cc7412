//! The session on a link's line, whatever family its scanner is of: the one list of families in the hub. What all of them
//! have is [`line::Session`]; what only one has is asked of that one. Refuses to know what is made of what they say.

use config::{Link, Scanner};
use line::{Account, Control, Nanos, Output, State};
use lms::variant::Baud;
use lms::{Identity, Settings};
use port::Source;

/// A session of one of the families.
#[expect(clippy::large_enum_variant, reason = "there is one per open port")]
pub(crate) enum Driver {
    /// SICK LMS 2xx.
    Lms(lms::Session),
    /// LDROBOT.
    Ld(ld::Session),
}

/// What a session hands out.
pub(crate) enum Heard<'a> {
    /// A telegram.
    Lms(lms::session::Received<'a>),
    /// Packets, or a turn that they complete.
    Ld(ld::Heard<'a>),
}

/// Says the same of whatever family it is.
macro_rules! each {
    ($driver:expr, $session:ident => $said:expr) => {
        match $driver {
            Driver::Lms($session) => $said,
            Driver::Ld($session) => $said,
        }
    };
}

impl Driver {
    /// A session on the port of `link`, which is open at its rate; to a recording nobody talks.
    pub(crate) fn new(link: &Link, is_recording: bool, now: Nanos) -> Driver {
        if let Scanner::Ld { .. } = link.scanner {
            return Driver::Ld(ld::Session::new(link.ld_settings(), now));
        }
        let fixed_rate = matches!(link.port, Source::Tcp { .. });
        let settings =
            Settings { variant: link.variant, baud: link.baud, listen_only: is_recording, fixed_rate };
        Driver::Lms(lms::Session::new(settings, now))
    }

    /// What a session before this one knew of the scanner a moment ago. To be said before anything is read.
    pub(crate) fn recall(&mut self, known: Identity) {
        if let Driver::Lms(session) = self {
            session.recall(known);
        }
    }

    /// The rate that is asked first where the scanner has to be sought. To be said before anything is read.
    pub(crate) fn seek_first(&mut self, rate: u32) {
        if let Driver::Lms(session) = self
            && let Some(baud) = Baud::ALL.into_iter().find(|baud| baud.rate() == rate)
        {
            session.seek_first(baud);
        }
    }

    /// The rate at which a scanner that was sought answered; nothing if none had to be sought.
    pub(crate) fn found_at(&self) -> Option<u32> {
        match self {
            Driver::Lms(session) => session.found_at().map(Baud::rate),
            Driver::Ld(_) => None,
        }
    }

    /// What the next session would have to ask if this one ended now; nothing if that is not known.
    pub(crate) fn identity(&self) -> Option<Identity> {
        match self {
            Driver::Lms(session) => session.identity(),
            Driver::Ld(_) => None,
        }
    }
}

impl line::Session for Driver {
    type Heard<'a> = Heard<'a>;
    type Why = ();

    fn spare(&mut self) -> &mut [u8] {
        each!(self, session => session.spare())
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        each!(self, session => session.commit(now, len))
    }

    fn may_leave(&self) -> bool {
        each!(self, session => session.may_leave())
    }

    fn leave(&mut self, now: Nanos, waiting: usize) -> bool {
        each!(self, session => session.leave(now, waiting))
    }

    fn handle_timeout(&mut self, now: Nanos) {
        each!(self, session => session.handle_timeout(now))
    }

    fn control(&mut self, control: Control, now: Nanos) {
        each!(self, session => session.control(control, now))
    }

    fn transmitted(&mut self, now: Nanos) {
        each!(self, session => session.transmitted(now))
    }

    fn poll_output(&mut self) -> Output<Heard<'_>, ()> {
        match self {
            Driver::Lms(session) => session.poll_output().map(Heard::Lms),
            Driver::Ld(session) => session.poll_output().map(Heard::Ld),
        }
    }

    fn state(&self) -> State {
        each!(self, session => session.state())
    }

    fn rate(&self) -> u32 {
        each!(self, session => session.rate())
    }

    fn account(&self) -> Account {
        each!(self, session => session.account())
    }
}
