//! Writer of ROS messages to an MCAP file in the form of rosbag2. The file has the profile `ros2`. Each channel has the
//! definition of its type, and the quality of service that its publisher offers.

use std::io::{self, Write};

use scanhub_schema::file::{ForeignChannel, Writer};
use scanhub_schema::{Header, Pose, Scan};

use crate::{
    LASER_SCAN, POINT_CLOUD, RosNames, TF_MESSAGE, TF_STATIC, Type, frame, laser_scan, scan_cloud,
    scan_topic, static_transforms,
};

/// Profile of a file that has only ROS messages.
pub const PROFILE: &str = "ros2";

/// Writes messages to a file. The writer stores the channels that the file already has, and the poses that were written
/// last.
#[derive(Debug, Default)]
pub struct BagWriter {
    /// Topic and channel ID of scans and of points.
    channels: Vec<(String, u16)>,
    transforms: Option<Transforms>,
    /// Frame and pose of each known sensor.
    poses: Vec<(String, Pose)>,
    message: Vec<u8>,
}

/// The channel of the poses.
#[derive(Clone, Copy, Debug)]
struct Transforms {
    channel: u16,
    /// Sequence number of the next message of poses. The minimum time of this message is `min_ns`, so that the message
    /// with the most poses is the latest one.
    number: u32,
    min_ns: u64,
}

impl BagWriter {
    /// Writes a scan of `sensor` as a LaserScan. The log time is the wall-clock time of the scan's telegram.
    ///
    /// # Errors
    ///
    /// Returns the writer's error.
    pub fn write_scan<W: Write>(
        &mut self,
        writer: &mut Writer<W>,
        sensor: &str,
        header: &Header,
        scan: &Scan,
    ) -> io::Result<()> {
        let write = |message: &mut Vec<u8>| laser_scan(message, frame(sensor), header, scan);
        self.write_message(writer, scan_topic(sensor), &LASER_SCAN, header, write)
    }

    /// Writes a scan of `sensor` as a PointCloud2, with the same log time as the LaserScan of this scan.
    ///
    /// # Errors
    ///
    /// Returns the writer's error.
    pub fn write_points<W: Write>(
        &mut self,
        writer: &mut Writer<W>,
        sensor: &str,
        header: &Header,
        scan: &Scan,
    ) -> io::Result<()> {
        let write = |message: &mut Vec<u8>| scan_cloud(message, frame(sensor), header, scan);
        self.write_message(writer, RosNames::default().topic(sensor, "points"), &POINT_CLOUD, header, write)
    }

    fn write_message<W: Write>(
        &mut self,
        writer: &mut Writer<W>,
        topic: String,
        message_type: &Type,
        header: &Header,
        write: impl FnOnce(&mut Vec<u8>),
    ) -> io::Result<()> {
        let channel = match self.channels.iter().find(|(known, _)| *known == topic) {
            Some(&(_, channel)) => channel,
            None => {
                let channel = add_channel(writer, &topic, message_type, SCAN_QOS)?;
                self.channels.push((topic, channel));
                channel
            }
        };
        self.message.clear();
        write(&mut self.message);
        writer.write_message(channel, header.topic_seq as u32, header.wall_ns, &self.message)
    }

    /// Writes the poses of all known sensors if `pose` of `sensor` is new. Log time and stamp are `wall_ns` (since
    /// 1970), or 1 ns after the previous message if that is later.
    pub fn write_pose<W: Write>(
        &mut self,
        writer: &mut Writer<W>,
        sensor: &str,
        wall_ns: u64,
        pose: &Pose,
    ) -> io::Result<()> {
        let frame = frame(sensor);
        match self.poses.iter_mut().find(|(known_frame, _)| known_frame == frame) {
            Some((_, known)) if known == pose => return Ok(()),
            Some((_, known)) => *known = *pose,
            None => self.poses.push((frame.to_owned(), *pose)),
        }
        let Transforms { channel, number, min_ns } = match self.transforms {
            Some(known) => known,
            None => Transforms {
                channel: add_channel(writer, TF_STATIC, &TF_MESSAGE, LATCHED_QOS)?,
                number: 0,
                min_ns: 0,
            },
        };
        let at_ns = wall_ns.max(min_ns);
        self.transforms =
            Some(Transforms { channel, number: number.wrapping_add(1), min_ns: at_ns.saturating_add(1) });
        self.message.clear();
        static_transforms(&mut self.message, at_ns, &self.poses);
        writer.write_message(channel, number, at_ns, &self.message)
    }
}

fn add_channel<W: Write>(
    writer: &mut Writer<W>,
    topic: &str,
    message_type: &Type,
    qos: &str,
) -> io::Result<u16> {
    writer.add_channel(&ForeignChannel {
        topic,
        encoding: Type::ENCODING,
        schema: (message_type.name, message_type.text, Type::LANGUAGE),
        metadata: &[("offered_qos_profiles", qos)],
    })
}

/// Expands to the text of a quality of service: reliable, keep the last `depth` messages. `durability` is 2 for
/// volatile and 1 for transient local.
macro_rules! offered {
    ($depth:literal, $durability:literal) => {
        concat!(
            "- history: 1\n  depth: ",
            $depth,
            "\n  reliability: 1\n  durability: ",
            $durability,
            "\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n",
            "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n",
            "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n",
            "  avoid_ros_namespace_conventions: false\n"
        )
    };
}

/// Quality of service of scans and points. A player of the file offers it, and it is compatible with every subscriber.
const SCAN_QOS: &str = offered!(5, 2);
/// Quality of service of transforms, which subscribers to transforms request.
const LATCHED_QOS: &str = offered!(1, 1);
