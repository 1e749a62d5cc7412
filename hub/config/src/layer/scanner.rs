//! The keys that say of which family a link's scanner is, and what only some families have. Refuses to know what a family
//! speaks.

use scanhub_drivers::line;
use scanhub_drivers::line::family::Features;
use scanhub_drivers::scanner::features;
use schema::{Failure, Family};
use toml::Spanned;

use crate::origin::Origin;
use crate::scanner::{Scanner, Turning};

/// The keys of a scanner, as one source says them.
pub(super) struct ScannerLayer {
    pub(super) family: Option<Spanned<String>>,
    pub(super) model: Option<Spanned<String>>,
    pub(super) beams: Option<Spanned<i64>>,
    pub(super) idle: Option<Spanned<String>>,
}

/// What all sources say, with their places.
#[derive(Default)]
pub(super) struct ScannerDraft {
    family: Option<(Family, String)>,
    model: Option<(String, String)>,
    beams: Option<(usize, String)>,
    /// The name of one; the number of one is of an LMS.
    pub(super) mode: Option<(String, String)>,
    stop_when_idle: Option<(bool, String)>,
}

impl ScannerDraft {
    /// Lays what `layer` says over it.
    pub(super) fn lay(&mut self, layer: ScannerLayer, origin: &Origin) -> Result<(), Failure> {
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

    /// What it says; `refuse` makes the failure of a place, of what is said there and of the remedy.
    pub(super) fn finish(self, refuse: impl Fn(&str, String, &str) -> Failure) -> Result<Scanner, Failure> {
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
                mode.map(|(mode, place)| (place, format!("mode = \"{mode}\""), super::MODES)),
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

/// Returns the family of the model called `model`, whose name belongs to one family alone.
fn family_of(model: &str) -> Option<Family> {
    let has = |family: &Family| {
        features(*family).is_some_and(|features| {
            features.models.iter().any(|known| known.name.eq_ignore_ascii_case(model))
        })
    };
    Family::ALL.into_iter().find(has)
}

/// The mode called `mode` of a family called `name`; else what is wrong, and the remedy.
fn mode_of(features: &Features, name: &str, mode: &str) -> Result<&'static str, (String, String)> {
    if features.modes.is_empty() {
        let what = format!("mode = \"{mode}\", and an {name} measures in one way only");
        return Err((what, "leave it out".to_owned()));
    }
    let known = features.modes.iter().find(|known| known.eq_ignore_ascii_case(mode));
    known.copied().ok_or_else(|| (format!("mode = \"{mode}\""), auto_or(features.modes.iter().copied())))
}

/// What to do about a key of an LMS that is set for another `scanner`.
pub(super) fn remedy_of_lms(key: &str, scanner: &Scanner) -> String {
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

/// It is found out, or chosen.
const AUTO: &str = "auto";
/// What the motor does while nobody follows: whether it stops.
const IDLE: [(&str, bool); 2] = [("run", false), ("stop", true)];
