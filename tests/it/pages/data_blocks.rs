//! Tests of the blocks that are not programs: configurations, worlds, sites and lines of JSON. A list names each block
//! of plain text and the test that checks it.

use std::fs;
use std::path::Path;

use serde_json::Value;

use super::blocks::{Block, blocks};
use super::is_program;
use super::output_page::{examples, rows};
use crate::testkit::{TERM, TestEnv, output};

/// Blocks of plain text. Each entry has the page, the beginning of the block, and the test that checks the block or the
/// reason why no test does.
const TEXT_BLOCKS: [(&str, &str, &str); 8] = [
    ("README.md", " LMS 291 ──RS-422", "a drawing"),
    ("docs/datagram.md", " 0  53485542", "schema/tests/datagram.rs compares it with the golden datagram"),
    ("docs/ros2.md", "cargo install", "clients/bridge/tests/ros2.rs runs the second line"),
    ("docs/ros2.md", "sudo apt-get install ros-", "ROS is not installed where tests run"),
    ("docs/ros2.md", "scanhub bridge --connect", "clients/bridge/tests/ros2.rs runs it"),
    ("docs/tracks.md", "1 appeared in hall", "tests/it/track_page.rs reads it"),
    ("docs/measured.md", "empty rooms: ", "figures, which the example `proof` prints"),
    ("docs/worlds.md", "w.toml:2:1: unknown key", "invalid_world_has_the_error_on_the_page"),
];

/// The CMake project of the examples in C and C++.
const EXAMPLES: &str = include_str!("../../../clients/c/examples/CMakeLists.txt");

/// Returns what is wrong with a block that is not a program, or `None` if nothing is wrong.
fn error_in_block(block: &Block) -> Option<String> {
    match block.language.as_str() {
        "toml" => error_in_toml(block),
        "json" => block.text.lines().find_map(error_in_json),
        "text" => {
            let is_named = |(page, begin, _): &(&str, &str, &str)| {
                block.location.starts_with(page) && block.text.starts_with(begin)
            };
            (!TEXT_BLOCKS.iter().any(is_named)).then(|| "no test checks this text".to_owned())
        }
        "sh" => None,
        // Lines of the CMake project of the examples, which `client_c.rs` builds.
        "cmake"
            if block.text.lines().all(|line| EXAMPLES.contains(line.split("  ").next().unwrap_or(line))) =>
        {
            None
        }
        // A configuration of Zenoh, which the bridge's tests use.
        "json5" if block.location.starts_with("docs/bridge.md") => None,
        // A program that publishes angles, which `tilt.rs` runs.
        "rust,no_run" if block.location.starts_with("docs/tilt.md") => None,
        // A program that reads a recording, which `python/read.rs` runs.
        "python,no_run" if block.location.starts_with("docs/python.md") => None,
        // A program that uses a crate on which clients do not depend. The doc tests of that crate run the program.
        "rust,edition2024" if block.location.starts_with("docs/tilt.md") => None,
        _ if is_program(block) => None,
        other => Some(format!("unknown kind of block: {other:?}")),
    }
}

/// Returns what is wrong with a TOML block, or `None` if the block is a configuration, a site or a world.
fn error_in_toml(block: &Block) -> Option<String> {
    let env = TestEnv::new();
    let file = env.file("page.toml", &block.text);
    let checked = env.run(&["config", "check", &file]);
    if checked.exit_code == Some(0) {
        return None;
    }
    // A section of a configuration may lack a link. With a link added, the section must be a complete configuration.
    let with_link = format!("{}\n[[link]]\nname = \"front\"\nport = \"/dev/ttyUSB0\"\n", block.text);
    let completed = env.run(&["config", "check", &env.file("completed.toml", with_link)]);
    if checked.stderr.contains("no link is configured") && completed.exit_code == Some(0) {
        return None;
    }
    if env.run(&["site", "check", &file]).exit_code == Some(0) {
        return None;
    }
    let port = format!("--port={}", env.path_argument("front"));
    let mut world = env.start(&["simulate", "--json", "--world", &file, &port]);
    if !world.ends_without_output() {
        let outcome = world.end(TERM);
        return (outcome.exit_code != Some(0)).then(|| outcome.to_string());
    }
    Some(format!("neither a configuration, a site nor a world: {checked}{}", world.wait()))
}

