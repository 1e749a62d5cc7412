//! Which sensors and topics exist at this moment, for callers that want no failure and do not wait.

use schema::{Domain, Topic, ipc, publisher};

/// Returns the sensors of the hub at the first live one of `places`, for who wants no failure; never waits.
///
/// # Examples
///
/// ```
/// use scanhub_client::{live_sensors, places};
///
/// let places = places(Some("no-hub-is-here"))?;
/// assert!(live_sensors(&places).is_empty());
/// # Ok::<(), scanhub_client::Failure>(())
/// ```
pub fn live_sensors(places: &[Domain]) -> Vec<String> {
    let lives = |domain: &&Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    places.iter().find(lives).and_then(|domain| ipc::sensors(domain).ok()).unwrap_or_default()
}

/// Returns the topics of each of [`live_sensors`] as `SENSOR/TOPIC`.
pub fn live_topics(places: &[Domain]) -> Vec<String> {
    let of = |sensor: String| Topic::ALL.map(|topic| format!("{sensor}/{}", topic.name()));
    live_sensors(places).into_iter().flat_map(of).collect()
}
