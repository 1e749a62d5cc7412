//! The topics: their table, and the names of topics, services and sensors.
//!
//! One row of the table has everything that differs between topics. All code for each topic, here and in other crates,
//! is generated from this table, so a new topic is a new row.

use bytemuck::Pod;

use crate::limits::TopicLimits;
use crate::{Failure, Kind};

/// The table of topics. Calls the macro `$each` with rows of the table. Without a prefix, `$each` gets the rows of all
/// topics. With `links:`, `$each` gets only the rows of the topics that a hub publishes for each link. With `makers:`,
/// `$each` gets all rows in groups `MAKER { .. }`, one group for each [`PublisherKind`].
///
/// A row is `VARIANT PAYLOAD, name, number, type, group, rate, word, queue, history: description;`. Its columns are the
/// fields of [`TopicSpec`], in the same order. A payload other than `[u8]` is a type of this crate.
///
/// # Examples
///
/// ```
/// macro_rules! names {
///     ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $description:literal;)*) => {
///         [$(stringify!($name)),*]
///     };
/// }
/// let names = scanhub_schema::for_each_topic!(names);
/// assert_eq!((names[1], names[names.len() - 1]), ("scan", "obstacles"));
/// let names = scanhub_schema::for_each_topic!(links: names);
/// assert_eq!((names[1], names[names.len() - 1]), ("scan", "early"));
/// ```
#[macro_export]
macro_rules! for_each_topic {
    (@rows $($to:tt)*) => {
        $crate::for_each_topic! { $($to)*
            Link {
                Telegram [u8], telegram, 1, "u8[]", 83, Scan, First, 64, 0:
                    "Bytes of telegrams, including replies.";
                Scan Scan, scan, 2, "scanhub.Scan.v2", 82, Scan, First, 64, 0:
                    "Decoded measurements.";
                Marks Marks, marks, 3, "scanhub.Marks.v2", 81, Scan, Last, 16, 0:
                    "Reflector marks.";
                Zones Zones, zones, 4, "scanhub.Zones.v2", 81, Scan, First, 16, 1:
                    "Verdicts about zones around the robot.";
                Foreground Foreground, foreground, 5, "scanhub.Foreground.v2", 81, Scan, Last, 16, 0:
                    "Beams in front of the background.";
                Background Background, background, 6, "scanhub.Background.v2", 82, Change, Last, 4, 1:
                    "The background model.";
                Status Status, status, 7, "scanhub.Status.v2", 80, Second, Last, 4, 1:
                    "State, properties and counters of the link.";
                Lines Lines, lines, 8, "scanhub.Lines.v2", 81, Scan, Last, 16, 0:
                    "Straight lines and their corners.";
                Motion Motion, motion, 9, "scanhub.Motion.v2", 81, Scan, Last, 16, 0:
                    "Motion of the robot since the previous scan.";
                Early Early, early, 10, "scanhub.Early.v2", 81, Change, Early, 16, 0:
                    "Early warnings from partial telegrams.";
            }
            Tracker {
                Tracks Tracks, tracks, 11, "scanhub.Tracks.v2", 81, Scan, Last, 16, 0:
                    "Positions of people, from a tracker.";
                Events Event, events, 12, "scanhub.Event.v2", 81, Change, Last, 64, 0:
                    "Events of people, from a tracker.";
            }
            Mount {
                Tilt Tilt, tilt, 13, "scanhub.Tilt.v2", 81, Scan, Last, 64, 0:
                    "The angle of a mount.";
            }
            Tilted {
                Cloud Cloud, cloud, 14, "scanhub.Cloud.v2", 82, Change, Last, 128, 0:
                    "Points in three dimensions.";
                Obstacles Obstacles, obstacles, 15, "scanhub.Obstacles.v2", 81, Change, Last, 16, 0:
                    "Obstacles in three dimensions.";
            }
        }
    };
    (@all $each:ident $($maker:ident { $($rows:tt)* })*) => {
        $each! { $($($rows)*)* }
    };
    (@links $each:ident Link { $($rows:tt)* } $($rest:tt)*) => {
        $each! { $($rows)* }
    };
    (@makers $each:ident $($groups:tt)*) => {
        $each! { $($groups)* }
    };
    ($each:ident) => {
        $crate::for_each_topic! { @rows @all $each }
    };
    (links: $each:ident) => {
        $crate::for_each_topic! { @rows @links $each }
    };
    (makers: $each:ident) => {
        $crate::for_each_topic! { @rows @makers $each }
    };
}

