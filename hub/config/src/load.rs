//! Reads all sources of a configuration into the values in effect; the last one wins.

use std::path::Path;

use port::{Source, is_same_line};
use schema::{Failure, Kind};

use crate::gateway::Gateway;
use crate::layer::Drafts;
use crate::link::{Config, Link};
use crate::sources::Sources;

impl Config {
    /// Reads all sources.
    ///
    /// # Errors
    ///
    /// Returns [`schema::Kind::Configuration`] with place, value and remedy if a value is not valid, or if there is no
    /// link.
    pub fn load(sources: &Sources) -> Result<Config, Failure> {
        let mut drafts = Drafts::default();
        for layer in sources.files() {
            let (origin, layer) = layer?;
            drafts.merge(layer, origin, true)?;
        }
        let mut names = Vec::new();
        for layer in sources.links() {
            let (origin, layer) = layer?;
            layer.check_names(&origin, &mut names)?;
            drafts.merge(layer, origin, true)?;
        }
        let settings = sources.settings().collect::<Result<Vec<_>, _>>()?;
        if drafts.len() == 0 {
            let remedy =
                "--link NAME=PORT, or a section [[link]] in a file: scanhub config default prints one";
            return Err(Failure::new(Kind::Configuration, "no link is configured", remedy));
        }
        for (origin, layer) in settings {
            drafts.merge(layer, origin, false)?;
        }
        let (links, limits) = drafts.finish()?;
        check_ports(&links)?;
        Ok(Config { links, limits })
    }
}

/// Refuses two links at one line, also where it goes by two names at this moment.
fn check_ports(links: &[Link]) -> Result<(), Failure> {
    let is_same = |a: &Source, b: &Source| match (a, b) {
        (Source::File { .. }, _) => false,
        (Source::Tty(a), Source::Tty(b)) => is_same_line(a, b),
        // No name of a server is resolved to read a configuration.
        _ => a == b,
    };
    for (at, link) in links.iter().enumerate() {
        if let Some(other) = links[..at].iter().find(|other| is_same(&other.port, &link.port)) {
            let names = match (other.port.name(), link.port.name()) {
                (one, same) if one == same => one,
                (one, another) => format!("{one} is {another}"),
            };
            let message = format!("links {} and {} have the same port: {names}", other.name, link.name);
            let is_by_id = |port: &Source| matches!(port, Source::Tty(path) if is_by_serial_number(path));
            let hint = if other.port != link.port && (is_by_id(&other.port) || is_by_id(&link.port)) {
                "adapters with the same serial number share their name in by-id: use the names in /dev/serial/by-path, which \
                 scanhub probe lists"
            } else {
                "name the port of each sensor"
            };
            return Err(Failure::new(Kind::Configuration, message, hint));
        }
    }
    Ok(())
}

/// Returns whether udev has made the name of an adapter's serial number.
fn is_by_serial_number(path: &Path) -> bool {
    path.parent().is_some_and(|parent| parent.ends_with("serial/by-id"))
}

