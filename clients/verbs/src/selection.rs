//! The syntax for verbs that take several topics: `SENSOR/TOPIC`, `*/TOPIC` and `SENSOR/*`. Refuses to know which
//! sensors there are.

use scanhub_schema::{Failure, Kind, Maker, ROBOT, Topic};

use crate::names::{TopicName, as_word, nearest, topics};

/// What one word stands for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Word {
    /// The sensor; nothing: all of them.
    pub sensor: Option<String>,
    /// The topic; nothing: all of them.
    pub topic: Option<Topic>,
}

impl Word {
    /// What `text` stands for; `robot/zones` is the fold over all sensors.
    ///
    /// [`Kind::Usage`] with the topics that there are, or if the sensor's name is not possible.
    pub fn parse(text: &str) -> Result<Word, Failure> {
        let (sensor, topic) = text.split_once('/').unwrap_or((text, ""));
        match (sensor, topic) {
            (ALL, ALL) => Ok(Word { sensor: None, topic: None }),
            (ALL, topic) => match Topic::parse(topic) {
                Some(topic) => Ok(Word { sensor: None, topic: Some(topic) }),
                None => {
                    let hint = format!("{}{}", nearest(ALL, topic), topics());
                    Err(Failure::new(Kind::Usage, format!("no topic {text:?}"), hint))
                }
            },
            (ROBOT, ALL) => {
                let hint = format!(
                    "*/* names all topics of all sensors, {ROBOT}/zones the verdict over all sensors"
                );
                Err(Failure::new(Kind::Usage, format!("{text} is not possible"), hint))
            }
            (sensor, ALL) => {
                as_word(scanhub_schema::check_followed(sensor))?;
                Ok(Word { sensor: Some(sensor.to_owned()), topic: None })
            }
            _ => {
                let TopicName { sensor, topic } = TopicName::parse(text)?;
                Ok(Word { sensor: Some(sensor), topic: Some(topic) })
            }
        }
    }
}

/// What several words stand for together.
#[derive(Clone, Debug, Default)]
pub(crate) struct Selection {
    /// Topics of sensors that are named, each once, in the order of the words.
    pub(crate) named: Vec<TopicName>,
    /// Topics of all sensors, each once, in their own order.
    pub(crate) of_all: Vec<Topic>,
}

impl Selection {
    /// What `texts` stand for; nothing said is nothing selected. Failures as of [`Word::parse`].
    pub(crate) fn parse(texts: &[String]) -> Result<Selection, Failure> {
        let mut named: Vec<TopicName> = Vec::new();
        let mut of_all = Vec::new();
        for text in texts {
            let word = Word::parse(text)?;
            // Who made a name's topics is known when they are there: one that is named has what a link has.
            let may_have = |topic: Topic| word.sensor.is_none() || topic.maker() == Maker::Link;
            let is_meant = |topic: &Topic| word.topic.map_or(may_have(*topic), |known| known == *topic);
            let meant = Topic::ALL.into_iter().filter(is_meant);
            match &word.sensor {
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

/// Stands for all sensors, or all topics.
const ALL: &str = "*";

#[cfg(test)]
mod tests {
    use super::*;

    fn selection(texts: &[&str]) -> (Vec<String>, Vec<Topic>) {
        let texts: Vec<_> = texts.iter().map(|&text| text.to_owned()).collect();
        let selection = Selection::parse(&texts).unwrap();
        (selection.named.iter().map(TopicName::to_string).collect(), selection.of_all)
    }

    #[test]
    fn a_word_may_stand_for_all() {
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
    fn what_is_no_topic_is_refused_with_what_there_is() {
        let refused = |text: &str| Word::parse(text).unwrap_err();
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
