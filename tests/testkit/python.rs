//! Python interpreter with the modules that a test needs.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use super::child::succeeds;
use super::{output, skip};

#[path = "../../clients/python/sources.rs"]
mod sources;

/// Returns a command that starts a Python interpreter that has `modules`. It is the interpreter in the variable
/// `SCANHUB_PYTHON`, or else the one that `.ci/run` installs. If the modules are missing, skips the test and returns
/// `None`.
pub(crate) fn python(modules: &str) -> Option<Command> {
    python_for("python-packages", modules)
}

/// Does the same as [`python`], but names `need` as the missing requirement if the test is skipped.
pub(crate) fn python_for(need: &str, modules: &str) -> Option<Command> {
    let made = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/venv/bin/python");
    let python = std::env::var_os("SCANHUB_PYTHON").map_or(made, PathBuf::from);
    let import = format!("import {modules}");
    if !succeeds(Command::new(&python).args(["-B", "-c", &import])) {
        skip(need, format!("{} does not exist or lacks {modules}; .ci/run creates one", python.display()));
        return None;
    }
    let mut command = Command::new(python);
    command.arg("-B");
    Some(command)
}

/// Returns a command that starts a Python interpreter with the package `scanhub` that was built from these sources. If
/// the package was not built, skips the test and returns `None`.
pub(crate) fn client_python() -> Option<Command> {
    static CLIENT_PYTHON: OnceLock<(String, String)> = OnceLock::new();
    let command = python_for("python-packages", "numpy")?;
    let (found, expected) = CLIENT_PYTHON.get_or_init(|| {
        let mut ask = Command::new(command.get_program());
        ask.args(["-B", "-c", "import scanhub; print(scanhub._scanhub._sources)"]);
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let expected = sources::packages(root).and_then(|packages| sources::hash(root, &packages));
        (text(ask), expected.expect("the sources are readable"))
    });
    if found != expected {
        let python = command.get_program().display();
        let what = format!("{python} has no package scanhub that was built from these sources");
        skip("python-packages", format!("{what}; clients/python/build.sh builds it"));
        return None;
    }
    Some(command)
}

/// Returns the trimmed stdout of a program, or an empty string if it fails.
fn text(mut command: Command) -> String {
    let output = output(command.stderr(Stdio::null())).ok().filter(|output| output.status.success());
    output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default()
}
