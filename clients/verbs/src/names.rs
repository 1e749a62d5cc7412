//! Parses names of topics on the command line: `SENSOR/TOPIC`, `*/TOPIC` and `SENSOR/*`. Creates the failures for names
//! that do not exist.

use std::fmt;

use scanhub_schema::{Failure, Kind, PublisherKind, ROBOT, Topic, check_any_sensor};

/// A topic of a sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicName {
    /// The sensor's name.
    pub sensor: String,
    /// The topic.
    pub topic: Topic,
}

impl TopicName {
    /// Parses the name of a topic, such as `front/scan`. `robot/zones` is the combined verdict of all sensors.
    ///
    /// # Errors
    ///
    /// [`Kind::Usage`], with the names of all topics, if the topic does not exist, and if the sensor's name is not
    /// valid.
    pub fn parse(text: &str) -> Result<TopicName, Failure> {
        let unknown = |how: String| {
            Failure::new(Kind::Usage, format!("no topic {text:?}"), format!("{how}{}", topics()))
        };
        let (sensor, word) = text
            .split_once('/')
            .ok_or_else(|| unknown("write SENSOR/TOPIC, such as front/zones; ".into()))?;
        let topic = Topic::parse(word).ok_or_else(|| unknown(nearest(sensor, word)))?;
        let name = TopicName { sensor: sensor.to_owned(), topic };
        if sensor == ROBOT && topic != Topic::Zones {
            let hint =
                format!("{ROBOT} stands for all sensors, and only zones can be combined: {ROBOT}/zones");
            return Err(Failure::new(Kind::Usage, format!("no topic {text:?}"), hint));
        }
        if !name.is_robot() {
            as_argument(check_any_sensor(sensor))?;
        }
        Ok(name)
    }

    /// Returns whether the topic is the combined verdict of all sensors.
    pub fn is_robot(&self) -> bool {
        self.sensor == ROBOT && self.topic == Topic::Zones
    }
}

impl fmt::Display for TopicName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.sensor, self.topic.name())
    }
}

/// Returns an index for a program that publishes as `name` next to a hub. The index is at least 128, because the links
/// of a hub have lower indexes.
pub fn position(name: &str) -> u8 {
    const FIRST_INDEX: u8 = 128;
    let sum = name.bytes().fold(0u32, |sum, byte| sum.wrapping_mul(31).wrapping_add(byte.into()));
    FIRST_INDEX + (sum % u32::from(u8::MAX - FIRST_INDEX)) as u8
}

/// Converts the error of a check to [`Kind::Usage`], because the name is from the command line.
pub fn as_argument(checked: Result<(), Failure>) -> Result<(), Failure> {
    checked.map_err(|failure| Failure { kind: Kind::Usage, ..failure })
}

/// Returns a hint with the names of all topics.
fn topics() -> String {
    format!("topics are {}", Topic::ALL.map(Topic::name).join(", "))
}

/// Returns a hint with the topic that is most similar to `word`, because `word` may be misspelled. The hint is empty if
/// no topic is similar.
fn nearest(sensor: &str, word: &str) -> String {
    let topic = most_similar(word, Topic::ALL.into_iter().map(Topic::name));
    topic.map_or(String::new(), |topic| format!("did you mean {sensor}/{topic}? "))
}

/// Returns the name in `known` that is most similar to `word`, if `word` may be a misspelling of it.
fn most_similar<'a>(word: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let near = |known: &str| strsim::jaro_winkler(known, word);
    known.max_by(|a, b| near(a).total_cmp(&near(b))).filter(|known| near(known) > MIN_SIMILARITY)
}

/// Minimum similarity of a misspelled word to the right one. 1 means that the words are equal, and 0 that they have
/// nothing in common.
const MIN_SIMILARITY: f64 = 0.8;

