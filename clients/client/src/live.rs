//! Which sensors and topics exist at this moment, for callers that want no failure and do not wait.

use scanhub_schema::Failure;
use scanhub_shm::{Domain, publisher};

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
    live(places, scanhub_shm::sensors)
}

/// Returns the topics of each of [`live_sensors`] as `SENSOR/TOPIC`.
pub fn live_topics(places: &[Domain]) -> Vec<String> {
    let mut topics = live(places, scanhub_shm::published);
    topics.sort();
    topics.into_iter().map(|(sensor, topic)| format!("{sensor}/{}", topic.name())).collect()
}

fn live<T>(places: &[Domain], of: impl Fn(&Domain) -> Result<Vec<T>, Failure>) -> Vec<T> {
    let lives = |domain: &&Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    places.iter().find(lives).and_then(|domain| of(domain).ok()).unwrap_or_default()
}
