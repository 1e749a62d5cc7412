//! Hash of the sources of the native module. The build script compiles the hash into the module, and the tests compare
//! it with the hash of the current sources.

use std::collections::BTreeSet;
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::path::{Path, PathBuf};

/// Directories below a package that do not change the module.
const SKIPPED_DIRECTORIES: [&str; 4] = ["tests", "benches", "examples", "target"];

/// Extensions of the files that change the module. Files with other extensions are documents, or are written by Python,
/// maturin or an editor.
const EXTENSIONS: [&str; 7] = ["rs", "toml", "txt", "py", "pyi", "typed", "lock"];

/// Returns the hash of the sources in `packages`, relative to the directory `root` of the workspace.
pub(crate) fn hash(root: &Path, packages: &BTreeSet<String>) -> io::Result<String> {
    let mut hasher = DefaultHasher::new();
    for package in packages {
        add(root, Path::new(package), &mut hasher)?;
    }
    Ok(format!("{:016x}", hasher.finish()))
}

/// Returns the directories, relative to `root`, of the module's package and of its dependencies in the workspace.
pub(crate) fn packages(root: &Path) -> io::Result<BTreeSet<String>> {
    let workspace = fs::read_to_string(root.join("Cargo.toml"))?;
    let directory_of = |dependency: &str| {
        let entry = format!("{dependency} = {{ path = \"");
        workspace.lines().find_map(|line| line.strip_prefix(&entry)?.split('"').next())
    };
    let (mut packages, mut next) = (BTreeSet::new(), vec!["clients/python"]);
    while let Some(package) = next.pop() {
        if !packages.insert(package.to_owned()) {
            continue;
        }
        let mut section = "";
        let manifest = fs::read_to_string(root.join(package).join("Cargo.toml"))?;
        for line in manifest.lines() {
            section = if line.starts_with('[') { line } else { section };
            let name = line.split(['.', ' ', '=']).next().unwrap_or_default();
            next.extend(directory_of(name).filter(|_| section == "[dependencies]"));
        }
    }
    Ok(packages)
}

fn add(root: &Path, path: &Path, hasher: &mut DefaultHasher) -> io::Result<()> {
    let mut names: Vec<PathBuf> = fs::read_dir(root.join(path))?
        .map(|entry| Ok(path.join(entry?.file_name())))
        .collect::<io::Result<_>>()?;
    names.sort();
    for name in names {
        let file = name.file_name().unwrap_or_default().to_string_lossy();
        if file.starts_with('.') || SKIPPED_DIRECTORIES.contains(&&*file) {
            continue;
        }
        if root.join(&name).is_dir() {
            add(root, &name, hasher)?;
        } else if name.extension().is_some_and(|it| EXTENSIONS.iter().any(|extension| it == *extension)) {
            (&name, fs::read(root.join(&name))?).hash(hasher);
        }
    }
    Ok(())
}