/// Returns the failure for a topic that the sensor of `name` will never have, because it has other `topics`.
pub fn no_such_topic(name: &TopicName, topics: &[Topic]) -> Failure {
    let names = topics.iter().map(|topic| format!("{}/{}", name.sensor, topic.name()));
    let hint = format!("there are {}", names.collect::<Vec<_>>().join(", "));
    let publisher = topics
        .first()
        .map_or(String::new(), |topic| format!(": {} is {}", name.sensor, topic.publisher_kind().name()));
    Failure::new(Kind::NoTopic, format!("there is no topic {name}{publisher}"), hint)
}

/// Returns the failure for a `sensor` that the hub does not have. The hint lists its `sensors`.
pub fn no_sensor(sensor: &str, sensors: &[String]) -> Failure {
    let hint = match sensors {
        [] => "it has no sensors: `scanhub run --link NAME=PORT`".to_owned(),
        some => {
            let near = most_similar(sensor, some.iter().map(String::as_str));
            let near = near.map_or(String::new(), |near| format!("did you mean {near}? "));
            format!("{near}there are {}", some.join(", "))
        }
    };
    Failure::new(Kind::NoTopic, format!("the hub has no sensor {sensor}"), hint)
}

/// Selection of topics by one argument of the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicPattern {
    /// The sensor; `None` for all sensors.
    pub sensor: Option<String>,
    /// The topic; `None` for all topics.
    pub topic: Option<Topic>,
}

impl TopicPattern {
    /// Parses `SENSOR/TOPIC`, `*/TOPIC`, `SENSOR/*` or `*/*`. `robot/zones` is the combined verdict of all sensors.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`TopicName::parse`].
    pub fn parse(text: &str) -> Result<TopicPattern, Failure> {
        let (sensor, topic) = text.split_once('/').unwrap_or((text, ""));
        match (sensor, topic) {
            (WILDCARD, WILDCARD) => Ok(TopicPattern { sensor: None, topic: None }),
            (WILDCARD, topic) => match Topic::parse(topic) {
                Some(topic) => Ok(TopicPattern { sensor: None, topic: Some(topic) }),
                None => {
                    let hint = format!("{}{}", nearest(WILDCARD, topic), topics());
                    Err(Failure::new(Kind::Usage, format!("no topic {text:?}"), hint))
                }
            },
            (ROBOT, WILDCARD) => {
                let hint = format!(
                    "*/* names all topics of all sensors, {ROBOT}/zones the verdict over all sensors"
                );
                Err(Failure::new(Kind::Usage, format!("{text} is not possible"), hint))
            }
            (sensor, WILDCARD) => {
                as_argument(check_any_sensor(sensor))?;
                Ok(TopicPattern { sensor: Some(sensor.to_owned()), topic: None })
            }
            _ => {
                let TopicName { sensor, topic } = TopicName::parse(text)?;
                Ok(TopicPattern { sensor: Some(sensor), topic: Some(topic) })
            }
        }
    }
}

/// Selection of topics by all arguments of the command line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Selection {
    /// Topics of named sensors, each once, in the order of the arguments.
    pub(crate) named: Vec<TopicName>,
    /// Topics of all sensors, each once, in the order of [`Topic::ALL`].
    pub(crate) of_all: Vec<Topic>,
}

impl Selection {
    /// Parses the arguments `texts`. The selection is empty if `texts` is empty.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`TopicName::parse`].
    pub(crate) fn parse(texts: &[String]) -> Result<Selection, Failure> {
        let mut named: Vec<TopicName> = Vec::new();
        let mut of_all = Vec::new();
        for text in texts {
            let pattern = TopicPattern::parse(text)?;
            // The kind of a sensor's publisher is unknown until its topics exist, so `SENSOR/*` selects the topics of a
            // link.
            let may_have =
                |topic: Topic| pattern.sensor.is_none() || topic.publisher_kind() == PublisherKind::Link;
            let is_meant = |topic: &Topic| pattern.topic.map_or(may_have(*topic), |known| known == *topic);
            let meant = Topic::ALL.into_iter().filter(is_meant);
            match &pattern.sensor {
                None => of_all.extend(meant),
                Some(sensor) => named.extend(meant.map(|topic| TopicName { sensor: sensor.clone(), topic })),
            }
        }
        let mut once: Vec<TopicName> = Vec::new();
        for name in named {
            if !once.contains(&name) {
                once.push(name);
            }
        }
        let of_all = Topic::ALL.into_iter().filter(|topic| of_all.contains(topic)).collect();
        Ok(Selection { named: once, of_all })
    }
}

