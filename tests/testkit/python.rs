//! A Python interpreter with the modules that a test needs.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use super::child::succeeds;
use super::{output, skip};

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

/// Returns a command that starts a Python with the package `scanhub` of this version and commit. If there is none, skips the
/// test and returns `None`.
pub(crate) fn client_python() -> Option<Command> {
    static FOUND: OnceLock<String> = OnceLock::new();
    let command = python_for("python-packages", "numpy")?;
    let found = FOUND.get_or_init(|| {
        let mut ask = Command::new(command.get_program());
        ask.args(["-B", "-c", "import scanhub; print(scanhub.__version__, scanhub.__commit__)"]);
        text(ask)
    });
    let mut git = Command::new("git");
    let commit = text({
        git.args(["rev-parse", "HEAD"]).current_dir(env!("CARGO_MANIFEST_DIR"));
        git
    });
    let commit = if commit.is_empty() { "unknown" } else { &commit };
    let expected = format!("{} {commit}", env!("CARGO_PKG_VERSION"));
    if *found != expected {
        let python = command.get_program().display();
        let what = format!("{python} has the package {found:?} in place of {expected:?}");
        skip("python-packages", format!("{what}: clients/python/build.sh makes it"));
        return None;
    }
    Some(command)
}

/// Returns what a program prints in one line; empty if it fails.
fn text(mut command: Command) -> String {
    let output = output(command.stderr(Stdio::null())).ok().filter(|output| output.status.success());
    output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default()
}
