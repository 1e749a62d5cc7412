//! Checks that the reference pages are complete: every class and key of `--json`, every exit code, configuration key
//! and flag, and every field of a datagram is on the right page.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use scanhub_schema::Kind;

use super::names::{of_configuration, of_help};
use super::output_page::{examples, rows};
use crate::testkit::TestEnv;
use crate::tidy::tree::SourceTree;

/// Verbs, each with the pages that describe its flags. Flags that many verbs have are on [`SHARED_PAGES`] instead.
const VERB_PAGES: [(&str, &[&str]); 30] = [
    ("run", &["configuration"]),
    ("replay", &["replay"]),
    ("demo", &["verbs", "worlds", "output", "scanners"]),
    ("simulate", &["scanners"]),
    ("probe", &["verbs"]),
    ("configure", &["scanner-lms"]),
    ("config", &["configuration"]),
    ("doctor", &["doctor", "bridge"]),
    ("list", &["output"]),
    ("info", &["output"]),
    ("echo", &["output"]),
    ("hz", &["output"]),
    ("latency", &["output"]),
    ("watch", &["watch"]),
    ("web", &["web"]),
    ("record", &["recording"]),
    ("telegram", &["output"]),
    ("control", &["output"]),
    ("background", &["output"]),
    ("zones", &["output"]),
    ("track", &["tracks"]),
    ("tilt", &["tilt"]),
    ("site", &["tracks"]),
    ("leds", &["output", "early"]),
    ("gateway", &["datagram"]),
    ("listen", &["sharing", "datagram", "verbs"]),
    ("key", &["datagram"]),
    ("convert", &["recording"]),
    ("completions", &["verbs"]),
    ("man", &["verbs"]),
];

/// Pages with flags that many verbs have: the flags of all verbs, and the flags that change the configuration.
const SHARED_PAGES: [&str; 2] = ["output", "configuration"];

/// Serialized structs that are not part of a line of `--json`. Each entry has a part of the file's path and the name of
/// the struct (empty for all structs of the file). Comments give the reasons.
const OTHER_STRUCTS: [(&str, &str); 4] = [
    // Messages to browsers and Foxglove.
    ("clients/viewer/src/server/", ""),
    // A struct that a configuration contains. The page of the configuration is checked for its keys.
    ("clients/perception/src/tilt/angles.rs", "ReversalDetector"),
    ("hub/config/src/section.rs", ""),
    // Structs in files that the hub saves.
    ("hub/daemon/src/saved_state.rs", ""),
];

fn page(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("docs/{name}.md"));
    fs::read_to_string(path).expect("a page")
}

/// Returns the words in quoted code on `page`, and the keys of its examples in JSON.
fn quoted_words(page: &str) -> BTreeSet<String> {
    let mut words = BTreeSet::new();
    for line in page.lines() {
        // An example has every name in quotation marks, all other lines have code in backticks.
        let mark = if line.starts_with('{') { '"' } else { '`' };
        for code in line.split(mark).skip(1).step_by(2) {
            let is_part = |c: char| c.is_alphanumeric() || "_-".contains(c);
            words.extend(code.split(|c| !is_part(c)).map(str::to_owned));
        }
    }
    words
}

/// Returns whether `text` contains `flag` as a whole word, and not only as the start of a longer flag.
fn has_flag(text: &str, flag: &str) -> bool {
    text.match_indices(flag)
        .any(|(at, _)| !text[at + flag.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '-'))
}

/// Classes and keys of JSON lines, each with the file that prints it.
#[derive(Debug, Default)]
struct Printed {
    classes: BTreeSet<(String, String)>,
    keys: BTreeSet<(String, String)>,
}

