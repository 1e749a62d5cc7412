//! Checks the versions of this program, the shared-memory library, the kernel, and the running hub. Hub and clients of
//! different versions refuse each other. Programs are compared by their bytes, or else by the version that they report.

use std::fs::{self, File, Metadata};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

use rustix::process::geteuid;
use shm::LIBRARY;

use super::{Finding, System};

const NAME: &str = "version";

/// The version of this program.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A program, compared with this one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Build {
    /// A program with the same bytes.
    Same,
    /// Another build, and the version that it reports; `None` if it must not be started, or reports none.
    Other(Option<String>),
}

/// The program of a hub's process.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Running {
    build: Build,
    /// Whether its file was replaced or removed after the start.
    is_replaced: bool,
}

/// Reports the versions, and compares this program with that of the `hub`, if one runs.
pub(crate) fn version(system: &System, hub: Option<u32>) -> Finding {
    let kernel = system.text("proc/sys/kernel/osrelease").unwrap_or_default();
    let own = match kernel.trim() {
        "" => format!("scanhub {VERSION}, {LIBRARY}"),
        kernel => format!("scanhub {VERSION}, {LIBRARY}, Linux {kernel}"),
    };
    judge(own, hub.map(|pid| (pid, running(pid))))
}

fn judge(own: String, hub: Option<(u32, Option<Running>)>) -> Finding {
    let restart = "restart the hub: sudo systemctl restart scanhub, if it is the service";
    match hub {
        None => Finding::ok(NAME, own),
        Some((_, None)) => {
            Finding::ok(NAME, format!("{own}; this user may not see which program the hub runs"))
        }
        Some((pid, Some(Running { build: Build::Other(Some(version)), .. }))) if version != VERSION => {
            let text = format!("{own}; the hub, process {pid}, is scanhub {version}: they refuse each other");
            Finding::failed(NAME, text, format!("use one version for both; {restart}"))
        }
        Some((pid, Some(Running { is_replaced: true, build }))) if build != Build::Same => {
            let text = format!("{own}; the hub, process {pid}, runs a program that was replaced since");
            Finding::warning(NAME, text, restart)
        }
        Some((_, Some(Running { is_replaced: true, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs this version; its file was replaced"))
        }
        Some((_, Some(Running { build: Build::Same, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs the same program"))
        }
        Some((_, Some(Running { .. }))) => Finding::ok(NAME, format!("{own}; the hub runs another build")),
    }
}

/// Returns the program of process `pid`, or `None` if this user may not see it.
fn running(pid: u32) -> Option<Running> {
    let process = PathBuf::from(format!("/proc/{pid}"));
    let link = fs::read_link(process.join("exe")).ok()?;
    let is_own = user_of(pid) == Some(geteuid().as_raw());
    let build = compare(&process.join("exe"), is_own).ok()?;
    Some(Running { build, is_replaced: link.to_string_lossy().ends_with(" (deleted)") })
}

/// Compares `program` with this one. Starts it to query its version only if it is `trusted`, and if only this user and
/// root can write it.
///
/// # Errors
///
/// Returns the system's error if the file cannot be read.
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
    Ok(Build::Other(if trusted && is_ours(&their) { reported_version(program) } else { None }))
}

/// Returns the user that process `pid` runs as. The owner of its directory may be root instead.
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
    let (mut left, mut right) = (vec![0; PIECE], vec![0; PIECE]);
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
    for _ in 0..POLLS {
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

/// Number of bytes that are compared at once.
const PIECE: usize = 1 << 16;
/// Maximum length of the output of `--version`, in bytes.
const MAX_OUTPUT: u64 = 1 << 10;
/// Number of polls: two seconds in total.
const POLLS: u32 = 200;
const POLL_INTERVAL: Duration = Duration::from_millis(10);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::State;
    use crate::doctor::system::tests::TempRoot;

    #[test]
    fn judges_program_of_hub() {
        let of =
            |build, is_replaced| judge("own".to_owned(), Some((7, Some(Running { build, is_replaced }))));
        let other = |version: &str| Build::Other(Some(version.to_owned()));
        assert_eq!(judge("own".to_owned(), None).state, State::Ok);
        assert_eq!(judge("own".to_owned(), Some((7, None))).state, State::Ok);
        assert_eq!(of(Build::Same, false).state, State::Ok);
        assert_eq!(of(other(VERSION), false).state, State::Ok);
        assert_eq!(of(Build::Same, true).state, State::Ok);
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
        let own = running(std::process::id()).expect("may be seen");
        assert_eq!(own, Running { build: Build::Same, is_replaced: false });
        assert_eq!(running(0), None);
    }

    #[test]
    fn compares_programs_by_their_bytes() {
        let temp = TempRoot::new(7, &[("else", "#!/bin/sh\necho scanhub 9.9.9\n")]);
        let own = std::env::current_exe().unwrap();
        assert_eq!(compare(&own, false).unwrap(), Build::Same);
        std::fs::copy(&own, temp.path("copy")).unwrap();
        assert_eq!(compare(&temp.path("copy"), true).unwrap(), Build::Same);
        // The file is not executable, so it reports no version.
        assert_eq!(compare(&temp.path("else"), true).unwrap(), Build::Other(None));
        assert!(compare(&temp.path("nothing"), true).is_err() && compare(&temp.path(""), true).is_err());
    }
}
