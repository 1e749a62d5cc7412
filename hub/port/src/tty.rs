//! Serial line of this machine, opened exclusively, raw, and at a baud rate that the driver has confirmed.
//!
//! The crate `serialport` sets the baud rate, the character format and the handshake, on a descriptor that this module
//! has opened and locked. Only settings that differ are set, because each setting reaches the driver separately, and
//! setting it could disturb a stream. Two parts of that crate are unsuitable. Its `set_parity` makes the driver drop
//! bytes with errors (IGNPAR), but here every byte counts. The crate also does not keep the errno of an error of the
//! kernel.
//!
//! The kernel provides the error counters of a UART, but no safe crate reads them. Some drivers, such as the driver of
//! a pty, have no counters. This is not an error. The driver counts errors when bytes reach it, but does not report in
//! which bytes. After a telegram was read, an error may be in this telegram, in another telegram of the same read, or
//! in bytes that have arrived since. Those bytes start the next telegram.
#![allow(unsafe_code)]

use std::cell::Cell;
use std::fmt;
use std::io::{self, ErrorKind};
use std::mem::ManuallyDrop;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, open};
use rustix::io::Errno;
use rustix::ioctl::{Opcode, Updater, ioctl};
use rustix::termios::{
    ControlModes, InputModes, LocalModes, OptionalActions, OutputModes, SpecialCodeIndex, Termios,
    ioctl_tiocexcl, ioctl_tiocnxcl, tcgetattr, tcsetattr,
};
use serialport::{ClearBuffer, DataBits, FlowControl, SerialPort, StopBits, TTYPort};

use crate::serial_ports::{MAX_LATENCY_MS, check_tty, is_tty, latency_ms};
use crate::{PortError, write_all};

/// Open serial line, exclusive and raw. Reads and writes never block.
pub struct Tty {
    line: OwnedFd,
    /// Device that the port's name resolved to when it was opened.
    device: PathBuf,
    /// Settings that this process has made. They are compared with the present settings to detect changes by another
    /// process.
    settings: Cell<Settings>,
    /// Number of errors that the driver had counted at the last check. `None` if the driver does not count errors.
    errors: Cell<Option<u32>>,
}

impl Tty {
    /// Opens `path` at `baud`. Bytes in the line's buffer are kept, because a hub that crashed may not have read them.
    pub(crate) fn open(path: &Path, baud: u32) -> Result<Tty, PortError> {
        check_tty(path)?;
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        Tty::begin(open(path, flags, Mode::empty())?, path, baud)
    }

    /// Configures `line`, which is already open, as [`Tty::open`] does.
    ///
    /// Returns [`PortError::Missing`] if `path` now names another line.
    pub(crate) fn adopt(line: OwnedFd, path: &Path, baud: u32) -> Result<Tty, PortError> {
        if Tty::is_at(&line, path) { Tty::begin(line, path, baud) } else { Err(PortError::Missing) }
    }

    /// Returns whether `path` names the open `line`.
    pub(crate) fn is_at(line: &OwnedFd, path: &Path) -> bool {
        let open = fstat(line).map(|stat| stat.st_rdev);
        path.metadata().is_ok_and(|now| open == Ok(now.rdev())) && is_tty(path)
    }

    fn begin(line: OwnedFd, path: &Path, baud: u32) -> Result<Tty, PortError> {
        let termios = tcgetattr(&line)?;
        // Take the lock before setting the exclusive mode. A process that does not get the lock must not end the
        // exclusive mode of the process that owns it.
        flock(&line, FlockOperation::NonBlockingLockExclusive).map_err(|error| match error {
            Errno::WOULDBLOCK => PortError::Busy,
            error => error.into(),
        })?;
        ioctl_tiocexcl(&line)?;
        let device = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        let tty = Tty { line, device, settings: Cell::new(Settings::of(&termios)), errors: Cell::new(None) };
        // Not all drivers support low latency, and scanners also stream without it.
        if let Err(error) = set_low_latency(&tty.line) {
            tracing::debug!(%error, "{}: no low latency", path.display());
        }
        tty.configure(termios, baud)?;
        if let Some(ms) = latency_ms(path).filter(|&ms| ms > MAX_LATENCY_MS) {
            tracing::warn!(
                "{}: the adapter collects bytes for {ms} ms, so stamps are wrong by up to this time; fix it with a udev rule: \
                 ACTION==\"add\", SUBSYSTEM==\"usb-serial\", DRIVER==\"ftdi_sio\", ATTR{{latency_timer}}=\"1\"",
                path.display()
            );
        }
        tty.errors.set(tty.uart_counters().map(|counts| counts.errors()));
        Ok(tty)
    }

