//! What is recorded: topics that are named, and topics of all sensors. Refuses to know which sensors there are.

use schema::{Failure, Kind, Topic};

use crate::names::TopicName;

/// The topics that are kept.
#[derive(Clone, Debug)]
pub(super) struct Selection {
    named: Vec<TopicName>,
    of_all: Vec<Topic>,
}

/// What a recording for ROS 2 is made of.
const ROS2: [Topic; 2] = [Topic::Scan, Topic::Status];
/// Telegrams, from which all else can be made again, and the results that are wanted first.
const USUAL: [Topic; 5] = [Topic::Telegram, Topic::Marks, Topic::Zones, Topic::Foreground, Topic::Status];

impl Selection {
    /// What `texts` name, `SENSOR/TOPIC` or `*/TOPIC`; nothing named: `everything` that there is, or what is usual. For
    /// `ros2` scans, and the status of their sensors, which tells where they sit.
    ///
    /// [`Kind::NoTopic`] with the topics that there are; [`Kind::Configuration`] if a name is not possible, or stands for
    /// no topic; [`Kind::Usage`] if ROS has no message for it.
    pub(super) fn parse(texts: &[String], everything: bool, ros2: bool) -> Result<Selection, Failure> {
        let mut selection = Selection { named: Vec::new(), of_all: Vec::new() };
        if texts.is_empty() {
            selection.of_all = match (everything, ros2) {
                (true, true) => return Err(no_message("--all")),
                (false, true) => ROS2.to_vec(),
                (true, false) => Topic::ALL.to_vec(),
                (false, false) => USUAL.to_vec(),
            };
        }
        for text in texts {
            let topic = match text.strip_prefix("*/") {
                Some(topic) => {
                    let topic = Topic::parse(topic).ok_or_else(|| no_topic(text))?;
                    selection.of_all.push(topic);
                    topic
                }
                None => {
                    let name = TopicName::parse(text)?;
                    selection.named.push(name.clone());
                    name.topic
                }
            };
            if ros2 && topic != Topic::Scan {
                return Err(no_message(text));
            }
        }
        if let Some(fold) = selection.named.iter().find(|name| name.is_robot()) {
            let hint = "`*/zones` records the zones of each sensor";
            return Err(Failure::new(Kind::Configuration, format!("{fold} is made by who listens"), hint));
        }
        if ros2 {
            let status = |name: &TopicName| TopicName { topic: Topic::Status, ..name.clone() };
            let statuses: Vec<_> = selection.named.iter().map(status).collect();
            selection.named.extend(statuses);
            if !selection.of_all.is_empty() {
                selection.of_all = ROS2.to_vec();
            }
        }
        Ok(selection)
    }

    /// The names to follow, each once.
    pub(super) fn names(&self) -> Vec<TopicName> {
        let mut names: Vec<TopicName> = Vec::new();
        for name in &self.named {
            if !names.contains(name) {
                names.push(name.clone());
            }
        }
        names
    }

    /// The topics to follow of all sensors, in their order.
    pub(super) fn topics(&self) -> Vec<Topic> {
        Topic::ALL.into_iter().filter(|topic| self.of_all.contains(topic)).collect()
    }
}

/// `what` cannot be in a recording for ROS 2.
fn no_message(what: &str) -> Failure {
    let message = format!("--ros2 records messages of ROS alone, and {what} has others: only scans are such");
    let hint = "record without --ros2, and `scanhub convert IN.mcap OUT.mcap --ros2` makes a file for ROS of it later";
    Failure::new(Kind::Usage, message, hint)
}

fn no_topic(text: &str) -> Failure {
    let topics = Topic::ALL.map(|topic| format!("*/{}", topic.name()));
    Failure::new(Kind::NoTopic, format!("no topic {text:?}"), format!("there are {}", topics.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn selection(texts: &[&str], everything: bool, ros2: bool) -> Result<Selection, Failure> {
        Selection::parse(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>(), everything, ros2)
    }

    fn names(selection: &Selection) -> Vec<String> {
        selection.names().iter().map(TopicName::to_string).collect()
    }

    #[test]
    fn what_is_usual_and_everything() {
        assert_eq!(selection(&[], false, false).unwrap().topics(), USUAL);
        assert_eq!(selection(&[], true, false).unwrap().topics(), Topic::ALL);
        let some = selection(&["front/scan", "*/status", "front/scan"], false, false).unwrap();
        assert_eq!((names(&some), some.topics()), (vec!["front/scan".into()], vec![Topic::Status]));
    }

    #[test]
    fn ros_takes_scans_and_where_their_sensors_sit() {
        let ours = [Topic::Scan, Topic::Status];
        assert_eq!(selection(&[], false, true).unwrap().topics(), ours);
        assert_eq!(selection(&["*/scan"], false, true).unwrap().topics(), ours);
        let front = selection(&["front/scan"], false, true).unwrap();
        assert_eq!(
            (names(&front), front.topics()),
            (vec!["front/scan".into(), "front/status".into()], vec![])
        );
        for (texts, everything) in [(&[][..], true), (&["front/zones"], false), (&["*/telegram"], false)] {
            let failure = selection(texts, everything, true).unwrap_err();
            assert_eq!(failure.kind, Kind::Usage, "{texts:?}");
            assert!(failure.hint.contains("convert"), "{failure}");
        }
    }

    #[test]
    fn what_is_no_topic_is_refused() {
        let kind = |text| selection(&[text], false, false).map(drop).map_err(|failure| failure.kind);
        for bad in ["front", "*/scam", "front/scam", "robot/scan", "*"] {
            assert_eq!(kind(bad), Err(Kind::NoTopic), "{bad}");
        }
        for bad in ["robot/zones", "Front/scan"] {
            assert_eq!(kind(bad), Err(Kind::Configuration), "{bad}");
        }
    }
}
