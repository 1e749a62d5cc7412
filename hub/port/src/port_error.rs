//! Reasons why a port cannot be opened, with messages and remedies. An attempt to open the port returns only the
//! reason. Details, such as the process that has the port open or the ports that exist, are looked up only when the
//! failure is reported.

use std::fmt;
use std::io;
use std::path::Path;

use rustix::io::Errno;
use scanhub_schema::{Failure, Kind};

use super::access::{Holder, PortPermissions, holder, is_opened_here, lock_owner};
use super::serial_ports::{PortlessAdapter, SerialPortInfo, serial_ports};
use crate::PortSpec;

/// Reason why a port cannot be opened. Two attempts that fail for the same reason have equal errors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortError {
    /// Nothing exists at this path.
    Missing,
    /// The file is not a terminal.
    NotTty,
    /// This user has no permission.
    PermissionDenied,
    /// Another process uses the port.
    Busy,
    /// The device file exists, but the device does not.
    NoDevice,
    /// This process has no descriptor or thread left, or the kernel has no memory.
    ResourceExhausted(Errno),
    /// The driver sets a baud rate other than the requested one.
    Rate {
        /// Requested baud rate, in bits per second.
        requested: u32,
        /// Baud rate that the driver sets instead, in bits per second.
        actual: u32,
    },
    /// The name of the serial server cannot be resolved. Contains the reason.
    NoHost(String),
    /// The serial server runs, but does not accept a connection at this TCP port.
    Refused,
    /// The serial server does not reply.
    TimedOut,
    /// The serial server cannot be reached over the network. Contains the reason.
    Network(String),
    /// The caller stopped the attempt.
    Interrupted,
    /// The port is a recording, which cannot be opened as a line.
    Recording,
    /// Other error of the kernel.
    Other(Errno),
}

impl PortError {
    pub(crate) fn of_io(error: &io::Error) -> PortError {
        Errno::from_io_error(error).map_or(PortError::Other(Errno::IO), PortError::from)
    }

    /// Returns the failure to report for `spec`, with details and remedy. Looks up the details now.
    pub fn explain(&self, spec: &PortSpec) -> Failure {
        let name = spec.name();
        let path = Path::new(&name);
        let reason = self.to_string();
        let failure = |kind, hint: &str| Failure::new(kind, format!("{name}: {reason}"), hint);
        match self {
            PortError::Missing => missing_failure(path, &serial_ports(), &portless_adapters()),
            PortError::PermissionDenied => {
                let (what, remedy) = PortPermissions::of(path).explain(path);
                Failure::new(Kind::PortPermission, what, remedy)
            }
            // The owner of the lock certainly uses the port. Another program that has the port open may be harmless.
            PortError::Busy => match lock_owner(path).or_else(|| holder(path)) {
                None if is_opened_here(path) => Failure::new(
                    Kind::PortBusy,
                    format!("{name}: in use by another link of this hub"),
                    "name the port of each sensor",
                ),
                holder => busy_failure(path, holder),
            },
            PortError::NotTty if path.is_dir() => {
                let hint = format!(
                    "it is a directory; {}",
                    alternatives(&name, &serial_ports(), &portless_adapters())
                );
                failure(Kind::PortNotTty, &hint)
            }
            PortError::NotTty => failure(Kind::PortNotTty, "name a tty, or tcp:HOST:PORT"),
            PortError::NoDevice => {
                failure(Kind::PortMissing, &alternatives(&name, &serial_ports(), &portless_adapters()))
            }
            PortError::ResourceExhausted(Errno::AGAIN) => {
                failure(Kind::ResourceExhausted, "raise the limit of threads (ulimit -u)")
            }
            PortError::ResourceExhausted(_) => {
                failure(Kind::ResourceExhausted, "raise the limit of open descriptors (ulimit -n)")
            }
            PortError::Rate { requested: wanted, .. } => failure(Kind::PortRate, rate_remedy(*wanted)),
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
            PortError::Other(_) => failure(Kind::PortNotTty, "the kernel's log (dmesg) may show why"),
        }
    }
}

