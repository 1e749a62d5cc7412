//! Format of datagrams. A gateway sends a sample in one datagram, or in several parts if the sample is too long for
//! one. The gateway also sends an announcement of each sensor once a second. A reader needs no library for the format.
//! Every field is checked before it is used.
//!
//! This module needs neither shared memory nor a heap. Senders and receivers are in `clients/network`.

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, pod_read_unaligned};
use crc::{CRC_32_ISCSI, Crc, Table};

use crate::payload::{read_head, write};
use crate::text::named;
use crate::{Topic, check_sensor, text};

pub use crate::payload::{DatagramPayload, FixedPayload, UsedElements};

/// Length of the header in bytes.
pub const HEADER_LEN: usize = size_of::<DatagramHead>();
/// Length in bytes of the MAC, which follows the payload if [`LanFlags::AUTHENTICATED`] is set.
pub const MAC_LEN: usize = 16;
/// Length in bytes of the longest datagram that is not fragmented if the MTU is 1400, as in many tunnels.
pub const MTU_SAFE: usize = 1372;
/// Lowest limit in bytes that a gateway accepts for the length of its datagrams. Every network can carry datagrams of
/// this length. Samples that need longer datagrams are sent in parts.
pub const MIN_MTU: usize = 576;
/// Length in bytes of the longest datagram that fits into one Ethernet frame.
pub const MTU_ETHERNET: usize = 1472;
/// Maximum length in bytes of the payload of a part.
pub const MAX_PART_LEN: usize = MTU_ETHERNET - HEADER_LEN;
/// Maximum number of parts of a sample.
pub const MAX_PARTS: usize = 255;
/// UDP port of all multicast groups.
pub const PORT: u16 = 22_200;
/// First three bytes of the addresses of all multicast groups. [`group`] returns the last byte.
pub const GROUP_PREFIX: [u8; 3] = [239, 255, 76];

/// Header of a datagram as it is sent. 48 bytes.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct DatagramHead {
    /// Magic: `SHUB`.
    magic: [u8; 4],
    /// Version: 2.
    version: u8,
    /// Length of the header: 48. A later gateway may append fields; readers skip them.
    header_len: u8,
    /// Number of the topic. See the table of groups.
    topic: u8,
    /// Flags: [`LanFlags`]. Readers ignore other bits.
    flags: u8,
    /// Random number of the gateway, the same in all its runs.
    hub: u64,
    /// Number of the gateway's run, higher than in every earlier run.
    epoch: u32,
    /// Number of the sample among the samples of this sensor and topic, from 0 in each epoch. The number wraps.
    sequence: u32,
    /// Wall clock of the telegram's first byte, in ns since 1970. For announcements and `status`, the time of sending.
    stamp_ns: u64,
    /// Position of the sensor's link in the hub's configuration, from 0.
    sensor: u8,
    /// Index of this part within the sample, from 0.
    part: u8,
    /// Number of parts of the sample, mostly 1.
    parts: u8,
    /// Family of the sensor: [`Family`](crate::Family); 255 while the hub searches for the scanner. Other numbers
    /// are families of later versions. The format of their telegrams is unknown.
    family: u8,
    /// Length in bytes of the payload, or of this part of it, without the MAC.
    payload_len: u16,
    /// Revision of the payload, from 1. A higher revision only appends fields.
    revision: u16,
    /// Lower half of the sample's `seq`, which the samples of one telegram share.
    counter: u32,
    /// CRC-32C of the datagram, computed with 0 in this field.
    crc: u32,
}

/// Bits of [`Head::flags`].
pub struct LanFlags;

impl LanFlags {
    /// A MAC follows the payload.
    pub const AUTHENTICATED: u8 = 1;
    /// The sensor is simulated.
    pub const SIMULATED: u8 = 2;
    /// The sensor is a replayed recording.
    pub const REPLAYED: u8 = 4;
    /// The stamp is estimated.
    pub const STAMP_ESTIMATED: u8 = 8;
    /// The telegram is suspect.
    pub const SUSPECT: u8 = 16;
}

