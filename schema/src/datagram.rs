//! A sample as one datagram, or as several if it is longer. Its format needs no library to read, and every field is
//! checked before it is used.
//!
//! This module needs neither shared memory nor a heap. Senders and receivers are in `clients/network`.

mod announce;
mod payload;

use crc::{CRC_32_ISCSI, Crc, Table};

use crate::Topic;

pub use announce::{Announce, Announced};
pub use payload::{FixedPayload, Packed, UsedElements};
pub(crate) use payload::{are_finite, packed_as_is, read_head, used_elements, write};

/// Bytes of the header.
pub const HEAD: usize = 48;
/// Bytes of the MAC after the payload, if [`LanFlags::AUTHENTICATED`] is set.
pub const MAC: usize = 16;
/// Longest datagram that is never fragmented where tunnels leave an MTU of 1400.
pub const MTU_SAFE: usize = 1372;
/// Lowest limit that a gateway accepts, which every network can carry. Longer samples are sent in parts.
pub const MTU_LEAST: usize = 576;
/// Longest datagram on an Ethernet.
pub const MTU_ETHERNET: usize = 1472;
/// Longest payload of a part.
pub const PART_LONGEST: usize = MTU_ETHERNET - HEAD;
/// Maximum number of parts of a sample.
pub const PARTS: usize = 255;
/// Port of all groups.
pub const PORT: u16 = 22_200;
/// First three bytes of all groups. [`group`] returns the last one.
pub const GROUPS: [u8; 3] = [239, 255, 76];

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
    /// Run of the gateway: seconds since 1970 at its start, or one more than the previous run.
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
    /// Payload, or a part of it. [`Packed::unpack`] checks the content of a whole payload.
    pub payload: &'a [u8],
    /// MAC, if the datagram has one. It is not checked here.
    pub mac: Option<&'a [u8; MAC]>,
}

impl Head {
    /// Writes the header and the checksum before a payload of `len` bytes that starts at [`HEAD`] in `buffer`. Returns
    /// the whole datagram, without a MAC, or `None` if the buffer ends before the payload does or the length does not
    /// fit into two bytes.
    pub fn seal<'a>(&self, buffer: &'a mut [u8], len: usize) -> Option<&'a [u8]> {
        let datagram = buffer.get_mut(..HEAD + len)?;
        self.write(datagram, len, self.flags & !LanFlags::AUTHENTICATED)?;
        Some(checked(datagram))
    }

    /// Does the same as [`seal`](Head::seal), and appends the MAC that `mac` computes from header and payload while the
    /// checksum is 0. Also returns `None` if the buffer ends before the MAC does.
    pub fn seal_with<'a>(
        &self,
        buffer: &'a mut [u8],
        len: usize,
        mac: impl FnOnce(&[u8]) -> [u8; MAC],
    ) -> Option<&'a [u8]> {
        let datagram = buffer.get_mut(..HEAD + len + MAC)?;
        self.write(datagram, len, self.flags | LanFlags::AUTHENTICATED)?;
        let (covered, place) = datagram.split_last_chunk_mut::<MAC>()?;
        *place = mac(covered);
        Some(checked(datagram))
    }

    /// Writes the header to the start of `datagram`, with a checksum of 0.
    fn write(&self, datagram: &mut [u8], len: usize, flags: u8) -> Option<()> {
        let (head, _) = datagram.split_first_chunk_mut::<HEAD>()?;
        head[..4].copy_from_slice(MAGIC);
        head[4..8].copy_from_slice(&[VERSION, HEAD as u8, self.topic, flags]);
        head[8..16].copy_from_slice(&self.hub.to_le_bytes());
        head[16..20].copy_from_slice(&self.epoch.to_le_bytes());
        head[20..24].copy_from_slice(&self.sequence.to_le_bytes());
        head[24..32].copy_from_slice(&self.stamp_ns.to_le_bytes());
        head[32..36].copy_from_slice(&[self.sensor, self.part, self.parts, self.family]);
        head[36..38].copy_from_slice(&u16::try_from(len).ok()?.to_le_bytes());
        head[38..40].copy_from_slice(&self.revision.to_le_bytes());
        head[40..44].copy_from_slice(&self.counter.to_le_bytes());
        head[CRC_AT..].fill(0);
        Some(())
    }
}

/// Writes the checksum into `datagram`, whose checksum field is 0, and returns it.
fn checked(datagram: &mut [u8]) -> &[u8] {
    let crc = CRC.checksum(datagram);
    datagram[CRC_AT..HEAD].copy_from_slice(&crc.to_le_bytes());
    datagram
}

/// Returns the three pieces of `bytes` that the MAC covers: header and payload with a checksum of 0. `bytes` is a
/// datagram with a MAC that [`read`](Datagram::read) has accepted.
pub fn covered(bytes: &[u8]) -> [&[u8]; 3] {
    let end = bytes.len().saturating_sub(MAC).max(HEAD);
    [&bytes[..CRC_AT], &[0; HEAD - CRC_AT], &bytes[HEAD..end]]
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
        let (head, _) = bytes.split_first_chunk::<HEAD>().ok_or(DatagramError::Short)?;
        if &head[..4] != MAGIC {
            return Err(DatagramError::Magic);
        }
        if head[4] != VERSION {
            return Err(DatagramError::Version);
        }
        let begin = usize::from(head[5]);
        let (part, parts) = (head[33], head[34]);
        if begin < HEAD || begin > bytes.len() || part >= parts {
            return Err(DatagramError::Header);
        }
        let two = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let four = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| head[at + i]));
        let eight = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| head[at + i]));
        let flags = head[7];
        let (payload, mac) =
            bytes[begin..].split_at_checked(usize::from(two(36))).ok_or(DatagramError::Length)?;
        if parts > 1 && payload.len() > PART_LONGEST {
            return Err(DatagramError::Length);
        }
        let mac = match (flags & LanFlags::AUTHENTICATED != 0, mac) {
            (false, []) => None,
            (true, mac) => Some(mac.try_into().map_err(|_| DatagramError::Length)?),
            _ => return Err(DatagramError::Length),
        };
        let mut digest = CRC.digest();
        digest.update(&bytes[..CRC_AT]);
        digest.update(&[0; HEAD - CRC_AT]);
        digest.update(&bytes[HEAD..]);
        if digest.finalize() != four(CRC_AT) {
            return Err(DatagramError::Crc);
        }
        let head = Head {
            topic: head[6],
            flags,
            hub: eight(8),
            epoch: four(16),
            sequence: four(20),
            stamp_ns: eight(24),
            sensor: head[32],
            part,
            parts,
            family: head[35],
            revision: two(38),
            counter: four(40),
        };
        Ok(Datagram { head, payload, mac })
    }
}

