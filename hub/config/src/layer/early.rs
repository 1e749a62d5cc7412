//! The keys of section early, and their valid values.

use schema::{Failure, Family};
use serde::Deserialize;
use toml::Spanned;

use super::processing::{put, whole};
use crate::origin::Origin;
use crate::processing::Early;

/// Section `early`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of early, as { pieces = 2 }")]
pub(super) struct EarlyLayer {
    pieces: Option<Spanned<i64>>,
}

impl EarlyLayer {
    pub(super) fn lay(self, origin: &Origin, early: &mut Early) -> Result<(), Failure> {
        put(&mut early.pieces, self.pieces, |value| whole(origin, "pieces", value, 2..=8))
    }

    /// [`Kind::Configuration`](schema::Kind::Configuration) if it is said for a scanner of a `family` whose packets are pieces already.
    pub(super) fn check_family(&self, origin: &Origin, family: Family) -> Result<(), Failure> {
        let foreign = self.pieces.as_ref().filter(|_| family != Family::Lms);
        foreign.map_or(Ok(()), |pieces| {
            let what = format!("pieces, and an {} sends packets, which are short", family.name());
            Err(origin.refuse(Some(pieces.span()), what, "it warns by each packet anyway"))
        })
    }
}