    /// Makes the line raw and sets `baud`. `termios` has the present settings.
    fn configure(&self, mut termios: Termios, baud: u32) -> Result<(), PortError> {
        // Disable parity, so that the driver drops or doubles no byte because of an error. Ignore the modem lines,
        // which are not connected.
        termios.make_raw();
        termios.input_modes.remove(InputModes::IXOFF | InputModes::IXANY | InputModes::INPCK);
        termios.control_modes.insert(ControlModes::CREAD | ControlModes::CLOCAL);
        tcsetattr(&self.line, OptionalActions::Now, &termios)?;
        let checked = self.check(apply_settings(&self.line, baud), baud);
        self.settings.set(Settings::of(&tcgetattr(&self.line)?));
        checked
    }

    /// Returns the settings that another process has changed. Returns `None` if they are unchanged.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub(crate) fn changed_settings(&self) -> io::Result<Option<SettingsChange>> {
        let (own, current) = (self.settings.get(), Settings::of(&tcgetattr(&self.line)?));
        Ok((current != own).then_some(match current.speed {
            speed if speed != own.speed => SettingsChange::Rate(speed),
            _ => SettingsChange::Settings,
        }))
    }

    /// Restores the settings of this process, at `baud`, and discards the input that arrived with other settings. If
    /// the driver rejects the rate, the line keeps its present rate, which is not an error: a search then tries other
    /// rates.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub(crate) fn restore(&self, baud: u32) -> io::Result<()> {
        let configured = self.configure(tcgetattr(&self.line)?, baud);
        clear_input(&self.line).map_err(|_| self.lost_line_error())?;
        // Discard the errors that the driver has counted, because with other settings every byte counts as an error.
        self.line_errors();
        match configured {
            Ok(()) | Err(PortError::Rate { .. }) => Ok(()),
            Err(error) => Err(io::Error::other(error.to_string())),
        }
    }

    /// Returns the device that the port's name resolved to when it was opened.
    pub fn device(&self) -> &Path {
        &self.device
    }

    /// Returns whether the line is a pty. If so, another program simulates the scanner.
    pub(crate) fn is_simulated(&self) -> bool {
        self.device.starts_with("/dev/pts")
    }

    /// Returns the driver's counters since the driver was loaded. Returns `None` if the driver has no counters.
    pub(crate) fn uart_counters(&self) -> Option<UartCounters> {
        UartCounters::of(&self.line).ok()
    }

    /// Returns the baud rate that the driver reports.
    pub(crate) fn baud(&self) -> Option<u32> {
        tcgetattr(&self.line).ok().map(|termios| termios.output_speed())
    }

    /// Returns the number of errors that the driver has counted since the last call. After a change of the baud rate,
    /// counting starts again.
    pub(crate) fn line_errors(&self) -> u64 {
        let Some(before) = self.errors.get() else { return 0 };
        let now = self.uart_counters().map_or(before, |counts| counts.errors());
        self.errors.set(Some(now));
        u64::from(now.wrapping_sub(before))
    }

    pub(crate) fn set_baud(&self, baud: u32) -> io::Result<()> {
        let applied = self.check(apply_baud(&self.line, baud), baud);
        if let Some(speed) = self.baud() {
            self.settings.set(Settings { speed, ..self.settings.get() });
        }
        clear_input(&self.line).map_err(|_| self.lost_line_error())?;
        // Discard the errors that the driver has counted, because at a wrong baud rate every byte counts as an error.
        self.line_errors();
        applied.map_err(|error| match error {
            PortError::Rate { .. } => io::Error::new(ErrorKind::Unsupported, error.to_string()),
            refusal => io::Error::other(refusal.to_string()),
        })
    }

    /// Asserts or clears DTR. A pty and some adapters do not have DTR. If DTR is asserted, it stays asserted after the
    /// line is closed.
    pub(crate) fn set_dtr(&self, on: bool) -> io::Result<()> {
        let mut termios = tcgetattr(&self.line)?;
        termios.control_modes.set(ControlModes::HUPCL, !on);
        tcsetattr(&self.line, OptionalActions::Now, &termios)?;
        match apply_dtr(&self.line, on) {
            Err(_) if self.baud().is_none() => Err(self.lost_line_error()),
            _ => Ok(()),
        }
    }

    /// Returns the number of bytes in the input buffer, if the driver reports it.
    pub(crate) fn buffered_bytes(&self) -> Option<usize> {
        rustix::io::ioctl_fionread(&self.line).ok().map(|waiting| waiting as usize)
    }

    pub(crate) fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match rustix::io::read(&self.line, buffer) {
            // With VMIN = 0, which some programs set, reading an empty buffer returns the same as the end of the line.
            Ok(0) if self.baud().is_some() => Ok(0),
            Ok(0) | Err(Errno::IO) => Err(hangup_error()),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            other => Ok(other?),
        }
    }

    pub(crate) fn write(&self, bytes: &[u8]) -> io::Result<()> {
        let written = write_all(&self.line, bytes);
        written.map_err(|error| if error == Errno::IO { hangup_error() } else { error.into() })
    }

    /// Checks the result of a change of settings, and the baud rate that the driver has set for `requested`. If the
    /// line is lost, reading its settings fails. Otherwise an error means that the driver rejected a setting, because
    /// the library does not keep the errno.
    fn check(&self, result: serialport::Result<()>, requested: u32) -> Result<(), PortError> {
        let actual = tcgetattr(&self.line)?.output_speed();
        check_rate(result.map_err(|_| Errno::INVAL), actual, requested)
    }

    /// Returns the error that reading the settings of a lost line reports.
    fn lost_line_error(&self) -> io::Error {
        tcgetattr(&self.line).err().unwrap_or(Errno::IO).into()
    }
}

