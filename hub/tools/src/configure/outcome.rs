//! The result of a change, in words: the sensor's settings and state now, above all after a failure.

use std::fmt;

use lms_configure::{Change, Failing, Outcome, OwnedConfiguration, Plan, Step};
use scanhub_drivers::lms::operating;
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
    /// What brings back what was changed, for the words alone.
    #[serde(skip)]
    back: Back,
}

/// The way back: settings of `configure`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Back {
    settings: Vec<String>,
    /// The former rate after power-on was overwritten, and nobody knows it.
    is_rate_lost: bool,
}

impl Back {
    /// From what `plan` changes; `was_permanent` as for the differences.
    fn of(plan: &Plan, was_permanent: Option<bool>) -> Back {
        let mut back = Back::default();
        if plan.new != plan.old {
            back.settings.push(format!("configuration={}", hex(plan.old.bytes())));
        }
        match (plan.power_on, was_permanent) {
            (None, _) => {}
            (Some(_), Some(false)) => back.settings.push("power_on_baud=9600".to_owned()),
            (Some(_), _) => back.is_rate_lost = true,
        }
        back
    }
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
            back: Back::default(),
        }
    }

    /// [`Kind::Failed`] with the state of the sensor if something failed. `was_permanent` as for the differences.
    pub(crate) fn of(
        port: &str,
        plan: &Plan,
        was_permanent: Option<bool>,
        outcome: &Outcome,
    ) -> Result<Configured, Failure> {
        if let Some((step, failing)) = outcome.failed {
            return Err(failure(port, plan, outcome, step, failing));
        }
        Ok(Configured {
            written: true,
            after: hex(outcome.configuration.as_ref().map_or(&[], OwnedConfiguration::bytes)),
            operating_mode: outcome.operating_mode.unwrap_or_default(),
            back: Back::of(plan, was_permanent),
            ..Configured::nothing(port, plan)
        })
    }
}

impl fmt::Display for Configured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Configured { port, back, .. } = self;
        if !self.written {
            return write!(f, "{port}: nothing to change, nothing was written");
        }
        let now = operating::name(self.operating_mode);
        write!(f, "{port}: written, read back and correct; now at: {now}")?;
        if self.operating_mode != self.found_mode {
            write!(f, "\n  it was found at: {}", operating::name(self.found_mode))?;
        }
        if !back.settings.is_empty() {
            write!(f, "\n  to go back: scanhub configure {port} {}", back.settings.join(" "))?;
        }
        if back.is_rate_lost {
            f.write_str(
                "\n  the earlier rate after power-on cannot be restored: the sensor did not report it",
            )?;
        }
        Ok(())
    }
}

fn failure(port: &str, plan: &Plan, outcome: &Outcome, step: Step, failing: Failing) -> Failure {
    let what = match (step, failing) {
        (Step::Enter, Failing::Refused) => "the sensor refuses the installation mode: wrong password?".into(),
        (Step::Compare, Failing::Differs) => {
            "its settings changed since you confirmed: is this another sensor?".into()
        }
        (_, Failing::Differs) => "the settings read back differ from those written".into(),
        (step, Failing::Refused) => format!("{}: the sensor refuses", words(step)),
        (step, Failing::Unanswered) => format!("{}: no answer", words(step)),
    };
    if step == Step::Compare {
        return Failure::new(Kind::Failed, format!("{port}: {what}"), "nothing was written");
    }
    let kept = match outcome.configuration {
        _ if !outcome.written => "nothing was written".into(),
        None => format!("the settings in the EEPROM are not known now; before: {}", hex(plan.old.bytes())),
        Some(kept) if kept == plan.old && plan.old != plan.new => {
            "the EEPROM has the old configuration".into()
        }
        Some(kept) if kept == plan.new => "the EEPROM has the new configuration".into(),
        Some(kept) => format!("the EEPROM has {}; before: {}", hex(kept.bytes()), hex(plan.old.bytes())),
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
        "whether it was written is not known: scanhub probe shows it"
    } else {
        "nothing was written"
    };
    let what = format!("{port}: {}: {}", words(change.step()), failure.message);
    Failure::new(failure.kind, what, format!("{kept}; {LOST}"))
}

/// What to do with a sensor whose mode is not known.
const LOST: &str = "it may be in installation mode: scanhub run leaves it, or power it off and on";
