//! Checks the files that systemd, udev and logind read: the service with its program and the udev rule, which
//! `hub/dist/install.sh` installs, and what logind does to shared memory at logout. Reads only files. A hub that is
//! started by hand needs neither service nor rule.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use port::Candidate;
use scanhub_files::regular;

use super::version::{Build, VERSION, compare};
use super::{Finding, System};

/// Checks whether the service is installed, starts this version, and runs if it is enabled. `hub` is the process of the
/// hub, if one runs.
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
        // A program that only root can read is not a problem.
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

/// Checks whether the udev rule of this version is installed, and has named the adapters `there`.
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

/// Returns the program that `unit` starts, with respect to its drop-in files.
fn program(system: &System, unit: &Path) -> Option<PathBuf> {
    let directories: Vec<String> = UNITS.iter().map(|place| format!("{place}/{UNIT}.d")).collect();
    let mut program = None;
    for path in std::iter::once(unit.to_owned()).chain(system.drop_ins(&directories)) {
        let text = regular::read_text(&path, regular::LONGEST).unwrap_or_default();
        for line in text.lines() {
            let Some(command) = line.trim().strip_prefix("ExecStart=") else { continue };
            // An empty value resets the setting. Characters before the path select how systemd starts it.
            let words = command.trim().trim_start_matches(['@', '-', ':', '+', '!']);
            program = words.split_whitespace().next().map(PathBuf::from).filter(|path| path.is_absolute());
        }
    }
    program
}

/// Returns whether another unit starts the service, such as at boot.
fn is_enabled(system: &System) -> bool {
    let directories = UNITS.iter().filter_map(|place| fs::read_dir(system.path(place)).ok());
    let mut entries = directories.flatten().flatten().map(|entry| entry.path());
    entries.any(|path| {
        let is_dependency = path.extension().is_some_and(|kind| kind == "wants" || kind == "requires");
        is_dependency && path.join(UNIT).symlink_metadata().is_ok()
    })
}

/// Returns whether the service has processes, by the kernel's list of its control group.
fn is_running(system: &System) -> bool {
    let groups = ["", "unified/", "systemd/"]
        .map(|kind| format!("sys/fs/cgroup/{kind}system.slice/{UNIT}/cgroup.procs"));
    groups.iter().any(|path| system.text(path).is_some_and(|pids| !pids.trim().is_empty()))
}

const UNIT: &str = "scanhub.service";
const RULE: &str = "60-scanhub.rules";
/// The rule of this version.
const TEXT: &str = include_str!("../../../dist/60-scanhub.rules");
/// Directories in which systemd searches for units, in its order.
const UNITS: [&str; 5] = [
    "etc/systemd/system",
    "run/systemd/system",
    "usr/local/lib/systemd/system",
    "usr/lib/systemd/system",
    "lib/systemd/system",
];
/// Directories in which udev searches for rules, in its order.
const RULES: [&str; 5] = [
    "etc/udev/rules.d",
    "run/udev/rules.d",
    "usr/local/lib/udev/rules.d",
    "usr/lib/udev/rules.d",
    "lib/udev/rules.d",
];
const INSTALL: &str = "sudo hub/dist/install.sh puts this version in place";

