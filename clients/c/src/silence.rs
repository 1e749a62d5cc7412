//! Reasons for a silence as numbers and texts for a C program, and the names that exist in a domain.

use std::ffi::c_int;

use scanhub_client::{Silence, domain_candidates, live_sensors, live_topics};

use crate::ffi::CallError;

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

/// Returns the reason. If the silence has a remedy, it follows on a second line, as in the message of an error.
pub(crate) fn silence_text(silence: &Silence) -> String {
    let remedy = silence.remedy();
    if remedy.is_empty() { silence.to_string() } else { format!("{silence}\n  {remedy}") }
}

/// Returns the names of the sensors in `domain`, or in the domain that the environment names, sorted.
pub(crate) fn sensors(domain: Option<&str>) -> Result<Vec<String>, CallError> {
    let mut sensors = live_sensors(&domain_candidates(domain, None)?);
    sensors.sort();
    Ok(sensors)
}

/// Returns the topics of all sensors in `domain`, as [`sensors`] does.
pub(crate) fn topics(domain: Option<&str>) -> Result<Vec<String>, CallError> {
    Ok(live_topics(&domain_candidates(domain, None)?))
}
