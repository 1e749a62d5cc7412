//! The keys of section motion, and their valid values.

use schema::Failure;
use serde::Deserialize;
use toml::Spanned;

use super::processing::{put, within};
use crate::origin::Origin;

/// Section `motion`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of motion, as { max_step = 0.5, max_turn = 30.0 }")]
pub(super) struct MotionLayer {
    max_step: Option<Spanned<f64>>,
    max_turn: Option<Spanned<f64>>,
    min_overlap: Option<Spanned<f64>>,
}

impl MotionLayer {
    pub(super) fn lay(
        self,
        origin: &Origin,
        motion: &mut preprocess::motion::Settings,
    ) -> Result<(), Failure> {
        put(&mut motion.max_step_m, self.max_step, |value| {
            within(origin, "max_step", value, 0.01..=10.0, "metres from scan to scan, from 0.01 to 10")
        })?;
        put(&mut motion.max_turn_deg, self.max_turn, |value| {
            within(origin, "max_turn", value, 1.0..=85.0, "degrees from scan to scan, from 1 to 85")
        })?;
        put(&mut motion.min_overlap, self.min_overlap, |value| {
            within(origin, "min_overlap", value, 0.1..=1.0, "a share from 0.1 to 1")
        })
    }
}
