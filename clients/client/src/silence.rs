//! Reasons why a subscriber receives no samples, with remedies.

use std::fmt;

use scanhub_schema::{Failure, Kind, Printable, PublisherKind, State, Status, Topic};
use scanhub_shm::{Domain, Node, Payload, PortFactory, ThreadSafeService};

use crate::error::Error;
use crate::hub_finder::DomainHolder;
use crate::session::Session;
use crate::topic_reader::TopicReader;

/// Reason why a subscriber receives no samples. `Display` writes one line; [`Silence::remedy`] returns the remedy for
/// the user.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Silence {
    /// No hub runs in the domain.
    #[non_exhaustive]
    NoHub {
        /// The domain, and the reason if its directory cannot be opened.
        message: String,
        /// The command that starts a hub, and the hubs in other domains.
        remedy: String,
    },
    /// Only another user runs a hub in the domain.
    #[non_exhaustive]
    OtherUser {
        /// The domain, and the reason if its directory cannot be opened.
        message: String,
        /// The user who runs the hub, and how to get its data.
        remedy: String,
    },
    /// The hub has no such sensor.
    #[non_exhaustive]
    UnknownSensor {
        /// Name of the sensor to which the program has subscribed. Empty if the program subscribes to all sensors with
        /// zones, and the hub has none.
        sensor: String,
        /// Names of the sensors that exist.
        sensors: Vec<String>,
    },
    /// The hub has the sensor, but does not publish the topic.
    #[non_exhaustive]
    UnknownTopic {
        /// The sensor and the topic, as `front/marks`.
        topic: String,
        /// Names of the topics of the sensor.
        topics: Vec<String>,
    },
    /// The scanner sends no data.
    #[non_exhaustive]
    Absent {
        /// Name of the sensor.
        sensor: String,
        /// State of its link, other than [`State::Paused`] and [`State::Streaming`].
        state: State,
        /// Last error of the link; may be empty.
        error: String,
    },
    /// The link is paused on request.
    #[non_exhaustive]
    Paused {
        /// Name of the sensor.
        sensor: String,
    },
    /// No slot, memory or descriptor was left for the subscriber.
    #[non_exhaustive]
    Full {
        /// Message that names the exhausted resource.
        message: String,
        /// Ways to get a slot, memory or a descriptor.
        remedy: String,
    },
    /// No problem is known: the next sample has not been sent yet, the hub is starting, or its status has not arrived
    /// yet.
    Waiting,
}

impl Silence {
    /// Returns the reason if the hub is missing, or if memory or descriptors are too short to find it.
    pub(crate) fn of_hub(session: &mut Session) -> Option<Silence> {
        match session.check_hub() {
            Err(error) => Some(Silence::of_shortage(&error)),
            Ok(_) => session.domain().is_none().then(|| session.silence_reason()),
        }
    }

    fn of_shortage(error: &Error) -> Silence {
        Silence::Full { message: error.message(), remedy: error.remedy() }
    }

    /// Returns the reason that the status of a sensor shows.
    pub(crate) fn of_status(sensor: &str, status: &Status) -> Silence {
        let sensor = sensor.to_owned();
        match status.state() {
            None | Some(State::Streaming) => Silence::Waiting,
            Some(State::Paused) => Silence::Paused { sensor },
            Some(state) => {
                let error = Printable(status.last_error()).to_string();
                Silence::Absent { sensor, state, error }
            }
        }
    }

    /// Returns the reason if the topic does not exist; `None` if it does. `published` has all topics that the hub
    /// publishes, each with its sensor.
    pub(crate) fn of_topics(sensor: &str, topic: Topic, published: &[(String, Topic)]) -> Option<Silence> {
        let sensors = names(published);
        if !sensors.iter().any(|known| known == sensor) {
            return Some(Silence::UnknownSensor { sensor: sensor.to_owned(), sensors });
        }
        let of_sensor = published.iter().filter(|(known, _)| known == sensor).map(|(_, topic)| *topic);
        let topics: Vec<Topic> = of_sensor.collect();
        (!topics.contains(&topic)).then(|| Silence::UnknownTopic {
            topic: format!("{sensor}/{}", topic.name()),
            topics: topics.iter().map(|topic| topic.name().to_owned()).collect(),
        })
    }

