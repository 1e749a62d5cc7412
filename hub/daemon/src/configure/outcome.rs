//! What became of a change, in words: what the sensor keeps now and what it does now, above all when something failed.

use std::fmt;

use lms::change::{Change, Failing, Kept, Outcome, Plan, Step};
use lms::operating;
use schema::{Failure, Kind};
use serde::Serialize;

use super::words;
use crate::probe::hex;

/// A change that went well, or none; class `configured`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Configured {
    class: &'static str,
    port: String,
    /// Whether anything was written.
    written: bool,
    /// The configuration as it was, in hex.
    before: String,
    /// As it was read back.
    after: String,
    /// The operating mode in which the sensor is now, and in which it was found.
    operating_mode: u8,
    found_mode: u8,
}

impl Configured {
    /// There was nothing to change.
    pub(crate) fn nothing(port: &str, plan: &Plan) -> Configured {
        Configured {
            class: "configured",
            port: port.to_owned(),
            written: false,
            before: hex(plan.old.bytes()),
            after: hex(plan.old.bytes()),
            operating_mode: plan.operating_mode,
            found_mode: plan.operating_mode,
        }
    }

    /// [`Kind::Failed`] with the state of the sensor if something failed.
    pub(crate) fn of(port: &str, plan: &Plan, outcome: &Outcome) -> Result<Configured, Failure> {
        if let Some((step, failing)) = outcome.failed {
            return Err(failure(port, plan, outcome, step, failing));
        }
        Ok(Configured {
            written: true,
            after: hex(outcome.configuration.as_ref().map_or(&[], Kept::bytes)),
            operating_mode: outcome.operating_mode.unwrap_or_default(),
            ..Configured::nothing(port, plan)
        })
    }
}

impl fmt::Display for Configured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Configured { port, before, .. } = self;
        if !self.written {
            return write!(f, "{port}: nothing to change, nothing was written");
        }
        let now = operating::name(self.operating_mode);
        writeln!(f, "{port}: written, read back, and as it should be; now at: {now}")?;
        if self.operating_mode != self.found_mode {
            writeln!(f, "  it was found at: {}", operating::name(self.found_mode))?;
        }
        write!(f, "  to go back: scanhub configure {port} configuration={before}")
    }
}

fn failure(port: &str, plan: &Plan, outcome: &Outcome, step: Step, failing: Failing) -> Failure {
    let what = match (step, failing) {
        (Step::Enter, Failing::Refused) => "the sensor refuses the installation mode: wrong password?".into(),
        (Step::Compare, Failing::Differs) => {
            "it does not keep what it did when it was asked: is this another sensor?".into()
        }
        (_, Failing::Differs) => "what was read back is not what was to be written".into(),
        (step, Failing::Refused) => format!("{}: the sensor refuses", words(step)),
        (step, Failing::Unanswered) => format!("{}: no answer", words(step)),
    };
    if step == Step::Compare {
        return Failure::new(Kind::Failed, format!("{port}: {what}"), "nothing was written");
    }
    let kept = match outcome.configuration {
        _ if !outcome.written => "nothing was written".into(),
        None => format!("what it keeps now is not known; before it was {}", hex(plan.old.bytes())),
        Some(kept) if kept == plan.old && plan.old != plan.new => "it keeps the old configuration".into(),
        Some(kept) if kept == plan.new => "it keeps the new configuration".into(),
        Some(kept) => format!("it keeps {}, before it was {}", hex(kept.bytes()), hex(plan.old.bytes())),
    };
    let mode = match outcome.operating_mode {
        Some(mode) => format!("it is at: {}", operating::name(mode)),
        None => LOST.to_owned(),
    };
    Failure::new(Kind::Failed, format!("{port}: {what}"), format!("{kept}; {mode}"))
}

/// The port failed before anything was said.
pub(crate) fn untouched(port: &str, error: &std::io::Error) -> Failure {
    Failure::new(Kind::PortMissing, format!("{port}: {error}"), "nothing was written")
}

/// The port went away in the middle of `change`.
pub(crate) fn gone(port: &str, change: &Change, failure: &Failure) -> Failure {
    let kept = if change.outcome().written {
        "whether it was written is not known: scanhub probe tells"
    } else {
        "nothing was written"
    };
    let what = format!("{port}: {}: {}", words(change.step()), failure.message);
    Failure::new(failure.kind, what, format!("{kept}; {LOST}"))
}

/// What to do with a sensor whose mode is not known.
const LOST: &str = "it may be in installation mode: scanhub run leaves it, or power it off and on";
