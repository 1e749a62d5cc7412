//! USB serial adapters that have no port: the kernel sees the adapter, and no driver has made a tty of it. Found by their
//! USB IDs in sysfs; nothing is opened.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use crate::candidates::{entries, word};

/// A USB serial adapter without a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortlessAdapter {
    /// USB socket, as the kernel's log names it, such as `1-1.2`.
    pub usb: String,
    /// Vendor and product ID, such as `1a86:7523`.
    pub id: String,
    /// Name of the chip, such as `CH340`.
    pub chip: &'static str,
    /// Kernel module that drives it, such as `ch341`.
    pub module: &'static str,
    /// Reason why it has no port.
    pub reason: Reason,
}

/// Reason why an adapter has no port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// brltty runs, which takes adapters away from their driver to look for a Braille display.
    Brltty {
        /// Process ID of brltty.
        pid: u32,
    },
    /// Another program uses the adapter directly, through usbfs.
    Claimed,
    /// The kernel has its tty, but no device file exists: a container was not given it.
    NoDevice {
        /// Name of the tty.
        tty: String,
    },
    /// The module is not loaded.
    NotLoaded,
    /// The running kernel has no such module.
    NotInstalled {
        /// Release of the kernel.
        release: String,
    },
    /// The module is loaded, and does not drive the adapter.
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
            let ids = ["idVendor", "idProduct"].map(|key| word(&link.join(key)).unwrap_or_default());
            let Some(&(_, _, chip, module)) =
                CHIPS.iter().find(|(vendor, product, ..)| ids[0] == *vendor && ids[1] == *product)
            else {
                continue;
            };
            let (Ok(device), Some(usb)) = (link.canonicalize(), link.file_name()) else { continue };
            let own = ttys.iter().find(|(_, hardware)| hardware.starts_with(&device));
            let reason = match own {
                Some((tty, _)) if root.join("dev").join(tty).exists() => continue,
                Some((tty, _)) => Reason::NoDevice { tty: tty.clone() },
                None => match *brltty.get_or_insert_with(|| process(root, "brltty")) {
                    Some(pid) => Reason::Brltty { pid },
                    None => driver_reason(root, &device, module),
                },
            };
            let usb = usb.to_string_lossy().into_owned();
            found.push(PortlessAdapter { usb, id: ids.join(":"), chip, module, reason });
        }
        found
    }

    /// Returns what to do about it.
    pub fn remedy(&self) -> String {
        let module = self.module;
        let again = "then unplug the adapter and plug it in again";
        match &self.reason {
            Reason::Brltty { .. } => format!("without a Braille display, sudo apt remove brltty, {again}"),
            Reason::Claimed => format!("end that program (sudo lsof /dev/bus/usb/*/* names it), {again}"),
            Reason::NoDevice { tty } => {
                format!("start the container with --device /dev/{tty}; on the machine itself, {UDEV}")
            }
            Reason::NotLoaded => format!(
                "sudo modprobe {module}; if a file disables it, grep -r {module} /etc/modprobe.d names the file"
            ),
            Reason::NotInstalled { release } => format!(
                "install the kernel's other modules (Ubuntu: sudo apt install linux-modules-extra-{release}), or a kernel \
                 that has {module}; after an update of the kernel, restart the machine"
            ),
            Reason::NotBound => {
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
            Reason::Brltty { pid } => write!(f, "brltty, process {pid}, takes it away from its driver"),
            Reason::Claimed => f.write_str("a program uses it directly, in place of its driver"),
            Reason::NoDevice { tty } => write!(f, "the kernel has {tty}, but there is no /dev/{tty}"),
            Reason::NotLoaded => write!(f, "the kernel module {module} is not loaded"),
            Reason::NotInstalled { release } => write!(f, "kernel {release} has no module {module}"),
            Reason::NotBound => write!(f, "the kernel module {module} does not drive it"),
        }
    }
}

/// Returns why no driver has made a tty of `device`, which `module` should drive.
fn driver_reason(root: &Path, device: &Path, module: &str) -> Reason {
    let interfaces = entries(device).into_iter().filter_map(|part| part.join("driver").canonicalize().ok());
    if interfaces.into_iter().any(|driver| driver.ends_with("usbfs")) {
        return Reason::Claimed;
    }
    let is_loaded = [format!("sys/bus/usb/drivers/{module}"), format!("sys/module/{module}")];
    if is_loaded.iter().any(|path| root.join(path).exists()) {
        return Reason::NotBound;
    }
    let release = word(&root.join("proc/sys/kernel/osrelease")).unwrap_or_default();
    let lists = ["modules.dep", "modules.builtin"]
        .map(|list| fs::read_to_string(root.join("lib/modules").join(&release).join(list)));
    // A file name may have - where the module's name has _.
    let is_it = |path: &str| {
        let file = path.split(':').next().and_then(|path| path.rsplit('/').next()).unwrap_or_default();
        file.split(".ko").next().is_some_and(|name| name.replace('-', "_") == module)
    };
    let is_known = |list: &std::io::Result<String>| list.as_ref().is_ok_and(|list| list.lines().any(is_it));
    match lists.iter().any(is_known) {
        // A container has no list.
        false if lists.iter().any(Result::is_ok) => Reason::NotInstalled { release },
        _ => Reason::NotLoaded,
    }
}

