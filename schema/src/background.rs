//! The background model of a sensor: the range at which each beam ends when nobody is there. Refuses to know how it is
//! learned.

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::datagram::Packed;
use crate::sliced::sliced;

/// What stands before the ranges of a [`Background`]. 32 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct BackgroundHead {
    /// Angle of beam 0 in radians, as of a scan.
    pub first_angle: f64,
    /// Angle from one beam to the next in radians; 0 before the first scan.
    pub step: f64,
    /// Counts the models of this hub's life: one more after a reset, a load, and a change of beams or unit.
    pub generation: u32,
    /// Micrometres per device unit.
    pub unit_um: u32,
    /// Beams whose background is known.
    pub taught: u16,
    /// Beams of the model; 0 before the first scan.
    pub count: u16,
    /// [`Background::FROZEN`] or 0.
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 3],
}

sliced! {
    /// The payload of topic `background`: a [`BackgroundHead`], which its fields are read through, and behind it a range of two
    /// bytes for every beam. Sent when a new generation starts, and with every scan if so configured.
    Background, BackgroundWord, "scanhub.Background.v2", BackgroundHead
}

impl Background {
    /// Range of a beam whose background is not known.
    pub const UNTAUGHT: u16 = 0;
    /// Range of a beam whose background is beyond what the sensor measures.
    pub const FAR: u16 = u16::MAX;
    /// Flag: nothing is learned until it is thawed.
    pub const FROZEN: u8 = 1;

    /// Returns the bytes of a model of so many beams.
    pub const fn len(beams: usize) -> usize {
        Background::HEAD + 2 * beams
    }

    /// Returns a model with `head` and as many `ranges` as that shall have beams.
    pub fn of(head: BackgroundHead, ranges: &[u16]) -> Box<Background> {
        let mut model = Background::zeroed(Background::len(ranges.len()));
        model.begin(BackgroundHead { count: ranges.len() as u16, ..head }).copy_from_slice(ranges);
        model
    }

    /// Writes `head` and returns the ranges, which have to be filled.
    ///
    /// # Panics
    ///
    /// If the memory is too short for them.
    pub fn begin(&mut self, head: BackgroundHead) -> &mut [u16] {
        **self = head;
        cast_slice_mut(&mut self.memory_mut()[Background::HEAD..Background::len(head.count.into())])
    }

    /// Returns the ranges of the beams in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    pub fn ranges(&self) -> &[u16] {
        let room = self.memory().len().saturating_sub(Background::HEAD) / 2;
        let beams = usize::from(self.count).min(room);
        self.memory().get(Background::HEAD..Background::len(beams)).map_or(&[], cast_slice)
    }

    /// Returns the ranges, to be written.
    pub fn ranges_mut(&mut self) -> &mut [u16] {
        let head = **self;
        self.begin(head)
    }

    /// Returns whether nothing is learned until it is thawed.
    pub fn is_frozen(&self) -> bool {
        self.flags & Background::FROZEN != 0
    }

    /// Returns the model in `bytes`, if they are as many as its count says.
    pub fn read(bytes: &[u8]) -> Option<Box<Background>> {
        let mut model = Background::zeroed(bytes.len());
        (model.unpack(bytes) && model.bytes().len() == bytes.len()).then_some(model)
    }

    fn used(&self) -> usize {
        Background::len(self.ranges().len())
    }
}

impl fmt::Debug for Background {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Background").field("head", &**self).field("ranges", &self.ranges()).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_go_there_and_back() {
        let head = BackgroundHead { generation: 3, taught: 2, unit_um: 10_000, ..BackgroundHead::default() };
        let model = Background::of(head, &[400, 0, Background::FAR]);
        assert_eq!(model.bytes().len(), 38);
        assert_eq!(Background::read(model.bytes()), Some(model.clone()));
        for bytes in [&model.bytes()[..37], &[model.bytes(), &[0]].concat(), &[], &[0xFF; 816]] {
            assert_eq!(Background::read(bytes), None);
        }
    }
}
