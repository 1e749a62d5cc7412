//! Findings of `scanhub doctor`, and assertions about them. For each expected problem, the assertion prints a line of a
//! table with the setup, the state, the check and the remedy.

use serde_json::Value;

use super::{Outcome, TestEnv};

/// All findings of one run of `scanhub doctor`, as JSON lines of class `check`.
pub(crate) struct Findings(Vec<Value>);

impl Findings {
    /// Runs `scanhub doctor` with these arguments, and returns its findings.
    pub(crate) fn of(env: &TestEnv, arguments: &[&str]) -> Findings {
        Findings::in_outcome(&env.run(&[&["doctor", "--json", "--no-system-config"], arguments].concat()))
    }

    /// Returns the findings in the output of a run. Asserts that the exit code is 5 if a check has failed, and 0
    /// otherwise.
    pub(crate) fn in_outcome(outcome: &Outcome) -> Findings {
        let findings = Findings(outcome.of_class("check"));
        let failed = findings.0.iter().any(|line| line["state"] == "failed");
        assert_eq!(outcome.exit_code, Some(if failed { 5 } else { 0 }), "{outcome}");
        findings
    }

    /// Creates findings from JSON lines that the test has obtained in another way.
    pub(crate) fn in_lines(lines: Vec<Value>) -> Findings {
        Findings(lines)
    }

    /// Asserts that check `name` has `state` and a remedy that contains `remedy_word`, and prints the finding as a line
    /// of the table. `set_up` describes the setup of the test.
    pub(crate) fn assert_problem(&self, set_up: &str, name: &str, state: &str, remedy_word: &str) {
        let is_it = |line: &&Value| {
            let remedy = line["remedy"].as_str().unwrap_or_default();
            line["name"] == name && line["state"] == state && remedy.contains(remedy_word)
        };
        let line = self.0.iter().find(is_it);
        let line = line.unwrap_or_else(|| {
            panic!("{set_up}: check {name} is not {state} with {remedy_word} in its remedy: {:#?}", self.0)
        });
        let remedy = line["remedy"].as_str().unwrap_or_default();
        println!("{set_up:44} {state:8} {name:13} {remedy}");
    }

    /// Asserts that every check is `ok` or `skipped` and has a finding but no remedy.
    pub(crate) fn assert_no_problem(&self) {
        assert!(!self.0.is_empty());
        for line in &self.0 {
            let state = line["state"].as_str().unwrap_or_default();
            let finding = line["finding"].as_str().unwrap_or_default();
            assert!(["ok", "skipped"].contains(&state) && !finding.is_empty(), "{line}");
            assert_eq!(line["remedy"], "", "{line}");
        }
    }

    /// Returns the findings of all checks except `names`.
    pub(crate) fn without(&self, names: &[&str]) -> Findings {
        let others = self.0.iter().filter(|line| !names.iter().any(|name| line["name"] == *name));
        Findings(others.cloned().collect())
    }

    /// Returns the findings that do not belong to a port.
    pub(crate) fn without_ports(&self) -> Findings {
        Findings(self.0.iter().filter(|line| line["port"].is_null()).cloned().collect())
    }

    /// Returns state and finding of the first check called `name`.
    pub(crate) fn state_and_text(&self, name: &str) -> (&str, &str) {
        let line = self.0.iter().find(|line| line["name"] == name);
        let line = line.unwrap_or_else(|| panic!("no check {name} in {:#?}", self.0));
        (line["state"].as_str().unwrap_or_default(), line["finding"].as_str().unwrap_or_default())
    }
}
