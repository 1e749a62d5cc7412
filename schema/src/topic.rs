//! The names of topics, their services and sensors. Refuses to know how a service is created.

mod maker;
mod table;

use crate::limits::TopicLimits;
use crate::{Failure, Kind};

pub use maker::Maker;
pub use table::{Pace, Ring, Row, Topic};

impl Topic {
    /// What a hub publishes of each link.
    pub const OF_LINKS: [Topic; 10] = [
        Topic::Telegram,
        Topic::Scan,
        Topic::Marks,
        Topic::Zones,
        Topic::Foreground,
        Topic::Background,
        Topic::Status,
        Topic::Lines,
        Topic::Motion,
        Topic::Early,
    ];

    /// Returns what the table says of the topic.
    pub const fn row(self) -> &'static Row {
        &table::ROWS[self as usize]
    }

    /// Returns the topic's name, as in `front/scan`.
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// Returns the topic called `name`.
    ///
    /// # Examples
    ///
    /// ```
    /// use schema::Topic;
    ///
    /// assert_eq!(Topic::parse("scan"), Some(Topic::Scan));
    /// assert_eq!(Topic::Scan.service("front"), "scanhub/v2/front/scan");
    /// ```
    pub fn parse(name: &str) -> Option<Topic> {
        Topic::ALL.into_iter().find(|topic| topic.name() == name)
    }

    /// Returns the topic's number on a network: from 1.
    pub fn number(self) -> u8 {
        self as u8 + 1
    }

    /// Returns the topic with this number.
    pub fn of_number(number: u8) -> Option<Topic> {
        Topic::ALL.into_iter().find(|topic| topic.number() == number)
    }

    /// Returns the payload's type, the same in all languages.
    pub fn payload(self) -> &'static str {
        self.row().payload
    }

    /// Returns the bytes of the longest payload where the topic is made as `limits` say.
    pub fn longest(self, limits: &TopicLimits) -> usize {
        (self.row().longest)(limits)
    }

    /// Returns the payload's revision: a greater one only appends.
    pub fn revision(self) -> u32 {
        1
    }

    /// Returns the name of the topic's service for `sensor`.
    pub fn service(self, sensor: &str) -> String {
        service(sensor, self.name())
    }
}

/// Name of the service that takes requests for the hub's links.
pub const CONTROL: &str = "scanhub/v2/control";
/// Name of the event that wakes the hub for a request.
pub const CONTROL_REQUEST: &str = "scanhub/v2/control/request";
/// Name of the event that wakes clients for a response.
pub const CONTROL_RESPONSE: &str = "scanhub/v2/control/response";

/// Name of the service that wakes the consumers of a sensor, beside its topics.
pub const WAKE: &str = "wake";

/// Why consumers are woken: the event's id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Wake {
    /// All samples of a telegram are sent.
    Telegram = 1,
    /// The status changed, or something else was published without a telegram: zones that became unknown, a new background.
    Status = 2,
    /// The hub is up; sent automatically when the notifier is created.
    HubUp = 3,
    /// The hub is down; sent automatically when the notifier is dropped or its process is found dead.
    HubDown = 4,
    /// A telegram that is not complete is a warning.
    Early = 5,
}

impl Wake {
    /// Returns the name of the wake service of `sensor`.
    pub fn service(sensor: &str) -> String {
        service(sensor, WAKE)
    }
}

/// Returns the sensor and topic that a service's name stands for, if it is one of ours: the other direction of
/// [`Topic::service`]; the wake service has no topic.
pub fn of_service(name: &str) -> Option<(&str, Option<Topic>)> {
    let (sensor, topic) = name.strip_prefix("scanhub/v2/")?.split_once('/')?;
    if topic == WAKE { Some((sensor, None)) } else { Some((sensor, Some(Topic::parse(topic)?))) }
}

/// Means all sensors of a hub, wherever a sensor's name is expected; so it cannot be a sensor's name.
pub const ROBOT: &str = "robot";

/// Refuses a sensor's name that is not `[a-z0-9_-]`, 1 to 24 of them, or [`ROBOT`].
///
/// # Errors
///
/// [`Kind::Configuration`] with an example.
pub fn check_sensor(name: &str) -> Result<(), Failure> {
    if name == ROBOT {
        let what = format!("sensor name {ROBOT:?} is not possible: it stands for all sensors");
        return Err(Failure::new(Kind::Configuration, what, "any other name, for example front"));
    }
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == '-';
    if (1..=24).contains(&name.len()) && name.chars().all(allowed) {
        return Ok(());
    }
    Err(Failure::new(
        Kind::Configuration,
        format!("sensor name {name:?} is not possible"),
        "1 to 24 of a-z, 0-9, _ and -, for example front",
    ))
}

/// Refuses what no consumer can follow: neither a sensor's name nor that of a remote one, `HUB.SENSOR`, of which each
/// half is as a sensor's name: [`Kind::Configuration`].
///
/// # Errors
///
/// [`Kind::Configuration`] with an example.
pub fn check_followed(name: &str) -> Result<(), Failure> {
    match name.split_once('.') {
        Some((hub, sensor)) => check_sensor(hub).and_then(|()| check_sensor(sensor)),
        None => check_sensor(name),
    }
}

/// Returns whether the sensor is another machine's; a listener brings its topics here.
pub fn is_remote(sensor: &str) -> bool {
    sensor.contains('.')
}

fn service(sensor: &str, topic: &str) -> String {
    format!("scanhub/v2/{sensor}/{topic}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn service_names_go_there_and_back() {
        assert_eq!(Topic::Scan.service("front"), "scanhub/v2/front/scan");
        for topic in Topic::ALL {
            assert_eq!(of_service(&topic.service("rear")), Some(("rear", Some(topic))));
            assert_eq!(Topic::parse(topic.name()), Some(topic));
            assert_eq!(Topic::of_number(topic.number()), Some(topic));
        }
        assert_eq!(of_service(&Wake::service("rear")), Some(("rear", None)));
        assert_eq!(of_service("scanhub/v1/rear/scan"), None);
        for control in [CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE] {
            assert_eq!(of_service(control), None);
        }
    }

    #[test]
    fn names_of_sensors() {
        assert!(check_sensor("front_2-b").is_ok());
        for bad in ["", "Front", "a/b", "a b", "ä", ROBOT, &"a".repeat(25)] {
            assert_eq!(check_sensor(bad).map_err(|failure| failure.kind), Err(Kind::Configuration), "{bad}");
            assert!(check_followed(bad).is_err() && check_followed(&format!("hub.{bad}")).is_err(), "{bad}");
        }
        assert!(check_sensor("hub.front").is_err() && check_followed("00ab.front").is_ok());
        assert!(check_followed("front").is_ok() && check_followed("a.b.c").is_err());
        assert!(is_remote("hub.front") && !is_remote("front"));
    }
}
