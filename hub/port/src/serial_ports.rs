//! Serial lines of this machine, with the permanent name of each and the properties that the kernel reports without
//! opening it. The module also lists the USB serial adapters that have no port, because no driver has created a tty for
//! them.

use std::ops::RangeInclusive;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::{fmt, fs, io};

use rustix::fs::{Access, access, major, minor};

use crate::PortError;
use crate::access::{Holder, holders};

/// Serial line of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialPortInfo {
    /// Permanent name: the name below `/dev/serial/by-id`. If another adapter shares that name, it is the name below
    /// `/dev/serial/by-path`, or the path of the device file if there is no name below `/dev/serial/by-path`.
    pub name: PathBuf,
    /// Path of the device file.
    pub device: PathBuf,
    /// Name below `/dev/serial/by-id` that this adapter shares with another one, because both have the same serial
    /// number or none. The name belongs to one of the two adapters, and possibly to the other one after a restart.
    pub shared_name: Option<PathBuf>,
    /// Driver, such as `ftdi_sio`.
    pub driver: Option<String>,
    /// Manufacturer and product that the adapter reports.
    pub product: Option<String>,
    /// Process that has the line open, if it is visible to this user.
    pub holder: Option<Holder>,
    /// Whether this user may open the line.
    pub is_permitted: bool,
}

impl SerialPortInfo {
    /// Returns the warning and the remedy for a user who wants to configure the port `path`. Returns `None` if there is
    /// no warning.
    pub fn caution(&self, path: &Path) -> Option<(String, String)> {
        if self.device.ends_with(PI_5_DEBUG_TTY) {
            let what = "the debug connector of a Raspberry Pi 5, not pins 8 and 10 of its header: by default, /dev/serial0 is this connector";
            let remedy = "for a scanner at pins 8 and 10, put dtparam=uart0=on into /boot/firmware/config.txt, restart, and use \
                          /dev/ttyAMA0";
            return Some((what.to_owned(), remedy.to_owned()));
        }
        let shared = self.shared_name.as_ref().filter(|shared| *shared == path)?.display();
        let what = format!(
            "two adapters with the same serial number, or without one, share {shared}: after a restart, it may name the other \
             one"
        );
        let remedy = if self.name == self.device {
            "there is no name below /dev/serial/by-path: name each adapter by its USB socket in a udev rule (KERNELS)".to_owned()
        } else {
            format!("use the name {}, which belongs to the USB socket", self.name.display())
        };
        Some((what, remedy))
    }
}

impl fmt::Display for SerialPortInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.name.display())?;
        match (&self.product, &self.driver) {
            (Some(text), _) | (None, Some(text)) => write!(f, " ({text})"),
            (None, None) => Ok(()),
        }
    }
}

/// Returns the serial lines of this machine, USB adapters first. Does not open any of them.
pub fn serial_ports() -> Vec<SerialPortInfo> {
    let mut found = serial_ports_in(Path::new("/"));
    let devices: Vec<&Path> = found.iter().map(|candidate| candidate.device.as_path()).collect();
    let holders = holders(&devices);
    for (candidate, holders) in found.iter_mut().zip(holders) {
        candidate.holder = holders.into_iter().next();
        candidate.is_permitted = access(&candidate.device, Access::READ_OK | Access::WRITE_OK).is_ok();
    }
    found
}

