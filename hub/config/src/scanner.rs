//! The scanner of a link: its family and the settings of a rotating scanner, as values in effect and as keys of the
//! sources. The settings of an LMS are in [`Link`](crate::Link).

use scanhub_drivers::line;
use scanhub_drivers::line::family::{Features, Model, Wanted};
use scanhub_drivers::scanner::features;
use schema::{Failure, Family};
use toml::Spanned;

use crate::sources::Origin;

/// Family of a scanner, with its settings. The settings of an LMS are in its [`Link`](crate::Link).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scanner {
    /// SICK LMS 2xx.
    Lms,
    /// A rotating scanner.
    Turning(Turning),
}

/// Settings of a rotating scanner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turning {
    /// Family of the scanner.
    pub family: Family,
    /// Models and modes of the family.
    pub features: &'static Features,
    /// Model, or the features' `auto` if the session must detect it.
    pub model: Model,
    /// Measuring mode; `None` if the scanner chooses it.
    pub mode: Option<&'static str>,
    /// Number of beams of a scan; `None` for that of the model.
    pub beams: Option<usize>,
    /// Whether the motor stops while there are no subscribers.
    pub stop_when_idle: bool,
}

impl Turning {
    /// Creates the settings of a scanner of `family`, with nothing set.
    pub(crate) fn new(family: Family, features: &'static Features) -> Turning {
        Turning { family, features, model: features.auto, mode: None, beams: None, stop_when_idle: false }
    }

    /// Returns whether the session must detect the model, and with it the number of beams.
    pub fn is_auto(&self) -> bool {
        self.model == self.features.auto && self.beams.is_none()
    }

    /// Returns the number of beams of a scan, or its maximum if the model must be detected.
    pub fn most_beams(&self) -> usize {
        self.beams.unwrap_or(self.model.beams)
    }

    /// Returns the highest rate that the scanner can have.
    pub fn most_rate(&self) -> u32 {
        let all = self.features.models.iter().map(|model| model.baud);
        if self.is_auto() { all.max().unwrap_or(self.model.baud) } else { self.model.baud }
    }

    /// Returns the settings of its session. `fixed_rate` is whether the port's rate cannot be changed, `listen_only`
    /// whether nothing may be sent.
    pub fn wanted(&self, fixed_rate: bool, listen_only: bool) -> Wanted {
        Wanted {
            model: (self.model != self.features.auto).then_some(self.model.name),
            mode: self.mode,
            beams: self.beams,
            most_beams: Some(self.most_beams()),
            fixed_rate,
            listen_only,
            stop_when_idle: self.stop_when_idle,
        }
    }
}

/// Keys of a scanner in one source.
pub(crate) struct ScannerLayer {
    pub(crate) family: Option<Spanned<String>>,
    pub(crate) model: Option<Spanned<String>>,
    pub(crate) beams: Option<Spanned<i64>>,
    pub(crate) idle: Option<Spanned<String>>,
}

/// Values of all sources with their places.
#[derive(Default)]
pub(crate) struct ScannerDraft {
    family: Option<(Family, String)>,
    model: Option<(String, String)>,
    beams: Option<(usize, String)>,
    /// Name of a mode. A number is a mode of an LMS.
    pub(crate) mode: Option<(String, String)>,
    stop_when_idle: Option<(bool, String)>,
}

impl ScannerDraft {
    /// Applies the keys that are set in `layer`.
    pub(crate) fn apply(&mut self, layer: ScannerLayer, origin: &Origin) -> Result<(), Failure> {
        let ScannerLayer { family, model, beams, idle } = layer;
        if let Some(family) = family {
            let known = Family::parse(family.get_ref()).ok_or_else(|| {
                let what = format!("family = \"{}\"", family.get_ref());
                origin.refuse(Some(family.span()), what, one_of(Family::ALL.map(Family::name)))
            })?;
            self.family = Some((known, origin.place(Some(family.span()))));
        }
        if let Some(model) = model {
            let place = origin.place(Some(model.span()));
            self.model = Some((model.into_inner(), place));
        }
        if let Some(beams) = beams {
            let known =
                usize::try_from(*beams.get_ref()).ok().filter(|beams| line::grid::BEAMS.contains(beams));
            let known = known.ok_or_else(|| {
                let (least, most) = (line::grid::BEAMS.start(), line::grid::BEAMS.end());
                let what = format!("beams = {}", beams.get_ref());
                origin.refuse(Some(beams.span()), what, format!("a whole number from {least} to {most}"))
            })?;
            self.beams = Some((known, origin.place(Some(beams.span()))));
        }
        if let Some(idle) = idle {
            let stops = IDLE.iter().find(|(word, _)| word == idle.get_ref()).ok_or_else(|| {
                let what = format!("idle = \"{}\"", idle.get_ref());
                origin.refuse(Some(idle.span()), what, one_of(IDLE.map(|(word, _)| word)))
            })?;
            self.stop_when_idle = Some((stops.1, origin.place(Some(idle.span()))));
        }
        Ok(())
    }

