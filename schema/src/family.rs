//! Families of scanners: their numbers and names, the codes of the SICK LMS 2xx, and the content of topic `telegram`.
//!
//! A telegram has the bytes of a scanner in the unit in which its family transmits: one telegram of an LMS from STX to
//! CRC, or whole packets of another family that arrived together. The hub checks a telegram before publishing it.

use std::f64::consts::TAU;
use std::ops::{Deref, DerefMut};

use bytemuck::TransparentWrapper;
use bytemuck::allocation::TransparentWrapperAlloc;

use crate::text::named;
use crate::{ArrayFlags, Code, ScanHead};

/// A family of scanners with one protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Family {
    /// SICK LMS 200, 211, 221 and 291.
    Lms = 0,
    /// LDROBOT LD06, LD19, STL19P, STL27L and LD14P.
    Ld = 1,
    /// Slamtec RPLIDAR A1, A2, A3, S1, S2, S3 and C1.
    Rplidar = 2,
}

/// Contents of a telegram of a family that sends packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketInfo {
    /// `data`, or `reply` to a request.
    pub kind: &'static str,
    /// Whether the checksums are correct; `None` if the packets have no checksums.
    pub checked: Option<bool>,
    /// Number of packets.
    pub packets: usize,
}

named! {
    Family:
    Lms "lms",
    Ld "ld",
    Rplidar "rplidar",
}

impl Family {
    /// Number in place of a family while the hub searches for the scanner.
    pub const UNKNOWN: u8 = 255;

    /// Returns the family called `name`, in upper or lower case.
    pub fn parse(name: &str) -> Option<Family> {
        Family::ALL.into_iter().find(|family| family.name().eq_ignore_ascii_case(name))
    }

    /// Returns the maximum number of bytes of a telegram, or of packets that are published together.
    pub const fn max_telegram(self) -> usize {
        match self {
            // Telegram listing: 812 bytes, and two more for the checksum.
            Family::Lms => 814,
            // The packets of 10 ms. In this family, an STL27L sends the most packets.
            Family::Ld => 17 * LD_PACKET_LEN,
            Family::Rplidar => 800,
        }
    }

    /// Returns whether the family's intensities are levels of reflectors, with 0 for any other surface. If not, the
    /// intensity of every surface is measured, and the user must configure the threshold for reflectors.
    pub fn has_reflector_levels(self) -> bool {
        self == Family::Lms
    }

    /// Returns the contents of `bytes`, a telegram of the family. `None` if the family does not send packets.
    pub fn packets(self, bytes: &[u8]) -> Option<PacketInfo> {
        match self {
            Family::Lms => None,
            // An LDROBOT sends no replies, and the hub publishes only packets with a correct checksum.
            Family::Ld => {
                let packets = bytes.len() / LD_PACKET_LEN;
                Some(PacketInfo { kind: "data", checked: Some(true), packets })
            }
            Family::Rplidar => Some(slamtec_packets(bytes)),
        }
    }

    /// Returns the family with this number, as in a scan's head.
    pub fn of_number(number: u8) -> Option<Family> {
        Family::ALL.into_iter().find(|family| *family as u8 == number)
    }
}

impl ScanHead {
    /// Returns the head of a scan of one revolution. The scanner is of `family` and rotates clockwise. The points of
    /// the revolution are assigned to a grid of `beams` equal bins, and the first bin is straight ahead. Ranges are in
    /// millimeters, intensities have 8 bits, and angles are exact. The caller sets the times.
    pub fn of_revolution(family: Family, beams: usize) -> ScanHead {
        let step = -TAU / beams.max(1) as f64;
        ScanHead {
            step,
            spacing: -step as f32,
            unit_um: 1000,
            count: beams as u16,
            valid_to: Code::Error.value() - 1,
            no_return: Code::NoReturn.value(),
            beyond: Code::NoReturn.value(),
            family: family as u8,
            contents: ArrayFlags::REVOLUTION,
            intensity_bits: 8,
            ..ScanHead::default()
        }
    }
}

/// Length of a packet of an LDROBOT (manual of the LD19, "data packet format").
const LD_PACKET_LEN: usize = 47;

