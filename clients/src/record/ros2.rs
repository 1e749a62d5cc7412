//! A scan as `sensor_msgs/msg/LaserScan`, in the form in which ROS 2 sends and keeps it: little-endian CDR (OMG XCDR1),
//! and the text from which a reader that has no ROS learns it. Refuses to know files.

use std::f64::consts::FRAC_PI_2;

use schema::file::Foreign;
use schema::{Code, Header, Scan, TURN_NS};

/// The type's name and text, each type it is made of behind a line, as rosbag2 keeps them.
const NAME: &str = "sensor_msgs/msg/LaserScan";
const TEXT: &str = "\
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

/// The profile of a recording that has such messages.
pub(super) const PROFILE: &str = "ros2";

/// The channel with the name `topic`.
pub(super) fn channel(topic: &str) -> Foreign<'_> {
    Foreign { topic, encoding: "cdr", schema: (NAME, TEXT, "ros2msg") }
}

/// The name of the topic of `sensor`'s scans: letters, digits and `_` in words that begin with none of the digits
/// (<https://design.ros2.org/articles/topic_and_service_names.html>), and another machine's in a space of its own.
pub(super) fn topic(sensor: &str) -> String {
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

/// Writes `scan`, of the frame `frame`, to the end of `message`: x ahead, angles in radians counter-clockwise from there,
/// ranges in metres (REP 103). +inf where nothing came back from as far as the sensor sees, -inf where something is too
/// near, NaN where nothing can be said (REP 117). Stamped when its first beam was measured.
pub(super) fn write(message: &mut Vec<u8>, frame: &str, header: &Header, scan: &Scan) {
    let mut cdr = Cdr::begin(message);
    let stamp_ns = header.wall_ns.saturating_sub(scan.beam_age_ns(0));
    cdr.four(((stamp_ns / SECOND_NS) as i32).to_le_bytes());
    cdr.four(((stamp_ns % SECOND_NS) as u32).to_le_bytes());
    cdr.text(frame);
    let ahead = |i: usize| (scan.angle_deg(i).to_radians() - FRAC_PI_2) as f32;
    let last = scan.beams().saturating_sub(1);
    let step = f64::from(scan.step_mdeg) / 1000.0;
    // Beams that stand between others are measured a turn later: then no one time lies between two.
    let beam_ns = if scan.step_mdeg >= 1000 { step / 360.0 * TURN_NS as f64 } else { 0.0 };
    let metres = f32::from(scan.unit_mm) / 1000.0;
    for value in [
        ahead(0),
        ahead(last),
        step.to_radians() as f32,
        (beam_ns / 1e9) as f32,
        (f64::from(header.period_us) / 1e6) as f32,
        metres,
        f32::from(scan.max().saturating_sub(Code::BEYOND.0 + 1)) * metres,
    ] {
        cdr.four(value.to_le_bytes());
    }
    cdr.floats(scan.beams(), (0..scan.beams()).map(|i| range_m(scan, i)));
    cdr.floats(scan.intensities().len(), scan.intensities().iter().map(|&value| f32::from(value)));
}

fn range_m(scan: &Scan, i: usize) -> f32 {
    match (scan.distance_mm(i), scan.code(i)) {
        (Some(0), _) => f32::NEG_INFINITY,
        (Some(mm), _) => mm as f32 / 1000.0,
        (None, Some(Code::NO_RETURN | Code::BEYOND)) => f32::INFINITY,
        (None, _) => f32::NAN,
    }
}

/// Values behind one another, each at a multiple of its size from where the body begins. None here is longer than four.
struct Cdr<'a> {
    message: &'a mut Vec<u8>,
    body: usize,
}

impl Cdr<'_> {
    /// Little-endian, no options.
    fn begin(message: &mut Vec<u8>) -> Cdr<'_> {
        message.extend([0, 1, 0, 0]);
        let body = message.len();
        Cdr { message, body }
    }

    fn four(&mut self, bytes: [u8; 4]) {
        while !(self.message.len() - self.body).is_multiple_of(4) {
            self.message.push(0);
        }
        self.message.extend(bytes);
    }

    fn text(&mut self, text: &str) {
        self.four((text.len() as u32 + 1).to_le_bytes());
        self.message.extend(text.as_bytes());
        self.message.push(0);
    }

    fn floats(&mut self, count: usize, values: impl Iterator<Item = f32>) {
        self.four((count as u32).to_le_bytes());
        values.for_each(|value| self.message.extend(value.to_le_bytes()));
    }
}

const SECOND_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(ranges: &[u16]) -> Scan {
        let mut scan = Scan {
            count: ranges.len() as u16,
            unit_mm: 10,
            range_bits: 13,
            step_mdeg: 1000,
            first_angle_mdeg: 0,
            ..Scan::default()
        };
        scan.range_array[..ranges.len()].copy_from_slice(ranges);
        scan
    }

    /// The numbers behind a frame of four letters, whose end makes three bytes of padding.
    fn numbers(message: &[u8]) -> Vec<f32> {
        let body = &message[4..];
        assert_eq!(body[8..20], [5, 0, 0, 0, b'r', b'e', b'a', b'r', 0, 0, 0, 0]);
        body[20..].chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().unwrap())).collect()
    }

    #[test]
    fn a_scan_is_these_numbers() {
        let header = Header { wall_ns: 1_700_000_001_000_000_000, period_us: 13_320, ..Header::default() };
        let mut message = Vec::new();
        let mut it = scan(&[100, 0x1FFF, 0x1FF7, 0x1FFE, 0]);
        it.contents = 1;
        it.intensity_bits = 3;
        it.upper_array[1] = 7;
        write(&mut message, "rear", &header, &it);
        assert_eq!(message[..4], [0, 1, 0, 0]);
        // The first of five beams of a degree each was measured four 360ths of a turn before the last, which stamps.
        let nanosec = 1_000_000_000 - 4 * TURN_NS / 360;
        assert_eq!(message[4..8], 1_700_000_000_i32.to_le_bytes());
        assert_eq!(message[8..12], (nanosec as u32).to_le_bytes());
        let told = numbers(&message);
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(near(told[0], -std::f32::consts::FRAC_PI_2) && near(told[1], 4_f32.to_radians() + told[0]));
        assert!(near(told[2], 1_f32.to_radians()) && near(told[3], 37e-6) && near(told[4], 0.01332));
        assert!(near(told[5], 0.01) && near(told[6], 81.82));
        assert_eq!(told[7].to_bits(), 5);
        assert_eq!(
            (told[8], told[9], told[10], told[12]),
            (1.0, f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY)
        );
        assert!(told[11].is_nan());
        assert_eq!(told[13].to_bits(), 5);
        assert_eq!(told[14..], [0.0, 7.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn beams_of_several_turns_have_no_one_time_between_them() {
        let mut message = Vec::new();
        let between = Scan { step_mdeg: 500, ..scan(&[100; 9]) };
        write(&mut message, "rear", &Header { wall_ns: 1 << 60, ..Header::default() }, &between);
        let told = numbers(&message);
        assert_eq!((told[3], told[7].to_bits(), told[17].to_bits(), told.len()), (0.0, 9, 0, 18));
    }

    #[test]
    fn names_are_those_that_ros_takes() {
        assert_eq!(topic("front"), "/front/scan");
        assert_eq!(topic("front-left_2"), "/front_left_2/scan");
        assert_eq!(topic("5f3a12bc00d1e2f3.front"), "/sensor_5f3a12bc00d1e2f3/front/scan");
    }
}
