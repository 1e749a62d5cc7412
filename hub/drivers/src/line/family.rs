//! What is common to families of scanners with a rotating head: the session trait, the models and settings that a configuration
//! can name, and the events of a session. A caller that supports all families needs only a list of them.

use core::fmt;

use crate::line::grid::Point;
use crate::line::{Received, Session};
use schema::Nanos;

/// Session with a scanner whose head rotates.
pub trait Turning: Session + Sized {
    /// Models and settings of the family.
    const FEATURES: Features;

    /// Creates a session on a port that is open at the rate of the model in `wanted`.
    fn begin(wanted: Wanted, now: Nanos) -> Self;

    /// Returns the model, once it is known. Of models that cannot be distinguished, it is one.
    fn model(&self) -> Option<Model>;

    /// Returns the number of beams of a scan, once the model is known.
    fn beams(&self) -> Option<usize>;

    /// Returns the revolution that is being measured, with the points that have arrived. Call it when [`Session::poll_output`]
    /// has returned a wait. `None` between revolutions.
    fn begun(&self) -> Option<Turn<'_>>;

    /// Returns the model if it is not the one of the settings. Of models that cannot be distinguished, it is one.
    fn other_model(&self) -> Option<Model> {
        None
    }

    /// Returns the name of a setting that a recording needs before it can be read, in words.
    fn lacks(&self) -> Option<&'static str> {
        None
    }

    /// Writes the scan mode and the firmware version of the scanner, in short form.
    fn specify(&self, text: &mut dyn fmt::Write) {
        let _ = text;
    }

    /// Writes the identity that the scanner reported into `identity`, and its health into `health`. Returns `None` before it has
    /// reported both, and always for a family that accepts no requests.
    fn introduction(&self, identity: &mut dyn fmt::Write, health: &mut dyn fmt::Write) -> Option<Condition> {
        let _ = (identity, health);
        None
    }

    /// Returns the time at which the last returned packet was measured, by the scanner's own clock, if it has one. Its zero is
    /// arbitrary. The clock restarts with the scanner.
    fn scanner_time(&self) -> Option<Nanos> {
        None
    }

    /// Adds `reasons`, bits of [`crate::line::suspect`], to the packets that are returned next. Used for a recording, which does not
    /// contain the damaged bytes beside a packet.
    fn doubt(&mut self, reasons: u8) {
        let _ = reasons;
    }
}

/// Health that a scanner reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Condition {
    /// Not reported.
    Unknown,
    /// The scanner works.
    Good,
    /// The scanner measures, but may fail soon.
    Warning,
    /// The scanner does not measure.
    Error,
}

/// Models and settings of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features {
    /// The models.
    pub models: &'static [Model],
    /// Values for an unknown model: the first rate, and the number of beams for which there is space.
    pub auto: Model,
    /// Names of the scan modes. Empty if there is no choice.
    pub modes: &'static [&'static str],
    /// Whether the motor can be stopped.
    pub can_rest: bool,
    /// Whether the scanner streams as soon as it has power, without a request.
    pub speaks_unasked: bool,
}

/// A model of a scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Model {
    /// Name in the configuration and in messages.
    pub name: &'static str,
    /// Rate of its line, in bits per second.
    pub baud: u32,
    /// Default number of beams of a scan.
    pub beams: usize,
}

/// Settings of a session, with names in place of a family's types.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Name of one of the [`Features::models`]. `None`: the session finds it out.
    pub model: Option<&'static str>,
    /// Name of one of the [`Features::modes`]. `None`: the best one.
    pub mode: Option<&'static str>,
    /// Number of beams of the grid. `None`: the model's number, at most [`most_beams`](Self::most_beams).
    pub beams: Option<usize>,
    /// Maximum number of beams. `None`: the maximum of a grid.
    pub most_beams: Option<usize>,
    /// Whether the port has one fixed rate and bytes do not arrive at the pace of a line, as with a serial server on the
    /// network or a recording.
    pub fixed_rate: bool,
    /// Whether nothing can be sent, because the bytes are from a recording.
    pub listen_only: bool,
    /// Whether the motor stops while there are no subscribers, if it [can](Features::can_rest).
    pub stop_when_idle: bool,
}

/// Event from a session with a scanner whose head rotates.
#[derive(Clone, Copy, Debug)]
pub enum Heard<'a> {
    /// Packets that arrived together, at most 10 ms of them, without other bytes between them. Each packet is in one of these
    /// events, in the order of arrival.
    Packets(Received<'a, Packets>),
    /// A complete revolution, after its packets.
    Turn(Turn<'a>),
}

/// Facts about packets that arrived together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packets {
    /// Number of packets.
    pub count: usize,
    /// Whether each packet has a checksum, and it was right.
    pub is_checked: bool,
    /// Whether they are the response to a request, without points.
    pub is_reply: bool,
}

/// A revolution of the head.
#[derive(Clone, Copy, Debug)]
pub struct Turn<'a> {
    /// Number of the revolution. Incomplete revolutions have numbers, too.
    pub number: u64,
    /// Points in the order of arrival, for a [`Grid`](crate::line::grid::Grid).
    pub points: &'a [Point],
    /// Time at which beam 0 was, or would have been, measured.
    pub first: Nanos,
    /// Time at which the last point was measured.
    pub last: Nanos,
    /// Duration of a revolution.
    pub period: Nanos,
    /// Number of beams of the grid.
    pub beams: usize,
    /// Points that the scanner measures per second.
    pub points_per_second: f32,
    /// Whether packets are missing.
    pub incomplete: bool,
    /// Reasons for suspicion: bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
}

/// Numbers of revolutions by kind. They only increase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TurnCounts {
    /// Returned revolutions, including incomplete ones.
    pub turns: u64,
    /// Returned revolutions that are incomplete.
    pub incomplete: u64,
    /// Revolutions that were not returned, because less than half of the points arrived.
    pub short: u64,
    /// Revolutions without a packet.
    pub missed: u64,
}