/// Returns the paths and texts of the program's sources in `tree`, without their tests.
fn product_files(tree: &SourceTree) -> impl Iterator<Item = (&str, &str)> {
    let is_product = |path: &str| {
        ["hub/", "clients/", "schema/src/"].iter().any(|top| path.starts_with(top))
            && !["/tests", "/examples/"].iter().any(|part| path.contains(part))
    };
    let files = tree.files(".rs").filter(move |(path, _)| is_product(path));
    files.map(|(path, text)| (path, text.split("\n#[cfg(test)]").next().unwrap_or_default()))
}

/// Returns the classes and keys that the sources of `tree` print.
fn printed(tree: &SourceTree) -> Printed {
    let mut printed = Printed::default();
    for (path, text) in product_files(tree) {
        printed.classes.extend(classes(text).map(|class| (class, path.to_owned())));
        let is_other = |name: &str| {
            OTHER_STRUCTS.iter().any(|(of, other)| path.starts_with(of) && name.starts_with(other))
        };
        for item in serialized(text).filter(|item| !is_other(&item.name)) {
            printed.keys.extend(item.keys.into_iter().map(|key| (key, path.to_owned())));
            printed.classes.extend(item.classes.into_iter().map(|class| (class, path.to_owned())));
        }
    }
    printed
}

/// Returns the classes that occur in `text` as values of the key `class`.
fn classes(text: &str) -> impl Iterator<Item = String> {
    const BEFORE: [&str; 7] = [
        "class: \"",
        "\"class\": \"",
        "\"class\":\"",
        "\\\"class\\\":\\\"",
        "SampleKeys::new(\"",
        "const CLASS: &str = \"",
        "tag = \"class\", rename = \"",
    ];
    BEFORE.into_iter().flat_map(move |before| {
        text.split(before).skip(1).filter_map(|rest| {
            let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_')?;
            (end > 0).then(|| rest[..end].to_owned())
        })
    })
}

/// Serialized struct or enum.
struct Serialized {
    name: String,
    keys: Vec<String>,
    /// Classes that the variants of the enum stand for.
    classes: Vec<String>,
}

/// Returns the structs and enums of `text` that derive `Serialize`.
fn serialized(text: &str) -> impl Iterator<Item = Serialized> {
    let lines: Vec<&str> = text.lines().collect();
    let derives = lines
        .iter()
        .enumerate()
        .filter(|(_, line)| line.trim_start().starts_with("#[derive(") && line.contains("Serialize"));
    let starts: Vec<usize> = derives.map(|(at, _)| at).collect();
    starts.into_iter().filter_map(move |start| {
        let is_item = |line: &&str| {
            let line = line.trim_start().trim_start_matches("pub(crate) ").trim_start_matches("pub ");
            line.starts_with("struct ") || line.starts_with("enum ")
        };
        let at = start + lines[start..].iter().position(is_item)?;
        let has_class = lines[start..at].iter().any(|line| line.contains("tag = \"class\", rename_all"));
        let indent = lines[at].len() - lines[at].trim_start().len();
        let end = format!("{}}}", " ".repeat(indent));
        let name =
            lines[at].split_whitespace().skip_while(|word| *word != "struct" && *word != "enum").nth(1)?;
        let name = name.split(|c: char| !c.is_alphanumeric()).next()?.to_owned();
        let (mut keys, mut classes, mut attributes) = (Vec::new(), Vec::new(), String::new());
        if lines[at].ends_with('{') {
            for line in lines[at + 1..].iter().take_while(|line| **line != end) {
                let inner = line.trim_start();
                if inner.starts_with("#[") {
                    attributes += inner;
                    continue;
                }
                if inner.starts_with("//") {
                    continue;
                }
                let is_skipped = ["flatten", "serde(skip)"].iter().any(|word| attributes.contains(word));
                let renamed = attributes.split("rename = \"").nth(1).and_then(|rest| rest.split('"').next());
                let field = inner.trim_start_matches("pub(crate) ").trim_start_matches("pub ");
                let is_name = |name: &&str| {
                    name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
                };
                if let Some(field) = field.split_once(": ").map(|(field, _)| field).filter(is_name)
                    && !is_skipped
                {
                    keys.push(renamed.unwrap_or(field).to_owned());
                } else if has_class && line.len() - inner.len() == indent + 4 {
                    let variant: String = inner.chars().take_while(|c| c.is_alphanumeric()).collect();
                    classes.extend(
                        (!variant.is_empty()).then(|| renamed.map_or(snake(&variant), str::to_owned)),
                    );
                }
                attributes.clear();
            }
        }
        Some(Serialized { name, keys, classes })
    })
}