/// Returns the last byte of the group that `topic` is sent to. There is one group for each class of traffic, because
/// switches filter by group and not by port. The group of announcements is [`Announce::GROUP`].
pub fn group(topic: Topic) -> u8 {
    topic.row().group
}

const MAGIC: &[u8; 4] = b"SHUB";
const VERSION: u8 = 2;
/// Offset of the checksum, which is computed with these four bytes as 0.
const CRC_AT: usize = 44;
const CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISCSI);

// Payloads are sent as they are in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// Reason why a datagram is refused. The reasons are in the order of the checks, and the first check that fails counts.
/// [`Datagram::read`] returns those up to the checksum, [`Datagram::check_payload`] the last two, and receivers the others.
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
    /// A later epoch of the same gateway is known.
    Epoch,
    /// A key is required, and the sensor or topic was not announced within 5 s of this machine's clock. The datagram
    /// may be a recorded one.
    Untimely,
    /// It comes from another sender than the other datagrams of this gateway and epoch, and is not known to come from
    /// the same gateway. A second gateway probably has the same number.
    Twin,
    /// The sequence number is older than the window, so it is unknown whether the sample is a duplicate.
    Stale,
    /// There is no memory for another gateway that delivers, or for another of its topics.
    Capacity,
    /// This version does not have the topic.
    Skipped,
    /// The payload is shorter than its own counts require, contradicts itself or has no revision, or it is a single
    /// part.
    Payload,
}

impl DatagramError {
    /// All reasons, in the order of the checks.
    pub const ALL: [DatagramError; 15] = [
        DatagramError::Short,
        DatagramError::Magic,
        DatagramError::Version,
        DatagramError::Header,
        DatagramError::Length,
        DatagramError::Crc,
        DatagramError::Unauthenticated,
        DatagramError::Mac,
        DatagramError::Epoch,
        DatagramError::Untimely,
        DatagramError::Twin,
        DatagramError::Stale,
        DatagramError::Capacity,
        DatagramError::Skipped,
        DatagramError::Payload,
    ];

    /// Returns the reason's name in all output.
    pub fn name(self) -> &'static str {
        match self {
            DatagramError::Short => "short",
            DatagramError::Magic => "magic",
            DatagramError::Version => "version",
            DatagramError::Header => "header",
            DatagramError::Length => "length",
            DatagramError::Crc => "crc",
            DatagramError::Unauthenticated => "unauthenticated",
            DatagramError::Mac => "mac",
            DatagramError::Epoch => "epoch",
            DatagramError::Untimely => "untimely",
            DatagramError::Twin => "twin",
            DatagramError::Stale => "stale",
            DatagramError::Capacity => "capacity",
            DatagramError::Skipped => "skipped",
            DatagramError::Payload => "payload",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sealed(head: Head, payload: &[u8]) -> Vec<u8> {
        let mut buffer = [0xAA; MTU_ETHERNET];
        buffer[HEAD..HEAD + payload.len()].copy_from_slice(payload);
        head.seal(&mut buffer, payload.len()).unwrap().to_vec()
    }

    #[test]
    fn the_checksum_is_that_of_the_catalogue() {
        assert_eq!(CRC.checksum(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn datagrams_go_there_and_back() {
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
        assert_eq!(head.seal(&mut [0; HEAD], 1), None);
        assert_eq!(head.seal(&mut vec![0; 70_000], 65_536), None);
    }

    #[test]
    fn the_first_failing_check_names_the_reason() {
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
    fn a_part_is_no_longer_than_a_datagram_on_an_ethernet() {
        let of = |parts, len| {
            let (head, mut buffer) = (Head { parts, ..Head::default() }, vec![0; 2000]);
            Datagram::read(head.seal(&mut buffer, len).unwrap()).map(|datagram| datagram.payload.len())
        };
        assert_eq!((of(2, PART_LONGEST), of(1, 1900)), (Ok(PART_LONGEST), Ok(1900)));
        assert_eq!(of(2, PART_LONGEST + 1), Err(DatagramError::Length));
    }

    #[test]
    fn every_flipped_bit_is_seen() {
        let good = sealed(Head { hub: 9, ..Head::default() }, &[0x55; 100]);
        for bit in 0..8 * good.len() {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(Datagram::read(&bytes).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn a_longer_header_of_a_later_version_is_skipped() {
        let mut bytes = sealed(Head::default(), b"1234");
        bytes.splice(HEAD..HEAD, [1, 2, 3, 4]);
        bytes[5] = 52;
        bytes[CRC_AT..HEAD].fill(0);
        let crc = CRC.checksum(&bytes).to_le_bytes();
        bytes[CRC_AT..HEAD].copy_from_slice(&crc);
        assert_eq!(Datagram::read(&bytes).unwrap().payload, b"1234");
    }
}
