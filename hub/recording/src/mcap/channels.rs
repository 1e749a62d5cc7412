//! Which channel of a file has which sensor's topic, as the names of the channels say. Refuses to know messages.

use std::collections::BTreeMap;

use mcap::records::Channel;
use schema::file::ENCODING;
use schema::{Topic, check_followed};

/// What a channel is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) sensor: String,
    pub(crate) topic: Topic,
}

impl Place {
    /// What `channel` is; nothing if it is somebody else's.
    pub(crate) fn of(channel: &Channel) -> Option<Place> {
        let (sensor, topic) = channel.topic.rsplit_once('/')?;
        let is_ours = channel.message_encoding == ENCODING && check_followed(sensor).is_ok();
        let topic = Topic::parse(topic).filter(|_| is_ours)?;
        Some(Place { sensor: sensor.to_owned(), topic })
    }
}

/// The channels of a file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Channels(BTreeMap<u16, Place>);

impl Channels {
    /// Takes over a channel's record, which may be repeated.
    pub(crate) fn note(&mut self, channel: &Channel) {
        if let Some(place) = Place::of(channel) {
            self.0.insert(channel.id, place);
        }
    }

    /// What the channel with this number is.
    pub(crate) fn place(&self, id: u16) -> Option<&Place> {
        self.0.get(&id)
    }
}
