//! The list of the families of scanners whose heads turn: who wants to talk to any of them, or to offer them all, needs no
//! other one. Refuses to know what a family speaks.

use std::fmt;

use crate::line::family::{Condition, Features, Model, Turning as _, Wanted};
use crate::line::{Heard, Output, Turn};
use crate::{ld, line, rplidar};
use schema::{Family, Nanos};

/// Declares the families. A line has the name and the module of one.
macro_rules! families {
    ($($Family:ident $family:ident,)*) => {
        /// A session with a scanner of one of the families.
        #[expect(clippy::large_enum_variant, reason = "there is one per open port")]
        #[derive(Clone, Debug)]
        pub enum Session {
            $(#[doc = concat!("Of family ", stringify!($family), ".")] $Family($family::Session),)*
        }

        /// Why a session is not where it should be; its words are the family's.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub enum Trouble {
            $(#[doc = concat!("Of family ", stringify!($family), ".")] $Family($family::Trouble),)*
        }

        /// Returns what may be set for a scanner of `family`; nothing for an LMS, whose settings are its own.
        pub const fn features(family: Family) -> Option<&'static Features> {
            match family {
                Family::Lms => None,
                $(Family::$Family => Some(&$family::Session::FEATURES),)*
            }
        }

        impl Session {
            /// A session with a scanner of `family` on a port that is open at the rate of the model that is `wanted`; nothing
            /// with an LMS.
            pub fn begin(family: Family, wanted: Wanted, now: Nanos) -> Option<Session> {
                match family {
                    Family::Lms => None,
                    $(Family::$Family => Some(Session::$Family($family::Session::begin(wanted, now))),)*
                }
            }

            /// What it talks to.
            pub fn family(&self) -> Family {
                match self { $(Session::$Family(_) => Family::$Family,)* }
            }
        }

        /// The trouble of a session of any family.
        fn trouble(session: &Session) -> Option<Trouble> {
            match session {
                $(Session::$Family(session) => line::Session::trouble(session).map(Trouble::$Family),)*
            }
        }

        impl fmt::Display for Trouble {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self { $(Trouble::$Family(trouble) => trouble.fmt(f),)* }
            }
        }

        /// Says the same of whatever family it is.
        macro_rules! each {
            ($of:expr, $session:ident => $said:expr) => {
                match $of { $(Session::$Family($session) => $said,)* }
            };
        }
    };
}

families! {
    Ld ld,
    Rplidar rplidar,
}

/// What a scanner said of itself when it was asked, in words.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Introduction {
    /// Firmware and numbers.
    pub identity: String,
    /// How it says that it is; empty if it did not say.
    pub health: String,
    /// The same as a verdict.
    pub condition: Condition,
}

impl Session {
    /// What is at the other end, as far as that is known: of models that cannot be told apart, one.
    pub fn model(&self) -> Option<Model> {
        each!(self, session => line::family::Turning::model(session))
    }

    /// Beams of the grid that turns are for; nothing before it is known what is at the other end.
    pub fn beams(&self) -> Option<usize> {
        each!(self, session => line::family::Turning::beams(session))
    }

    /// The turn that is being measured, as if it ended with the points that are known, once [`line::Session::poll_output`] wants
    /// to wait; nothing between turns.
    pub fn begun(&self) -> Option<Turn<'_>> {
        each!(self, session => line::family::Turning::begun(session))
    }

    /// What it turned out to be where another model is wanted.
    pub fn other_model(&self) -> Option<Model> {
        each!(self, session => line::family::Turning::other_model(session))
    }

    /// What has to be named before it can be read where nobody can be asked.
    pub fn lacks(&self) -> Option<&'static str> {
        each!(self, session => line::family::Turning::lacks(session))
    }

    /// What it is in a few words, the model first: how it measures, and its firmware.
    pub fn kind(&self) -> Option<String> {
        let mut text = self.model()?.name.to_uppercase();
        each!(self, session => session.specify(&mut text));
        Some(text)
    }

    /// What the scanner said of itself, and how it says that it is; nothing before it was asked all that changes nothing, and
    /// nothing of one that is never asked.
    pub fn introduction(&self) -> Option<Introduction> {
        let (mut identity, mut health) = (String::new(), String::new());
        let condition = each!(self, session => session.introduction(&mut identity, &mut health))?;
        Some(Introduction { identity, health, condition })
    }

    /// When the last packet that was handed out was measured, by the scanner's own clock, if it has one.
    pub fn scanner_time(&self) -> Option<Nanos> {
        each!(self, session => line::family::Turning::scanner_time(session))
    }

    /// The packets that are handed out next are suspect for these `reasons` too, bits of [`line::suspect`].
    pub fn doubt(&mut self, reasons: u8) {
        each!(self, session => line::family::Turning::doubt(session, reasons));
    }
}

impl line::Session for Session {
    type Heard<'a> = Heard<'a>;
    type Trouble = Trouble;

    crate::delegate_session!(each);

    fn poll_output(&mut self) -> Output<Heard<'_>> {
        each!(self, session => session.poll_output())
    }

    fn trouble(&self) -> Option<Trouble> {
        trouble(self)
    }
}
