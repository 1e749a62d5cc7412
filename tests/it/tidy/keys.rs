//! Rule for the number of files that name a key of the configuration. These are the file with the key's field, and the
//! files that use it. Only the pipeline and the files of `hub/preprocess` may name a processor.

use super::assert_rule;
use super::tree::{SourceTree, code};

/// Keys that are checked, for all keys of sections and of scanners. Each entry is the beginning of the key's name,
/// which no other name contains.
const CHECKED_KEYS: [&str; 7] = [
    "max_turn",
    "min_overlap",
    "max_invalid",
    "max_range_step",
    "candidate_mm",
    "threshold_mm",
    "stop_when_idle",
];

/// Maximum number of product files that name a key.
const MAX_FILES: usize = 3;

/// Returns an error for each key that more than [`MAX_FILES`] files name, and for each key that no file names.
fn few_files_name_a_key(tree: &SourceTree) -> Vec<String> {
    let is_product = |path: &str| {
        ["hub/", "clients/", "schema/"].iter().any(|top| path.starts_with(top)) && !path.contains("tests")
    };
    let naming = |key: &str| -> Vec<&str> {
        let named = tree
            .files(".rs")
            .filter(|(path, text)| is_product(path) && code(text).any(|(_, line)| line.contains(key)));
        named.map(|(path, _)| path).collect()
    };
    let keys = CHECKED_KEYS.into_iter().map(|key| (key, naming(key)));
    let many = keys.filter(|(_, paths)| paths.len() > MAX_FILES || paths.is_empty());
    many.map(|(key, paths)| format!("{} files name the key {key}: {}", paths.len(), paths.join(", ")))
        .collect()
}

#[test]
fn key_is_named_in_few_files() {
    assert_rule(few_files_name_a_key, |tree| {
        let use_it =
            |number: usize| (format!("hub/daemon/src/planted{number}.rs"), "settings.stop_when_idle;\n");
        let planted = (0..MAX_FILES).fold(tree.clone(), |tree, number| {
            let (path, text) = use_it(number);
            tree.with(&path, text)
        });
        vec![planted]
    });
}

/// Types of processors. `hub/preprocess` has a file for each of them, and other rules apply there.
const PROCESSORS: [&str; 4] = ["MarkDetector", "LineFinder", "MotionEstimator", "Segmenter"];

/// The file that calls all processors.
const PIPELINE_FILE: &str = "hub/daemon/src/pipeline.rs";

/// Returns an error for each product file outside of `hub/preprocess` that names a processor, except the pipeline.
fn only_the_pipeline_names_a_processor(tree: &SourceTree) -> Vec<String> {
    let is_outside = |path: &str| {
        path.starts_with("hub/")
            && !path.starts_with("hub/preprocess/")
            && !path.contains("tests")
            && path != PIPELINE_FILE
    };
    let named = |processor: &'static str| {
        let others = tree.files(".rs").filter(move |(path, text)| {
            is_outside(path) && code(text).any(|(_, line)| line.contains(processor))
        });
        others.map(move |(path, _)| format!("{path} names {processor}: call it in {PIPELINE_FILE}"))
    };
    PROCESSORS.into_iter().flat_map(named).collect()
}

#[test]
fn only_the_pipeline_calls_processors() {
    assert_rule(only_the_pipeline_names_a_processor, |tree| {
        vec![tree.with("hub/daemon/src/link.rs", "//! A link.\nlet marks = MarkDetector::new(settings);\n")]
    });
}