impl AsFd for Tty {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.line.as_fd()
    }
}

impl Drop for Tty {
    fn drop(&mut self) {
        // End the exclusive mode, which would survive the close of a pty. The call has no effect on a line that hung
        // up.
        let _ = ioctl_tiocnxcl(&self.line);
    }
}

/// Settings of a line that decide whether bytes arrive as they were sent.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Settings {
    /// Baud rate in bits per second.
    speed: u32,
    input: InputModes,
    output: OutputModes,
    control: ControlModes,
    local: LocalModes,
    /// Number of bytes that a read waits for (VMIN).
    min: u8,
}

impl Settings {
    fn of(termios: &Termios) -> Settings {
        Settings {
            speed: termios.output_speed(),
            input: termios.input_modes,
            output: termios.output_modes,
            control: termios.control_modes & CHARACTER_MODES,
            local: termios.local_modes,
            min: termios.special_codes[SpecialCodeIndex::VMIN],
        }
    }
}

/// Change of an open line's settings by another process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SettingsChange {
    /// The baud rate has changed, in bits per second. Other settings may have changed as well.
    Rate(u32),
    /// Settings other than the baud rate have changed.
    Settings,
}

impl fmt::Display for SettingsChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SettingsChange::Rate(baud) => write!(f, "the port was set to {baud} baud by another process"),
            SettingsChange::Settings => f.write_str("the port's settings were changed by another process"),
        }
    }
}

/// Control modes that matter on an open line. HUPCL matters only when the line is closed, and the baud rate has a
/// separate field.
const CHARACTER_MODES: ControlModes = ControlModes::CSIZE
    .union(ControlModes::CSTOPB)
    .union(ControlModes::CREAD)
    .union(ControlModes::PARENB)
    .union(ControlModes::PARODD)
    .union(ControlModes::CMSPAR)
    .union(ControlModes::CLOCAL)
    .union(ControlModes::CRTSCTS);

/// Returns the error of a read after the adapter was unplugged, the other end of a pty was closed, or the line hung up.
fn hangup_error() -> io::Error {
    io::Error::new(ErrorKind::UnexpectedEof, "the line hung up")
}