    /// Returns the scanner. `refuse` creates the failure for a place, a problem and a remedy.
    pub(crate) fn finish(self, refuse: impl Fn(&str, String, &str) -> Failure) -> Result<Scanner, Failure> {
        let ScannerDraft { family, model, beams, mode, stop_when_idle } = self;
        let model = model.filter(|(model, _)| !model.eq_ignore_ascii_case(AUTO));
        let implied = model.as_ref().and_then(|(model, _)| family_of(model));
        let set = family.as_ref().map(|(family, _)| *family);
        if let (Some((model, place)), Some((family, family_place)), Some(implied)) =
            (&model, &family, implied)
            && implied != *family
        {
            let [implied, family] = [implied.name(), family.name()];
            let what =
                format!("model = \"{model}\" is of family {implied}, but {family_place} says {family}");
            return Err(refuse(place, what, &format!("leave `family` out, or set family = \"{implied}\"")));
        }
        if let (Some((model, place)), None, None) = (&model, set, implied) {
            let known = Family::ALL.into_iter().filter_map(features).flat_map(|features| features.models);
            let names = auto_or(known.map(|model| model.name));
            let remedy = format!(
                "{names}; leave it out for an LMS, which reports its model; `type` is the expected one"
            );
            return Err(refuse(place, format!("model = \"{model}\""), &remedy));
        }
        let family = set.or(implied).unwrap_or(Family::Lms);
        let name = family.name();
        let mode = mode.filter(|(mode, _)| mode != AUTO);
        let rest = stop_when_idle.filter(|(stops, _)| *stops);
        let known = features(family);
        if let Some((_, place)) = rest.as_ref().filter(|_| known.is_none_or(|known| !known.can_rest)) {
            let what = format!("idle = \"stop\", and an {name} cannot be told to rest");
            return Err(refuse(place, what, "leave it out"));
        }
        let Some(features) = known else {
            let own = [
                model.map(|(model, place)| {
                    let what =
                        format!("model = \"{model}\", but a scanner of family {name} reports its model");
                    (place, what, "leave it out; `type` is the expected model")
                }),
                beams.map(|(beams, place)| {
                    let what = format!("beams = {beams}, and an {name} has its own");
                    (place, what, "leave it out; `angle` and `resolution` say how many")
                }),
                mode.map(|(mode, place)| (place, format!("mode = \"{mode}\""), crate::layer::MODES)),
            ];
            return match own.into_iter().flatten().next() {
                Some((place, what, remedy)) => Err(refuse(&place, what, remedy)),
                None => Ok(Scanner::Lms),
            };
        };
        let mut turning = Turning::new(family, features);
        if let Some((model, place)) = model {
            let known = features.models.iter().find(|known| known.name.eq_ignore_ascii_case(&model));
            turning.model = *known.ok_or_else(|| {
                let names = features.models.iter().map(|model| model.name);
                refuse(&place, format!("model = \"{model}\""), &auto_or(names))
            })?;
        }
        if let Some((mode, place)) = mode {
            turning.mode =
                Some(mode_of(features, name, &mode).map_err(|(what, remedy)| refuse(&place, what, &remedy))?);
        }
        turning.beams = beams.map(|(beams, _)| beams);
        turning.stop_when_idle = rest.is_some();
        Ok(Scanner::Turning(turning))
    }
}

/// Returns the family of the model called `model`. Each name belongs to one family.
fn family_of(model: &str) -> Option<Family> {
    let has = |family: &Family| {
        features(*family).is_some_and(|features| {
            features.models.iter().any(|known| known.name.eq_ignore_ascii_case(model))
        })
    };
    Family::ALL.into_iter().find(has)
}

/// Returns the mode called `mode` of the family `name`, or the problem and the remedy.
fn mode_of(features: &Features, name: &str, mode: &str) -> Result<&'static str, (String, String)> {
    if features.modes.is_empty() {
        let what = format!("mode = \"{mode}\", and an {name} measures in one way only");
        return Err((what, "leave it out".to_owned()));
    }
    let known = features.modes.iter().find(|known| known.eq_ignore_ascii_case(mode));
    known.copied().ok_or_else(|| (format!("mode = \"{mode}\""), auto_or(features.modes.iter().copied())))
}

/// Returns the remedy for a key of an LMS that is set for another `scanner`.
pub(crate) fn remedy_of_lms(key: &str, scanner: &Scanner) -> String {
    match (key, scanner) {
        ("baud", _) => "leave it out: the rate is the model's".to_owned(),
        ("mode", Scanner::Turning(turning)) if !turning.features.modes.is_empty() => {
            format!("name one of: {}", turning.features.modes.join(", "))
        }
        _ => "leave it out, or set family = \"lms\"".to_owned(),
    }
}

fn auto_or(names: impl Iterator<Item = &'static str>) -> String {
    format!("auto, or one of: {}", names.collect::<Vec<_>>().join(", "))
}

fn one_of<const N: usize>(names: [&str; N]) -> String {
    format!("one of: {}", names.join(", "))
}

/// The session detects or chooses the value.
const AUTO: &str = "auto";
/// Values of `idle`, and whether the motor then stops while there are no subscribers.
const IDLE: [(&str, bool); 2] = [("run", false), ("stop", true)];
