//! Points in time and durations, and how long bytes take on a serial line.

/// A point in time or a duration, in nanoseconds of one monotonic clock that the caller chooses.
pub type Nanos = u64;

/// One millisecond in [`Nanos`].
pub const MILLIS: Nanos = 1_000_000;
/// One microsecond in [`Nanos`].
pub const MICROS: Nanos = 1_000;

/// Returns how long `bytes` bytes take on a line of `baud` bits per second: with 8N1, a byte has 10 bits.
pub const fn line_time(bytes: usize, baud: u32) -> Nanos {
    bytes as u64 * 10 * 1_000_000_000 / baud as u64
}
