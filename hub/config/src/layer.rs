//! Merges the sources of a configuration, one on top of the others. Every value is checked in its own source, so that
//! an error names file, line and column, or the flag.

use std::rc::Rc;

use port::Source;
use scanhub_drivers::Settings;
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
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
use crate::scanner::{ScannerDraft, ScannerLayer, remedy_of_lms};
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
    lms_type: Option<Spanned<String>>,
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
    family: Option<Sourced<Family>>,
    angle_deg: Option<Sourced<u16>>,
    resolution_cdeg: Option<Sourced<u16>>,
    unit: Option<Sourced<Unit>>,
    mode: Option<Sourced<Mode>>,
    baud: Option<Sourced<Baud>>,
    /// Sections for this link, in the order of the sources.
    own: Vec<(Rc<Origin>, Sections)>,
}

/// A value, and the last place where it was set.
struct Sourced<T> {
    value: T,
    place: String,
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
        let Draft { name, place, port, scanner, family, angle_deg, resolution_cdeg, unit, mode, baud, own } =
            self;
        let refuse = |place: &str, what: String, remedy: &str| {
            Failure::new(Kind::Configuration, format!("{place}: link {name}: {what}"), remedy)
        };
        let port = port.ok_or_else(|| refuse(&place, "no port".into(), "add port = \"/dev/ttyUSB0\""))?;
        let said = |place: Option<&String>, key| place.map(|place| (place.clone(), key));
        let of_lms = [
            said(family.as_ref().map(|said| &said.place), "type"),
            said(angle_deg.as_ref().map(|said| &said.place), "angle"),
            said(resolution_cdeg.as_ref().map(|said| &said.place), "resolution"),
            said(unit.as_ref().map(|said| &said.place), "unit"),
            said(mode.as_ref().map(|said| &said.place), "mode"),
            said(baud.as_ref().map(|said| &said.place), "baud"),
        ];
        let of_lms: Vec<_> = of_lms.into_iter().flatten().collect();
        let mut scanner = scanner.finish(&of_lms, refuse)?;
        if !scanner.features().models.is_empty()
            && let Some((place, key)) = of_lms.first()
        {
            let what = format!("{key} is of family lms; a scanner of another family has no such setting");
            return Err(refuse(place, what, &remedy_of_lms(key, &scanner)));
        }
        if let Some(mode) = mode.as_ref().filter(|_| !matches!(port, Source::File { .. })) {
            let what = format!("the mode of {} is read from the sensor", port.name());
            return Err(refuse(
                &mode.place,
                what,
                "mode is only for recordings, port = \"file:PATH\"; leave it out",
            ));
        }
        // Place of the value that conflicts, or of the value that implies it.
        let type_place = family.as_ref().map_or(&place, |said| &said.place);
        let angle_place = angle_deg.as_ref().map_or(type_place, |said| &said.place);
        let step_place = resolution_cdeg.as_ref().map_or(angle_place, |said| &said.place);
        let family = family.as_ref().map(|said| said.value);
        let factory = family.and_then(Family::factory_variant).unwrap_or(Variant::HALF);
        let angle_deg = angle_deg.as_ref().map_or(factory.angle_deg, |said| said.value);
        let resolution_cdeg = resolution_cdeg.as_ref().map_or(factory.resolution_cdeg, |said| said.value);
        if family == Some(Family::Fast) {
            // A scan with 181 values looks like one of 180 degrees with a resolution of 1 degree.
            let what =
                "the beams of version S14 have other angles: 90 degrees at 0.5, which no telegram reports";
            return Err(refuse(
                type_place,
                what.into(),
                "a hub can stream lms200, lms211, lms221 and lms291",
            ));
        }
        let variant = Variant::new(angle_deg, resolution_cdeg).ok_or_else(|| {
            let step = f64::from(resolution_cdeg) / 100.0;
            let remedy = "180 degrees at 0.5 or 1, 100 degrees at 0.25, 0.5 or 1";
            refuse(step_place, format!("no sensor scans {angle_deg} degrees at {step}"), remedy)
        })?;
        if let Some((family, why)) = family.and_then(|f| Some((f, f.refuses_variant(variant)?))) {
            let what = format!("an {} does not scan {angle_deg} degrees: {why}", family.name());
            return Err(refuse(angle_place, what, "angle = 100"));
        }
        if scanner.family.is_some() && scanner.features().models.is_empty() {
            scanner.expected_type = family.map(Family::name);
            scanner.settings = Settings {
                view: Some((variant.angle_deg, variant.resolution_cdeg)),
                baud: baud.map(|said| said.value.rate()),
                unit_mm: unit.map(|said| said.value.mm()),
                mode_number: mode.map(|said| said.value.0),
                ..scanner.settings
            };
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
                    family: None,
                    angle_deg: None,
                    resolution_cdeg: None,
                    unit: None,
                    mode: None,
                    baud: None,
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
        let LinkLayer { family, model, beams, idle, .. } = link;
        draft.scanner.apply(ScannerLayer { family, model, beams, idle }, origin)?;
        if let Some(family) = link.lms_type {
            let value = Family::of_name(family.get_ref()).ok_or_else(|| {
                let what = format!("type = \"{}\"", family.get_ref());
                origin.refuse(Some(family.span()), what, "lms200, lms211, lms221 or lms291")
            })?;
            draft.family = Some(Sourced { value, place: origin.place(Some(family.span())) });
        }
        if let Some(angle) = link.angle {
            let value = scaled(origin, &angle, 1.0, "angle", "100 or 180")?;
            draft.angle_deg = Some(Sourced { value, place: origin.place(Some(angle.span())) });
        }
        if let Some(step) = link.resolution {
            let value = scaled(origin, &step, 100.0, "resolution", "0.25, 0.5 or 1")?;
            draft.resolution_cdeg = Some(Sourced { value, place: origin.place(Some(step.span())) });
        }
        if let Some(unit) = link.unit {
            let value = match unit.get_ref().as_str() {
                "mm" => Unit::Mm,
                "cm" => Unit::Cm,
                other => {
                    let what = format!("unit = \"{other}\"");
                    return Err(origin.refuse(Some(unit.span()), what, "\"mm\" or \"cm\""));
                }
            };
            draft.unit = Some(Sourced { value, place: origin.place(Some(unit.span())) });
        }
        if let Some(mode) = link.mode {
            let place = origin.place(Some(mode.span()));
            // The last one applies, whatever its family is.
            (draft.mode, draft.scanner.mode) = match mode.get_ref() {
                toml::Value::String(name) => (None, Some((name.clone(), place))),
                value => {
                    let number = value.as_integer().and_then(|number| u8::try_from(number).ok());
                    let known = number.map(Mode).filter(|mode| mode.has_ranges());
                    let refuse = || origin.refuse(Some(mode.span()), format!("mode = {value}"), MODES);
                    (Some(Sourced { value: known.ok_or_else(refuse)?, place }), None)
                }
            };
        }
        if let Some(baud) = link.baud {
            let value = Baud::of_rate(*baud.get_ref()).ok_or_else(|| {
                let what = format!("baud = {}", baud.get_ref());
                origin.refuse(
                    Some(baud.span()),
                    what,
                    "500000, 38400, 19200 or 9600; it is of an LMS, and the rate of others is the model's",
                )
            })?;
            draft.baud = Some(Sourced { value, place: origin.place(Some(baud.span())) });
        }
        let LinkLayer { pose, zones, marks, lines, motion, background, early, .. } = link;
        draft.own.push((origin.clone(), Sections { pose, zones, marks, lines, motion, background, early }));
    }
    Ok(())
}

/// Returns `value * scale` if a variant has this number. `allowed` lists the valid values in the failure.
fn scaled(
    origin: &Origin,
    value: &Spanned<f64>,
    scale: f64,
    key: &str,
    allowed: &str,
) -> Result<u16, Failure> {
    let scaled = value.get_ref() * scale;
    let known = |v: &Variant| if scale == 1.0 { v.angle_deg } else { v.resolution_cdeg };
    let found = Variant::ALL.iter().map(known).find(|&number| f64::from(number) == scaled);
    found.ok_or_else(|| origin.refuse(Some(value.span()), format!("{key} = {}", value.get_ref()), allowed))
}

/// Modes whose values are ranges (Telegram listing, 77h block D).
pub(crate) const MODES: &str = "0x00 to 0x06, or 0x0F: 0x01 has 3 reflector bits, 0x03 has 2, 0x05 has 1";

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
