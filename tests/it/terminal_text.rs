//! Tests of control characters in files, on a serial line and in names. No program writes them unescaped to stdout or
//! stderr. JSON lines have them as escapes.

use std::fs;

use crate::testkit::{Outcome, TERM, TestEnv};
use scanhub_drivers::lms::telegram::Writer;

/// Characters of C0, DEL and C1, which a terminal may interpret as commands.
const CONTROL_CHARACTERS: &str = "\u{1b}]0;x\u{7}\u{9b}31m\u{7f}\u{85}\u{9d}";

/// Asserts that the output has no control characters except line feeds.
fn assert_printable(outcome: &Outcome) {
    for text in [String::from_utf8_lossy(&outcome.stdout).into_owned(), outcome.stderr.clone()] {
        let control = text.chars().find(|&c| c.is_control() && c != '\n');
        assert_eq!(control, None, "{:?}", text);
    }
}

#[test]
fn configuration_text_has_no_control_characters() {
    let env = TestEnv::new();
    let quoted: String = CONTROL_CHARACTERS.chars().map(|c| format!("\\u{:04x}", c as u32)).collect();
    let port = format!("/dev/{quoted}");
    let sound = env.file(
        "sound.toml",
        format!("[[link]]\nname = \"a\"\nport = \"{port}\"\n[gateway]\ninterface = \"{quoted}\"\n"),
    );
    // The first file has a key with characters that TOML does not allow. The others have a value and a key with C1
    // characters, which TOML allows.
    let raw = env.file("raw.toml", "[[link]]\nname = \"a\"\npo\u{1b}[2Jrt = 1\n");
    let value = env.file("value.toml", "[[link]]\nname = \"\u{9b}31m\"\nport = \"x\"\n");
    let key = env.file("key.toml", "[[link]]\n\"\u{9b}31m\\u001b\" = 1\n");
    let name = env.path_argument(&format!("{CONTROL_CHARACTERS}.toml"));
    fs::write(&name, "nothing = 1\n").expect("a file with an unusual name");
    for json in [&[][..], &["--json"]] {
        let with = |words: &[&str]| env.run(&[words, json].concat());
        for (code, outcome) in [
            (0, with(&["config", "check", &sound])),
            (0, with(&["config", "show", "--config", &sound])),
            (78, with(&["config", "check", &raw])),
            (78, with(&["config", "check", &value])),
            (78, with(&["config", "check", &key])),
            (78, with(&["config", "check", &name])),
            (5, with(&["doctor", "--no-system-config", "--config", &sound])),
            (66, with(&["convert", &name, "x.mcap"])),
            (4, with(&["probe", &name])),
        ] {
            assert_eq!(outcome.exit_code, Some(code), "{outcome}");
            assert_printable(&outcome);
        }
    }
    // JSON output has the exact value, with escapes.
    let outcome = env.run(&["config", "check", &sound, "--json"]);
    assert_eq!(outcome.lines()[0]["links"][0]["port"], format!("/dev/{CONTROL_CHARACTERS}"), "{outcome}");
    // Check the log of a hub, and verbs that print the status of the hub.
    let hub = env.hub(&["--config", &sound]);
    for verb in
        [&["info", "a"][..], &["info", "a", "--json"], &["list"], &["echo", "a/status", "-n1", "--json"]]
    {
        let outcome = env.run(verb);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert_printable(&outcome);
    }
    let outcome = hub.end(TERM);
    assert!(outcome.stderr.contains("no such port"), "{outcome}");
    assert_printable(&outcome);
}

#[test]
fn scanner_text_has_no_control_characters() {
    let env = TestEnv::new();
    let bytes = Writer::new(0x80, 0xBA).slice(CONTROL_CHARACTERS.as_bytes()).byte(0x10).finish();
    let file = env.file("type.bin", bytes.bytes());
    for flags in [&[][..], &["--all"], &["--json"]] {
        let outcome = env.run(&[&["telegram", "decode", &file], flags].concat());
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert_printable(&outcome);
    }
}
