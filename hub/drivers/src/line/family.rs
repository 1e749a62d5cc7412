//! What a configuration can name: the models and settings of a family.

use crate::line::settings::Key;

/// Models and settings of a family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features {
    /// The models. Empty if the scanner reports its model.
    pub models: &'static [Model],
    /// Values for an unknown model: the first rate, and the number of beams for which there is space.
    pub auto: Model,
    /// Names of the scan modes. Empty if there is no choice.
    pub modes: &'static [&'static str],
    /// Keys of settings that only this family has.
    pub keys: &'static [Key],
    /// Whether the motor can be stopped.
    pub can_rest: bool,
    /// Whether the scanner streams as soon as it has power, without a request.
    pub speaks_unasked: bool,
    /// Whether each telegram is a scan or a reply by itself. Otherwise the family sends packets, which are parts of a
    /// scan.
    pub has_whole_telegrams: bool,
    /// Whether the scanner reports its settings on request, outside a session: to an [inquiry](crate::inquiry).
    pub has_inquiry: bool,
    /// Arrays of a scan: bits of [`schema::Contents`].
    pub contents: u8,
    /// Maximum number of bytes of a telegram, or of packets that arrived together.
    pub max_telegram: usize,
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

/// Settings of a session, with names and numbers in place of a family's types. A family ignores what it does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// Name of one of the [`Features::models`]. `None`: the session finds it out.
    pub model: Option<&'static str>,
    /// Name of one of the [`Features::modes`]. `None`: the best one.
    pub mode: Option<&'static str>,
    /// Number of beams of the grid. `None`: the model's number, at most [`max_beams`](Self::max_beams).
    pub beams: Option<usize>,
    /// Maximum number of beams. `None`: the maximum of a grid.
    pub max_beams: Option<usize>,
    /// Angle of view in degrees and angle between two beams in hundredths of a degree. `None`: the family's usual ones.
    pub view: Option<(u16, u16)>,
    /// Rate to stream at, in bits per second. `None`: that of the model or family.
    pub baud: Option<u32>,
    /// Name of the expected type. It is compared, never written.
    pub expected_type: Option<&'static str>,
    /// Expected unit of ranges in mm. It is compared, never written.
    pub unit_mm: Option<u8>,
    /// Number of the mode that defines the meaning of values, for a recording that does not contain it.
    pub mode_number: Option<u8>,
    /// Whether the port has one fixed rate and bytes do not arrive at the pace of a line, as with a serial server on
    /// the network or a recording.
    pub fixed_rate: bool,
    /// Whether nothing can be sent, because the bytes are from a recording.
    pub listen_only: bool,
    /// Whether the motor stops while there are no subscribers, if it [can](Features::can_rest).
    pub stop_when_idle: bool,
    /// Whether a search has found the scanner. Its number of beams then follows what it reports.
    pub is_found: bool,
}

/// Maps a constant array with a constant function.
macro_rules! table {
    ($from:expr, $map:path) => {{
        let mut to = [$map($from[0]); $from.len()];
        let mut at = 1;
        while at < to.len() {
            to[at] = $map($from[at]);
            at += 1;
        }
        to
    }};
}
pub(crate) use table;
