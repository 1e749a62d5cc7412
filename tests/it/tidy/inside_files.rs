//! Tests of the rules for the contents of sources and pages.

use super::{assert_rule, pages, sources};

#[test]
fn only_the_demonstration_of_the_program_reads_clocks() {
    assert_rule(sources::only_the_demonstration_of_the_program_reads_clocks, |tree| {
        vec![
            tree.with("hub/main.rs", "//! The program.\nlet now = std::time::Instant::now();\n"),
            tree.with("hub/cli/convert.rs", "//! Conversion.\nlet now = SystemTime::now();\n"),
        ]
    });
}

#[test]
fn tests_do_not_depend_on_time() {
    assert_rule(sources::tests_do_not_depend_on_time, |tree| {
        vec![
            tree.with("tests/it/planted.rs", "//! Sleeps.\nstd::thread::sleep(Duration::from_secs(1));\n"),
            tree.with("hub/drivers/tests/planted.rs", "//! Sleeps.\nsleep(Duration::from_secs(1));\n"),
            tree.with(
                "clients/network/tests/planted.rs",
                "//! Compares.\nassert!(begun.elapsed() < Duration::from_secs(1));\n",
            ),
        ]
    });
}

#[test]
fn unsafe_code_is_rare_and_explained() {
    assert_rule(sources::unsafe_code_is_rare_and_explained, |tree| {
        let listed = "hub/daemon/src/process.rs";
        let explained = "// SAFETY: so it is.\nunsafe { call() };\n";
        vec![
            tree.with(listed, "//! A handler.\nunsafe { call() };\n"),
            tree.with(listed, &format!("//! Many.\n{}", explained.repeat(11))),
            tree.with("hub/daemon/tests/planted.rs", &format!("//! A test.\n{explained}")),
            tree.with("hub/daemon/tests/counting/mod.rs", "//! An allocator.\nunsafe { call() };\n"),
            tree.with("hub/daemon/src/link.rs", &format!("//! A link.\n{explained}")),
            tree.with("hub/daemon/src/link.rs", "//! A link.\n#![allow(unsafe_code)]\n"),
        ]
    });
}

#[test]
fn tests_start_children_in_one_file() {
    assert_rule(sources::tests_start_children_in_one_file, |tree| {
        let plant = |path: &str, call: &str| {
            tree.with(path, &format!("//! A test.\nlet begun = Command::new(\"true\"){call};\n"))
        };
        vec![
            plant("tests/it/planted.rs", ".spawn()"),
            plant("tests/testkit/planted.rs", ".output()"),
            plant("clients/bridge/tests/planted.rs", ".status()"),
        ]
    });
}

#[test]
fn shared_memory_is_built_in_one_crate() {
    assert_rule(sources::shared_memory_is_built_in_one_crate, |tree| {
        vec![
            tree.with("clients/verbs/src/planted.rs", "//! A client.\nuse iceoryx2::prelude::*;\n"),
            tree.with("schema/src/scan.rs", "//! A scan.\nuse iceoryx2::node::NodeBuilder;\n"),
        ]
    });
}

#[test]
fn ranges_are_created_in_one_file() {
    assert_rule(sources::ranges_are_created_in_one_file, |tree| {
        vec![
            tree.with("hub/daemon/src/link.rs", "//! A link.\nfor word in measured.words() {}\n"),
            tree.with("hub/tools/src/probe.rs", "//! Probes.\nfor word in measured.words() {}\n"),
        ]
    });
}

#[test]
fn files_begin_with_a_description() {
    assert_rule(sources::files_begin_with_a_description, |tree| {
        vec![tree.with("clients/verbs/src/planted.rs", "use std::fmt;\n")]
    });
}

#[test]
fn names_have_no_vague_words() {
    assert_rule(sources::names_have_no_vague_words, |tree| {
        vec![
            tree.with("clients/verbs/src/utils.rs", "//! Things.\n"),
            tree.with("clients/verbs/src/planted.rs", "//! Things.\nstruct LinkManager;\n"),
            tree.with("clients/verbs/src/planted.rs", "//! Things.\nmod common;\n"),
            tree.with("clients/verbs/src/planted.rs", "//! Things.\nfn get_range() {}\n"),
        ]
    });
}

#[test]
fn no_text_promises_safety() {
    assert_rule(sources::no_text_promises_safety, |tree| {
        vec![
            tree.with("clients/verbs/src/planted.rs", "//! A protective field.\n"),
            tree.with("CHANGELOG.md", "- A safety function for robots.\n"),
        ]
    });
}

#[test]
fn first_program_page_matches_the_example() {
    assert_rule(pages::first_program_page_matches_the_example, |tree| {
        let (page, example) = ("docs/first-program.md", "clients/examples/first.rs");
        let (shown, compiled) = (tree.text(page), tree.text(example));
        vec![
            tree.with(page, &shown.replace("from_millis(500)", "from_secs(5)")),
            tree.with(page, &shown.replace("```rust", "```")),
            tree.with(page, &format!("{shown}\n```rust\nlet more = 1;\n```\n")),
            tree.with(example, &compiled.replace("continue;", "break;")),
        ]
    });
}
