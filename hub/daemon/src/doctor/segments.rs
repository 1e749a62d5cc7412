//! Files in shared memory that nobody uses any more. Their names tell only a domain's name, and a hub below another root,
//! or of another user, may have the same: what somebody may still hold is never counted.

use std::collections::HashSet;
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use rustix::fs::{major, minor};
use schema::shortage::SHARED_MEMORY;

/// Files of `user` in shared memory whose names begin with `prefix`, with their bytes, that no process of this machine
/// has open or mapped; none if that cannot be known.
pub(crate) fn abandoned(prefix: &str, user: u32) -> Vec<(PathBuf, u64)> {
    let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    let ours = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    let mut files: Vec<(PathBuf, Metadata)> = ours
        .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user && metadata.len() > ALWAYS_LEFT)
        .collect();
    if files.is_empty() {
        return Vec::new();
    }
    let Some(held) = held(user) else { return Vec::new() };
    files.retain(|(_, metadata)| !held.contains(&identity(metadata)));
    files.sort_by(|a, b| a.0.cmp(&b.0));
    files.into_iter().map(|(path, metadata)| (path, metadata.len())).collect()
}

/// Device and inode as `/proc/PID/maps` writes them.
type Identity = (String, u64);

fn identity(metadata: &Metadata) -> Identity {
    let device = metadata.dev();
    (format!("{:02x}:{:02x}", major(device), minor(device)), metadata.ino())
}

/// Every file that a process has open or mapped, as far as this user may see; none if a process of `user` cannot be
/// looked at.
fn held(user: u32) -> Option<HashSet<Identity>> {
    let mut held = HashSet::new();
    let processes = fs::read_dir("/proc").ok()?.flatten();
    for pid in processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok()) {
        // Descriptors first: who maps a file closes it afterwards.
        let open = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        held.extend(open.filter_map(|entry| Some(identity(&fs::metadata(entry.path()).ok()?))));
        match fs::read(format!("/proc/{pid}/maps")) {
            Ok(maps) => held.extend(String::from_utf8_lossy(&maps).lines().filter_map(mapped)),
            Err(_) if is_of(pid, user) => return None,
            Err(_) => {}
        }
    }
    Some(held)
}

/// The file in a line of `/proc/PID/maps`: addresses, rights, offset, device, inode, path.
fn mapped(line: &str) -> Option<Identity> {
    let mut words = line.split_whitespace().skip(3);
    Some((words.next()?.to_owned(), words.next()?.parse().ok()?))
}

/// Whether the process lives and is one of `user`; the owner of its directory is root's where it has capabilities.
fn is_of(pid: u32, user: u32) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let users = status.lines().find_map(|line| line.strip_prefix("Uid:")).unwrap_or_default();
    users.split_whitespace().any(|word| word.parse() == Ok(user))
}

/// One lock of the library's is never removed, and has 16 bytes.
const ALWAYS_LEFT: u64 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_counts_once_nobody_holds_it_and_for_its_owner_alone() {
        let prefix = format!("sh_segments-{}_", std::process::id());
        let path = PathBuf::from(format!("{SHARED_MEMORY}/{prefix}a"));
        let file = fs::File::create_new(&path).unwrap();
        file.set_len(64).unwrap();
        let user = file.metadata().unwrap().uid();
        let open = abandoned(&prefix, user);
        drop(file);
        let (closed, other) = (abandoned(&prefix, user), abandoned(&prefix, user + 1));
        fs::remove_file(&path).unwrap();
        assert_eq!((open, other), (Vec::new(), Vec::new()));
        // A process that cannot be looked at makes it unknown.
        assert!(closed.is_empty() || closed == [(path, 64)], "{closed:?}");
        assert_eq!(closed.is_empty(), held(user).is_none());
    }

    #[test]
    fn a_mapping_names_its_file() {
        let line = "7f00-7f10 rw-s 00000000 00:1b 4711    /dev/shm/sh_nu_a (deleted)";
        assert_eq!(mapped(line), Some(("00:1b".to_owned(), 4711)));
        assert_eq!(mapped("7f00-7f10 rw-p 0 00:00"), None);
    }
}
