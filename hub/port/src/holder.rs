//! Finds the process that has a port open, and programs that are known to open ports by themselves. Each search reads about
//! all processes, so it is made once after an error, not repeatedly.

use std::fmt;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use rustix::fs::{major, minor};

/// A process that has a port open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Holder {
    /// Its process id.
    pub pid: u32,
    /// Its program's name, at most 15 bytes.
    pub program: String,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "process {} ({})", self.pid, self.program)
    }
}

/// The first other process that has `path` open, as far as this user may see.
pub fn holder(path: &Path) -> Option<Holder> {
    all_holders(path).into_iter().next()
}

/// All other processes that have `path` open, as far as this user may see.
pub fn all_holders(path: &Path) -> Vec<Holder> {
    let device = path.canonicalize().ok();
    device.and_then(|device| holders(&[&device]).pop()).unwrap_or_default()
}

/// Returns the other process that has locked `path`, whichever user it belongs to. Returns `None` if no running
/// process has locked it.
pub(super) fn lock_owner(path: &Path) -> Option<Holder> {
    let file = fs::metadata(path).ok()?;
    let device = file.dev();
    let key = format!("{:02x}:{:02x}:{}", major(device), minor(device), file.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = lock_owners(&locks, &key).find(|&pid| pid != std::process::id())?;
    Path::new(&format!("/proc/{pid}")).exists().then(|| Holder { pid, program: name_of(pid) })
}

/// Returns the processes that hold a lock made by flock(2) on the file `key`, as in `/proc/locks` (proc_locks(5)).
fn lock_owners<'a>(locks: &'a str, key: &'a str) -> impl Iterator<Item = u32> + 'a {
    locks.lines().filter_map(move |line| match line.split_whitespace().collect::<Vec<_>>()[..] {
        [_, "FLOCK", _, _, pid, file, ..] if file == key => pid.parse().ok(),
        _ => None,
    })
}

/// Returns the program that may have changed the settings of `path`, as part of a message: one that is known to try every
/// port, or another process that has the port open.
pub fn altering_program(path: &Path) -> Option<String> {
    let running = |name: &str| pids().any(|pid| name_of(pid) == name);
    let known = PORT_PROGRAMS.iter().find(|(name, _)| running(name));
    known.map(|(name, remedy)| format!("{name} runs: {remedy}")).or_else(|| {
        // The service manager only keeps the port for the hub.
        let holder = all_holders(path).into_iter().find(|holder| holder.program != "systemd")?;
        Some(format!("{holder} has it open"))
    })
}

/// Whether this process itself has `path` open, not counting what it inherited from its parent.
pub(super) fn is_own(path: &Path) -> bool {
    let open = fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
    let given = |entry: &fs::DirEntry| ["0", "1", "2"].iter().any(|number| entry.file_name() == *number);
    let mut targets = open.filter(|entry| !given(entry)).filter_map(|entry| fs::read_link(entry.path()).ok());
    path.canonicalize().is_ok_and(|device| targets.any(|target| target == device))
}

/// For each of the real `devices` the other processes that have it open, in one look at all processes.
pub(super) fn holders(devices: &[&Path]) -> Vec<Vec<Holder>> {
    let mut found: Vec<Vec<Holder>> = vec![Vec::new(); devices.len()];
    for pid in pids().filter(|&pid| pid != std::process::id()) {
        let open = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        for target in open.filter_map(|entry| fs::read_link(entry.path()).ok()) {
            let at = devices.iter().position(|&device| device == target);
            let known = at.and_then(|at| found.get_mut(at));
            // Once each, however often it has it open.
            if let Some(known) = known.filter(|known| known.last().is_none_or(|last| last.pid != pid)) {
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

/// Programs that open every serial port that they find, and the remedy.
const PORT_PROGRAMS: [(&str, &str); 2] = [
    ("ModemManager", "sudo systemctl stop ModemManager"),
    ("brltty", "without a Braille display, sudo apt remove brltty"),
];

#[cfg(test)]
mod tests {
    use super::*;

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
    fn lock_of_another_process_names_it() {
        let (_other, port) = crate::tty::tests::pty();
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
