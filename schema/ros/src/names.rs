//! Names of topics and frames. Refuses to know messages.

/// The topic of [`static_transforms`](crate::static_transforms).
pub const TF_STATIC: &str = "/tf_static";

/// The topic of [`diagnosis`](crate::diagnosis).
pub const DIAGNOSTICS: &str = "/diagnostics";

/// The frame of the robot, in which poses are given (REP 105).
pub const BASE_FRAME: &str = "base_link";

/// The frame in which `sensor` measures: its name.
pub fn frame(sensor: &str) -> &str {
    sensor
}

/// The topic of `sensor`'s scans, where nothing else is said. A sensor of another machine has its own namespace.
pub fn scan_topic(sensor: &str) -> String {
    Names::default().topic(sensor, "scan")
}

/// Returns the topic of `sensor`'s scans as points, with the default [`Names`].
pub fn points_topic(sensor: &str) -> String {
    Names::default().topic(sensor, "points")
}

/// How topics and frames are called.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    /// Before every topic: words, each behind a slash; empty: none.
    namespace: String,
    /// The same, behind the namespace and before the topics of sensors.
    prefix: String,
    /// Sensors that have another frame than one with their name.
    frames: Vec<(String, String)>,
}

impl Names {
    /// Makes names with `namespace` before every topic, behind it `prefix` before those of sensors, and a frame for each
    /// sensor in `frames`. Words are separated by slashes; one before the first may be left out.
    ///
    /// # Errors
    ///
    /// The name that ROS does not take (<https://design.ros2.org/articles/topic_and_service_names.html>).
    pub fn new(namespace: &str, prefix: &str, frames: Vec<(String, String)>) -> Result<Names, String> {
        if let Some((_, bad)) = frames.iter().find(|(_, frame)| frame.is_empty() || words(frame).is_none()) {
            return Err(bad.clone());
        }
        let path = |text: &str| words(text).ok_or_else(|| text.to_owned());
        Ok(Names { namespace: path(namespace)?, prefix: path(prefix)?, frames })
    }

    /// Returns the namespace: words, each behind a slash; empty: none.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Returns the topic `word` of `sensor`: letters, digits and `_` in words that do not start with a digit.
    pub fn topic(&self, sensor: &str, word: &str) -> String {
        let mut topic = [self.namespace(), &self.prefix].concat();
        for part in sensor.split('.') {
            topic.push('/');
            if part.starts_with(|sign: char| sign.is_ascii_digit()) {
                topic.push_str("sensor_");
            }
            topic.extend(part.chars().map(|sign| if sign.is_ascii_alphanumeric() { sign } else { '_' }));
        }
        topic + "/" + word
    }

    /// Returns the topic `name`, such as [`TF_STATIC`], in the namespace.
    pub fn shared(&self, name: &str) -> String {
        [self.namespace(), name].concat()
    }

    /// Returns the sensors to which a frame was given.
    pub fn framed(&self) -> impl Iterator<Item = &str> {
        self.frames.iter().map(|(sensor, _)| &**sensor)
    }

    /// Returns the frame in which `sensor` measures.
    pub fn frame<'a>(&'a self, sensor: &'a str) -> &'a str {
        self.frames.iter().find(|(of, _)| of == sensor).map_or(frame(sensor), |(_, frame)| frame)
    }
}

/// `text` with a slash before each of its words; nothing if ROS does not take one of them.
fn words(text: &str) -> Option<String> {
    let text = text.strip_prefix('/').unwrap_or(text);
    if text.is_empty() {
        return Some(String::new());
    }
    let is_word = |word: &str| {
        word.starts_with(|sign: char| sign.is_ascii_alphabetic() || sign == '_')
            && word.chars().all(|sign| sign.is_ascii_alphanumeric() || sign == '_')
    };
    text.split('/').all(is_word).then(|| format!("/{text}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_ros_takes() {
        assert_eq!(scan_topic("front"), "/front/scan");
        assert_eq!(scan_topic("front-left_2"), "/front_left_2/scan");
        assert_eq!(scan_topic("5f3a12bc00d1e2f3.front"), "/sensor_5f3a12bc00d1e2f3/front/scan");
    }

    #[test]
    fn names_stand_in_namespaces() {
        let frames = vec![("front".to_owned(), "laser".to_owned())];
        let names = Names::new("robot1/base", "/lidars", frames).unwrap();
        assert_eq!(names.topic("front", "zones"), "/robot1/base/lidars/front/zones");
        assert_eq!(names.shared(TF_STATIC), "/robot1/base/tf_static");
        assert_eq!((names.frame("front"), names.frame("rear")), ("laser", "rear"));
        assert_eq!(Names::new("", "/", Vec::new()), Ok(Names::default()));
        assert!(Names::new("", "", vec![("front".to_owned(), String::new())]).is_err());
        for bad in ["robot 1", "1st", "a//b", "a/", "a-b", "//a"] {
            assert_eq!(Names::new(bad, "", Vec::new()), Err(bad.to_owned()));
            assert_eq!(Names::new("", bad, Vec::new()), Err(bad.to_owned()));
            assert!(Names::new("", "", vec![("front".to_owned(), bad.to_owned())]).is_err());
        }
    }
}
