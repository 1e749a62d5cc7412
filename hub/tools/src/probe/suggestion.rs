//! The link that a configuration needs for a scanner that was found: as a command for the shell, and as a section of a
//! file.

use std::path::{Path, PathBuf};

use port::{Candidate, Source};
/// A link for the scanner at a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SuggestedLink {
    /// The port, by a name that does not change.
    port: String,
    /// Keys and values besides name and port.
    settings: Vec<(&'static str, String)>,
}

impl SuggestedLink {
    /// Creates the link for a scanner at `source`, with keys and values besides name and port.
    pub(crate) fn new(
        source: &Source,
        there: &[Candidate],
        settings: Vec<(&'static str, String)>,
    ) -> SuggestedLink {
        SuggestedLink { port: permanent_name(source, there), settings }
    }

    /// Returns the value of `--link`.
    pub fn flag(&self) -> String {
        let settings = self.settings.iter().map(|(key, value)| format!(",{key}={value}"));
        format!("{NAME}={}{}", self.port, settings.collect::<String>())
    }

    /// Returns the command that runs a hub for this scanner, as a shell takes it.
    pub fn command(&self) -> String {
        format!("scanhub run --link {}", shm::shell_word(&self.flag()))
    }

    /// Returns the section of a configuration file, without the end of its last line.
    pub fn toml(&self) -> String {
        let mut text = format!("[[link]]\nname = \"{NAME}\"\nport = {}", toml_string(&self.port));
        for (key, value) in &self.settings {
            let is_number = value.parse::<u32>().is_ok();
            text += &format!("\n{key} = {}", if is_number { value.clone() } else { toml_string(value) });
        }
        text
    }
}

/// Returns the serial line of this machine that `source` names.
pub(crate) fn candidate_of<'a>(source: &Source, there: &'a [Candidate]) -> Option<&'a Candidate> {
    let Source::Tty(path) = source else { return None };
    let device = path.canonicalize().ok()?;
    there.iter().find(|candidate| candidate.device == device)
}

/// Returns the name by which a configuration should name `source`: the one that stays, whatever is plugged in next.
fn permanent_name(source: &Source, there: &[Candidate]) -> String {
    let Source::Tty(path) = source else { return source.name() };
    let path: PathBuf = std::path::absolute(path).unwrap_or_else(|_| path.clone());
    let name = match candidate_of(source, there) {
        // A link elsewhere was made by the user, who knows what it stands for.
        Some(candidate) if path == candidate.device || is_by_udev(&path) => &candidate.name,
        _ => &path,
    };
    name.display().to_string()
}

/// Returns whether udev's own rules made the name.
fn is_by_udev(path: &Path) -> bool {
    path.parent().is_some_and(|parent| parent.ends_with("serial/by-id") || parent.ends_with("serial/by-path"))
}

/// Returns `text` as a string of TOML.
fn toml_string(text: &str) -> String {
    let mut string = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => string.extend(['\\', c]),
            c if c.is_control() => string += &format!("\\u{:04X}", u32::from(c)),
            c => string.push(c),
        }
    }
    string + "\""
}

/// Name of the sensor; the user may choose another one.
const NAME: &str = "front";

#[cfg(test)]
mod tests {
    use super::*;
    use config::{Config, Link, Sources};
    use scanhub_drivers::features;
    use scanhub_drivers::lms::family::Family as Type;
    use schema::Family;

    fn link(port: &str, settings: &[(&'static str, &str)]) -> SuggestedLink {
        let settings = settings.iter().map(|(key, value)| (*key, (*value).to_owned())).collect();
        SuggestedLink { port: port.to_owned(), settings }
    }

    /// Returns the link as `run` loads it, from the flag and from the section.
    fn loaded(link: &SuggestedLink) -> Link {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(&file, link.toml()).unwrap();
        let load = |sources: Sources| Config::load(&sources).map(|config| config.links);
        let by_file = load(Sources { files: vec![file.path().to_owned()], ..Sources::default() });
        let by_flag = load(Sources { links: vec![link.flag()], ..Sources::default() });
        assert_eq!(by_file, by_flag, "{}", link.toml());
        let [loaded] = &by_flag.unwrap_or_else(|failure| panic!("{}: {failure}", link.flag()))[..] else {
            panic!("one link")
        };
        loaded.clone()
    }

    #[test]
    fn every_suggestion_is_a_valid_link() {
        for family in Family::ALL {
            let models = features(family).models;
            for model in models {
                let link = loaded(&link("/dev/x", &[("family", family.name()), ("model", model.name)]));
                assert_eq!((link.family(), link.scanner.model().name), (Some(family), model.name));
            }
            assert_eq!(loaded(&link("/dev/x", &[("family", family.name())])).family(), Some(family));
        }
        for kind in Type::ALL.into_iter().filter(|kind| kind.factory_variant().is_some()) {
            let suggested =
                link("tcp:[::1]:4001", &[("family", "lms"), ("type", kind.name()), ("baud", "38400")]);
            let link = loaded(&suggested);
            assert_eq!(
                (link.scanner.settings.expected_type, link.rate(), link.port.name()),
                (Some(kind.name()), 38_400, suggested.port)
            );
        }
        for port in ["/dev/serial/by-id/usb-a_b\\x20c#1,2-if00", "/dev/it's \"one\"", "/dev/a,b c"] {
            let suggested = link(port, &[("family", "ld")]);
            assert_eq!(loaded(&suggested).port.name(), port);
        }
    }

    #[test]
    fn a_command_is_quoted_where_a_shell_needs_it() {
        let plain = link("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", &[("family", "ld")]);
        assert_eq!(plain.command(), format!("scanhub run --link {}", plain.flag()));
        let brackets = link("tcp:[::1]:4001", &[("family", "ld")]);
        assert_eq!(brackets.command(), "scanhub run --link 'front=tcp:[::1]:4001,family=ld'");
        assert_eq!(link("/dev/it's", &[]).command(), r"scanhub run --link 'front=/dev/it'\''s'");
    }

    #[test]
    fn a_name_that_changes_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap();
        let (by_id, by_path) = (root.join("serial/by-id/a"), root.join("serial/by-path/b"));
        for path in [&by_id, &by_path] {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        }
        let device = root.join("ttyUSB0");
        std::fs::write(&device, "").unwrap();
        for link in [&by_id, &by_path, &root.join("lidar")] {
            std::os::unix::fs::symlink(&device, link).unwrap();
        }
        let mut there = [Candidate {
            name: by_id.clone(),
            device: device.clone(),
            shared_name: None,
            driver: None,
            product: None,
            holder: None,
            is_permitted: true,
        }];
        let name = |path: &Path, there: &[Candidate]| permanent_name(&Source::Tty(path.to_owned()), there);
        assert_eq!(name(&device, &there), by_id.display().to_string());
        let own = root.join("lidar");
        assert_eq!(name(&own, &there), own.display().to_string(), "the user's own name stays");
        // Another adapter has the same serial number.
        (there[0].name, there[0].shared_name) = (by_path.clone(), Some(by_id.clone()));
        assert_eq!(name(&by_id, &there), by_path.display().to_string());
        assert_eq!(name(Path::new("/dev/no-such-port"), &there), "/dev/no-such-port");
    }
}
