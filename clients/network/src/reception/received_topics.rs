//! Which topics a receiver takes: those of all sensors, whole. Refuses to know who sends them.

use scanhub_schema::{Failure, Kind, Topic};

use scanhub_verbs::selection::Word;

/// Returns the topics that `texts` name, each as `*/TOPIC`; none named is all of them.
///
/// # Errors
///
/// [`Kind::Usage`] with the topics that there are, or if a sensor is named or samples are to be thinned: who receives counts
/// all samples of a topic, and knows sensors only when they come.
pub fn received_topics(texts: &[String]) -> Result<Vec<Topic>, Failure> {
    let mut wanted = Vec::new();
    for text in texts {
        let refuse =
            |what: &str, hint: &str| Err(Failure::new(Kind::Usage, format!("topic {text} {what}"), hint));
        if let Some((topic, _)) = text.split_once(':') {
            let hint = format!("--topic {topic} here, and --topic {text} where it is sent");
            return refuse("cannot be thinned where it is received", &hint);
        }
        let word = Word::parse(text)?;
        if word.sensor.is_some() {
            let topic = word.topic.map_or("*", Topic::name);
            let hint = format!("*/{topic} is received of all sensors, of those hubs that --hub names");
            return refuse("is of one sensor, and --publish takes topics of all", &hint);
        }
        wanted.extend(Topic::ALL.into_iter().filter(|topic| word.topic.is_none_or(|named| named == *topic)));
    }
    Ok(Topic::ALL.into_iter().filter(|topic| texts.is_empty() || wanted.contains(topic)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn received(texts: &[&str]) -> Result<Vec<Topic>, Failure> {
        received_topics(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn topics_of_all_sensors_are_received() {
        assert_eq!(received(&[]), Ok(Topic::ALL.to_vec()));
        assert_eq!(received(&["*/*"]), Ok(Topic::ALL.to_vec()));
        let two = Topic::ALL.into_iter().filter(|topic| matches!(topic, Topic::Scan | Topic::Zones));
        assert_eq!(received(&["*/zones", "*/scan", "*/zones"]), Ok(two.collect()));
    }

    #[test]
    fn what_cannot_be_received_alone_is_refused() {
        for (text, said) in [
            ("front/scan", "*/scan"),
            ("robot1.front/*", "*/*"),
            ("*/scan:every=4", "where it is sent"),
            ("*/scam", "scan"),
        ] {
            let failure = received(&[text]).unwrap_err();
            assert!(failure.kind == Kind::Usage && failure.hint.contains(said), "{failure}");
        }
    }
}