/// Checks whether the shared memory of the hub of `user` remains when this user logs out. At the end of the last
/// session of an ordinary user, logind removes their files in /dev/shm, even while a hub uses them (logind.conf(5),
/// `RemoveIPC=`).
pub(crate) fn logout(system: &System, user: u32) -> Finding {
    const NAME: &str = "logout";
    let name = system.name_of(user);
    if user <= LAST_SYSTEM_USER {
        return Finding::ok(NAME, format!("user {name} is a system user: shared memory stays at logout"));
    }
    if !system.path("run/systemd/users").is_dir() {
        return Finding::ok(NAME, "there is no logind that could remove shared memory");
    }
    let (removes, place) = removes_ipc(system);
    if !removes {
        return Finding::ok(NAME, format!("RemoveIPC=no in {place}: shared memory stays"));
    }
    if system.path("var/lib/systemd/linger").join(&name).exists() {
        return Finding::ok(NAME, format!("user {name} lingers: shared memory stays"));
    }
    Finding::warning(
        NAME,
        format!(
            "RemoveIPC=yes ({place}): when user {name} logs out, shared memory is removed, even while a hub uses it"
        ),
        format!(
            "sudo loginctl enable-linger {name}; or run the service, whose user does not log out; or set RemoveIPC=no under \
             [Login] in /etc/systemd/logind.conf.d/scanhub.conf, then restart the machine"
        ),
    )
}

/// Returns whether logind removes shared memory, and the file with this setting.
fn removes_ipc(system: &System) -> (bool, String) {
    let directories = CONFIGURATIONS.map(|place| format!("{place}/logind.conf.d"));
    let first = system.first(&CONFIGURATIONS, "logind.conf");
    let files = first.into_iter().chain(system.drop_ins(&directories));
    let mut found = (true, "the default".to_owned());
    for path in files {
        let text = regular::read_text(&path, regular::LONGEST).unwrap_or_default();
        if let Some(removes) = remove_ipc_setting(&text) {
            found = (removes, path.display().to_string());
        }
    }
    found
}

/// Returns the last valid value of `RemoveIPC` in the text of a file.
fn remove_ipc_setting(text: &str) -> Option<bool> {
    let mut section = "";
    let mut setting = None;
    for line in text.lines().map(str::trim) {
        if line.starts_with('[') {
            section = line;
        } else if let Some((key, value)) = line.split_once('=')
            && (section, key.trim_end()) == ("[Login]", "RemoveIPC")
        {
            setting = as_bool(value.trim_start()).or(setting);
        }
    }
    setting
}

/// Parses a boolean as systemd does, which ignores an invalid value.
fn as_bool(value: &str) -> Option<bool> {
    match value.to_lowercase().as_str() {
        "1" | "yes" | "y" | "true" | "t" | "on" => Some(true),
        "0" | "no" | "n" | "false" | "f" | "off" => Some(false),
        _ => None,
    }
}

/// Directories in which systemd searches for its configuration, in its order.
const CONFIGURATIONS: [&str; 4] = ["etc/systemd", "run/systemd", "usr/local/lib/systemd", "usr/lib/systemd"];
/// Highest ID of a system user (systemd, SYSTEM_UID_MAX).
const LAST_SYSTEM_USER: u32 = 999;

#[cfg(test)]
mod tests {
    use port::found_in;

    use super::*;
    use crate::doctor::State;
    use crate::doctor::system::tests::TempRoot;

    const SERVICE: &str = include_str!("../../../dist/scanhub.service");

    #[test]
    fn judges_installed_service() {
        let temp = TempRoot::new(0, &[]);
        let of = |hub| service(&temp.system, hub);
        assert_eq!(of(None).state, State::Skipped);
        temp.put("etc/systemd/system/scanhub.service", SERVICE);
        let broken = of(None);
        assert!(
            broken.state == State::Failed && broken.finding.contains("/usr/local/bin/scanhub"),
            "{broken}"
        );
        fs::create_dir_all(temp.path("usr/local/bin")).unwrap();
        fs::copy(std::env::current_exe().unwrap(), temp.path("usr/local/bin/scanhub")).unwrap();
        assert!(of(None).state == State::Ok && of(None).finding.contains("not enabled"), "{}", of(None));
        temp.link(
            "/etc/systemd/system/scanhub.service",
            "etc/systemd/system/multi-user.target.wants/scanhub.service",
        );
        assert_eq!(of(None).state, State::Ok, "systemd does not run");
        fs::create_dir_all(temp.path("run/systemd/system")).unwrap();
        let asleep = of(None);
        assert!(asleep.state == State::Failed && asleep.remedy.contains("systemctl status"), "{asleep}");
        assert_eq!(of(Some(7)).state, State::Ok, "a hub that was started by hand");
        temp.put("sys/fs/cgroup/system.slice/scanhub.service/cgroup.procs", "7\n");
        assert!(of(None).finding.ends_with("this program; enabled, runs"), "{}", of(None));
        temp.put(
            "etc/systemd/system/scanhub.service.d/own.conf",
            "[Service]\nExecStart=\nExecStart=-/opt/scanhub run\n",
        );
        assert!(of(None).finding.contains("/opt/scanhub, which is not there"), "{}", of(None));
        fs::remove_file(temp.path("etc/systemd/system/scanhub.service")).unwrap();
        temp.link("/dev/null", "etc/systemd/system/scanhub.service");
        assert!(of(None).finding.contains("masked"), "{}", of(None));
    }

