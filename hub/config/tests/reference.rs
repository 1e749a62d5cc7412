//! Generator of the default configuration and of the tables of `docs/configuration.md`, from the keys of the sections.
//! The tests fail if the files differ from the generated text. This command writes the files again: `SCANHUB_REWRITE=1
//! cargo test -p scanhub-config --test reference`.

use std::fs;
use std::path::Path;

use scanhub_config::{Key, keys};
use scanhub_drivers::{AUTO, Features, features};
use scanhub_schema::Family;

/// Head of the default configuration.
const PAGE_HEAD: &str = "\
# Made with: scanhub config default > scanhub.toml. Every key is here, with its default; docs/configuration.md explains
# them. Keys behind a # have no default, or an automatic one.
# `scanhub probe PORT` finds the scanner at a port, and `scanhub probe PORT --toml` prints its section.
";

/// Links of the default configuration: title, name, port and family. All links except the first are comments.
const LINKS: [(&str, &str, &str, Option<Family>); 5] = [
    ("", "front", "/dev/ttyUSB0", None),
    ("A SICK LMS 2xx.", "rear", "/dev/ttyUSB1", Some(Family::Lms)),
    ("An LDROBOT.", "side", "/dev/ttyUSB2", Some(Family::Ld)),
    ("A Slamtec RPLIDAR. It has `beams`, too.", "top", "/dev/ttyUSB3", Some(Family::Rplidar)),
    ("A recording of an LMS.", "recorded", "file:scans.bin", None),
];

/// Comments of sections in the default configuration.
const SECTIONS: [(&str, &str); 2] = [
    ("zones", "for all links; for one: [link.zones] below its keys, and so for the sections below"),
    ("gateway", "for `scanhub gateway`"),
];

fn keys_of(section: &str) -> Vec<(Key, String)> {
    let found = keys().into_iter().find(|(name, _)| *name == section);
    found.unwrap_or_else(|| panic!("no section {section}")).1
}

/// Returns the paragraphs of a description.
fn paragraphs(key: &Key) -> Vec<String> {
    let lines = key.text.lines().map(str::trim).collect::<Vec<_>>();
    lines.split(|line| line.is_empty()).map(|lines| lines.join(" ")).filter(|text| !text.is_empty()).collect()
}

/// Returns a line of the default configuration.
fn line(setting: &str, comment: &str) -> String {
    match setting.len() {
        0..24 => format!("{setting:25}# {comment}"),
        _ => format!("{setting}   # {comment}"),
    }
}

/// Returns the line of a key with its default. If the key has an example, the line is a comment with the example.
fn with_default(key: &Key, default: &str) -> String {
    let setting = match key.example {
        "" => format!("{} = {default}", key.name),
        example => format!("# {} = {example}", key.name),
    };
    line(&setting, &paragraphs(key)[0])
}

fn join_with_or(names: &[&str]) -> String {
    let (last, others) = names.split_last().expect("a name");
    format!("{} or {last}", others.join(", "))
}

/// Returns the example and the comment of `key`, if the link of `family` shows it.
fn default_of_family(family: Family, key: &Key) -> Option<(String, String)> {
    let Features { models, modes, keys, .. } = features(family);
    let models: Vec<_> = [AUTO].into_iter().chain(models.iter().map(|model| model.name)).collect();
    let comment = paragraphs(key)[0].clone();
    let own = keys.iter().any(|own| own.name() == key.name);
    Some(match key.name {
        "model" if models.len() > 1 => (key.example.to_owned(), join_with_or(&models)),
        "beams" if family == Family::Ld => (key.example.to_owned(), comment),
        "mode" if !modes.is_empty() => {
            (format!("\"{AUTO}\""), format!("auto: the fastest; {}", join_with_or(modes)))
        }
        "type" if own => ("\"lms291\"".to_owned(), comment),
        "mode" | "model" | "beams" => return None,
        _ if own => (key.example.to_owned(), comment),
        _ => return None,
    })
}