/// Checks that `actual`, which a driver has set, is close to the `requested` baud rate. Some drivers set another rate,
/// and others reject a rate that they do not support.
fn check_rate(result: Result<(), Errno>, actual: u32, requested: u32) -> Result<(), PortError> {
    match result {
        Ok(()) | Err(Errno::INVAL) if !is_near(actual, requested) => {
            Err(PortError::Rate { requested, actual })
        }
        result => Ok(result?),
    }
}

/// Returns whether a UART at `actual` bits per second can receive from one at `requested`. At the middle of the last
/// bit, both ends together may be off by half a bit, so each end may be off by at most 3 %.
fn is_near(actual: u32, requested: u32) -> bool {
    u64::from(actual.abs_diff(requested)) * 100 <= u64::from(requested) * 3
}

/// Sets 8 data bits, 1 stop bit, no handshake (Telegram listing 4), and `baud`.
///
/// # Errors
///
/// Returns an error if the driver rejects a setting, or the line is lost. The library does not distinguish the two.
fn apply_settings(line: impl AsFd, baud: u32) -> serialport::Result<()> {
    with_library(line, |port| {
        if port.data_bits()? != DataBits::Eight {
            port.set_data_bits(DataBits::Eight)?;
        }
        if port.stop_bits()? != StopBits::One {
            port.set_stop_bits(StopBits::One)?;
        }
        if port.flow_control()? != FlowControl::None {
            port.set_flow_control(FlowControl::None)?;
        }
        set_rate(port, baud)
    })
}

/// Sets only the baud rate.
///
/// # Errors
///
/// Returns the same errors as [`apply_settings`].
fn apply_baud(line: impl AsFd, baud: u32) -> serialport::Result<()> {
    with_library(line, |port| set_rate(port, baud))
}

/// Asserts or clears DTR.
///
/// # Errors
///
/// Returns an error if the line does not have DTR, or is lost.
fn apply_dtr(line: impl AsFd, on: bool) -> serialport::Result<()> {
    with_library(line, |port| port.write_data_terminal_ready(on))
}

/// Discards the received bytes.
///
/// # Errors
///
/// Returns an error if the line is lost.
fn clear_input(line: impl AsFd) -> serialport::Result<()> {
    with_library(line, |port| port.clear(ClearBuffer::Input))
}

fn set_rate(port: &mut TTYPort, baud: u32) -> serialport::Result<()> {
    // The library returns an error if the baud rates of the two directions differ. In this case, set both rates.
    if port.baud_rate().ok() == Some(baud) { Ok(()) } else { port.set_baud_rate(baud) }
}

/// Calls `set` with `line` as a port of the library. This process must have locked the line before, because the library
/// locks it too.
fn with_library<T>(
    line: impl AsFd,
    set: impl FnOnce(&mut TTYPort) -> serialport::Result<T>,
) -> serialport::Result<T> {
    let line = line.as_fd();
    // SAFETY: the descriptor is open while it is borrowed, which is longer than `port` exists. `port` is never dropped,
    // so it neither closes the descriptor nor ends its exclusive mode.
    let mut port = ManuallyDrop::new(unsafe { TTYPort::from_raw_fd(line.as_raw_fd()) });
    set(&mut port)
}

/// Counters of a line since its driver was loaded. All of them wrap around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UartCounters {
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

impl UartCounters {
    /// Reads the counters from the driver of `line`.
    pub(crate) fn of(line: impl AsFd) -> Result<UartCounters, Errno> {
        let mut words = [0; STRUCT_WORDS];
        ioctl_words::<TIOCGICOUNT>(line.as_fd(), &mut words)?;
        Ok(UartCounters::from_words(&words))
    }

    /// Returns the total of all errors.
    pub fn errors(self) -> u32 {
        let UartCounters { received: _, framing, overrun, parity, breaks, buffer } = self;
        [framing, overrun, parity, breaks, buffer].into_iter().fold(0, u32::wrapping_add)
    }

    /// Creates the counters from the words of a `serial_icounter_struct`: cts dsr rng dcd rx tx frame overrun parity
    /// brk buf_overrun.
    fn from_words(words: &[u32; STRUCT_WORDS]) -> UartCounters {
        let [_, _, _, _, received, _, framing, overrun, parity, breaks, buffer, ..] = *words;
        UartCounters { received, framing, overrun, parity, breaks, buffer }
    }
}

