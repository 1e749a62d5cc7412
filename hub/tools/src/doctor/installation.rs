//! Checks of the installation: the version of the running hub, and the files that systemd, udev and logind read. These
//! are the service with its program and the udev rule, which `hub/dist/install.sh` installs, and the configuration of
//! logind, which may remove shared memory at logout. A hub that is started by hand needs neither service nor rule.
//!
//! Hub and clients of different versions refuse each other. Programs are compared by their bytes and, if these differ,
//! by the version that the programs report.

use std::fs::{self, File, Metadata};
use std::io::{ErrorKind, Read};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

use rustix::process::{geteuid, getuid};
use scanhub_files::regular_file;
use scanhub_port::SerialPortInfo;
use scanhub_shm::LIBRARY_VERSION;

use crate::doctor::Finding;

/// The files of a machine, and the user that reads them. The files are below a directory that need not be the root of
/// this machine, so that tests can provide files of an administrator.
#[derive(Clone, Debug)]
pub struct System {
    root: PathBuf,
    user: u32,
}

impl System {
    /// Returns this machine, and the user of this process.
    pub fn local() -> System {
        System::at("/", getuid().as_raw())
    }

    /// Creates a machine whose files are below `root`, for the user with this ID.
    pub fn at(root: impl Into<PathBuf>, user: u32) -> System {
        System { root: root.into(), user }
    }

    /// Returns the user's ID.
    pub(crate) fn user(&self) -> u32 {
        self.user
    }

    /// Returns the path at which this process finds `path` of that machine.
    pub(crate) fn path(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        self.root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// Returns the text of a file, or `None` if it cannot be read.
    pub(crate) fn text(&self, path: &str) -> Option<String> {
        regular_file::read_text(&self.path(path), regular_file::MAX_FILE_BYTES).ok()
    }

    /// Returns the path of `name` in the first of `directories` that has it. A symlink without a target counts.
    pub(crate) fn first(&self, directories: &[&str], name: &str) -> Option<PathBuf> {
        let paths = directories.iter().map(|directory| self.path(directory).join(name));
        paths.into_iter().find(|path| path.symlink_metadata().is_ok())
    }

    /// Returns the files of `directories` whose names end with `.conf`, in the order of their names. If several files
    /// have the same name, only the file of the first directory counts, as systemd reads drop-in files.
    fn drop_ins(&self, directories: &[String]) -> Vec<PathBuf> {
        let mut found: Vec<PathBuf> = Vec::new();
        for directory in directories {
            for entry in fs::read_dir(self.path(directory)).into_iter().flatten().flatten() {
                let path = entry.path();
                let is_known = found.iter().any(|known| known.file_name() == path.file_name());
                if !is_known && path.extension().is_some_and(|extension| extension == "conf") {
                    found.push(path);
                }
            }
        }
        found.sort_by(|a, b| a.file_name().cmp(&b.file_name()));
        found
    }

    /// Returns the name of the user with this ID, or the ID if the user has no name.
    pub(crate) fn name_of(&self, user: u32) -> String {
        let known = self.text("etc/passwd").unwrap_or_default();
        let number = user.to_string();
        let line = known.lines().find(|line| line.split(':').nth(2) == Some(&number));
        line.and_then(|line| line.split(':').next()).map_or(number, str::to_owned)
    }
}

/// A program, compared with this one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum VersionMatch {
    /// A program with the same bytes.
    Same,
    /// Another build, and the version that it reports; `None` if the program must not be started, or reports no
    /// version.
    Other(Option<String>),
}

/// The program of a hub's process.
#[derive(Clone, Debug, PartialEq, Eq)]
struct RunningProgram {
    build: VersionMatch,
    /// Whether the program's file was replaced or removed after the start of the process.
    is_replaced: bool,
}

/// Reports the versions, and compares this program with the program of the `hub`, if a hub runs.
pub(crate) fn version(system: &System, hub: Option<u32>) -> Finding {
    let kernel = system.text("proc/sys/kernel/osrelease").unwrap_or_default();
    let own = match kernel.trim() {
        "" => format!("scanhub {VERSION}, {LIBRARY_VERSION}"),
        kernel => format!("scanhub {VERSION}, {LIBRARY_VERSION}, Linux {kernel}"),
    };
    version_finding(own, hub.map(|pid| (pid, running_program(pid))))
}

