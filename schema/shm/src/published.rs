//! Lists of the sensors and topics that are published in a domain.

use iceoryx2::prelude::CallbackProgression;
use iceoryx2::prelude::ipc::Service;
use iceoryx2::service::Service as _;
use scanhub_schema::{Failure, Maker, Topic, of_service};

use crate::domain::Domain;
use crate::node::config;
use crate::segments::access_failure;

/// Returns the sensors that have topics in `domain`, sorted. Those of a dead hub stay as long as a subscriber keeps
/// them.
///
/// # Errors
///
/// Returns [`Kind::Failed`](scanhub_schema::Kind) with owner, mode and remedy if the directory belongs to another user.
pub fn sensors(domain: &Domain) -> Result<Vec<String>, Failure> {
    let mut sensors: Vec<String> = published(domain)?.into_iter().map(|(sensor, _)| sensor).collect();
    sensors.dedup();
    Ok(sensors)
}

/// Returns those of [`sensors`] that have a link, here or on another machine. A tracker has none.
///
/// # Errors
///
/// Returns the errors of [`sensors`].
pub fn links(domain: &Domain) -> Result<Vec<String>, Failure> {
    let of_links = published(domain)?.into_iter().filter(|(_, topic)| topic.maker() == Maker::Link);
    let mut links: Vec<String> = of_links.map(|(sensor, _)| sensor).collect();
    links.dedup();
    Ok(links)
}

/// Returns the sensors that have zones in `domain`, sorted. A robot's combined verdict is computed from them.
///
/// # Errors
///
/// Returns the errors of [`sensors`].
pub fn sensors_with_zones(domain: &Domain) -> Result<Vec<String>, Failure> {
    let with_zones = published(domain)?.into_iter().filter(|(_, topic)| *topic == Topic::Zones);
    Ok(with_zones.map(|(sensor, _)| sensor).collect())
}

/// Returns all topics in `domain` with their sensors, sorted by sensor.
///
/// # Errors
///
/// Returns the errors of [`sensors`].
pub fn published(domain: &Domain) -> Result<Vec<(String, Topic)>, Failure> {
    let mut topics = Vec::new();
    let Some(config) = config(domain.root())? else { return Ok(topics) };
    let listed = Service::list(&config, |service| {
        if let Some((sensor, Some(topic))) = of_service(service.static_details.name().as_str()) {
            topics.push((sensor.to_owned(), topic));
        }
        CallbackProgression::Continue
    });
    listed.map_err(|error| access_failure(domain.root(), format!("cannot list topics: {error:?}")))?;
    topics.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(topics)
}
