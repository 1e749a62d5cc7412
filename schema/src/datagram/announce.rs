//! What a gateway announces about a sensor once a second: its name and type, which topic is sent where, and the next
//! number of each topic, from which a listener knows what it lost before the first and after the last datagram.

use crate::{Topic, check_sensor, text};

/// The payload of an announcement, made by a gateway or read from a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Announce {
    /// Run of the hub.
    pub boot: u64,
    name: [u8; NAME],
    kind: [u8; KIND],
    topics: [Announced; MOST],
    count: usize,
    replaced: [u32; MOST],
    /// Of how many topics it says how many samples were replaced: none, or all.
    replaced_count: usize,
}

/// One topic in an announcement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Announced {
    /// Number of the topic, see [`Topic::of_number`].
    pub topic: u8,
    /// The last byte of its group.
    pub group: u8,
    /// Its port.
    pub port: u16,
    /// Number that its next datagram will have.
    pub next: u32,
}

impl Announce {
    /// Topic number of announcements themselves.
    pub const NUMBER: u8 = 0;
    /// The last byte of their group.
    pub const GROUP: u8 = 80;

    /// Makes one for `sensor`, a sensor of type `kind`, without topics.
    pub fn new(boot: u64, sensor: &str, kind: &str) -> Announce {
        let mut announce = Announce {
            boot,
            name: [0; NAME],
            kind: [0; KIND],
            topics: [Announced::default(); MOST],
            count: 0,
            replaced: [0; MOST],
            replaced_count: 0,
        };
        text::write(&mut announce.name, sensor);
        text::write(&mut announce.kind, kind);
        announce
    }

    /// Adds a topic; beyond 16 there is no room and it is left out.
    pub fn add(&mut self, topic: Announced) {
        if let Some(place) = self.topics.get_mut(self.count) {
            *place = topic;
            self.count += 1;
        }
    }

    /// Says of the topic that was added last how many of its samples were replaced by newer ones before they had a number;
    /// the count wraps. To be said of all topics or of none.
    pub fn add_replaced(&mut self, replaced: u64) {
        if let Some(place) = self.replaced[..self.count].last_mut() {
            *place = replaced as u32;
            self.replaced_count = self.count;
        }
    }

    /// Returns how many samples of the topic with this number were replaced by newer ones before they had a number; the count
    /// wraps. Nothing if that is not said.
    pub fn replaced(&self, topic: u8) -> Option<u32> {
        let said = self.topics[..self.replaced_count].iter().zip(self.replaced);
        said.into_iter().find(|(announced, _)| announced.topic == topic).map(|(_, replaced)| replaced)
    }

    /// Returns the revision of the payload: 2 if it says what was replaced, else 1.
    pub fn revision(&self) -> u16 {
        if self.replaced_count > 0 { 2 } else { 1 }
    }

    /// Returns the same announcement of those of its topics alone that are among `topics`.
    pub fn only(&self, topics: &[Topic]) -> Announce {
        let mut only = Announce::new(self.boot, self.sensor(), self.kind());
        for announced in self.topics() {
            if Topic::of_number(announced.topic).is_some_and(|topic| topics.contains(&topic)) {
                only.add(*announced);
                if let Some(replaced) = self.replaced(announced.topic) {
                    only.add_replaced(replaced.into());
                }
            }
        }
        only
    }

    /// Returns the sensor's name.
    pub fn sensor(&self) -> &str {
        text::read(&self.name)
    }

    /// Returns the sensor's type; empty if unknown.
    pub fn kind(&self) -> &str {
        text::read(&self.kind)
    }

    /// Returns the topics that go out.
    pub fn topics(&self) -> &[Announced] {
        &self.topics[..self.count]
    }