/// Enables low latency in the driver, so that an FTDI adapter delivers bytes every millisecond instead of every 16 ms.
/// Also removes a custom divisor, which replaces the rate 38400 by another rate. An old `setserial` may have set it.
pub(super) fn set_low_latency(line: impl AsFd) -> Result<(), Errno> {
    let mut serial = [0; STRUCT_WORDS];
    ioctl_words::<TIOCGSERIAL>(line.as_fd(), &mut serial)?;
    let flags = serial[FLAGS_INDEX];
    serial[FLAGS_INDEX] = low_latency_flags(flags);
    if serial[FLAGS_INDEX] == flags { Ok(()) } else { ioctl_words::<TIOCSSERIAL>(line.as_fd(), &mut serial) }
}

/// Returns `flags` of a `serial_struct` with low latency and without a custom divisor.
fn low_latency_flags(flags: u32) -> u32 {
    (flags | ASYNC_LOW_LATENCY) & !ASYNC_SPD_MASK
}

fn ioctl_words<const OPCODE: Opcode>(
    line: BorrowedFd<'_>,
    words: &mut [u32; STRUCT_WORDS],
) -> Result<(), Errno> {
    // SAFETY: each opcode below makes the kernel read or write one structure at `words`. All fields of these structures
    // are plain numbers, and the longest has 80 bytes (linux/serial.h), which is the size of `words`.
    unsafe { ioctl(line, Updater::<OPCODE, _>::new(words)) }
}

/// Length of a `serial_icounter_struct` in words. A `serial_struct` is shorter.
const STRUCT_WORDS: usize = 20;
/// Index of the flags in a `serial_struct`.
const FLAGS_INDEX: usize = 4;
/// Bits of the flags (linux/tty_flags.h).
const ASYNC_LOW_LATENCY: u32 = 1 << 13;
const ASYNC_SPD_MASK: u32 = 1 << 12 | 1 << 5 | 1 << 4;
/// Numbers of ioctls (asm-generic/ioctls.h).
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;
const TIOCGICOUNT: Opcode = 0x545D;

/// Tracker of whether the driver's errors may be in the bytes that were read.
#[derive(Debug, Default)]
pub struct LineErrors {
    /// Whether the driver has counted errors since the last wait for bytes.
    is_current: bool,
    /// Whether the driver counted errors between the last two waits for bytes.
    was_previous: bool,
}

impl LineErrors {
    /// Records that a telegram was read, and that the driver has counted `errors` since the previous telegram. Returns
    /// whether an error may be in this telegram.
    pub fn note_telegram(&mut self, errors: u64) -> bool {
        self.is_current |= errors > 0;
        self.is_current || self.was_previous
    }

