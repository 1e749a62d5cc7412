//! Rate, character and handshake of a serial line by serialport, the library for them, on a descriptor that was opened and
//! locked here. Only what differs is set: each setting reaches the driver by itself, and a line that streams is not to be
//! disturbed for nothing.
//!
//! Not taken from the library: its `set_parity`, which makes the driver drop bytes with errors (IGNPAR), while here every
//! byte counts; and the number of an error, which it does not keep. See `tty.rs`.
#![allow(unsafe_code)]

use std::mem::ManuallyDrop;
use std::os::fd::{AsFd, AsRawFd, FromRawFd};

use serialport::{ClearBuffer, DataBits, FlowControl, Result, SerialPort, StopBits, TTYPort};

/// 8 data bits, 1 stop bit, no handshake (Telegram listing 4), at `baud`.
///
/// # Errors
///
/// The driver refuses a setting, or the line is gone: which of both the library does not tell.
pub(crate) fn apply(line: impl AsFd, baud: u32) -> Result<()> {
    with(line, |port| {
        if port.data_bits()? != DataBits::Eight {
            port.set_data_bits(DataBits::Eight)?;
        }
        if port.stop_bits()? != StopBits::One {
            port.set_stop_bits(StopBits::One)?;
        }
        if port.flow_control()? != FlowControl::None {
            port.set_flow_control(FlowControl::None)?;
        }
        set_baud(port, baud)
    })
}

/// The rate alone.
///
/// # Errors
///
/// As [`apply`].
pub(crate) fn apply_baud(line: impl AsFd, baud: u32) -> Result<()> {
    with(line, |port| set_baud(port, baud))
}

/// Asserts DTR, or clears it.
///
/// # Errors
///
/// There is no such line, or the whole line is gone.
pub(crate) fn set_dtr(line: impl AsFd, on: bool) -> Result<()> {
    with(line, |port| port.write_data_terminal_ready(on))
}

/// Forgets what came in.
///
/// # Errors
///
/// The line is gone.
pub(crate) fn clear_input(line: impl AsFd) -> Result<()> {
    with(line, |port| port.clear(ClearBuffer::Input))
}

fn set_baud(port: &mut TTYPort, baud: u32) -> Result<()> {
    // Two rates, one for each direction, are an error to the library: then both are set.
    if port.baud_rate().ok() == Some(baud) { Ok(()) } else { port.set_baud_rate(baud) }
}

/// Lets `set` work on the library's view of `line`, which has to be locked by this process already: the view locks it, too.
fn with<T>(line: impl AsFd, set: impl FnOnce(&mut TTYPort) -> Result<T>) -> Result<T> {
    let line = line.as_fd();
    // SAFETY: the descriptor is open for as long as it is borrowed, which is longer than the view lives; never dropped, the
    // view neither closes it nor ends its exclusive mode.
    let mut port = ManuallyDrop::new(unsafe { TTYPort::from_raw_fd(line.as_raw_fd()) });
    set(&mut port)
}
