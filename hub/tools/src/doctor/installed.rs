//! What `hub/dist/install.sh` installs: the service with its program, and the udev rule. Reads only files. It is not a
//! fault if nothing is installed: a hub that is started by hand needs neither.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use port::Candidate;
use schema::regular;

use super::finding::Finding;
use super::program::{Build, VERSION, compare};
use super::system::System;

/// Whether the service is installed, starts this version, and runs if it shall; `hub` is the hub that lives, if one does.
pub(crate) fn service(system: &System, hub: Option<u32>) -> Finding {
    const NAME: &str = "service";
    let Some(unit) = system.first(&UNITS, UNIT) else {
        return Finding::skipped(NAME, "not installed; hub/dist/install.sh puts it in place");
    };
    if fs::read_link(&unit).is_ok_and(|target| target == Path::new("/dev/null")) {
        return Finding::ok(NAME, format!("{}: masked, never started", unit.display()));
    }
    let at = unit.display().to_string();
    let Some(program) = program(system, &unit) else {
        return Finding::failed(NAME, format!("{at} starts nothing"), INSTALL);
    };
    let place = system.path(&program);
    let build = match compare(&place, true) {
        Ok(Build::Same) => "this program".to_owned(),
        Ok(Build::Other(Some(version))) if version == VERSION => format!("another build of {VERSION}"),
        Ok(Build::Other(Some(version))) => {
            return Finding::warning(
                NAME,
                format!("{at} starts {}, version {version}; this is {VERSION}", program.display()),
                format!("{INSTALL}, then sudo systemctl restart scanhub"),
            );
        }
        Ok(Build::Other(None)) => "a program that does not report its version".to_owned(),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let text = format!("{at} starts {}, which is not there", program.display());
            return Finding::failed(NAME, text, INSTALL);
        }
        // What only root may read is root's business.
        Err(_) => "a program that this user may not read".to_owned(),
    };
    let text = format!("{at} starts {}: {build}", program.display());
    let is_booted = system.path("run/systemd/system").is_dir();
    match (is_enabled(system), is_running(system), hub) {
        (true, true, _) => Finding::ok(NAME, format!("{text}; enabled, runs")),
        (false, true, _) => Finding::ok(NAME, format!("{text}; runs, and is not enabled")),
        (true, false, None) if is_booted => Finding::failed(
            NAME,
            format!("{text}; enabled, and does not run"),
            "systemctl status scanhub shows the reason; sudo systemctl start scanhub",
        ),
        (true, false, _) => Finding::ok(NAME, format!("{text}; enabled, does not run")),
        (false, false, _) => {
            Finding::ok(NAME, format!("{text}; not enabled: sudo systemctl enable --now scanhub enables it"))
        }
    }
}

/// Whether the udev rule is installed, is that of this version, and has done its work for the adapters `there`.
pub(crate) fn rules(system: &System, there: &[Candidate]) -> Finding {
    const NAME: &str = "udev";
    let Some(path) = system.first(&RULES, RULE) else {
        return Finding::skipped(NAME, "no rule installed; hub/dist/install.sh puts it in place");
    };
    let at = path.display();
    match regular::read_text(&path, regular::LONGEST) {
        Ok(text) if text == TEXT => {}
        Ok(_) => {
            let text = format!("{at} belongs to another version");
            return Finding::warning(NAME, text, format!("{INSTALL}; give your own rule another name"));
        }
        Err(error) => return Finding::warning(NAME, format!("{at}: {error}"), INSTALL),
    }
    let links = fs::read_dir(system.path("dev/scanhub")).into_iter().flatten().flatten();
    let named: Vec<PathBuf> = links.filter_map(|entry| entry.path().canonicalize().ok()).collect();
    let is_adapter = |device: &Path| {
        let name = device.file_name().unwrap_or_default().to_string_lossy();
        ["ttyUSB", "ttyACM"].iter().any(|kind| name.starts_with(kind))
    };
    let adapters = there.iter().map(|port| port.device.as_path()).filter(|device| is_adapter(device));
    let without: Vec<String> = adapters
        .filter(|device| !named.iter().any(|named| named == device))
        .map(|it| it.display().to_string())
        .collect();
    if without.is_empty() {
        return Finding::ok(NAME, at.to_string());
    }
    Finding::warning(
        NAME,
        format!("{at} has not seen {}", without.join(", ")),
        "sudo udevadm control --reload && sudo udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial",
    )
}

/// The program that `unit` starts, its drop-ins included.
fn program(system: &System, unit: &Path) -> Option<PathBuf> {
    let directories: Vec<String> = UNITS.iter().map(|place| format!("{place}/{UNIT}.d")).collect();
    let mut program = None;
    for path in std::iter::once(unit.to_owned()).chain(system.drop_ins(&directories)) {
        let text = regular::read_text(&path, regular::LONGEST).unwrap_or_default();
        for line in text.lines() {
            let Some(said) = line.trim().strip_prefix("ExecStart=") else { continue };
            // Empty it takes back what stood before; signs in front of the path say how it is started.
            let words = said.trim().trim_start_matches(['@', '-', ':', '+', '!']);
            program = words.split_whitespace().next().map(PathBuf::from).filter(|path| path.is_absolute());
        }
    }
    program
}

