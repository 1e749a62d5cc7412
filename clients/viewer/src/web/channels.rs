//! Channels of sensors, mounts, and programs such as `tilt`. A channel is opened when `web` subscribes to its topics.
//! Each sample is published as a message.

use std::collections::BTreeMap;

use scanhub_client::streams::Sample;
use scanhub_schema::{Background, Header, PublisherKind, Scan, SweepPoints, Topic};
use scanhub_verbs::names::TopicName;

use crate::live_scene::Pair;
use crate::scene::Sensor;
use crate::server::{ChannelPublisher, ChannelStore, messages};

/// Channels of one sensor.
pub(super) struct SensorChannels<'a> {
    sensor: String,
    scan: ChannelPublisher<'a>,
    foreground: ChannelPublisher<'a>,
    background: ChannelPublisher<'a>,
    status: ChannelPublisher<'a>,
    /// Memory for messages.
    message: Vec<u8>,
}

impl<'a> SensorChannels<'a> {
    pub(super) fn open(channels: &'a ChannelStore, sensor: &str) -> SensorChannels<'a> {
        SensorChannels {
            sensor: sensor.to_owned(),
            scan: channels.open(messages::scan_channel(sensor)),
            foreground: channels.open(messages::foreground_channel(sensor)),
            background: channels.open(messages::background_channel(sensor)),
            status: channels.open(messages::status_channel(sensor)),
            message: Vec::new(),
        }
    }

    /// Publishes a scan.
    pub(super) fn publish_scan(&mut self, header: &Header, scan: &Scan) {
        if self.scan.is_needed() {
            self.message.clear();
            scanhub_ros::laser_scan(&mut self.message, scanhub_ros::frame(&self.sensor), header, scan);
            self.scan.publish(header.wall_ns, &self.message);
        }
    }

    /// Publishes a foreground. The angles of the beams are taken from the scan of the same telegram.
    pub(super) fn publish_foreground(&mut self, ((header, scan), foreground): &Pair) {
        if self.foreground.is_needed() {
            let (message, frame) = (&mut self.message, scanhub_ros::frame(&self.sensor));
            message.clear();
            scanhub_ros::foreground_cloud(message, frame, header, scan, foreground);
            self.foreground.publish(header.wall_ns, message);
        }
    }

    /// Publishes the current background.
    pub(super) fn publish_background(&mut self, wall_ns: u64, model: &Background) {
        self.message.clear();
        messages::background(&mut self.message, &self.sensor, wall_ns, model);
        self.background.publish(wall_ns, &self.message);
    }

    /// Publishes the state of the sensor.
    pub(super) fn publish_status(&self, wall_ns: u64, state: &Sensor) {
        self.status.publish(wall_ns, &messages::status(state));
    }

    /// Removes messages of scans that are too old.
    pub(super) fn clear(&self) {
        self.scan.clear();
        self.foreground.clear();
    }
}

/// Channels of mounts, and of programs that publish sweeps. `web` subscribes to the topics with angles and points only
/// while a viewer needs them.
pub(super) struct TiltChannels<'a> {
    channels: &'a ChannelStore,
    mounts: BTreeMap<String, ChannelPublisher<'a>>,
    sweeps: BTreeMap<String, SweepChannels<'a>>,
}

/// Channels of one program that publishes sweeps.
struct SweepChannels<'a> {
    cloud: ChannelPublisher<'a>,
    obstacles: ChannelPublisher<'a>,
    /// Points of the sweep that is not complete yet.
    points: SweepPoints,
    /// Memory for messages.
    message: Vec<u8>,
}

impl<'a> TiltChannels<'a> {
    pub(super) fn new(channels: &'a ChannelStore) -> TiltChannels<'a> {
        TiltChannels { channels, mounts: BTreeMap::new(), sweeps: BTreeMap::new() }
    }

    /// Opens the channels of a topic that `web` will subscribe to.
    pub(super) fn begin(&mut self, name: &TopicName) {
        match name.topic.publisher_kind() {
            PublisherKind::Mount => drop(self.mount(&name.sensor)),
            _ => drop(self.sweeps(&name.sensor)),
        }
    }

    fn mount(&mut self, name: &str) -> ChannelPublisher<'a> {
        let open = || self.channels.open(messages::tilt_channel(name));
        *self.mounts.entry(name.to_owned()).or_insert_with(open)
    }

    fn sweeps(&mut self, name: &str) -> &mut SweepChannels<'a> {
        let open = || SweepChannels {
            cloud: self.channels.open(messages::cloud_channel(name)),
            obstacles: self.channels.open(messages::obstacles_channel(name)),
            points: SweepPoints::default(),
            message: Vec::new(),
        };
        self.sweeps.entry(name.to_owned()).or_insert_with(open)
    }

    /// Returns whether a viewer subscribes to `topic` of any mount or program. Returns true for topics other than
    /// angles and points.
    pub(super) fn needs(&self, topic: Topic) -> bool {
        match topic {
            Topic::Tilt => self.mounts.values().any(ChannelPublisher::is_subscribed),
            Topic::Cloud => self.sweeps.values().any(|sweeps| sweeps.cloud.is_subscribed()),
            _ => true,
        }
    }

    /// Publishes a `sample` of `name`: angles and obstacles at once, points when their sweep is complete.
    pub(super) fn publish(&mut self, name: &TopicName, sample: &Sample) {
        match sample {
            Sample::Tilt(angle) => {
                let channel = self.mount(&name.sensor);
                if channel.is_needed() {
                    channel.publish(angle.header().wall_ns, &messages::tilt(angle));
                }
            }
            Sample::Cloud(cloud) => {
                let SweepChannels { cloud: channel, points, message, .. } = self.sweeps(&name.sensor);
                if let Some(points) = points.take(cloud.header(), cloud)
                    && channel.is_needed()
                {
                    message.clear();
                    scanhub_ros::sweep_cloud(message, cloud.header(), points);
                    channel.publish(cloud.header().wall_ns, message);
                }
            }
            Sample::Obstacles(found) => {
                let channel = self.sweeps(&name.sensor).obstacles;
                let header = found.header();
                channel.publish(header.wall_ns, &messages::obstacles(header, found));
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn obstacles_need_no_viewer_but_angles_and_points_do() {
        let channels = ChannelStore::new().unwrap();
        let mut tilted = TiltChannels::new(&channels);
        let name = |sensor: &str, topic| TopicName { sensor: sensor.to_owned(), topic };
        tilted.begin(&name("mount", Topic::Tilt));
        tilted.begin(&name("hall", Topic::Cloud));
        tilted.begin(&name("hall", Topic::Obstacles));
        assert_eq!((tilted.mounts.len(), tilted.sweeps.len()), (1, 1));
        let wants = [Topic::Tilt, Topic::Cloud, Topic::Obstacles].map(|topic| tilted.needs(topic));
        assert_eq!(wants, [false, false, true]);
        assert!(!tilted.sweeps["hall"].obstacles.is_needed(), "obstacles are valid from their arrival");
    }
}
