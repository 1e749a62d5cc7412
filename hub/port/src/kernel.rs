//! What the kernel knows about a UART besides its rate, and no safe crate provides: how many errors the line had, and
//! whether the driver may collect bytes before it hands them over. A driver without these, such as a pty's, reports that,
//! which is not an error.
#![allow(unsafe_code)]

use std::os::fd::{AsFd, BorrowedFd};

use rustix::io::Errno;
use rustix::ioctl::{Opcode, Updater, ioctl};

/// What happened on a line since its driver was loaded. All wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Bytes received.
    pub received: u32,
    /// Bytes without a stop bit.
    pub framing: u32,
    /// Bytes that the UART lost.
    pub overrun: u32,
    /// Bytes of the wrong parity.
    pub parity: u32,
    /// How often the line was held low for longer than a byte.
    pub breaks: u32,
    /// Bytes for which the kernel's buffer had no room.
    pub buffer: u32,
}

impl Counts {
    /// Asks the driver of `line`.
    pub(crate) fn of(line: impl AsFd) -> Result<Counts, Errno> {
        let mut words = [0; WORDS];
        call::<TIOCGICOUNT>(line.as_fd(), &mut words)?;
        Ok(Counts::in_words(&words))
    }

    /// All errors in one number.
    pub fn errors(self) -> u32 {
        let Counts { received: _, framing, overrun, parity, breaks, buffer } = self;
        [framing, overrun, parity, breaks, buffer].into_iter().fold(0, u32::wrapping_add)
    }

    /// A `serial_icounter_struct`: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun.
    fn in_words(words: &[u32; WORDS]) -> Counts {
        let [_, _, _, _, received, _, framing, overrun, parity, breaks, buffer, ..] = *words;
        Counts { received, framing, overrun, parity, breaks, buffer }
    }
}

/// Has the driver hand over bytes as they come; an FTDI adapter then does so each millisecond instead of each 16. Takes
/// away the divisor that an old `setserial` may have left, which makes another rate of 38400.
pub(super) fn hand_over_at_once(line: impl AsFd) -> Result<(), Errno> {
    let mut serial = [0; WORDS];
    call::<TIOCGSERIAL>(line.as_fd(), &mut serial)?;
    let flags = serial[FLAGS];
    serial[FLAGS] = prompt(flags);
    if serial[FLAGS] == flags { Ok(()) } else { call::<TIOCSSERIAL>(line.as_fd(), &mut serial) }
}

/// The `flags` of a `serial_struct` as they shall be.
fn prompt(flags: u32) -> u32 {
    (flags | ASYNC_LOW_LATENCY) & !ASYNC_SPD_MASK
}

fn call<const OPCODE: Opcode>(line: BorrowedFd<'_>, words: &mut [u32; WORDS]) -> Result<(), Errno> {
    // SAFETY: each opcode below makes the kernel read or write one structure at `words`, all fields of which are plain
    // numbers; the longest has 80 bytes (linux/serial.h), and so many are there.
    unsafe { ioctl(line, Updater::<OPCODE, _>::new(words)) }
}

/// Words of a `serial_icounter_struct`; a `serial_struct` is shorter.
const WORDS: usize = 20;
/// Where the flags stand in a `serial_struct`.
const FLAGS: usize = 4;
/// Bits of the flags (linux/tty_flags.h).
const ASYNC_LOW_LATENCY: u32 = 1 << 13;
const ASYNC_SPD_MASK: u32 = 1 << 12 | 1 << 5 | 1 << 4;
/// asm-generic/ioctls.h.
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;
const TIOCGICOUNT: Opcode = 0x545D;

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
        assert_eq!(hand_over_at_once(&slave), Err(Errno::NOTTY));
    }
}
