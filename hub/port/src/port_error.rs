//! Why a port cannot be opened, and what to do about it. The reason is found by trying; its circumstances (which
//! process has it open, which other ports exist) are looked up once, when the failure is reported.

use std::fmt;
use std::io;
use std::path::Path;

use rustix::io::Errno;
use scanhub_schema::{Failure, Kind};

use super::access::{Holder, Rights, holder, is_own, lock_owner};
use super::candidates::{Candidate, PortlessAdapter, candidates};
use crate::Source;

/// Only the reason; equal as long as nothing changes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortError {
    /// Nothing exists at that path.
    Missing,
    /// Something exists, but it is not a terminal.
    NotTty,
    /// This user has no permission.
    Denied,
    /// Another process has it.
    Busy,
    /// The name exists, but no device behind it.
    Dead,
    /// This process has no descriptor or thread left, or the kernel no memory.
    Short(Errno),
    /// The driver sets another rate than the wanted one.
    Rate {
        /// The wanted rate, in Bd.
        wanted: u32,
        /// The rate that the driver sets instead.
        given: u32,
    },
    /// The serial server's name cannot be looked up.
    NoHost(String),
    /// The serial server runs, but accepts no connection at this port.
    Refused,
    /// The serial server does not answer.
    TimedOut,
    /// The network has no route to it.
    Network(String),
    /// The caller wanted to stop.
    Interrupted,
    /// It is a recording, not a line.
    Recording,
    /// Any other error of the kernel.
    Other(Errno),
}

impl PortError {
    pub(crate) fn of_io(error: &io::Error) -> PortError {
        Errno::from_io_error(error).map_or(PortError::Other(Errno::IO), PortError::from)
    }

    /// The reason with its circumstances at `source`, as they are now.
    pub fn explain(&self, source: &Source) -> Failure {
        let name = source.name();
        let path = Path::new(&name);
        let told = self.to_string();
        let failure = |kind, hint: &str| Failure::new(kind, format!("{name}: {told}"), hint);
        match self {
            PortError::Missing => missing(path, &candidates(), &portless()),
            PortError::Denied => {
                let (what, remedy) = Rights::of(path).explain(path);
                Failure::new(Kind::PortPermission, what, remedy)
            }
            // The owner of the lock is certain; a program that only has the port open may be harmless.
            PortError::Busy => match lock_owner(path).or_else(|| holder(path)) {
                None if is_own(path) => Failure::new(
                    Kind::PortBusy,
                    format!("{name}: in use by another link of this hub"),
                    "name the port of each sensor",
                ),
                holder => busy(path, holder),
            },
            PortError::NotTty if path.is_dir() => {
                let hint = format!("it is a directory; {}", instead(&name, &candidates(), &portless()));
                failure(Kind::PortNotTty, &hint)
            }
            PortError::NotTty => failure(Kind::PortNotTty, "name a tty, or tcp:HOST:PORT"),
            PortError::Dead => failure(Kind::PortMissing, &instead(&name, &candidates(), &portless())),
            PortError::Short(Errno::AGAIN) => failure(Kind::Short, "raise the limit of threads (ulimit -u)"),
            PortError::Short(_) => failure(Kind::Short, "raise the limit of open descriptors (ulimit -n)"),
            PortError::Rate { wanted, .. } => failure(Kind::PortRate, remedy_of_rate(*wanted)),
            PortError::NoHost(_) => {
                failure(Kind::PortMissing, "correct the name, or give the address instead")
            }
            PortError::Refused => failure(
                Kind::PortMissing,
                "nothing listens there, or it serves another client: the server's port must be in raw TCP mode",
            ),
            PortError::TimedOut => failure(Kind::PortMissing, "is it switched on, and is the address right?"),
            PortError::Network(_) => {
                failure(Kind::PortMissing, "is the network plugged in, and is there a route to it?")
            }
            PortError::Interrupted => Failure::new(Kind::Interrupted, "interrupted", ""),
            PortError::Recording => failure(Kind::Configuration, "name a tty, or tcp:HOST:PORT"),
            PortError::Other(Errno::LOOP) => failure(
                Kind::PortNotTty,
                "its symbolic links form a loop: correct them, or name another port",
            ),
            PortError::Other(Errno::NAMETOOLONG) => {
                failure(Kind::PortNotTty, "name a port with a shorter path")
            }
            PortError::Other(_) => {
                failure(Kind::PortNotTty, "the kernel refuses it; its log (dmesg) may show why")
            }
        }
    }
}