/// Returns the name of a variant as serde writes it with `rename_all = "snake_case"`.
fn snake(name: &str) -> String {
    let mut snake = String::new();
    for c in name.chars() {
        if c.is_uppercase() && !snake.is_empty() {
            snake.push('_');
        }
        snake.push(c.to_ascii_lowercase());
    }
    snake
}

/// Returns a description of each class and each key that `page` lacks.
fn missing_output(printed: &Printed, page: &str) -> Vec<String> {
    let listed: BTreeSet<_> = rows(page).into_iter().flat_map(|row| row.classes).collect();
    let words = quoted_words(page);
    let classes = printed.classes.iter().filter(|(class, _)| !listed.contains(class.as_str()));
    let keys = printed.keys.iter().filter(|(key, _)| key != "class" && !words.contains(key));
    let classes = classes.map(|(class, path)| format!("docs/output.md has no class {class} of {path}"));
    classes.chain(keys.map(|(key, path)| format!("docs/output.md has no key {key} of {path}"))).collect()
}

#[test]
fn page_has_every_class_and_key() {
    let tree = SourceTree::load();
    let all = printed(&tree);
    assert!(all.classes.len() > 50 && all.keys.len() > 150, "{all:?}");
    assert_eq!(missing_output(&all, &page("output")), Vec::<String>::new());
    for (struct_text, what) in [
        (
            "#[derive(Serialize)]\nstruct PlantedJson {\n    class: &'static str,\n    planted_ms: u64,\n}\n",
            "planted_ms",
        ),
        (
            "#[derive(Serialize)]\nstruct PlantedJson {\n    #[serde(rename = \"planted\")]\n    seq: u64,\n}\n",
            "planted",
        ),
        ("let line = PlantedJson { class: \"planted\", seq };\n", "planted"),
        ("SampleKeys::new(\"planted\", sensor, header);\n", "planted"),
        (
            "#[derive(Serialize)]\n#[serde(tag = \"class\", rename_all = \"snake_case\")]\nenum Planted {\n    NewLine {\n        \
             seq: u64,\n    },\n}\n",
            "new_line",
        ),
        ("out.json(&json!({ \"class\": \"planted\", \"file\": path }))\n", "planted"),
    ] {
        let planted =
            printed(&tree.with("clients/verbs/src/planted.rs", &format!("//! A file.\n{struct_text}")));
        let missing = missing_output(&planted, &page("output"));
        assert!(missing.len() == 1 && missing[0].contains(&format!(" {what} of")), "{what}: {missing:?}");
    }
}

/// Returns the keys in the examples and rows of `page` that the sources of `tree` do not print, as `CLASS.KEY`. A source
/// prints a key as a field of a struct or as a word in a string. Another class may print the key.
fn unprinted_keys(tree: &SourceTree, page: &str) -> Vec<String> {
    let is_separator = |c: char| !c.is_alphanumeric() && c != '_';
    let mut words = BTreeSet::new();
    for (_, text) in product_files(tree) {
        let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let fields = code.clone().filter_map(|line| line.trim_start().split_once(": "));
        words.extend(
            fields.map(|(name, _)| name.trim_start_matches("pub(crate) ").trim_start_matches("pub ")),
        );
        let strings = code.flat_map(|line| line.split('"').skip(1).step_by(2));
        words.extend(strings.flat_map(|text| text.split(is_separator)));
    }
    let mut keys_of_page: Vec<(String, String)> = Vec::new();
    for example in examples(page) {
        keys_of_page.extend(example.keys.into_iter().map(|key| (example.class.clone(), key)));
    }
    for row in rows(page) {
        let class = row.classes.join(", ");
        keys_of_page.extend(row.keys.into_iter().map(|key| (class.clone(), key.to_owned())));
    }
    let unprinted = keys_of_page.iter().filter(|(_, key)| !words.contains(key.as_str()));
    unprinted.map(|(class, key)| format!("{class}.{key}")).collect()
}

