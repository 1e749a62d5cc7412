//! Merging of all sources of a configuration into the values in effect. The last source takes precedence. Each source
//! must be valid by itself, so that an error can state the place in that source.

use std::ops::Range;
use std::path::Path;

use scanhub_port::{PortSpec, is_same_line};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::gateway::{Gateway, LimitsKeys};
use crate::link::{Config, Link, LinkKeys, MAX_LINKS};
use crate::processing::{
    BackgroundKeys, EarlyKeys, LinesKeys, MarksKeys, MotionKeys, Processing, ZonesKeys, check_coverage,
    check_family,
};
use crate::scanner::ScannerRequest;
use crate::section::{Section, find};
use crate::sources::{SourceKind, SourceMap, Sources};

/// Keys of a source. The sections of a source apply to all links.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Document {
    link: Vec<LinkKeys>,
    zones: ZonesKeys,
    marks: MarksKeys,
    lines: LinesKeys,
    motion: MotionKeys,
    background: BackgroundKeys,
    early: EarlyKeys,
    pub(crate) limits: LimitsKeys,
    pub(crate) gateway: Gateway,
}

impl Document {
    /// Checks all values except those of section `gateway`. The values were read from `table`.
    fn check(&self, table: &DeTable<'_>, sources: &SourceMap) -> Result<(), Failure> {
        let Document { link: _, zones, marks, lines, motion, background, early, limits, gateway: _ } = self;
        let sections: [(_, &dyn Section); _] = [
            ("zones", zones),
            ("marks", marks),
            ("lines", lines),
            ("motion", motion),
            ("background", background),
            ("early", early),
            ("limits", limits),
        ];
        sections.into_iter().try_for_each(|(name, section)| check_section(name, section, table, sources))
    }
}

fn check_section(
    name: &str,
    section: &dyn Section,
    table: &DeTable<'_>,
    sources: &SourceMap,
) -> Result<(), Failure> {
    let Some(value) = find(table, name) else { return Ok(()) };
    match value.get_ref() {
        DeValue::Table(table) => section.check(table, sources),
        // serde would assign the elements of a list to the keys in their order.
        _ => Err(sources.refuse(value.span(), format!("{name} is a list"), format!("write it as [{name}]"))),
    }
}

/// All sources, merged.
pub(crate) struct MergedConfig<'a> {
    sources: &'a SourceMap,
    /// Values that apply to all links, and the values of the sections `limits` and `gateway`.
    pub(crate) general: DeTable<'a>,
    /// Links in the order in which they were added.
    pub(crate) links: Vec<MergedLink<'a>>,
    /// Failure of the first source whose value for the gateway is not valid. The hub ignores this failure.
    gateway: Result<(), Failure>,
}

/// One link, merged from all sources.
pub(crate) struct MergedLink<'a> {
    /// Place where the link is first defined.
    location: String,
    /// Values for this link only.
    own: DeTable<'a>,
    /// Values for this link and for all links. A value for this link takes precedence over a value for all links,
    /// regardless of the order of the sources.
    pub(crate) table: DeTable<'a>,
    /// Keys with the values of `table`.
    pub(crate) keys: LinkKeys,
}

