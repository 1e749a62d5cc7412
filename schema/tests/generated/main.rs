//! Generator of the layouts of all payloads for other languages, from the Rust structs. The tests check that the
//! committed files are up to date. After a change of a struct, `SCANHUB_WRITE=1 cargo test -p scanhub-schema --test
//! generated` writes these files.
//!
//! The generator reads names, types and comments of the fields. These conventions define the rest:
//!
//! - `X_text` is UTF-8, padded with 0. `reserved` is 0, and readers do not show it.
//! - The used elements of `X_array` are counted by the field `Xs` if it exists, and otherwise by `count`.
//! - A comment that links to an enum, or to a type that only has constants, lists their values. A link to constants
//!   whose comments start with "Flag" lists the flags; the field is called `flags`.
//! - A link to another constant is replaced by the constant's value. A sentence with a link to a function is left out.
//!
//! `rules` and `readers` have the information that the structs do not express: arrays whose length depends on counts,
//! names that differ between languages, and conditions of a valid payload.

mod c;
mod datagram_c;
mod description;
mod docs;
mod lua;
mod python;
mod readers;
mod recording;
mod rules;
mod wire;

use std::path::Path;
use std::{env, fs};

use description::Description;
use scanhub_schema::Topic;
use scanhub_schema::limits::TopicLimits;

const WRITE_COMMAND: &str = "SCANHUB_WRITE=1 cargo test -p scanhub-schema --test generated";

/// Returns all topics in the order of their numbers, which start at 1 and have no gaps.
fn topics_by_number() -> [Topic; Topic::ALL.len()] {
    let mut topics = Topic::ALL;
    topics.sort_by_key(|topic| topic.number());
    topics
}

/// Checks that the file at `path` contains `text`. With `SCANHUB_WRITE`, writes the file.
fn check(path: &str, text: &str) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path);
    if fs::read_to_string(&file).expect("a committed file") == text {
        return;
    }
    assert!(env::var_os("SCANHUB_WRITE").is_some(), "{path} is not up to date: {WRITE_COMMAND}");
    fs::write(file, text).expect("a writable file");
}

/// Does the same as [`check`] for the blocks of a file. A block is between a line with `COMMAND: NAME` and the next
/// line with `End of NAME`.
fn check_blocks(path: &str, blocks: &[(&str, String)]) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path);
    let mut text = fs::read_to_string(file).expect("a committed file");
    for (name, block) in blocks {
        let begin = format!("generated: {name}");
        let line = |of: &str, from: usize| {
            let at = from + text[from..].find(of).unwrap_or_else(|| panic!("{path} has no line with {of:?}"));
            (text[..at].rfind('\n').map_or(0, |at| at + 1), at + text[at..].find('\n').expect("an end") + 1)
        };
        let (_, from) = line(&begin, 0);
        let (to, _) = line(&format!("End of {name}"), from);
        text.replace_range(from..to, block);
    }
    check(path, &text);
}

/// Returns `text` in lines of at most `width` columns. The first line starts with `first`, and the other lines start
/// with `next`.
fn wrap(first: &str, next: &str, text: &str, width: usize) -> String {
    let mut lines = Vec::new();
    let mut line = first.to_owned();
    let mut is_empty = true;
    for word in text.split(' ') {
        if !is_empty && line.len() + word.len() >= width {
            lines.push(line.trim_end().to_owned());
            line = next.to_owned();
            is_empty = true;
        }
        line += if is_empty { "" } else { " " };
        line += word;
        is_empty = false;
    }
    lines.push(line);
    lines.join("\n") + "\n"
}

/// Offsets are sums of sizes, so a wrong offset would also lead to a wrong size.
#[test]
fn sizes_match_the_structs() {
    let description = Description::read();
    assert_eq!(description.layout("Header").size, size_of::<scanhub_schema::Header>());
    let limits = TopicLimits { beams: 0, contents: 0, ..TopicLimits::default() };
    for topic in Topic::ALL {
        let Some(layout) = description.payload(topic) else { continue };
        let fixed = |tail: &rules::ArrayRule| {
            Some(tail.count.parse::<usize>().ok()? * description.layout(tail.kind).size)
        };
        let arrays: usize = rules::arrays_of(&layout.name).iter().filter_map(fixed).sum();
        assert_eq!(layout.size + arrays, topic.max_payload_len(&limits), "{}", topic.name());
    }
}

#[test]
fn layouts_are_up_to_date() {
    check("tests/vectors/v2/layouts.txt", &Description::read().text());
}

#[test]
fn recording_layout_is_up_to_date() {
    check("schema/src/file/layout.txt", &recording::layout(&Description::read()));
}

#[test]
fn c_headers_are_up_to_date() {
    let description = Description::read();
    let blocks = [
        ("structs", c::structs(&description)),
        ("arrays", c::arrays(&description)),
        ("checks", c::checks(&description)),
    ];
    check_blocks("clients/c/include/scanhub/attach.h", &blocks);
    let payloads = [
        ("values", datagram_c::values(&description)),
        ("wire", wire::c(&description)),
        ("payloads", datagram_c::payloads(&description)),
    ];
    check_blocks("clients/c/scanhub.h", &payloads);
    check_blocks("clients/c/include/scanhub/attach.hpp", &[("topics", c::topics(&description))]);
}

#[test]
fn pages_are_up_to_date() {
    let description = Description::read();
    let layouts = ["Header"].into_iter().map(|rust| description.layout(rust));
    let layouts = layouts.chain(Topic::ALL.into_iter().filter_map(|topic| description.payload(topic)));
    let lists: Vec<_> =
        layouts.map(|layout| (layout.name.as_str(), docs::lists(&description, layout))).collect();
    check_blocks("docs/topics.md", &lists);
    check_blocks("docs/topics.md", &[("services", docs::services())]);
    let blocks = [
        ("header", wire::header(&description)),
        ("payloads", docs::payloads(&description)),
        ("groups", docs::groups()),
    ];
    check_blocks("docs/datagram.md", &blocks);
}

#[test]
fn python_is_up_to_date() {
    let description = Description::read();
    let blocks = [
        ("constants", python::constants(&description)),
        ("wire", wire::python(&description)),
        ("classes", python::classes(&description)),
        ("union", python::union(&description)),
        ("readers", python::functions(&description)),
    ];
    check_blocks("clients/python/scanhub_lan.py", &blocks);
}

#[test]
fn lua_is_up_to_date() {
    let description = Description::read();
    let blocks = [
        ("values", lua::values(&description)),
        ("wire", wire::lua(&description)),
        ("fields", lua::fields(&description)),
        ("payloads", lua::functions(&description)),
    ];
    check_blocks("clients/wireshark/scanhub.lua", &blocks);
}
