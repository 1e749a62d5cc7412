//! A Python that has what a test needs: that of `SCANHUB_PYTHON`, else the one that `.ci/run` makes in `target/venv`.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The interpreter, or nothing, said why, where there is none that can import all `modules`.
pub(crate) fn python(modules: &[&str]) -> Option<PathBuf> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let named = std::env::var_os("SCANHUB_PYTHON").map(PathBuf::from);
    let python = named.unwrap_or_else(|| top.join("target/venv/bin/python"));
    let imports = format!("import {}", modules.join(", "));
    let has_all = Command::new(&python).args(["-c", &imports]).stderr(Stdio::null()).status();
    if has_all.is_ok_and(|status| status.success()) {
        return Some(python);
    }
    let missing = modules.join(" and ");
    eprintln!("skipped: {} is no Python with {missing}; .ci/run makes one", python.display());
    None
}

/// Runs `script`, a path below the top, by `python`: it finds the package `scanhub` of this project, and leaves no caches.
pub(crate) fn script(python: &Path, script: &str) -> Command {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut command = Command::new(python);
    command.arg("-B").arg(top.join(script)).env("PYTHONPATH", top.join("clients/python"));
    command.env_remove("SCANHUB_DOMAIN");
    command
}
