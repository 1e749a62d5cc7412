//! Where a link's bytes come from: a serial line or a recording. Above this file nobody knows which.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, BorrowedFd, FromRawFd, IntoRawFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, QueueSelector, isatty, tcflush, tcgetattr, tcsetattr};
use schema::{Failure, Kind};

/// An open serial line, exclusive and raw; reads and writes never block.
pub(crate) struct Tty {
    line: File,
    /// Whether another program plays the sensor.
    pub(crate) simulated: bool,
}

impl Tty {
    /// Opens `path` at `baud`.
    ///
    /// [`Kind::PortMissing`], [`Kind::PortPermission`], [`Kind::PortBusy`] or [`Kind::PortNotTty`], each with its
    /// remedy.
    pub(crate) fn open(path: &Path, baud: u32) -> Result<Tty, Failure> {
        let busy = || {
            let who = holder(path).map_or("another process".to_owned(), |pid| format!("process {pid}"));
            Failure::new(Kind::PortBusy, format!("{}: in use by {who}", path.display()), "stop it first")
        };
        inspect(path).map_err(|error| match error.kind() {
            ErrorKind::ResourceBusy => busy(),
            kind => unusable(path, kind, &error),
        })?;
        let name = path.to_string_lossy();
        let port = serialport::new(name, baud).open_native().map_err(|error| match error.kind() {
            // The file was there and could be opened a moment ago: it is the lock that somebody else has.
            serialport::ErrorKind::NoDevice => busy(),
            serialport::ErrorKind::Io(kind) => unusable(path, kind, &error),
            _ => unusable(path, ErrorKind::Other, &error),
        })?;
        // SAFETY: into_raw_fd gives up the descriptor, which is open and which nobody else owns from here on.
        #[allow(unsafe_code)]
        let line = unsafe { File::from_raw_fd(port.into_raw_fd()) };
        let broken = |error: Errno| unusable(path, ErrorKind::Other, &error);
        fcntl_setfl(&line, fcntl_getfl(&line).map_err(broken)? | OFlags::NONBLOCK).map_err(broken)?;
        let simulated = path.canonicalize().is_ok_and(|real| real.starts_with("/dev/pts"));
        Ok(Tty { line, simulated })
    }

    /// Changes the rate, and forgets what came in at the old one.
    pub(crate) fn set_baud(&self, baud: u32) -> io::Result<()> {
        let mut termios = tcgetattr(&self.line)?;
        termios.set_speed(baud)?;
        tcsetattr(&self.line, OptionalActions::Now, &termios)?;
        Ok(tcflush(&self.line, QueueSelector::IFlush)?)
    }

    /// Reads what there is: 0 bytes if nothing, an error if the line is gone.
    pub(crate) fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match (&self.line).read(buffer) {
            Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(0),
            other => other,
        }
    }

    /// Writes one byte; a full line drops it, as a cable would, and the request is tried again.
    pub(crate) fn write(&self, byte: u8) -> io::Result<()> {
        match (&self.line).write(&[byte]) {
            Err(error) if !matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
                Err(error)
            }
            _ => Ok(()),
        }
    }
}

impl AsFd for Tty {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.line.as_fd()
    }
}

/// Opens and closes the port for the sake of the error that tells why it cannot be used.
fn inspect(path: &Path) -> io::Result<()> {
    let is_device = std::fs::metadata(path)?.file_type().is_char_device();
    if !is_device {
        return Err(Errno::NOTTY.into());
    }
    let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits() as i32;
    let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(path)?;
    if isatty(&file) { Ok(()) } else { Err(Errno::NOTTY.into()) }
}

fn unusable(path: &Path, kind: ErrorKind, error: &dyn std::fmt::Display) -> Failure {
    let place = path.display();
    match kind {
        ErrorKind::NotFound => {
            let others = serial_lines();
            let hint = if others.is_empty() {
                "no serial line is plugged in".to_owned()
            } else {
                format!("there are: {}", others.join(", "))
            };
            Failure::new(Kind::PortMissing, format!("{place}: no such port"), hint)
        }
        ErrorKind::PermissionDenied => {
            let group = std::fs::metadata(path).map_or(0, |metadata| metadata.gid());
            Failure::new(
                Kind::PortPermission,
                format!("{place}: no permission"),
                format!("it belongs to group {}: add this user to it and log in again", group_name(group)),
            )
        }
        _ => Failure::new(Kind::PortNotTty, format!("{place}: not a serial line ({error})"), "name a tty"),
    }
}

/// The serial lines of this machine, by the names that stay.
fn serial_lines() -> Vec<String> {
    let named = |directory: &str| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect()
    };
    let mut lines = named("/dev/serial/by-id");
    if lines.is_empty() {
        let is_serial = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("ttyUSB") || name.starts_with("ttyACM")
        };
        lines = named("/dev").into_iter().filter(is_serial).collect();
    }
    lines.sort();
    lines.iter().map(|path| path.display().to_string()).collect()
}

fn group_name(gid: u32) -> String {
    let groups = std::fs::read_to_string("/etc/group").unwrap_or_default();
    let line = groups.lines().find(|line| line.split(':').nth(2) == Some(&gid.to_string()));
    line.and_then(|line| line.split(':').next()).map_or(gid.to_string(), str::to_owned)
}

/// The process that has `path` open, as far as this user may see.
fn holder(path: &Path) -> Option<u32> {
    let device = path.canonicalize().ok()?;
    let processes = std::fs::read_dir("/proc").ok()?.flatten();
    processes.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).find(|pid: &u32| {
        let Ok(open) = std::fs::read_dir(format!("/proc/{pid}/fd")) else { return false };
        *pid != std::process::id()
            && open.flatten().any(|fd| std::fs::read_link(fd.path()).is_ok_and(|target| target == device))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(path: &str) -> Kind {
        Tty::open(Path::new(path), 500_000).err().expect("cannot be opened").kind
    }

    #[test]
    fn why_a_port_cannot_be_used() {
        assert_eq!(kind("/dev/no-such-port"), Kind::PortMissing);
        assert_eq!(kind("/dev/null"), Kind::PortNotTty);
        assert_eq!(kind("/etc/hostname"), Kind::PortNotTty);
        assert_eq!(kind("/"), Kind::PortNotTty);
    }
}
