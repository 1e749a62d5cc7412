//! The keys that say of which family a link's scanner is, and what only some families have. Refuses to know what a family
//! speaks.

use schema::{Failure, Family};
use toml::Spanned;

use crate::link::Scanner;
use crate::origin::Origin;

/// The keys `family`, `model` and `beams` of a link, as one source says them.
pub(super) struct ScannerLayer {
    pub(super) family: Option<Spanned<String>>,
    pub(super) model: Option<Spanned<String>>,
    pub(super) beams: Option<Spanned<i64>>,
}

/// What all sources say, with their places.
#[derive(Default)]
pub(super) struct ScannerDraft {
    family: Option<(Family, String)>,
    model: Option<(String, String)>,
    beams: Option<(usize, String)>,
}

impl ScannerDraft {
    /// Lays what `layer` says over it.
    pub(super) fn lay(&mut self, layer: ScannerLayer, origin: &Origin) -> Result<(), Failure> {
        if let Some(family) = layer.family {
            let known = Family::parse(family.get_ref()).ok_or_else(|| {
                let what = format!("family = \"{}\"", family.get_ref());
                origin.refuse(
                    Some(family.span()),
                    what,
                    format!("one of: {}", names(Family::ALL, Family::name)),
                )
            })?;
            self.family = Some((known, origin.place(Some(family.span()))));
        }
        if let Some(model) = layer.model {
            let place = origin.place(Some(model.span()));
            self.model = Some((model.into_inner(), place));
        }
        if let Some(beams) = layer.beams {
            let known =
                usize::try_from(*beams.get_ref()).ok().filter(|beams| line::grid::BEAMS.contains(beams));
            let known = known.ok_or_else(|| {
                let (least, most) = (line::grid::BEAMS.start(), line::grid::BEAMS.end());
                let what = format!("beams = {}", beams.get_ref());
                origin.refuse(Some(beams.span()), what, format!("a whole number from {least} to {most}"))
            })?;
            self.beams = Some((known, origin.place(Some(beams.span()))));
        }
        Ok(())
    }

    /// What it says; `refuse` makes the failure of a place, of what is said there and of the remedy.
    pub(super) fn finish(self, refuse: impl Fn(&str, String, &str) -> Failure) -> Result<Scanner, Failure> {
        let model = self.model.filter(|(name, _)| name != AUTO);
        match self.family.map_or(Family::Lms, |(family, _)| family) {
            Family::Lms => {
                if let Some((name, place)) = model {
                    let what = format!("model = \"{name}\", and an lms says itself what it is");
                    return Err(refuse(&place, what, "leave it out; `type` is what is expected of it"));
                }
                if let Some((beams, place)) = self.beams {
                    let what = format!("beams = {beams}, and an lms has its own");
                    return Err(refuse(&place, what, "leave it out; `angle` and `resolution` say how many"));
                }
                Ok(Scanner::Lms)
            }
            Family::Ld => {
                let beams = self.beams.map(|(beams, _)| beams);
                let Some((name, place)) = model else { return Ok(Scanner::Ld { model: None, beams }) };
                let known = ld::Model::named(&name).ok_or_else(|| {
                    let remedy = format!("auto, or one of: {}", names(ld::Model::ALL, ld::Model::name));
                    refuse(&place, format!("model = \"{name}\""), &remedy)
                })?;
                Ok(Scanner::Ld { model: Some(known), beams })
            }
        }
    }
}

fn names<T, const N: usize>(all: [T; N], name: impl Fn(T) -> &'static str) -> String {
    all.map(name).join(", ")
}

/// The model is found out.
const AUTO: &str = "auto";
