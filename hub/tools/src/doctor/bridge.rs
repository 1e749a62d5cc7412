//! Whether a bridge to other machines would work: the program is there and of this version, and what it finds itself when it
//! connects as it would. Zenoh is in that program, not in this one.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde::Deserialize;

use super::finding::Finding;
use crate::bridge_program::{PROGRAM, find, places};

const NAME: &str = "bridge";

/// How a bridge would connect.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bridge {
    /// Routers, as `scanhub bridge --connect` takes them.
    pub connect: Vec<String>,
    /// A file of Zenoh's own configuration.
    pub config: Option<PathBuf>,
    /// Where the program may be, the first place first; none: beside this one, and where the shell looks.
    pub places: Vec<PathBuf>,
}

/// What the program says, a line each.
#[derive(Deserialize)]
struct Said {
    class: String,
    state: String,
    finding: String,
    remedy: String,
}

/// Examines what `bridge` says, if anybody named a router.
pub(crate) fn bridge(bridge: &Bridge) -> Vec<Finding> {
    if bridge.connect.is_empty() && bridge.config.is_none() {
        return vec![Finding::skipped(NAME, "no router is named; --bridge tcp/HOST:7447 does")];
    }
    let places = if bridge.places.is_empty() { places() } else { bridge.places.clone() };
    match find(&places) {
        Ok(program) => ask(&program, bridge),
        Err(failure) => vec![Finding::failed(NAME, failure.message, failure.hint)],
    }
}

/// What the program finds when it connects.
fn ask(program: &Path, bridge: &Bridge) -> Vec<Finding> {
    let mut command = Command::new(program);
    command.args(["--check", "--json"]).stdin(Stdio::null());
    command.args(bridge.connect.iter().map(|to| format!("--connect={to}")));
    if let Some(config) = &bridge.config {
        command.arg("--config").arg(config);
    }
    let output = match command.output() {
        Ok(output) => output,
        Err(error) => return vec![Finding::failed(NAME, format!("{}: {error}", program.display()), "")],
    };
    let text = String::from_utf8_lossy(&output.stdout);
    let lines = text.lines().filter_map(|line| serde_json::from_str::<Said>(line).ok());
    let findings: Vec<Finding> = lines.filter(|said| said.class == "bridge_check").map(finding).collect();
    if findings.is_empty() {
        let said = String::from_utf8_lossy(&output.stderr);
        let said = said.lines().next().unwrap_or("nothing");
        return vec![Finding::failed(NAME, format!("{PROGRAM} --check says {said}"), "run it by itself")];
    }
    findings
}

fn finding(said: Said) -> Finding {
    match said.state.as_str() {
        "ok" => Finding::ok(NAME, said.finding),
        "warning" => Finding::warning(NAME, said.finding, said.remedy),
        _ => Finding::failed(NAME, said.finding, said.remedy),
    }
}

#[cfg(test)]
#[path = "../../../../tests/testkit/child.rs"]
mod child;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::child::write_program;
    use super::*;

    /// What is found with a program that is this text of a shell.
    fn of(script: Option<&str>) -> Vec<(State, String, String)> {
        let place = tempfile::tempdir().unwrap();
        if let Some(script) = script {
            write_program(place.path().join(PROGRAM), format!("#!/bin/sh\n{script}\n"));
        }
        let examined =
            Bridge { connect: vec!["tcp/r:1".into()], config: None, places: vec![place.path().to_owned()] };
        bridge(&examined).into_iter().map(|it| (it.state, it.finding, it.remedy)).collect()
    }

    fn version() -> String {
        format!("[ \"$1\" = --version ] && echo {PROGRAM} {} && exit", env!("CARGO_PKG_VERSION"))
    }

    #[test]
    fn without_a_router_nothing_is_looked_at() {
        assert_eq!(bridge(&Bridge::default())[0].state, State::Skipped);
    }

    #[test]
    fn a_program_that_is_missing_or_another_one_is_told() {
        let missing = of(None);
        assert!(missing[0].0 == State::Failed && missing[0].2.contains("cargo install"), "{missing:?}");
        let other = of(Some("echo scanhub-bridge 0.0.7"));
        assert!(other[0].0 == State::Failed && other[0].1.contains("version 0.0.7"), "{other:?}");
        let broken = of(Some("echo no such library >&2; exit 127"));
        assert!(broken[0].0 == State::Failed && broken[0].1.contains("does not run"), "{broken:?}");
    }

    #[test]
    fn what_the_program_finds_is_shown() {
        let line = |state: &str| {
            format!(
                "echo '{{\"class\":\"bridge_check\",\"state\":\"{state}\",\"finding\":\"'$3'\",\"remedy\":\"do\"}}'"
            )
        };
        let script = format!("{}\n{}\n{}\necho nonsense\nexit 5", version(), line("warning"), line("failed"));
        let found = of(Some(&script));
        let said = "--connect=tcp/r:1".to_owned();
        assert_eq!(found, [(State::Warning, said.clone(), "do".into()), (State::Failed, said, "do".into())]);
        let silent = of(Some(&format!("{}\necho what >&2; exit 2", version())));
        assert!(silent[0].0 == State::Failed && silent[0].1.contains("what"), "{silent:?}");
    }
}
