//! Which sensors and topics exist at this moment, for callers that want no failure and do not wait.

use schema::{Domain, Topic, ipc, publisher};

/// The sensors of the hub at the first of `places` where one runs; empty if there is none; never waits.
pub fn live_sensors(places: &[Domain]) -> Vec<String> {
    let lives = |domain: &&Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    places.iter().find(lives).and_then(|domain| ipc::sensors(domain).ok()).unwrap_or_default()
}

/// As [`live_sensors`], the topics of each as `SENSOR/TOPIC`.
pub fn live_topics(places: &[Domain]) -> Vec<String> {
    let of = |sensor: String| Topic::ALL.map(|topic| format!("{sensor}/{}", topic.name()));
    live_sensors(places).into_iter().flat_map(of).collect()
}