fn version_finding(own: String, hub: Option<(u32, Option<RunningProgram>)>) -> Finding {
    const NAME: &str = "version";
    let restart = "restart the hub: sudo systemctl restart scanhub, if it is the service";
    match hub {
        None => Finding::ok(NAME, own),
        Some((_, None)) => {
            Finding::ok(NAME, format!("{own}; this user may not see which program the hub runs"))
        }
        Some((pid, Some(RunningProgram { build: VersionMatch::Other(Some(version)), .. })))
            if version != VERSION =>
        {
            let text = format!("{own}; the hub, process {pid}, is scanhub {version}: they refuse each other");
            Finding::failed(NAME, text, format!("use one version for both; {restart}"))
        }
        Some((pid, Some(RunningProgram { is_replaced: true, build }))) if build != VersionMatch::Same => {
            let text = format!("{own}; the hub, process {pid}, runs a program that was replaced since");
            Finding::warning(NAME, text, restart)
        }
        Some((_, Some(RunningProgram { is_replaced: true, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs this version; its file was replaced"))
        }
        Some((_, Some(RunningProgram { build: VersionMatch::Same, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs the same program"))
        }
        Some((_, Some(RunningProgram { .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs another build"))
        }
    }
}

/// Returns the program of process `pid`, or `None` if this user may not see it.
fn running_program(pid: u32) -> Option<RunningProgram> {
    let process = PathBuf::from(format!("/proc/{pid}"));
    let link = fs::read_link(process.join("exe")).ok()?;
    let is_own = user_of(pid) == Some(geteuid().as_raw());
    let build = compare(&process.join("exe"), is_own).ok()?;
    Some(RunningProgram { build, is_replaced: link.to_string_lossy().ends_with(" (deleted)") })
}

/// Compares `program` with this one. Starts it to query its version only if it is `trusted`, and if only this user and
/// root can write it.
///
/// # Errors
///
/// Returns the system's error if the file cannot be read.
fn compare(program: &Path, trusted: bool) -> std::io::Result<VersionMatch> {
    let (ours, theirs) = (File::open("/proc/self/exe")?, File::open(program)?);
    let (our, their) = (ours.metadata()?, theirs.metadata()?);
    if !their.is_file() {
        return Err(std::io::ErrorKind::InvalidInput.into());
    }
    if (our.dev(), our.ino()) == (their.dev(), their.ino())
        || (our.len() == their.len() && is_same(ours, theirs))
    {
        return Ok(VersionMatch::Same);
    }
    Ok(VersionMatch::Other(if trusted && is_ours(&their) { reported_version(program) } else { None }))
}

/// Returns the user that process `pid` runs as. The owner of its directory in /proc would not be reliable, because it
/// may be root.
pub(crate) fn user_of(pid: u32) -> Option<u32> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    status.lines().find_map(|line| line.strip_prefix("Uid:"))?.split_whitespace().next()?.parse().ok()
}

/// Returns whether a signal or a debugger has stopped process `pid`.
pub(crate) fn is_stopped(pid: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let state = status.lines().find_map(|line| line.strip_prefix("State:"));
    state.is_some_and(|state| state.trim_start().starts_with(['T', 't']))
}

/// Returns whether only this user and root can write a file.
fn is_ours(metadata: &Metadata) -> bool {
    [0, geteuid().as_raw()].contains(&metadata.uid()) && metadata.mode() & 0o022 == 0
}

fn is_same(mut one: File, mut other: File) -> bool {
    let (mut left, mut right) = (vec![0; BLOCK_LEN], vec![0; BLOCK_LEN]);
    loop {
        match one.read(&mut left) {
            Ok(0) => return true,
            Ok(len) if other.read_exact(&mut right[..len]).is_ok() && left[..len] == right[..len] => {}
            _ => return false,
        }
    }
}

/// Returns the version that `program --version` prints within two seconds, if it is a scanhub.
fn reported_version(program: &Path) -> Option<String> {
    let mut command = Command::new(program);
    command.arg("--version").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut process = command.spawn().ok()?;
    for _ in 0..MAX_POLLS {
        if let Ok(Some(_)) = process.try_wait() {
            let mut output = String::new();
            process.stdout.take()?.take(MAX_OUTPUT).read_to_string(&mut output).ok()?;
            return Some(output.lines().next()?.strip_prefix("scanhub ")?.trim().to_owned());
        }
        thread::sleep(POLL_INTERVAL);
    }
    let _ = process.kill();
    let _ = process.wait();
    None
}

/// Checks whether the service is installed, starts this version, and runs if it is enabled. `hub` is the process of the
/// hub, if one runs.
pub(crate) fn service(system: &System, hub: Option<u32>) -> Finding {
    const NAME: &str = "service";
    let Some(unit) = system.first(&UNIT_DIRECTORIES, UNIT_NAME) else {
        return Finding::skipped(NAME, "not installed; hub/dist/install.sh puts it in place");
    };
    if fs::read_link(&unit).is_ok_and(|target| target == Path::new("/dev/null")) {
        return Finding::ok(NAME, format!("{}: masked, never started", unit.display()));
    }
    let at = unit.display().to_string();
    let Some(program) = program(system, &unit) else {
        return Finding::failed(NAME, format!("{at} starts nothing"), INSTALL_REMEDY);
    };
    let program_path = system.path(&program);
    let build = match compare(&program_path, true) {
        Ok(VersionMatch::Same) => "this program".to_owned(),
        Ok(VersionMatch::Other(Some(version))) if version == VERSION => format!("another build of {VERSION}"),
        Ok(VersionMatch::Other(Some(version))) => {
            return Finding::warning(
                NAME,
                format!("{at} starts {}, version {version}; this is {VERSION}", program.display()),
                format!("{INSTALL_REMEDY}, then sudo systemctl restart scanhub"),
            );
        }
        Ok(VersionMatch::Other(None)) => "a program that does not report its version".to_owned(),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let text = format!("{at} starts {}, which does not exist", program.display());
            return Finding::failed(NAME, text, INSTALL_REMEDY);
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

/// Checks whether the udev rule of this version is installed, and has named the adapters of `serial_ports`.
pub(crate) fn rules(system: &System, serial_ports: &[SerialPortInfo]) -> Finding {
    const NAME: &str = "udev";
    let Some(path) = system.first(&RULE_DIRECTORIES, RULE_NAME) else {
        return Finding::skipped(NAME, "no rule installed; hub/dist/install.sh puts it in place");
    };
    let at = path.display();
    match regular_file::read_text(&path, regular_file::MAX_FILE_BYTES) {
        Ok(text) if text == RULE_TEXT => {}
        Ok(_) => {
            let text = format!("{at} belongs to another version");
            return Finding::warning(
                NAME,
                text,
                format!("{INSTALL_REMEDY}; give your own rule another name"),
            );
        }
        Err(error) => return Finding::warning(NAME, format!("{at}: {error}"), INSTALL_REMEDY),
    }
    let links = fs::read_dir(system.path("dev/scanhub")).into_iter().flatten().flatten();
    let named: Vec<PathBuf> = links.filter_map(|entry| entry.path().canonicalize().ok()).collect();
    let is_adapter = |device: &Path| {
        let name = device.file_name().unwrap_or_default().to_string_lossy();
        ["ttyUSB", "ttyACM"].iter().any(|kind| name.starts_with(kind))
    };
    let adapters = serial_ports.iter().map(|port| port.device.as_path()).filter(|device| is_adapter(device));
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

/// Returns the program that `unit` starts, according to the unit and its drop-in files.
fn program(system: &System, unit: &Path) -> Option<PathBuf> {
    let directories: Vec<String> =
        UNIT_DIRECTORIES.iter().map(|directory| format!("{directory}/{UNIT_NAME}.d")).collect();
    let mut program = None;
    for path in std::iter::once(unit.to_owned()).chain(system.drop_ins(&directories)) {
        let text = regular_file::read_text(&path, regular_file::MAX_FILE_BYTES).unwrap_or_default();
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
    let directories =
        UNIT_DIRECTORIES.iter().filter_map(|directory| fs::read_dir(system.path(directory)).ok());
    let mut entries = directories.flatten().flatten().map(|entry| entry.path());
    entries.any(|path| {
        let is_dependency = path.extension().is_some_and(|kind| kind == "wants" || kind == "requires");
        is_dependency && path.join(UNIT_NAME).symlink_metadata().is_ok()
    })
}

/// Returns whether the service has processes, according to the kernel's list of the service's control group.
fn is_running(system: &System) -> bool {
    let groups = ["", "unified/", "systemd/"]
        .map(|kind| format!("sys/fs/cgroup/{kind}system.slice/{UNIT_NAME}/cgroup.procs"));
    groups.iter().any(|path| system.text(path).is_some_and(|pids| !pids.trim().is_empty()))
}

/// Checks whether the shared memory of the hub of `user` remains when this user logs out. At the end of the last
/// session of an ordinary user, logind removes their files in /dev/shm, even while a hub uses them (logind.conf(5),
/// `RemoveIPC=`).
pub(crate) fn logout(system: &System, user: u32) -> Finding {
    const NAME: &str = "logout";
    let name = system.name_of(user);
    if user <= MAX_SYSTEM_UID {
        return Finding::ok(NAME, format!("user {name} is a system user: shared memory stays at logout"));
    }
    if !system.path("run/systemd/users").is_dir() {
        return Finding::ok(NAME, "there is no logind that could remove shared memory");
    }
    let (removes, file) = removes_ipc(system);
    if !removes {
        return Finding::ok(NAME, format!("RemoveIPC=no in {file}: shared memory stays"));
    }
    if system.path("var/lib/systemd/linger").join(&name).exists() {
        return Finding::ok(NAME, format!("user {name} lingers: shared memory stays"));
    }
    Finding::warning(
        NAME,
        format!(
            "RemoveIPC=yes ({file}): when user {name} logs out, shared memory is removed, even while a hub uses it"
        ),
        format!(
            "sudo loginctl enable-linger {name}; or run the service, whose user does not log out; or set RemoveIPC=no under \
             [Login] in /etc/systemd/logind.conf.d/scanhub.conf, then restart the machine"
        ),
    )
}

/// Returns whether logind removes shared memory, and the file with this setting.
fn removes_ipc(system: &System) -> (bool, String) {
    let directories = CONFIG_DIRECTORIES.map(|directory| format!("{directory}/logind.conf.d"));
    let first = system.first(&CONFIG_DIRECTORIES, "logind.conf");
    let files = first.into_iter().chain(system.drop_ins(&directories));
    let mut found = (true, "the default".to_owned());
    for path in files {
        let text = regular_file::read_text(&path, regular_file::MAX_FILE_BYTES).unwrap_or_default();
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

#[cfg(test)]
pub(crate) use tests::TempRoot;

/// The version of this program.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Number of bytes that are compared at once.
const BLOCK_LEN: usize = 1 << 16;
/// Maximum length of the output of `--version`, in bytes.
const MAX_OUTPUT: u64 = 1 << 10;
/// Number of polls for the end of `--version`, one every 10 ms, so two seconds in total.
const MAX_POLLS: u32 = 200;
const POLL_INTERVAL: Duration = Duration::from_millis(10);
const UNIT_NAME: &str = "scanhub.service";
const RULE_NAME: &str = "60-scanhub.rules";
/// The rule of this version.
const RULE_TEXT: &str = include_str!("../../../dist/60-scanhub.rules");
/// Directories in which systemd searches for units, in the order of its search.
const UNIT_DIRECTORIES: [&str; 5] = [
    "etc/systemd/system",
    "run/systemd/system",
    "usr/local/lib/systemd/system",
    "usr/lib/systemd/system",
    "lib/systemd/system",
];
/// Directories in which udev searches for rules, in the order of its search.
const RULE_DIRECTORIES: [&str; 5] = [
    "etc/udev/rules.d",
    "run/udev/rules.d",
    "usr/local/lib/udev/rules.d",
    "usr/lib/udev/rules.d",
    "lib/udev/rules.d",
];
const INSTALL_REMEDY: &str = "sudo hub/dist/install.sh puts this version in place";
/// Directories in which systemd searches for its configuration, in the order of its search.
const CONFIG_DIRECTORIES: [&str; 4] =
    ["etc/systemd", "run/systemd", "usr/local/lib/systemd", "usr/lib/systemd"];
/// Highest ID of a system user (systemd, SYSTEM_UID_MAX).
const MAX_SYSTEM_UID: u32 = 999;

#[cfg(test)]
mod tests {
    use scanhub_port::serial_ports_in;

    use crate::doctor::State;

    use super::*;

    const SERVICE: &str = include_str!("../../../dist/scanhub.service");

    #[test]
    fn checks_installed_service() {
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
        assert!(of(None).finding.contains("/opt/scanhub, which does not exist"), "{}", of(None));
        fs::remove_file(temp.path("etc/systemd/system/scanhub.service")).unwrap();
        temp.link("/dev/null", "etc/systemd/system/scanhub.service");
        assert!(of(None).finding.contains("masked"), "{}", of(None));
    }

    #[test]
    fn checks_installed_udev_rule() {
        let temp = TempRoot::new(0, &[("dev/ttyUSB0", ""), ("sys/usb/idVendor", "0403\n")]);
        fs::create_dir_all(temp.path("sys/class/tty/ttyUSB0")).unwrap();
        temp.link(temp.path("sys/usb").to_str().unwrap(), "sys/class/tty/ttyUSB0/device");
        let there = serial_ports_in(&temp.path(""));
        assert_eq!(there.len(), 1);
        let of = || rules(&temp.system, &there);
        assert_eq!(of().state, State::Skipped);
        temp.put("etc/udev/rules.d/60-scanhub.rules", "# older\n");
        assert!(of().state == State::Warning && of().remedy.contains("install.sh"), "{}", of());
        temp.put("etc/udev/rules.d/60-scanhub.rules", RULE_TEXT);
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

    #[test]
    fn checks_program_of_hub() {
        let of = |build, is_replaced| {
            version_finding("own".to_owned(), Some((7, Some(RunningProgram { build, is_replaced }))))
        };
        let other = |version: &str| VersionMatch::Other(Some(version.to_owned()));
        assert_eq!(version_finding("own".to_owned(), None).state, State::Ok);
        assert_eq!(version_finding("own".to_owned(), Some((7, None))).state, State::Ok);
        assert_eq!(of(VersionMatch::Same, false).state, State::Ok);
        assert_eq!(of(other(VERSION), false).state, State::Ok);
        assert_eq!(of(VersionMatch::Same, true).state, State::Ok);
        let replaced = of(other(VERSION), true);
        assert!(replaced.state == State::Warning && replaced.remedy.contains("restart"), "{replaced}");
        let different = of(other("0.0.1"), false);
        assert!(
            different.state == State::Failed && different.finding.contains("scanhub 0.0.1"),
            "{different}"
        );
    }

    #[test]
    fn recognizes_own_program() {
        let own = running_program(std::process::id()).expect("may be seen");
        assert_eq!(own, RunningProgram { build: VersionMatch::Same, is_replaced: false });
        assert_eq!(running_program(0), None);
    }

    #[test]
    fn compares_programs_by_their_bytes() {
        let temp = TempRoot::new(7, &[("else", "#!/bin/sh\necho scanhub 9.9.9\n")]);
        let own = std::env::current_exe().unwrap();
        assert_eq!(compare(&own, false).unwrap(), VersionMatch::Same);
        std::fs::copy(&own, temp.path("copy")).unwrap();
        assert_eq!(compare(&temp.path("copy"), true).unwrap(), VersionMatch::Same);
        // The file is not executable, so it reports no version.
        assert_eq!(compare(&temp.path("else"), true).unwrap(), VersionMatch::Other(None));
        assert!(compare(&temp.path("nothing"), true).is_err() && compare(&temp.path(""), true).is_err());
    }

    /// Files below a temporary directory.
    pub(crate) struct TempRoot {
        root: PathBuf,
        _directory: tempfile::TempDir,
        pub(crate) system: System,
    }

    impl TempRoot {
        /// Creates `files` from paths and contents, for `user`.
        pub(crate) fn new(user: u32, files: &[(&str, &str)]) -> TempRoot {
            let directory = tempfile::tempdir().unwrap();
            let root = directory.path().canonicalize().unwrap();
            let temp = TempRoot { system: System::at(&root, user), root, _directory: directory };
            for (path, content) in files {
                temp.put(path, content);
            }
            temp
        }

        pub(crate) fn put(&self, path: &str, content: &str) {
            let path = self.path(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        }

        pub(crate) fn link(&self, target: &str, path: &str) {
            let path = self.path(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::os::unix::fs::symlink(target, path).unwrap();
        }

        pub(crate) fn path(&self, path: &str) -> PathBuf {
            self.root.join(path)
        }
    }

    #[test]
    fn uses_first_of_files_with_same_name() {
        let files =
            [("etc/x.d/b.conf", "1"), ("usr/x.d/b.conf", "2"), ("usr/x.d/a.conf", "3"), ("etc/x.d/c", "4")];
        let temp = TempRoot::new(7, &files);
        let found = temp.system.drop_ins(&["etc/x.d".to_owned(), "usr/x.d".to_owned()]);
        assert_eq!(found, [temp.path("usr/x.d/a.conf"), temp.path("etc/x.d/b.conf")]);
    }

    #[test]
    fn returns_name_of_user() {
        let temp = TempRoot::new(7, &[("etc/passwd", "root:x:0:0::/:\nrobot:x:7:7::/:\n")]);
        assert_eq!([7, 8].map(|user| temp.system.name_of(user)), ["robot", "8"]);
    }
}
