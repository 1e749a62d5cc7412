//! Merges the sources of a configuration, one on top of the others. Every value is checked in its own source, so that
//! an error names file, line and column, or the flag.

use std::rc::Rc;

use port::Source;
use schema::limits::TopicLimits;
use schema::{Failure, Kind, check_sensor};
use serde::Deserialize;
use toml::Spanned;

use crate::gateway::GatewayLayer;
use crate::link::{Link, MAX_LINKS};
use crate::processing::{
    BackgroundLayer, EarlyLayer, LinesLayer, MarksLayer, MotionLayer, PoseLayer, Processing, Sections,
    ZonesLayer,
};
use crate::scanner::{ScannerDraft, ScannerLayer};
use crate::sources::Origin;
use crate::zone_coverage::ZoneCoverage;

/// Contents of one source. All other keys are unknown.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Layer {
    #[serde(default)]
    link: Vec<LinkLayer>,
    zones: Option<ZonesLayer>,
    marks: Option<MarksLayer>,
    lines: Option<LinesLayer>,
    motion: Option<MotionLayer>,
    background: Option<BackgroundLayer>,
    early: Option<EarlyLayer>,
    limits: Option<LimitsLayer>,
    /// The gateway can use the hub's configuration file.
    pub(crate) gateway: Option<GatewayLayer>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LinkLayer {
    name: Spanned<String>,
    port: Option<Spanned<String>>,
    #[serde(rename = "type")]
    expected_type: Option<Spanned<String>>,
    family: Option<Spanned<String>>,
    model: Option<Spanned<String>>,
    beams: Option<Spanned<i64>>,
    angle: Option<Spanned<f64>>,
    resolution: Option<Spanned<f64>>,
    unit: Option<Spanned<String>>,
    /// A number for an LMS, a name for other families.
    mode: Option<Spanned<toml::Value>>,
    idle: Option<Spanned<String>>,
    baud: Option<Spanned<u32>>,
    pose: Option<PoseLayer>,
    zones: Option<ZonesLayer>,
    marks: Option<MarksLayer>,
    lines: Option<LinesLayer>,
    motion: Option<MotionLayer>,
    background: Option<BackgroundLayer>,
    early: Option<EarlyLayer>,
}

impl Layer {
    /// Refuses a link of a flag that an earlier flag has defined, and adds the names of the others to `names`.
    pub(crate) fn check_names(&self, origin: &Origin, names: &mut Vec<String>) -> Result<(), Failure> {
        for LinkLayer { name, .. } in &self.link {
            if names.contains(name.get_ref()) {
                let what = format!("a second link {}", name.get_ref());
                return Err(origin.refuse(Some(name.span()), what, "give each link its own name"));
            }
            names.push(name.get_ref().clone());
        }
        Ok(())
    }
}

/// All links while sources are merged.
#[derive(Default)]
pub(crate) struct Drafts {
    links: Vec<Draft>,
    /// Sections for all links, in the order of the sources.
    general: Vec<(Rc<Origin>, Sections)>,
    limits: TopicLimits,
}

/// A link while sources are merged.
struct Draft {
    name: String,
    place: String,
    port: Option<Source>,
    scanner: ScannerDraft,
    /// Sections for this link, in the order of the sources.
    own: Vec<(Rc<Origin>, Sections)>,
}

impl Drafts {
    pub(crate) fn len(&self) -> usize {
        self.links.len()
    }

    /// Applies `layer` on top of the others. It may add links only if `may_add` is set.
    pub(crate) fn merge(&mut self, layer: Layer, origin: Origin, may_add: bool) -> Result<(), Failure> {
        let Layer { link, zones, marks, lines, motion, background, early, limits, gateway: _ } = layer;
        if let Some(section) = limits {
            section.apply(&origin, &mut self.limits)?;
        }
        let origin = Rc::new(origin);
        merge(&mut self.links, link, &origin, may_add)?;
        self.general.push((origin, Sections { pose: None, zones, marks, lines, motion, background, early }));
        Ok(())
    }

