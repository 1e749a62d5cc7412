//! Selection of the topics that are sent, with a thinning factor for each.

use std::num::NonZeroU64;

use scanhub_schema::{Failure, Kind, PublishRate, PublisherKind, ROBOT, Topic, is_remote};
use scanhub_verbs::names::TopicPattern;

/// Topics that are sent, each with its thinning factor.
#[derive(Clone, Debug)]
pub struct Selection {
    entries: Vec<Entry>,
}

#[derive(Clone, Debug)]
struct Entry {
    pattern: TopicPattern,
    every: NonZeroU64,
}

impl Selection {
    /// Parses `texts`. Each text is a pattern `SENSOR/TOPIC`, optionally followed by `:every=N` to thin the samples. If
    /// `texts` is empty, selects topics of all sensors: the telegrams if `bare` is set, otherwise the topics that
    /// [`is_default`](Self::is_default) accepts.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if a pattern or a number is not valid, a pattern is given twice, or a pattern does not
    /// name telegrams although `bare` is set.
    pub fn parse(texts: &[String], bare: bool) -> Result<Selection, Failure> {
        let mut entries: Vec<Entry> = Vec::new();
        for text in texts {
            let entry = Entry::parse(text)?;
            if bare && entry.pattern.topic != Some(Topic::Telegram) {
                let hint = "without --bare all topics can be sent";
                return Err(refuse(text, "has no telegrams, and --bare sends nothing else", hint));
            }
            if entries.iter().any(|other| other.pattern == entry.pattern) {
                return Err(refuse(text, "is named twice", "name each topic once"));
            }
            entries.push(entry);
        }
        if entries.is_empty() {
            let is_sent = |topic: &Topic| match bare {
                true => *topic == Topic::Telegram,
                false => Selection::is_default(*topic),
            };
            let all = Topic::ALL.into_iter().filter(is_sent);
            entries.extend(all.map(|topic| Entry {
                pattern: TopicPattern { sensor: None, topic: Some(topic) },
                every: NonZeroU64::MIN,
            }));
        }
        Ok(Selection { entries })
    }

    /// Returns whether `topic` is sent if the user names no topics. Telegrams and clouds are not, because they have
    /// many bytes. Lines, motion and early warnings are not, because the hub computes them only while they have a
    /// subscriber.
    pub fn is_default(topic: Topic) -> bool {
        !matches!(topic, Topic::Telegram | Topic::Lines | Topic::Motion | Topic::Early | Topic::Cloud)
    }

    /// Returns the thinning factor of this topic, or `None` if it is not sent. If several patterns match, the most
    /// specific one decides.
    pub(super) fn every(&self, sensor: &str, topic: Topic) -> Option<NonZeroU64> {
        let pattern = |sensor: Option<&str>, topic| TopicPattern { sensor: sensor.map(str::to_owned), topic };
        let most_specific_first =
            [(Some(sensor), Some(topic)), (Some(sensor), None), (None, Some(topic)), (None, None)];
        let find = |pattern: TopicPattern| self.entries.iter().find(|entry| entry.pattern == pattern);
        most_specific_first
            .into_iter()
            .find_map(|(sensor, topic)| find(pattern(sensor, topic)))
            .map(|entry| entry.every)
    }

    /// Returns whether `topic` is sent for at least one sensor.
    pub fn includes(&self, topic: Topic) -> bool {
        self.entries.iter().any(|entry| entry.pattern.topic.is_none_or(|named| named == topic))
    }

    /// Returns the sensors that are named, each once.
    pub(super) fn named_sensors(&self) -> Vec<&str> {
        let mut named: Vec<_> =
            self.entries.iter().filter_map(|entry| entry.pattern.sensor.as_deref()).collect();
        named.sort_unstable();
        named.dedup();
        named
    }

    /// Returns the kind of publisher of the topics that the user selected for `sensor` by name. It is the link if the
    /// pattern selects all topics.
    pub(super) fn publisher_kind(&self, sensor: &str) -> PublisherKind {
        let patterns = self.entries.iter().map(|entry| &entry.pattern);
        let mut kinds = patterns
            .filter(|pattern| pattern.sensor.as_deref() == Some(sensor))
            .filter_map(|pattern| pattern.topic.map(Topic::publisher_kind));
        kinds.find(|kind| *kind != PublisherKind::Link).unwrap_or(PublisherKind::Link)
    }

    /// Returns whether a pattern selects topics of all sensors, so that sensors that are not named are sent, too.
    pub(super) fn includes_unnamed(&self) -> bool {
        self.entries.iter().any(|entry| entry.pattern.sensor.is_none())
    }
}

