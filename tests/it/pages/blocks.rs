//! Blocks of code in README.md, in `docs/` and in the pages of the Python and C libraries, each with its location and
//! its language.
#![allow(dead_code)] // Each test uses only some items of this module.

use std::fs;
use std::path::{Path, PathBuf};

/// A block of code on a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Block {
    /// Page and line of the opening fence as `PAGE:LINE`, the form in which compilers print locations.
    pub(crate) location: String,
    /// Language after the opening fence, such as `sh`, `rust` or `python`. Empty if the fence names none.
    pub(crate) language: String,
    /// Lines between the fences, each with a line feed.
    pub(crate) text: String,
}

/// Returns all blocks of all pages.
pub(crate) fn blocks() -> Vec<Block> {
    let top = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut pages = vec![top.join("README.md")];
    for directory in ["docs", "clients/python", "clients/c"] {
        pages.extend(fs::read_dir(top.join(directory)).expect(directory).map(|entry| entry.unwrap().path()));
    }
    pages.retain(|page| page.extension().is_some_and(|it| it == "md"));
    pages.sort();
    let read = |page: &PathBuf| {
        let name = page.strip_prefix(top).expect("a path below the top").display().to_string();
        blocks_of_page(&name, &fs::read_to_string(page).expect("a page"))
    };
    pages.iter().flat_map(read).collect()
}

/// Returns the blocks of the page `name` with the text `text`.
pub(crate) fn blocks_of_page(name: &str, text: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    for (number, line) in text.lines().enumerate() {
        match (&mut open, line.trim_start().strip_prefix("```")) {
            (None, Some(language)) => {
                let location = format!("{name}:{}", number + 1);
                open = Some(Block { location, language: language.trim().to_owned(), text: String::new() });
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(block), None) => block.text.extend([line, "\n"]),
            (None, None) => {}
        }
    }
    assert_eq!(open, None, "a block without an end");
    blocks
}

#[test]
fn page_blocks_have_a_location_and_a_language() {
    let page = "words\n```sh\none\n\ntwo\n```\n- item\n  ```\n  three\n  ```\n";
    let block = |place: &str, language: &str, text: &str| Block {
        location: place.into(),
        language: language.into(),
        text: text.into(),
    };
    let expected = [block("p.md:2", "sh", "one\n\ntwo\n"), block("p.md:8", "", "  three\n")];
    assert_eq!(blocks_of_page("p.md", page), expected);
}