fn reference_file() -> String {
    let keys_of_link = keys_of("link");
    let key =
        |name: &str| keys_of_link.iter().map(|(key, _)| key).find(|key| key.name == name).expect("a key");
    let mut text = PAGE_HEAD.to_owned();
    for (title, name, port, family) in LINKS {
        let mut lines =
            vec!["[[link]]".to_owned(), format!("name = \"{name}\""), format!("port = \"{port}\"")];
        if title.is_empty() {
            lines[1] = line(&lines[1], &paragraphs(key("name"))[0]);
            lines[2] = line(&lines[2], &paragraphs(key("port"))[0]);
            let families = format!(
                "{}; or {}",
                paragraphs(key("family"))[0],
                join_with_or(&Family::ALL.map(Family::name))
            );
            lines.push(line(&format!("family = \"{AUTO}\""), &families));
            let pose: Vec<_> =
                keys_of("pose").iter().map(|(key, default)| format!("{} = {default}", key.name)).collect();
            lines.push(line(&format!("pose = {{ {} }}", pose.join(", ")), &paragraphs(key("pose"))[0]));
            text += &format!("\n{}\n", lines.join("\n"));
            continue;
        }
        match family {
            Some(family) => {
                lines.push(format!("family = \"{}\"", family.name()));
                let shown = keys_of_link
                    .iter()
                    .filter_map(|(key, _)| Some((key.name, default_of_family(family, key)?)));
                let settings = shown.map(|(key, (example, comment))| {
                    line(&format!("# {key} = {example}"), &comment).split_off(2)
                });
                lines.extend(settings);
            }
            None => lines.push(
                line(&format!("# mode = {}", key("mode").example), &paragraphs(key("mode"))[0]).split_off(2),
            ),
        }
        text += &format!("\n# {title}\n# {}\n", lines.join("\n# "));
    }
    for (section, keys) in keys().into_iter().filter(|(section, _)| !["link", "pose"].contains(section)) {
        let comment = SECTIONS.iter().find(|(name, _)| *name == section).map(|(_, comment)| *comment);
        let title = format!("[{section}]");
        text += &format!("\n{}\n", comment.map_or(title.clone(), |comment| line(&title, comment)));
        for (key, default) in keys {
            text += &format!("{}\n", with_default(&key, &default));
        }
    }
    text
}

/// Returns `page` with the table of each section written between its markers.
fn with_tables(page: &str) -> String {
    let mut parts = page.split("<!-- keys of ");
    let mut text = parts.next().expect("a part").to_owned();
    for part in parts {
        let (section, rest) = part.split_once(" -->").expect("a marker");
        let (_, rest) = rest.split_once("<!-- end of keys -->").expect("an end");
        let rows = keys_of(section).into_iter().filter(|(_, default)| !default.starts_with('{'));
        let rows = rows.map(|(key, default)| {
            let all = paragraphs(&key);
            let about = if all.len() > 1 { all[1..].join(" ") } else { sentence(&all[0]) };
            let default =
                if default == "-" || default == "\"\"" { String::new() } else { format!("`{default}`") };
            format!("| `{}` | {default} | {about} |\n", key.name)
        });
        let rows: String = rows.collect();
        text += &format!(
            "<!-- keys of {section} -->\n| key | default | meaning |\n|---|---|---|\n{rows}<!-- end of keys -->{rest}"
        );
    }
    text
}

/// Returns the comment `text` as a sentence that starts with an uppercase letter and ends with a period.
fn sentence(text: &str) -> String {
    format!("{}{}.", text[..1].to_uppercase(), &text[1..])
}

fn compare(path: &str, generated: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    if std::env::var_os("SCANHUB_REWRITE").is_some() {
        return fs::write(path, generated).expect("a writable file");
    }
    let written = fs::read_to_string(&path).expect("a file");
    let differs = written.lines().zip(generated.lines()).find(|(written, generated)| written != generated);
    assert!(written == generated, "{}: not as generated: {differs:?}", path.display());
}

#[test]
fn default_configuration_is_generated() {
    compare("src/default.toml", &reference_file());
}

#[test]
fn tables_of_the_page_are_generated() {
    let path = "../../docs/configuration.md";
    let page = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).expect("a page");
    for (section, _) in keys() {
        assert!(page.contains(&format!("<!-- keys of {section} -->")), "no table of {section}");
    }
    compare(path, &with_tables(&page));
}
