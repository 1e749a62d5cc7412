//! Rule for text that exists twice: the program on the first page for clients must equal the example that Cargo
//! compiles.

use std::path::Path;

use super::assert_rule;
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

/// Returns an error for each link of a page to a file that does not exist, or to a heading that the page does not have.
fn links_have_targets(tree: &SourceTree) -> Vec<String> {
    let mut wrong = Vec::new();
    for (path, text) in tree.files(".md") {
        let rests = prose_lines(text).flat_map(|line| line.split("](").skip(1));
        let links = rests.filter_map(|rest| rest.split_once(')')).map(|(link, _)| link);
        let lost = links.filter(|link| !link.contains("://") && !has_target(tree, path, link));
        wrong.extend(lost.map(|link| format!("{path}: the link {link} has no target")));
    }
    wrong
}

/// Returns whether the file and the heading of `link`, which is on the page at `path`, exist.
fn has_target(tree: &SourceTree, path: &str, link: &str) -> bool {
    let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
    let target = if file.is_empty() { Some(path.to_owned()) } else { joined(path, file) };
    let Some(target) = target else { return false };
    let page = tree.files(&target).find(|(found, _)| *found == target);
    match page {
        _ if anchor.is_empty() => {
            page.is_some() || Path::new(env!("CARGO_MANIFEST_DIR")).join(&target).exists()
        }
        Some((_, text)) => prose_lines(text).filter_map(heading).any(|heading| anchor_of(heading) == anchor),
        None => false,
    }
}

/// Returns the lines of a page that are outside its code blocks.
fn prose_lines(text: &str) -> impl Iterator<Item = &str> {
    text.split("```").step_by(2).flat_map(str::lines)
}

/// Returns the text of the heading in `line`, if it is one.
fn heading(line: &str) -> Option<&str> {
    line.starts_with('#').then(|| line.trim_start_matches('#').trim())
}

/// Returns the anchor of a heading as the hosts of pages form it.
fn anchor_of(heading: &str) -> String {
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    kept.map(|c| if c == ' ' { '-' } else { c.to_ascii_lowercase() }).collect()
}

/// Returns the path of `file`, which is relative to the directory of the page at `path`. `None` if it is outside the
/// project.
fn joined(path: &str, file: &str) -> Option<String> {
    let mut parts: Vec<&str> = path.split('/').collect();
    parts.pop();
    for part in file.split('/') {
        match part {
            "." => {}
            ".." => drop(parts.pop()?),
            part => parts.push(part),
        }
    }
    Some(parts.join("/"))
}

#[test]
fn links_between_pages_have_targets() {
    assert_rule(links_have_targets, |tree| {
        let page = |link: &str| tree.with("docs/new.md", &format!("# New\n\nSee [this]({link}).\n"));
        ["missing.md", "design.md#no-such-heading", "#missing", "../hub/missing.rs", "../../README.md"]
            .map(page)
            .into()
    });
}
