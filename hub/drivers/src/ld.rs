//! Family `ld`: the LDROBOT scanners LD06, LD19, STL19P, STL27L and LD14P. They stream without a request, and the hub
//! never sends them a byte.
//!
//! This file has the models, the settings and the recognizer of the family.

pub mod packet;
mod point_count;
mod sequence;
mod session;

use scanhub_schema::{ArrayFlags, Family, MILLIS, Nanos};

use crate::ld::packet::{Framer, PACKET_LEN, Packet};
use crate::ld::sequence::{PacketPosition, PacketSequencer};
use crate::line::family::{self, Evidence, Features, ListenStep, SearchSteps, named, table};
use crate::line::framing::fill;
use crate::settings::Settings;

pub use crate::line::{ByteCounters, RevolutionCounts};
pub use session::{LdSession, Problem};

/// Models and settings of the family.
pub const FEATURES: Features = Features {
    models: &MODELS,
    // This number of beams is sufficient for every model except the STL27L.
    defaults: family::Model { name: "auto", baud: Model::Ld19.baud(), beams: 720 },
    modes: &[],
    keys: &[],
    can_stop_motor: false,
    streams_unrequested: true,
    has_whole_telegrams: false,
    has_identity_probe: false,
    array_flags: ArrayFlags::REVOLUTION,
    max_telegram: session::MAX_PACKETS_PER_SAMPLE * PACKET_LEN,
};

/// Returns the description of a model for configurations.
const fn describe(model: Model) -> family::Model {
    family::Model { name: model.name(), baud: model.baud(), beams: model.beams() }
}

/// Descriptions of all models for configurations.
const MODELS: [family::Model; Model::ALL.len()] = table!(Model::ALL, describe);

named! {
    /// Model of an LDROBOT scanner.
    Model {
        /// LD06.
        Ld06 "ld06",
        /// LD19, also sold in the kit D500.
        Ld19 "ld19",
        /// STL19P.
        Stl19p "stl19p",
        /// STL27L.
        Stl27l "stl27l",
        /// LD14P, whose head rotates more slowly than the heads of the other models.
        Ld14p "ld14p",
    }
}

impl Model {
    /// Returns the model whose name is `name`.
    pub fn from_name(name: &str) -> Option<Model> {
        Model::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Returns the model of `settings`.
    pub(crate) fn of(settings: &Settings) -> Option<Model> {
        settings.model.and_then(Model::from_name)
    }

    /// Returns the baud rate of the scanner's line, in bits per second.
    pub const fn baud(self) -> u32 {
        match self {
            Model::Stl27l => 921_600,
            _ => 230_400,
        }
    }

    /// Returns the number of points that the scanner measures per second. This number does not depend on the speed of
    /// the head.
    pub const fn points_per_second(self) -> u32 {
        match self {
            Model::Stl27l => 21_600,
            Model::Ld14p => 4_000,
            _ => 4_500,
        }
    }

    /// Returns the speed at which the head of a factory-new scanner rotates, in revolutions per second.
    pub const fn revolutions_per_second(self) -> u32 {
        match self {
            Model::Ld14p => 6,
            _ => 10,
        }
    }

    /// Returns the default number of beams, which was chosen by measurement (docs/measured.md).
    pub const fn beams(self) -> usize {
        match self {
            Model::Stl27l => 2_160,
            Model::Ld14p => 666,
            _ => 450,
        }
    }

    /// Returns the model that measures `points_per_second`. If several models measure this number of points, returns
    /// the best-known of these models.
    pub(crate) fn of_point_rate(points_per_second: f32) -> Model {
        match points_per_second {
            rate if rate > 10_000.0 => Model::Stl27l,
            rate if (3_600.0..4_250.0).contains(&rate) => Model::Ld14p,
            _ => Model::Ld19,
        }
    }
}

/// Recognizer of LDROBOT packets.
#[derive(Clone, Debug)]
pub struct Probe {
    framer: Framer,
    sequence: PacketSequencer,
    /// Number of packets in the current sequence.
    packets: u32,
}

impl Default for Probe {
    fn default() -> Self {
        Probe { framer: Framer::default(), sequence: PacketSequencer::new(), packets: 0 }
    }
}

impl Probe {
    /// Reads the packets in the framer and counts those that continue the sequence.
    fn count(&mut self) {
        while let Some(span) = self.framer.advance(1) {
            let packet = self.framer.bytes(span).first_chunk().and_then(|bytes| Packet::check(bytes).ok());
            match packet.map(|packet| self.sequence.locate(&packet)) {
                Some(PacketPosition::First { .. }) => self.packets = 1,
                Some(PacketPosition::Next { .. }) => self.packets += 1,
                Some(PacketPosition::Repeated | PacketPosition::Outlier) | None => {}
            }
        }
    }
}

impl crate::line::family::Probe for Probe {
    fn search_steps(&self) -> &'static SearchSteps {
        &SEARCH_STEPS
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    fn receive(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let len = fill(self.framer.buffer.read_buffer(), &mut bytes);
            self.framer.buffer.commit(len);
            self.count();
        }
    }

    fn hold_time(&self) -> Option<Nanos> {
        self.framer.buffer.hold_time()
    }

    fn release(&mut self, idle: Nanos) {
        self.framer.buffer.release(idle);
        self.count();
    }

    fn evidence(&self) -> Evidence {
        match self.packets {
            0 => Evidence::None,
            1..MIN_PROOF_PACKETS => Evidence::Partial,
            _ => Evidence::Found(None),
        }
    }
}

const SEARCH_STEPS: SearchSteps = SearchSteps {
    family: Family::Ld,
    listen_steps: &[
        ListenStep { rate: Model::Ld19.baud(), duration: 150 * MILLIS, needs_bytes: false },
        ListenStep { rate: Model::Stl27l.baud(), duration: 100 * MILLIS, needs_bytes: true },
    ],
    request_steps: None,
    boot_rate: None,
    max_transmission: PACKET_LEN,
    advice: "it streams by itself once it has 5 V and its head rotates",
};
/// Number of consecutive packets that prove an LDROBOT scanner. The header and the checksum of a packet have only 24
/// bits in total, so other bytes may look like a packet by chance. The angles and the clock of each packet must also
/// continue those of the previous packet.
const MIN_PROOF_PACKETS: u32 = 4;
