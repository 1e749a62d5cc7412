//! The announcement of a sensor, which a gateway sends once a second: name and type of the sensor, and group, port and
//! next sequence number of each topic. The sequence numbers show a listener what it lost before the first and after the
//! last datagram.

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, pod_read_unaligned};

use super::payload::{read_head, write};
use super::{HEAD, MAC, MTU_LEAST};
use crate::{Topic, check_sensor, text};

/// The payload of an announcement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Announce {
    /// Random number of the hub's run.
    pub boot: u64,
    /// All fields but `boot` are as they are sent.
    head: AnnounceHead,
    topics: [Announced; MAX_TOPICS],
    /// Number of replaced samples of each topic, if [`AnnounceHead::REPLACED`] is set.
    replaced: [u32; MAX_TOPICS],
}

/// Start of an announcement, before the topics. 68 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C, packed(4))]
struct AnnounceHead {
    /// Random number of the hub's run.
    boot: u64,
    /// Name of the sensor: 1 to 24 of a-z, 0-9, _ and -.
    sensor_text: [u8; 32],
    /// Type that the sensor reports; empty if unknown.
    type_text: [u8; 24],
    /// Number of topics that are sent.
    count: u8,
    /// Flags: [`AnnounceHead::REPLACED`].
    flags: u8,
    /// 0.
    reserved: [u8; 2],
}

impl AnnounceHead {
    /// Flag, in revision 2 from a bridge: the numbers of replaced samples follow the topics.
    const REPLACED: u8 = 1;
}

/// One topic of an announcement. 8 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Announced {
    /// Number of the topic, as in the header.
    pub topic: u8,
    /// Last byte of the address of its group.
    pub group: u8,
    /// Port that it is sent to.
    pub port: u16,
    /// Sequence number that its next datagram will have.
    pub next: u32,
}

/// Maximum number of topics of an announcement: 37. That many fit into the shortest datagram that a gateway may be limited
/// to, with a MAC and the numbers of replaced samples. An announcement is never sent in parts.
const MAX_TOPICS: usize = (MTU_LEAST - HEAD - MAC - size_of::<AnnounceHead>()) / (size_of::<Announced>() + 4);

const _: () = assert!(Topic::ALL.len() <= MAX_TOPICS);

impl Announce {
    /// Topic number of announcements.
    pub const NUMBER: u8 = 0;
    /// Last byte of the address of their group.
    pub const GROUP: u8 = 80;

    /// Creates an announcement of `sensor`, a sensor of type `kind`, without topics. `boot` identifies the run of its hub.
    pub fn new(boot: u64, sensor: &str, kind: &str) -> Announce {
        let mut head = AnnounceHead::zeroed();
        text::write(&mut head.sensor_text, sensor);
        text::write(&mut head.type_text, kind);
        Announce { boot, head, topics: [Announced::default(); MAX_TOPICS], replaced: [0; MAX_TOPICS] }
    }

    /// Adds a topic, or ignores it if there are 37 already.
    pub fn add(&mut self, topic: Announced) {
        if let Some(place) = self.topics.get_mut(usize::from(self.head.count)) {
            *place = topic;
            self.head.count += 1;
        }
    }

    /// Sets how many samples of the topic that was added last were replaced by newer ones before they got a sequence number.
    /// The number wraps. Call it for all topics or for none.
    pub fn add_replaced(&mut self, replaced: u64) {
        if let Some(place) = self.replaced[..usize::from(self.head.count)].last_mut() {
            *place = replaced as u32;
            self.head.flags |= AnnounceHead::REPLACED;
        }
    }

    /// Returns how many samples of the topic with this number were replaced by newer ones before they got a sequence number.
    /// The number wraps. `None` if the gateway does not report it.
    pub fn replaced(&self, topic: u8) -> Option<u32> {
        let at = self.topics().iter().position(|announced| announced.topic == topic)?;
        self.has_replaced().then(|| self.replaced[at])
    }

    fn has_replaced(&self) -> bool {
        self.head.flags & AnnounceHead::REPLACED != 0
    }

    /// Returns the revision of the payload: 2 with numbers of replaced samples, otherwise 1.
    pub fn revision(&self) -> u16 {
        1 + u16::from(self.has_replaced())
    }

    /// Returns the announcement with only those of its topics that are among `topics`.
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
        text::read(&self.head.sensor_text)
    }

    /// Returns the sensor's type; empty if unknown.
    pub fn kind(&self) -> &str {
        text::read(&self.head.type_text)
    }

    /// Returns the topics that are sent.
    pub fn topics(&self) -> &[Announced] {
        &self.topics[..usize::from(self.head.count)]
    }

    /// Writes the payload to the start of `room`. Returns its length, or `None` if there is too little room.
    pub fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let replaced = if self.has_replaced() { usize::from(self.head.count) } else { 0 };
        let replaced = cast_slice(&self.replaced[..replaced]);
        let head = AnnounceHead { boot: self.boot, ..self.head };
        write(room, &[bytes_of(&head), cast_slice(self.topics()), replaced])
    }

    /// Returns the announcement in `payload`, with its first 37 topics. `None` if it is shorter than its own count requires, or
    /// if the sensor's name is not valid. Numbers of replaced samples are read only if all topics have one.
    pub fn unpack(payload: &[u8]) -> Option<Announce> {
        let head: AnnounceHead = read_head(payload)?;
        let count = usize::from(head.count);
        let (topics, replaced) =
            payload[size_of::<AnnounceHead>()..].split_at_checked(count * size_of::<Announced>())?;
        let mut announce =
            Announce::new(head.boot, text::read(&head.sensor_text), text::read(&head.type_text));
        // A byte that is not UTF-8 ends the text, but not the name.
        let name_len = head.sensor_text.iter().position(|&byte| byte == 0)?;
        check_sensor(announce.sensor()).ok().filter(|()| announce.sensor().len() == name_len)?;
        let is_reported = head.flags & AnnounceHead::REPLACED != 0 && replaced.len() >= 4 * count;
        let mut replaced = replaced.chunks_exact(4).map(pod_read_unaligned::<u32>);
        for topic in topics.chunks_exact(size_of::<Announced>()).take(MAX_TOPICS) {
            announce.add(pod_read_unaligned(topic));
            if let Some(replaced) = replaced.next().filter(|_| is_reported) {
                announce.add_replaced(replaced.into());
            }
        }
        Some(announce)
    }
}

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
    fn an_announcement_with_a_mac_fits_into_the_shortest_datagram() {
        let mut announce = Announce::new(1, "front", "");
        for topic in 0..100 {
            announce.add(Announced { topic, ..Announced::default() });
            announce.add_replaced(topic.into());
        }
        let mut room = [0; MTU_LEAST - HEAD - MAC];
        let len = announce.pack(&mut room).expect("it fits");
        assert_eq!((announce.topics().len(), announce.replaced(36)), (37, Some(99)));
        assert_eq!(Announce::unpack(&room[..len]), Some(announce));
        // A later gateway may announce more.
        let mut longer = vec![0; 68 + 12 * 255];
        longer[..68].copy_from_slice(&room[..68]);
        longer[64] = 255;
        assert_eq!(Announce::unpack(&longer).map(|announce| announce.topics().len()), Some(37));
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
