//! The scanner of a link: its family and settings, as values in effect and as keys of the sources.

use port::Source;
use scanhub_drivers::{ANY, Features, Model, Settings, features, line};
use schema::{Failure, Family};
use toml::Spanned;

use crate::sources::Origin;

/// Family of a scanner, with its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scanner {
    /// Family of the scanner. `None`: the hub searches for it.
    pub family: Option<Family>,
    /// Name of the expected type, for a family that reports it.
    pub expected_type: Option<&'static str>,
    /// Values that are set for the session. Those of the port follow from the link.
    pub settings: Settings,
}

impl Scanner {
    /// Returns the models and settings of the family, or of all families if it is searched for.
    pub fn features(&self) -> &'static Features {
        self.family.map_or(&ANY, features)
    }

    /// Returns the model, or the values for an unknown one if the session must detect it.
    pub fn model(&self) -> Model {
        let features = self.features();
        let named = features.models.iter().find(|model| Some(model.name) == self.settings.model);
        named.copied().unwrap_or(features.auto)
    }

    /// Returns whether the session must detect the model, and with it the number of beams.
    pub fn is_auto(&self) -> bool {
        let Settings { model, beams, .. } = self.settings;
        let has_models = self.family.is_none_or(|family| !features(family).models.is_empty());
        has_models && model.is_none() && beams.is_none()
    }

    /// Returns the number of beams of a scan, or its maximum if it is not known before.
    pub fn max_beams(&self) -> usize {
        let Some(beams) = self.settings.beams else { return self.model().beams };
        if self.family.is_some() {
            return beams;
        }
        // A scanner that reports its model has its own number of beams.
        let own = Family::ALL.into_iter().map(features).filter(|features| features.models.is_empty());
        own.map(|features| features.auto.beams).max().unwrap_or(beams).max(beams)
    }

    /// Returns the rate at which a tty is opened, in bits per second.
    pub fn rate(&self) -> u32 {
        self.settings.baud.unwrap_or(self.model().baud)
    }

    /// Returns the highest rate that the scanner can have.
    fn max_rate(&self) -> u32 {
        let families =
            self.family.map_or(Family::ALL.to_vec(), |family| vec![family]).into_iter().map(features);
        let all = families.flat_map(|features| features.models.iter().chain([&features.auto]));
        let all = all.map(|model| model.baud);
        if self.is_auto() { all.max().unwrap_or(self.rate()) } else { self.rate() }
    }

    /// Returns the highest rate that the scanner can have at `port`. A serial server has its own rate, whatever is
    /// configured here.
    pub fn max_rate_at(&self, port: &Source) -> u32 {
        if matches!(port, Source::Tty(_)) { self.rate() } else { self.max_rate() }
    }

    /// Returns the settings of a session at `port`. `listen_only` is whether nothing may be sent.
    pub fn settings_at(&self, port: &Source, listen_only: bool) -> Settings {
        let fixed_rate = !matches!(port, Source::Tty(_));
        let is_found = self.family.is_none() || self.settings.is_found;
        Settings { max_beams: Some(self.max_beams()), fixed_rate, listen_only, is_found, ..self.settings }
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
    /// The family, or that it is searched for.
    family: Option<(Option<Family>, String)>,
    model: Option<(String, String)>,
    beams: Option<(usize, String)>,
    /// Name of a mode. A number is a mode of an LMS.
    pub(crate) mode: Option<(String, String)>,
    stop_when_idle: Option<(bool, String)>,
}

/// A key that names the family of its link.
struct Naming {
    family: Family,
    /// Key and value, as text.
    what: String,
    place: String,
}

