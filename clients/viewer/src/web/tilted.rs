//! What mounts say and what programs like `tilt` make of it, as channels. Angles and points are followed only while a viewer
//! asks for them. Refuses to know sensors.

use crate::server::{Board, ChannelId, messages};
use scanhub_client::streams::Sample;
use scanhub_schema::{Maker, SweepPoints, Topic};

use scanhub_verbs::names::TopicName;

pub(super) struct Tilted<'a> {
    board: &'a Board,
    mounts: Vec<(String, ChannelId)>,
    sweeps: Vec<Sweeps>,
    message: Vec<u8>,
}

/// Of one program.
struct Sweeps {
    name: String,
    cloud: ChannelId,
    obstacles: ChannelId,
    /// Of the sweep that comes.
    points: SweepPoints,
}

impl<'a> Tilted<'a> {
    pub(super) fn new(board: &'a Board) -> Tilted<'a> {
        Tilted { board, mounts: Vec::new(), sweeps: Vec::new(), message: Vec::new() }
    }

    /// A topic of `name` will be followed: its channels are there from now on.
    pub(super) fn begin(&mut self, name: &TopicName) {
        match name.topic.maker() {
            Maker::Mount => drop(self.mount(&name.sensor)),
            _ => drop(self.sweeps(&name.sensor)),
        }
    }

    fn mount(&mut self, name: &str) -> ChannelId {
        let at = self.mounts.iter().position(|(known, _)| known == name).unwrap_or_else(|| {
            self.mounts.push((name.to_owned(), self.board.channel(messages::tilt_channel(name))));
            self.mounts.len() - 1
        });
        self.mounts[at].1
    }

    fn sweeps(&mut self, name: &str) -> &mut Sweeps {
        let at = self.sweeps.iter().position(|known| known.name == name).unwrap_or_else(|| {
            self.sweeps.push(Sweeps {
                name: name.to_owned(),
                cloud: self.board.channel(messages::cloud_channel(name)),
                obstacles: self.board.channel(messages::obstacles_channel(name)),
                points: SweepPoints::default(),
            });
            self.sweeps.len() - 1
        });
        &mut self.sweeps[at]
    }

    /// Whether a viewer asks for `topic` of anybody.
    pub(super) fn wants(&self, topic: Topic) -> bool {
        match topic {
            Topic::Tilt => self.mounts.iter().any(|(_, channel)| self.board.is_watched(*channel)),
            Topic::Cloud => self.sweeps.iter().any(|sweeps| self.board.is_watched(sweeps.cloud)),
            _ => true,
        }
    }

    /// Puts up `sample` of `name`: angles as they come, points once their sweep is whole, and what that has found.
    pub(super) fn take(&mut self, name: &TopicName, sample: &Sample) {
        let board = self.board;
        match sample {
            Sample::Tilt(said) => {
                let channel = self.mount(&name.sensor);
                if board.is_wanted(channel) {
                    board.put(channel, said.header().wall_ns, &messages::tilt(said));
                }
            }
            Sample::Cloud(cloud) => {
                let mut message = std::mem::take(&mut self.message);
                let sweeps = self.sweeps(&name.sensor);
                if let Some(points) = sweeps.points.take(cloud.header(), cloud)
                    && board.is_wanted(sweeps.cloud)
                {
                    message.clear();
                    scanhub_ros::sweep_cloud(&mut message, cloud.header(), points);
                    board.put(sweeps.cloud, cloud.header().wall_ns, &message);
                }
                self.message = message;
            }
            Sample::Obstacles(found) => {
                let sweeps = self.sweeps(&name.sensor);
                let header = found.header();
                board.put(sweeps.obstacles, header.wall_ns, &messages::obstacles(header, found));
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_and_points_are_followed_only_while_a_viewer_asks_for_them() {
        let board = Board::new().unwrap();
        let mut tilted = Tilted::new(&board);
        let name = |sensor: &str, topic| TopicName { sensor: sensor.to_owned(), topic };
        tilted.begin(&name("mount", Topic::Tilt));
        tilted.begin(&name("hall", Topic::Cloud));
        tilted.begin(&name("hall", Topic::Obstacles));
        assert_eq!((tilted.mounts.len(), tilted.sweeps.len()), (1, 1));
        let wants = |tilted: &Tilted<'_>| {
            [Topic::Tilt, Topic::Cloud, Topic::Obstacles].map(|topic| tilted.wants(topic))
        };
        assert_eq!(wants(&tilted), [false, false, true]);
        assert!(
            !board.is_wanted(tilted.sweeps[0].obstacles),
            "how long they hold is told from when they come"
        );
    }
}
