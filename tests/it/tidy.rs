//! The walls of the house, each one an assertion that was seen to fail: every test first finds the project in order,
//! then plants a breach and must find that.

mod between;
mod crates;
mod eeprom;
mod families;
mod keys;
mod sources;
mod topics;
mod tree;
mod verbs;
mod within;
mod written;

use tree::{Tree, Wall};

/// The wall stands in `tree` and would be missed in each of `broken`.
fn holds(wall: Wall, broken: impl Fn(&Tree) -> Vec<Tree>) {
    let tree = Tree::load();
    let breaches = wall(&tree);
    assert!(breaches.is_empty(), "{}", breaches.join("\n"));
    for (number, broken) in broken(&tree).iter().enumerate() {
        assert_ne!(wall(broken), Vec::<String>::new(), "breach {number} was not found");
    }
}
