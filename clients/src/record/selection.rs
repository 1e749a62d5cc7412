//! What is recorded: topics that are named, and topics of all sensors. Refuses to know which sensors there are.

use schema::{Failure, Kind, Topic};

use super::queue::Track;
use crate::names::TopicName;
use crate::selection;

/// The topics that are kept.
#[derive(Clone, Debug)]
pub(super) struct Selection {
    chosen: selection::Selection,
    ros2: bool,
}

/// Telegrams, from which all else can be made again, and the results that are wanted first.
const USUAL: [Topic; 5] = [Topic::Telegram, Topic::Marks, Topic::Zones, Topic::Foreground, Topic::Status];

impl Selection {
    /// What `texts` name, see [`selection::Word`]; nothing named: `everything` that there is, or what is usual. With
    /// `ros2` scans are kept as messages of ROS 2, too.
    ///
    /// [`Kind::Usage`] with the topics that there are, or if a name is not possible or stands for what no hub publishes.
    pub(super) fn parse(texts: &[String], everything: bool, ros2: bool) -> Result<Selection, Failure> {
        let mut chosen = selection::Selection::parse(texts)?;
        if texts.is_empty() {
            chosen.of_all = if everything { Topic::ALL.to_vec() } else { USUAL.to_vec() };
        }
        if let Some(fold) = chosen.named.iter().find(|name| name.is_robot()) {
            let hint = "`*/zones` records the zones of each sensor";
            return Err(Failure::new(Kind::Usage, format!("{fold} is made by who listens"), hint));
        }
        Ok(Selection { chosen, ros2 })
    }

    /// The names to follow, each once.
    pub(super) fn names(&self) -> Vec<TopicName> {
        let mut names: Vec<TopicName> = Vec::new();
        let scan = |name: &TopicName| TopicName { topic: Topic::Scan, ..name.clone() };
        let scans = self.chosen.named.iter().filter(|_| self.ros2).map(scan);
        for name in self.chosen.named.iter().cloned().chain(scans) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    /// The topics to follow of all sensors, in their order.
    pub(super) fn topics(&self) -> Vec<Topic> {
        let is_wanted = |topic: &Topic| {
            self.chosen.of_all.contains(topic)
                || (self.ros2 && *topic == Topic::Scan && !self.chosen.of_all.is_empty())
        };
        Topic::ALL.into_iter().filter(is_wanted).collect()
    }

    /// As what `name` is kept.
    pub(super) fn track(&self, name: &TopicName) -> Track {
        let native = self.chosen.named.contains(name) || self.chosen.of_all.contains(&name.topic);
        Track { name: name.clone(), native, ros2: self.ros2 && name.topic == Topic::Scan }
    }
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
        let track = some.track(&TopicName::parse("rear/status").unwrap());
        assert_eq!((track.native, track.ros2), (true, false));
    }

    #[test]
    fn ros_wants_scans_without_asking_for_ours() {
        let usual = selection(&[], false, true).unwrap();
        assert!(usual.topics().contains(&Topic::Scan));
        let track = usual.track(&TopicName::parse("rear/scan").unwrap());
        assert_eq!((track.native, track.ros2), (false, true));
        let front = selection(&["front/telegram"], false, true).unwrap();
        assert_eq!(
            (names(&front), front.topics()),
            (vec!["front/telegram".into(), "front/scan".into()], vec![])
        );
        let both = selection(&["*/scan"], false, true).unwrap();
        let track = both.track(&TopicName::parse("rear/scan").unwrap());
        assert_eq!((track.native, track.ros2), (true, true));
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
