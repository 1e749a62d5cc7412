//! The program `scanhub-bridge`: where it is, and whether it is of this version. Refuses to know what it does.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use schema::{Failure, Kind};

/// What it is called.
pub const PROGRAM: &str = "scanhub-bridge";
/// How to get it.
const INSTALL: &str = "in the directory of scanhub's source: cargo install --path clients/bridge";

/// Returns the directories in which it may be, the first one first: that of this program, and those of PATH.
pub fn places() -> Vec<PathBuf> {
    let beside = std::env::current_exe().ok().and_then(|path| path.parent().map(Path::to_owned));
    let path = std::env::var_os("PATH").unwrap_or_default();
    beside.into_iter().chain(std::env::split_paths(&path)).collect()
}

/// Returns the first one in `places` that is of this version.
///
/// # Errors
///
/// [`Kind::Configuration`] if there is none, if it does not run, or if it is of another version.
pub fn find(places: &[PathBuf]) -> Result<PathBuf, Failure> {
    let refuse = |what: String, hint: &str| Err(Failure::new(Kind::Configuration, what, hint));
    let Some(program) = places.iter().map(|place| place.join(PROGRAM)).find(|path| path.is_file()) else {
        return refuse(format!("{PROGRAM} is not installed"), INSTALL);
    };
    let own = env!("CARGO_PKG_VERSION");
    match version(&program) {
        Ok(version) if version == own => Ok(program),
        Ok(version) => {
            let what = format!("{} has version {version}, this program {own}", program.display());
            refuse(what, &format!("install both of one version, {INSTALL}"))
        }
        Err(why) => {
            let what = format!("{} does not run: {why}", program.display());
            refuse(what, &format!("install it again, {INSTALL}"))
        }
    }
}

fn version(program: &Path) -> Result<String, String> {
    let said = Command::new(program).arg("--version").stdin(Stdio::null()).output();
    let said = said.map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&said.stdout);
    let version = text.strip_prefix(PROGRAM).map(str::trim).filter(|_| said.status.success());
    version.map(str::to_owned).ok_or_else(|| format!("it says {:?}", text.trim()))
}
