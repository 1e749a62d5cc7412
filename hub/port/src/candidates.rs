//! The serial lines of this machine: the permanent name of each, and what the kernel knows about it without opening it.

use std::fmt;
use std::fs;
use std::ops::RangeInclusive;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use rustix::fs::{Access, access, major, minor};

use super::holder::{Holder, holders};

/// A serial line of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// The permanent name, if there is one: below `/dev/serial`, else the device.
    pub name: PathBuf,
    /// The device itself.
    pub device: PathBuf,
    /// Its driver, such as `ftdi_sio`.
    pub driver: Option<String>,
    /// Maker and product, as its adapter reports them.
    pub product: Option<String>,
    /// The process that has it open, as far as this user may see.
    pub holder: Option<Holder>,
    /// Whether this user may open it.
    pub is_permitted: bool,
}

impl fmt::Display for Candidate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.name.display())?;
        match (&self.product, &self.driver) {
            (Some(words), _) | (None, Some(words)) => write!(f, " ({words})"),
            (None, None) => Ok(()),
        }
    }
}

/// The serial lines of this machine, USB adapters first. Opens none.
pub fn candidates() -> Vec<Candidate> {
    let mut found = found_in(Path::new("/"));
    let devices: Vec<&Path> = found.iter().map(|candidate| candidate.device.as_path()).collect();
    let holders = holders(&devices);
    for (candidate, holders) in found.iter_mut().zip(holders) {
        candidate.holder = holders.into_iter().next();
        candidate.is_permitted = access(&candidate.device, Access::READ_OK | Access::WRITE_OK).is_ok();
    }
    found
}

/// The serial lines in `sys` and `dev` below `root`.
pub fn found_in(root: &Path) -> Vec<Candidate> {
    let stable: Vec<(PathBuf, PathBuf)> = ["by-id", "by-path"]
        .iter()
        .flat_map(|kind| entries(&root.join("dev/serial").join(kind)))
        .filter_map(|name| Some((name.canonicalize().ok()?, name)))
        .collect();
    let mut found: Vec<Candidate> = entries(&root.join("sys/class/tty"))
        .iter()
        .filter_map(|class| {
            let device = root.join("dev").join(class.file_name()?);
            // A terminal without hardware has no device; a UART that the driver did not find has type 0.
            let hardware = class.join("device").canonicalize().ok()?;
            if word(&class.join("type")).as_deref() == Some("0") || !device.exists() {
                return None;
            }
            let name = stable.iter().find(|(real, _)| *real == device).map(|(_, name)| name);
            Some(Candidate {
                name: name.unwrap_or(&device).clone(),
                driver: driver_of(&hardware),
                product: product_of(&hardware),
                device,
                holder: None,
                is_permitted: false,
            })
        })
        .collect();
    found.sort_by_key(|candidate| (candidate.product.is_none(), candidate.name.clone()));
    found
}

/// Whether `path` is a terminal, according to the kernel. It is not opened, because opening other devices can do harm: a
/// watchdog, a pipe that waits for its other end.
pub fn is_tty(path: &Path) -> bool {
    let Ok(metadata) = path.metadata() else { return false };
    if !metadata.file_type().is_char_device() {
        return false;
    }
    let (major, minor) = (major(metadata.rdev()), minor(metadata.rdev()));
    let known = Path::new("/sys/dev/char");
    match fs::read_link(known.join(format!("{major}:{minor}/subsystem"))) {
        Ok(subsystem) => subsystem.ends_with("tty"),
        // Ptys are not listed; without sysfs nothing is, and the terminal has to say it itself.
        Err(_) => UNIX98_PTYS.contains(&major) || !known.exists(),
    }
}

/// How long the adapter at `path` collects bytes before it hands them over, in milliseconds, if it reports that.
pub fn latency_ms(path: &Path) -> Option<u8> {
    let device = path.canonicalize().ok()?;
    latency_of(&Path::new("/sys/class/tty").join(device.file_name()?).join("device"))
}

fn latency_of(hardware: &Path) -> Option<u8> {
    word(&hardware.join("latency_timer"))?.parse().ok()
}

/// The driver of `hardware`, or of what it is a part of: since Linux 6.5 the UARTs of a board hang below a bus that has
/// no driver of its own.
fn driver_of(hardware: &Path) -> Option<String> {
    let mut drivers = hardware.ancestors().filter_map(|part| part.join("driver").canonicalize().ok());
    let driver = drivers.find(|driver| !driver.iter().any(|part| part == "serial-base"))?;
    Some(driver.file_name()?.to_string_lossy().into_owned())
}

