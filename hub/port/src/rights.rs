//! Who may open a port: compares its owner, group and mode with the user and the groups of this process, and says what is
//! missing. Reads only files; users of a directory service are not seen.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use rustix::process::{getegid, geteuid, getgroups};

/// What decides whether a port may be opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rights {
    /// Owner, group and mode of the port; nothing if not even they may be seen.
    pub port: Option<Ownership>,
    /// This process's user.
    pub uid: u32,
    /// Groups of this process.
    pub groups: Vec<u32>,
    /// The user's name, else its number.
    pub user: String,
    /// The port's group by name, else its number.
    pub group: String,
    /// Whether the list of groups names the user in the port's group, whatever groups this process has.
    pub is_listed: bool,
}

/// To whom a file belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ownership {
    /// Its owner.
    pub uid: u32,
    /// Its group.
    pub gid: u32,
    /// The permission bits.
    pub mode: u32,
}

impl Rights {
    /// The rights of this process at `path`.
    pub fn of(path: &Path) -> Rights {
        let port = fs::metadata(path).ok().map(|metadata| Ownership {
            uid: metadata.uid(),
            gid: metadata.gid(),
            mode: metadata.mode() & 0o777,
        });
        let uid = geteuid().as_raw();
        let mut groups: Vec<u32> =
            getgroups().unwrap_or_default().iter().map(|group| group.as_raw()).collect();
        groups.push(getegid().as_raw());
        let user = entry("/etc/passwd", uid).map_or(uid.to_string(), |words| words[0].clone());
        let gid = port.map_or(0, |port| port.gid);
        let listed = entry("/etc/group", gid);
        let is_listed = listed
            .as_ref()
            .and_then(|words| words.get(3))
            .is_some_and(|members| members.split(',').any(|member| member == user));
        let group = listed.map_or(gid.to_string(), |words| words[0].clone());
        Rights { port, uid, groups, user, group, is_listed }
    }

    /// What is the case, and the remedy.
    pub fn explain(&self, path: &Path) -> (String, String) {
        let Rights { user, group, .. } = self;
        let path = path.display();
        let Some(Ownership { uid, gid, mode }) = self.port else {
            let remedy = "a directory above it is closed: check its parents with ls -ld".to_owned();
            return (format!("{path}: no permission for user {user} to look at it"), remedy);
        };
        let what = format!("{path}: no permission for user {user}: group {group}, mode {mode:03o}");
        let remedy = if uid == self.uid && mode & RW << 6 != RW << 6 {
            format!("you own it, but its mode denies access: chmod u+rw {path}")
        } else if uid == self.uid
            || mode & RW == RW
            || (self.groups.contains(&gid) && mode & RW << 3 == RW << 3)
        {
            format!("owner and mode allow it, so an access list or a container forbids it: getfacl {path}")
        } else if gid == 0 || mode & RW << 3 != RW << 3 {
            // Also what a new device is for a moment, until udev has seen it.
            "no group may use it; a udev rule gives it to one: SUBSYSTEM==\"tty\", GROUP=\"dialout\", MODE=\"0660\""
                .to_owned()
        } else if self.is_listed {
            format!("user {user} is in group {group}, but was not when this session started: log in again")
        } else {
            format!("sudo usermod -aG {group} {user}, then log in again")
        };
        (what, remedy)
    }
}

/// Read and write, as the last digit of a mode.
const RW: u32 = 0o6;

/// The words of the line in a file like `/etc/group` whose third one is `id`; at least three.
fn entry(file: &str, id: u32) -> Option<Vec<String>> {
    let text = fs::read_to_string(file).ok()?;
    let id = id.to_string();
    let words = |line: &str| line.split(':').map(str::to_owned).collect::<Vec<_>>();
    text.lines().map(words).find(|words| words.get(2) == Some(&id))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_reason_has_its_remedy() {
        let robot = Rights {
            port: Some(Ownership { uid: 0, gid: 20, mode: 0o660 }),
            uid: 1000,
            groups: vec![1000],
            user: "robot".to_owned(),
            group: "dialout".to_owned(),
            is_listed: false,
        };
        let port = |uid, gid, mode| Rights { port: Some(Ownership { uid, gid, mode }), ..robot.clone() };
        for (rights, says) in [
            (robot.clone(), "sudo usermod -aG dialout robot, then log in again"),
            (Rights { is_listed: true, ..robot.clone() }, "is in group dialout, but was not"),
            (Rights { groups: vec![1000, 20], ..robot.clone() }, "getfacl /dev/ttyUSB0"),
            (port(0, 0, 0o600), "udev rule"),
            (port(0, 20, 0o640), "udev rule"),
            (port(1000, 20, 0o440), "chmod u+rw /dev/ttyUSB0"),
            (port(1000, 20, 0o660), "getfacl"),
            (Rights { port: None, ..robot.clone() }, "directory above it"),
        ] {
            let (what, remedy) = rights.explain(Path::new("/dev/ttyUSB0"));
            assert!(remedy.contains(says), "{rights:?}: {remedy}");
            assert!(what.contains("/dev/ttyUSB0") && what.contains("user robot"), "{what}");
        }
        let (what, _) = robot.explain(Path::new("/dev/ttyUSB0"));
        assert!(what.contains("no permission") && what.ends_with("group dialout, mode 660"), "{what}");
    }

    #[test]
    fn the_rights_of_this_process() {
        let rights = Rights::of(Path::new("/dev/null"));
        assert_eq!(rights.uid, geteuid().as_raw());
        assert_eq!(rights.port.map(|port| port.uid), Some(0));
        assert!(rights.groups.contains(&getegid().as_raw()));
    }
}
