//! A Python interpreter with the modules that a test needs.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::child::succeeds;
use super::skip;

/// Returns a command that starts a Python with `modules`: that of `SCANHUB_PYTHON`, or the one that `.ci/run`
/// installs. If there is none, skips the test and returns `None`.
pub(crate) fn python(modules: &str) -> Option<Command> {
    python_for("python-packages", modules)
}

/// Returns the same as [`python`], and skips the test for want of `need`.
pub(crate) fn python_for(need: &str, modules: &str) -> Option<Command> {
    let made = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/venv/bin/python");
    let python = std::env::var_os("SCANHUB_PYTHON").map_or(made, PathBuf::from);
    let import = format!("import {modules}");
    if !succeeds(Command::new(&python).args(["-B", "-c", &import])) {
        skip(need, format!("{} is not there, or has no {modules}: .ci/run makes one", python.display()));
        return None;
    }
    let mut command = Command::new(python);
    command.arg("-B");
    Some(command)
}