impl<'a> MergedConfig<'a> {
    /// Parses and merges `sources`.
    pub(crate) fn of(sources: &'a SourceMap) -> Result<MergedConfig<'a>, Failure> {
        let mut merged =
            MergedConfig { sources, general: DeTable::new(), links: Vec::new(), gateway: Ok(()) };
        let (settings, others): (Vec<_>, Vec<_>) =
            sources.layers()?.into_iter().partition(|(kind, ..)| *kind == SourceKind::Setting);
        let mut flags = Vec::new();
        for (kind, table, document) in others {
            merged.add_source(kind, table, document, &mut flags)?;
        }
        if merged.links.is_empty() {
            let remedy =
                "--link NAME=PORT, or a section [[link]] in a file: scanhub config default prints one";
            return Err(Failure::new(Kind::Configuration, "no link is configured", remedy));
        }
        for (kind, table, document) in settings {
            merged.add_source(kind, table, document, &mut flags)?;
        }
        for link in &mut merged.links {
            link.table = merged.general.clone();
            for section in ["limits", "gateway"] {
                link.table.remove(section);
            }
            overlay(&mut link.table, link.own.clone());
            link.keys = sources.deserialize(link.table.clone())?;
        }
        Ok(merged)
    }

    /// Adds one source. The values of this source take precedence over the values of earlier sources. `flags` has the
    /// names of the links from earlier flags `--link`.
    fn add_source(
        &mut self,
        kind: SourceKind,
        mut table: DeTable<'a>,
        document: Document,
        flags: &mut Vec<String>,
    ) -> Result<(), Failure> {
        document.check(&table, self.sources)?;
        let gateway = check_section("gateway", &document.gateway, &table, self.sources);
        self.gateway = std::mem::replace(&mut self.gateway, Ok(())).and(gateway);
        let links = table.remove("link").map(Spanned::into_inner);
        let Some(DeValue::Array(links)) = links else {
            overlay(&mut self.general, table);
            return Ok(());
        };
        overlay(&mut self.general, table);
        let mut earlier_names = Vec::new();
        for (keys, link) in document.link.into_iter().zip(links) {
            let span = link.span();
            let DeValue::Table(link) = link.into_inner() else {
                return Err(self.sources.refuse(span, "a link is a list", "write it as [[link]]"));
            };
            self.add_link(
                kind,
                keys,
                link,
                span,
                if kind == SourceKind::Link { flags } else { &mut earlier_names },
            )?;
        }
        Ok(())
    }

    fn add_link(
        &mut self,
        kind: SourceKind,
        keys: LinkKeys,
        table: DeTable<'a>,
        span: Range<usize>,
        earlier_names: &mut Vec<String>,
    ) -> Result<(), Failure> {
        let sources = self.sources;
        let Some(span) = table.get("name").map(Spanned::span) else {
            return Err(sources.refuse(span, "missing field `name`", "see docs/configuration.md"));
        };
        keys.check(&table, sources)?;
        for (name, section) in keys.sections() {
            check_section(name, section, &table, sources)?;
        }
        ScannerRequest::of(&keys, &table, sources)?;
        let name = keys.name;
        if earlier_names.contains(&name) {
            let remedy = match kind {
                SourceKind::Link => "give each link its own name",
                _ => "give each link its own name, or put its keys into the section of the first one",
            };
            return Err(sources.refuse(span, format!("a second link {name}"), remedy));
        }
        earlier_names.push(name.clone());
        if let Some(link) = self.links.iter_mut().find(|link| link.keys.name == name) {
            overlay(&mut link.own, table);
            return Ok(());
        }
        if kind == SourceKind::Setting {
            let names: Vec<_> = self.links.iter().map(|link| link.keys.name.as_str()).collect();
            let remedy = format!("the links are: {}", names.join(", "));
            return Err(sources.refuse(span, format!("no link {name}"), remedy));
        }
        if self.links.len() >= MAX_LINKS {
            let what =
                format!("more than {MAX_LINKS} links: a sample stores its sensor's number in one byte");
            return Err(sources.refuse(span, what, format!("{MAX_LINKS} links for one hub")));
        }
        let keys = LinkKeys { name, ..LinkKeys::default() };
        let location = sources.location(span);
        self.links.push(MergedLink { location, own: table, table: DeTable::new(), keys });
        Ok(())
    }

    /// Returns the configuration in effect.
    pub(crate) fn config(&self) -> Result<Config, Failure> {
        let links = self.links.iter().map(|link| link.finish(self.sources)).collect::<Result<Vec<_>, _>>()?;
        check_ports(&links)?;
        let limits: LimitsKeys = self.section("limits")?;
        let limits = TopicLimits { subscribers: limits.subscribers as usize, ..TopicLimits::default() };
        Ok(Config { links, limits })
    }

    /// Merges only the section `gateway`.
    fn of_gateway(sources: &'a SourceMap) -> Result<MergedConfig<'a>, Failure> {
        let mut merged =
            MergedConfig { sources, general: DeTable::new(), links: Vec::new(), gateway: Ok(()) };
        for (_, table, document) in sources.layers::<Document>()? {
            check_section("gateway", &document.gateway, &table, sources)?;
            overlay(&mut merged.general, table);
        }
        Ok(merged)
    }

    /// Returns the section `gateway`.
    pub(crate) fn gateway(&self) -> Result<Gateway, Failure> {
        self.gateway.clone()?;
        self.section("gateway")
    }

    /// Returns the section `name`, which does not belong to a link.
    pub(crate) fn section<T: DeserializeOwned + Default>(&self, name: &str) -> Result<T, Failure> {
        let table = find(&self.general, name).and_then(|section| section.get_ref().as_table());
        table.map_or(Ok(T::default()), |table| self.sources.deserialize(table.clone()))
    }

    /// Returns the place where `key`, which does not belong to a link, is set.
    pub(crate) fn location(&self, key: &str) -> Option<String> {
        find(&self.general, key).map(|value| self.sources.location(value.span()))
    }

    /// Returns the place where `key` of `link` is set.
    pub(crate) fn location_of(&self, link: &MergedLink<'_>, key: &str) -> Option<String> {
        find(&link.table, key).map(|value| self.sources.location(value.span()))
    }
}

impl MergedLink<'_> {
    /// Checks the merged values and returns the link.
    fn finish(&self, sources: &SourceMap) -> Result<Link, Failure> {
        let MergedLink { location, own, table, keys } = self;
        let name = keys.name.clone();
        let refuse = |location: Option<String>, what: String, remedy: &str| {
            let location = location.as_ref().unwrap_or(&self.location);
            Failure::new(Kind::Configuration, format!("{location}: link {name}: {what}"), remedy)
        };
        let no_port = || refuse(None, "no port".into(), "add port = \"/dev/ttyUSB0\"");
        let port = keys.port.as_deref().and_then(|port| PortSpec::parse(port).ok()).ok_or_else(no_port)?;
        let request = ScannerRequest::of(keys, table, sources)?;
        let scanner = request.finish(refuse)?;
        let is_live = !matches!(port, PortSpec::File { .. });
        if let Some(location) = request.mode_number_location().filter(|_| is_live) {
            let what = format!("the mode of {} is read from the sensor", port.name());
            let remedy = "mode is only for recordings, port = \"file:PATH\"; leave it out";
            return Err(refuse(Some(location), what, remedy));
        }
        let mut link = Link { name: name.clone(), port, scanner, processing: Processing::of(keys) };
        check_coverage(&link, table, location, sources)?;
        if let Some(family) = link.family() {
            check_family(own, sources, family)?;
        }
        let mut background = link.processing.background.clone();
        background.read(&link).map_err(|failure| {
            let start = find(table, "background.start");
            let location = start.map(|start| sources.location(start.span())).unwrap_or_default();
            Failure::new(failure.kind, format!("{location}: {}", failure.message), failure.hint)
        })?;
        link.processing.background = background;
        Ok(link)
    }
}

/// Merges the values of `over` into `under`. A value of `over` replaces the value of the same key in `under`.
fn overlay<'a>(under: &mut DeTable<'a>, over: DeTable<'a>) {
    for (key, value) in over {
        let span = value.span();
        match (under.get_mut(&**key.get_ref()).map(Spanned::get_mut), value.into_inner()) {
            (Some(DeValue::Table(under)), DeValue::Table(over)) => overlay(under, over),
            (_, value) => {
                under.insert(key, Spanned::new(span, value));
            }
        }
    }
}

