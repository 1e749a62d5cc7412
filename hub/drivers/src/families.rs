//! List of all scanner families, and a [`Session`] with a scanner of any family. Code that supports every family needs
//! only this module.

use std::fmt;

use crate::line::family::{Features, Model, Probe};
use crate::line::{
    self, Action, Control, DeviceInfo, Identity, KnownRate, Notice, RawScan, ReceivedTelegram, SessionStats,
    State,
};
use crate::lms::IdentityProbe;
use crate::settings::{Refusal, Settings, SettingsRequest};
use crate::{ld, lms, rplidar, search};
use scanhub_schema::{Counters, Family, Nanos, ScanHead, Status};

/// Declares the families, each with its name, its module and its session, in the order in which the search tries them.
macro_rules! families {
    ($($Family:ident $family:ident $Session:ident,)*) => {
        /// Session with a scanner of one of the families.
        #[expect(clippy::large_enum_variant, reason = "there is one per open port")]
        #[derive(Clone, Debug)]
        pub enum Session {
            $(#[doc = concat!("Of family ", stringify!($family), ".")] $Family($family::$Session),)*
        }

        /// Reason why a session does not stream as it should. The scanner's family provides the text.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub enum Problem {
            $(#[doc = concat!("Of family ", stringify!($family), ".")] $Family($family::Problem),)*
            /// The search has not found a scanner.
            Search(search::Problem),
        }

        /// Returns the models and settings of `family`.
        pub const fn features(family: Family) -> &'static Features {
            match family { $(Family::$Family => &$family::FEATURES,)* }
        }

        /// Creates a recognizer for each family, in the order of the declaration below. The search uses the families in
        /// this order.
        pub(crate) fn probes() -> Vec<Box<dyn Probe>> {
            vec![$(Box::<$family::Probe>::default()),*]
        }

        impl Session {
            /// Creates a session with a scanner of `family`. The port is open at the baud rate in `settings`. If
            /// `settings` contain no baud rate, the port is open at the default rate of the model or family.
            pub fn begin(family: Family, settings: &Settings, now: Nanos) -> Session {
                match family { $(Family::$Family => Session::$Family($family::$Session::new((*settings).into(), now)),)* }
            }

            /// Returns the family.
            pub fn family(&self) -> Family {
                match self { $(Session::$Family(_) => Family::$Family,)* }
            }
        }

        /// Returns the problem of a session of any family.
        fn problem(session: &Session) -> Option<Problem> {
            match session { $(Session::$Family(session) => line::ScannerSession::problem(session).map(Problem::$Family),)* }
        }

        impl fmt::Display for Problem {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Problem::$Family(problem) => problem.fmt(f),)*
                    Problem::Search(problem) => problem.fmt(f),
                }
            }
        }

        /// Evaluates an expression with the session that a [`Session`] contains. This session may be of any family.
        macro_rules! each {
            ($of:expr, $session:ident => $value:expr) => {
                match $of { $(Session::$Family($session) => $value,)* }
            };
        }
    };
}

families! {
    Ld ld LdSession,
    Lms lms LmsSession,
    Rplidar rplidar RplidarSession,
}

/// Returns all heads that the scans of a scanner of `family` with these `settings` may have. All heads have the same
/// number of beams. For a rotating scanner, this number is the first of these that exists: the number of beams in the
/// settings, the maximum number of beams in the settings, and the default of the family.
pub fn scan_heads(family: Family, settings: &Settings) -> Vec<ScanHead> {
    match family {
        Family::Lms => lms::scan_heads(settings),
        Family::Ld | Family::Rplidar => {
            let beams = settings.beams.or(settings.max_beams).unwrap_or(features(family).defaults.beams);
            vec![ScanHead::of_revolution(family, beams)]
        }
    }
}

/// Checks the settings in `request`, and returns the settings of a session with a scanner of `family`.
pub(crate) fn check(family: Family, request: &SettingsRequest) -> Result<Settings, Refusal> {
    match family {
        Family::Lms => lms::check(request),
        Family::Ld | Family::Rplidar => request.check_models(family, features(family)),
    }
}

/// Creates the identity probe of a scanner of `family`. The port is open at `rate`, in bits per second. `rate` is `None`
/// for a serial server, on which the user sets the baud rate. Returns `None` for a family [without an identity
/// probe](Features::has_identity_probe).
pub fn identity_probe(family: Family, rate: Option<u32>, now: Nanos) -> Option<IdentityProbe> {
    match family {
        Family::Lms => Some(IdentityProbe::begin(rate, now)),
        Family::Ld | Family::Rplidar => None,
    }
}