/// Expands to the type that a row of [`for_each_topic!`](crate::for_each_topic) has in its column `PAYLOAD`. Other
/// crates can use this macro, too.
///
/// # Examples
///
/// ```
/// assert_eq!(size_of::<scanhub_schema::payload_type!(Marks)>(), 1028);
/// let telegram: &scanhub_schema::payload_type!([u8]) = &[2, 0x80];
/// ```
#[macro_export]
macro_rules! payload_type {
    ([u8]) => {
        [u8]
    };
    ($payload:ident) => {
        $crate::$payload
    };
}

/// Properties of a topic, without the properties of its payload.
#[derive(Clone, Copy, Debug)]
pub struct TopicSpec {
    /// Name, as in `front/scan`.
    pub name: &'static str,
    /// Number in datagrams and in C. A new topic gets the next free number, wherever its row is in the table.
    pub number: u8,
    /// Name of the payload's type, which is the same in all languages.
    pub payload: &'static str,
    /// Last byte of the address of the topic's multicast group.
    pub group: u8,
    /// Publish rate.
    pub publish_rate: PublishRate,
    /// Doorbell word that the hub rings after a sample.
    pub doorbell_word: DoorbellWord,
    /// Maximum number of samples that are queued for a subscriber. If the queue is full, a new sample evicts the oldest
    /// one. If a recorder must not miss samples of a topic, the topic has a queue for the samples of 1.7 s. With a
    /// queue of 16 samples, a recorder missed 7 scans while its machine was stopped for 0.6 s.
    pub queue_len: usize,
    /// Number of samples in the history for late joiners.
    pub history_len: usize,
    /// Returns the length in bytes of the longest payload of a topic that is created with these limits.
    pub max_payload_len: fn(&TopicLimits) -> usize,
}

/// Publish rate of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PublishRate {
    /// One sample for each scan.
    Scan,
    /// One sample every second, and one after each change.
    Second,
    /// One sample for each new value.
    Change,
}

/// Words of a sensor's doorbell. There are three words, so that a subscriber to `zones` need not wait for the marks of
/// the same scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DoorbellWord {
    /// Rung as soon as telegram, scan and zones are sent.
    First,
    /// Rung after all samples of a telegram are sent.
    Last,
    /// Rung for an early warning, before the telegram is complete.
    Early,
}

impl DoorbellWord {
    /// All words.
    pub const ALL: [DoorbellWord; 3] = [DoorbellWord::First, DoorbellWord::Last, DoorbellWord::Early];
}

macro_rules! rows {
    ($($topic:ident $payload:tt, $name:ident, $number:literal, $kind:literal, $group:literal, $pace:ident,
        $ring:ident, $waiting:literal, $kept:literal: $about:literal;)*) => {
        /// A topic that a sensor can have.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Topic {
            $(#[doc = $about] $topic,)*
        }

        impl Topic {
            /// All topics, in the order in which all commands print them.
            pub const ALL: [Topic; [$(stringify!($name)),*].len()] = [$(Topic::$topic),*];
        }

        /// The rows of the topics, in the order of [`Topic::ALL`].
        pub(super) const SPECS: [TopicSpec; Topic::ALL.len()] = [$(TopicSpec {
            name: stringify!($name),
            number: $number,
            payload: $kind,
            group: $group,
            publish_rate: PublishRate::$pace,
            doorbell_word: DoorbellWord::$ring,
            queue_len: $waiting,
            history_len: $kept,
            max_payload_len: <crate::payload_type!($payload) as PayloadLen>::max_payload_len,
        },)*];
    };
}