/// Returns the contents of an RPLIDAR's packets or response. A packet of one point has neither a checksum nor a type. A
/// packet of any other type has a head and a checksum, which identify it (rplidar_sdk, `sl_lidar_cmd.h`).
fn slamtec_packets(bytes: &[u8]) -> PacketInfo {
    const CAPSULE_LENS: [usize; 3] = [84, 132, 170];
    const POINT_LEN: usize = 5;
    const HEAD_LEN: usize = 7;
    // A packet may start with the same bytes as a response, so the length decides, too. The head of a response contains
    // the length of the rest. If a stream follows, the response is only the head.
    if let Some(&[0xA5, 0x5A, low, middle, high, ..]) = bytes.first_chunk::<HEAD_LEN>() {
        let len = u32::from_le_bytes([low, middle, high, 0]) as usize;
        if bytes.len() == HEAD_LEN || bytes.len() == HEAD_LEN + len {
            return PacketInfo { kind: "reply", checked: None, packets: 1 };
        }
    }
    let is_capsule = |len: &usize| {
        if !bytes.len().is_multiple_of(*len) {
            return false;
        }
        let Some([first, second, rest @ ..]) = bytes.get(..*len) else { return false };
        let sum = rest.iter().fold(0, |sum, byte| sum ^ byte);
        (first >> 4, second >> 4) == (0xA, 0x5) && sum == first & 15 | second << 4
    };
    let capsule = CAPSULE_LENS.into_iter().find(is_capsule);
    let packets = bytes.len() / capsule.unwrap_or(POINT_LEN);
    PacketInfo { kind: "data", checked: capsule.map(|_| true), packets }
}

impl ScanHead {
    /// Returns the head of a scan of an LMS. Beam 0 is at `first_angle_mdeg`, and each next beam is `step_mdeg`
    /// further, both in 1/1000 degree. A scan with a step of 1000, 500 or 250 takes 1, 2 or 4 revolutions. Ranges have
    /// `range_bits` bits and are in units of `unit_mm` mm. Their nine highest values are codes.
    ///
    /// The stamp is the time at which the LMS starts to send, after the last beam of the last revolution. The head
    /// states that the upper bits are not intensities.
    pub fn lms(
        count: usize,
        first_angle_mdeg: i32,
        step_mdeg: u32,
        unit_mm: u32,
        range_bits: u8,
    ) -> ScanHead {
        let in_radians = |mdeg: f64| (mdeg / 1000.0).to_radians();
        let step = in_radians(step_mdeg.into());
        let max_value = ((1_u32 << range_bits.min(16)) - 1) as u16;
        let revolutions = (1000 / step_mdeg.max(1)).max(1);
        let beam_time_ns = step_mdeg * (REVOLUTION_NS / 360) / 1000;
        let age_ns = (revolutions - 1) * REVOLUTION_NS + count.saturating_sub(1) as u32 * beam_time_ns;
        ScanHead {
            first_angle: in_radians(first_angle_mdeg.into()),
            step,
            spacing: step as f32,
            beam_time_ns,
            first_beam_ns: -(age_ns as i32),
            unit_um: 1000 * unit_mm,
            count: count as u16,
            valid_to: max_value.saturating_sub(9),
            no_return: max_value,
            beyond: max_value.saturating_sub(8),
            family: Family::Lms as u8,
            contents: ArrayFlags::UPPER,
            turns: revolutions as u8,
            turn_ns: if revolutions > 1 { REVOLUTION_NS } else { 0 },
            ..ScanHead::default()
        }
    }
}

/// Returns the code of `value`, which is not a range, in a scan with `head` (Telegram listing, B0h). The values 3, 6
/// and 7 below the highest value are reserved.
pub(crate) fn lms_code(head: &ScanHead, value: u16) -> Code {
    match head.no_return.checked_sub(value) {
        Some(0) => Code::NoReturn,
        Some(1) => Code::TooBright,
        Some(4) => Code::Weak,
        Some(5) => Code::Error,
        Some(8) => Code::Beyond,
        _ => Code::Overflow,
    }
}

/// Returns whether an LMS in measuring mode `mode` sends reflector bits (Telegram listing, 77h block D).
pub(crate) fn has_reflector_bits(mode: u8) -> bool {
    matches!(mode, REFLECTOR_MODE | 0x03 | 0x05)
}

/// Measuring mode of an LMS with all three reflector bits.
pub(crate) const REFLECTOR_MODE: u8 = 0x01;

/// Time of one revolution of the mirror (75 Hz).
const REVOLUTION_NS: u32 = 13_320_000;

