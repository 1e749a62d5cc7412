//! Names of topics and frames. Refuses to know messages.

/// The topic of [`static_transforms`](crate::static_transforms).
pub const TF_STATIC: &str = "/tf_static";

/// The frame of the robot, in which poses are given (REP 105).
pub const BASE_FRAME: &str = "base_link";

/// The frame in which `sensor` measures: its name.
pub fn frame(sensor: &str) -> &str {
    sensor
}

/// The topic of `sensor`'s scans: letters, digits and `_` in words that do not start with a digit
/// (<https://design.ros2.org/articles/topic_and_service_names.html>). A sensor of another machine has its own namespace.
pub fn scan_topic(sensor: &str) -> String {
    let mut topic = String::new();
    for word in sensor.split('.') {
        topic.push('/');
        if word.starts_with(|sign: char| sign.is_ascii_digit()) {
            topic.push_str("sensor_");
        }
        topic.extend(word.chars().map(|sign| if sign.is_ascii_alphanumeric() { sign } else { '_' }));
    }
    topic + "/scan"
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
}
