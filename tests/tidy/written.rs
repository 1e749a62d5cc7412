//! What a program has written stands as it wrote it: the tables of benches/README.md are made of the last runs' lines.

#[path = "../../benches/report/tables.rs"]
mod tables;

use crate::tree::Tree;

const PAGE: &str = "benches/README.md";
const LAST: &str = "benches/last/";

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
