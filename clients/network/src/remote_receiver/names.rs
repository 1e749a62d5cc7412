//! Selection of the gateways and topics that a receiver takes, and the names that the user gave to gateways.

use scanhub_schema::{Failure, Kind, Topic, check_sensor};
use scanhub_verbs::names::TopicPattern;

/// Names that the user gave to gateways.
#[derive(Default)]
pub(super) struct Names(Vec<(String, u64)>);

impl Names {
    /// Parses names of the form `NAME=HUB`. HUB is 16 hex digits as in all output.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if a name or a number is not valid, or if a name or a number is given twice.
    pub(super) fn parse(given: &[String]) -> Result<Names, Failure> {
        let mut names: Vec<(String, u64)> = Vec::new();
        for text in given {
            let wrong = |what: &str| {
                let hint = "NAME=HUB, for example --name robot1=5f3a12bc00d1e2f3; a gateway or bridge prints its own at its start";
                Failure::new(Kind::Configuration, format!("--name {text}: {what}"), hint)
            };
            let (name, hub) = text.split_once('=').ok_or_else(|| wrong("no hub is named"))?;
            check_sensor(name).map_err(|failure| {
                let what = format!("--name {text}: {name:?} cannot be a hub's name here");
                Failure::new(failure.kind, what, format!("{HUB_NAMES}, for example robot1"))
            })?;
            let hub = number(hub).ok_or_else(|| wrong("a hub is 16 hex digits"))?;
            if names.iter().any(|(other, known)| other == name || *known == hub) {
                return Err(wrong("named twice"));
            }
            names.push((name.to_owned(), hub));
        }
        Ok(Names(names))
    }

    /// Returns the name of `hub`, or its 16 hex digits.
    pub(super) fn of(&self, hub: u64) -> String {
        let given = self.0.iter().find(|(_, known)| *known == hub);
        given.map_or_else(|| format!("{hub:016x}"), |(name, _)| name.clone())
    }

    /// Returns the hubs in `given`, each by its name or its 16 hex digits.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if a text is neither a name nor 16 hex digits.
    pub(super) fn hubs(&self, given: &[String]) -> Result<Vec<u64>, Failure> {
        let hub = |text: &String| {
            let named = self.0.iter().find(|(name, _)| name == text).map(|(_, hub)| *hub);
            named.or_else(|| number(text)).ok_or_else(|| {
                let what = format!("--hub {text}: neither 16 hex digits nor a name that --name gives");
                let hint = format!(
                    "for example --hub 5f3a12bc00d1e2f3, or --name {text}=5f3a12bc00d1e2f3 besides; \
                     a gateway or bridge prints its own at its start"
                );
                Failure::new(Kind::Configuration, what, hint)
            })
        };
        given.iter().map(hub).collect()
    }
}

/// Returns the hub with these 16 hex digits.
fn number(text: &str) -> Option<u64> {
    let is_hex = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    u64::from_str_radix(text, 16).ok().filter(|_| is_hex)
}

/// Form of a hub's name. It is the same as that of a sensor's name, because remote sensors are called `HUB.SENSOR`.
/// `robot` is excluded, because it means all sensors.
const HUB_NAMES: &str = "1 to 24 of a-z, 0-9, _ and -, but not robot";

/// Returns the topics that `texts` name, each as `*/TOPIC`, or all topics if `texts` is empty.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if a topic does not exist, or if a sensor or a thinning factor is named: a receiver counts
/// all samples of a topic, and learns the names of sensors only from announcements.
pub fn received_topics(texts: &[String]) -> Result<Vec<Topic>, Failure> {
    let mut selected = Vec::new();
    for text in texts {
        let refuse =
            |what: &str, hint: &str| Err(Failure::new(Kind::Usage, format!("topic {text} {what}"), hint));
        if let Some((topic, _)) = text.split_once(':') {
            let hint = format!("--topic {topic} here, and --topic {text} where it is sent");
            return refuse("cannot be thinned where it is received", &hint);
        }
        let pattern = TopicPattern::parse(text)?;
        if pattern.sensor.is_some() {
            let topic = pattern.topic.map_or("*", Topic::name);
            let hint = format!("*/{topic} is received of all sensors, of those hubs that --hub names");
            return refuse("names one sensor, and --publish takes topics of all sensors", &hint);
        }
        selected
            .extend(Topic::ALL.into_iter().filter(|topic| pattern.topic.is_none_or(|named| named == *topic)));
    }
    Ok(Topic::ALL.into_iter().filter(|topic| texts.is_empty() || selected.contains(topic)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hubs_are_selected_by_number_and_by_name() {
        let names = Names::parse(&["robot1=00000000000000ab".into()]).unwrap();
        let parse = |texts: &[&str]| names.hubs(&texts.iter().map(|&text| text.into()).collect::<Vec<_>>());
        assert_eq!(parse(&["robot1", "00000000000000AC"]), Ok(vec![0xab, 0xac]));
        for bad in ["robot2", "ab", "", "+0000000000000ab"] {
            let failure = parse(&[bad]).map(drop).unwrap_err();
            assert!(failure.kind == Kind::Configuration && failure.hint.contains("--name"), "{failure}");
        }
    }

    #[test]
    fn names_are_valid_and_unique() {
        let parse = |texts: &[&str]| Names::parse(&texts.iter().map(|&text| text.into()).collect::<Vec<_>>());
        let names = parse(&["robot1=00000000000000ab"]).unwrap();
        assert_eq!((names.of(0xab), names.of(1)), ("robot1".into(), "0000000000000001".into()));
        let failure = parse(&["Robot=00000000000000ab"]).map(drop).unwrap_err();
        assert!(failure.message.contains("hub's name") && failure.hint.contains("robot1"), "{failure}");
        for bad in [
            &["robot1"][..],
            &["Robot=00000000000000ab"],
            &["a=ab"],
            &["a=+0000000000000ab"],
            &["a=00000000000000ab", "a=00000000000000ac"],
            &["a=00000000000000ab", "b=00000000000000ab"],
        ] {
            assert_eq!(
                parse(bad).map(|_| ()).map_err(|failure| failure.kind),
                Err(Kind::Configuration),
                "{bad:?}"
            );
        }
    }

    fn received(texts: &[&str]) -> Result<Vec<Topic>, Failure> {
        received_topics(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn receives_topics_of_all_sensors() {
        assert_eq!(received(&[]), Ok(Topic::ALL.to_vec()));
        assert_eq!(received(&["*/*"]), Ok(Topic::ALL.to_vec()));
        let two = Topic::ALL.into_iter().filter(|topic| matches!(topic, Topic::Scan | Topic::Zones));
        assert_eq!(received(&["*/zones", "*/scan", "*/zones"]), Ok(two.collect()));
    }

    #[test]
    fn refuses_single_sensors_and_thinning() {
        for (text, expected) in [
            ("front/scan", "*/scan"),
            ("robot1.front/*", "*/*"),
            ("*/scan:every=4", "where it is sent"),
            ("*/scam", "scan"),
        ] {
            let failure = received(&[text]).unwrap_err();
            assert!(failure.kind == Kind::Usage && failure.hint.contains(expected), "{failure}");
        }
    }
}
