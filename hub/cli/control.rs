//! `scanhub control` on the command line.

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use scanhub_schema::{Failure, Verb};
use scanhub_verbs::ControlOptions;

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Control {
    /// The sensor
    sensor: String,
    /// pause: stop the sensor; resume: stream again; resync: restart the session with the sensor
    #[arg(value_parser = verbs())]
    verb: Verb,
}

impl Control {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<ControlOptions, Failure> {
        Ok(ControlOptions {
            sensor: self.sensor.clone(),
            verb: self.verb,
            json: everywhere.json,
            places: everywhere.places()?,
        })
    }
}

fn verbs() -> impl TypedValueParser<Value = Verb> {
    PossibleValuesParser::new(Verb::FLOW.map(Verb::name))
        .try_map(|word| Verb::parse(&word).ok_or("not a request"))
}