crate::for_each_topic!(rows);

/// Length of the longest payload of a topic.
pub(crate) trait PayloadLen {
    /// Returns the length in bytes of the longest payload of a topic that is created with `limits`.
    fn max_payload_len(limits: &TopicLimits) -> usize;
}

impl PayloadLen for [u8] {
    fn max_payload_len(limits: &TopicLimits) -> usize {
        limits.telegram
    }
}

impl<P: Pod> PayloadLen for P {
    fn max_payload_len(_limits: &TopicLimits) -> usize {
        size_of::<P>()
    }
}

macro_rules! links {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        impl Topic {
            /// Topics that a hub publishes for each link.
            pub const OF_LINKS: [Topic; [$(stringify!($name)),*].len()] = [$(Topic::$topic),*];
        }
    };
}

crate::for_each_topic!(links: links);

impl Topic {
    /// Returns the topic's row of the table.
    pub const fn spec(self) -> &'static TopicSpec {
        &SPECS[self as usize]
    }

    /// Returns the topic's name, as in `front/scan`.
    pub fn name(self) -> &'static str {
        self.spec().name
    }

    /// Returns the topic called `name`, or `None` if no topic has this name.
    ///
    /// # Examples
    ///
    /// ```
    /// use scanhub_schema::Topic;
    ///
    /// assert_eq!(Topic::parse("scan"), Some(Topic::Scan));
    /// assert_eq!(Topic::Scan.service("front"), "scanhub/v2/front/scan");
    /// ```
    pub fn parse(name: &str) -> Option<Topic> {
        Topic::ALL.into_iter().find(|topic| topic.name() == name)
    }

    /// Returns the topic's number in datagrams, from 1.
    pub fn number(self) -> u8 {
        self.spec().number
    }

    /// Returns the topic with this number in datagrams, or `None` if no topic has it.
    pub fn of_number(number: u8) -> Option<Topic> {
        Topic::ALL.into_iter().find(|topic| topic.number() == number)
    }

    /// Returns the name of the payload's type, which is the same in all languages.
    pub fn payload(self) -> &'static str {
        self.spec().payload
    }

    /// Returns the length in bytes of the longest payload if the topic is created with `limits`.
    pub fn max_payload_len(self, limits: &TopicLimits) -> usize {
        (self.spec().max_payload_len)(limits)
    }

    /// Returns the revision of the payload. A higher revision only appends fields.
    pub fn revision(self) -> u32 {
        match self {
            Topic::Motion => 2,
            _ => 1,
        }
    }

    /// Returns the name of the topic's service for `sensor`.
    pub fn service(self, sensor: &str) -> String {
        service(sensor, self.name())
    }
}

/// Name of the service that receives requests for the hub's links.
pub const CONTROL: &str = "scanhub/v2/control";
/// Name of the event that wakes the hub after a request.
pub const CONTROL_REQUEST: &str = "scanhub/v2/control/request";
/// Name of the event that wakes clients after a response.
pub const CONTROL_RESPONSE: &str = "scanhub/v2/control/response";

/// Name of the service that wakes the subscribers of a sensor.
pub const WAKE: &str = "wake";

/// Reason why subscribers are woken. The value is the ID of the event in the wake service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum WakeEvent {
    /// All samples of a telegram are sent.
    Telegram = 1,
    /// The status changed, or another sample was published without a telegram, such as zones that became unknown or a
    /// new background.
    Status = 2,
    /// The hub is up. The shared-memory library sends this event when the hub creates its notifier.
    HubUp = 3,
    /// The hub is down. The shared-memory library sends this event when the hub's notifier is dropped, or when its
    /// process is found dead.
    HubDown = 4,
    /// A partial telegram caused an early warning.
    Early = 5,
}