    /// Returns the reason for a robot that subscribes to all sensors and has found none.
    pub(crate) fn of_all_sensors(session: &Session) -> Silence {
        // Only a hub has a complete list. A listener publishes each sensor as soon as another machine sends it.
        let is_complete = session.domain_holder() == Some(DomainHolder::Hub) && !session.hub_is_starting();
        let Some(domain) = session.domain().filter(|_| is_complete) else { return Silence::Waiting };
        match scanhub_shm::published_topics(domain) {
            Ok(published) if published.iter().any(|(_, topic)| *topic == Topic::Zones) => Silence::Waiting,
            Ok(published) => Silence::UnknownSensor { sensor: String::new(), sensors: names(&published) },
            Err(failure) => Silence::of_shortage(&failure.into()),
        }
    }

    /// Returns the remedy for the user. Empty for [`Silence::Waiting`].
    pub fn remedy(&self) -> String {
        match self {
            Silence::NoHub { remedy, .. }
            | Silence::OtherUser { remedy, .. }
            | Silence::Full { remedy, .. } => Printable(remedy).to_string(),
            Silence::UnknownSensor { sensors, .. } if sensors.is_empty() => {
                "the hub has no sensors: scanhub run --link NAME=PORT adds one".to_owned()
            }
            Silence::UnknownSensor { sensors, .. } => format!("the sensors are {}", sensors.join(", ")),
            Silence::UnknownTopic { topics, .. } => {
                format!("the topics are {}; docs/configuration.md explains the others", topics.join(", "))
            }
            Silence::Absent { sensor, .. } => {
                format!("`scanhub info {sensor}` shows the link; check cable, port and power of the scanner")
            }
            Silence::Paused { sensor } => format!("scanhub control {sensor} resume"),
            Silence::Waiting => String::new(),
        }
    }
}

impl fmt::Display for Silence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Silence::NoHub { message, .. }
            | Silence::OtherUser { message, .. }
            | Silence::Full { message, .. } => {
                write!(f, "{}", Printable(message))
            }
            Silence::UnknownSensor { sensor, .. } if sensor.is_empty() => {
                write!(f, "the hub has no sensor with zones")
            }
            Silence::UnknownSensor { sensor, .. } => write!(f, "the hub has no sensor {sensor}"),
            Silence::UnknownTopic { topic, .. } => write!(f, "the hub does not publish {topic}"),
            Silence::Absent { sensor, state, error } => {
                write!(f, "the scanner of {sensor} sends no data: {}", state.name())?;
                if error.is_empty() { Ok(()) } else { write!(f, ", {error}") }
            }
            Silence::Paused { sensor } => write!(f, "{sensor} is paused"),
            Silence::Waiting => write!(f, "no sample has been sent yet"),
        }
    }
}

/// Check for the reason why a sensor's topic is silent. From the first call of [`reason`](Self::reason) on, the check
/// subscribes to the sensor's status.
#[derive(Default)]
pub(crate) struct SilenceCheck {
    status: Option<Box<SensorStatus>>,
}

/// Subscription to the status of the sensor.
struct SensorStatus {
    reader: TopicReader<Status>,
    last: Option<Status>,
    /// Value of [`Session::start_count`] when the subscription was created. A later start means that another hub
    /// publishes the status.
    start_count: u32,
}

impl SilenceCheck {
    /// Returns why `reader` receives nothing. Never waits.
    pub(crate) fn reason<P: Payload + ?Sized>(
        &mut self,
        session: &mut Session,
        reader: &TopicReader<P>,
    ) -> Silence {
        if let Some(reason) = Silence::of_hub(session) {
            self.status = None;
            return reason;
        }
        if let Some(error) = reader.refused() {
            return Silence::of_shortage(error);
        }
        let Some(domain) = session.domain() else { return Silence::Waiting };
        let (sensor, topic) = (reader.sensor(), <P as Payload>::TOPIC);
        // Check the start before the topics, because a hub that is no longer starting has all of its topics.
        let is_starting = session.hub_is_starting();
        // If the next hub lacks the topic, the ports of subscribers still keep the topic open, so check for a
        // publisher.
        let is_served = match session.node().map(|node| has_publisher(node, sensor, topic)) {
            Some(Ok(is_served)) => is_served,
            Some(Err(failure)) => return Silence::of_shortage(&failure.into()),
            None => false,
        };
        if !reader.is_attached(session) || !is_served {
            self.status = None;
            if is_starting || is_served {
                return Silence::Waiting;
            }
            return match published(session, domain, sensor) {
                Ok(published) => Silence::of_topics(sensor, topic, &published).unwrap_or(Silence::Waiting),
                Err(failure) => Silence::of_shortage(&failure.into()),
            };
        }
        if topic.publisher_kind() != PublisherKind::Link {
            return Silence::Waiting;
        }
        let starts = session.start_count();
        self.status.take_if(|status| status.start_count != starts);
        let status = self.status.get_or_insert_with(|| {
            Box::new(SensorStatus { reader: TopicReader::new(sensor), last: None, start_count: starts })
        });
        // Only the status shows the state of the sensor.
        while let Ok(Some(received)) = status.reader.receive_quietly(session) {
            status.last = Some(*received);
        }
        status.last.as_ref().map_or(Silence::Waiting, |status| Silence::of_status(sensor, status))
    }
}

