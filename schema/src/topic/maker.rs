//! Who publishes a topic: all topics of a name that are made together are of one maker. Refuses to know names.

use super::Topic;

/// Who publishes a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Maker {
    /// A hub, of a link; or a listener, of one of another machine.
    Link,
    /// What follows people.
    Tracker,
    /// What turns a mount, or measures its angle.
    Mount,
    /// What makes three dimensions of a scanner on a mount.
    Tilted,
}

impl Maker {
    /// All of them.
    pub const ALL: [Maker; 4] = [Maker::Link, Maker::Tracker, Maker::Mount, Maker::Tilted];

    /// Returns what it publishes, in the order of [`Topic::ALL`].
    pub const fn topics(self) -> &'static [Topic] {
        match self {
            Maker::Link => &Topic::OF_LINKS,
            Maker::Tracker => &[Topic::Tracks, Topic::Events],
            Maker::Mount => &[Topic::Tilt],
            Maker::Tilted => &[Topic::Cloud, Topic::Obstacles],
        }
    }

    /// Returns what a name is called that has its topics.
    pub const fn name(self) -> &'static str {
        match self {
            Maker::Link => "a sensor",
            Maker::Tracker => "a tracker",
            Maker::Mount => "a mount",
            Maker::Tilted => "a cloud",
        }
    }
}

impl Topic {
    /// Returns who publishes it.
    pub fn maker(self) -> Maker {
        let has = |maker: &Maker| maker.topics().contains(&self);
        Maker::ALL.into_iter().find(has).unwrap_or(Maker::Link)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_topic_has_one_maker() {
        let topics: Vec<Topic> = Maker::ALL.into_iter().flat_map(|maker| maker.topics()).copied().collect();
        assert_eq!(topics, Topic::ALL);
        assert_eq!((Topic::Early.maker(), Topic::Events.maker()), (Maker::Link, Maker::Tracker));
        assert_eq!((Topic::Tilt.maker(), Topic::Obstacles.maker()), (Maker::Mount, Maker::Tilted));
    }
}
