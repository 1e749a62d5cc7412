//! What a part of a scan tells, before the rest of it arrived. Refuses to know how it was found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::Verdict;

/// The payload of topic `early`, 12 bytes: a warning by a telegram that is not complete, or by a turn that is not over. The
/// first zones of its number or a greater one are of its scan and confirm it; a sample with [`Early::WITHDRAWN`] takes it back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Early.v2"))]
#[repr(C)]
pub struct Early {
    /// See [`Verdict`]: slow or stop, never clear or unknown.
    pub verdict: u8,
    /// [`Early::WITHDRAWN`] or 0.
    pub flags: u8,
    /// The beam of the nearest point so far.
    pub beam: u16,
    /// Distance of that point from the robot's centre, in mm.
    pub distance_mm: u32,
    /// Bytes of the telegram that had arrived; 0 of a turn.
    pub bytes_seen: u16,
    /// Beams of the scan that had arrived.
    pub beams_seen: u16,
}

impl Early {
    /// Flag: what was said under this number does not hold.
    pub const WITHDRAWN: u8 = 1;

    /// Returns the verdict; unknown if it is none.
    pub fn verdict(&self) -> Verdict {
        Verdict::of(self.verdict)
    }

    /// Returns whether the warning is taken back.
    pub fn is_withdrawn(&self) -> bool {
        self.flags & Early::WITHDRAWN != 0
    }
}
