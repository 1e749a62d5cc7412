//! The tables of topics in C, Python and Lua say what the one in Rust says.

use std::fs;

use schema::Topic;

/// Text of a file, by its path from the top of the repository.
fn text(path: &str) -> String {
    let path = format!("{}/../{path}", env!("CARGO_MANIFEST_DIR"));
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// By their numbers, from 1.
fn names() -> impl Iterator<Item = String> {
    Topic::ALL.into_iter().map(|topic| topic.name().to_owned())
}

#[test]
fn of_c() {
    let text = text("clients/c/include/scanhub/attach.h");
    let found: Vec<_> = text
        .lines()
        .filter_map(|line| {
            let (name, rest) = line.strip_prefix("#define SCANHUB_TOPIC_")?.split_once(' ')?;
            let (number, payload) = rest.split_once("/*")?;
            let kind = match payload.trim().strip_prefix("struct ") {
                Some(kind) => {
                    kind.trim_end_matches(" */").replace("scanhub_", "scanhub.").replace("_v", ".v")
                }
                None => "u8[]".to_owned(),
            };
            Some((number.trim().parse().unwrap(), name.to_lowercase(), kind))
        })
        .collect();
    let expected: Vec<_> = Topic::ALL
        .map(|topic| (topic.number(), topic.name().to_owned(), topic.payload().to_lowercase()))
        .to_vec();
    assert_eq!(found, expected);
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
    assert_eq!(quoted("clients/python/scanhub_lan.py", "TOPICS = ")[1..], names);
}

#[test]
fn of_lua() {
    let names: Vec<_> = ["announce".to_owned()].into_iter().chain(names()).collect();
    assert_eq!(quoted("clients/wireshark/scanhub.lua", "    [0] = \"announce\""), names);
}
