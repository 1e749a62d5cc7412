//! The families of scanners, by number and name, and the scan of one whose head turns. Refuses to know what they speak.

use std::f64::consts::TAU;

use super::{Code, Contents, ScanHead};

/// A family of scanners: what speaks one protocol.
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

/// What is said in a telegram of a family that sends packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PacketFacts {
    /// `data`, or `reply` to a request.
    pub kind: &'static str,
    /// Whether a checksum was right; nothing where there is none.
    pub checked: Option<bool>,
    /// Number of packets.
    pub packets: usize,
}

impl Family {
    /// All of them.
    pub const ALL: [Family; 3] = [Family::Lms, Family::Ld, Family::Rplidar];

    /// Returns the family's name in configurations and in all output.
    pub fn name(self) -> &'static str {
        match self {
            Family::Lms => "lms",
            Family::Ld => "ld",
            Family::Rplidar => "rplidar",
        }
    }

    /// Returns the family called `name`.
    pub fn parse(name: &str) -> Option<Family> {
        Family::ALL.into_iter().find(|family| family.name() == name)
    }

    /// Returns whether its intensities are levels of reflectors, 0 where there is none: else they are counts of any surface,
    /// and only the user knows from which on one is a reflector.
    pub fn has_reflector_levels(self) -> bool {
        self == Family::Lms
    }

    /// Returns what is said in `bytes`, a telegram of the family; nothing if it sends no packets.
    pub fn packets(self, bytes: &[u8]) -> Option<PacketFacts> {
        match self {
            Family::Lms => None,
            // It only speaks, and what is published had a checksum that was right.
            Family::Ld => {
                let packets = bytes.len() / LD_PACKET;
                Some(PacketFacts { kind: "data", checked: Some(true), packets })
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
    /// Returns the head of a turn of a scanner of `family` that turns clockwise, put on a grid of `beams` equal bins of which
    /// the first is ahead: ranges in millimetres, intensities of 8 bits, exact angles. Its times are to be set.
    pub fn turning(family: Family, beams: usize) -> ScanHead {
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
            contents: Contents::TURNING,
            intensity_bits: 8,
            ..ScanHead::default()
        }
    }
}

/// Bytes of a packet of an LDROBOT (manual of the LD19, "data packet format").
const LD_PACKET: usize = 47;

/// What is said in packets or an answer of a scanner of Slamtec. Packets of one point have no checksum and nothing that says
/// what they are; those with a head and a right checksum are no such ones (rplidar_sdk, `sl_lidar_cmd.h`).
fn slamtec_packets(bytes: &[u8]) -> PacketFacts {
    const CAPSULES: [usize; 3] = [84, 132, 170];
    const POINT: usize = 5;
    const HEAD: usize = 7;
    // A packet may begin like an answer, whose head says how much follows: nothing, where a stream does.
    if let Some(&[0xA5, 0x5A, low, middle, high, ..]) = bytes.first_chunk::<HEAD>() {
        let len = u32::from_le_bytes([low, middle, high, 0]) as usize;
        if bytes.len() == HEAD || bytes.len() == HEAD + len {
            return PacketFacts { kind: "reply", checked: None, packets: 1 };
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
    let capsule = CAPSULES.into_iter().find(is_capsule);
    let packets = bytes.len() / capsule.unwrap_or(POINT);
    PacketFacts { kind: "data", checked: capsule.map(|_| true), packets }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_that_begins_like_an_answer_is_none() {
        let said = |bytes: &[u8]| {
            let facts = Family::Rplidar.packets(bytes).expect("packets");
            (facts.kind, facts.checked, facts.packets)
        };
        let info = [&[0xA5, 0x5A, 20, 0, 0, 0, 4][..], &[7; 20]].concat();
        assert_eq!(said(&info), ("reply", None, 1));
        assert_eq!(said(&[0xA5, 0x5A, 0x84, 0, 0, 0x40, 0x84]), ("reply", None, 1));
        // The nibbles of the sum are A5h, and what follows gives it.
        let mut capsule = [0; 132];
        (capsule[0], capsule[1], capsule[2]) = (0xA5, 0x5A, 0xA5);
        assert_eq!(said(&capsule), ("data", Some(true), 1));
        assert_eq!(said(&[capsule, capsule].concat()), ("data", Some(true), 2));
        assert_eq!(said(&[1; 15]), ("data", None, 3));
    }
}
