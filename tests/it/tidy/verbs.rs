//! Rule for the number of files that name a verb. It checks only verb `hz`, as an example.

use super::assert_rule;
use super::tree::{SourceTree, code};

/// Files that have to be changed for a new verb, each with the reason. `docs/design.md` has the same list.
const VERB_FILES: [&str; 3] = [
    // The verb itself: its arguments with help and examples, its `run`, and its text and JSON.
    "clients/verbs/src/hz.rs",
    // Declares the module of the verb.
    "clients/verbs/src/lib.rs",
    // The row of the verb in the table of verbs.
    "hub/cli.rs",
];

/// Returns the product files that name the verb.
fn files_with_verb(tree: &SourceTree) -> Vec<&str> {
    let is_product = |path: &str| {
        ["hub/", "clients/", "schema/"].iter().any(|top| path.starts_with(top)) && !path.contains("tests")
    };
    let names_it = |line: &str| {
        let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
        words.any(|word| word == "HzArgs")
            || ["mod hz", "Verb::Hz", "(\"hz\""].iter().any(|it| line.contains(it))
    };
    let sources = tree.files(".rs").filter(|(path, _)| is_product(path));
    sources.filter(|(_, text)| code(text).any(|(_, line)| names_it(line))).map(|(path, _)| path).collect()
}

/// Returns an error for each file that names the verb but may not.
fn few_files_name_a_verb(tree: &SourceTree) -> Vec<String> {
    let others = files_with_verb(tree).into_iter().filter(|path| !VERB_FILES.contains(path));
    let ask = "a verb changes no other file: its `run` takes the whole `Context`";
    others.map(|path| format!("{path} names verb hz, but {ask}")).collect()
}

/// Returns an error for each file in the list of this rule that `docs/design.md` does not mention under "A verb".
fn the_page_lists_the_files_of_a_verb(tree: &SourceTree) -> Vec<String> {
    let page = tree.text("docs/design.md");
    let entry = page.split("- **A verb**").nth(1).unwrap_or_default();
    let entry = entry.split("\n- ").next().unwrap_or_default().split("\n## ").next().unwrap_or_default();
    let missing = VERB_FILES.iter().filter(|path| !entry.contains(&format!("`{path}`")));
    missing.map(|path| format!("docs/design.md does not say that a verb touches {path}")).collect()
}

#[test]
fn verb_is_named_in_few_files() {
    assert_rule(few_files_name_a_verb, |tree| {
        vec![
            tree.with("hub/main.rs", "//! The program.\nVerb::Hz(hz) => hz.run(json, &places),\n"),
            tree.with("hub/cli/examples.rs", "//! Examples.\n(\"hz\", &[\"scanhub hz front/scan\"]),\n"),
            tree.with("clients/verbs/src/follow.rs", "//! Follows topics.\npub use crate::hz::HzArgs;\n"),
        ]
    });
    let tree = SourceTree::load();
    let naming = files_with_verb(&tree);
    for path in VERB_FILES {
        assert!(naming.contains(&path), "{path} does not name verb hz: remove it from the list");
    }
}

#[test]
fn design_page_lists_the_files_of_a_verb() {
    assert_rule(the_page_lists_the_files_of_a_verb, |tree| {
        let page = tree.text("docs/design.md").replace("`hub/cli.rs`", "the table");
        vec![tree.with("docs/design.md", &page)]
    });
}
