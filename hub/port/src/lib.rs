//! Where a link's bytes come from: a serial line, on this machine or behind a serial server. No caller knows how it is
//! opened, or what can go wrong then.

mod allowance;
mod candidates;
pub mod clock;
mod holder;
mod kernel;
mod line_errors;
mod line_settings;
mod port_error;
mod rights;
mod source;
mod tcp;
mod tty;
mod usb_adapter;

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use schema::Failure;

pub use allowance::Allowance;
pub use candidates::{Candidate, PROMPT_MS, candidates, check_tty, found_in, is_tty, latency_ms};
pub use holder::{Holder, all_holders, altering_program, holder};
pub use kernel::Counts;
pub use line_errors::LineErrors;
pub use port_error::PortError;
pub use rights::{Ownership, Rights};
pub use source::Source;
pub use tcp::{Dial, Tcp};
pub use tty::{Alteration, Tty};
pub use usb_adapter::{PortlessAdapter, Reason};

/// An open line to a sensor; reads and writes never block.
pub enum Port {
    /// A serial line, exclusive and raw.
    Tty(Tty),
    /// A connection to a serial server.
    Tcp(Tcp),
}

impl Port {
    /// Opens `source` at `baud`. Waits for a serial server, some seconds at most, or until `stop` is set.
    ///
    /// A failure of one of the port kinds, with its remedy; of kind `short` without descriptors, of kind
    /// `configuration` if it is a recording, of kind `interrupted` if `stop` is set.
    pub fn open(source: &Source, baud: u32, stop: &AtomicBool) -> Result<Port, Failure> {
        Port::attempt(source, baud, stop).map_err(|refusal| refusal.explain(source))
    }

    /// As [`Port::open`], for repeated tries: only the reason, without looking up its circumstances.
    pub fn attempt(source: &Source, baud: u32, stop: &AtomicBool) -> Result<Port, PortError> {
        match source {
            Source::Tty(path) => Tty::open(path, baud).map(Port::Tty),
            Source::Tcp { host, port } => Tcp::open(host, *port, stop).map(Port::Tcp),
            Source::File { .. } => Err(PortError::Recording),
        }
    }

    /// Continues with `line`, which an earlier hub had opened, if it still is what `source` names.
    pub fn adopt(line: OwnedFd, source: &Source, baud: u32) -> Option<Port> {
        match source {
            Source::Tty(path) => Tty::adopt(line, path, baud).ok().map(Port::Tty),
            // What stands in a connection that nobody reads is old, and the other end may have given up.
            Source::Tcp { .. } | Source::File { .. } => None,
        }
    }

    /// Whether `source` names the `line`, which is open.
    pub fn is_at(line: &OwnedFd, source: &Source) -> bool {
        matches!(source, Source::Tty(path) if Tty::is_at(line, path))
    }

    /// Whether another program simulates the sensor.
    pub fn simulated(&self) -> bool {
        match self {
            Port::Tty(tty) => tty.is_simulated(),
            Port::Tcp(_) => false,
        }
    }

    /// Starts to open `source` if that takes time; nothing if [`Port::attempt`] returns at once.
    pub fn dial(source: &Source) -> Option<Result<Dial, PortError>> {
        match source {
            Source::Tcp { host, port } => Some(Dial::start(host, *port)),
            _ => None,
        }
    }

