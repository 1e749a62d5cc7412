//! Where a conversation with a sensor can be, what it was asked to reach, and how long each wait lasts. No behaviour:
//! that is [`crate::lms::dialogue`].

use crate::line::State;
use crate::lms::command::Request;
use crate::lms::header::StreamHeader;
use crate::lms::reply::Reply;
use crate::lms::variant::{Baud, Mode, Variant};
use schema::{MILLIS, Nanos};

/// What a session shall do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Angle and resolution to ask for; a sensor that refuses streams what it has.
    pub variant: Variant,
    /// Rate to stream at.
    pub baud: Baud,
    /// Whether anybody hears us: a recording is only listened to.
    pub listen_only: bool,
    /// Whether the port has the wanted rate and no other: a serial server on the network.
    pub fixed_rate: bool,
    /// Whether to keep to `baud` even if the line cannot carry it. Otherwise, the session streams at 38,400 baud after two
    /// switches to 500,000 baud that the scanner acknowledged and that were followed by silence.
    pub keep_baud: bool,
    /// Measuring mode of a recording that does not contain it.
    pub mode: Option<Mode>,
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum Phase {
    /// Listening without sending, for a sensor that streams. The state is `shown` during this time; afterwards comes
    /// `attempt`, already at `quiet_at` if no byte came.
    Listening { give_up_at: Nanos, quiet_at: Nanos, shown: State, attempt: usize },
    /// A question at one rate after the other.
    Probing { attempt: usize },
    /// The sensor hears us: it is brought to rest, to the wanted rate, to its settings, to a stream.
    Starting { step: Step, progress: Progress },
    /// Measured data come. After a scan from `ask_at` on, the next question may be asked; all were asked `rounds` times.
    Streaming {
        header: StreamHeader,
        silent_at: Nanos,
        questions: &'static [Request],
        rounds: u8,
        ask_at: Nanos,
    },
    /// Bytes come from a recording.
    Following,
    /// Nothing is wanted. A stream that goes on all the same is stopped so many times more.
    Paused { stops_left: u8 },
}

/// Steps of [`Phase::Starting`], each a request. Between two changes of mode or rate, whose replies look alike, there
/// is always another one: so a reply that is late, or comes twice, is not taken for the next one's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Ends a stream, or the installation mode.
    Stop,
    /// Asks the sensor what it does now, and whether it hears at this rate.
    Check,
    Baud,
    Variant,
    Type,
    Configuration,
    Stream,
}

/// How far a start is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Progress {
    /// Stops that may still be said.
    pub(crate) stops_left: u8,
    /// What follows once the sensor is at rest and at the wanted rate.
    pub(crate) settings: &'static [Step],
    /// Whether it told its status: what it does, and how its values are split.
    pub(crate) has_status: bool,
    /// Whether it told its type.
    pub(crate) has_type: bool,
}

impl Progress {
    /// Nothing was done yet.
    pub(crate) const BEGIN: Progress = Progress {
        stops_left: STOPS + 1,
        settings: &[Step::Variant, Step::Type, Step::Configuration, Step::Stream],
        has_status: false,
        has_type: false,
    };

    /// Nothing was done yet but `request`, which the sensor answered with `reply`.
    pub(crate) fn begin(request: Request, reply: Option<&Reply<'_>>) -> Progress {
        Progress::BEGIN.after(request, reply)
    }

    /// So far, and the sensor answered `request` with `reply`. What it refuses to tell is asked another way.
    pub(crate) fn after(self, request: Request, reply: Option<&Reply<'_>>) -> Progress {
        Progress {
            has_status: self.has_status || matches!(reply, Some(Reply::Status(_))),
            has_type: self.has_type || request == Request::Type,
            ..self
        }
    }
}

/// Two scans of the slowest variant, and some; longer where the line is slower than the scans.
pub(crate) const LISTEN: Nanos = 120 * MILLIS;
/// On a line that is silent for so long nobody streams whole scans: the slowest variant begins one every 53 ms, and has
/// bytes on the line for a third of that at least. Two telegram times of the usual one.
pub(crate) const QUIET: Nanos = 55 * MILLIS;
/// Without measured data for so long the session begins again (paper: resynchronise after one second).
pub const SILENCE: Nanos = 1_000 * MILLIS;
/// After a change of rate the sensor's and the adapter's UART need a moment.
pub(crate) const SETTLE: Nanos = 20 * MILLIS;
/// After a refusal, before everything begins again.
pub(crate) const PAUSE: Nanos = 500 * MILLIS;
/// A sensor may overlook a request while its mirror turns; three tries are what all drivers give it.
pub const TRIES: u8 = 3;
/// Of requests without which there is no stream.
pub const MORE_TRIES: u8 = 5;
/// A whole scan that began so long after a request says that the request was overlooked: it breaks off what is sent.
/// The time is for bytes that an adapter keeps.
pub(crate) const OVERLOOKED: Nanos = 25 * MILLIS;
/// At all rates nobody answered and no byte came: before the next round, by how many there were.
pub(crate) const PAUSES: [Nanos; 4] = [0, 500 * MILLIS, 1_000 * MILLIS, 1_500 * MILLIS];
/// A sensor that shall only stop is sought in so many rounds, a hasty and a patient one.
pub(crate) const PAUSE_ROUNDS: usize = 2;
/// In every other round a sensor has so much more time: one that is slow would never be found otherwise.
pub(crate) const PATIENCE: Nanos = 250 * MILLIS;
/// Stops beside the first one; what goes on after so many does not listen.
pub(crate) const STOPS: u8 = 2;
/// What a stream does not tell: who sends it, which may say at which angles, and how values are split, from the one reply
/// or the other. After some rounds only the latter is still wanted, rarely: without it there are no scans.
pub(crate) const QUESTIONS: &[Request] = &[Request::Type, Request::Status, Request::Configuration];
pub(crate) const QUESTION_ROUNDS: u8 = 5;
pub(crate) const QUESTION_PAUSE: Nanos = 10_000 * MILLIS;
/// STX to count word, status and checksum: bytes of a telegram beside its values.
pub(crate) const BESIDE_VALUES: usize = 10;