impl fmt::Display for PortError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PortError::Missing => f.write_str("no such port"),
            PortError::NotTty => f.write_str("not a serial line"),
            PortError::Denied => f.write_str("no permission"),
            PortError::Busy => f.write_str("in use"),
            PortError::Dead => f.write_str("no such port: the name exists, but no line behind it"),
            PortError::Short(errno) => write!(f, "cannot be opened: {errno}"),
            PortError::Rate { wanted, given } => {
                write!(f, "{wanted} Bd is not possible here, the driver gives {given} Bd")
            }
            PortError::NoHost(why) => write!(f, "no such host: {why}"),
            PortError::Refused => f.write_str("connection refused"),
            PortError::TimedOut => f.write_str("no answer"),
            PortError::Network(why) => write!(f, "cannot be reached: {why}"),
            PortError::Interrupted => f.write_str("interrupted"),
            PortError::Recording => f.write_str("a recording, not a line to a sensor"),
            PortError::Other(errno) => write!(f, "cannot be used as a serial line: {errno}"),
        }
    }
}

impl From<Errno> for PortError {
    fn from(errno: Errno) -> PortError {
        match errno {
            Errno::NOENT => PortError::Missing,
            Errno::ACCESS | Errno::PERM => PortError::Denied,
            Errno::BUSY => PortError::Busy,
            Errno::NOTTY | Errno::ISDIR | Errno::NOTDIR => PortError::NotTty,
            // A UART that the board does not have, an adapter that was pulled out a moment ago, half a pty.
            Errno::IO | Errno::NXIO | Errno::NODEV => PortError::Dead,
            Errno::MFILE | Errno::NFILE | Errno::NOMEM => PortError::Short(errno),
            errno => PortError::Other(errno),
        }
    }
}

/// The adapters of this machine that have no port.
fn portless() -> Vec<PortlessAdapter> {
    PortlessAdapter::all(Path::new("/"))
}

fn missing(path: &Path, there: &[Candidate], portless: &[PortlessAdapter]) -> Failure {
    let name = path.display().to_string();
    let what = match path.read_link() {
        Ok(target) => format!("{name}: no such port: it points to {}, which is not there", target.display()),
        Err(_) if path.starts_with("/dev/serial") => {
            format!("{name}: no such port: its adapter is not plugged in, or it is another adapter")
        }
        Err(_) => format!("{name}: no such port"),
    };
    Failure::new(Kind::PortMissing, what, instead(&name, there, portless))
}

/// Returns what to do where `name` does not exist: an adapter without a port may be the one, otherwise the ports of this machine
/// are named, the most similar names first.
fn instead(name: &str, there: &[Candidate], portless: &[PortlessAdapter]) -> String {
    let mut there: Vec<&Candidate> = there.iter().collect();
    there.sort_by_key(|candidate| {
        let names = [&candidate.name, &candidate.device];
        names.map(|known| strsim::levenshtein(name, &known.to_string_lossy())).into_iter().min()
    });
    let mut hints: Vec<String> =
        portless.iter().map(|adapter| format!("{adapter}; {}", adapter.remedy())).collect();
    if !there.is_empty() {
        let names: Vec<String> = there.iter().map(|candidate| candidate.to_string()).collect();
        hints.push(format!("there are: {}", names.join(", ")));
    }
    if hints.is_empty() { "no serial line is plugged in".to_owned() } else { hints.join("; ") }
}

fn busy(path: &Path, holder: Option<Holder>) -> Failure {
    let name = path.display();
    let (who, remedy) = match holder {
        None => {
            ("another process".to_owned(), format!("stop it first; sudo fuser -v {name} shows which it is"))
        }
        Some(holder) => {
            let remedy = match holder.program.as_str() {
                "ModemManager" => {
                    "stop it first (sudo systemctl stop ModemManager), or a udev rule keeps it away: \
                     ENV{ID_MM_DEVICE_IGNORE}=\"1\""
                }
                "brltty" => "stop it first: without a Braille display, sudo apt remove brltty",
                "agetty" | "getty" => {
                    "a login waits there: stop it first (sudo systemctl stop serial-getty@...)"
                }
                "systemd" => "the service manager keeps it open for a service: sudo systemctl stop scanhub",
                "gpsd" => "stop it first (sudo systemctl stop gpsd.socket gpsd)",
                "scanhub" => "stop it first, or listen to it: scanhub list --domains",
                _ => "stop it first",
            };
            (holder.to_string(), remedy.to_owned())
        }
    };
    Failure::new(Kind::PortBusy, format!("{name}: in use by {who}"), remedy)
}