impl WakeEvent {
    /// Returns the name of the wake service of `sensor`.
    pub fn service(sensor: &str) -> String {
        service(sensor, WAKE)
    }
}

/// Returns the sensor and the topic in the name of a service; the topic is `None` for a wake service. Returns `None`
/// for any other service, such as the control service. Reverses [`Topic::service`].
pub fn parse_service_name(name: &str) -> Option<(&str, Option<Topic>)> {
    let (sensor, topic) = name.strip_prefix("scanhub/v2/")?.split_once('/')?;
    if topic == WAKE { Some((sensor, None)) } else { Some((sensor, Some(Topic::parse(topic)?))) }
}

/// Word that stands for all sensors of a hub, and that users can write in place of a sensor's name. No sensor can have
/// this name.
pub const ROBOT: &str = "robot";

/// Checks a sensor's name. It must have 1 to 24 characters of `[a-z0-9_-]`, and must not be [`ROBOT`].
///
/// # Errors
///
/// Returns [`Kind::Configuration`] with an example if the name is not valid.
pub fn check_sensor(name: &str) -> Result<(), Failure> {
    if name == ROBOT {
        let message = format!("sensor name {ROBOT:?} is not possible: it stands for all sensors");
        return Err(Failure::new(Kind::Configuration, message, "any other name, for example front"));
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

/// Checks the name of a sensor, or of a remote sensor. The name of a remote sensor is `HUB.SENSOR`, and `HUB` and
/// `SENSOR` must each be a valid name of a sensor.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] with an example if the name is not valid.
pub fn check_any_sensor(name: &str) -> Result<(), Failure> {
    match name.split_once('.') {
        Some((hub, sensor)) => check_sensor(hub).and_then(|()| check_sensor(sensor)),
        None => check_sensor(name),
    }
}

/// Returns whether `sensor` is the name of a remote sensor. A listener publishes the topics of a remote sensor on this
/// machine.
pub fn is_remote(sensor: &str) -> bool {
    sensor.contains('.')
}

fn service(sensor: &str, topic: &str) -> String {
    format!("scanhub/v2/{sensor}/{topic}")
}

/// Kind of a publisher. All topics under one name have the same publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PublisherKind {
    /// A hub, which publishes the topics of its links; or a listener, which publishes the topics of remote sensors.
    Link,
    /// A program that tracks people.
    Tracker,
    /// A program that tilts a mount or measures its angle.
    Mount,
    /// A program that computes points in three dimensions from a scanner on a mount.
    Tilted,
}

impl PublisherKind {
    /// Returns a description, such as `a sensor`, of a name that has the topics of this publisher. Messages contain it.
    pub const fn name(self) -> &'static str {
        match self {
            PublisherKind::Link => "a sensor",
            PublisherKind::Tracker => "a tracker",
            PublisherKind::Mount => "a mount",
            PublisherKind::Tilted => "a cloud",
        }
    }
}

macro_rules! makers {
    ($($maker:ident {
        $($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*
    })*) => {
        impl PublisherKind {
            /// All kinds.
            pub const ALL: [PublisherKind; [$(stringify!($maker)),*].len()] = [$(PublisherKind::$maker),*];

            /// Returns the topics of this kind of publisher, in the order of [`Topic::ALL`].
            pub const fn topics(self) -> &'static [Topic] {
                match self { $(PublisherKind::$maker => &[$(Topic::$topic),*],)* }
            }
        }
    };
}

crate::for_each_topic!(makers: makers);

