//! What is said twice is the same: the tables of benches/README.md are made of the last runs' lines, and the program that
//! docs/first-consumer.md shows is the example that is compiled.

use super::tree::Tree;
use crate::report::tables;

const PAGE: &str = "benches/README.md";
const LAST: &str = "benches/last/";
const FIRST: (&str, &str) = ("docs/first-consumer.md", "clients/examples/first.rs");

pub(crate) fn tables_are_of_the_last_runs(tree: &Tree) -> Vec<String> {
    let files: Vec<(&str, &str)> = tree
        .files(".jsonl")
        .filter_map(|(path, lines)| Some((path.strip_prefix(LAST)?.strip_suffix(".jsonl")?, lines)))
        .collect();
    let page = tree.text(PAGE);
    match tables::page(page, &files) {
        Ok(written) if written == page => Vec::new(),
        Ok(_) => vec![format!("{PAGE} is not what was measured; run `cargo bench --bench report`")],
        Err(error) => vec![format!("{PAGE}: {error}")],
    }
}

pub(crate) fn the_first_consumer_is_compiled(tree: &Tree) -> Vec<String> {
    let (page, example) = FIRST;
    let shown: Vec<&str> =
        tree.text(page).split("```rust\n").skip(1).filter_map(|rest| rest.split("```").next()).collect();
    let compiled = tree.text(example).lines().filter(|line| !line.starts_with("//!"));
    let compiled: String =
        compiled.skip_while(|line| line.is_empty()).map(|line| format!("{line}\n")).collect();
    if shown == [compiled] { Vec::new() } else { vec![format!("{page} shows something else than {example}")] }
}