impl ScannerDraft {
    /// Applies the keys that are set in `layer`.
    pub(crate) fn apply(&mut self, layer: ScannerLayer, origin: &Origin) -> Result<(), Failure> {
        let ScannerLayer { family, model, beams, idle } = layer;
        if let Some(family) = family {
            let known = Family::parse(family.get_ref());
            if known.is_none() && !family.get_ref().eq_ignore_ascii_case(AUTO) {
                let what = format!("family = \"{}\"", family.get_ref());
                let names = auto_or(Family::ALL.into_iter().map(Family::name));
                return Err(origin.refuse(Some(family.span()), what, names));
            }
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

    /// Returns the scanner. `lms_keys` are the keys that only an LMS has, each with its place. `refuse` creates the
    /// failure for a place, a problem and a remedy.
    pub(crate) fn finish(
        self,
        lms_keys: &[(String, &str)],
        refuse: impl Fn(&str, String, &str) -> Failure,
    ) -> Result<Scanner, Failure> {
        let named = match &self.family {
            Some((Some(_), _)) => None,
            _ => self.named_family(lms_keys, &refuse)?,
        };
        let ScannerDraft { family, model, beams, mode, stop_when_idle } = self;
        let model = model.filter(|(model, _)| !model.eq_ignore_ascii_case(AUTO));
        let implied = model.as_ref().and_then(|(model, _)| family_of(model));
        let set = family.and_then(|(family, place)| Some((family?, place)));
        if let (Some((model, place)), Some((family, family_place)), Some(implied)) = (&model, &set, implied)
            && implied != *family
        {
            let [implied, family] = [implied.name(), family.name()];
            let what =
                format!("model = \"{model}\" is of family {implied}, but {family_place} says {family}");
            return Err(refuse(place, what, &format!("leave `family` out, or set family = \"{implied}\"")));
        }
        if let (Some((model, place)), None, None) = (&model, &set, implied) {
            let known = Family::ALL.into_iter().map(features).flat_map(|features| features.models);
            let names = auto_or(known.map(|model| model.name));
            let remedy = format!(
                "{names}; leave it out for an LMS, which reports its model; `type` is the expected one"
            );
            return Err(refuse(place, format!("model = \"{model}\""), &remedy));
        }
        let Some(family) = set.map(|(family, _)| family).or(named) else {
            let settings = Settings { beams: beams.map(|(beams, _)| beams), ..Settings::default() };
            return Ok(Scanner { family: None, expected_type: None, settings });
        };
        let name = family.name();
        let mode = mode.filter(|(mode, _)| !mode.eq_ignore_ascii_case(AUTO));
        let rest = stop_when_idle.filter(|(stops, _)| *stops);
        let features = features(family);
        if let Some((_, place)) = rest.as_ref().filter(|_| !features.can_rest) {
            let what = format!("idle = \"stop\", and an {name} cannot be told to rest");
            return Err(refuse(place, what, "leave it out"));
        }
        let mut settings = Settings { stop_when_idle: rest.is_some(), ..Settings::default() };
        if features.models.is_empty() {
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
                None => Ok(Scanner { family: Some(family), expected_type: None, settings }),
            };
        }
        if let Some((model, place)) = model {
            let known = features.models.iter().find(|known| known.name.eq_ignore_ascii_case(&model));
            let known = known.ok_or_else(|| {
                let names = features.models.iter().map(|model| model.name);
                refuse(&place, format!("model = \"{model}\""), &auto_or(names))
            })?;
            settings.model = Some(known.name);
        }
        if let Some((mode, place)) = mode {
            settings.mode =
                Some(mode_of(features, name, &mode).map_err(|(what, remedy)| refuse(&place, what, &remedy))?);
        }
        settings.beams = beams.map(|(beams, _)| beams);
        Ok(Scanner { family: Some(family), expected_type: None, settings })
    }

    /// Returns the family that the keys name which only one family has. `None` if there are none.
    fn named_family(
        &self,
        lms_keys: &[(String, &str)],
        refuse: impl Fn(&str, String, &str) -> Failure,
    ) -> Result<Option<Family>, Failure> {
        let of_lms = lms_keys.iter().map(|(place, key)| Naming {
            family: Family::Lms,
            what: (*key).to_owned(),
            place: place.clone(),
        });
        let model = self.model.as_ref().and_then(|(model, place)| {
            let what = format!("model = \"{model}\"");
            Some(Naming { family: family_of(model)?, what, place: place.clone() })
        });
        let mode = self.mode.as_ref().filter(|(mode, _)| !mode.eq_ignore_ascii_case(AUTO));
        let mode = mode.and_then(|(mode, place)| {
            let family = family_with(|features| !features.modes.is_empty())?;
            Some(Naming { family, what: format!("mode = \"{mode}\""), place: place.clone() })
        });
        let idle = self.stop_when_idle.as_ref().and_then(|(_, place)| {
            let family = family_with(|features| features.can_rest)?;
            Some(Naming { family, what: "idle".to_owned(), place: place.clone() })
        });
        let mut all = of_lms.chain(model).chain(mode).chain(idle);
        let Some(first) = all.next() else { return Ok(None) };
        if let Some(other) = all.find(|other| other.family != first.family) {
            let what = format!(
                "{} is of family {}, but {} at {} is of family {}",
                other.what,
                other.family.name(),
                first.what,
                first.place,
                first.family.name()
            );
            return Err(refuse(&other.place, what, "set only keys of the family that the scanner has"));
        }
        Ok(Some(first.family))
    }
}

/// Returns the family of the model called `model`. Each name belongs to one family.
fn family_of(model: &str) -> Option<Family> {
    let has =
        |family: &Family| features(*family).models.iter().any(|known| known.name.eq_ignore_ascii_case(model));
    Family::ALL.into_iter().find(has)
}

/// Returns the first family whose features meet `condition`.
fn family_with(condition: impl Fn(&Features) -> bool) -> Option<Family> {
    Family::ALL.into_iter().find(|family| condition(features(*family)))
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
        ("mode", scanner) if !scanner.features().modes.is_empty() => {
            format!("name one of: {}", scanner.features().modes.join(", "))
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

/// The hub or the session detects or chooses the value.
pub(crate) const AUTO: &str = "auto";
/// Values of `idle`, and whether the motor then stops while there are no subscribers.
const IDLE: [(&str, bool); 2] = [("run", false), ("stop", true)];