/// What the USB device above `hardware` calls itself.
fn product_of(hardware: &Path) -> Option<String> {
    let usb = hardware.ancestors().find(|directory| directory.join("idVendor").exists())?;
    let words = ["manufacturer", "product"].map(|key| word(&usb.join(key)));
    let words: Vec<String> = words.into_iter().flatten().collect();
    if words.is_empty() {
        let ids = ["idVendor", "idProduct"].map(|key| word(&usb.join(key)).unwrap_or_default());
        return Some(format!("USB {}", ids.join(":")));
    }
    Some(words.join(" "))
}

/// What stands in a file, if anything does.
fn word(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

fn entries(directory: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// An adapter that collects bytes for longer blurs the stamps.
pub const PROMPT_MS: u8 = 2;
/// Majors of the ends of ptys that are opened by name (Linux, devices.txt).
const UNIX98_PTYS: RangeInclusive<u32> = 136..=143;

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname};
    use std::os::unix::fs::symlink;

    /// A machine with a USB adapter, a UART on the board, one that is not there, and a terminal without hardware.
    fn machine(root: &Path) {
        let directory = |path: &str| fs::create_dir_all(root.join(path)).unwrap();
        let file = |path: &str, text: &str| fs::write(root.join(path), text).unwrap();
        let link = |target: &str, path: &str| symlink(root.join(target), root.join(path)).unwrap();
        for name in ["ttyUSB0", "ttyS0", "ttyS1", "tty1"] {
            directory("dev/serial/by-id");
            directory(&format!("sys/class/tty/{name}"));
            file(&format!("dev/{name}"), "");
        }
        directory("sys/bus/ftdi_sio");
        directory("sys/usb1/1-1/1-1:1.0/ttyUSB0");
        file("sys/usb1/1-1/idVendor", "0403\n");
        file("sys/usb1/1-1/manufacturer", "FTDI\n");
        file("sys/usb1/1-1/product", "USB-RS422 Cable\n");
        file("sys/usb1/1-1/1-1:1.0/ttyUSB0/latency_timer", "16\n");
        link("sys/bus/ftdi_sio", "sys/usb1/1-1/1-1:1.0/ttyUSB0/driver");
        link("sys/usb1/1-1/1-1:1.0/ttyUSB0", "sys/class/tty/ttyUSB0/device");
        link("dev/ttyUSB0", "dev/serial/by-id/usb-FTDI_USB-RS422-if00-port0");
        directory("sys/pnp");
        for (name, kind) in [("ttyS0", "4\n"), ("ttyS1", "0\n")] {
            link("sys/pnp", &format!("sys/class/tty/{name}/device"));
            file(&format!("sys/class/tty/{name}/type"), kind);
        }
    }

    #[test]
    fn what_is_a_terminal_is_known_without_opening() {
        let pty = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&pty).unwrap();
        let name = ptsname(&pty, Vec::new()).unwrap();
        // Still locked: opening it would be refused.
        assert!(is_tty(Path::new(name.to_str().unwrap())));
        assert!(is_tty(Path::new("/dev/tty")));
        for other in ["/dev/null", "/dev/zero", "/dev", "/etc/hostname", "/dev/no-such-port"] {
            assert!(!is_tty(Path::new(other)), "{other}");
        }
    }

    #[test]
    fn what_is_known_without_opening() {
        let root = std::env::temp_dir().join(format!("scanhub-candidates-{}", std::process::id()));
        fs::create_dir_all(&root).unwrap();
        let root = root.canonicalize().unwrap();
        machine(&root);
        let found = found_in(&root);
        let latency = latency_of(&root.join("sys/class/tty/ttyUSB0/device"));
        fs::remove_dir_all(&root).unwrap();
        let [adapter, board] = &found[..] else { panic!("{found:?}") };
        assert_eq!(adapter.name, root.join("dev/serial/by-id/usb-FTDI_USB-RS422-if00-port0"));
        assert_eq!(adapter.device, root.join("dev/ttyUSB0"));
        assert_eq!(adapter.driver.as_deref(), Some("ftdi_sio"));
        assert_eq!(latency, Some(16));
        assert!(adapter.to_string().ends_with("port0 (FTDI USB-RS422 Cable)"), "{adapter}");
        assert_eq!((&board.name, &board.driver), (&root.join("dev/ttyS0"), &None));
        assert_eq!(board.to_string(), root.join("dev/ttyS0").display().to_string());
    }
}
