//! Access to a port: whether its owner, group and mode permit this process to open it, and which other process has it
//! open.
//!
//! Names of users and groups are read from files, so names of a directory service are not found. Each search for
//! processes reads the data of every process, so it should run once after an error, not repeatedly.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::{fmt, fs};

use rustix::fs::{major, minor};
use rustix::process::{getegid, geteuid, getgroups};

/// Owner, user and groups that decide whether this process may open a port.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PortPermissions {
    /// Owner, group and mode of the port. `None` if they cannot be read.
    pub port: Option<Ownership>,
    /// User ID of this process.
    pub uid: u32,
    /// Group IDs of this process.
    pub groups: Vec<u32>,
    /// Name of the user, or the ID if there is no name.
    pub user: String,
    /// Name of the port's group, or the ID if there is no name.
    pub group: String,
    /// Whether `/etc/group` lists the user in the port's group, even if this process does not have that group.
    pub is_listed: bool,
}

/// Owner, group and mode of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ownership {
    /// User ID of the owner.
    pub uid: u32,
    /// Group ID.
    pub gid: u32,
    /// Permission bits.
    pub mode: u32,
}

impl PortPermissions {
    /// Reads the permissions of this process for the port `path`.
    pub fn of(path: &Path) -> PortPermissions {
        let port = fs::metadata(path).ok().map(|metadata| Ownership {
            uid: metadata.uid(),
            gid: metadata.gid(),
            mode: metadata.mode() & 0o777,
        });
        let uid = geteuid().as_raw();
        let mut groups: Vec<u32> =
            getgroups().unwrap_or_default().iter().map(|group| group.as_raw()).collect();
        groups.push(getegid().as_raw());
        let user = database_entry("/etc/passwd", uid).map_or(uid.to_string(), |fields| fields[0].clone());
        let gid = port.map_or(0, |port| port.gid);
        let group_entry = database_entry("/etc/group", gid);
        let is_listed = group_entry
            .as_ref()
            .and_then(|words| words.get(3))
            .is_some_and(|members| members.split(',').any(|member| member == user));
        let group = group_entry.map_or(gid.to_string(), |words| words[0].clone());
        PortPermissions { port, uid, groups, user, group, is_listed }
    }

    /// Returns the reason why this process may not open the port, and the remedy.
    pub fn explain(&self, path: &Path) -> (String, String) {
        let PortPermissions { user, group, .. } = self;
        let path = path.display();
        let Some(Ownership { uid, gid, mode }) = self.port else {
            let remedy =
                "a directory in its path denies access: check the directories with ls -ld".to_owned();
            return (format!("{path}: no permission for user {user} to access it"), remedy);
        };
        let what = format!("{path}: no permission for user {user}: group {group}, mode {mode:03o}");
        let remedy = if uid == self.uid && mode & RW_BITS << 6 != RW_BITS << 6 {
            format!("you own it, but its mode denies access: chmod u+rw {path}")
        } else if uid == self.uid
            || mode & RW_BITS == RW_BITS
            || (self.groups.contains(&gid) && mode & RW_BITS << 3 == RW_BITS << 3)
        {
            format!("owner and mode allow it, so an access list or a container forbids it: getfacl {path}")
        } else if gid == 0 || mode & RW_BITS << 3 != RW_BITS << 3 {
            // A new device is in this state for a moment, until udev has processed it.
            "its group has no access: give it to a group with a udev rule, SUBSYSTEM==\"tty\", GROUP=\"dialout\", MODE=\"0660\""
                .to_owned()
        } else if self.is_listed {
            format!("user {user} is in group {group}, but was not when this session started: log in again")
        } else {
            format!("sudo usermod -aG {group} {user}, then log in again")
        };
        (what, remedy)
    }
}

/// Read and write permission, as one octal digit of a mode.
const RW_BITS: u32 = 0o6;

