//! A family of scanners whose head turns and whose points fall where they like, as a configuration and a hub see it: the
//! models that it has, what may be set for one, and how a session begins. So whoever offers all families needs a list of
//! them and nothing else. Refuses to know what a family speaks.

use core::fmt;

use crate::line::{Session, Turn};
use schema::Nanos;

/// A session with a scanner of such a family.
pub trait Turning: Session + Sized {
    /// What may be set for one.
    const FEATURES: Features;

    /// A session on a port that is open at the rate of the model that is `wanted`.
    fn begin(wanted: Wanted, now: Nanos) -> Self;

    /// What is at the other end, as far as that is known: of models that cannot be told apart, one.
    fn model(&self) -> Option<Model>;

    /// Beams of the grid that turns are for; nothing before it is known what is at the other end.
    fn beams(&self) -> Option<usize>;

    /// The turn that is being measured, as if it ended with the points that are known, once [`Session::poll_output`] wants to
    /// wait; nothing between turns.
    fn begun(&self) -> Option<Turn<'_>>;

    /// What it turned out to be where another model is wanted; of models that cannot be told apart, one.
    fn other_model(&self) -> Option<Model> {
        None
    }

    /// What has to be named before it can be read where nobody can be asked, in words; nothing if nothing has.
    fn lacks(&self) -> Option<&'static str> {
        None
    }

    /// Writes more of what it is, in a few letters: how it measures, and its firmware.
    fn specify(&self, text: &mut dyn fmt::Write) {
        let _ = text;
    }

    /// Writes what the scanner said of itself, such as its firmware, into `identity`, and how it says that it is into
    /// `health`. Nothing before it was asked all that changes nothing; of one that is never asked, nothing at all.
    fn introduction(&self, identity: &mut dyn fmt::Write, health: &mut dyn fmt::Write) -> Option<Condition> {
        let _ = (identity, health);
        None
    }

    /// When the last packet that was handed out was measured, by the scanner's own clock, whose zero is any; nothing where it
    /// has none. It begins again where the scanner does.
    fn scanner_time(&self) -> Option<Nanos> {
        None
    }

    /// The packets that are handed out next are suspect for these `reasons` too, bits of [`crate::line::suspect`]: of a recording,
    /// which has nothing any more of what was damaged beside them. Where a family does not take it, its turns do not say it.
    fn doubt(&mut self, reasons: u8) {
        let _ = reasons;
    }
}

/// How well a scanner says that it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Condition {
    /// It did not say.
    Unknown,
    /// Well.
    Good,
    /// It measures, and may not for long.
    Warning,
    /// It does not measure.
    Error,
}

/// What may be set for a scanner of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features {
    /// The models.
    pub models: &'static [Model],
    /// What counts where the model is to be found out: the rate to begin with, and beams for which there is room.
    pub auto: Model,
    /// Names of the ways in which it can measure; empty if there is nothing to choose.
    pub modes: &'static [&'static str],
    /// Whether its motor can rest.
    pub can_rest: bool,
    /// Whether it speaks as soon as it has power: then nothing need be sent to it.
    pub speaks_unasked: bool,
}

/// A model of scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Model {
    /// Its name in configuration and words.
    pub name: &'static str,
    /// The rate at which it speaks, in bits per second.
    pub baud: u32,
    /// Beams of a turn unless something else is asked for.
    pub beams: usize,
}

/// What is wanted of a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Name of one of the [`Features::models`]; `None` is to be found out.
    pub model: Option<&'static str>,
    /// Name of one of the [`Features::modes`]; `None`: the best one.
    pub mode: Option<&'static str>,
    /// Beams of the grid; `None`: the model's, at most [`most_beams`](Self::most_beams).
    pub beams: Option<usize>,
    /// The most beams that there is room for; `None`: as many as a grid can have.
    pub most_beams: Option<usize>,
    /// Whether the port has one rate and not the pace of a line: a serial server on the network, a recording.
    pub fixed_rate: bool,
    /// Whether nobody can be talked to: a recording.
    pub listen_only: bool,
    /// Whether the motor rests while nobody follows, where it [can](Features::can_rest).
    pub stop_when_idle: bool,
}