    /// Returns the links and the limits of their topics after all sources were merged.
    pub(crate) fn finish(self) -> Result<(Vec<Link>, TopicLimits), Failure> {
        let Drafts { links, general, limits } = self;
        let links: Result<_, _> = links.into_iter().map(|draft| draft.finish(&general)).collect();
        Ok((links?, limits))
    }
}

impl Draft {
    /// Returns the link. Values for the link take precedence over values for all links, regardless of their order.
    fn finish(self, general: &[(Rc<Origin>, Sections)]) -> Result<Link, Failure> {
        let Draft { name, place, port, scanner: requested, own } = self;
        let refuse = |place: &str, what: String, remedy: &str| {
            Failure::new(Kind::Configuration, format!("{place}: link {name}: {what}"), remedy)
        };
        let port = port.ok_or_else(|| refuse(&place, "no port".into(), "add port = \"/dev/ttyUSB0\""))?;
        let scanner_refused =
            |at: Option<&str>, what, remedy: &str| refuse(at.unwrap_or(&place), what, remedy);
        let scanner = requested.finish(scanner_refused)?;
        if let Some(mode_place) =
            requested.mode_number_place().filter(|_| !matches!(port, Source::File { .. }))
        {
            let what = format!("the mode of {} is read from the sensor", port.name());
            return Err(refuse(
                mode_place,
                what,
                "mode is only for recordings, port = \"file:PATH\"; leave it out",
            ));
        }
        let mut processing = Processing::default();
        let said: Vec<_> = general.iter().chain(&own).collect();
        for (origin, sections) in &said {
            sections.clone().apply(origin, &mut processing)?;
        }
        let start =
            said.iter().rev().find_map(|(origin, sections)| Some(origin.place(Some(sections.start()?))));
        let mut link = Link { name, port, scanner, processing };
        ZoneCoverage { link: &link, place: &place, said }.check()?;
        if let Some(family) = link.family() {
            own.iter().try_for_each(|(origin, sections)| sections.check_family(origin, family))?;
        }
        let mut background = std::mem::take(&mut link.processing.background);
        background.read(&link).map_err(|failure| {
            let place = start.unwrap_or_default();
            Failure::new(failure.kind, format!("{place}: {}", failure.message), failure.hint)
        })?;
        link.processing.background = background;
        Ok(link)
    }
}

/// Parses the text of `origin`.
pub(crate) fn parse(origin: &Origin) -> Result<Layer, Failure> {
    toml::from_str(origin.text()).map_err(|error| origin.explain(&error))
}

fn merge(
    links: &mut Vec<Draft>,
    layers: Vec<LinkLayer>,
    origin: &Rc<Origin>,
    may_add: bool,
) -> Result<(), Failure> {
    let mut seen: Vec<String> = Vec::new();
    for link in layers {
        let (span, name) = (Some(link.name.span()), link.name.into_inner());
        check_sensor(&name).map_err(|failure| origin.refuse(span.clone(), failure.message, failure.hint))?;
        if seen.contains(&name) {
            return Err(origin.refuse(
                span,
                format!("a second link {name}"),
                "give each link its own name, or put its keys into the section of the first one",
            ));
        }
        seen.push(name.clone());
        let known = links.iter().position(|draft| draft.name == name);
        let at = match known {
            Some(at) => at,
            None if may_add && links.len() >= MAX_LINKS => {
                let what =
                    format!("more than {MAX_LINKS} links: a sample stores its sensor's number in one byte");
                return Err(origin.refuse(span, what, format!("{MAX_LINKS} links for one hub")));
            }
            None if may_add => {
                links.push(Draft {
                    name: name.clone(),
                    place: origin.place(span),
                    port: None,
                    scanner: ScannerDraft::default(),
                    own: Vec::new(),
                });
                links.len() - 1
            }
            None => {
                let names: Vec<_> = links.iter().map(|draft| draft.name.as_str()).collect();
                let remedy = format!("there are: {}", names.join(", "));
                return Err(origin.refuse(span, format!("no link {name}"), remedy));
            }
        };
        let draft = &mut links[at];
        if let Some(port) = link.port {
            let port_span = Some(port.span());
            let port = port.into_inner();
            draft.port = Some(Source::parse(&port).map_err(|what| {
                origin.refuse(
                    port_span,
                    what,
                    "name a tty, tcp:HOST:PORT, or file:PATH, which may end with ?rate=max",
                )
            })?);
        }
        let LinkLayer {
            family, expected_type, model, beams, angle, resolution, unit, mode, idle, baud, ..
        } = link;
        let layer =
            ScannerLayer { family, expected_type, model, beams, angle, resolution, unit, mode, idle, baud };
        draft.scanner.apply(layer, origin)?;
        let LinkLayer { pose, zones, marks, lines, motion, background, early, .. } = link;
        draft.own.push((origin.clone(), Sections { pose, zones, marks, lines, motion, background, early }));
    }
    Ok(())
}

