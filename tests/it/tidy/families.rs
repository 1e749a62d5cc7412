//! Rule for the number of files that name a family of scanners. A new family needs one module of the drivers, one
//! module of the simulator, and an entry in each file that this rule lists.

use super::assert_rule;
use super::tree::{SourceTree, code};

/// Files that may name a family, each with the reason. The driver and the simulator of the family, tests, benches and
/// pages may name it, too.
const ALLOWED_FILES: [&str; 9] = [
    // The list of the modules of the drivers.
    "hub/drivers/src/lib.rs",
    // The list of the families.
    "hub/drivers/src/families.rs",
    // The configuration that users start from, with a section for each family.
    "hub/config/src/default.toml",
    // Number and name of each family, in each language in which programs read scans, and the properties of the family's
    // packets.
    "schema/src/family.rs",
    "schema/src/file/layout.txt",
    "clients/c/include/scanhub/attach.h",
    "clients/c/scanhub.h",
    "clients/python/scanhub_lan.py",
    "clients/wireshark/scanhub.lua",
];

/// Names of makers and models, which also stand for a family.
const FAMILY_WORDS: [(&str, &[&str]); 2] = [
    ("ld", &["ldrobot", "ld06", "ld19", "stl19p", "stl27l", "ld14p"]),
    ("rplidar", &["slamtec", "a1m8", "a2m8", "a2m12"]),
];

/// Folders with sources of the hub, its configuration, its tools and the program. These files, and those directly in
/// `hub/`, may name no family, not even the LMS. Recordings and clients may name the LMS, because its telegrams are a
/// format of files and topics.
const HUB_FOLDERS: [&str; 5] = ["hub/config/", "hub/daemon/", "hub/tools/", "hub/cli/", "hub/demo/"];

/// Sources of the hub that may name the LMS, each with the reason.
const MAY_NAME_LMS: [&str; 4] = [
    // Changes settings in the EEPROM. Only an LMS has such settings.
    "hub/tools/src/configure",
    // Explains telegrams byte by byte. Only an LMS sends telegrams.
    "hub/tools/src/telegram",
    // Describes and checks the settings that only an LMS reports on request.
    "hub/tools/src/probe/description.rs",
    "hub/tools/src/doctor/sensor.rs",
];

/// Returns an error for each source of the hub that names the LMS but may not.
fn hub_names_no_lms(tree: &SourceTree) -> Vec<String> {
    let others =
        hub_sources_with_lms(tree).filter(|path| !MAY_NAME_LMS.iter().any(|may| path.starts_with(may)));
    others.map(|path| format!("{path} names the LMS: call a function for all families")).collect()
}

/// Returns the sources of the hub that name the LMS.
fn hub_sources_with_lms(tree: &SourceTree) -> impl Iterator<Item = &str> {
    let is_program = |path: &str| path.strip_prefix("hub/").is_some_and(|file| !file.contains('/'));
    let is_hub = move |path: &str| {
        !path.contains("tests") && (is_program(path) || HUB_FOLDERS.iter().any(|hub| path.starts_with(hub)))
    };
    let names_it = |line: &str| {
        let line = line.to_lowercase();
        line.split(|c: char| !c.is_alphanumeric()).any(|word| word.starts_with("lms"))
    };
    let sources = tree.files(".rs").filter(move |(path, _)| is_hub(path));
    sources.filter(move |(_, text)| code(text).any(|(_, line)| names_it(line))).map(|(path, _)| path)
}

/// Returns an error for each file that names a family but may not.
fn few_files_name_a_family(tree: &SourceTree) -> Vec<String> {
    let named = FAMILY_WORDS.iter().flat_map(|(name, words)| files_with_words(tree, name, words));
    let others = named.filter(|path| !ALLOWED_FILES.contains(path));
    others.map(|path| format!("{path} names a family: use a list of all families")).collect()
}

/// Returns the files that contain the name `name` of a family, or one of `words`.
fn files_with_words<'a>(tree: &'a SourceTree, name: &str, words: &[&str]) -> Vec<&'a str> {
    const OWN: [&str; 7] = [".ci/", "hub/sim/", "tests/", "benches/", "docs/", "README.md", "CHANGELOG.md"];
    let own = |path: &str| {
        OWN.iter().any(|own| path.starts_with(own))
            || path == format!("hub/drivers/src/{name}.rs")
            || path.starts_with(&format!("hub/drivers/src/{name}/"))
            || path.contains("tests")
            || path.ends_with(".lock")
    };
    let names_it = |line: &str| {
        // The examples in help texts may name any family.
        let is_example = line.trim_start().starts_with("scanhub ");
        let line = line.replace("ls -ld", "").to_lowercase();
        let mut named = line.split(|c: char| !c.is_alphanumeric());
        !is_example && named.any(|word| word == name || words.contains(&word))
    };
    let named =
        tree.files("").filter(|(path, _)| !own(path)).filter(|(path, text)| match path.ends_with(".rs") {
            true => code(text).any(|(_, line)| names_it(line)),
            false => text.lines().any(names_it),
        });
    named.map(|(path, _)| path).collect()
}

#[test]
fn hub_sources_do_not_name_the_lms() {
    assert_rule(hub_names_no_lms, |tree| {
        vec![
            tree.with(
                "hub/daemon/src/session_driver.rs",
                "//! Drives.\nif matches!(session, Session::Lms(_)) {\n",
            ),
            tree.with("hub/daemon/src/session_driver.rs", "//! Drives.\nif family == Family::Lms {\n"),
            tree.with("hub/tools/src/driver.rs", "//! Drives.\nuse scanhub_drivers::lms::variant::Baud;\n"),
            tree.with("hub/tools/src/probe.rs", "//! Probes.\nif kind == \"LMS291\" {\n"),
            tree.with("hub/config/src/planted.rs", "//! Settings.\nif family != Family::Lms {\n"),
            tree.with("hub/cli/planted.rs", "//! Options.\nlms_type: String,\n"),
        ]
    });
    let tree = SourceTree::load();
    for may in MAY_NAME_LMS {
        let is_used = hub_sources_with_lms(&tree).any(|path| path.starts_with(may));
        assert!(is_used, "{may} does not name the LMS: remove it from the list");
    }
}

#[test]
fn family_is_named_in_few_files() {
    assert_rule(few_files_name_a_family, |tree| {
        vec![
            tree.with(
                "hub/daemon/src/session_driver.rs",
                "//! Drives.\nlet trouble = ld::Trouble::Silence;\n",
            ),
            tree.with(
                "hub/daemon/src/session_driver.rs",
                "//! Drives.\nlet trouble = rplidar::Trouble::Silence;\n",
            ),
            tree.with("hub/config/src/planted.rs", "//! Settings.\nuse scanhub_drivers::ld::Model;\n"),
            tree.with("hub/tools/src/probe.rs", "//! Probes.\nif model == \"LD19\" {\n"),
            tree.with("clients/c/planted.h", "#define FAMILY_LD 1\n"),
        ]
    });
    let tree = SourceTree::load();
    for (name, words) in FAMILY_WORDS {
        let named = files_with_words(&tree, name, words);
        for path in ALLOWED_FILES {
            assert!(named.contains(&path), "{path} does not name {name}: remove it from the list");
        }
    }
}