/// Argument that stands for all sensors or all topics.
const WILDCARD: &str = "*";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_names_and_suggests_similar_ones() {
        let name = TopicName::parse("front/scan").unwrap();
        assert_eq!(
            (name.sensor.as_str(), name.topic, name.to_string()),
            ("front", Topic::Scan, "front/scan".into())
        );
        for bad in ["front", "front/scam", "front/scan/x", ""] {
            let failure = TopicName::parse(bad).unwrap_err();
            assert_eq!(failure.kind, Kind::Usage, "{bad}");
            assert!(failure.hint.contains("topics are telegram, scan, "), "{failure}");
        }
        let hint = |text: &str| TopicName::parse(text).unwrap_err().hint;
        assert!(hint("zones").starts_with("write SENSOR/TOPIC, such as front/zones; topics are "));
        assert!(hint("front/backgroud").starts_with("did you mean front/background? topics are "));
        assert!(hint("front/x").starts_with("topics are "));
        assert!(TopicName::parse("robot/zones").unwrap().is_robot());
        assert!(!TopicName::parse("front/zones").unwrap().is_robot());
        let failure = TopicName::parse("robot/scan").unwrap_err();
        assert_eq!(failure.kind, Kind::Usage);
        assert!(failure.hint.contains("robot/zones"), "{failure}");
        assert_eq!(TopicName::parse("Front/scan").unwrap_err().kind, Kind::Usage);
        let hint = |sensor| no_sensor(sensor, &["front".to_owned(), "rear".to_owned()]).hint;
        assert_eq!(hint("frnt"), "did you mean front? there are front, rear");
        assert_eq!(hint("side"), "there are front, rear");
        let name = TopicName { sensor: "house".to_owned(), topic: Topic::Scan };
        let failure = no_such_topic(&name, PublisherKind::Tracker.topics());
        assert_eq!(failure.message, "there is no topic house/scan: house is a tracker");
        assert_eq!(failure.hint, "there are house/tracks, house/events");
    }

    fn selection(texts: &[&str]) -> (Vec<String>, Vec<Topic>) {
        let texts: Vec<_> = texts.iter().map(|&text| text.to_owned()).collect();
        let selection = Selection::parse(&texts).unwrap();
        (selection.named.iter().map(TopicName::to_string).collect(), selection.of_all)
    }

    #[test]
    fn selects_all_sensors_or_topics() {
        assert_eq!(selection(&["*/scan"]), (vec![], vec![Topic::Scan]));
        let front: Vec<_> = Topic::OF_LINKS.iter().map(|topic| format!("front/{}", topic.name())).collect();
        assert_eq!(selection(&["front/*"]), (front, vec![]));
        assert_eq!(selection(&["*/*"]), (vec![], Topic::ALL.to_vec()));
        assert_eq!(selection(&["robot1.front/scan"]), (vec!["robot1.front/scan".into()], vec![]));
        assert_eq!(
            selection(&["*/status", "robot/zones", "front/scan", "*/scan", "front/scan"]),
            (vec!["robot/zones".into(), "front/scan".into()], vec![Topic::Scan, Topic::Status])
        );
        assert_eq!(selection(&[]), (vec![], vec![]));
    }

    #[test]
    fn refuses_unknown_topics_with_suggestions() {
        let refused = |text: &str| TopicPattern::parse(text).unwrap_err();
        for bad in [
            "*",
            "*/",
            "*/scam",
            "front",
            "front/",
            "front/scam",
            "/scan",
            "robot/*",
            "robot/scan",
            "",
            "Front/*",
        ] {
            assert_eq!(refused(bad).kind, Kind::Usage, "{bad}");
        }
        assert!(refused("*/backgroud").hint.starts_with("did you mean */background? topics are "));
        assert!(refused("*").hint.starts_with("topics are "));
        assert!(refused("robot/*").hint.contains("robot/zones"));
    }
}