#[test]
fn examples_have_only_keys_of_the_program() {
    let tree = SourceTree::load();
    assert_eq!(unprinted_keys(&tree, &page("output")), Vec::<String>::new());
    let planted = "| `zones` | `echo` | `planted_row_ms` |\n\n\
                   {\"class\":\"zones\",\"sensor\":\"front\",\"verdikt\":\"clear\"}\n";
    assert_eq!(unprinted_keys(&tree, planted), ["zones.verdikt", "zones.planted_row_ms"]);
}

/// All kinds of failures. A test compares this list with the source.
const KINDS: [Kind; 20] = [
    Kind::Failed,
    Kind::OtherUser,
    Kind::Incompatible,
    Kind::DomainHeld,
    Kind::NameHeld,
    Kind::Usage,
    Kind::NoHub,
    Kind::NoTopic,
    Kind::Timeout,
    Kind::PortMissing,
    Kind::PortPermission,
    Kind::PortBusy,
    Kind::PortNotTty,
    Kind::PortRate,
    Kind::Check,
    Kind::Input,
    Kind::Output,
    Kind::ResourceExhausted,
    Kind::Configuration,
    Kind::Interrupted,
];

/// Returns the kinds whose name is missing on `page` in the row of their exit code.
fn missing_exit_codes(kinds: &[Kind], page: &str) -> Vec<String> {
    let table = page.split("## Exit codes").nth(1).unwrap_or_default();
    let is_listed = |kind: &Kind| {
        let code = format!("| {} |", kind.exit_code());
        let name = format!("`{}`", kind.name());
        table.lines().any(|row| row.starts_with(&code) && row.contains(&name))
    };
    let missing = kinds.iter().filter(|kind| !is_listed(kind));
    missing.map(|kind| format!("{} {}", kind.exit_code(), kind.name())).collect()
}

#[test]
fn page_has_every_exit_code() {
    let page = page("output");
    let source = SourceTree::load();
    let source = source.text("schema/src/text.rs").split("pub enum Kind {\n").nth(1).expect("the kinds");
    let names = source.lines().take_while(|line| *line != "}").filter(|line| !line.contains("//"));
    let names: Vec<_> = names.map(|line| line.trim().trim_end_matches(',')).collect();
    assert_eq!(names, KINDS.map(|kind| format!("{kind:?}")));
    assert_eq!(missing_exit_codes(&KINDS, &page), Vec::<String>::new());
    let planted =
        page.replace("| 66 | `input`", "| 67 | `input`").replace("`no_topic`, `timeout`", "`no_topic`");
    assert_eq!(missing_exit_codes(&KINDS, &planted), ["3 timeout", "66 input"]);
}

/// Returns the keys of the configuration that have no row on `page`. Each key is written as `SECTION.KEY`.
fn missing_keys(keys: &[(String, String)], page: &str) -> Vec<String> {
    let mut missing = Vec::new();
    for (section, key) in keys {
        // `background.keep` has its own heading, below the heading of `background`.
        let heading = section.rsplit('.').next().unwrap_or_default();
        let text = page.split(&format!("# {heading}\n")).nth(1).unwrap_or_default();
        let text = text.split("\n## ").next().unwrap_or_default();
        // Sections of a link have their own headings.
        let is_section = section == "link" && page.contains(&format!("\n## {key}\n"));
        if !is_section && !text.contains(&format!("| `{key}`")) {
            missing.push(format!("{section}.{key}"));
        }
    }
    missing
}