    /// Writes the payload to the start of `room`; returns its length, or `None` if there is too little room.
    pub fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let topics_end = TOPICS + EACH * self.count;
        let room = room.get_mut(..topics_end + 4 * self.replaced_count)?;
        room[..8].copy_from_slice(&self.boot.to_le_bytes());
        room[8..40].copy_from_slice(&self.name);
        room[40..64].copy_from_slice(&self.kind);
        let flags = if self.replaced_count > 0 { REPLACED } else { 0 };
        room[64..TOPICS].copy_from_slice(&[self.count as u8, flags, 0, 0]);
        for (bytes, topic) in room[TOPICS..topics_end].chunks_exact_mut(EACH).zip(self.topics()) {
            bytes[..2].copy_from_slice(&[topic.topic, topic.group]);
            bytes[2..4].copy_from_slice(&topic.port.to_le_bytes());
            bytes[4..].copy_from_slice(&topic.next.to_le_bytes());
        }
        let replaced = &self.replaced[..self.replaced_count];
        for (bytes, replaced) in room[topics_end..].chunks_exact_mut(4).zip(replaced) {
            bytes.copy_from_slice(&replaced.to_le_bytes());
        }
        Some(room.len())
    }

    /// Returns the announcement in `payload`; `None` if it is shorter than its own count says, or if its sensor has no possible
    /// name. Topics beyond the 16th are left away. What was replaced is read if it is said of all topics.
    pub fn unpack(payload: &[u8]) -> Option<Announce> {
        let (head, rest) = payload.split_first_chunk::<TOPICS>()?;
        let (rest, more) = rest.split_at_checked(EACH * usize::from(head[64]))?;
        let (boot, _) = head.split_first_chunk()?;
        let mut announce =
            Announce::new(u64::from_le_bytes(*boot), text::read(&head[8..40]), text::read(&head[40..64]));
        // What is no text ends what is read of a field, but not the name.
        let name_len = head[8..40].iter().position(|&byte| byte == 0)?;
        check_sensor(announce.sensor()).ok().filter(|()| announce.sensor().len() == name_len)?;
        for bytes in rest.chunks_exact(EACH) {
            announce.add(Announced {
                topic: bytes[0],
                group: bytes[1],
                port: u16::from_le_bytes([bytes[2], bytes[3]]),
                next: u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]),
            });
        }
        let (replaced, _) = more.as_chunks::<4>();
        if head[65] & REPLACED != 0 && replaced.len() >= usize::from(head[64]) {
            announce.replaced_count = announce.count;
            for (place, bytes) in announce.replaced[..announce.count].iter_mut().zip(replaced) {
                *place = u32::from_le_bytes(*bytes);
            }
        }
        Some(announce)
    }
}

const NAME: usize = 32;
const KIND: usize = 24;
/// Where the topics begin.
const TOPICS: usize = 68;
/// Bytes of a topic.
const EACH: usize = 8;
/// The bit of the flags that says that behind the topics stands how many samples of each were replaced.
const REPLACED: u8 = 1;
/// More topics than there are.
const MOST: usize = 16;

const _: () = assert!(Topic::ALL.len() < MOST);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn announcements_go_there_and_back() {
        let mut announce = Announce::new(0x1122, "front", "LMS200;301063;V02.30");
        for topic in [Topic::Scan, Topic::Status] {
            announce.add(Announced { topic: topic.number(), group: 81, port: 22_200, next: 5 });
        }
        let mut room = [0; 100];
        assert_eq!(announce.pack(&mut room), Some(84));
        assert_eq!(Announce::unpack(&room), Some(announce));
        assert_eq!((announce.sensor(), announce.topics().len()), ("front", 2));
        assert_eq!((Announce::unpack(&room[..83]), announce.pack(&mut [0; 83])), (None, None));
        room[8] = b'/';
        assert_eq!(Announce::unpack(&room), None, "no sensor has such a name");
        room[8..14].copy_from_slice(b"fron\xFF\0");
        assert_eq!(Announce::unpack(&room), None, "nor such");
    }

    #[test]
    fn what_was_replaced_is_said_of_all_topics_or_of_none() {
        let mut announce = Announce::new(1, "front", "");
        announce.add_replaced(9);
        assert_eq!((announce.revision(), announce.replaced(0)), (1, None), "there is no topic");
        for (topic, replaced) in [(Topic::Scan, 7), (Topic::Status, (1 << 32) + 3)] {
            announce.add(Announced { topic: topic.number(), group: 81, port: 22_200, next: 5 });
            announce.add_replaced(replaced);
        }
        let mut room = [0; 100];
        assert_eq!((announce.pack(&mut room), announce.revision()), (Some(92), 2));
        let read = Announce::unpack(&room[..92]).unwrap();
        let replaced = [Topic::Scan, Topic::Status, Topic::Zones].map(|topic| read.replaced(topic.number()));
        assert_eq!((read, replaced), (announce, [Some(7), Some(3), None]));
        let only = read.only(&[Topic::Status, Topic::Zones]);
        assert_eq!(
            (only.sensor(), only.topics(), only.replaced(Topic::Scan.number())),
            ("front", &read.topics()[1..], None)
        );
        assert_eq!(only.replaced(Topic::Status.number()), Some(3));
        let cut = Announce::unpack(&room[..91]).unwrap();
        assert_eq!((cut.topics(), cut.replaced(Topic::Scan.number())), (announce.topics(), None));
    }
}