/// Bytes that a scanner sent, with functions that return the fields of a telegram of an LMS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Telegram<'a> {
    /// Family of the scanner; `None` if this version does not know it.
    pub family: Option<Family>,
    /// The bytes as they were received.
    pub bytes: &'a [u8],
}

impl<'a> Telegram<'a> {
    /// Maximum length of a telegram of any family, in bytes.
    pub const MAX_LEN: usize = {
        let (mut max, mut at) = (0, 0);
        while at < Family::ALL.len() {
            let len = Family::ALL[at].max_telegram();
            max = if len > max { len } else { max };
            at += 1;
        }
        max
    };

    /// Returns the telegram at the start of a payload of `family`. The length field of an LMS telegram gives the
    /// telegram's length, and the bytes after the telegram belong to a later revision of the payload. For another
    /// family, the telegram is the whole payload. Returns `None` if there is no telegram, or if it is longer than
    /// [`MAX_LEN`](Self::MAX_LEN).
    pub fn of(family: u8, payload: &'a [u8]) -> Option<Telegram<'a>> {
        let family = Family::of_number(family);
        let len = match (family, payload) {
            (Some(Family::Lms), [STX, _, low, high, ..]) => {
                usize::from(u16::from_le_bytes([*low, *high])) + FRAME_LEN
            }
            (Some(Family::Lms), _) | (_, []) => return None,
            _ => payload.len(),
        };
        let bytes = payload.get(..len).filter(|bytes| bytes.len() <= Telegram::MAX_LEN)?;
        Some(Telegram { family, bytes })
    }

    /// Returns whether this is a telegram of an LMS. Only these telegrams have the fields that the functions below
    /// return.
    pub fn is_lms(self) -> bool {
        self.family == Some(Family::Lms)
    }

    /// Returns the contents of the packets. `None` for an LMS, and for a family that this version does not know.
    pub fn packets(self) -> Option<PacketInfo> {
        self.family?.packets(self.bytes)
    }

    /// Returns the address byte: the scanner's address, with 80h added in its replies. Returns 0 if the bytes end
    /// before this field.
    pub fn address(self) -> u8 {
        self.bytes.get(1).copied().unwrap_or_default()
    }

    /// Returns the length field, the number of bytes from the command to the status, both included. Returns 0 if the
    /// bytes end before this field.
    pub fn length(self) -> u16 {
        match self.bytes.get(2..4) {
            Some(bytes) => u16::from_le_bytes([bytes[0], bytes[1]]),
            None => 0,
        }
    }

    /// Returns the command byte of a request or reply. Returns 0 if the bytes end before this byte.
    pub fn command(self) -> u8 {
        self.bytes.get(4).copied().unwrap_or_default()
    }

    /// Returns the bytes between command and CRC: the data and, in a reply, the status byte at their end.
    pub fn data(self) -> &'a [u8] {
        self.bytes.get(5..self.bytes.len().saturating_sub(2)).unwrap_or_default()
    }
}

/// Payload of the topic `telegram`: the bytes of one telegram, as the scanner sent them.
#[derive(Debug, PartialEq, Eq, TransparentWrapper)]
#[repr(transparent)]
pub struct TelegramBytes([u8]);

impl TelegramBytes {
    /// Returns the bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// Returns the payload of these bytes.
    pub fn of_bytes(bytes: &[u8]) -> &TelegramBytes {
        TransparentWrapper::wrap_ref(bytes)
    }

    /// Returns the payload of these bytes, for writing.
    pub fn of_bytes_mut(bytes: &mut [u8]) -> &mut TelegramBytes {
        TransparentWrapper::wrap_mut(bytes)
    }

    /// Returns a payload of `len` zeros.
    pub fn zeroed(len: usize) -> Box<TelegramBytes> {
        TransparentWrapperAlloc::wrap_box(vec![0; len].into_boxed_slice())
    }
}

impl Deref for TelegramBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.0
    }
}

impl DerefMut for TelegramBytes {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }
}

