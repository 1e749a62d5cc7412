//! The versions: this program, the shared-memory library, the kernel, and the running hub. Hub and clients of two versions
//! refuse each other.

use std::fs;
use std::path::PathBuf;

use rustix::process::geteuid;
use schema::ipc::LIBRARY;

use super::finding::Finding;
use super::program::{Build, VERSION, compare, user_of};
use super::system::System;

const NAME: &str = "version";

/// What the hub's process runs.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Running {
    build: Build,
    /// Its file was replaced or removed since it was started.
    is_gone: bool,
}

/// Tells the versions, and compares this program with that of the `hub`, if one lives.
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
        Some((pid, Some(Running { is_gone: true, build }))) if build != Build::Same => {
            let text = format!("{own}; the hub, process {pid}, runs a program that was replaced since");
            Finding::warning(NAME, text, restart)
        }
        Some((_, Some(Running { is_gone: true, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs this version; its file was replaced"))
        }
        Some((_, Some(Running { build: Build::Same, .. }))) => {
            Finding::ok(NAME, format!("{own}; the hub runs the same program"))
        }
        Some((_, Some(Running { .. }))) => Finding::ok(NAME, format!("{own}; the hub runs another build")),
    }
}

/// What process `pid` runs, if this user may see it.
fn running(pid: u32) -> Option<Running> {
    let process = PathBuf::from(format!("/proc/{pid}"));
    let link = fs::read_link(process.join("exe")).ok()?;
    let is_own = user_of(pid) == Some(geteuid().as_raw());
    let build = compare(&process.join("exe"), is_own).ok()?;
    Some(Running { build, is_gone: link.to_string_lossy().ends_with(" (deleted)") })
}

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::*;

    #[test]
    fn one_version_meets_itself() {
        let of = |build, is_gone| judge("own".to_owned(), Some((7, Some(Running { build, is_gone }))));
        let told = |version: &str| Build::Other(Some(version.to_owned()));
        assert_eq!(judge("own".to_owned(), None).state, State::Ok);
        assert_eq!(judge("own".to_owned(), Some((7, None))).state, State::Ok);
        assert_eq!(of(Build::Same, false).state, State::Ok);
        assert_eq!(of(told(VERSION), false).state, State::Ok);
        assert_eq!(of(Build::Same, true).state, State::Ok);
        let replaced = of(told(VERSION), true);
        assert!(replaced.state == State::Warning && replaced.remedy.contains("restart"), "{replaced}");
        let other = of(told("0.0.1"), false);
        assert!(other.state == State::Failed && other.finding.contains("scanhub 0.0.1"), "{other}");
    }

    #[test]
    fn what_this_process_runs() {
        let own = running(std::process::id()).expect("may be seen");
        assert_eq!(own, Running { build: Build::Same, is_gone: false });
        assert_eq!(running(0), None);
    }
}
