//! The table of topics in the Python package is that of Rust. Those of other readers are generated.

use std::fs;

use scanhub_schema::Topic;

/// Text of a file, by its path from the top of the repository.
fn text(path: &str) -> String {
    let path = format!("{}/../{path}", env!("CARGO_MANIFEST_DIR"));
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// By their numbers, from 1.
fn names() -> impl Iterator<Item = String> {
    Topic::ALL.into_iter().map(|topic| topic.name().to_owned())
}

/// The words in quotes of the first line of `path` that begins with `start`.
fn quoted(path: &str, start: &str) -> Vec<String> {
    let text = text(path);
    let line = text.lines().find(|line| line.starts_with(start)).unwrap_or_else(|| panic!("no {start}"));
    line.split('"').skip(1).step_by(2).map(str::to_owned).collect()
}

#[test]
fn of_python() {
    let names: Vec<_> = names().collect();
    assert_eq!(quoted("clients/python/scanhub/names.py", "TOPICS = "), names);
}
