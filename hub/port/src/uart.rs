//! Error counters of a UART, and the telegrams that an error may be in. The kernel provides the counters, and no safe
//! crate does. A driver without them, such as a pty's, reports that, which is not an error.
//!
//! The driver counts errors when bytes reach it, but not in which bytes. When a telegram has been read, an error may be
//! in it, in another telegram of the same read, or in bytes that have arrived since: the start of the next telegram.
#![allow(unsafe_code)]

use std::os::fd::{AsFd, BorrowedFd};

use rustix::io::Errno;
use rustix::ioctl::{Opcode, Updater, ioctl};

/// Counters of a line since its driver was loaded. All of them wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Bytes received.
    pub received: u32,
    /// Bytes without a stop bit.
    pub framing: u32,
    /// Bytes that the UART lost because it was not read in time.
    pub overrun: u32,
    /// Bytes with the wrong parity.
    pub parity: u32,
    /// Number of times that the line was held low for longer than a byte.
    pub breaks: u32,
    /// Bytes for which the kernel's buffer had no room.
    pub buffer: u32,
}

impl Counts {
    /// Reads the counters of the driver of `line`.
    pub(crate) fn of(line: impl AsFd) -> Result<Counts, Errno> {
        let mut words = [0; WORDS];
        call::<TIOCGICOUNT>(line.as_fd(), &mut words)?;
        Ok(Counts::in_words(&words))
    }

    /// Returns the total of all errors.
    pub fn errors(self) -> u32 {
        let Counts { received: _, framing, overrun, parity, breaks, buffer } = self;
        [framing, overrun, parity, breaks, buffer].into_iter().fold(0, u32::wrapping_add)
    }

    /// Reads a `serial_icounter_struct`: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun.
    fn in_words(words: &[u32; WORDS]) -> Counts {
        let [_, _, _, _, received, _, framing, overrun, parity, breaks, buffer, ..] = *words;
        Counts { received, framing, overrun, parity, breaks, buffer }
    }
}

/// Sets the driver to low latency, so that an FTDI adapter delivers bytes every millisecond instead of every 16. Also
/// removes a custom divisor that an old `setserial` may have left, which replaces the rate 38400 by another one.
pub(super) fn set_low_latency(line: impl AsFd) -> Result<(), Errno> {
    let mut serial = [0; WORDS];
    call::<TIOCGSERIAL>(line.as_fd(), &mut serial)?;
    let flags = serial[FLAGS];
    serial[FLAGS] = prompt(flags);
    if serial[FLAGS] == flags { Ok(()) } else { call::<TIOCSSERIAL>(line.as_fd(), &mut serial) }
}

/// Returns `flags` of a `serial_struct` with low latency and without a custom divisor.
fn prompt(flags: u32) -> u32 {
    (flags | ASYNC_LOW_LATENCY) & !ASYNC_SPD_MASK
}

fn call<const OPCODE: Opcode>(line: BorrowedFd<'_>, words: &mut [u32; WORDS]) -> Result<(), Errno> {
    // SAFETY: each opcode below makes the kernel read or write one structure at `words`. All fields of these structures
    // are plain numbers, and the longest has 80 bytes (linux/serial.h), which is the size of `words`.
    unsafe { ioctl(line, Updater::<OPCODE, _>::new(words)) }
}

/// Length of a `serial_icounter_struct` in words. A `serial_struct` is shorter.
const WORDS: usize = 20;
/// Index of the flags in a `serial_struct`.
const FLAGS: usize = 4;
/// Bits of the flags (linux/tty_flags.h).
const ASYNC_LOW_LATENCY: u32 = 1 << 13;
const ASYNC_SPD_MASK: u32 = 1 << 12 | 1 << 5 | 1 << 4;
/// asm-generic/ioctls.h.
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;
const TIOCGICOUNT: Opcode = 0x545D;

/// Tracks whether errors may belong to the bytes that were read.
#[derive(Debug, Default)]
pub struct LineErrors {
    /// Whether the driver counted errors since the last wait for bytes.
    moved: bool,
    /// Whether it counted errors in the period before that.
    before: bool,
}

impl LineErrors {
    /// Records that a telegram was read, and that the driver counted `errors` since the previous one. Returns whether
    /// they may be in this telegram.
    pub fn note(&mut self, errors: u64) -> bool {
        self.moved |= errors > 0;
        self.moved || self.before
    }

    /// Records that all telegrams of a read, at least one, were noted.
    pub fn wait(&mut self) {
        self.before = std::mem::take(&mut self.moved);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_what_the_line_did_wrong() {
        let mut words = [0; WORDS];
        words[..11].copy_from_slice(&[9, 9, 9, 9, 1_000_000, 500, 1, 20, 300, 4000, 50_000]);
        let counts = Counts::in_words(&words);
        assert_eq!((counts.received, counts.errors()), (1_000_000, 54_321));
        assert_eq!((counts.overrun, counts.buffer), (20, 50_000));
        assert_eq!(Counts { framing: u32::MAX, ..counts }.errors(), 54_319);
    }

    #[test]
    fn flags_that_matter() {
        // ASYNC_SKIP_TEST and ASYNC_SPD_CUST, as setserial leaves them.
        assert_eq!(prompt(0x40 | 0x30), 0x2040);
        assert_eq!(prompt(0x2040), 0x2040);
    }

    #[test]
    fn a_line_that_has_none() {
        let (_, slave) = std::io::pipe().unwrap();
        assert_eq!(Counts::of(&slave), Err(Errno::NOTTY));
        assert_eq!(set_low_latency(&slave), Err(Errno::NOTTY));
    }

    #[test]
    fn this_telegram_and_the_next_one() {
        let mut errors = LineErrors::default();
        let mut read = |counts: &[u64]| {
            let marked: Vec<bool> = counts.iter().map(|&count| errors.note(count)).collect();
            errors.wait();
            marked
        };
        assert_eq!(read(&[0]), [false]);
        assert_eq!(read(&[3]), [true]);
        assert_eq!(read(&[0]), [true]);
        assert_eq!(read(&[0]), [false]);
        // Several telegrams in one read: the counter of the first one covers all of them.
        assert_eq!(read(&[1, 0, 0]), [true; 3]);
        assert_eq!(read(&[2]), [true]);
        assert_eq!(read(&[0, 0]), [true; 2]);
        assert_eq!(read(&[0]), [false]);
    }
}