/// Header of a datagram, before the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// [`Announce::NUMBER`], or a topic's [`Topic::number`].
    pub topic: u8,
    /// Bits of [`LanFlags`].
    pub flags: u8,
    /// Random number of the gateway.
    pub hub: u64,
    /// Number of the gateway's run: seconds since 1970 at its start, or one more than the number of the previous run.
    pub epoch: u32,
    /// Sequence number of the sample within this sensor and topic. It starts at 0 and wraps.
    pub sequence: u32,
    /// Wall-clock time of the telegram's first byte, in ns since 1970. For announcements and `status`, the time of
    /// sending.
    pub stamp_ns: u64,
    /// Position of the sensor's link in the hub's configuration.
    pub sensor: u8,
    /// Index of this part within the sample, from 0.
    pub part: u8,
    /// Number of parts of the sample, mostly 1.
    pub parts: u8,
    /// Family of the sensor, a number of [`Family`](crate::Family).
    pub family: u8,
    /// Revision of the payload. A higher revision only appends fields.
    pub revision: u16,
    /// Lower half of the sample's `seq`, which the samples of one telegram share.
    pub counter: u32,
}

impl Default for Head {
    /// Returns a header whose fields are 0, for a sample of one part.
    fn default() -> Self {
        Head {
            topic: 0,
            flags: 0,
            hub: 0,
            epoch: 0,
            sequence: 0,
            stamp_ns: 0,
            sensor: 0,
            part: 0,
            parts: 1,
            family: 0,
            revision: 0,
            counter: 0,
        }
    }
}

/// A datagram with a valid header, consistent lengths and a correct checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// Header, before the payload.
    pub head: Head,
    /// Payload, or a part of it. [`DatagramPayload::unpack`] checks the content of a whole payload.
    pub payload: &'a [u8],
    /// MAC, if the datagram has one. This module does not check the MAC.
    pub mac: Option<&'a [u8; MAC_LEN]>,
}

impl Head {
    /// Writes the header and the checksum before a payload of `len` bytes that starts at [`HEADER_LEN`] in `buffer`.
    /// Returns the whole datagram, without a MAC, or `None` if the buffer ends before the payload does or the length
    /// does not fit into two bytes.
    pub fn seal<'a>(&self, buffer: &'a mut [u8], len: usize) -> Option<&'a [u8]> {
        let datagram = buffer.get_mut(..HEADER_LEN + len)?;
        self.write(datagram, len, self.flags & !LanFlags::AUTHENTICATED)?;
        Some(add_checksum(datagram))
    }

    /// Does the same as [`seal`](Head::seal), and appends the MAC that `mac` computes from header and payload while the
    /// checksum is 0. Returns `None` in the same cases, and if the buffer has no room for the MAC.
    pub fn seal_with<'a>(
        &self,
        buffer: &'a mut [u8],
        len: usize,
        mac: impl FnOnce(&[u8]) -> [u8; MAC_LEN],
    ) -> Option<&'a [u8]> {
        let datagram = buffer.get_mut(..HEADER_LEN + len + MAC_LEN)?;
        self.write(datagram, len, self.flags | LanFlags::AUTHENTICATED)?;
        let (input, mac_field) = datagram.split_last_chunk_mut::<MAC_LEN>()?;
        *mac_field = mac(input);
        Some(add_checksum(datagram))
    }

    /// Writes the header to the start of `datagram`, with a checksum of 0.
    fn write(&self, datagram: &mut [u8], len: usize, flags: u8) -> Option<()> {
        let &Head { topic, hub, epoch, sequence, stamp_ns, .. } = self;
        let &Head { sensor, part, parts, family, revision, counter, .. } = self;
        let (magic, version, header_len) = (MAGIC, VERSION, HEADER_LEN as u8);
        let (payload_len, crc) = (u16::try_from(len).ok()?, 0);
        let head = DatagramHead {
            magic,
            version,
            header_len,
            topic,
            flags,
            hub,
            epoch,
            sequence,
            stamp_ns,
            sensor,
            part,
            parts,
            family,
            payload_len,
            revision,
            counter,
            crc,
        };
        datagram.get_mut(..HEADER_LEN)?.copy_from_slice(bytes_of(&head));
        Some(())
    }
}