/// Returns the serial lines in `sys` and `dev` below `root`. Does not fill in the holder and the permission.
pub fn serial_ports_in(root: &Path) -> Vec<SerialPortInfo> {
    // Pairs of a device and one of its names.
    let [by_id, by_path] = ["by-id", "by-path"].map(|kind| -> Vec<(PathBuf, PathBuf)> {
        let names = entries(&root.join("dev/serial").join(kind)).into_iter();
        names.filter_map(|name| Some((name.canonicalize().ok()?, name))).collect()
    });
    let identities: Vec<(PathBuf, Vec<String>)> = entries(&root.join("sys/class/tty"))
        .iter()
        .filter_map(|class| {
            let device = root.join("dev").join(class.file_name()?);
            Some((device, identity_of(&class.join("device").canonicalize().ok()?)?))
        })
        .collect();
    let mut found: Vec<SerialPortInfo> = entries(&root.join("sys/class/tty"))
        .iter()
        .filter_map(|class| {
            let device = root.join("dev").join(class.file_name()?);
            // A terminal without hardware has no device, and a UART that the driver did not find has type 0.
            let hardware = class.join("device").canonicalize().ok()?;
            if read_word(&class.join("type")).as_deref() == Some("0") || !device.exists() {
                return None;
            }
            let own = identities.iter().find(|(other, _)| *other == device).map(|(_, identity)| identity);
            let same = identities.iter().filter(|(_, identity)| Some(identity) == own);
            let same_identity: Vec<&PathBuf> = same.map(|(device, _)| device).collect();
            let is_shared = same_identity.len() > 1;
            let name_in = |names: &[(PathBuf, PathBuf)]| {
                names.iter().find(|(real, _)| *real == device).map(|(_, name)| name.clone())
            };
            let shared_name = by_id.iter().find(|(real, _)| is_shared && same_identity.contains(&real));
            let name = if is_shared { None } else { name_in(&by_id) };
            Some(SerialPortInfo {
                name: name.or_else(|| name_in(&by_path)).unwrap_or_else(|| device.clone()),
                shared_name: shared_name.map(|(_, name)| name.clone()),
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

/// Returns whether `path` is a terminal, according to the kernel. The file is not opened, because opening a file that
/// is not a terminal can do harm. Examples are a watchdog, and a pipe whose other end is not open.
pub fn is_tty(path: &Path) -> bool {
    check_tty(path).is_ok()
}

/// Checks that `path` is a terminal, as [`is_tty`] does.
///
/// # Errors
///
/// Returns [`PortError::NoDevice`] if the device of a device file does not exist, for example in a container whose
/// `/dev` has a file for an unplugged adapter. Returns [`PortError::NotTty`] if `path` is another device or not a
/// device. Returns the kernel's error if the name cannot be resolved.
pub fn check_tty(path: &Path) -> Result<(), PortError> {
    check_tty_in(path, Path::new("/sys/dev/char"))
}

/// Checks `path` as [`check_tty`] does. `known` is the directory in which the kernel lists character devices.
fn check_tty_in(path: &Path, known: &Path) -> Result<(), PortError> {
    let metadata = path.metadata().map_err(|error| PortError::of_io(&error))?;
    if !metadata.file_type().is_char_device() {
        return Err(PortError::NotTty);
    }
    let (major, minor) = (major(metadata.rdev()), minor(metadata.rdev()));
    match fs::read_link(known.join(format!("{major}:{minor}/subsystem"))) {
        Ok(subsystem) if subsystem.ends_with("tty") => Ok(()),
        Ok(_) => Err(PortError::NotTty),
        // The kernel does not list ptys. Without sysfs, no device is listed.
        Err(error)
            if error.kind() == io::ErrorKind::NotFound && !UNIX98_PTYS.contains(&major) && known.exists() =>
        {
            Err(PortError::NoDevice)
        }
        // Opening the file will show whether it is a terminal.
        Err(_) => Ok(()),
    }
}

/// Returns whether two paths name the same line. Two different names with the same device number name the same line.
pub fn is_same_line(a: &Path, b: &Path) -> bool {
    let number = |path: &Path| {
        let metadata = fs::metadata(path).ok().filter(|metadata| metadata.file_type().is_char_device())?;
        Some(metadata.rdev())
    };
    let is_same_file = || a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    a == b || number(a).is_some_and(|a| Some(a) == number(b)) || is_same_file()
}

/// Returns the time for which the adapter at `path` collects bytes before it delivers them, in milliseconds. Returns
/// `None` if the adapter does not report it.
pub fn latency_ms(path: &Path) -> Option<u8> {
    let device = path.canonicalize().ok()?;
    latency_of(&Path::new("/sys/class/tty").join(device.file_name()?).join("device"))
}

fn latency_of(hardware: &Path) -> Option<u8> {
    read_word(&hardware.join("latency_timer"))?.parse().ok()
}

/// Returns the driver of `hardware`, or of a device that contains it. Since Linux 6.5, the UARTs of a board are below a
/// bus that has no real driver.
fn driver_of(hardware: &Path) -> Option<String> {
    let mut drivers = hardware.ancestors().filter_map(|part| part.join("driver").canonicalize().ok());
    let driver = drivers.find(|driver| !driver.iter().any(|part| part == "serial-base"))?;
    Some(driver.file_name()?.to_string_lossy().into_owned())
}

/// Returns the USB device that `hardware` belongs to.
fn usb_of(hardware: &Path) -> Option<&Path> {
    hardware.ancestors().find(|directory| directory.join("idVendor").exists())
}

/// Returns the properties from which udev derives the name below `/dev/serial/by-id` (60-serial.rules, usb_id). They
/// are the IDs and strings of the USB device, its interface, and the port. Returns `None` if `hardware` is not a USB
/// adapter.
fn identity_of(hardware: &Path) -> Option<Vec<String>> {
    let usb = usb_of(hardware)?;
    let of_device =
        ["idVendor", "idProduct", "manufacturer", "product", "serial"].map(|key| read_word(&usb.join(key)));
    let interface = hardware.ancestors().find_map(|part| read_word(&part.join("bInterfaceNumber")));
    let port = read_word(&hardware.join("port_number"));
    Some(of_device.into_iter().chain([interface, port]).map(Option::unwrap_or_default).collect())
}

/// Returns the manufacturer and product of the USB device above `hardware`, or its IDs.
fn product_of(hardware: &Path) -> Option<String> {
    let usb = usb_of(hardware)?;
    let words = ["manufacturer", "product"].map(|key| read_word(&usb.join(key)));
    let words: Vec<String> = words.into_iter().flatten().collect();
    if words.is_empty() {
        let ids = ["idVendor", "idProduct"].map(|key| read_word(&usb.join(key)).unwrap_or_default());
        return Some(format!("USB {}", ids.join(":")));
    }
    Some(words.join(" "))
}

/// Returns the text of a file without surrounding blanks. Returns `None` if it is empty or cannot be read.
pub(super) fn read_word(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

pub(super) fn entries(directory: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// Maximum time for which an adapter may collect bytes, in milliseconds. A longer time makes stamps inaccurate.
pub const MAX_LATENCY_MS: u8 = 2;
/// First UART of the processor of a Raspberry Pi 5 (alias `serial10` in its device tree). Only the debug connector uses
/// it.
const PI_5_DEBUG_TTY: &str = "ttyAMA10";
/// Major numbers of pty slaves (Linux, devices.txt).
const UNIX98_PTYS: RangeInclusive<u32> = 136..=143;

/// USB serial adapter without a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortlessAdapter {
    /// USB socket as the kernel's log names it, such as `1-1.2`.
    pub usb: String,
    /// Vendor and product ID, such as `1a86:7523`.
    pub id: String,
    /// Name of the chip, such as `CH340`.
    pub chip: &'static str,
    /// Name of the kernel module for the chip, such as `ch341`.
    pub module: &'static str,
    /// Reason why the adapter has no port.
    pub reason: NoPortReason,
}

/// Reason why an adapter has no port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NoPortReason {
    /// brltty is running. It detaches adapters from their driver to search for a Braille display.
    Brltty {
        /// Process ID of brltty.
        pid: u32,
    },
    /// Another program uses the adapter directly, through usbfs.
    Claimed,
    /// The kernel has a tty, but its device file does not exist, because a container lacks it.
    NoDevice {
        /// Name of the tty.
        tty: String,
    },
    /// The kernel module is not loaded.
    NotLoaded,
    /// The running kernel does not have the module.
    NotInstalled {
        /// Release of the kernel.
        release: String,
    },
    /// The module is loaded, but does not control the adapter.
    NotBound,
}

impl PortlessAdapter {
    /// Returns all adapters without a port on the machine whose files are below `root`.
    pub fn all(root: &Path) -> Vec<PortlessAdapter> {
        let ttys: Vec<(String, PathBuf)> = entries(&root.join("sys/class/tty"))
            .iter()
            .filter_map(|class| {
                let name = class.file_name()?.to_str()?.to_owned();
                Some((name, class.join("device").canonicalize().ok()?))
            })
            .collect();
        let mut brltty = None;
        let mut found = Vec::new();
        for link in entries(&root.join("sys/bus/usb/devices")) {
            let ids = ["idVendor", "idProduct"].map(|key| read_word(&link.join(key)).unwrap_or_default());
            let Some(&(_, _, chip, module)) =
                USB_CHIPS.iter().find(|(vendor, product, ..)| ids[0] == *vendor && ids[1] == *product)
            else {
                continue;
            };
            let (Ok(device), Some(usb)) = (link.canonicalize(), link.file_name()) else { continue };
            let own = ttys.iter().find(|(_, hardware)| hardware.starts_with(&device));
            let reason = match own {
                Some((tty, _)) if root.join("dev").join(tty).exists() => continue,
                Some((tty, _)) => NoPortReason::NoDevice { tty: tty.clone() },
                None => match *brltty.get_or_insert_with(|| find_process(root, "brltty")) {
                    Some(pid) => NoPortReason::Brltty { pid },
                    None => no_driver_reason(root, &device, module),
                },
            };
            let usb = usb.to_string_lossy().into_owned();
            found.push(PortlessAdapter { usb, id: ids.join(":"), chip, module, reason });
        }
        found
    }

    /// Returns the remedy.
    pub fn remedy(&self) -> String {
        let module = self.module;
        let replug = "then unplug the adapter and plug it in again";
        match &self.reason {
            NoPortReason::Brltty { .. } => {
                format!("without a Braille display, sudo apt remove brltty, {replug}")
            }
            NoPortReason::Claimed => {
                format!("end that program (sudo lsof /dev/bus/usb/*/* names it), {replug}")
            }
            NoPortReason::NoDevice { tty } => {
                format!("start the container with --device /dev/{tty}; on the machine itself, {UDEV_COMMAND}")
            }
            NoPortReason::NotLoaded => format!(
                "sudo modprobe {module}; if a file disables it, grep -r {module} /etc/modprobe.d names the file"
            ),
            NoPortReason::NotInstalled { release } => format!(
                "install the kernel's other modules (Ubuntu: sudo apt install linux-modules-extra-{release}), or a kernel \
                 that has {module}; after an update of the kernel, restart the machine"
            ),
            NoPortReason::NotBound => {
                "unplug it and plug it in again; dmesg shows why the driver refused it".to_owned()
            }
        }
    }
}

impl fmt::Display for PortlessAdapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PortlessAdapter { usb, id, chip, module, reason } = self;
        write!(f, "USB adapter {usb} ({chip}, {id}) has no port: ")?;
        match reason {
            NoPortReason::Brltty { pid } => write!(f, "brltty, process {pid}, takes it away from its driver"),
            NoPortReason::Claimed => f.write_str("a program uses it directly, in place of its driver"),
            NoPortReason::NoDevice { tty } => write!(f, "the kernel has {tty}, but there is no /dev/{tty}"),
            NoPortReason::NotLoaded => write!(f, "the kernel module {module} is not loaded"),
            NoPortReason::NotInstalled { release } => write!(f, "kernel {release} has no module {module}"),
            NoPortReason::NotBound => write!(f, "the kernel module {module} does not drive it"),
        }
    }
}

/// Returns the reason why there is no tty for `device`, whose kernel module is `module`.
fn no_driver_reason(root: &Path, device: &Path, module: &str) -> NoPortReason {
    let interfaces = entries(device).into_iter().filter_map(|part| part.join("driver").canonicalize().ok());
    if interfaces.into_iter().any(|driver| driver.ends_with("usbfs")) {
        return NoPortReason::Claimed;
    }
    let is_loaded = [format!("sys/bus/usb/drivers/{module}"), format!("sys/module/{module}")];
    if is_loaded.iter().any(|path| root.join(path).exists()) {
        return NoPortReason::NotBound;
    }
    let release = read_word(&root.join("proc/sys/kernel/osrelease")).unwrap_or_default();
    let lists = ["modules.dep", "modules.builtin"]
        .map(|list| fs::read_to_string(root.join("lib/modules").join(&release).join(list)));
    // A file name may have - where the name of the module has _.
    let is_module = |path: &str| {
        let file = path.split(':').next().and_then(|path| path.rsplit('/').next()).unwrap_or_default();
        file.split(".ko").next().is_some_and(|name| name.replace('-', "_") == module)
    };
    let is_known =
        |list: &std::io::Result<String>| list.as_ref().is_ok_and(|list| list.lines().any(is_module));
    match lists.iter().any(is_known) {
        // A container does not have the lists.
        false if lists.iter().any(Result::is_ok) => NoPortReason::NotInstalled { release },
        _ => NoPortReason::NotLoaded,
    }
}

/// Returns the ID of a process whose name is `name`.
fn find_process(root: &Path, name: &str) -> Option<u32> {
    let is_process = |path: &PathBuf| read_word(&path.join("comm")).is_some_and(|comm| comm == name);
    let pid = |path: PathBuf| path.file_name()?.to_str()?.parse().ok();
    entries(&root.join("proc")).into_iter().filter(is_process).find_map(pid)
}

/// Command that creates missing device files.
const UDEV_COMMAND: &str = "sudo udevadm trigger --subsystem-match=tty";

/// Serial bridges in scanners and in the adapters that are sold with them. Each entry has vendor ID, product ID, chip
/// and kernel module (Linux, `drivers/usb/serial/*.c`). The last entries have the class CDC ACM
/// (`drivers/usb/class/cdc-acm.c`).
const USB_CHIPS: [(&str, &str, &str, &str); 25] = [
    ("1a86", "7523", "CH340", "ch341"),
    ("1a86", "7522", "CH340", "ch341"),
    ("1a86", "5523", "CH341", "ch341"),
    ("10c4", "ea60", "CP210x", "cp210x"),
    ("10c4", "ea70", "CP2105", "cp210x"),
    ("10c4", "ea71", "CP2108", "cp210x"),
    ("0403", "6001", "FT232R", "ftdi_sio"),
    ("0403", "6010", "FT2232H", "ftdi_sio"),
    ("0403", "6011", "FT4232H", "ftdi_sio"),
    ("0403", "6014", "FT232H", "ftdi_sio"),
    ("0403", "6015", "FT230X", "ftdi_sio"),
    ("067b", "2303", "PL2303", "pl2303"),
    ("067b", "23a3", "PL2303GC", "pl2303"),
    ("067b", "23b3", "PL2303GB", "pl2303"),
    ("067b", "23c3", "PL2303GT", "pl2303"),
    ("067b", "23d3", "PL2303GL", "pl2303"),
    ("067b", "23e3", "PL2303GE", "pl2303"),
    ("067b", "23f3", "PL2303GS", "pl2303"),
    ("1a86", "55d2", "CH342", "cdc_acm"),
    ("1a86", "55d3", "CH343", "cdc_acm"),
    ("1a86", "55d4", "CH9102", "cdc_acm"),
    ("1a86", "55d5", "CH344", "cdc_acm"),
    ("0483", "5740", "STM32", "cdc_acm"),
    ("15d1", "0000", "Hokuyo", "cdc_acm"),
    ("28e9", "018a", "GD32", "cdc_acm"),
];

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname};
    use std::os::unix::fs::symlink;

    /// Simulated machine, whose files are below a temporary directory.
    pub(crate) struct Machine {
        pub(crate) root: PathBuf,
        _directory: tempfile::TempDir,
    }

    impl Machine {
        pub(crate) fn new() -> Machine {
            let directory = tempfile::tempdir().unwrap();
            Machine { root: directory.path().canonicalize().unwrap(), _directory: directory }
        }

        pub(crate) fn directory(&self, path: &str) {
            fs::create_dir_all(self.root.join(path)).unwrap();
        }

        pub(crate) fn file(&self, path: &str, text: &str) {
            let path = self.root.join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }

        pub(crate) fn link(&self, target: &str, path: &str) {
            let path = self.root.join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let _ = fs::remove_file(&path);
            symlink(self.root.join(target), path).unwrap();
        }

        /// Adds a USB device with one interface at `place`.
        pub(crate) fn usb(&self, place: &str, id: &str, serial: &str) {
            let (vendor, product) = id.split_once(':').unwrap();
            let device = format!("sys/devices/usb1/{place}");
            for (key, text) in [("idVendor", vendor), ("idProduct", product), ("serial", serial)] {
                self.file(&format!("{device}/{key}"), &format!("{text}\n"));
            }
            self.file(&format!("{device}/{place}:1.0/bInterfaceNumber"), "00\n");
            self.link(&device, &format!("sys/bus/usb/devices/{place}"));
            self.link(&format!("{device}/{place}:1.0"), &format!("sys/bus/usb/devices/{place}:1.0"));
        }

        /// Adds the tty `name` that `driver` creates for the USB device at `place`.
        pub(crate) fn tty(&self, name: &str, place: &str, driver: &str) {
            let hardware = format!("sys/devices/usb1/{place}/{place}:1.0/{name}");
            self.file(&format!("{hardware}/port_number"), "0\n");
            self.directory(&format!("sys/bus/usb-serial/drivers/{driver}"));
            self.link(&format!("sys/bus/usb-serial/drivers/{driver}"), &format!("{hardware}/driver"));
            self.link(&hardware, &format!("sys/class/tty/{name}/device"));
            self.file(&format!("dev/{name}"), "");
        }

        /// Adds a UART of the board, with the type that its driver has found.
        fn uart(&self, name: &str, kind: &str) {
            self.directory("sys/devices/pnp");
            self.link("sys/devices/pnp", &format!("sys/class/tty/{name}/device"));
            self.file(&format!("sys/class/tty/{name}/type"), kind);
            self.file(&format!("dev/{name}"), "");
        }
    }

    #[test]
    fn recognizes_a_tty_without_opening_it() {
        let pty = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&pty).unwrap();
        let name = ptsname(&pty, Vec::new()).unwrap();
        // The line is still locked, so opening it would fail.
        assert!(is_tty(Path::new(name.to_str().unwrap())));
        assert!(is_tty(Path::new("/dev/tty")));
        for other in ["/dev/null", "/dev/zero", "/dev", "/etc/hostname", "/dev/no-such-port"] {
            assert!(!is_tty(Path::new(other)), "{other}");
        }
    }

    #[test]
    fn device_file_without_a_device_is_an_error() {
        let machine = Machine::new();
        let known = machine.root.join("sys/dev/char");
        let check = |path: &str| check_tty_in(Path::new(path), &known);
        assert_eq!(check("/dev/null"), Ok(()), "without sysfs the device has to say it itself");
        machine.directory("sys/dev/char");
        assert_eq!(check("/dev/null"), Err(PortError::NoDevice));
        for (subsystem, expected) in [("mem", Err(PortError::NotTty)), ("tty", Ok(()))] {
            machine.directory(&format!("sys/class/{subsystem}"));
            machine.link(&format!("sys/class/{subsystem}"), "sys/dev/char/1:3/subsystem");
            assert_eq!(check("/dev/null"), expected);
        }
        assert_eq!(check("/proc/self/exe"), Err(PortError::NotTty));
        assert_eq!(check("/dev/no-such-port"), Err(PortError::Missing));
    }

    #[test]
    fn describes_ports_without_opening_them() {
        let machine = Machine::new();
        machine.usb("1-1", "0403:6001", "A1");
        machine.file("sys/devices/usb1/1-1/manufacturer", "FTDI\n");
        machine.file("sys/devices/usb1/1-1/product", "USB-RS422 Cable\n");
        machine.tty("ttyUSB0", "1-1", "ftdi_sio");
        machine.file("sys/devices/usb1/1-1/1-1:1.0/ttyUSB0/latency_timer", "16\n");
        let by_id = "dev/serial/by-id/usb-FTDI_USB-RS422-if00-port0";
        machine.link("dev/ttyUSB0", by_id);
        machine.uart("ttyS0", "4\n");
        // `ttyS1` is a UART that the board does not have, and `tty1` is a terminal without hardware.
        machine.uart("ttyS1", "0\n");
        machine.directory("sys/class/tty/tty1");
        machine.file("dev/tty1", "");
        let root = &machine.root;
        let found = serial_ports_in(root);
        let [adapter, board] = &found[..] else { panic!("{found:?}") };
        assert_eq!((&adapter.name, &adapter.device), (&root.join(by_id), &root.join("dev/ttyUSB0")));
        assert_eq!(adapter.driver.as_deref(), Some("ftdi_sio"));
        assert_eq!(latency_of(&root.join("sys/class/tty/ttyUSB0/device")), Some(16));
        assert!(adapter.to_string().ends_with("port0 (FTDI USB-RS422 Cable)"), "{adapter}");
        assert_eq!((&board.name, &board.driver), (&root.join("dev/ttyS0"), &None));
        assert_eq!(board.to_string(), root.join("dev/ttyS0").display().to_string());
        assert_eq!([adapter, board].map(|port| port.caution(&port.name)), [None, None]);
    }

    #[test]
    fn adapters_with_equal_serials_are_named_by_socket() {
        let machine = Machine::new();
        for (tty, place) in [("ttyUSB0", "1-1"), ("ttyUSB1", "1-2")] {
            machine.usb(place, "10c4:ea60", "0001");
            machine.tty(tty, place, "cp210x");
            machine.link(
                &format!("dev/{tty}"),
                &format!("dev/serial/by-path/pci-0000:00:14.0-usb-0:{place}:1.0-port0"),
            );
        }
        let by_id = "dev/serial/by-id/usb-Silicon_Labs_CP2102_0001-if00-port0";
        // udev gives the name to one of the adapters, and to the other one after a restart.
        for owner in ["ttyUSB0", "ttyUSB1"] {
            machine.link(&format!("dev/{owner}"), by_id);
            let found = serial_ports_in(&machine.root);
            let names: Vec<_> = found.iter().map(|candidate| candidate.name.file_name().unwrap()).collect();
            assert_eq!(
                names,
                ["pci-0000:00:14.0-usb-0:1-1:1.0-port0", "pci-0000:00:14.0-usb-0:1-2:1.0-port0"]
            );
            for candidate in &found {
                assert_eq!(candidate.shared_name, Some(machine.root.join(by_id)), "{owner}");
                let (problem, remedy) = candidate.caution(&machine.root.join(by_id)).unwrap();
                assert_eq!(candidate.caution(&candidate.name), None);
                assert!(
                    problem.contains("same serial number") && problem.contains("_0001-if00"),
                    "{problem}"
                );
                assert!(remedy.contains("by-path/pci-0000:00:14.0-usb-0:1-"), "{remedy}");
            }
        }
        // Different serial numbers give different names.
        machine.usb("1-2", "10c4:ea60", "0002");
        let found = serial_ports_in(&machine.root);
        assert!(found.iter().all(|candidate| candidate.shared_name.is_none()), "{found:?}");
        assert!(found.iter().any(|candidate| candidate.name == machine.root.join(by_id)), "{found:?}");
    }

    #[test]
    fn debug_connector_of_a_raspberry_pi_5_is_named() {
        let machine = Machine::new();
        machine.uart("ttyAMA10", "32\n");
        machine.link("dev/ttyAMA10", "dev/serial0");
        let found = serial_ports_in(&machine.root);
        let [debug] = &found[..] else { panic!("{found:?}") };
        let (problem, remedy) = debug.caution(Path::new("/dev/serial0")).unwrap();
        assert!(problem.contains("debug connector") && problem.contains("/dev/serial0"), "{problem}");
        assert!(remedy.contains("dtparam=uart0=on") && remedy.contains("/dev/ttyAMA0"), "{remedy}");
    }

    /// Creates a machine with one adapter that has no port.
    fn machine(id: &str) -> Machine {
        let machine = Machine::new();
        machine.usb("1-1.2", id, "");
        machine.file("proc/sys/kernel/osrelease", "6.8.0-45-generic\n");
        machine
    }

    fn only(machine: &Machine) -> PortlessAdapter {
        let found = PortlessAdapter::all(&machine.root);
        let [adapter] = &found[..] else { panic!("{found:?}") };
        adapter.clone()
    }

    #[test]
    fn names_brltty_if_it_runs() {
        let machine = machine("1a86:7523");
        machine.directory("sys/bus/usb/drivers/ch341");
        machine.file("proc/812/comm", "brltty\n");
        let adapter = only(&machine);
        assert_eq!(adapter.reason, NoPortReason::Brltty { pid: 812 });
        assert_eq!(
            adapter.to_string(),
            "USB adapter 1-1.2 (CH340, 1a86:7523) has no port: brltty, process 812, takes it away from its driver"
        );
        assert!(adapter.remedy().contains("sudo apt remove brltty"), "{}", adapter.remedy());
    }

    #[test]
    fn names_the_missing_kernel_module() {
        for (id, module) in [
            ("1a86:7523", "ch341"),
            ("10c4:ea60", "cp210x"),
            ("0403:6001", "ftdi_sio"),
            ("067b:2303", "pl2303"),
            ("0483:5740", "cdc_acm"),
        ] {
            let machine = machine(id);
            let adapter = only(&machine);
            assert_eq!(
                (adapter.module, &adapter.reason),
                (module, &NoPortReason::NotLoaded),
                "no list of modules"
            );
            assert!(
                adapter.remedy().starts_with(&format!("sudo modprobe {module};")),
                "{}",
                adapter.remedy()
            );
            let list = "lib/modules/6.8.0-45-generic/modules.dep";
            machine.file(
                list,
                "kernel/drivers/usb/serial/ch348.ko.zst: kernel/drivers/usb/serial/usbserial.ko.zst\n",
            );
            let reason = NoPortReason::NotInstalled { release: "6.8.0-45-generic".to_owned() };
            assert_eq!(only(&machine).reason, reason);
            assert!(
                only(&machine)
                    .to_string()
                    .ends_with(&format!("kernel 6.8.0-45-generic has no module {module}"))
            );
            machine.file(list, &format!("kernel/drivers/usb/{}.ko.zst:\n", module.replace('_', "-")));
            assert_eq!(only(&machine).reason, NoPortReason::NotLoaded);
        }
    }

    #[test]
    fn distinguishes_claimed_adapter_from_unbound_one() {
        let machine = machine("10c4:ea60");
        machine.directory("sys/bus/usb/drivers/cp210x");
        assert_eq!(only(&machine).reason, NoPortReason::NotBound);
        machine.directory("sys/bus/usb/drivers/usbfs");
        machine.link("sys/bus/usb/drivers/usbfs", "sys/devices/usb1/1-1.2/1-1.2:1.0/driver");
        assert_eq!(only(&machine).reason, NoPortReason::Claimed);
    }

    #[test]
    fn udev_rule_sets_mm_port_ignore_for_every_chip() {
        let rule = include_str!("../../dist/60-scanhub.rules");
        let mut lines = rule.lines().filter(|line| line.ends_with("ENV{ID_MM_PORT_IGNORE}=\"1\""));
        let vendors: Vec<&str> =
            lines.next().and_then(|line| line.split('"').nth(1)).unwrap().split('|').collect();
        for (vendor, _, chip, _) in USB_CHIPS {
            assert!(vendors.contains(&vendor), "{chip} of {vendor} is missing in {vendors:?}");
        }
    }

    #[test]
    fn only_adapters_without_a_port_are_reported() {
        let machine = machine("1a86:7523");
        machine.tty("ttyUSB0", "1-1.2", "ch341");
        assert_eq!(PortlessAdapter::all(&machine.root), []);
        fs::remove_file(machine.root.join("dev/ttyUSB0")).unwrap();
        let adapter = only(&machine);
        assert_eq!(adapter.reason, NoPortReason::NoDevice { tty: "ttyUSB0".to_owned() });
        assert!(adapter.remedy().contains("--device /dev/ttyUSB0"), "{}", adapter.remedy());
        // This USB device is not a serial adapter.
        let other = Machine::new();
        other.usb("1-1", "046d:c52b", "");
        assert_eq!(PortlessAdapter::all(&other.root), []);
    }
}
