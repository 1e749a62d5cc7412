//! Why what arrived deserves less trust; bits of `reasons`. A family uses those that it can know.

/// The line's error counters moved.
pub const LINE_ERROR: u8 = 1;
/// Bytes before it belonged to nothing: its neighbour was damaged.
pub const NEIGHBOUR: u8 = 2;
/// It took longer than usual.
pub const SLOW: u8 = 4;
/// Bits are set that are never set.
pub const FORBIDDEN_BITS: u8 = 8;
/// Another acceptable header began inside.
pub const HEADER_INSIDE: u8 = 16;