/// Writes the checksum into `datagram`, whose checksum field is 0, and returns it.
fn add_checksum(datagram: &mut [u8]) -> &[u8] {
    let crc = CRC.checksum(datagram);
    datagram[CRC_OFFSET..HEADER_LEN].copy_from_slice(&crc.to_le_bytes());
    datagram
}

/// Returns the bytes that the MAC of a datagram covers, in three pieces: the header before the checksum, four zeros in
/// place of the checksum, and the rest without the MAC. `bytes` is a datagram with a MAC that [`read`](Datagram::read)
/// has accepted.
pub fn mac_input(bytes: &[u8]) -> [&[u8]; 3] {
    let end = bytes.len().saturating_sub(MAC_LEN).max(HEADER_LEN);
    [&bytes[..CRC_OFFSET], &[0; HEADER_LEN - CRC_OFFSET], &bytes[HEADER_LEN..end]]
}

impl<'a> Datagram<'a> {
    /// Checks `bytes`, a whole datagram as it was received.
    ///
    /// # Examples
    ///
    /// ```
    /// use scanhub_schema::datagram::{Datagram, DatagramError};
    ///
    /// assert_eq!(Datagram::read(b"SHUB"), Err(DatagramError::Short));
    /// ```
    ///
    /// # Errors
    ///
    /// Returns the reason of the first check that fails, in the order of [`DatagramError`].
    pub fn read(bytes: &'a [u8]) -> Result<Datagram<'a>, DatagramError> {
        let head: DatagramHead = read_head(bytes).ok_or(DatagramError::Short)?;
        if head.magic != MAGIC {
            return Err(DatagramError::Magic);
        }
        if head.version != VERSION {
            return Err(DatagramError::Version);
        }
        let DatagramHead { topic, flags, hub, epoch, sequence, stamp_ns, .. } = head;
        let DatagramHead { sensor, part, parts, family, revision, counter, .. } = head;
        let begin = usize::from(head.header_len);
        if begin < HEADER_LEN || begin > bytes.len() || part >= parts {
            return Err(DatagramError::Header);
        }
        let payload_len = usize::from(head.payload_len);
        let (payload, mac) = bytes[begin..].split_at_checked(payload_len).ok_or(DatagramError::Length)?;
        if parts > 1 && payload.len() > MAX_PART_LEN {
            return Err(DatagramError::Length);
        }
        let mac = match (flags & LanFlags::AUTHENTICATED != 0, mac) {
            (false, []) => None,
            (true, mac) => Some(mac.try_into().map_err(|_| DatagramError::Length)?),
            _ => return Err(DatagramError::Length),
        };
        let mut digest = CRC.digest();
        digest.update(&bytes[..CRC_OFFSET]);
        digest.update(&[0; HEADER_LEN - CRC_OFFSET]);
        digest.update(&bytes[HEADER_LEN..]);
        if digest.finalize() != head.crc {
            return Err(DatagramError::Crc);
        }
        let head = Head {
            topic,
            flags,
            hub,
            epoch,
            sequence,
            stamp_ns,
            sensor,
            part,
            parts,
            family,
            revision,
            counter,
        };
        Ok(Datagram { head, payload, mac })
    }
}

/// Returns the last byte of the address of the multicast group that `topic` is sent to. There is one group for each
/// class of traffic, because switches filter by group and not by port. The group of announcements is
/// [`Announce::GROUP`].
pub fn group(topic: Topic) -> u8 {
    topic.spec().group
}

const MAGIC: [u8; 4] = *b"SHUB";
const VERSION: u8 = 2;
/// Offset of the checksum, which is computed with these four bytes as 0.
const CRC_OFFSET: usize = std::mem::offset_of!(DatagramHead, crc);
const CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISCSI);