impl fmt::Display for PortError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PortError::Missing => f.write_str("no such port"),
            PortError::NotTty => f.write_str("not a serial line"),
            PortError::PermissionDenied => f.write_str("no permission"),
            PortError::Busy => f.write_str("in use"),
            PortError::NoDevice => {
                f.write_str("no such port: the device file exists, but the device does not")
            }
            PortError::ResourceExhausted(errno) => write!(f, "cannot be opened: {errno}"),
            PortError::Rate { requested: wanted, actual: given } => {
                write!(f, "the driver does not support {wanted} Bd, and sets {given} Bd instead")
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
            Errno::ACCESS | Errno::PERM => PortError::PermissionDenied,
            Errno::BUSY => PortError::Busy,
            Errno::NOTTY | Errno::ISDIR | Errno::NOTDIR => PortError::NotTty,
            // The device may be a UART that the board does not have, an adapter that was just unplugged, or a pty whose
            // master is closed.
            Errno::IO | Errno::NXIO | Errno::NODEV => PortError::NoDevice,
            Errno::MFILE | Errno::NFILE | Errno::NOMEM => PortError::ResourceExhausted(errno),
            errno => PortError::Other(errno),
        }
    }
}

/// Returns the adapters of this machine that have no port.
fn portless_adapters() -> Vec<PortlessAdapter> {
    PortlessAdapter::all(Path::new("/"))
}

fn missing_failure(path: &Path, ports: &[SerialPortInfo], portless: &[PortlessAdapter]) -> Failure {
    let name = path.display().to_string();
    let what = match path.read_link() {
        Ok(target) => {
            format!("{name}: no such port: it points to {}, which does not exist", target.display())
        }
        Err(_) if path.starts_with("/dev/serial") => {
            format!("{name}: no such port: its adapter is not plugged in, or it is another adapter")
        }
        Err(_) => format!("{name}: no such port"),
    };
    Failure::new(Kind::PortMissing, what, alternatives(&name, ports, portless))
}

/// Returns the remedy for a port `name` that does not exist. It lists adapters without a port, which may be the cause,
/// and the ports of this machine. The ports with the most similar names come first.
fn alternatives(name: &str, ports: &[SerialPortInfo], portless: &[PortlessAdapter]) -> String {
    let mut sorted: Vec<&SerialPortInfo> = ports.iter().collect();
    sorted.sort_by_key(|candidate| {
        let names = [&candidate.name, &candidate.device];
        names.map(|known| strsim::levenshtein(name, &known.to_string_lossy())).into_iter().min()
    });
    let mut hints: Vec<String> =
        portless.iter().map(|adapter| format!("{adapter}; {}", adapter.remedy())).collect();
    if !sorted.is_empty() {
        let names: Vec<String> = sorted.iter().map(|candidate| candidate.to_string()).collect();
        hints.push(format!("existing ports: {}", names.join(", ")));
    }
    if hints.is_empty() { "no serial line is plugged in".to_owned() } else { hints.join("; ") }
}

fn busy_failure(path: &Path, holder: Option<Holder>) -> Failure {
    let name = path.display();
    let (owner, remedy) = match holder {
        None => (
            "another process".to_owned(),
            format!("stop it first; sudo fuser -v {name} shows which process it is"),
        ),
        Some(holder) => {
            let remedy = match holder.program.as_str() {
                "ModemManager" => {
                    "stop it first (sudo systemctl stop ModemManager), or exclude the port with a udev rule: \
                     ENV{ID_MM_DEVICE_IGNORE}=\"1\""
                }
                "brltty" => "stop it first: without a Braille display, sudo apt remove brltty",
                "agetty" | "getty" => {
                    "it waits for a login: stop it first (sudo systemctl stop serial-getty@...)"
                }
                "systemd" => "the service manager keeps it open for a service: sudo systemctl stop scanhub",
                "gpsd" => "stop it first (sudo systemctl stop gpsd.socket gpsd)",
                "scanhub" => "stop it first, or subscribe to its sensors: scanhub list --domains",
                _ => "stop it first",
            };
            (holder.to_string(), remedy.to_owned())
        }
    };
    Failure::new(Kind::PortBusy, format!("{name}: in use by {owner}"), remedy)
}