    #[test]
    fn judges_installed_udev_rule() {
        let temp = TempRoot::new(0, &[("dev/ttyUSB0", ""), ("sys/usb/idVendor", "0403\n")]);
        fs::create_dir_all(temp.path("sys/class/tty/ttyUSB0")).unwrap();
        temp.link(temp.path("sys/usb").to_str().unwrap(), "sys/class/tty/ttyUSB0/device");
        let there = found_in(&temp.path(""));
        assert_eq!(there.len(), 1);
        let of = || rules(&temp.system, &there);
        assert_eq!(of().state, State::Skipped);
        temp.put("etc/udev/rules.d/60-scanhub.rules", "# older\n");
        assert!(of().state == State::Warning && of().remedy.contains("install.sh"), "{}", of());
        temp.put("etc/udev/rules.d/60-scanhub.rules", TEXT);
        assert!(of().state == State::Warning && of().remedy.contains("udevadm trigger"), "{}", of());
        temp.link(temp.path("dev/ttyUSB0").to_str().unwrap(), "dev/scanhub/pci-0");
        assert_eq!(of().state, State::Ok);
    }

    #[test]
    fn uses_last_setting_of_logind() {
        let temp = TempRoot::new(1000, &[("etc/passwd", "robot:x:1000:1000::/:\n")]);
        let state = |user| logout(&temp.system, user).state;
        assert_eq!(state(1000), State::Ok, "no logind");
        std::fs::create_dir_all(temp.path("run/systemd/users")).unwrap();
        let finding = logout(&temp.system, 1000);
        assert_eq!(finding.state, State::Warning);
        assert!(finding.remedy.contains("loginctl enable-linger robot"), "{finding}");
        assert_eq!([state(0), state(999), state(1001)], [State::Ok, State::Ok, State::Warning]);
        for (path, content, expected) in [
            ("usr/lib/systemd/logind.conf", "[Login]\nRemoveIPC=no\n", State::Ok),
            ("etc/systemd/logind.conf", "[Login]\n#RemoveIPC=no\nKillUserProcesses=no\n", State::Warning),
            ("usr/lib/systemd/logind.conf.d/50-ipc.conf", "[Login]\nRemoveIPC = off\n", State::Ok),
            ("etc/systemd/logind.conf.d/40-early.conf", "[Login]\nRemoveIPC=yes\n", State::Ok),
            ("run/systemd/logind.conf.d/60-late.conf", "[Login]\nRemoveIPC=true\n", State::Warning),
            ("etc/systemd/logind.conf.d/60-late.conf", "[Other]\nRemoveIPC=true\n", State::Ok),
            (
                "etc/systemd/logind.conf.d/70.conf",
                "[Login]\nRemoveIPC=1\nRemoveIPC=perhaps\n",
                State::Warning,
            ),
            ("var/lib/systemd/linger/robot", "", State::Ok),
        ] {
            temp.put(path, content);
            assert_eq!(state(1000), expected, "{path}");
        }
    }
}