impl Gateway {
    /// Reads the section in all sources; the last one wins. Links are not required.
    ///
    /// [`schema::Kind::Configuration`] with place, value and remedy.
    pub fn load(sources: &Sources) -> Result<Gateway, Failure> {
        let mut gateway = Gateway::default();
        for layer in sources.files().chain(sources.settings()) {
            let (origin, layer) = layer?;
            if let Some(section) = layer.gateway {
                section.apply(&origin, &mut gateway)?;
            }
        }
        Ok(gateway)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sources(set: &[&str], links: &[&str]) -> Sources {
        let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
        let links = if links.is_empty() { &["front=/dev/ttyUSB0", "rear=/dev/ttyUSB1"] } else { links };
        Sources { files: Vec::new(), set: owned(set), links: owned(links) }
    }

    fn refusal(set: &[&str], links: &[&str]) -> String {
        let failure = Config::load(&sources(set, links)).expect_err("must be refused");
        assert_eq!(failure.kind, Kind::Configuration);
        failure.to_string()
    }

    #[test]
    fn no_port_is_opened_that_nobody_named() {
        let none = |set: &[&str]| {
            let sources = Sources { links: Vec::new(), ..sources(set, &[]) };
            Config::load(&sources).expect_err("no link").to_string()
        };
        for set in [&[][..], &["link.front.angle=100"], &["zones.margin=0.1"]] {
            assert!(none(set).starts_with("no link is configured\n  --link NAME=PORT"), "{}", none(set));
        }
        assert!(none(&["speed=3"]).contains("speed=3"));
        let config = Config::load(&sources(&[], &[])).unwrap();
        let names: Vec<_> = config.links.iter().map(|link| (link.name.as_str(), link.port.name())).collect();
        assert_eq!(names, [("front", "/dev/ttyUSB0".to_owned()), ("rear", "/dev/ttyUSB1".to_owned())]);
        let second = ["front=/dev/x", "rear=/dev/y", "front=/dev/z,model=ld19"];
        let second = refusal(&[], &second);
        assert!(second.starts_with("--link front=/dev/z,model=ld19: a second link front"), "{second}");
        let link = &config.links[0];
        assert_eq!((link.family(), link.scanner.settings.view, link.rate()), (None, None, 230_400));
    }

    #[test]
    fn flags_win() {
        let config = Config::load(&sources(
            &["link.a.angle=100", "link.a.resolution=0.25", "link.a.unit=cm", "link.b.baud=38400"],
            &["a=/dev/x", "b=file:/tmp/a b.bin?rate=max"],
        ))
        .unwrap();
        let settings = &config.links[0].scanner.settings;
        assert_eq!((settings.view, settings.unit_mm), (Some((100, 25)), Some(10)));
        assert_eq!(config.links[1].rate(), 38_400);
        assert_eq!(config.links[1].port, Source::File { path: "/tmp/a b.bin".into(), paced: false });
    }

    #[test]
    fn serial_servers() {
        for (text, host, port) in [
            ("tcp:box:4001", "box", 4001),
            ("tcp:10.0.0.7:23", "10.0.0.7", 23),
            ("tcp:[::1]:4001", "::1", 4001),
        ] {
            let source = Source::parse(text).unwrap();
            assert_eq!((source.name().as_str(), &source), (text, &Source::Tcp { host: host.into(), port }));
        }
    }

    #[test]
    fn refusals_name_place_value_and_remedy() {
        let unknown = refusal(&["link.front.prot=/dev/x"], &[]);
        assert!(unknown.contains("--set link.front.prot=/dev/x: unknown key `prot`"), "{unknown}");
        assert!(unknown.contains("did you mean `port`?"), "{unknown}");
        assert!(refusal(&["link.front.angle=170"], &[]).contains("angle = 170\n  100 or 180"));
        assert!(refusal(&["link.side.angle=100"], &[]).contains("no link side\n  there are: front, rear"));
        assert!(
            refusal(&["link.front.resolution=0.25"], &[]).contains("no sensor scans 180 degrees at 0.25")
        );
        let pose = refusal(&["link.front.pose=3"], &[]);
        assert!(pose.contains("integer `3`, expected where the sensor sits, as { x = 0.3, "), "{pose}");
        assert!(refusal(&["baud=3"], &[]).contains("not a setting"));
        assert!(refusal(&[], &["front"]).contains("--link front: no = in it"));
        assert!(refusal(&[], &["Front=/dev/x"]).contains("sensor name \"Front\" is not possible"));
        assert!(refusal(&[], &["front=file:x?rate=2"]).contains("rate=max"));
        assert!(refusal(&[], &["front=tcp:box"]).contains("write tcp:HOST:PORT"));
        assert!(refusal(&[], &["front=tcp::4001"]).contains("without a host"));
        assert!(refusal(&[], &["front=tcp:box:0"]).contains("a number to 65535"));
        assert!(refusal(&[], &["front=tcp:fe80::1:4001"]).contains("in brackets"));
    }

    #[test]
    fn only_a_recording_is_told_its_mode() {
        let config = Config::load(&sources(&["link.a.mode=0x01"], &["a=file:x"])).unwrap();
        assert_eq!(config.links[0].scanner.settings.mode_number, Some(1));
        let live = refusal(&["link.front.mode=0x01"], &["front=/dev/x"]);
        assert!(
            live.contains(
                "--set link.front.mode=0x01: link front: the mode of /dev/x is read from the sensor"
            ),
            "{live}"
        );
        for mode in ["0x07", "-1", "257"] {
            let odd = refusal(&[&format!("link.a.mode={mode}")], &["a=file:x"]);
            assert!(odd.contains("mode = ") && odd.contains("0x00 to 0x06"), "{odd}");
        }
    }

    #[test]
    fn what_a_type_cannot_do_is_refused() {
        let of = |set: &[&str]| Config::load(&sources(set, &[])).map(|config| config.links[0].clone());
        let scanner = of(&["link.front.type=lms211"]).unwrap().scanner;
        assert_eq!(
            (scanner.settings.expected_type, scanner.settings.view),
            (Some("lms211"), Some((100, 50)))
        );
        let fine = of(&["link.front.type=lms211", "link.front.resolution=0.25"]).unwrap();
        assert_eq!(fine.scanner.settings.view, Some((100, 25)));
        let wide = refusal(&["link.front.angle=180", "link.front.type=lms211"], &[]);
        assert!(
            wide.starts_with("--set link.front.angle=180: link front: an lms211 does not scan 180"),
            "{wide}"
        );
        assert!(wide.contains("its window is 100 degrees wide\n  angle = 100"), "{wide}");
        let fast = refusal(&["link.front.type=s14"], &[]);
        assert!(
            fast.contains("--set link.front.type=s14: link front: ") && fast.contains("90 degrees"),
            "{fast}"
        );
        let unknown = refusal(&["link.front.type=lms100"], &[]);
        assert!(unknown.contains("type = \"lms100\"\n  lms200, lms211, lms221 or lms291"), "{unknown}");
    }

    #[test]
    fn one_port_is_for_one_link() {
        let directory = tempfile::tempdir().unwrap();
        let own = directory.path().join("port");
        std::os::unix::fs::symlink("/dev/null", &own).unwrap();
        let twice = refusal(&[], &["a=/dev/x", "b=/dev/y", "c=/dev/x"]);
        let named = refusal(&[], &["a=/dev/null", &format!("b={}", own.display())]);
        let moved = refusal(&["link.b.port=/dev/x"], &["a=/dev/x", "b=/dev/y"]);
        assert!(refusal(&[], &["a=tcp:h:1", "b=tcp:h:1"]).contains("have the same port: tcp:h:1"));
        assert!(named.ends_with("name the port of each sensor"), "{named}");
        assert!(twice.starts_with("links a and c have the same port: /dev/x\n"), "{twice}");
        assert!(named.contains(&format!("same port: /dev/null is {}\n", own.display())), "{named}");
        assert!(moved.starts_with("links a and b have the same port: /dev/x\n"), "{moved}");
        assert!(Config::load(&sources(&[], &["a=file:x", "b=file:x", "c=tcp:h:1", "d=tcp:h:2"])).is_ok());
    }

    #[test]
    fn adapters_with_one_serial_number_need_names_by_path() {
        let root = tempfile::tempdir().unwrap();
        let [by_id, by_path] = ["by-id", "by-path"].map(|kind| root.path().join("serial").join(kind));
        for directory in [&by_id, &by_path] {
            std::fs::create_dir_all(directory).unwrap();
        }
        let [first, second, shared] = [by_path.join("first"), by_path.join("second"), by_id.join("shared")];
        std::os::unix::fs::symlink("/dev/null", &first).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &second).unwrap();
        // Since the restart, the shared name stands for the second adapter.
        std::os::unix::fs::symlink("/dev/zero", &shared).unwrap();
        let links =
            |front: &Path| [format!("front={}", front.display()), format!("rear={}", second.display())];
        let load = |links: [String; 2]| Config::load(&Sources { links: links.into(), ..Sources::default() });
        let refusal = load(links(&shared)).unwrap_err();
        let by_socket = load(links(&first)).map(|config| config.links.len());
        assert!(refusal.hint.contains("use the names in /dev/serial/by-path"), "{refusal}");
        assert_eq!(by_socket, Ok(2));
    }

