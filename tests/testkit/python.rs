//! A Python that has what a test needs. Refuses to know what for.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::skip;

/// A Python that has `modules`: that of `SCANHUB_PYTHON`, or the one that `.ci/run` makes. Nothing, said, where there is none.
pub(crate) fn python(modules: &str) -> Option<Command> {
    python_for("python-packages", modules)
}

/// As [`python`], where `need` is what a test lacks without them.
pub(crate) fn python_for(need: &str, modules: &str) -> Option<Command> {
    let made = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/venv/bin/python");
    let python = std::env::var_os("SCANHUB_PYTHON").map_or(made, PathBuf::from);
    let import = format!("import {modules}");
    let has_all = Command::new(&python).args(["-B", "-c", &import]).output();
    if !has_all.is_ok_and(|outcome| outcome.status.success()) {
        skip(need, format!("{} is not there, or has no {modules}: .ci/run makes one", python.display()));
        return None;
    }
    let mut command = Command::new(python);
    command.arg("-B");
    Some(command)
}
