//! Which topics are recorded: named ones, and topics of all sensors. Refuses to know which sensors there are.

use scanhub_schema::{Failure, Kind, Topic};

use crate::names::TopicName;
use crate::selection;

/// The topics that are kept.
#[derive(Clone, Debug)]
pub(super) struct Selection {
    chosen: selection::Selection,
}

/// Telegrams, from which all else can be made again, and the results that are wanted first.
const USUAL: [Topic; 9] = [
    Topic::Telegram,
    Topic::Marks,
    Topic::Zones,
    Topic::Foreground,
    Topic::Status,
    Topic::Tracks,
    Topic::Events,
    Topic::Tilt,
    Topic::Obstacles,
];

impl Selection {
    /// What `texts` name, see [`selection::Word`]; nothing named: `everything` that there is, or what is usual. For
    /// `ros2` scans, and the status of their sensors, which tells where they sit.
    ///
    /// [`Kind::Usage`] with the topics that there are, if a name is not possible or stands for what no hub publishes, or if
    /// ROS has no message for it.
    pub(super) fn parse(texts: &[String], everything: bool, ros2: bool) -> Result<Selection, Failure> {
        let mut chosen = selection::Selection::parse(texts)?;
        if texts.is_empty() {
            chosen.of_all = match (everything, ros2) {
                (true, true) => return Err(no_message("--all")),
                (false, true) => vec![Topic::Scan],
                (true, false) => Topic::ALL.to_vec(),
                (false, false) => USUAL.to_vec(),
            };
        }
        if let Some(fold) = chosen.named.iter().find(|name| name.is_robot()) {
            let hint = "`*/zones` records the zones of each sensor";
            return Err(Failure::new(Kind::Usage, format!("{fold} is computed by the consumer"), hint));
        }
        if ros2 {
            let named = chosen.named.iter().map(|name| name.topic);
            if let Some(other) =
                named.chain(chosen.of_all.iter().copied()).find(|&topic| topic != Topic::Scan)
            {
                return Err(no_message(&format!("topic {}", other.name())));
            }
            let status = |name: &TopicName| TopicName { topic: Topic::Status, ..name.clone() };
            let statuses: Vec<_> = chosen.named.iter().map(status).collect();
            chosen.named.extend(statuses);
            chosen.of_all.extend(chosen.of_all.first().map(|_| Topic::Status));
        }
        Ok(Selection { chosen })
    }

    /// The names to follow, each once.
    pub(super) fn names(&self) -> Vec<TopicName> {
        let mut names: Vec<TopicName> = Vec::new();
        for name in &self.chosen.named {
            if !names.contains(name) {
                names.push(name.clone());
            }
        }
        names
    }

    /// The topics to follow of all sensors, in their order.
    pub(super) fn topics(&self) -> Vec<Topic> {
        Topic::ALL.into_iter().filter(|topic| self.chosen.of_all.contains(topic)).collect()
    }
}

/// `what` cannot be in a recording for ROS 2.
fn no_message(what: &str) -> Failure {
    let message = format!("--ros2 records only ROS messages, and {what} is not one: only scans are");
    let hint = "record without --ros2, and convert later: `scanhub convert IN.mcap OUT.mcap --ros2`";
    Failure::new(Kind::Usage, message, hint)
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
        for bad in ["front", "*/scam", "front/scam", "robot/scan", "*", "robot/zones", "Front/scan"] {
            assert_eq!(kind(bad), Err(Kind::Usage), "{bad}");
        }
        assert_eq!(kind("front/*"), Ok(()));
    }
}
