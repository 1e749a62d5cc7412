//! What a session with a scanner hands out whose head turns and that sends small packets: packets that arrived together, and
//! turns. Refuses to know what a packet says.

use crate::line::Received;
use crate::line::grid::Point;
use schema::Nanos;

/// What a session hands out.
#[derive(Clone, Copy, Debug)]
pub enum Heard<'a> {
    /// Whole packets that arrived together, of at most 10 ms, without anything between them. Each packet is in one
    /// of these, in the order in which they came.
    Packets(Received<'a, Packets>),
    /// A turn of the head, after its packets.
    Turn(Turn<'a>),
}

/// What packets that arrived together say, taken together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packets {
    /// How many there are.
    pub count: usize,
    /// Whether each of them has a checksum, which was right.
    pub is_checked: bool,
    /// Whether it is the answer to a request, and no points.
    pub is_reply: bool,
}

/// A turn of the head.
#[derive(Clone, Copy, Debug)]
pub struct Turn<'a> {
    /// Which one: no other of the session has this number, not even one that came to no end.
    pub number: u64,
    /// Its points as they came, to be put on a [`Grid`](crate::line::grid::Grid).
    pub points: &'a [Point],
    /// When beam 0 was measured: the first point, or where it would have been.
    pub first: Nanos,
    /// When the last point was measured.
    pub last: Nanos,
    /// How long a turn takes.
    pub period: Nanos,
    /// Beams of the grid that it is for.
    pub beams: usize,
    /// Points that the scanner measures in a second.
    pub points_per_second: f32,
    /// Whether packets of it are missing.
    pub incomplete: bool,
    /// Why it is suspect, bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
}

/// How many turns there were of which kind; every field only grows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TurnCounts {
    /// Handed out, the incomplete ones too.
    pub turns: u64,
    /// Of these the incomplete ones.
    pub incomplete: u64,
    /// Begun, but less than half of it came.
    pub short: u64,
    /// Gone without a packet.
    pub missed: u64,
}
