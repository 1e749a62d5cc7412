//! Checks of the project's sources. Each test asserts that the sources conform to a rule. It then changes copies of the
//! sources in memory so that they violate the rule, and asserts that the rule finds each violation.

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

/// Asserts that the project's tree conforms to the rule `wall`, and that each tree that `broken` returns violates the
/// rule.
fn assert_rule(wall: Rule, broken: impl Fn(&SourceTree) -> Vec<SourceTree>) {
    let tree = SourceTree::load();
    let breaches = wall(&tree);
    assert!(breaches.is_empty(), "{}", breaches.join("\n"));
    for (number, broken) in broken(&tree).iter().enumerate() {
        assert_ne!(wall(broken), Vec::<String>::new(), "breach {number} was not found");
    }
}
