//! How many files name a key of the configuration: one with its field, and those that use it.

use super::holds;
use super::tree::{Tree, code};

/// Keys of sections and of scanners, as the beginning of a name that nothing else has.
const KEYS: [&str; 7] = [
    "max_turn",
    "min_overlap",
    "max_invalid",
    "max_range_step",
    "candidate_mm",
    "threshold_mm",
    "stop_when_idle",
];

/// Maximum number of product files that name a key.
const MOST: usize = 3;

/// Keys that too many files name.
fn few_files_name_a_key(tree: &Tree) -> Vec<String> {
    let is_product = |path: &str| {
        ["hub/", "clients/", "schema/"].iter().any(|top| path.starts_with(top)) && !path.contains("tests")
    };
    let naming = |key: &str| -> Vec<&str> {
        let named = tree
            .files(".rs")
            .filter(|(path, text)| is_product(path) && code(text).any(|(_, line)| line.contains(key)));
        named.map(|(path, _)| path).collect()
    };
    let keys = KEYS.into_iter().map(|key| (key, naming(key)));
    let many = keys.filter(|(_, paths)| paths.len() > MOST || paths.is_empty());
    many.map(|(key, paths)| format!("{} files name the key {key}: {}", paths.len(), paths.join(", ")))
        .collect()
}

#[test]
fn a_key_is_in_few_files() {
    holds(few_files_name_a_key, |tree| {
        let use_it =
            |number: usize| (format!("hub/daemon/src/planted{number}.rs"), "settings.stop_when_idle;\n");
        let planted = (0..MOST).fold(tree.clone(), |tree, number| {
            let (path, text) = use_it(number);
            tree.with(&path, text)
        });
        vec![planted]
    });
}