impl Topic {
    /// Returns the kind of the topic's publisher.
    pub fn publisher_kind(self) -> PublisherKind {
        let has = |maker: &PublisherKind| maker.topics().contains(&self);
        PublisherKind::ALL.into_iter().find(has).unwrap_or(PublisherKind::Link)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn service_names_round_trip() {
        assert_eq!(Topic::Scan.service("front"), "scanhub/v2/front/scan");
        for topic in Topic::ALL {
            assert_eq!(parse_service_name(&topic.service("rear")), Some(("rear", Some(topic))));
            assert_eq!(Topic::parse(topic.name()), Some(topic));
            assert_eq!(Topic::of_number(topic.number()), Some(topic));
        }
        assert_eq!(parse_service_name(&WakeEvent::service("rear")), Some(("rear", None)));
        assert_eq!(parse_service_name("scanhub/v1/rear/scan"), None);
        for control in [CONTROL, CONTROL_REQUEST, CONTROL_RESPONSE] {
            assert_eq!(parse_service_name(control), None);
        }
    }

    #[test]
    fn sensor_names_are_checked() {
        assert!(check_sensor("front_2-b").is_ok());
        for bad in ["", "Front", "a/b", "a b", "ä", ROBOT, &"a".repeat(25)] {
            assert_eq!(check_sensor(bad).map_err(|failure| failure.kind), Err(Kind::Configuration), "{bad}");
            assert!(
                check_any_sensor(bad).is_err() && check_any_sensor(&format!("hub.{bad}")).is_err(),
                "{bad}"
            );
        }
        assert!(check_sensor("hub.front").is_err() && check_any_sensor("00ab.front").is_ok());
        assert!(check_any_sensor("front").is_ok() && check_any_sensor("a.b.c").is_err());
        assert!(is_remote("hub.front") && !is_remote("front"));
    }

    #[allow(unreachable_pub)]
    mod with_one_more {
        use super::super::{DoorbellWord, PayloadLen, PublishRate, TopicSpec};

        rows! {
            Telegram [u8], telegram, 1, "u8[]", 83, Scan, First, 16, 0: "Bytes.";
            Beat Marks, beat, 2, "scanhub.Beat.v1", 82, Change, Last, 2, 1: "A throw-away topic.";
        }
    }

    #[test]
    fn table_row_defines_a_complete_topic() {
        use with_one_more::{SPECS, Topic};
        assert_eq!(Topic::ALL, [Topic::Telegram, Topic::Beat]);
        let row = &SPECS[Topic::Beat as usize];
        assert_eq!(
            (row.name, row.publish_rate, row.doorbell_word),
            ("beat", super::PublishRate::Change, super::DoorbellWord::Last)
        );
        assert_eq!((row.queue_len, row.history_len), (2, 1));
        let limits = crate::limits::TopicLimits::default();
        assert_eq!((row.max_payload_len)(&limits), size_of::<crate::Marks>());
        assert_eq!((SPECS[0].max_payload_len)(&limits), crate::Telegram::MAX_LEN);
    }

    #[test]
    fn topics_are_unique_and_status_uses_announce_group() {
        let rows = super::Topic::ALL.map(super::Topic::spec);
        for (number, row) in rows.iter().enumerate() {
            let others = &rows[..number];
            assert!(others.iter().all(|other| other.name != row.name && other.payload != row.payload));
            assert!(others.iter().all(|other| other.number != row.number));
            assert!((1..=rows.len()).contains(&row.number.into()), "readers have a table of all numbers");
        }
        assert_eq!(super::Topic::Status.spec().group, crate::datagram::Announce::GROUP);
    }

    #[test]
    fn every_topic_has_one_publisher_kind() {
        let topics: Vec<Topic> =
            PublisherKind::ALL.into_iter().flat_map(|maker| maker.topics()).copied().collect();
        assert_eq!(topics, Topic::ALL);
        assert_eq!(
            (Topic::Early.publisher_kind(), Topic::Events.publisher_kind()),
            (PublisherKind::Link, PublisherKind::Tracker)
        );
        assert_eq!(
            (Topic::Tilt.publisher_kind(), Topic::Obstacles.publisher_kind()),
            (PublisherKind::Mount, PublisherKind::Tilted)
        );
    }
}
