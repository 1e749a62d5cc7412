//! `scanhub control`: requests the hub to pause a sensor, to resume its stream, or to restart its session. The verb
//! ends when the link has accepted the request; `info` shows the progress.

use std::io::Write;

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use scanhub_client::request;
use scanhub_schema::{Failure, Request, Verb, check_sensor};

use crate::context::Context;
use crate::json;
use crate::names::as_argument;
use crate::output::{Output, verb_result};

/// Pause a sensor, resume it, or restart its session
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub control front pause")]
pub struct ControlArgs {
    /// The sensor
    sensor: String,
    /// pause: stop the scans of the sensor. resume: continue the scans. resync: restart the session with the scanner
    #[arg(value_parser = verbs())]
    verb: Verb,
}

fn verbs() -> impl TypedValueParser<Value = Verb> {
    PossibleValuesParser::new(Verb::FLOW.map(Verb::name))
        .try_map(|word| Verb::parse(&word).ok_or("not a request"))
}

impl ControlArgs {
    /// Sends the request to the hub, waits until the link has accepted it, and writes a line to stdout.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`request`], and [`Kind::Usage`](scanhub_schema::Kind) if the sensor's name is not valid.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        as_argument(check_sensor(&self.sensor))?;
        request(&locations, &Request::new(&self.sensor, self.verb), &stop)?;
        confirm(&mut Output::new(&mut context.out), context.json, &self.sensor, self.verb)
    }
}

/// Writes the line that confirms an accepted request.
pub(crate) fn confirm(output: &mut Output<'_>, json: bool, sensor: &str, verb: Verb) -> Result<(), Failure> {
    verb_result(if json {
        output.json(&json::control(sensor, verb))
    } else {
        output.line(|line| write!(line, "{sensor}: {}", past_form(verb)))
    })
}

/// Returns the past tense of `verb`.
fn past_form(verb: Verb) -> &'static str {
    match verb {
        Verb::Pause => "paused",
        Verb::Resume => "resumed",
        Verb::Resync => "session restarted",
        Verb::Show => "background shown",
        Verb::Reset => "background reset",
        Verb::Freeze => "background frozen",
        Verb::Thaw => "background learning resumed",
        Verb::Load => "background loaded",
    }
}
