//! What a configuration can name: the models and settings of a family.

use crate::settings::Key;

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
    /// Arrays of a scan: bits of [`scanhub_schema::Contents`].
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