impl Config {
    /// Reads and merges all sources.
    ///
    /// # Errors
    ///
    /// Returns [`scanhub_schema::Kind::Configuration`] with place, value and remedy if a value is not valid, or if
    /// there is no link.
    pub fn load(sources: &Sources) -> Result<Config, Failure> {
        Config::of(&sources.read())
    }

    /// Merges sources that were already read.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`load`](Self::load).
    pub fn of(sources: &SourceMap) -> Result<Config, Failure> {
        MergedConfig::of(sources)?.config()
    }
}

impl Gateway {
    /// Merges the section `gateway` of all `sources`. The last source takes precedence. Links are not required.
    ///
    /// # Errors
    ///
    /// Returns [`scanhub_schema::Kind::Configuration`] with place, value and remedy if a value is not valid.
    pub fn of(sources: &SourceMap) -> Result<Gateway, Failure> {
        MergedConfig::of_gateway(sources)?.section("gateway")
    }

    /// Returns the place in `sources` where `background_every` is set.
    pub fn background_every_location(sources: &SourceMap) -> Option<String> {
        MergedConfig::of_gateway(sources).ok()?.location("gateway.background_every")
    }
}

/// Returns a failure if two links have the same port. Two names of ttys are the same port if they lead to the same
/// device at this moment.
fn check_ports(links: &[Link]) -> Result<(), Failure> {
    let is_same = |a: &PortSpec, b: &PortSpec| match (a, b) {
        (PortSpec::File { .. }, _) => false,
        (PortSpec::Tty(a), PortSpec::Tty(b)) => is_same_line(a, b),
        // Names of serial servers are compared as text, because reading a configuration must not resolve them.
        _ => a == b,
    };
    for (at, link) in links.iter().enumerate() {
        if let Some(other) = links[..at].iter().find(|other| is_same(&other.port, &link.port)) {
            let names = match (other.port.name(), link.port.name()) {
                (one, same) if one == same => one,
                (one, another) => format!("{one} is {another}"),
            };
            let message = format!("links {} and {} have the same port: {names}", other.name, link.name);
            let is_by_id = |port: &PortSpec| matches!(port, PortSpec::Tty(path) if is_by_serial_number(path));
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

/// Returns whether `path` is a name that udev derives from the serial number of an adapter.
fn is_by_serial_number(path: &Path) -> bool {
    path.parent().is_some_and(|parent| parent.ends_with("serial/by-id"))
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
    fn refuses_missing_and_duplicate_links() {
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
    fn flags_take_precedence_over_files() {
        let config = Config::load(&sources(
            &["link.a.angle=100", "link.a.resolution=0.25", "link.a.unit=cm", "link.b.baud=38400"],
            &["a=/dev/x", "b=file:/tmp/a b.bin?rate=max"],
        ))
        .unwrap();
        let settings = &config.links[0].scanner.settings;
        assert_eq!((settings.view, settings.unit_mm), (Some((100, 25)), Some(10)));
        assert_eq!(config.links[1].rate(), 38_400);
        assert_eq!(config.links[1].port, PortSpec::File { path: "/tmp/a b.bin".into(), paced: false });
    }

    #[test]
    fn parses_serial_server_ports() {
        for (text, host, port) in [
            ("tcp:box:4001", "box", 4001),
            ("tcp:10.0.0.7:23", "10.0.0.7", 23),
            ("tcp:[::1]:4001", "::1", 4001),
        ] {
            let source = PortSpec::parse(text).unwrap();
            assert_eq!((source.name().as_str(), &source), (text, &PortSpec::Tcp { host: host.into(), port }));
        }
    }

    #[test]
    fn refusal_has_location_value_and_remedy() {
        let unknown = refusal(&["link.front.prot=/dev/x"], &[]);
        assert!(unknown.contains("--set link.front.prot=/dev/x: unknown key `prot`"), "{unknown}");
        assert!(unknown.contains("did you mean `port`?"), "{unknown}");
        assert!(refusal(&["link.front.angle=170"], &[]).contains("angle = 170\n  100 or 180"));
        assert!(
            refusal(&["link.side.angle=100"], &[]).contains("no link side\n  the links are: front, rear")
        );
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
        assert!(refusal(&[], &["front=tcp:box:0"]).contains("a number from 1 to 65535"));
        assert!(refusal(&[], &["front=tcp:fe80::1:4001"]).contains("in brackets"));
    }

    #[test]
    fn only_recordings_accept_a_mode_number() {
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
    fn refuses_settings_the_type_does_not_support() {
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
    fn two_links_with_the_same_port_are_refused() {
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
        // After a restart, the shared name belongs to the second adapter.
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
    fn file_error_has_line_and_column() {
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