    /// Changes the rate, and discards what arrived at the old one. An error of kind `Unsupported` means that the driver
    /// refused it or set another rate, or that it cannot be changed from here.
    pub fn set_baud(&self, baud: u32) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.set_baud(baud),
            Port::Tcp(_) => {
                let what = "the rate of a serial server is set there, by hand";
                Err(io::Error::new(io::ErrorKind::Unsupported, what))
            }
        }
    }

    /// Asserts DTR, or clears it; what has no such line ignores it.
    pub fn set_dtr(&self, on: bool) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.set_dtr(on),
            Port::Tcp(_) => Ok(()),
        }
    }

    /// As [`Port::set_baud`], for callers with other rates to try: returns the error if this rate is not possible.
    pub fn try_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        match self.set_baud(baud) {
            Err(error) if error.kind() == io::ErrorKind::Unsupported => Ok(Some(error)),
            other => other.map(|()| None),
        }
    }

    /// Discards what arrived, and uses `baud` from now on; a serial server keeps its own rate.
    pub fn discard_input(&self, baud: u32) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.set_baud(baud),
            Port::Tcp(tcp) => tcp.forget(),
        }
    }

    /// How many bytes there are to read; nothing if asking is not worth it.
    pub fn waiting(&self) -> Option<usize> {
        match self {
            Port::Tty(tty) => tty.waiting(),
            Port::Tcp(_) => None,
        }
    }

    /// How much may be read of it: of a serial line, which has a rate, all that there is.
    pub fn allowance(&self, baud: u32) -> Option<Allowance> {
        match self {
            Port::Tty(_) => None,
            Port::Tcp(_) => Some(Allowance::new(baud, clock::now())),
        }
    }

    /// Reads what there is: 0 bytes if nothing, an error if the line is gone.
    pub fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Port::Tty(tty) => tty.read(buffer),
            Port::Tcp(tcp) => tcp.read(buffer),
        }
    }

    /// Writes one byte; a full line drops it, as a cable would, and the request is tried again.
    pub fn write(&self, byte: u8) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.write(byte),
            Port::Tcp(tcp) => tcp.write(byte),
        }
    }
}

impl Port {
    /// Errors that the driver counted on the line since the last call; 0, without asking it, if it counts none.
    pub fn line_errors(&self) -> u64 {
        match self {
            Port::Tty(tty) => tty.line_errors(),
            Port::Tcp(_) => 0,
        }
    }

    /// What the driver counted on the line since it was loaded, if it counts.
    pub fn counts(&self) -> Option<Counts> {
        match self {
            Port::Tty(tty) => tty.counts(),
            Port::Tcp(_) => None,
        }
    }

    /// Returns the settings that another process has made since those of this process; `None` if they are unchanged, or
    /// made elsewhere.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn altered(&self) -> io::Result<Option<Alteration>> {
        match self {
            Port::Tty(tty) => tty.altered(),
            Port::Tcp(_) => Ok(None),
        }
    }

    /// Makes the settings of this process again, at `baud`, and discards the input that arrived with others. A rate that the
    /// driver refuses stays as it is; a search tries others.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    pub fn restore(&self, baud: u32) -> io::Result<()> {
        match self {
            Port::Tty(tty) => tty.restore(baud),
            Port::Tcp(_) => Ok(()),
        }
    }

    /// Returns the device that the port's name resolved to when it was opened; `None` for a serial server.
    pub fn device(&self) -> Option<&Path> {
        match self {
            Port::Tty(tty) => Some(tty.device()),
            Port::Tcp(_) => None,
        }
    }

    /// The rate that the driver reports; nothing if the rate is set elsewhere.
    pub fn baud(&self) -> Option<u32> {
        match self {
            Port::Tty(tty) => tty.baud(),
            Port::Tcp(_) => None,
        }
    }
}

impl AsFd for Port {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Port::Tty(tty) => tty.as_fd(),
            Port::Tcp(tcp) => tcp.as_fd(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use schema::Kind;

    static NEVER: AtomicBool = AtomicBool::new(false);

    fn refused(text: &str) -> Failure {
        let source = Source::parse(text).unwrap();
        Port::open(&source, 500_000, &NEVER).err().expect("cannot be opened")
    }

    #[test]
    fn a_rate_that_cannot_be_had_is_no_port_that_is_gone() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let source = Source::parse(&format!("tcp:{}", listener.local_addr().unwrap())).unwrap();
        let port = Port::open(&source, 9600, &NEVER).unwrap();
        assert!(port.try_baud(38_400).unwrap().is_some());
    }

    #[test]
    fn why_a_port_cannot_be_used() {
        assert_eq!(refused("/dev/no-such-port").kind, Kind::PortMissing);
        assert_eq!(refused("/dev/null").kind, Kind::PortNotTty);
        assert_eq!(refused("/etc/hostname").kind, Kind::PortNotTty);
        assert_eq!(refused("/").kind, Kind::PortNotTty);
        assert_eq!(refused("file:/etc/hostname").kind, Kind::Configuration);
    }
}
