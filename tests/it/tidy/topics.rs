//! Rule for the number of files that name a topic. It checks only topic `motion`, as an example of a topic that the hub
//! publishes for each link and that clients only print.

use super::assert_rule;
use super::tree::{SourceTree, code};

/// Files that have to be changed for a new topic, each with the reason. `docs/design.md` has the same list.
const TOPIC_FILES: [&str; 6] = [
    // The row of the topic in the table of topics.
    "schema/src/topic.rs",
    // The payload of the topic.
    "schema/src/motion.rs",
    // The module with the payload.
    "schema/src/lib.rs",
    // Fills and sends the samples of the topic.
    "hub/daemon/src/link_output.rs",
    // Print the lines of the topic, as JSON and as text.
    "clients/verbs/src/json/results.rs",
    "clients/verbs/src/text.rs",
];

/// Other files that name `motion`, for reasons that do not apply to every topic.
const OTHER_FILES: [&str; 3] = [
    // The processor that computes the samples of the topic. `keys.rs` checks which files name a processor.
    "hub/preprocess/",
    "hub/daemon/src/pipeline.rs",
    // A gateway sends this topic only on request.
    "clients/network/src/forward/selection.rs",
];

/// Returns the product files that name the topic, except pages, generated files and the Python package. The Python
/// package has its own code for each topic.
fn files_with_topic(tree: &SourceTree) -> Vec<&str> {
    const EXCLUDED_FILES: [&str; 3] =
        ["clients/python/", "schema/src/file/layout.txt", "hub/sim/src/rplidar.rs"];
    let is_product = |path: &str| {
        ["hub/", "clients/", "schema/"].iter().any(|top| path.starts_with(top))
            && !path.contains("tests")
            && !EXCLUDED_FILES.iter().any(|other| path.starts_with(other))
    };
    let is_word =
        |line: &str| line.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == "Motion");
    let names_it =
        |line: &str| is_word(line) || line.contains("publishers.motion") || line.contains("crate::motion::*");
    let sources = tree.files(".rs").filter(|(path, _)| is_product(path));
    sources.filter(|(_, text)| code(text).any(|(_, line)| names_it(line))).map(|(path, _)| path).collect()
}

/// Returns an error for each file that names the topic but may not.
fn few_files_name_a_topic(tree: &SourceTree) -> Vec<String> {
    let may =
        |path: &str| TOPIC_FILES.contains(&path) || OTHER_FILES.iter().any(|also| path.starts_with(also));
    let others = files_with_topic(tree).into_iter().filter(|path| !may(path));
    let ask = "a topic is to touch no further file: derive this from the table of topics (`for_each_topic!`)";
    others.map(|path| format!("{path} names topic motion, but {ask}")).collect()
}

/// Returns an error for each file in the list of this rule that `docs/design.md` does not mention under "A topic".
fn the_page_lists_the_files_of_a_topic(tree: &SourceTree) -> Vec<String> {
    let page = tree.text("docs/design.md");
    let entry = page.split("- **A topic**").nth(1).unwrap_or_default();
    let entry = entry.split("\n- ").next().unwrap_or_default().split("\n## ").next().unwrap_or_default();
    let missing = TOPIC_FILES.iter().filter(|path| !entry.contains(&format!("`{path}`")));
    missing.map(|path| format!("docs/design.md does not say that a topic touches {path}")).collect()
}

#[test]
fn topic_is_named_in_few_files() {
    assert_rule(few_files_name_a_topic, |tree| {
        vec![
            tree.with("hub/daemon/src/topics.rs", "//! Topics.\nif topic == Topic::Motion {\n"),
            tree.with("schema/src/payload.rs", "//! Payloads.\nimpl Packed for Motion {\n"),
            tree.with("clients/client/src/lib.rs", "//! Client.\npub use scanhub_schema::{Marks, Motion};\n"),
            tree.with("hub/daemon/src/link.rs", "//! A link.\ntopics.publishers.motion.prepare();\n"),
        ]
    });
    let tree = SourceTree::load();
    let naming = files_with_topic(&tree);
    for path in TOPIC_FILES {
        assert!(naming.contains(&path), "{path} does not name topic motion: remove it from the list");
    }
}

#[test]
fn design_page_lists_the_files_of_a_topic() {
    assert_rule(the_page_lists_the_files_of_a_topic, |tree| {
        vec![tree.with(
            "docs/design.md",
            &tree.text("docs/design.md").replace("`schema/src/topic.rs`", "the table"),
        )]
    });
}
