//! Recognizes an LDROBOT by its stream. The search never sends a byte to find one.

use scanhub_schema::{Family, MILLIS, Nanos};

use crate::ld::framer::Framer;
use crate::ld::model::Model;
use crate::ld::packet::{LEN, Packet};
use crate::ld::sequence::{Place, Sequence};
use crate::line::probe::{Approach, Evidence, Listen};

/// Recognizer of LDROBOT packets.
#[derive(Clone, Debug)]
pub struct Probe {
    framer: Framer,
    sequence: Sequence,
    /// Packets in sequence.
    packets: u32,
}

impl Default for Probe {
    fn default() -> Self {
        Probe { framer: Framer::default(), sequence: Sequence::new(), packets: 0 }
    }
}

impl Probe {
    /// Counts the packets in the framer that continue each other.
    fn count(&mut self) {
        while let Some(span) = self.framer.advance(1) {
            let packet = self.framer.bytes(span).first_chunk().and_then(|bytes| Packet::check(bytes).ok());
            match packet.map(|packet| self.sequence.place(&packet)) {
                Some(Place::First { .. }) => self.packets = 1,
                Some(Place::Next { .. }) => self.packets += 1,
                Some(Place::Again | Place::Odd) | None => {}
            }
        }
    }
}

impl crate::line::probe::Probe for Probe {
    fn approach(&self) -> &'static Approach {
        &APPROACH
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    fn receive(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let spare = self.framer.spare();
            let len = spare.len().min(bytes.len());
            spare[..len].copy_from_slice(&bytes[..len]);
            self.framer.commit(len);
            bytes = &bytes[len..];
            self.count();
        }
    }

    fn hold(&self) -> Option<Nanos> {
        self.framer.hold()
    }

    fn release(&mut self, idle: Nanos) {
        self.framer.release(idle);
        self.count();
    }

    fn evidence(&self) -> Evidence {
        match self.packets {
            0 => Evidence::None,
            1..PROOF => Evidence::Begun,
            _ => Evidence::Found(None),
        }
    }
}

const APPROACH: Approach = Approach {
    family: Family::Ld,
    listens: &[
        Listen { rate: Model::Ld19.baud(), span: 150 * MILLIS, needs_bytes: false },
        Listen { rate: Model::Stl27l.baud(), span: 100 * MILLIS, needs_bytes: true },
    ],
    asks: None,
    boot_rate: None,
    max_transmission: LEN,
    advice: "it streams by itself once it has 5 V and its head rotates",
};
/// Packets in sequence that prove an LDROBOT. Each has a header and a checksum of 24 bits, and its angles and its clock have
/// to continue those of the packet before.
const PROOF: u32 = 4;