#[test]
fn page_has_every_configuration_key() {
    let (mut keys, page) = (of_configuration(), page("configuration"));
    assert!(keys.len() > 40, "{keys:?}");
    assert_eq!(missing_keys(&keys, &page), Vec::<String>::new());
    keys.push(("zones".to_owned(), "planted".to_owned()));
    assert_eq!(missing_keys(&keys, &page), ["zones.planted"]);
}

/// Returns the flags that the pages of their verb lack, as `VERB --FLAG`. `used` has the verb and the flag for each
/// flag of the program.
fn missing_flags(used: &[(String, String)]) -> Vec<String> {
    let shared: Vec<String> = SHARED_PAGES.iter().map(|name| page(name)).collect();
    let general_flags = ["json", "domain", "root", "help", "version", "for", "timeout", "force"];
    let configuration_flags = ["config", "set", "link", "no-system-config"];
    let mut missing = BTreeSet::new();
    for (verb, flag) in used {
        let pages = VERB_PAGES.iter().find(|(name, _)| name == verb).map_or(&[][..], |(_, pages)| *pages);
        let mut texts: Vec<String> = pages.iter().map(|name| page(name)).collect();
        if general_flags.contains(&flag.as_str()) {
            texts.push(shared[0].clone());
        }
        if configuration_flags.contains(&flag.as_str()) {
            texts.push(shared[1].clone());
        }
        let flag = format!("--{flag}");
        if !texts.iter().any(|text| has_flag(text, &flag)) {
            missing.insert(format!("{verb} {flag}"));
        }
    }
    missing.into_iter().collect()
}

#[test]
fn pages_have_every_flag() {
    let mut used: Vec<_> = of_help(&TestEnv::new());
    for (_, flag) in &mut used {
        *flag = flag.replace('_', "-");
    }
    let verbs: BTreeSet<_> = used.iter().map(|(verb, _)| verb.as_str()).collect();
    assert_eq!(verbs, VERB_PAGES.iter().map(|(verb, _)| *verb).collect::<BTreeSet<_>>());
    assert_eq!(missing_flags(&used), Vec::<String>::new());
    for (verb, flag) in [("hz", "planted"), ("hz", "windo"), ("planted", "as")] {
        let planted = [(verb.to_owned(), flag.to_owned())];
        assert_eq!(missing_flags(&planted), [format!("{verb} --{flag}")]);
    }
}

/// Returns the fields of the header in `source` that have no row in the table of `page`.
fn missing_fields(source: &str, page: &str) -> Vec<String> {
    let fields = source.split("\nstruct DatagramHead {\n").nth(1).unwrap_or_default();
    let fields = fields.lines().take_while(|line| *line != "}");
    let fields = fields.filter(|line| !line.trim_start().starts_with("//"));
    let fields = fields.filter_map(|line| line.trim().split_once(": "));
    let names: Vec<_> = fields.map(|(name, _)| name).collect();
    assert!(names.len() > 10, "{names:?}");
    let header =
        page.split("## Header").nth(1).and_then(|rest| rest.split("\n## ").next()).unwrap_or_default();
    let missing = names.iter().filter(|name| !header.contains(&format!("| `{name}`: ")));
    missing.map(|name| (*name).to_owned()).collect()
}

#[test]
fn page_has_every_field_of_a_datagram() {
    let tree = SourceTree::load();
    let (source, page) = (tree.text("schema/src/datagram.rs"), page("datagram"));
    assert_eq!(missing_fields(source, &page), Vec::<String>::new());
    let planted = source.replace("\nstruct DatagramHead {\n", "\nstruct DatagramHead {\n    planted: u8,\n");
    assert_eq!(missing_fields(&planted, &page), ["planted"]);
}