/// Returns what is wrong with a line of JSON output, unless docs/output.md lists its class, and has each of its keys in
/// a row or an example of the class. `reference.rs` checks that the program prints the keys of the examples.
fn error_in_json(line: &str) -> Option<String> {
    let Ok(Value::Object(keys)) = serde_json::from_str(line) else {
        return Some(format!("no object: {line}"));
    };
    let page =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/output.md")).expect("the page");
    let class = keys.get("class").and_then(Value::as_str).unwrap_or_default();
    let rows = rows(&page);
    let rows: Vec<_> = rows.iter().filter(|row| row.classes.contains(&class)).collect();
    let examples = examples(&page);
    let shown: Vec<_> = examples.iter().filter(|example| example.class == class).collect();
    let is_known = |key: &str| {
        rows.iter().any(|row| row.keys.contains(&key))
            || shown.iter().any(|example| example.keys.iter().any(|known| known == key))
    };
    let unknown = keys.keys().find(|key| *key != "class" && !is_known(key));
    match (rows.is_empty(), unknown) {
        (true, _) => Some(format!("docs/output.md has no class {class:?}: {line}")),
        (_, Some(key)) => Some(format!("docs/output.md has no key {key} in class {class}: {line}")),
        (false, None) => None,
    }
}

#[test]
fn page_blocks_are_valid_configurations_or_output() {
    let all = blocks();
    let wrong: Vec<String> = all
        .iter()
        .filter_map(|block| Some(format!("{}: {}", block.location, error_in_block(block)?)))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    for (page, begin, _) in TEXT_BLOCKS {
        let is_it = |block: &Block| block.location.starts_with(page) && block.text.starts_with(begin);
        assert!(all.iter().any(is_it), "{page} has no {begin:?} any more");
    }
}

#[test]
fn detects_invalid_blocks() {
    for (language, text, what) in [
        ("toml", "[[link]]\nname = \"front\"\nprot = \"/dev/ttyUSB0\"\n", "did you mean"),
        ("toml", "[[person]]\npath = [[0, 0]]\nspeed_m_s = 1\n", "unknown key"),
        ("json", "{\"class\":\"zones\",\"sensor\":\"front\",\"verdikt\":\"clear\"}\n", "no key verdikt"),
        ("json", "{\"class\":\"zone\"}\n", "no class \"zone\""),
        ("json", "{\"class\":\"zones\"\n", "no object"),
        ("text", "8191 mm\n", "no test checks"),
        ("", "scanhub list\n", "unknown kind of block"),
    ] {
        let block =
            Block { location: "docs/planted.md:1".into(), language: language.into(), text: text.into() };
        assert!(error_in_block(&block).is_some_and(|wrong| wrong.contains(what)), "{block:#?}");
    }
    let line = "{\"class\":\"zones\",\"sensor\":\"robot\",\"verdict\":\"clear\",\"nearest_sensor\":null}";
    assert_eq!(error_in_json(line), None);
}

#[test]
fn invalid_world_has_the_error_on_the_page() {
    let is_it = |block: &Block| block.location.starts_with("docs/worlds.md") && block.language == "text";
    let block = blocks().into_iter().find(is_it).expect("a block of text");
    let env = TestEnv::new();
    env.file("w.toml", "[[thing]]\nradius_m = 0.04\n");
    let mut command = env.command(&["simulate", "--world=w.toml", "--port=front"]);
    let output = output(command.current_dir(env.path(""))).expect("the output of the program");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(78), "{errors}");
    for line in block.text.lines() {
        assert!(errors.contains(line.trim_end_matches(" ...")), "{line:?} is not in {errors}");
    }
}