/// Returns the process called `name`.
fn process(root: &Path, name: &str) -> Option<u32> {
    let is_it = |path: &PathBuf| word(&path.join("comm")).is_some_and(|comm| comm == name);
    let pid = |path: PathBuf| path.file_name()?.to_str()?.parse().ok();
    entries(&root.join("proc")).into_iter().filter(is_it).find_map(pid)
}

/// Command that creates missing device files.
const UDEV: &str = "sudo udevadm trigger --subsystem-match=tty";

/// Serial bridges of scanners and of the adapters that they are sold with: vendor, product, chip, kernel module (Linux,
/// `drivers/usb/serial/*.c`; the last ones have the class CDC ACM, `drivers/usb/class/cdc-acm.c`).
const CHIPS: [(&str, &str, &str, &str); 25] = [
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
    use crate::candidates::tests::Machine;

    /// A machine with one adapter that has no port.
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
        assert_eq!(adapter.reason, Reason::Brltty { pid: 812 });
        assert_eq!(
            adapter.to_string(),
            "USB adapter 1-1.2 (CH340, 1a86:7523) has no port: brltty, process 812, takes it away from its driver"
        );
        assert!(adapter.remedy().contains("sudo apt remove brltty"), "{}", adapter.remedy());
    }

    #[test]
    fn names_the_module_that_is_missing() {
        for (id, module) in [
            ("1a86:7523", "ch341"),
            ("10c4:ea60", "cp210x"),
            ("0403:6001", "ftdi_sio"),
            ("067b:2303", "pl2303"),
            ("0483:5740", "cdc_acm"),
        ] {
            let machine = machine(id);
            let adapter = only(&machine);
            assert_eq!((adapter.module, &adapter.reason), (module, &Reason::NotLoaded), "no list of modules");
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
            let reason = Reason::NotInstalled { release: "6.8.0-45-generic".to_owned() };
            assert_eq!(only(&machine).reason, reason);
            assert!(
                only(&machine)
                    .to_string()
                    .ends_with(&format!("kernel 6.8.0-45-generic has no module {module}"))
            );
            machine.file(list, &format!("kernel/drivers/usb/{}.ko.zst:\n", module.replace('_', "-")));
            assert_eq!(only(&machine).reason, Reason::NotLoaded);
        }
    }

    #[test]
    fn names_what_has_the_adapter_although_the_driver_is_loaded() {
        let machine = machine("10c4:ea60");
        machine.directory("sys/bus/usb/drivers/cp210x");
        assert_eq!(only(&machine).reason, Reason::NotBound);
        machine.directory("sys/bus/usb/drivers/usbfs");
        machine.link("sys/bus/usb/drivers/usbfs", "sys/devices/usb1/1-1.2/1-1.2:1.0/driver");
        assert_eq!(only(&machine).reason, Reason::Claimed);
    }

    #[test]
    fn the_udev_rule_keeps_modem_manager_away_from_every_chip() {
        let rule = include_str!("../../dist/60-scanhub.rules");
        let mut lines = rule.lines().filter(|line| line.ends_with("ENV{ID_MM_PORT_IGNORE}=\"1\""));
        let vendors: Vec<&str> =
            lines.next().and_then(|line| line.split('"').nth(1)).unwrap().split('|').collect();
        for (vendor, _, chip, _) in CHIPS {
            assert!(vendors.contains(&vendor), "{chip} of {vendor} is missing in {vendors:?}");
        }
    }

    #[test]
    fn an_adapter_with_a_port_is_fine() {
        let machine = machine("1a86:7523");
        machine.tty("ttyUSB0", "1-1.2", "ch341");
        assert_eq!(PortlessAdapter::all(&machine.root), []);
        fs::remove_file(machine.root.join("dev/ttyUSB0")).unwrap();
        let adapter = only(&machine);
        assert_eq!(adapter.reason, Reason::NoDevice { tty: "ttyUSB0".to_owned() });
        assert!(adapter.remedy().contains("--device /dev/ttyUSB0"), "{}", adapter.remedy());
        // Not a serial adapter.
        let other = Machine::new();
        other.usb("1-1", "046d:c52b", "");
        assert_eq!(PortlessAdapter::all(&other.root), []);
    }
}