/// Whether something starts it with the machine.
fn is_enabled(system: &System) -> bool {
    let directories = UNITS.iter().filter_map(|place| fs::read_dir(system.path(place)).ok());
    let mut entries = directories.flatten().flatten().map(|entry| entry.path());
    entries.any(|path| {
        let is_wish = path.extension().is_some_and(|kind| kind == "wants" || kind == "requires");
        is_wish && path.join(UNIT).symlink_metadata().is_ok()
    })
}

/// Whether processes of it live, as the kernel's list of its group tells.
fn is_running(system: &System) -> bool {
    let groups = ["", "unified/", "systemd/"]
        .map(|kind| format!("sys/fs/cgroup/{kind}system.slice/{UNIT}/cgroup.procs"));
    groups.iter().any(|path| system.text(path).is_some_and(|pids| !pids.trim().is_empty()))
}

const UNIT: &str = "scanhub.service";
const RULE: &str = "60-scanhub.rules";
/// The rule of this version.
const TEXT: &str = include_str!("../../../dist/60-scanhub.rules");
/// Where systemd looks for units and udev for rules, in their order.
const UNITS: [&str; 5] = [
    "etc/systemd/system",
    "run/systemd/system",
    "usr/local/lib/systemd/system",
    "usr/lib/systemd/system",
    "lib/systemd/system",
];
const RULES: [&str; 5] = [
    "etc/udev/rules.d",
    "run/udev/rules.d",
    "usr/local/lib/udev/rules.d",
    "usr/lib/udev/rules.d",
    "lib/udev/rules.d",
];
const INSTALL: &str = "sudo hub/dist/install.sh puts this version in place";

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::super::system::tests::Laid;
    use super::*;
    use port::found_in;

    const SERVICE: &str = include_str!("../../../dist/scanhub.service");

    #[test]
    fn a_service_is_absent_broken_asleep_or_well() {
        let laid = Laid::out(0, &[]);
        let of = |hub| service(&laid.system, hub);
        assert_eq!(of(None).state, State::Skipped);
        laid.put("etc/systemd/system/scanhub.service", SERVICE);
        let broken = of(None);
        assert!(
            broken.state == State::Failed && broken.finding.contains("/usr/local/bin/scanhub"),
            "{broken}"
        );
        fs::create_dir_all(laid.path("usr/local/bin")).unwrap();
        fs::copy(std::env::current_exe().unwrap(), laid.path("usr/local/bin/scanhub")).unwrap();
        assert!(of(None).state == State::Ok && of(None).finding.contains("not enabled"), "{}", of(None));
        laid.link(
            "/etc/systemd/system/scanhub.service",
            "etc/systemd/system/multi-user.target.wants/scanhub.service",
        );
        assert_eq!(of(None).state, State::Ok, "systemd does not run");
        fs::create_dir_all(laid.path("run/systemd/system")).unwrap();
        let asleep = of(None);
        assert!(asleep.state == State::Failed && asleep.remedy.contains("systemctl status"), "{asleep}");
        assert_eq!(of(Some(7)).state, State::Ok, "a hub that was started by hand");
        laid.put("sys/fs/cgroup/system.slice/scanhub.service/cgroup.procs", "7\n");
        assert!(of(None).finding.ends_with("this program; enabled, runs"), "{}", of(None));
        laid.put(
            "etc/systemd/system/scanhub.service.d/own.conf",
            "[Service]\nExecStart=\nExecStart=-/opt/scanhub run\n",
        );
        assert!(of(None).finding.contains("/opt/scanhub, which is not there"), "{}", of(None));
        fs::remove_file(laid.path("etc/systemd/system/scanhub.service")).unwrap();
        laid.link("/dev/null", "etc/systemd/system/scanhub.service");
        assert!(of(None).finding.contains("masked"), "{}", of(None));
    }

    #[test]
    fn a_rule_is_of_this_version_and_in_effect() {
        let laid = Laid::out(0, &[("dev/ttyUSB0", ""), ("sys/usb/idVendor", "0403\n")]);
        fs::create_dir_all(laid.path("sys/class/tty/ttyUSB0")).unwrap();
        laid.link(laid.path("sys/usb").to_str().unwrap(), "sys/class/tty/ttyUSB0/device");
        let there = found_in(&laid.path(""));
        assert_eq!(there.len(), 1);
        let of = || rules(&laid.system, &there);
        assert_eq!(of().state, State::Skipped);
        laid.put("etc/udev/rules.d/60-scanhub.rules", "# older\n");
        assert!(of().state == State::Warning && of().remedy.contains("install.sh"), "{}", of());
        laid.put("etc/udev/rules.d/60-scanhub.rules", TEXT);
        assert!(of().state == State::Warning && of().remedy.contains("udevadm trigger"), "{}", of());
        laid.link(laid.path("dev/ttyUSB0").to_str().unwrap(), "dev/scanhub/pci-0");
        assert_eq!(of().state, State::Ok);
    }
}