impl Entry {
    /// Parses a pattern with an optional thinning factor.
    fn parse(text: &str) -> Result<Entry, Failure> {
        let (name, every) = match text.split_once(':') {
            None => (text, NonZeroU64::MIN),
            Some((name, every)) => {
                let every = every.strip_prefix("every=").and_then(|number| number.parse().ok());
                (name, every.ok_or_else(|| refuse(text, "has an invalid thinning factor", EVERY_FORM))?)
            }
        };
        let pattern = TopicPattern::parse(name)?;
        if pattern.sensor.as_deref() == Some(ROBOT) {
            return Err(refuse(text, "is a combined verdict", "*/zones sends the zones of each sensor"));
        }
        if pattern.sensor.as_deref().is_some_and(is_remote) {
            let hint = "a gateway sends what the hub of its own machine publishes";
            return Err(refuse(text, "belongs to another machine", hint));
        }
        if every > NonZeroU64::MIN
            && pattern.topic.is_none_or(|topic| topic.spec().publish_rate != PublishRate::Scan)
        {
            return Err(refuse(text, "cannot be thinned: it is not published once per scan", name));
        }
        Ok(Entry { pattern, every })
    }
}

fn refuse(text: &str, what: &str, hint: &str) -> Failure {
    Failure::new(Kind::Usage, format!("topic {text} {what}"), hint)
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
    fn selects_default_topics_or_bare_telegrams() {
        let usual = selection(&[], false).unwrap();
        for topic in Topic::ALL {
            let rare = [Topic::Telegram, Topic::Lines, Topic::Motion, Topic::Early, Topic::Cloud];
            let is_usual = !rare.contains(&topic);
            assert_eq!(every(&usual, "front", topic), is_usual.then_some(1));
        }
        let bare = selection(&[], true).unwrap();
        for topic in Topic::ALL {
            assert_eq!(every(&bare, "front", topic), (topic == Topic::Telegram).then_some(1));
        }
        let house = selection(&["front/*", "house/tracks"], false).unwrap();
        assert_eq!(
            (house.publisher_kind("front"), house.publisher_kind("house")),
            (PublisherKind::Link, PublisherKind::Tracker)
        );
        assert!(usual.includes_unnamed() && bare.includes_unnamed() && usual.named_sensors().is_empty());
    }

    #[test]
    fn most_specific_pattern_applies() {
        let some = selection(&["*/scan:every=8", "front/scan:every=4", "front/zones"], false).unwrap();
        assert_eq!(every(&some, "front", Topic::Scan), Some(4));
        assert_eq!(every(&some, "rear", Topic::Scan), Some(8));
        assert_eq!(
            (every(&some, "front", Topic::Zones), every(&some, "rear", Topic::Zones)),
            (Some(1), None)
        );
        assert_eq!((some.named_sensors(), some.includes_unnamed()), (vec!["front"], true));
        assert!(some.includes(Topic::Zones) && !some.includes(Topic::Marks));
        assert!(selection(&["front/*"], false).unwrap().includes(Topic::Marks));
        assert!(!selection(&["front/zones"], false).unwrap().includes_unnamed());
        let front = selection(&["*/scan:every=8", "front/*", "front/marks:every=2"], false).unwrap();
        assert_eq!(every(&front, "front", Topic::Scan), Some(1));
        assert_eq!(every(&front, "front", Topic::Marks), Some(2));
        assert_eq!(
            (every(&front, "rear", Topic::Scan), every(&front, "rear", Topic::Marks)),
            (Some(8), None)
        );
    }

    #[test]
    fn refuses_invalid_patterns() {
        let kind = |texts: &[&str], bare| selection(texts, bare).map(drop).map_err(|failure| failure.kind);
        for bad in ["front", "front/scam", "*", "*/scam", "robot/scan"] {
            assert_eq!(kind(&[bad], false), Err(Kind::Usage), "{bad}");
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
            "front/*:every=2",
        ] {
            assert_eq!(kind(&[bad], false), Err(Kind::Usage), "{bad}");
        }
        assert_eq!(kind(&["front/scan", "front/scan:every=2"], false), Err(Kind::Usage));
        assert_eq!(kind(&["front/scan"], true), Err(Kind::Usage));
        assert_eq!(kind(&["*/*"], true), Err(Kind::Usage));
        assert_eq!(kind(&["front/telegram:every=2"], true), Ok(()));
    }
}
