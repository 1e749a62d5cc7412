//! Whether a program on this machine is the same as this one: by its bytes, else by the version that it reports. Hub and
//! clients of two versions refuse each other.

use std::fs::{File, Metadata};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

use rustix::process::geteuid;

/// What a program is beside this one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Build {
    /// The same, byte for byte.
    Same,
    /// Another build; the version that it tells, if it could be asked.
    Other(Option<String>),
}

/// The version of this program.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Compares `program` with this one. It is started, to be asked, only if nobody but this user or root may have written
/// it, and `trusted`.
///
/// The system's error if it cannot be read.
pub(crate) fn compare(program: &Path, trusted: bool) -> std::io::Result<Build> {
    let (ours, theirs) = (File::open("/proc/self/exe")?, File::open(program)?);
    let (our, their) = (ours.metadata()?, theirs.metadata()?);
    if !their.is_file() {
        return Err(std::io::ErrorKind::InvalidInput.into());
    }
    if (our.dev(), our.ino()) == (their.dev(), their.ino())
        || (our.len() == their.len() && is_same(ours, theirs))
    {
        return Ok(Build::Same);
    }
    Ok(Build::Other(if trusted && is_ours(&their) { version(program) } else { None }))
}

/// The user that process `pid` runs as; whom its directory belongs to may be root all the same.
pub(crate) fn user_of(pid: u32) -> Option<u32> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    status.lines().find_map(|line| line.strip_prefix("Uid:"))?.split_whitespace().next()?.parse().ok()
}

/// Whether process `pid` was stopped, by a signal or a debugger.
pub(crate) fn is_stopped(pid: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let state = status.lines().find_map(|line| line.strip_prefix("State:"));
    state.is_some_and(|state| state.trim_start().starts_with(['T', 't']))
}

/// Whether only this user and root may write it.
fn is_ours(metadata: &Metadata) -> bool {
    [0, geteuid().as_raw()].contains(&metadata.uid()) && metadata.mode() & 0o022 == 0
}

fn is_same(mut one: File, mut other: File) -> bool {
    let (mut left, mut right) = (vec![0; PIECE], vec![0; PIECE]);
    loop {
        match one.read(&mut left) {
            Ok(0) => return true,
            Ok(len) if other.read_exact(&mut right[..len]).is_ok() && left[..len] == right[..len] => {}
            _ => return false,
        }
    }
}

/// What `program --version` says, if it is a scanhub and says it soon.
fn version(program: &Path) -> Option<String> {
    let mut command = Command::new(program);
    command.arg("--version").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut process = command.spawn().ok()?;
    for _ in 0..LOOKS {
        if let Ok(Some(_)) = process.try_wait() {
            let mut said = String::new();
            process.stdout.take()?.take(LONGEST).read_to_string(&mut said).ok()?;
            return Some(said.lines().next()?.strip_prefix("scanhub ")?.trim().to_owned());
        }
        thread::sleep(BETWEEN_LOOKS);
    }
    let _ = process.kill();
    let _ = process.wait();
    None
}

const PIECE: usize = 1 << 16;
const LONGEST: u64 = 1 << 10;
/// Two seconds in all.
const LOOKS: u32 = 200;
const BETWEEN_LOOKS: Duration = Duration::from_millis(10);

#[cfg(test)]
mod tests {
    use super::super::system::tests::Laid;
    use super::*;

    #[test]
    fn the_same_bytes_are_the_same_program() {
        let laid = Laid::out(7, &[("else", "#!/bin/sh\necho scanhub 9.9.9\n")]);
        let own = std::env::current_exe().unwrap();
        assert_eq!(compare(&own, false).unwrap(), Build::Same);
        std::fs::copy(&own, laid.path("copy")).unwrap();
        assert_eq!(compare(&laid.path("copy"), true).unwrap(), Build::Same);
        // It cannot be started, and what cannot be trusted is not.
        assert_eq!(compare(&laid.path("else"), true).unwrap(), Build::Other(None));
        assert!(compare(&laid.path("nothing"), true).is_err() && compare(&laid.path(""), true).is_err());
    }
}