fn remedy_of_rate(wanted: u32) -> &'static str {
    if wanted == 500_000 {
        "adapters with an FT232R, FT232H or FT4232H do it exactly; a UART clocked with 1.8432 MHz cannot: baud = 38400"
    } else {
        "set another rate: baud = 38400, 19200 or 9600"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidates::Reason;

    #[test]
    fn what_the_kernel_says_and_what_it_means() {
        let source = Source::Tty("/dev/full".into());
        for (refusal, kind, says) in [
            (Errno::NOTTY.into(), Kind::PortNotTty, "name a tty, or tcp:HOST:PORT"),
            (Errno::IO.into(), Kind::PortMissing, "no line behind it"),
            (Errno::NXIO.into(), Kind::PortMissing, "no line behind it"),
            (Errno::MFILE.into(), Kind::Short, "ulimit -n"),
            (PortError::Short(Errno::AGAIN), Kind::Short, "ulimit -u"),
            (Errno::LOOP.into(), Kind::PortNotTty, "its symbolic links form a loop"),
            (Errno::INVAL.into(), Kind::PortNotTty, "the kernel refuses it"),
            (Errno::PERM.into(), Kind::PortPermission, "/dev/full"),
            (Errno::BUSY.into(), Kind::PortBusy, "stop it first"),
            (
                PortError::Rate { wanted: 500_000, given: 115_200 },
                Kind::PortRate,
                "/dev/full: 500000 Bd is not possible here, the driver gives 115200 Bd\n  adapters with an FT232R",
            ),
            (PortError::Rate { wanted: 9600, given: 0 }, Kind::PortRate, "set another rate"),
        ] {
            let failure = PortError::explain(&refusal, &source);
            assert_eq!(failure.kind, kind, "{failure}");
            assert!(failure.to_string().contains(says) && !failure.hint.is_empty(), "{failure}");
        }
    }

    #[test]
    fn what_is_called_alike_stands_first() {
        let candidate = |name: &str, device: &str| Candidate {
            name: name.into(),
            device: device.into(),
            shared_name: None,
            driver: Some("ftdi_sio".to_owned()),
            product: None,
            holder: None,
            is_permitted: true,
        };
        let there = [
            candidate("/dev/serial/by-id/usb-FTDI-A-if00-port0", "/dev/ttyUSB1"),
            candidate("/dev/serial/by-id/usb-Prolific-if00-port0", "/dev/ttyUSB0"),
            candidate("/dev/ttyS0", "/dev/ttyS0"),
        ];
        let first = |name: &str| {
            let hint = missing(Path::new(name), &there, &[]).hint;
            hint.split([' ', ',']).nth(2).map(str::to_owned).unwrap_or_default()
        };
        assert_eq!(first("/dev/ttyUSB1"), "/dev/serial/by-id/usb-FTDI-A-if00-port0");
        assert_eq!(first("/dev/serial/by-id/usb-Prolific-if00-port1"), there[1].name.display().to_string());
        assert_eq!(first("/dev/ttyS1"), "/dev/ttyS0");
        let adapter = PortlessAdapter {
            usb: "1-1".to_owned(),
            id: "1a86:7523".to_owned(),
            chip: "CH340",
            module: "ch341",
            reason: Reason::NotLoaded,
        };
        let hint = missing(Path::new("/dev/ttyUSB7"), &there[2..], &[adapter]).hint;
        assert!(hint.starts_with("USB adapter 1-1 (CH340, 1a86:7523) has no port: "), "{hint}");
        assert!(
            hint.contains("sudo modprobe ch341") && hint.ends_with("; there are: /dev/ttyS0 (ftdi_sio)"),
            "{hint}"
        );
        assert_eq!(missing(Path::new("/dev/x"), &[], &[]).hint, "no serial line is plugged in");
    }

    #[test]
    fn who_has_it_and_how_to_get_it_back() {
        for (program, says) in [
            ("ModemManager", "systemctl stop ModemManager"),
            ("brltty", "apt remove brltty"),
            ("agetty", "serial-getty"),
            ("scanhub", "scanhub list --domains"),
            ("systemd", "systemctl stop scanhub"),
            ("minicom", "stop it first"),
        ] {
            let failure = busy(Path::new("/dev/x"), Some(Holder { pid: 7, program: program.to_owned() }));
            assert!(failure.message.ends_with(&format!("in use by process 7 ({program})")), "{failure}");
            assert!(failure.hint.contains(says), "{failure}");
        }
        assert!(busy(Path::new("/dev/x"), None).hint.contains("sudo fuser -v /dev/x"));
    }
}
