//! Which channel of a file has which sensor's topic, according to the channel records. In a damaged file they may
//! contradict each other: then a checksum decides, else how often a sensor is named. Refuses to know messages.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io;

use mcap::records::Channel;
use schema::file::{ENCODING, ENCODING_V1};
use schema::{Maker, Topic, check_followed};

/// What a channel is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) sensor: String,
    pub(crate) topic: Topic,
    /// It is of version 1.
    is_old: bool,
}

impl Place {
    /// What `channel` is; nothing if it is somebody else's, or of a name that is no sensor.
    fn of(channel: &Channel) -> Option<Place> {
        let (sensor, topic) = channel.topic.rsplit_once('/')?;
        let is_old = channel.message_encoding == ENCODING_V1;
        let is_ours = (is_old || channel.message_encoding == ENCODING) && check_followed(sensor).is_ok();
        let topic = Topic::parse(topic).filter(|topic| is_ours && topic.maker() == Maker::Link)?;
        Some(Place { sensor: sensor.to_owned(), topic, is_old })
    }

    /// Whether its messages are of version 1.
    pub(crate) fn is_old(&self) -> bool {
        self.is_old
    }

    /// Whether its messages are scans as they are now.
    pub(crate) fn has_scans(&self) -> bool {
        self.topic == Topic::Scan && !self.is_old
    }
}

/// The channels of a file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Channels {
    proven: BTreeMap<u16, Option<Place>>,
    /// The last different ones, the latest at the end.
    likely: BTreeMap<u16, Vec<Place>>,
    /// How often a sensor is named.
    named: HashMap<String, u32>,
    /// The first channel of any sensor.
    first: Option<u16>,
}

impl Channels {
    /// Takes over a channel's record, which may be repeated; `is_proven` if a checksum vouches for it.
    pub(crate) fn note(&mut self, channel: &Channel, is_proven: bool) {
        let place = Place::of(channel);
        if let Some(place) = &place {
            match self.named.get_mut(&place.sensor) {
                Some(count) => *count = count.saturating_add(1),
                None => drop(self.named.insert(place.sensor.clone(), 1)),
            }
            self.first = Some(self.first.map_or(channel.id, |first| first.min(channel.id)));
        }
        if is_proven {
            self.proven.insert(channel.id, place);
        } else if let Some(place) = place {
            let likely = self.likely.entry(channel.id).or_default();
            likely.retain(|other| *other != place);
            likely.push(place);
            if likely.len() > MOST_LIKELY {
                likely.remove(0);
            }
        }
    }

    /// [`io::ErrorKind::FileTooLarge`] if more sensors are named than are kept.
    pub(crate) fn check(&self) -> io::Result<()> {
        if self.named.len() <= MOST_SENSORS {
            return Ok(());
        }
        let what = format!("it names more than {MOST_SENSORS} sensors");
        Err(io::Error::new(io::ErrorKind::FileTooLarge, what))
    }

    /// What the channel with this number is: `None` if nothing is known of it, `Some(None)` if it is somebody else's.
    pub(crate) fn place(&self, id: u16) -> Option<Option<&Place>> {
        if let Some(place) = self.proven.get(&id) {
            return Some(place.as_ref());
        }
        let named = |place: &&Place| self.named.get(&place.sensor);
        self.likely.get(&id)?.iter().max_by_key(named).map(Some)
    }

    /// The sensors that are named, by the numbers of their channels.
    pub(crate) fn sensors(&self) -> Vec<String> {
        let mut ids: Vec<u16> = self.proven.keys().chain(self.likely.keys()).copied().collect();
        ids.sort_unstable();
        let mut seen = HashSet::new();
        let sensors = ids.into_iter().filter_map(|id| Some(&self.place(id)??.sensor));
        sensors.filter(|sensor| seen.insert(*sensor)).cloned().collect()
    }

    /// Whether a channel of the file has `sensor`'s scans.
    pub(crate) fn has_scans(&self, sensor: &str) -> bool {
        let mut places = self.proven.values().flatten().chain(self.likely.values().flatten());
        places.any(|place| place.sensor == sensor && place.has_scans())
    }

    /// The first sensor that is named.
    pub(crate) fn first_sensor(&self) -> Option<&str> {
        self.first.and_then(|id| Some(&self.place(id)??.sensor[..]))
    }
}

/// What a damaged file says about a channel: some bytes of a name may be wrong.
const MOST_LIKELY: usize = 4;
/// Of sixteen hubs with as many sensors as one can have.
const MOST_SENSORS: usize = 4096;

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
        let old = Channel { message_encoding: ENCODING_V1.to_owned(), ..channel(5, "rear/scan") };
        channels.note(&old, true);
        assert!(channels.has_scans("front") && !channels.has_scans("rear"), "scans of version 1 are others");
    }
}