/// Keys of section `limits`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of limits, as { consumers = 32 }")]
struct LimitsLayer {
    consumers: Option<Spanned<i64>>,
}

impl LimitsLayer {
    /// Applies the keys that are set to `limits`.
    fn apply(self, origin: &Origin, limits: &mut TopicLimits) -> Result<(), Failure> {
        let LimitsLayer { consumers } = self;
        if let Some(consumers) = consumers {
            let value = usize::try_from(*consumers.get_ref()).ok();
            let value = value.filter(|value| TopicLimits::CONSUMERS.contains(value));
            limits.consumers = value.ok_or_else(|| {
                let what = format!("consumers = {}", consumers.get_ref());
                let remedy =
                    format!("{} to {}", TopicLimits::CONSUMERS.start(), TopicLimits::CONSUMERS.end());
                origin.refuse(Some(consumers.span()), what, remedy)
            })?;
        }
        Ok(())
    }
}

/// Returns `link.NAME.KEY=VALUE`, or a key of all links such as `zones.margin=0.05`, as TOML. A value that is not valid
/// TOML becomes text.
pub(crate) fn set_as_toml(flag: &str) -> Option<String> {
    let (path, value) = flag.split_once('=')?;
    let (table, key) = path.split_once('.')?;
    let (head, key) = match (table, key.split_once('.')) {
        ("link", Some((name, key))) => (format!("[[link]]\nname = {}\n", quoted(name)), key),
        ("link", None) => return None,
        _ => (String::new(), path),
    };
    let is_key = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if key == "name" || key.split('.').any(|word| word.is_empty() || !word.chars().all(is_key)) {
        return None;
    }
    Some(format!("{head}{key} = {}", to_toml(value)))
}

/// Returns `NAME=PORT`, followed by any number of `,KEY=VALUE`, as TOML.
pub(crate) fn link_as_toml(flag: &str) -> Option<String> {
    let (name, rest) = flag.split_once('=')?;
    let is_set = |part: &&str| {
        part.split_once('=')
            .is_some_and(|(key, _)| key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c == '.'))
    };
    // The name of a port may contain a comma.
    let parts: Vec<&str> = rest.split(',').collect();
    let set = parts.iter().rev().take_while(|part| is_set(part)).count().min(parts.len() - 1);
    let (port, set) = parts.split_at(parts.len() - set);
    let mut text = format!("[[link]]\nname = {}\nport = {}", quoted(name), quoted(&port.join(",")));
    for (key, value) in set.iter().filter_map(|part| part.split_once('=')) {
        text = format!("{text}\n{key} = {}", to_toml(value));
    }
    Some(text)
}

/// Returns `value` as TOML. It becomes text unless it is valid TOML.
fn to_toml(value: &str) -> String {
    match toml::from_str::<toml::Table>(&format!("v = {value}")) {
        Ok(table) if table.len() == 1 => value.to_owned(),
        _ => quoted(value),
    }
}

/// Returns `text` as a TOML string.
fn quoted(text: &str) -> String {
    let escaped: String = text
        .chars()
        .map(|c| match c {
            '"' | '\\' => format!("\\{c}"),
            c if c.is_control() => format!("\\u{:04X}", c as u32),
            c => c.to_string(),
        })
        .collect();
    format!("\"{escaped}\"")
}
