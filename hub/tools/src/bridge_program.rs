//! The program `scanhub-bridge`. This module finds the program, checks its version, and runs its check whether a bridge
//! could connect. Zenoh is linked into that program, not into this one.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use scanhub_schema::{Failure, Kind};
use serde::Deserialize;

use crate::doctor::Finding;

/// Name of the program.
pub const PROGRAM: &str = "scanhub-bridge";
/// Remedy if the program is missing.
const INSTALL_REMEDY: &str = "in the directory of scanhub's source: cargo install --path clients/bridge";

/// Returns the directories in which the program may be, in the order of the search: the directory of this program, and
/// the directories of PATH.
pub fn search_directories() -> Vec<PathBuf> {
    let own = std::env::current_exe().ok().and_then(|path| path.parent().map(Path::to_owned));
    let path = std::env::var_os("PATH").unwrap_or_default();
    own.into_iter().chain(std::env::split_paths(&path)).collect()
}

/// Returns the path of the first `scanhub-bridge` in `directories`, which has the version of this program.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if the program is not found, does not run, or has another version.
pub fn find(directories: &[PathBuf]) -> Result<PathBuf, Failure> {
    let refuse = |what: String, hint: &str| Err(Failure::new(Kind::Configuration, what, hint));
    let Some(program) =
        directories.iter().map(|directory| directory.join(PROGRAM)).find(|path| path.is_file())
    else {
        return refuse(format!("{PROGRAM} is not installed"), INSTALL_REMEDY);
    };
    let own = env!("CARGO_PKG_VERSION");
    match version(&program) {
        Ok(version) if version == own => Ok(program),
        Ok(version) => {
            let what = format!("{} has version {version}, this program {own}", program.display());
            refuse(what, &format!("install both of one version, {INSTALL_REMEDY}"))
        }
        Err(why) => {
            let what = format!("{} does not run: {why}", program.display());
            refuse(what, &format!("install it again, {INSTALL_REMEDY}"))
        }
    }
}

/// Returns the version that `program` prints, or the reason why it prints none.
fn version(program: &Path) -> Result<String, String> {
    let output = Command::new(program).arg("--version").stdin(Stdio::null()).output();
    let output = output.map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stdout);
    let version = text.strip_prefix(PROGRAM).map(str::trim).filter(|_| output.status.success());
    version.map(str::to_owned).ok_or_else(|| format!("it says {:?}", text.trim()))
}

/// Connection of a bridge to other machines.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bridge {
    /// Routers, as `scanhub bridge --connect` takes them.
    pub connect: Vec<String>,
    /// A file of Zenoh's own configuration.
    pub config: Option<PathBuf>,
    /// Directories in which the program may be, in the order of the search. If the list is empty, the directories of
    /// [`search_directories`].
    pub directories: Vec<PathBuf>,
}

impl Bridge {
    /// Returns the findings of the check `bridge`. If the user named a router or a configuration, these are the
    /// findings of the program.
    pub(crate) fn check(&self) -> Vec<Finding> {
        if self.connect.is_empty() && self.config.is_none() {
            return vec![Finding::skipped(CHECK, "no router is named; --bridge tcp/HOST:7447 does")];
        }
        let directories =
            if self.directories.is_empty() { search_directories() } else { self.directories.clone() };
        match find(&directories) {
            Ok(program) => self.check_with(&program),
            Err(failure) => vec![Finding::failed(CHECK, failure.message, failure.hint)],
        }
    }

    /// Runs the check of `program`, which tries to connect, and returns its findings.
    fn check_with(&self, program: &Path) -> Vec<Finding> {
        let mut command = Command::new(program);
        command.args(["--check", "--json"]).stdin(Stdio::null());
        command.args(self.connect.iter().map(|to| format!("--connect={to}")));
        if let Some(config) = &self.config {
            command.arg("--config").arg(config);
        }
        let output = match command.output() {
            Ok(output) => output,
            Err(error) => return vec![Finding::failed(CHECK, format!("{}: {error}", program.display()), "")],
        };
        let text = String::from_utf8_lossy(&output.stdout);
        let lines = text.lines().filter_map(|line| serde_json::from_str::<CheckLine>(line).ok());
        let findings: Vec<Finding> =
            lines.filter(|line| line.class == "bridge_check").map(CheckLine::finding).collect();
        if findings.is_empty() {
            let errors = String::from_utf8_lossy(&output.stderr);
            let first = errors.lines().next().unwrap_or("nothing");
            return vec![Finding::failed(
                CHECK,
                format!("{PROGRAM} --check says {first}"),
                "run it by itself",
            )];
        }
        findings
    }
}

/// One line of JSON that the program prints.
#[derive(Deserialize)]
struct CheckLine {
    class: String,
    state: String,
    finding: String,
    remedy: String,
}

impl CheckLine {
    fn finding(self) -> Finding {
        match self.state.as_str() {
            "ok" => Finding::ok(CHECK, self.finding),
            "warning" => Finding::warning(CHECK, self.finding, self.remedy),
            _ => Finding::failed(CHECK, self.finding, self.remedy),
        }
    }
}

/// Name of the check in `doctor`.
const CHECK: &str = "bridge";

#[cfg(test)]
#[path = "../../../tests/testkit/child.rs"]
mod child;

#[cfg(test)]
mod tests {
    use super::child::write_program;
    use super::*;
    use crate::doctor::State;

    /// Checks a bridge with a program that is the shell script `script`.
    fn check(script: Option<&str>) -> Vec<(State, String, String)> {
        let place = tempfile::tempdir().unwrap();
        if let Some(script) = script {
            write_program(place.path().join(PROGRAM), format!("#!/bin/sh\n{script}\n"));
        }
        let bridge = Bridge {
            connect: vec!["tcp/r:1".into()],
            config: None,
            directories: vec![place.path().to_owned()],
        };
        bridge.check().into_iter().map(|it| (it.state, it.finding, it.remedy)).collect()
    }

    fn version() -> String {
        format!("[ \"$1\" = --version ] && echo {PROGRAM} {} && exit", env!("CARGO_PKG_VERSION"))
    }

    #[test]
    fn skips_check_without_router() {
        assert_eq!(Bridge::default().check()[0].state, State::Skipped);
    }

    #[test]
    fn reports_missing_different_or_broken_program() {
        let missing = check(None);
        assert!(missing[0].0 == State::Failed && missing[0].2.contains("cargo install"), "{missing:?}");
        let other = check(Some("echo scanhub-bridge 0.0.7"));
        assert!(other[0].0 == State::Failed && other[0].1.contains("version 0.0.7"), "{other:?}");
        let broken = check(Some("echo no such library >&2; exit 127"));
        assert!(broken[0].0 == State::Failed && broken[0].1.contains("does not run"), "{broken:?}");
    }

    #[test]
    fn passes_on_findings_of_program() {
        let line = |state: &str| {
            format!(
                "echo '{{\"class\":\"bridge_check\",\"state\":\"{state}\",\"finding\":\"'$3'\",\"remedy\":\"do\"}}'"
            )
        };
        let script = format!("{}\n{}\n{}\necho nonsense\nexit 5", version(), line("warning"), line("failed"));
        let found = check(Some(&script));
        let option = "--connect=tcp/r:1".to_owned();
        assert_eq!(
            found,
            [(State::Warning, option.clone(), "do".into()), (State::Failed, option, "do".into())]
        );
        let silent = check(Some(&format!("{}\necho what >&2; exit 2", version())));
        assert!(silent[0].0 == State::Failed && silent[0].1.contains("what"), "{silent:?}");
    }
}
