//! The background model of a sensor: the range at which each beam ends when nobody is there. Refuses to know how it is
//! learned.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::BEAMS;
use crate::datagram::Packed;

/// The payload of topic `background`, 816 bytes: sent when a new generation starts, and with every scan if so configured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Background.v1"))]
#[repr(C)]
pub struct Background {
    /// Counts the models of this hub's life: one more after a reset, a load, and a change of resolution or unit.
    pub generation: u32,
    /// Beams whose background is known.
    pub taught: u16,
    /// Beams of the model, at most [`BEAMS`]; 0 before the first scan.
    pub count: u16,
    /// Millimetres per device unit: 1, 10 or 100.
    pub unit_mm: u8,
    /// [`Background::FROZEN`] or 0.
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 2],
    /// Ranges in device units, [`Background::UNTAUGHT`] or [`Background::FAR`]; 0 beyond `count`.
    pub range_array: [u16; BEAMS],
    /// 0.
    pub pad: [u8; 2],
}

impl Default for Background {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Background {
    /// Range of a beam whose background is not known.
    pub const UNTAUGHT: u16 = 0;
    /// Range of a beam whose background is beyond what the sensor measures.
    pub const FAR: u16 = u16::MAX;
    /// Flag: nothing is learned until it is thawed.
    pub const FROZEN: u8 = 1;
    /// Bytes of a packed model before its ranges.
    pub(crate) const HEAD: usize = 12;
    /// Bytes of the longest packed model.
    pub const MAX_PACKED: usize = Self::HEAD + 2 * BEAMS;

    /// Returns the ranges that are used.
    pub fn ranges(&self) -> &[u16] {
        &self.range_array[..usize::from(self.count).min(BEAMS)]
    }

    /// Returns the angle of the first beam and between two, in 1/1000 degree; nothing if no variant has this many beams
    /// (Telegram listing, 3Bh: 180 degrees in steps of 1 or 0.5, 100 degrees ahead in steps of 1, 0.5 or 0.25).
    pub fn angles_mdeg(&self) -> Option<(i32, u16)> {
        match self.count {
            181 => Some((0, 1000)),
            361 => Some((0, 500)),
            101 => Some((40_000, 1000)),
            201 => Some((40_000, 500)),
            401 => Some((40_000, 250)),
            _ => None,
        }
    }

    /// Returns whether nothing is learned until it is thawed.
    pub fn is_frozen(&self) -> bool {
        self.flags & Background::FROZEN != 0
    }

    /// Returns the model without what is unused: as it goes over a network.
    pub fn packed(&self) -> &[u8] {
        &bytemuck::bytes_of(self)[..Self::HEAD + 2 * self.ranges().len()]
    }

    /// Returns the model in `bytes`, if they are as many as its count says.
    pub fn unpack(bytes: &[u8]) -> Option<Background> {
        let mut background = Background::default();
        (Packed::unpack(&mut background, bytes) && background.packed().len() == bytes.len())
            .then_some(background)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_go_there_and_back_packed() {
        let mut model =
            Background { generation: 3, taught: 2, count: 3, unit_mm: 10, ..Background::default() };
        model.range_array[..3].copy_from_slice(&[400, 0, Background::FAR]);
        assert_eq!(model.packed().len(), 18);
        assert_eq!(Background::unpack(model.packed()), Some(model));
        for bytes in [&model.packed()[..17], &[model.packed(), &[0]].concat(), &[], &[0xFF; 816]] {
            assert_eq!(Background::unpack(bytes), None);
        }
    }
}