// Payloads are sent as they are in memory, and the format is little-endian.
const _: () = assert!(cfg!(target_endian = "little"));

/// Reason why a datagram is refused. The reasons are in the order of the checks, and a datagram is refused for the
/// first check that fails. [`Datagram::read`] returns the reasons up to [`Crc`](Self::Crc), [`Datagram::check_payload`]
/// returns the last two, and receivers add the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DatagramError {
    /// Fewer bytes than a header.
    Short,
    /// No `SHUB` at the start.
    Magic,
    /// Another version.
    Version,
    /// The header is shorter than in this version or longer than the datagram, or the part's index is too high.
    Header,
    /// The lengths do not add up to the length of the datagram, or a part is too long.
    Length,
    /// The checksum is wrong.
    Crc,
    /// A key is required, and the datagram has no MAC.
    Unauthenticated,
    /// The MAC was not computed with the required key.
    Mac,
    /// The epoch is earlier than a known epoch of the same gateway.
    Epoch,
    /// A key is required, and the sensor or topic was not announced within 5 s of this machine's clock. The datagram
    /// may have been recorded and sent again.
    Untimely,
    /// The other datagrams of this gateway and epoch came from another sender, and this sender is not known to be the
    /// same gateway. A second gateway probably has the same number.
    Twin,
    /// The sequence number is older than the window in which duplicates are detected, so the sample may be a duplicate.
    Stale,
    /// There is no memory for another gateway that sends samples, or for another topic of this gateway.
    Capacity,
    /// This version does not have the topic.
    Skipped,
    /// The payload is shorter than its own counts require, contradicts itself or has no revision, or the datagram has
    /// only a part of a sample.
    Payload,
}

named! {
    DatagramError:
    Short "short",
    Magic "magic",
    Version "version",
    Header "header",
    Length "length",
    Crc "crc",
    Unauthenticated "unauthenticated",
    Mac "mac",
    Epoch "epoch",
    Untimely "untimely",
    Twin "twin",
    Stale "stale",
    Capacity "capacity",
    Skipped "skipped",
    Payload "payload",
}

/// The payload of an announcement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Announce {
    /// Random number of the hub's run.
    pub boot: u64,
    /// All other fields, as they are sent. The `boot` in this head is 0.
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
    /// Last byte of the address of the topic's group.
    pub group: u8,
    /// Port that the topic is sent to.
    pub port: u16,
    /// Sequence number that the topic's next datagram will have.
    pub next: u32,
}

/// Maximum number of topics of an announcement: 37. This is how many fit into a datagram of [`MIN_MTU`] bytes, together
/// with a MAC and the numbers of replaced samples. An announcement is never sent in parts.
const MAX_TOPICS: usize =
    (MIN_MTU - HEADER_LEN - MAC_LEN - size_of::<AnnounceHead>()) / (size_of::<Announced>() + 4);

const _: () = assert!(Topic::ALL.len() <= MAX_TOPICS);

impl Announce {
    /// Value of [`Head::topic`] in announcements.
    pub const NUMBER: u8 = 0;
    /// Last byte of the address of the multicast group for announcements.
    pub const GROUP: u8 = 80;

    /// Creates an announcement of `sensor`, a sensor of type `kind`, without topics. `boot` identifies the run of the
    /// sensor's hub.
    pub fn new(boot: u64, sensor: &str, kind: &str) -> Announce {
        let mut head = AnnounceHead::zeroed();
        text::write(&mut head.sensor_text, sensor);
        text::write(&mut head.type_text, kind);
        Announce { boot, head, topics: [Announced::default(); MAX_TOPICS], replaced: [0; MAX_TOPICS] }
    }

