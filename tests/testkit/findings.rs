//! What `scanhub doctor` finds, and a line of a table for each set-up in which it was found: what is wrong, which check
//! says so, and the remedy.

use serde_json::Value;

use super::{Outcome, TestEnv};

/// All findings of one examination.
pub(crate) struct Findings(Vec<Value>);

impl Findings {
    /// Those of the program with these arguments.
    pub(crate) fn of(env: &TestEnv, arguments: &[&str]) -> Findings {
        Findings::in_outcome(&env.run(&[&["doctor", "--json", "--no-system-config"], arguments].concat()))
    }

    /// Those that it said. Whether one failed it said by its exit code too.
    pub(crate) fn in_outcome(outcome: &Outcome) -> Findings {
        let findings = Findings(outcome.of_class("check"));
        let failed = findings.0.iter().any(|line| line["state"] == "failed");
        assert_eq!(outcome.exit_code, Some(if failed { 5 } else { 0 }), "{outcome}");
        findings
    }

    /// Those that somebody else was told, as lines.
    pub(crate) fn in_lines(lines: Vec<Value>) -> Findings {
        Findings(lines)
    }

    /// In `set_up` check `name` must say `state` and a remedy with this word.
    pub(crate) fn assert_problem(&self, set_up: &str, name: &str, state: &str, remedy_word: &str) {
        let is_it = |line: &&Value| {
            let remedy = line["remedy"].as_str().unwrap_or_default();
            line["name"] == name && line["state"] == state && remedy.contains(remedy_word)
        };
        let line = self.0.iter().find(is_it);
        let line =
            line.unwrap_or_else(|| panic!("{set_up}: no {name} {state} with {remedy_word}: {:#?}", self.0));
        let remedy = line["remedy"].as_str().unwrap_or_default();
        println!("{set_up:44} {state:8} {name:13} {remedy}");
    }

    /// Nothing may be wrong; what was not looked at has a reason.
    pub(crate) fn assert_no_problem(&self) {
        assert!(!self.0.is_empty());
        for line in &self.0 {
            let state = line["state"].as_str().unwrap_or_default();
            let finding = line["finding"].as_str().unwrap_or_default();
            assert!(["ok", "skipped"].contains(&state) && !finding.is_empty(), "{line}");
            assert_eq!(line["remedy"], "", "{line}");
        }
    }

    /// Those of other checks than these.
    pub(crate) fn without(&self, names: &[&str]) -> Findings {
        let others = self.0.iter().filter(|line| !names.iter().any(|name| line["name"] == *name));
        Findings(others.cloned().collect())
    }

    /// Those that are of no port.
    pub(crate) fn without_ports(&self) -> Findings {
        Findings(self.0.iter().filter(|line| line["port"].is_null()).cloned().collect())
    }

    /// State and finding of the check `name`, the first if there are several.
    pub(crate) fn state_and_text(&self, name: &str) -> (&str, &str) {
        let line = self.0.iter().find(|line| line["name"] == name);
        let line = line.unwrap_or_else(|| panic!("no {name}: {:#?}", self.0));
        (line["state"].as_str().unwrap_or_default(), line["finding"].as_str().unwrap_or_default())
    }
}
