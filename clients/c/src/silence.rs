//! Reasons for a silence as numbers and texts for a C program, and the names that exist in a domain.

use std::ffi::c_int;

use scanhub_client::{DEFAULT_DOMAIN, Domain, Environment, Error, Silence, live_sensors, live_topics};

use crate::boundary::CallError;

/// Returns the number of a reason in the header, `SCANHUB_SILENCE_..`.
pub(crate) fn silence_number(silence: &Silence) -> c_int {
    match silence {
        Silence::Waiting => 0,
        Silence::NoHub { .. } => 1,
        Silence::OtherUser { .. } => 2,
        Silence::UnknownSensor { .. } => 3,
        Silence::UnknownTopic { .. } => 4,
        Silence::Absent { .. } => 5,
        Silence::Paused { .. } => 6,
        Silence::Full { .. } => 7,
        _ => 8,
    }
}

/// Returns the reason, and its remedy in a second line, like the message of an error.
pub(crate) fn silence_text(silence: &Silence) -> String {
    let remedy = silence.remedy();
    if remedy.is_empty() { silence.to_string() } else { format!("{silence}\n  {remedy}") }
}

/// Returns the names of the sensors in `domain`, or in the domain that the environment names, sorted.
pub(crate) fn sensors(domain: Option<&str>) -> Result<Vec<String>, CallError> {
    let mut sensors = live_sensors(&places(domain)?);
    sensors.sort();
    Ok(sensors)
}

/// Returns the topics of all sensors in `domain`, as [`sensors`] does.
pub(crate) fn topics(domain: Option<&str>) -> Result<Vec<String>, CallError> {
    Ok(live_topics(&places(domain)?))
}

fn places(domain: Option<&str>) -> Result<Vec<Domain>, CallError> {
    let from_environment = || std::env::var("SCANHUB_DOMAIN").unwrap_or_else(|_| DEFAULT_DOMAIN.to_owned());
    let name = domain.map_or_else(from_environment, str::to_owned);
    Ok(Domain::candidates(&name, None, &Environment::of_process()).map_err(Error::from)?)
}