    #[test]
    fn a_file_error_has_line_and_column() {
        let path = tempfile::NamedTempFile::new().unwrap().into_temp_path();
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            Config::load(&Sources { files: vec![path.to_path_buf()], ..Sources::default() })
        };
        let error = load("[[link]]\nname = \"front\"\nprot = \"/dev/x\"\n").unwrap_err().to_string();
        assert!(error.contains(&format!("{}:3:1: unknown key `prot`", path.display())), "{error}");
        let error =
            load("[[link]]\nname = \"front\"\nport = \"/dev/x\"\nbaud = 115200\n").unwrap_err().to_string();
        assert!(error.contains(":4:8: baud = 115200"), "{error}");
        let error =
            load("[[link]]\nname = \"a\"\nport = \"x\"\n[[link]]\nname = \"a\"\n").unwrap_err().to_string();
        assert!(
            error.contains(":5:8: a second link a") && error.contains("into the section of the first"),
            "{error}"
        );
        let text = "[[link]]\nname = \"a\"\nport = \"x\"\ntype = \"lms211\"\nangle = 180\n";
        let error = load(text).unwrap_err().to_string();
        assert!(error.contains(":5:9: link a: an lms211 does not scan 180 degrees"), "{error}");
        let error = load("[[link]]\nname = \"a\"\n").unwrap_err().to_string();
        assert!(error.contains("link a: no port"), "{error}");
        let link = "[[link]]\nname = \"a\"\nport = \"x\"\n";
        for (text, place, words) in [
            ("[link]\nname = \"a\"\nport = \"x\"\n".to_owned(), ":1:1: ", "with two brackets"),
            (format!("{link}baud = \"500000\"\n"), ":4:8: ", "baud = 500000, without quotes"),
            (format!("{link}unit = 5\n"), ":4:8: unit = 5 is not text", "unit = \"5\", with quotes"),
            (format!("{link}angle = \"wide\"\n"), ":4:9: ", "angle = \"wide\" is not a number"),
            (format!("{link}[zones]\nradii = 1.0\n"), ":5:9: ", "radii = [1.0], with brackets"),
            (format!("{link}[zones]\nexact = \"false\"\n"), ":5:9: ", "exact = false, without quotes"),
            (format!("{link}[zones]\nexact = 1\n"), ":5:9: ", "exact = true, or exact = false"),
        ] {
            let error = load(&text).unwrap_err().to_string();
            assert!(error.contains(place) && error.contains(words), "{error}");
        }
        let set = refusal(&["link.front.baud=\"500000\""], &[]);
        assert!(set.starts_with("--set link.front.baud=") && set.contains("without quotes"), "{set}");
        assert!(load("[[link]]\nname = \"a\"\nport = \"x\"\nangle = 100\n").is_ok());
    }
}
