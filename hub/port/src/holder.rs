//! Which process has a port open. This reads the descriptors of all processes, so it is called once after an error, not
//! repeatedly.

use std::fmt;
use std::fs;
use std::path::Path;

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
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    for pid in pids.filter(|&pid| pid != std::process::id()) {
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

fn name_of(pid: u32) -> String {
    let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    match name.trim() {
        "" => "no name".to_owned(),
        name => name.to_owned(),
    }
}
