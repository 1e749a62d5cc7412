//! The keys of section `limits`, and their valid values. A value is checked in its own source.

use schema::Failure;
use schema::limits::TopicLimits;
use serde::Deserialize;
use toml::Spanned;

use crate::origin::Origin;

/// Section `limits`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of limits, as { consumers = 32 }")]
pub(crate) struct LimitsLayer {
    consumers: Option<Spanned<i64>>,
}

impl LimitsLayer {
    /// Lays what it says over `limits`.
    pub(crate) fn lay(self, origin: &Origin, limits: &mut TopicLimits) -> Result<(), Failure> {
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