/// First byte of every telegram of an LMS (Telegram listing 4).
const STX: u8 = 0x02;
/// Number of bytes of STX, address, length and CRC (Telegram listing 4).
const FRAME_LEN: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scan;

    #[test]
    fn data_packet_is_distinguished_from_a_reply() {
        let packet_facts = |bytes: &[u8]| {
            let facts = Family::Rplidar.packets(bytes).expect("packets");
            (facts.kind, facts.checked, facts.packets)
        };
        let info = [&[0xA5, 0x5A, 20, 0, 0, 0, 4][..], &[7; 20]].concat();
        assert_eq!(packet_facts(&info), ("reply", None, 1));
        assert_eq!(packet_facts(&[0xA5, 0x5A, 0x84, 0, 0, 0x40, 0x84]), ("reply", None, 1));
        // The two nibbles of the checksum form A5h, which is also the checksum of the other bytes.
        let mut capsule = [0; 132];
        (capsule[0], capsule[1], capsule[2]) = (0xA5, 0x5A, 0xA5);
        assert_eq!(packet_facts(&capsule), ("data", Some(true), 1));
        assert_eq!(packet_facts(&[capsule, capsule].concat()), ("data", Some(true), 2));
        assert_eq!(packet_facts(&[1; 15]), ("data", None, 3));
    }

    #[test]
    fn nine_greatest_lms_values_are_codes() {
        for (bits, max) in [(13, 0x1FFF), (14, 0x3FFF), (15, 0x7FFF)] {
            let scan = Scan::of(ScanHead::lms(4, 0, 500, 10, bits), &[max, max - 8, max - 9, 0]);
            assert_eq!(scan.code(0), Some(Code::NoReturn));
            assert_eq!(scan.code(1), Some(Code::Beyond));
            assert_eq!((scan.code(2), scan.range(2)), (None, Some(max - 9)));
            assert_eq!(scan.distance_mm(2), Some(u32::from(max - 9) * 10));
            assert_eq!(scan.range(3), Some(0));
            assert_eq!((scan.range(4), scan.code(4)), (None, None));
        }
    }

    #[test]
    fn half_degrees_are_measured_one_revolution_later() {
        let of = |count, step_mdeg| Scan::of(ScanHead::lms(count, 0, step_mdeg, 1, 13), &vec![0; count]);
        let (turn_ns, half) = (i64::from(REVOLUTION_NS), of(361, 500));
        assert_eq!(half.beam_ns(360), -turn_ns);
        assert_eq!(half.beam_ns(359), -turn_ns * 500 / 360_000);
        assert_eq!(half.beam_ns(0), -turn_ns - turn_ns / 2);
        assert_eq!(of(181, 1000).beam_ns(180), 0);
        assert_eq!(of(401, 250).beam_ns(398), -turn_ns - turn_ns * 500 / 360_000, "the third of four turns");
    }

    #[test]
    fn intensities_exist_only_if_the_mode_has_them() {
        let mut scan = Scan::of(ScanHead::lms(2, 0, 500, 1, 13), &[1, 2]);
        scan.arrays().upper[1] = 7;
        assert_eq!((scan.upper(), scan.intensities().len()), (&[0, 7][..], 0));
        scan.intensity_bits = 3;
        assert!(scan.intensities().iter().eq([0, 7]));
        scan.contents = 0;
        assert!(scan.intensities().is_empty() && scan.upper().is_empty());
    }

    #[test]
    fn reads_fields_of_an_lms_reply() {
        let bytes = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];
        let longer = [&bytes[..], &[7; 5]].concat();
        let telegram = Telegram::of(Family::Lms as u8, &longer).expect("what follows is a later revision's");
        assert_eq!((telegram.bytes, telegram.packets()), (&bytes[..], None));
        assert_eq!((telegram.address(), telegram.length(), telegram.command()), (0x80, 3, 0xA0));
        assert_eq!(telegram.data(), [0x00, 0x10]);
        assert!(Telegram { bytes: &[0x02], ..telegram }.data().is_empty());
        for short in 0..bytes.len() {
            assert_eq!(Telegram::of(Family::Lms as u8, &bytes[..short]), None);
        }
    }

    #[test]
    fn payload_is_interpreted_by_its_family() {
        let bytes = [2; 3 * 47];
        let telegram = Telegram::of(Family::Ld as u8, &bytes).expect("packets");
        let facts = telegram.packets().expect("no LMS");
        assert_eq!((facts.kind, facts.checked, facts.packets), ("data", Some(true), 3));
        let of_tomorrow = Telegram::of(99, &bytes).expect("bytes");
        assert_eq!((of_tomorrow.bytes, of_tomorrow.packets()), (&bytes[..], None));
        for family in Family::ALL.into_iter().filter(|family| *family != Family::Lms) {
            assert_eq!(Telegram::of(family as u8, &[]), None);
            assert_eq!(Telegram::of(family as u8, &[1; Telegram::MAX_LEN + 1]), None);
        }
    }
}
