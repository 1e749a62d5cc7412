//! Tests of skipped tests: the reason for a skip is printed although the test harness hides the output of passed tests.
//! A test fails instead of being skipped if `SCANHUB_REQUIRE` names the missing requirement.

use std::process::{Command, Output};

use crate::testkit::{output, own_program, single_test_args, skip, skip_verdict};

/// Variable that is set in the process in which the test skips itself.
const RERUN_VARIABLE: &str = "SCANHUB_TEST_SKIP";

#[test]
fn required_tool_may_not_be_skipped() {
    let verdict = skip_verdict("", "tmux", "there is none");
    assert_eq!(verdict, Ok("skipped for want of tmux: there is none".to_owned()));
    assert!(skip_verdict("cc,tshark", "tmux", "there is none").is_ok());
    for required in ["tmux", "cc,tmux", " cc , tmux ,"] {
        let message = skip_verdict(required, "tmux", "there is none").expect_err(required);
        assert_eq!(message, "tmux is required here by SCANHUB_REQUIRE: there is none");
    }
    // A misspelled name must be an error, because it would otherwise require nothing.
    for (required, need) in [("tmuks", "tmux"), ("", "tmuks"), ("tmux,netn", "cc")] {
        let message = skip_verdict(required, need, "there is none").expect_err(required);
        assert!(message.contains("is not a requirement of tests; known are bash, cc, "), "{message}");
    }
}

#[test]
fn skipped_test_is_reported_or_fails() {
    if std::env::var_os(RERUN_VARIABLE).is_some() {
        return skip("tmux", "as if there were none");
    }
    let again = |required: &str| -> Output {
        let mut command = Command::new(own_program());
        // Leave out `--nocapture`, so that the harness hides the output of passed tests.
        command.args(&single_test_args("skips::skipped_test_is_reported_or_fails")[..2]);
        command.env(RERUN_VARIABLE, "1").env("SCANHUB_REQUIRE", required).env_remove("RUST_TEST_NOCAPTURE");
        output(command).expect("the output of the program")
    };
    let left_out = again("cc");
    assert!(left_out.status.success(), "{left_out:?}");
    let errors = String::from_utf8_lossy(&left_out.stderr).into_owned();
    assert_eq!(errors, "skipped for want of tmux: as if there were none\n");
    let failed = again("cc,tmux");
    assert!(!failed.status.success(), "{failed:?}");
    let output_text = String::from_utf8_lossy(&failed.stdout).into_owned();
    assert!(
        output_text.contains("tmux is required here by SCANHUB_REQUIRE: as if there were none"),
        "{output_text}"
    );
}
