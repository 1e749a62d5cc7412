//! Checks of the project's sources. Each test first finds the project in order, then builds in violations and must find
//! each of them.

mod between;
mod crates;
mod eeprom;
mod families;
mod inside_files;
mod keys;
mod pages;
mod sources;
mod topics;
pub(crate) mod tree;
mod verbs;
mod words;

use tree::{Rule, SourceTree};

/// Asserts that the project's tree conforms to the rule `wall`, and that each tree of `broken` violates it.
fn assert_rule(wall: Rule, broken: impl Fn(&SourceTree) -> Vec<SourceTree>) {
    let tree = SourceTree::load();
    let breaches = wall(&tree);
    assert!(breaches.is_empty(), "{}", breaches.join("\n"));
    for (number, broken) in broken(&tree).iter().enumerate() {
        assert_ne!(wall(broken), Vec::<String>::new(), "breach {number} was not found");
    }
}
