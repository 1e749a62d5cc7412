//! Rule for text that exists twice: the program on the first page for clients equals the example that is compiled.

use super::tree::SourceTree;

const FIRST_PAGE: (&str, &str) = ("docs/first-program.md", "clients/examples/first.rs");

pub(crate) fn first_program_page_matches_the_example(tree: &SourceTree) -> Vec<String> {
    let (page, example) = FIRST_PAGE;
    let shown: Vec<&str> =
        tree.text(page).split("```rust\n").skip(1).filter_map(|rest| rest.split("```").next()).collect();
    let compiled = tree.text(example).lines().filter(|line| !line.starts_with("//!"));
    let compiled: String =
        compiled.skip_while(|line| line.is_empty()).map(|line| format!("{line}\n")).collect();
    if shown == [compiled] { Vec::new() } else { vec![format!("{page} differs from {example}")] }
}
