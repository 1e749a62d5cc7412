//! What the kernel knows of a UART beyond its rate, which no safe crate asks for: how many errors the line had, and
//! whether the driver may collect bytes before it hands them over. A driver that does not have these, as that of a pty,
//! says so, and nothing follows from it.
#![allow(unsafe_code)]

use std::os::fd::{AsFd, BorrowedFd};

use rustix::io::Errno;
use rustix::ioctl::{Opcode, Updater, ioctl};

/// Errors of the line since the driver was loaded: framing, overrun and parity errors, breaks, and bytes for which the
/// kernel's buffer had no room. Wraps.
pub(super) fn line_errors(line: impl AsFd) -> Result<u32, Errno> {
    let mut counts = [0; WORDS];
    call::<TIOCGICOUNT>(line.as_fd(), &mut counts)?;
    Ok(sum_of_errors(&counts))
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

/// The error counts of a `serial_icounter_struct` in one number.
fn sum_of_errors(counts: &[u32; WORDS]) -> u32 {
    counts[ERRORS].iter().fold(0, |sum, count| sum.wrapping_add(*count))
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
/// Where frame, overrun, parity, brk and buf_overrun stand in it.
const ERRORS: std::ops::RangeInclusive<usize> = 6..=10;
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
        // cts dsr rng dcd rx tx, then frame overrun parity brk buf_overrun, then what is reserved.
        let mut counts = [0; WORDS];
        counts[..11].copy_from_slice(&[9, 9, 9, 9, 1_000_000, 500, 1, 20, 300, 4000, 50_000]);
        assert_eq!(sum_of_errors(&counts), 54_321);
        counts[6] = u32::MAX;
        assert_eq!(sum_of_errors(&counts), 54_319);
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
        assert_eq!(line_errors(&slave), Err(Errno::NOTTY));
        assert_eq!(hand_over_at_once(&slave), Err(Errno::NOTTY));
    }
}
