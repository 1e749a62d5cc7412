//! Build script that stores the commit from which the module is built, and the hash of its sources. With the hash, the
//! tests detect a module that was built from other sources.

mod sources;

use std::io;
use std::path::Path;
use std::process::Command;

fn main() -> io::Result<()> {
    let git = |words: &[&str]| {
        let output =
            Command::new("git").args(words).output().ok().filter(|output| output.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["rev-parse", "HEAD"]).unwrap_or_else(|| "unknown".to_owned());
    println!("cargo:rustc-env=SCANHUB_COMMIT={commit}");
    for path in ["HEAD", "logs/HEAD"].into_iter().filter_map(|path| git(&["rev-parse", "--git-path", path])) {
        println!("cargo:rerun-if-changed={path}");
    }
    let root = Path::new("../..");
    let packages = sources::packages(root)?;
    println!("cargo:rustc-env=SCANHUB_SOURCES={}", sources::hash(root, &packages)?);
    println!("cargo:rerun-if-changed=../../Cargo.toml");
    packages.iter().for_each(|package| println!("cargo:rerun-if-changed=../../{package}"));
    Ok(())
}