    /// Adds `topic`, or ignores it if the announcement already has 37 topics.
    pub fn add(&mut self, topic: Announced) {
        if let Some(slot) = self.topics.get_mut(usize::from(self.head.count)) {
            *slot = topic;
            self.head.count += 1;
        }
    }

    /// Sets how many samples of the topic that was added last were replaced by newer ones before they got a sequence
    /// number. The number wraps. Call this function for all topics or for none.
    pub fn add_replaced(&mut self, replaced: u64) {
        if let Some(slot) = self.replaced[..usize::from(self.head.count)].last_mut() {
            *slot = replaced as u32;
            self.head.flags |= AnnounceHead::REPLACED;
        }
    }

    /// Returns how many samples of the topic with this number were replaced by newer ones before they got a sequence
    /// number. The number wraps. Returns `None` if the gateway does not report this number.
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

    /// Returns the announcement without the topics that are not in `topics`.
    pub fn restricted_to(&self, topics: &[Topic]) -> Announce {
        let mut restricted = Announce::new(self.boot, self.sensor(), self.kind());
        for announced in self.topics() {
            if Topic::of_number(announced.topic).is_some_and(|topic| topics.contains(&topic)) {
                restricted.add(*announced);
                if let Some(replaced) = self.replaced(announced.topic) {
                    restricted.add_replaced(replaced.into());
                }
            }
        }
        restricted
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

    /// Writes the payload to the start of `room`. Returns the length of the payload, or `None` if `room` is too short.
    pub fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let replaced = if self.has_replaced() { usize::from(self.head.count) } else { 0 };
        let replaced = cast_slice(&self.replaced[..replaced]);
        let head = AnnounceHead { boot: self.boot, ..self.head };
        write(room, &[bytes_of(&head), cast_slice(self.topics()), replaced])
    }

