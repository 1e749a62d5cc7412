//! Checks that no JSON key, configuration key or flag has one of the former public names that were misleading or
//! contradicted the glossary.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use super::output_page::{examples, rows};
use crate::testkit::TestEnv;

/// Words that must not be names. Each word has a list of the places in which its meaning is allowed. A place is a row
/// of `docs/output.md`, written as `CLASS VERB`.
const FORBIDDEN: [(&str, &[&str]); 36] = [
    ("self_min", &[]),
    ("i_min", &[]),
    ("polish", &[]),
    ("consumers", &[]),
    ("breaks", &[]),
    ("collapsed", &[]),
    ("taught", &[]),
    ("doubted", &[]),
    ("left_out", &[]),
    ("unordered", &[]),
    ("angles_unordered", &[]),
    ("angles_ahead", &[]),
    ("ahead", &[]),
    ("withheld", &[]),
    ("forgotten", &[]),
    ("unfit", &[]),
    ("angles_unfit", &[]),
    ("pictures", &[]),
    ("trouble", &[]),
    // Allowed for telegrams and datagrams that did not arrive.
    ("lost", &["summary demo", "lan listen", "lan_evicted listen", "bridge bridge", "bridge_evicted bridge"]),
    ("lan_given_up", &[]),
    ("bridge_given_up", &[]),
    ("lives", &[]),
    ("displaced", &[]),
    ("unasked", &[]),
    ("disk_trouble", &[]),
    ("disk_well", &[]),
    ("file_gone", &[]),
    ("gone", &[]),
    ("client", &[]),
    ("came", &[]),
    ("clients", &[]),
    // Allowed for samples of a topic that the receiver does not support.
    ("skipped", &["lan_refused listen", "bridge_refused bridge"]),
    ("well", &[]),
    // Allowed for people who returned through a door.
    ("back", &["count track --count DOOR"]),
    ("unheard", &[]),
];

/// A name, and before it the place in which the name is used.
pub(super) type Used = (String, String);

/// Returns the names among `used` that are forbidden where they are used.
fn forbidden(used: &[Used]) -> Vec<String> {
    let is_forbidden = |(place, name): &&Used| {
        FORBIDDEN.iter().any(|(word, allowed)| word == name && !allowed.contains(&place.as_str()))
    };
    used.iter().filter(is_forbidden).map(|(place, name)| format!("{place}: {name}")).collect()
}

/// Returns the classes and keys in the tables and examples of `page`, which has the form of `docs/output.md`. An
/// example belongs to the rows of its class in the same section, and without such a row has the class as its place.
fn of_output(page: &str) -> Vec<Used> {
    let mut used = Vec::new();
    for section in page.split("\n## ") {
        let (rows, examples) = (rows(section), examples(section));
        for row in &rows {
            for class in &row.classes {
                let place = format!("{class} {}", row.verbs.first().unwrap_or(&""));
                let shown = examples.iter().filter(|example| example.class == *class && example.is_of(row));
                let shown = shown.flat_map(|example| &example.keys).map(String::as_str);
                let words = row.keys.iter().copied().chain([*class]).chain(shown);
                used.extend(words.map(|word| (place.clone(), word.to_owned())));
            }
        }
        for example in examples.iter().filter(|example| !rows.iter().any(|row| example.is_of(row))) {
            used.extend(example.keys.iter().map(|key| (example.class.clone(), key.clone())));
        }
    }
    used
}

/// Returns the keys of the configuration.
pub(super) fn of_configuration() -> Vec<Used> {
    let keys = scanhub_config::keys().into_iter();
    keys.flat_map(|(section, keys)| {
        keys.into_iter().map(move |(key, _)| (section.to_owned(), key.name.to_owned()))
    })
    .collect()
}

/// Returns the flags in the help of all verbs.
pub(super) fn of_help(env: &TestEnv) -> Vec<Used> {
    let help = |arguments: &[&str]| {
        let outcome = env.run(arguments);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        String::from_utf8(outcome.stdout).expect("text")
    };
    let all = help(&["--help"]);
    // The bridge is another program, and its own tests check its flags.
    let verbs = verbs_in(&all).into_iter().filter(|verb| !["help", "bridge"].contains(verb));
    let mut used = Vec::new();
    for verb in verbs {
        let mut text = help(&[verb, "--help"]);
        for below in verbs_in(&text.clone()) {
            if below != "help" {
                text += &help(&[verb, below, "--help"]);
            }
        }
        let words = text.split(|c: char| c.is_whitespace() || "[]()=,.;:`".contains(c));
        let flags = words.filter_map(|word| word.strip_prefix("--")).filter(|flag| !flag.is_empty());
        used.extend(flags.map(|flag| (verb.to_owned(), flag.replace('-', "_"))));
    }
    used
}

/// Returns the verbs in the lists of `help`. Each row has two spaces, a verb and more spaces.
fn verbs_in(help: &str) -> BTreeSet<&str> {
    let is_verb = |word: &str| word.chars().all(|c| c.is_ascii_lowercase());
    let rows = help.lines().take_while(|line| *line != "Options:");
    let rows = rows.filter_map(|line| line.strip_prefix("  ")?.split_once("  "));
    rows.map(|(verb, _)| verb).filter(|verb| !verb.is_empty() && is_verb(verb)).collect()
}

#[test]
fn no_public_name_is_forbidden() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/output.md");
    let output = of_output(&fs::read_to_string(page).expect("the page"));
    for (word, places) in FORBIDDEN {
        let is_used = |place: &&&str| output.iter().any(|(used, name)| used == *place && name == word);
        assert_eq!(places.iter().find(|place| !is_used(place)), None, "{word} does not exist any more");
    }
    let (keys, flags) = (of_configuration(), of_help(&TestEnv::new()));
    for (used, name) in [(&output, "topic_seq"), (&keys, "body_mask"), (&flags, "subscribers")] {
        assert!(used.iter().any(|(_, known)| known == name), "no {name} in {used:?}");
    }
    assert_eq!(forbidden(&[output, keys, flags].concat()), Vec::<String>::new());
}

#[test]
fn finds_a_forbidden_name() {
    let row = "| `hz` | `hz` | `sensor topic hz received lost` (samples), `lost_on_line` |\n\
               | `lan` | `listen` | `received lost` |\n";
    assert_eq!(forbidden(&of_output(row)), ["hz hz: lost"]);
    let example = "{\"class\":\"lan\",\"lost\":0}\n";
    let table = "| `lan`, `lan_to` | `listen` |\n| `lan` | `gateway` |\n";
    let cases: [(&str, &[&str]); 4] = [
        ("lan of listen", &[]),
        ("lan of gateway", &["lan gateway: lost"]),
        ("lan", &["lan gateway: lost"]),
        ("lan of bridge", &["lan: lost"]),
    ];
    for (heading, expected) in cases {
        let page = format!("# A page\n\n## Network\n\n{table}\n### {heading}\n\n{example}");
        assert_eq!(forbidden(&of_output(&page)), expected, "{heading}");
    }
    let other_section = format!("## Network\n\n{table}\n## Rates\n\n### lan\n\n{example}");
    assert_eq!(forbidden(&of_output(&other_section)), ["lan: lost"]);
    assert_eq!(forbidden(&[("zones".to_owned(), "self_min".to_owned())]), ["zones: self_min"]);
}
