//! The walls of the house, each one an assertion that was seen to fail: every test first finds the project in order,
//! then plants a breach and must find that.

mod between;
mod crates;
mod eeprom;
mod families;
mod inside_files;
mod keys;
mod pages;
mod sources;
mod topics;
mod tree;
mod verbs;

use tree::{Rule, SourceTree};

/// The wall stands in `tree` and would be missed in each of `broken`.
fn assert_rule(wall: Rule, broken: impl Fn(&SourceTree) -> Vec<SourceTree>) {
    let tree = SourceTree::load();
    let breaches = wall(&tree);
    assert!(breaches.is_empty(), "{}", breaches.join("\n"));
    for (number, broken) in broken(&tree).iter().enumerate() {
        assert_ne!(wall(broken), Vec::<String>::new(), "breach {number} was not found");
    }
}
