//! Which channel of a file has which sensor's topic, as the records of the channels say. Of a file that is harmed they
//! may contradict each other: then a checksum decides, else how often a sensor is named. Refuses to know messages.

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
    fn of(channel: &Channel) -> Option<Place> {
        let (sensor, topic) = channel.topic.rsplit_once('/')?;
        let is_ours = channel.message_encoding == ENCODING && check_followed(sensor).is_ok();
        let topic = Topic::parse(topic).filter(|_| is_ours)?;
        Some(Place { sensor: sensor.to_owned(), topic })
    }
}

/// The channels of a file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Channels {
    proven: BTreeMap<u16, Option<Place>>,
    likely: BTreeMap<u16, Vec<Place>>,
}

impl Channels {
    /// Takes over a channel's record, which may be repeated; `is_proven` if a checksum vouches for it.
    pub(crate) fn note(&mut self, channel: &Channel, is_proven: bool) {
        let place = Place::of(channel);
        if is_proven {
            self.proven.insert(channel.id, place);
        } else if let Some(place) = place {
            self.likely.entry(channel.id).or_default().push(place);
        }
    }

    /// What the channel with this number is: `None` if nothing is known of it, `Some(None)` if it is somebody else's.
    pub(crate) fn place(&self, id: u16) -> Option<Option<&Place>> {
        if let Some(place) = self.proven.get(&id) {
            return Some(place.as_ref());
        }
        let named = |place: &&Place| self.places().filter(|other| other.sensor == place.sensor).count();
        self.likely.get(&id)?.iter().max_by_key(named).map(Some)
    }

    /// The sensors that are named, by the numbers of their channels.
    pub(crate) fn sensors(&self) -> Vec<String> {
        let mut ids: Vec<u16> = self.proven.keys().chain(self.likely.keys()).copied().collect();
        ids.sort_unstable();
        let mut sensors: Vec<String> = Vec::new();
        for place in ids.into_iter().filter_map(|id| self.place(id)?) {
            if !sensors.contains(&place.sensor) {
                sensors.push(place.sensor.clone());
            }
        }
        sensors
    }

    /// Whether a channel of the file is `sensor`'s `topic`.
    pub(crate) fn has(&self, sensor: &str, topic: Topic) -> bool {
        self.places().any(|place| place.sensor == sensor && place.topic == topic)
    }

    fn places(&self) -> impl Iterator<Item = &Place> {
        self.proven.values().flatten().chain(self.likely.values().flatten())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(id: u16, topic: &str) -> Channel {
        let (topic, message_encoding) = (topic.to_owned(), ENCODING.to_owned());
        Channel { id, schema_id: 1, topic, message_encoding, metadata: BTreeMap::new() }
    }

    #[test]
    fn of_two_that_contradict_each_other_the_proven_or_the_usual_name_is_right() {
        let mut channels = Channels::default();
        channels.note(&channel(1, "fsont/telegram"), false);
        channels.note(&channel(1, "front/telegram"), false);
        channels.note(&channel(2, "front/scan"), false);
        channels.note(&channel(3, "reax/telegram"), false);
        channels.note(&channel(3, "rear/telegram"), true);
        channels.note(&Channel { message_encoding: "cdr".to_owned(), ..channel(4, "front/telegram") }, true);
        assert_eq!(channels.place(1).unwrap().unwrap().sensor, "front");
        assert_eq!(channels.place(3).unwrap().unwrap().sensor, "rear");
        assert_eq!((channels.place(4), channels.place(5)), (Some(None), None));
        assert_eq!(channels.sensors(), ["front", "rear"]);
    }
}