fn rate_remedy(requested: u32) -> &'static str {
    if requested == 500_000 {
        "use an adapter with an FT232R, FT232H or FT4232H, or set baud = 38400; a UART with a 1.8432 MHz clock cannot do it"
    } else {
        "set another rate: baud = 38400, 19200 or 9600"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serial_ports::NoPortReason;

    #[test]
    fn explains_kernel_errors_with_kind_and_hint() {
        let source = PortSpec::Tty("/dev/full".into());
        for (refusal, kind, text) in [
            (Errno::NOTTY.into(), Kind::PortNotTty, "name a tty, or tcp:HOST:PORT"),
            (Errno::IO.into(), Kind::PortMissing, "the device does not"),
            (Errno::NXIO.into(), Kind::PortMissing, "the device does not"),
            (Errno::MFILE.into(), Kind::ResourceExhausted, "ulimit -n"),
            (PortError::ResourceExhausted(Errno::AGAIN), Kind::ResourceExhausted, "ulimit -u"),
            (Errno::LOOP.into(), Kind::PortNotTty, "its symbolic links form a loop"),
            (Errno::INVAL.into(), Kind::PortNotTty, "the kernel's log (dmesg)"),
            (Errno::PERM.into(), Kind::PortPermission, "/dev/full"),
            (Errno::BUSY.into(), Kind::PortBusy, "stop it first"),
            (
                PortError::Rate { requested: 500_000, actual: 115_200 },
                Kind::PortRate,
                "/dev/full: the driver does not support 500000 Bd, and sets 115200 Bd instead\n  use an adapter with an FT232R",
            ),
            (PortError::Rate { requested: 9600, actual: 0 }, Kind::PortRate, "set another rate"),
        ] {
            let failure = PortError::explain(&refusal, &source);
            assert_eq!(failure.kind, kind, "{failure}");
            assert!(failure.to_string().contains(text) && !failure.hint.is_empty(), "{failure}");
        }
    }

    #[test]
    fn suggests_the_most_similar_port_first() {
        let candidate = |name: &str, device: &str| SerialPortInfo {
            name: name.into(),
            device: device.into(),
            shared_name: None,
            driver: Some("ftdi_sio".to_owned()),
            product: None,
            holder: None,
            is_permitted: true,
        };
        let candidates = [
            candidate("/dev/serial/by-id/usb-FTDI-A-if00-port0", "/dev/ttyUSB1"),
            candidate("/dev/serial/by-id/usb-Prolific-if00-port0", "/dev/ttyUSB0"),
            candidate("/dev/ttyS0", "/dev/ttyS0"),
        ];
        let first = |name: &str| {
            let hint = missing_failure(Path::new(name), &candidates, &[]).hint;
            hint.split([' ', ',']).nth(2).map(str::to_owned).unwrap_or_default()
        };
        assert_eq!(first("/dev/ttyUSB1"), "/dev/serial/by-id/usb-FTDI-A-if00-port0");
        assert_eq!(
            first("/dev/serial/by-id/usb-Prolific-if00-port1"),
            candidates[1].name.display().to_string()
        );
        assert_eq!(first("/dev/ttyS1"), "/dev/ttyS0");
        let adapter = PortlessAdapter {
            usb: "1-1".to_owned(),
            id: "1a86:7523".to_owned(),
            chip: "CH340",
            module: "ch341",
            reason: NoPortReason::NotLoaded,
        };
        let hint = missing_failure(Path::new("/dev/ttyUSB7"), &candidates[2..], &[adapter]).hint;
        assert!(hint.starts_with("USB adapter 1-1 (CH340, 1a86:7523) has no port: "), "{hint}");
        assert!(
            hint.contains("sudo modprobe ch341") && hint.ends_with("; existing ports: /dev/ttyS0 (ftdi_sio)"),
            "{hint}"
        );
        assert_eq!(missing_failure(Path::new("/dev/x"), &[], &[]).hint, "no serial line is plugged in");
    }

    #[test]
    fn busy_error_names_the_holder_and_the_remedy() {
        for (program, text) in [
            ("ModemManager", "systemctl stop ModemManager"),
            ("brltty", "apt remove brltty"),
            ("agetty", "serial-getty"),
            ("scanhub", "scanhub list --domains"),
            ("systemd", "systemctl stop scanhub"),
            ("minicom", "stop it first"),
        ] {
            let failure =
                busy_failure(Path::new("/dev/x"), Some(Holder { pid: 7, program: program.to_owned() }));
            assert!(failure.message.ends_with(&format!("in use by process 7 ({program})")), "{failure}");
            assert!(failure.hint.contains(text), "{failure}");
        }
        assert!(busy_failure(Path::new("/dev/x"), None).hint.contains("sudo fuser -v /dev/x"));
    }
}