/// Returns the topics in `domain`, without those of `sensor` that only subscribers keep open. Fails if the directory
/// belongs to another user, or with [`Kind::ResourceExhausted`] if memory or descriptors are short.
fn published(session: &Session, domain: &Domain, sensor: &str) -> Result<Vec<(String, Topic)>, Failure> {
    let mut published = Vec::new();
    for (name, topic) in scanhub_shm::published_topics(domain)? {
        let is_served = match session.node().filter(|_| name == sensor) {
            Some(node) => has_publisher(node, &name, topic)?,
            None => true,
        };
        published.extend(is_served.then_some((name, topic)));
    }
    Ok(published)
}

/// Returns the names of the sensors, sorted.
fn names(published: &[(String, Topic)]) -> Vec<String> {
    let mut sensors: Vec<String> = published.iter().map(|(sensor, _)| sensor.clone()).collect();
    sensors.sort();
    sensors.dedup();
    sensors
}

macro_rules! has_publisher {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Returns whether any program publishes the `topic` of `sensor`. A topic with another layout counts, too.
        /// Fails with [`Kind::ResourceExhausted`] if memory or descriptors are short.
        fn has_publisher(node: &Node<ThreadSafeService>, sensor: &str, topic: Topic) -> Result<bool, Failure> {
            let publishers = match topic {
                $(Topic::$topic => <scanhub_schema::payload_type!($payload)>::open(node, sensor)
                    .map(|service| service.map(|service| service.dynamic_config().number_of_publishers())),)*
            };
            match publishers {
                Ok(publishers) => Ok(publishers.is_some_and(|publishers| publishers > 0)),
                Err(failure) if failure.kind == Kind::ResourceExhausted => Err(failure),
                Err(_) => Ok(true),
            }
        }
    };
}

scanhub_schema::for_each_topic!(has_publisher);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_gives_the_reason_for_a_silence() {
        let of = |state: State, error: &str| {
            let mut status = Status { state: state as u8, ..Status::default() };
            status.set_last_error(error);
            Silence::of_status("front", &status)
        };
        assert_eq!(of(State::Streaming, "old"), Silence::Waiting);
        assert_eq!(of(State::Paused, ""), Silence::Paused { sensor: "front".into() });
        let absent = of(State::Absent, "no such port");
        assert_eq!(absent.to_string(), "the scanner of front sends no data: absent, no such port");
        assert!(absent.remedy().contains("scanhub info front"), "{}", absent.remedy());
        assert_eq!(of(State::Silent, "").to_string(), "the scanner of front sends no data: silent");
    }

    #[test]
    fn remedy_lists_available_sensors_and_topics() {
        let published = |names: &[(&str, Topic)]| {
            names.iter().map(|(sensor, topic)| ((*sensor).to_owned(), *topic)).collect::<Vec<_>>()
        };
        let hub = published(&[("rear", Topic::Scan), ("front", Topic::Scan), ("front", Topic::Status)]);
        let of = |sensor, topic| Silence::of_topics(sensor, topic, &hub);
        assert_eq!(of("front", Topic::Scan), None);
        let unknown = of("frnot", Topic::Scan).expect("there is no such sensor");
        assert_eq!(unknown.to_string(), "the hub has no sensor frnot");
        assert_eq!(unknown.remedy(), "the sensors are front, rear");
        let unknown = of("front", Topic::Marks).expect("there is no such topic");
        assert_eq!(unknown.to_string(), "the hub does not publish front/marks");
        assert!(unknown.remedy().starts_with("the topics are scan, status"), "{}", unknown.remedy());
        let empty = Silence::of_topics("front", Topic::Scan, &[]).expect("there is nothing");
        assert!(empty.remedy().contains("scanhub run --link"), "{}", empty.remedy());
        assert_eq!(Silence::Waiting.remedy(), "");
    }
}
