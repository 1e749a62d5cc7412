//! The files of the project as text, and functions that change copies of them in memory. With these copies, a test can
//! prove that a rule finds violations.

use std::collections::BTreeMap;
use std::path::Path;

/// Texts of files, by the path of the file relative to the project's root, with `/` as separator.
#[derive(Clone)]
pub(crate) struct SourceTree {
    files: BTreeMap<String, String>,
}

/// A rule. It returns one line for each violation.
pub(crate) type Rule = fn(&SourceTree) -> Vec<String>;

impl SourceTree {
    /// Loads all text files, except hidden and built ones: sources, manifests, pages, units and scripts.
    pub(crate) fn load() -> SourceTree {
        let mut tree = SourceTree { files: BTreeMap::new() };
        tree.add(Path::new(env!("CARGO_MANIFEST_DIR")), "");
        assert!(tree.files.len() > 30, "the project is not where it should be");
        tree
    }

    /// Returns a tree with only the file at `path`.
    pub(crate) fn of_file(path: &str, text: &str) -> SourceTree {
        SourceTree { files: BTreeMap::from([(path.to_owned(), text.to_owned())]) }
    }

    /// Returns a copy with the file at `path` added or replaced.
    pub(crate) fn with(&self, path: &str, text: &str) -> SourceTree {
        let mut tree = self.clone();
        tree.files.insert(path.to_owned(), text.to_owned());
        tree
    }

    /// Returns a copy with `line` as the first line of a section of a manifest.
    pub(crate) fn with_line(&self, path: &str, section: &str, line: &str) -> SourceTree {
        let text = self.text(path);
        let changed = if text.contains(section) {
            text.replacen(section, &format!("{section}\n{line}"), 1)
        } else {
            format!("{text}\n{section}\n{line}\n")
        };
        self.with(path, &changed)
    }

    /// Returns the text of a file. Panics if it is missing.
    pub(crate) fn text(&self, path: &str) -> &str {
        self.files.get(path).unwrap_or_else(|| panic!("{path} is missing"))
    }

    /// Returns all files whose path ends with `suffix`.
    pub(crate) fn files(&self, suffix: &str) -> impl Iterator<Item = (&str, &str)> {
        self.files
            .iter()
            .filter(move |(path, _)| path.ends_with(suffix))
            .map(|(path, text)| (path.as_str(), text.as_str()))
    }

    /// Returns all Rust files except those of the rules, which contain violations on purpose.
    pub(crate) fn sources(&self) -> impl Iterator<Item = (&str, &str)> {
        self.files(".rs").filter(|(path, _)| !path.starts_with("tests/it/tidy"))
    }

    /// Returns a parsed manifest.
    pub(crate) fn manifest(&self, path: &str) -> toml::Table {
        self.text(path).parse().unwrap_or_else(|error| panic!("{path}: {error}"))
    }

    /// Returns the manifests of the crates below the project's root, by the name of the crate.
    pub(crate) fn members(&self) -> BTreeMap<String, toml::Table> {
        self.files("/Cargo.toml")
            .filter_map(|(path, _)| {
                let manifest = self.manifest(path);
                let name = manifest.get("package")?.get("name")?.as_str()?.to_owned();
                Some((name, manifest))
            })
            .collect()
    }

    fn add(&mut self, directory: &Path, relative: &str) {
        for entry in std::fs::read_dir(directory).expect("a readable directory") {
            let entry = entry.expect("an entry");
            let name = entry.file_name().into_string().expect("a name in UTF-8");
            let path = format!("{relative}{name}");
            let hidden = name.starts_with('.') && name != ".ci";
            if entry.file_type().expect("a type").is_dir() {
                if !hidden && name != "target" {
                    self.add(&entry.path(), &format!("{path}/"));
                }
            } else if !hidden && let Ok(text) = std::fs::read_to_string(entry.path()) {
                self.files.insert(path, text);
            }
        }
    }
}

/// Returns the numbered lines of code in `text`, without comments and without the unit tests at its end.
pub(crate) fn code(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .enumerate()
        .take_while(|(_, line)| !line.starts_with("#[cfg(test)]"))
        .filter(|(_, line)| !line.trim_start().starts_with("//"))
        .map(|(number, line)| (number + 1, line))
}

/// Returns the lines of code with one of `needles` in the sources for which `select` returns true.
pub(crate) fn find(tree: &SourceTree, needles: &[&str], select: impl Fn(&str) -> bool) -> Vec<String> {
    let mut places = Vec::new();
    for (path, text) in tree.sources().filter(|(path, _)| select(path)) {
        for (number, line) in code(text) {
            if needles.iter().any(|needle| line.contains(needle)) {
                places.push(format!("{path}:{number}: {}", line.trim()));
            }
        }
    }
    places
}