/// Features of a link with `family = "auto"`. The limits in these features are sufficient for every scanner.
pub const ANY_FAMILY: Features = {
    let mut any = Features {
        models: &[],
        // This number of beams is sufficient for every model.
        defaults: Model { name: "auto", baud: FIRST_RATE, beams: 3_240 },
        modes: &[],
        keys: &[],
        can_stop_motor: false,
        streams_unrequested: false,
        has_whole_telegrams: true,
        has_identity_probe: false,
        array_flags: 0,
        max_telegram: 0,
    };
    let mut at = 0;
    while at < Family::ALL.len() {
        let features = features(Family::ALL[at]);
        any.array_flags |= features.array_flags;
        if features.max_telegram > any.max_telegram {
            any.max_telegram = features.max_telegram;
        }
        at += 1;
    }
    any
};

impl Session {
    /// Returns the models and settings of the session's family.
    pub fn features(&self) -> &'static Features {
        features(self.family())
    }
}

/// Defines methods that call the method with the same name of the session that a [`Session`] contains.
macro_rules! delegate {
    ($Trait:ident & $(fn $name:ident($($arg:ident: $Arg:ty),*) $(-> $Ret:ty)?;)*) => {
        $(fn $name(&self $(, $arg: $Arg)*) $(-> $Ret)? {
            each!(self, session => line::$Trait::$name(session $(, $arg)*))
        })*
    };
    ($Trait:ident &mut $(fn $name:ident($($arg:ident: $Arg:ty),*) $(-> $Ret:ty)?;)*) => {
        $(fn $name(&mut self $(, $arg: $Arg)*) $(-> $Ret)? {
            each!(self, session => line::$Trait::$name(session $(, $arg)*))
        })*
    };
}

impl line::Protocol for Session {
    delegate! { Protocol &mut
        fn read_buffer() -> &mut [u8];
        fn commit(now: Nanos, len: usize);
        fn handle_timeout(now: Nanos);
        fn handle_transmitted(now: Nanos);
        fn reject_rate(now: Nanos);
        fn poll_action() -> Action<'_>;
    }
}

impl line::ScannerSession for Session {
    type Problem = Problem;

    fn problem(&self) -> Option<Problem> {
        problem(self)
    }

    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<ReceivedTelegram<'a>> {
        each!(self, session => line::ScannerSession::read_recorded(session, telegram, is_readable, status))
    }

    delegate! { ScannerSession &mut
        fn control(control: Control, now: Nanos);
        fn defer_read(now: Nanos, waiting: usize) -> bool;
        fn set_has_subscribers(now: Nanos, has_subscribers: bool);
        fn end(now: Nanos) -> bool;
        fn restore_identity(identity: Identity);
        fn hint_rate(known: KnownRate);
        fn set_start_rate(rate: u32, now: Nanos);
        fn restore_beams(model: Model, beams: usize);
        fn set_partial_reads(count: u8);
        fn mark_suspect(reasons: u8);
    }

    delegate! { ScannerSession &
        fn state() -> State;
        fn missing_transmission() -> Option<&'static str>;
        fn rate() -> u32;
        fn stats() -> SessionStats;
        fn can_defer_read() -> bool;
        fn identity() -> Option<Identity>;
        fn known_rate() -> Option<KnownRate>;
        fn partial_scan() -> Option<RawScan<'_>>;
        fn model() -> Option<Model>;
        fn beams() -> Option<usize>;
        fn unexpected_model() -> Option<Model>;
        fn unit_mm() -> Option<u8>;
        fn notice() -> Option<Notice>;
        fn missing_setting() -> Option<&'static str>;
        fn model_text() -> Option<String>;
        fn stream_responses(reported: &str, beams: Option<usize>) -> Vec<u8>;
        fn write_details(text: &mut dyn fmt::Write);
        fn device_info() -> Option<DeviceInfo>;
        fn scanner_time() -> Option<Nanos>;
        fn describe(status: &mut Status);
        fn add_counters(counters: &mut Counters);
    }
}

/// Baud rate at which a search starts if no earlier search has found the scanner, in bits per second.
const FIRST_RATE: u32 = 230_400;
const _: () = {
    let mut at = 0;
    while at < Family::ALL.len() {
        assert!(features(Family::ALL[at]).max_telegram == Family::ALL[at].max_telegram());
        at += 1;
    }
};