    /// Returns the announcement in `payload`, with its first 37 topics. Returns `None` if `payload` is shorter than its
    /// number of topics requires, or if the sensor's name is not valid. Numbers of replaced samples are read only if
    /// `payload` has one for each topic.
    pub fn unpack(payload: &[u8]) -> Option<Announce> {
        let head: AnnounceHead = read_head(payload)?;
        let count = usize::from(head.count);
        let (topics, replaced) =
            payload[size_of::<AnnounceHead>()..].split_at_checked(count * size_of::<Announced>())?;
        let mut announce =
            Announce::new(head.boot, text::read(&head.sensor_text), text::read(&head.type_text));
        // A byte that is not UTF-8 ends the text that `sensor` returns. The name is then rejected, because the text
        // ends before the first 0.
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

    fn sealed(head: Head, payload: &[u8]) -> Vec<u8> {
        let mut buffer = [0xAA; MTU_ETHERNET];
        buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
        head.seal(&mut buffer, payload.len()).unwrap().to_vec()
    }

    #[test]
    fn checksum_matches_the_crc_catalogue() {
        assert_eq!(CRC.checksum(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn datagrams_round_trip() {
        let head = Head {
            topic: Topic::Scan.number(),
            flags: LanFlags::SUSPECT,
            hub: 1,
            epoch: 2,
            sequence: 3,
            stamp_ns: 4,
            sensor: 5,
            part: 1,
            parts: 255,
            family: 8,
            revision: 6,
            counter: 7,
        };
        let bytes = sealed(head, b"payload");
        assert_eq!(Datagram::read(&bytes), Ok(Datagram { head, payload: b"payload", mac: None }));
        assert_eq!(head.seal(&mut [0; HEADER_LEN], 1), None);
        assert_eq!(head.seal(&mut vec![0; 70_000], 65_536), None);
    }

    #[test]
    fn first_failing_check_names_the_reason() {
        let good = sealed(Head::default(), b"1234");
        let with = |at: usize, byte: u8| {
            let mut bytes = good.clone();
            bytes[at] = byte;
            Datagram::read(&bytes).unwrap_err()
        };
        assert_eq!(Datagram::read(&good[..47]), Err(DatagramError::Short));
        assert_eq!(with(0, b'X'), DatagramError::Magic);
        assert_eq!((with(4, 1), with(4, 3)), (DatagramError::Version, DatagramError::Version));
        assert_eq!((with(33, 1), with(34, 0)), (DatagramError::Header, DatagramError::Header));
        assert_eq!((with(5, 47), with(5, 53)), (DatagramError::Header, DatagramError::Header));
        assert_eq!(
            (with(36, 3), with(36, 5), with(7, 1)),
            (DatagramError::Length, DatagramError::Length, DatagramError::Length)
        );
        assert_eq!((with(44, 0), with(51, 0)), (DatagramError::Crc, DatagramError::Crc));
        assert_eq!(
            Datagram::read(&[&good[..], &[0]].concat()),
            Err(DatagramError::Length),
            "nothing may follow"
        );
    }

    #[test]
    fn part_is_no_longer_than_a_datagram_on_an_ethernet() {
        let of = |parts, len| {
            let (head, mut buffer) = (Head { parts, ..Head::default() }, vec![0; 2000]);
            Datagram::read(head.seal(&mut buffer, len).unwrap()).map(|datagram| datagram.payload.len())
        };
        assert_eq!((of(2, MAX_PART_LEN), of(1, 1900)), (Ok(MAX_PART_LEN), Ok(1900)));
        assert_eq!(of(2, MAX_PART_LEN + 1), Err(DatagramError::Length));
    }

    #[test]
    fn every_flipped_bit_is_detected() {
        let good = sealed(Head { hub: 9, ..Head::default() }, &[0x55; 100]);
        for bit in 0..8 * good.len() {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(Datagram::read(&bytes).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn longer_header_of_a_later_version_is_skipped() {
        let mut bytes = sealed(Head::default(), b"1234");
        bytes.splice(HEADER_LEN..HEADER_LEN, [1, 2, 3, 4]);
        bytes[5] = 52;
        bytes[CRC_OFFSET..HEADER_LEN].fill(0);
        let crc = CRC.checksum(&bytes).to_le_bytes();
        bytes[CRC_OFFSET..HEADER_LEN].copy_from_slice(&crc);
        assert_eq!(Datagram::read(&bytes).unwrap().payload, b"1234");
    }

    #[test]
    fn announcements_round_trip() {
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
    fn longest_announcement_fits_the_shortest_datagram() {
        let mut announce = Announce::new(1, "front", "");
        for topic in 0..100 {
            announce.add(Announced { topic, ..Announced::default() });
            announce.add_replaced(topic.into());
        }
        let mut room = [0; MIN_MTU - HEADER_LEN - MAC_LEN];
        let len = announce.pack(&mut room).expect("it fits");
        assert_eq!((announce.topics().len(), announce.replaced(36)), (37, Some(99)));
        assert_eq!(Announce::unpack(&room[..len]), Some(announce));
        // A gateway of a later version may announce more topics.
        let mut longer = vec![0; 68 + 12 * 255];
        longer[..68].copy_from_slice(&room[..68]);
        longer[64] = 255;
        assert_eq!(Announce::unpack(&longer).map(|announce| announce.topics().len()), Some(37));
    }

    #[test]
    fn replaced_counts_cover_all_topics_or_none() {
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
        let only = read.restricted_to(&[Topic::Status, Topic::Zones]);
        assert_eq!(
            (only.sensor(), only.topics(), only.replaced(Topic::Scan.number())),
            ("front", &read.topics()[1..], None)
        );
        assert_eq!(only.replaced(Topic::Status.number()), Some(3));
        let cut = Announce::unpack(&room[..91]).unwrap();
        assert_eq!((cut.topics(), cut.replaced(Topic::Scan.number())), (announce.topics(), None));
    }
}
