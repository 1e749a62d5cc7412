//! A sample on a network: a datagram, or several if it is longer, readable without a library, checked before any of it is used. Refuses to know
//! sockets, senders and what is missing between two datagrams. Needs neither shared memory nor a heap.

mod announce;
mod datagram_error;
mod lives;
mod numbers;
mod payload;
mod standing;
mod stream_stats;
mod voices;

use crc::{CRC_32_ISCSI, Crc, Table};

pub use announce::{Announce, Announced};
pub use datagram_error::DatagramError;
pub use lives::LIVES;
pub use numbers::{Fresh, Row, WINDOW};
pub use payload::Packed;
pub use standing::{Arrival, Standing};
pub use stream_stats::{GivenUp, ROWS, StreamStats};

use crate::Topic;

/// Bytes before the payload.
pub const HEAD: usize = 48;
/// Bytes of a MAC after the payload, if [`LanFlags::AUTHENTICATED`] is set.
pub const MAC: usize = 16;
/// The longest datagram that is never fragmented where tunnels leave an MTU of 1400.
pub const MTU_SAFE: usize = 1372;
/// The shortest limit that a gateway can be given: what every network has to carry. Longer samples go in parts.
pub const MTU_LEAST: usize = 576;
/// The longest datagram on an Ethernet.
pub const MTU_ETHERNET: usize = 1472;
/// The longest payload of a part.
pub const PART_LONGEST: usize = MTU_ETHERNET - HEAD;
/// The most parts of a sample.
pub const PARTS: usize = 255;
/// Port of all groups.
pub const PORT: u16 = 22_200;
/// The first three bytes of all groups, of which [`group`] is the last.
pub const GROUPS: [u8; 3] = [239, 255, 76];

/// The bits of [`Head::flags`].
pub struct LanFlags;

impl LanFlags {
    /// A MAC follows the payload.
    pub const AUTHENTICATED: u8 = 1;
    /// The sensor is simulated.
    pub const SIMULATED: u8 = 2;
    /// The sensor is a recording.
    pub const REPLAYED: u8 = 4;
    /// The stamp is an estimate.
    pub const STAMP_ESTIMATED: u8 = 8;
    /// The telegram is suspect.
    pub const SUSPECT: u8 = 16;
}

/// The header, before the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// [`Announce::NUMBER`], or a topic's [`Topic::number`].
    pub topic: u8,
    /// Bits of [`LanFlags`].
    pub flags: u8,
    /// The gateway, a random number.
    pub hub: u64,
    /// The gateway's life: seconds since 1970 at its start, or one more than the last one.
    pub epoch: u32,
    /// Number of the sample among those of this sensor and topic, from 0, wrapping.
    pub sequence: u32,
    /// The wall clock of the telegram's first byte, ns since 1970; of announce and status that of sending.
    pub stamp_ns: u64,
    /// Position of the sensor's link in the hub's configuration.
    pub sensor: u8,
    /// Which part of the sample this is, from 0.
    pub part: u8,
    /// In how many parts the sample comes; 1 for most.
    pub parts: u8,
    /// Of which family the sensor is, a number of [`Family`](crate::Family).
    pub family: u8,
    /// Revision of the payload: a greater one only appends.
    pub revision: u16,
    /// The lower half of the sample's `seq`: joins the samples of one telegram.
    pub counter: u32,
}

impl Default for Head {
    /// All 0, and the only part.
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

/// A datagram whose header, lengths and checksum are right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram<'a> {
    /// The header, before the payload.
    pub head: Head,
    /// The payload, or a part of it; [`Packed::unpack`] checks the content of a whole one.
    pub payload: &'a [u8],
    /// The MAC, if there is one. It is not checked here.
    pub mac: Option<&'a [u8; MAC]>,
}

impl Head {
    /// Writes the header before a payload of `len` bytes that starts at [`HEAD`] in `buffer`, and the checksum; returns
    /// the whole datagram, without a MAC. `None` if the buffer ends before the payload does, or if the length does not
    /// fit into two bytes.
    pub fn seal<'a>(&self, buffer: &'a mut [u8], len: usize) -> Option<&'a [u8]> {
        let datagram = buffer.get_mut(..HEAD + len)?;
        self.write(datagram, len, self.flags & !LanFlags::AUTHENTICATED)?;
        Some(checked(datagram))
    }

    /// As [`seal`](Head::seal), with the MAC behind the payload that `mac` makes of header and payload, the checksum in
    /// them 0. `None` also if the buffer ends before the MAC does.
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

    /// Writes the header, with a checksum of 0, to the beginning of `datagram`.
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

/// `datagram` with its checksum, the place of which is 0.
fn checked(datagram: &mut [u8]) -> &[u8] {
    let crc = CRC.checksum(datagram);
    datagram[CRC_AT..HEAD].copy_from_slice(&crc.to_le_bytes());
    datagram
}

/// What the MAC of `bytes`, a datagram that has one and was [`read`](Datagram::read), covers, in three pieces: header and
/// payload with a checksum of 0.
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
    /// use schema::datagram::{Datagram, DatagramError};
    ///
    /// assert_eq!(Datagram::read(b"SHUB"), Err(DatagramError::Short));
    /// ```
    ///
    /// # Errors
    ///
    /// The reason of the first check that fails, in the order of [`DatagramError`].
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

/// Returns the last byte of the group that `topic` goes to: a group for each class of traffic, because switches filter by
/// group and not by port. That of announcements is [`Announce::GROUP`].
pub fn group(topic: Topic) -> u8 {
    topic.row().group
}

const MAGIC: &[u8; 4] = b"SHUB";
const VERSION: u8 = 2;
/// Where the checksum stands; it is taken over the datagram with these four bytes as 0.
const CRC_AT: usize = 44;
const CRC: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISCSI);

// Payloads go out as they lie in memory.
const _: () = assert!(cfg!(target_endian = "little"));

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