/// Returns the fields of the line whose third field is `id`, in a file such as `/etc/group`. The result has at least
/// three fields.
fn database_entry(file: &str, id: u32) -> Option<Vec<String>> {
    let text = fs::read_to_string(file).ok()?;
    let id = id.to_string();
    let words = |line: &str| line.split(':').map(str::to_owned).collect::<Vec<_>>();
    text.lines().map(words).find(|words| words.get(2) == Some(&id))
}

/// Process that has a port open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Holder {
    /// Process ID.
    pub pid: u32,
    /// Name of the program, at most 15 bytes.
    pub program: String,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "process {} ({})", self.pid, self.program)
    }
}

/// Returns the first other process that has `path` open and is visible to this user.
pub fn holder(path: &Path) -> Option<Holder> {
    all_holders(path).into_iter().next()
}

/// Returns all other processes that have `path` open and are visible to this user.
pub fn all_holders(path: &Path) -> Vec<Holder> {
    let device = path.canonicalize().ok();
    device.and_then(|device| holders(&[&device]).pop()).unwrap_or_default()
}

/// Returns the other process that has locked `path`, which may belong to any user. Returns `None` if no running process
/// has locked it.
pub(super) fn lock_owner(path: &Path) -> Option<Holder> {
    let file = fs::metadata(path).ok()?;
    let device = file.dev();
    let key = format!("{:02x}:{:02x}:{}", major(device), minor(device), file.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = lock_owners(&locks, &key).find(|&pid| pid != std::process::id())?;
    Path::new(&format!("/proc/{pid}")).exists().then(|| Holder { pid, program: name_of(pid) })
}

/// Returns the IDs of the processes that hold an flock(2) lock on the file `key`, in the format of `/proc/locks`
/// (proc_locks(5)).
fn lock_owners<'a>(locks: &'a str, key: &'a str) -> impl Iterator<Item = u32> + 'a {
    locks.lines().filter_map(move |line| match line.split_whitespace().collect::<Vec<_>>()[..] {
        [_, "FLOCK", _, _, pid, file, ..] if file == key => pid.parse().ok(),
        _ => None,
    })
}

/// Returns, as part of a message, the program that may have changed the settings of the port `path`: a program that
/// opens every serial port, or another process that has this port open.
pub fn altering_program(path: &Path) -> Option<String> {
    let running = |name: &str| pids().any(|pid| name_of(pid) == name);
    let known = PORT_PROGRAMS.iter().find(|(name, _)| running(name));
    known.map(|(name, remedy)| format!("{name} runs: {remedy}")).or_else(|| {
        // systemd only keeps the port open for the hub.
        let holder = all_holders(path).into_iter().find(|holder| holder.program != "systemd")?;
        Some(format!("{holder} has it open"))
    })
}

/// Returns whether this process has opened `path` itself. Descriptors 0 to 2, which it inherited from its parent, do
/// not count.
pub(super) fn is_opened_here(path: &Path) -> bool {
    let open = fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let is_standard =
        |entry: &fs::DirEntry| ["0", "1", "2"].iter().any(|number| entry.file_name() == *number);
    let mut targets =
        open.filter(|entry| !is_standard(entry)).filter_map(|entry| fs::read_link(entry.path()).ok());
    path.canonicalize().is_ok_and(|device| targets.any(|target| target == device))
}

/// Returns, for each of `devices`, the other processes that have it open. The paths must be canonical. Reads the
/// descriptors of all processes once.
pub(super) fn holders(devices: &[&Path]) -> Vec<Vec<Holder>> {
    let mut found: Vec<Vec<Holder>> = vec![Vec::new(); devices.len()];
    for pid in pids().filter(|&pid| pid != std::process::id()) {
        let open = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        for target in open.filter_map(|entry| fs::read_link(entry.path()).ok()) {
            let at = devices.iter().position(|&device| device == target);
            let found_holders = at.and_then(|at| found.get_mut(at));
            // Add a process only once, even if it has several descriptors of the device.
            if let Some(known) = found_holders.filter(|known| known.last().is_none_or(|last| last.pid != pid))
            {
                known.push(Holder { pid, program: name_of(pid) });
            }
        }
    }
    found
}

/// Returns the IDs of all processes.
fn pids() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

fn name_of(pid: u32) -> String {
    let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    match name.trim() {
        "" => "no name".to_owned(),
        name => name.to_owned(),
    }
}

/// Programs that open every serial port, and the remedy for each.
const PORT_PROGRAMS: [(&str, &str); 2] = [
    ("ModemManager", "sudo systemctl stop ModemManager"),
    ("brltty", "without a Braille display, sudo apt remove brltty"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_permission_problem_has_a_remedy() {
        let robot = PortPermissions {
            port: Some(Ownership { uid: 0, gid: 20, mode: 0o660 }),
            uid: 1000,
            groups: vec![1000],
            user: "robot".to_owned(),
            group: "dialout".to_owned(),
            is_listed: false,
        };
        let port =
            |uid, gid, mode| PortPermissions { port: Some(Ownership { uid, gid, mode }), ..robot.clone() };
        for (rights, says) in [
            (robot.clone(), "sudo usermod -aG dialout robot, then log in again"),
            (PortPermissions { is_listed: true, ..robot.clone() }, "is in group dialout, but was not"),
            (PortPermissions { groups: vec![1000, 20], ..robot.clone() }, "getfacl /dev/ttyUSB0"),
            (port(0, 0, 0o600), "udev rule"),
            (port(0, 20, 0o640), "udev rule"),
            (port(1000, 20, 0o440), "chmod u+rw /dev/ttyUSB0"),
            (port(1000, 20, 0o660), "getfacl"),
            (PortPermissions { port: None, ..robot.clone() }, "ls -ld"),
        ] {
            let (what, remedy) = rights.explain(Path::new("/dev/ttyUSB0"));
            assert!(remedy.contains(says), "{rights:?}: {remedy}");
            assert!(what.contains("/dev/ttyUSB0") && what.contains("user robot"), "{what}");
        }
        let (what, _) = robot.explain(Path::new("/dev/ttyUSB0"));
        assert!(what.contains("no permission") && what.ends_with("group dialout, mode 660"), "{what}");
    }

    #[test]
    fn reads_permissions_of_this_process() {
        let rights = PortPermissions::of(Path::new("/dev/null"));
        assert_eq!(rights.uid, geteuid().as_raw());
        assert_eq!(rights.port.map(|port| port.uid), Some(0));
        assert!(rights.groups.contains(&getegid().as_raw()));
    }

    #[test]
    fn owners_of_a_lock_are_found_by_file() {
        let locks = "1: POSIX  ADVISORY  WRITE 9177 00:05:93 0 EOF\n\
                     2: FLOCK  ADVISORY  WRITE 812 00:05:94 0 EOF\n\
                     3: FLOCK  ADVISORY  WRITE 4711 00:05:93 0 EOF\n\
                     3: -> FLOCK  ADVISORY  WRITE 4712 00:05:93 0 EOF\n";
        assert_eq!(lock_owners(locks, "00:05:93").collect::<Vec<_>>(), [4711]);
        assert_eq!(lock_owners(locks, "00:05:95").count(), 0);
    }

    #[test]
    fn lock_owner_is_the_locking_process() {
        let (_other, port) = crate::tests::pty();
        let mut owner = std::process::Command::new("flock");
        let owner = owner.arg(&port).args(["sh", "-c", "echo locked; exec cat"]);
        let owner = owner.stdin(std::process::Stdio::piped()).stdout(std::process::Stdio::piped()).spawn();
        let mut owner = owner.expect("flock is part of util-linux");
        let mut word = String::new();
        let output = owner.stdout.as_mut().expect("a pipe");
        std::io::BufRead::read_line(&mut std::io::BufReader::new(output), &mut word).expect("text");
        assert_eq!(lock_owner(&port).map(|owner| owner.pid), Some(owner.id()));
        drop(owner.stdin.take());
        owner.wait().expect("it ends");
        assert_eq!(lock_owner(&port), None);
    }
}
