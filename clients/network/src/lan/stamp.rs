//! A moment as both ends of a network need it. Refuses to know who reads the clocks.

/// One moment on two clocks, in ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamp {
    /// A clock that is never set, such as CLOCK_MONOTONIC.
    pub monotonic_ns: u64,
    /// The wall clock, since 1970.
    pub wall_ns: u64,
}