    /// Records the end of a read, after all of its telegrams were noted. The read had at least one telegram.
    pub fn note_read(&mut self) {
        self.was_previous = std::mem::take(&mut self.is_current);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::pty;

    #[test]
    fn accepts_rates_within_3_percent() {
        assert!(is_near(500_000, 500_000) && is_near(485_000, 500_000) && is_near(515_000, 500_000));
        // Baud rates that drivers set instead of 500 kBd if they do not support it.
        assert!(!is_near(460_800, 500_000) && !is_near(9600, 500_000) && !is_near(0, 500_000));
    }

    #[test]
    fn changes_by_another_process_are_detected_and_undone() {
        let (other, path) = pty();
        let tty = Tty::open(&path, 500_000).expect("it is free");
        let change = |change: &dyn Fn(&mut Termios)| {
            let mut termios = tcgetattr(&other).expect("a terminal");
            change(&mut termios);
            tcsetattr(&other, OptionalActions::Now, &termios).expect("a terminal");
            tty.changed_settings().expect("it is connected")
        };
        assert_eq!(change(&|_| {}), None);
        tty.set_baud(38_400).expect("a pty takes every rate");
        tty.set_dtr(true).expect("it is connected");
        assert_eq!(change(&|_| {}), None, "changes by this process");
        let rate = |termios: &mut Termios| termios.set_speed(9600).expect("a valid rate");
        let parity = |termios: &mut Termios| termios.input_modes.insert(InputModes::ISTRIP);
        let lines = |termios: &mut Termios| termios.local_modes.insert(LocalModes::ICANON);
        for (by, alteration) in [
            (&rate as &dyn Fn(&mut Termios), SettingsChange::Rate(9600)),
            (&parity, SettingsChange::Settings),
            (&lines, SettingsChange::Settings),
        ] {
            assert_eq!(change(by), Some(alteration));
            tty.restore(38_400).expect("it is connected");
            assert_eq!((tty.changed_settings().expect("it is connected"), tty.baud()), (None, Some(38_400)));
        }
    }

    #[test]
    fn empty_read_is_a_hang_up_only_if_line_is_lost() {
        let (other, path) = pty();
        let tty = Tty::open(&path, 500_000).expect("it is free");
        let mut termios = tcgetattr(&other).expect("a terminal");
        termios.special_codes[SpecialCodeIndex::VMIN] = 0;
        tcsetattr(&other, OptionalActions::Now, &termios).expect("a terminal");
        assert_eq!(tty.read(&mut [0; 8]).expect("it is connected"), 0);
        drop(other);
        assert_eq!(tty.read(&mut [0; 8]).map_err(|error| error.kind()), Err(ErrorKind::UnexpectedEof));
    }

    #[test]
    fn distinguishes_a_refused_rate_from_a_dead_line() {
        let no_rate = |given| Err(PortError::Rate { requested: 500_000, actual: given });
        assert_eq!(check_rate(Ok(()), 500_000, 500_000), Ok(()));
        assert_eq!(check_rate(Ok(()), 460_800, 500_000), no_rate(460_800));
        assert_eq!(check_rate(Err(Errno::INVAL), 38_400, 500_000), no_rate(38_400));
        // The driver supports the rate, but rejects another setting.
        assert_eq!(check_rate(Err(Errno::INVAL), 500_000, 500_000), Err(PortError::Other(Errno::INVAL)));
        assert_eq!(check_rate(Err(Errno::IO), 38_400, 500_000), Err(PortError::NoDevice));
    }

    #[test]
    fn sums_the_line_error_counters() {
        let mut words = [0; STRUCT_WORDS];
        words[..11].copy_from_slice(&[9, 9, 9, 9, 1_000_000, 500, 1, 20, 300, 4000, 50_000]);
        let counts = UartCounters::from_words(&words);
        assert_eq!((counts.received, counts.errors()), (1_000_000, 54_321));
        assert_eq!((counts.overrun, counts.buffer), (20, 50_000));
        assert_eq!(UartCounters { framing: u32::MAX, ..counts }.errors(), 54_319);
    }

    #[test]
    fn low_latency_flags_clear_custom_divisor() {
        // ASYNC_SKIP_TEST and ASYNC_SPD_CUST, as setserial leaves them.
        assert_eq!(low_latency_flags(0x40 | 0x30), 0x2040);
        assert_eq!(low_latency_flags(0x2040), 0x2040);
    }

    #[test]
    fn pipe_has_no_counters_and_no_low_latency() {
        let (_, slave) = std::io::pipe().unwrap();
        assert_eq!(UartCounters::of(&slave), Err(Errno::NOTTY));
        assert_eq!(set_low_latency(&slave), Err(Errno::NOTTY));
    }

    #[test]
    fn line_errors_mark_the_current_and_next_telegram() {
        let mut errors = LineErrors::default();
        let mut read = |counts: &[u64]| {
            let marked: Vec<bool> = counts.iter().map(|&count| errors.note_telegram(count)).collect();
            errors.note_read();
            marked
        };
        assert_eq!(read(&[0]), [false]);
        assert_eq!(read(&[3]), [true]);
        assert_eq!(read(&[0]), [true]);
        assert_eq!(read(&[0]), [false]);
        // There are several telegrams in one read, so the error count of the first one applies to all of them.
        assert_eq!(read(&[1, 0, 0]), [true; 3]);
        assert_eq!(read(&[2]), [true]);
        assert_eq!(read(&[0, 0]), [true; 2]);
        assert_eq!(read(&[0]), [false]);
    }
}
