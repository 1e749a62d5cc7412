//! What goes out: topics of sensors, and every how manieth sample of each. Refuses to know which sensors there are.

use std::num::NonZeroU64;

use schema::{Failure, Kind, Topic, is_remote};

use crate::names::TopicName;

/// The topics that go out.
#[derive(Clone, Debug)]
pub(super) struct Selection {
    entries: Vec<Entry>,
}

#[derive(Clone, Debug)]
struct Entry {
    /// Nothing: all sensors that are not named beside this topic.
    sensor: Option<String>,
    topic: Topic,
    every: NonZeroU64,
}

impl Selection {
    /// What `texts` name: `SENSOR/TOPIC` or `*/TOPIC`, with `:every=N` behind it if the samples are to be thinned. Nothing
    /// named is all sensors, and of these telegrams if `bare`, else all other topics.
    ///
    /// [`Kind::NoTopic`] with the topics that there are; [`Kind::Configuration`] if a name or a number is not possible,
    /// something is named twice, or is no telegram and `bare`.
    pub(super) fn parse(texts: &[String], bare: bool) -> Result<Selection, Failure> {
        let mut entries: Vec<Entry> = Vec::new();
        for text in texts {
            let entry = Entry::parse(text)?;
            if bare && entry.topic != Topic::Telegram {
                let hint = "without --bare all topics can go out";
                return Err(refuse(text, "is no telegram, and nothing else goes out bare", hint));
            }
            if entries.iter().any(|other| (&other.sensor, other.topic) == (&entry.sensor, entry.topic)) {
                return Err(refuse(text, "is named twice", "name each topic once"));
            }
            entries.push(entry);
        }
        if entries.is_empty() {
            let wanted = |topic: &Topic| (*topic == Topic::Telegram) == bare;
            let all = Topic::ALL.into_iter().filter(wanted);
            entries.extend(all.map(|topic| Entry { sensor: None, topic, every: NonZeroU64::MIN }));
        }
        Ok(Selection { entries })
    }

    /// Every how manieth sample of this topic goes out, if any do.
    pub(super) fn every(&self, sensor: &str, topic: Topic) -> Option<NonZeroU64> {
        let of_topic = || self.entries.iter().filter(move |entry| entry.topic == topic);
        let named = of_topic().find(|entry| entry.sensor.as_deref() == Some(sensor));
        named.or_else(|| of_topic().find(|entry| entry.sensor.is_none())).map(|entry| entry.every)
    }

    /// The sensors that are named, each once.
    pub(super) fn named(&self) -> Vec<&str> {
        let mut named: Vec<_> = self.entries.iter().filter_map(|entry| entry.sensor.as_deref()).collect();
        named.sort_unstable();
        named.dedup();
        named
    }

    /// Something goes out of sensors that are not named.
    pub(super) fn wants_all(&self) -> bool {
        self.entries.iter().any(|entry| entry.sensor.is_none())
    }
}

impl Entry {
    fn parse(text: &str) -> Result<Entry, Failure> {
        let (name, every) = match text.split_once(':') {
            None => (text, NonZeroU64::MIN),
            Some((name, every)) => {
                let every = every.strip_prefix("every=").and_then(|number| number.parse().ok());
                (name, every.ok_or_else(|| refuse(text, "cannot be thinned so", EVERY_FORM))?)
            }
        };
        let (sensor, topic) = match name.strip_prefix("*/") {
            Some(topic) => (None, Topic::parse(topic).ok_or_else(|| no_topic(name))?),
            None => {
                let name = TopicName::parse(name)?;
                if name.is_robot() {
                    return Err(refuse(text, "is a fold", "*/zones sends the zones of each sensor"));
                }
                if is_remote(&name.sensor) {
                    let hint = "a gateway sends what the hub of its own machine publishes";
                    return Err(refuse(text, "is another machine's", hint));
                }
                (Some(name.sensor), name.topic)
            }
        };
        if every > NonZeroU64::MIN && matches!(topic, Topic::Background | Topic::Status) {
            return Err(refuse(text, "is not of each telegram, and cannot be thinned", name));
        }
        Ok(Entry { sensor, topic, every })
    }
}

fn refuse(text: &str, what: &str, hint: &str) -> Failure {
    Failure::new(Kind::Configuration, format!("topic {text} {what}"), hint)
}

fn no_topic(name: &str) -> Failure {
    let topics = Topic::ALL.map(|topic| format!("*/{}", topic.name()));
    Failure::new(Kind::NoTopic, format!("no topic {name:?}"), format!("there are {}", topics.join(", ")))
}

const EVERY_FORM: &str = "front/scan:every=4 keeps the samples of every fourth telegram";

#[cfg(test)]
mod tests {
    use super::*;

    fn selection(texts: &[&str], bare: bool) -> Result<Selection, Failure> {
        Selection::parse(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>(), bare)
    }

    fn every(selection: &Selection, sensor: &str, topic: Topic) -> Option<u64> {
        selection.every(sensor, topic).map(NonZeroU64::get)
    }

    #[test]
    fn all_but_telegrams_or_nothing_but_telegrams() {
        let usual = selection(&[], false).unwrap();
        for topic in Topic::ALL {
            assert_eq!(every(&usual, "front", topic), (topic != Topic::Telegram).then_some(1));
        }
        let bare = selection(&[], true).unwrap();
        for topic in Topic::ALL {
            assert_eq!(every(&bare, "front", topic), (topic == Topic::Telegram).then_some(1));
        }
        assert!(usual.wants_all() && bare.wants_all() && usual.named().is_empty());
    }

    #[test]
    fn what_is_named_wins_over_all() {
        let some = selection(&["*/scan:every=8", "front/scan:every=4", "front/zones"], false).unwrap();
        assert_eq!(every(&some, "front", Topic::Scan), Some(4));
        assert_eq!(every(&some, "rear", Topic::Scan), Some(8));
        assert_eq!(
            (every(&some, "front", Topic::Zones), every(&some, "rear", Topic::Zones)),
            (Some(1), None)
        );
        assert_eq!((some.named(), some.wants_all()), (vec!["front"], true));
        assert!(!selection(&["front/zones"], false).unwrap().wants_all());
    }

    #[test]
    fn what_cannot_go_out_is_refused() {
        let kind = |texts: &[&str], bare| selection(texts, bare).map(drop).map_err(|failure| failure.kind);
        for bad in ["front", "front/scam", "*", "*/scam", "robot/scan"] {
            assert_eq!(kind(&[bad], false), Err(Kind::NoTopic), "{bad}");
        }
        for bad in [
            "Front/scan",
            "robot/zones",
            "robot1.front/zones",
            "front/scan:every=0",
            "front/scan:every=",
            "front/scan:4",
            "front/status:every=2",
            "*/background:every=2",
        ] {
            assert_eq!(kind(&[bad], false), Err(Kind::Configuration), "{bad}");
        }
        assert_eq!(kind(&["front/scan", "front/scan:every=2"], false), Err(Kind::Configuration));
        assert_eq!(kind(&["front/scan"], true), Err(Kind::Configuration));
        assert_eq!(kind(&["front/telegram:every=2"], true), Ok(()));
    }
}
