//! Zones around the robot's center with their verdict, and early warnings, which are verdicts from a partial scan.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::payload::{FixedPayload, UsedElements, used_elements};
use crate::text::named;

/// Maximum number of zones of a sensor.
pub const MAX_ZONES: usize = 8;

/// The payload of topic `zones`, 76 bytes. There is one sample per scan, and one with verdict unknown when scans stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Zones.v2"))]
#[repr(C)]
pub struct Zones {
    /// Verdict: [`Verdict`]. Treat unknown, and every other number, as stop.
    pub verdict: u8,
    /// Number of zones, at most [`MAX_ZONES`].
    pub count: u8,
    /// Beam of the point nearest to the robot's center; [`Zones::NO_BEAM`] if no beam has a valid reading.
    pub nearest_beam: u16,
    /// Distance of the nearest point from the center in mm, rounded down; [`Zones::NO_DISTANCE`] if there is none.
    pub nearest_mm: u32,
    /// Number of beams without a valid reading among the beams that cross the largest zone.
    pub invalid_beams: u16,
    /// Flags: [`Zones::PROVISIONAL`].
    pub flags: u8,
    /// 0.
    pub reserved: u8,
    /// The zones, the largest first; 0 beyond `count`.
    pub zone_array: [Zone; MAX_ZONES],
}

/// One zone: a circle around the robot's center.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Zone.v2"))]
#[repr(C)]
pub struct Zone {
    /// Radius in mm.
    pub radius_mm: u16,
    /// Number of beams of this scan that end inside the zone.
    pub beams: u16,
    /// 1 if enough beams ended inside the zone in enough consecutive scans.
    pub violated: u8,
    /// 0.
    pub reserved: [u8; 3],
}

impl Default for Zones {
    fn default() -> Self {
        Zones::unknown()
    }
}

impl FixedPayload for Zones {
    const ARRAYS: &'static [UsedElements] = &[used_elements!(Zones, zone_array: [Zone; MAX_ZONES], count)];
}

impl Zones {
    /// Value of [`Zones::nearest_beam`] if there is no nearest point.
    pub const NO_BEAM: u16 = u16::MAX;
    /// Value of [`Zones::nearest_mm`] if there is no nearest point.
    pub const NO_DISTANCE: u32 = u32::MAX;
    /// Flag: no zone can be violated yet, because fewer scans have arrived than a violation requires.
    pub const PROVISIONAL: u8 = 1;

    /// Returns a payload without zones, with verdict unknown.
    ///
    /// # Examples
    ///
    /// ```
    /// use scanhub_schema::{Verdict, Zones};
    ///
    /// assert_eq!(Zones::unknown().verdict(), Verdict::Unknown);
    /// // An object inside outweighs missing data.
    /// assert_eq!(Verdict::Unknown.worse(Verdict::Stop), Verdict::Stop);
    /// ```
    pub fn unknown() -> Zones {
        Zones {
            verdict: Verdict::Unknown as u8,
            nearest_beam: Zones::NO_BEAM,
            nearest_mm: Zones::NO_DISTANCE,
            ..Zeroable::zeroed()
        }
    }

    /// Returns the used zones, the largest first.
    pub fn zones(&self) -> &[Zone] {
        &self.zone_array[..usize::from(self.count).min(MAX_ZONES)]
    }

    /// Returns the verdict; unknown if this version does not know its number.
    pub fn verdict(&self) -> Verdict {
        Verdict::of(self.verdict)
    }

    /// Returns the beam of the nearest point, and the point's distance from the robot's center in mm. Returns `None` if
    /// no beam has a valid reading.
    pub fn nearest(&self) -> Option<(u16, u32)> {
        (self.nearest_beam != Zones::NO_BEAM).then_some((self.nearest_beam, self.nearest_mm))
    }
}

/// Result of checking a scan against all zones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Verdict {
    /// Nothing is inside any zone.
    Clear = 0,
    /// Something is inside a zone, but not inside the smallest one.
    Slow = 1,
    /// Something is inside the smallest zone.
    Stop = 2,
    /// Too many beams have no reading, or there are no scans. Treat it as stop.
    Unknown = 3,
}

named! {
    Verdict:
    Clear "clear",
    Slow "slow",
    Stop "stop",
    Unknown "unknown",
}

impl Verdict {
    /// Returns the verdict with this number; unknown if this version does not know it.
    pub(crate) fn of(number: u8) -> Verdict {
        Verdict::ALL.into_iter().find(|verdict| *verdict as u8 == number).unwrap_or(Verdict::Unknown)
    }

    /// Returns the worse of two verdicts: stop, then unknown, then slow, then clear. An object inside a zone outweighs
    /// missing data.
    pub fn worse(self, other: Verdict) -> Verdict {
        let rank = |verdict| match verdict {
            Verdict::Clear => 0,
            Verdict::Slow => 1,
            Verdict::Unknown => 2,
            Verdict::Stop => 3,
        };
        if rank(other) > rank(self) { other } else { self }
    }
}

/// The payload of topic `early`, 12 bytes: an early warning from a partial telegram or revolution. The first sample of
/// topic `zones` with the same or a higher `seq` belongs to the same scan and confirms the warning. A sample with
/// [`Early::WITHDRAWN`] withdraws the warning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Early.v2"))]
#[repr(C)]
pub struct Early {
    /// Verdict: [`Verdict`]. It is slow or stop, never clear or unknown.
    pub verdict: u8,
    /// Flags: [`Early::WITHDRAWN`].
    pub flags: u8,
    /// Beam of the nearest point so far.
    pub beam: u16,
    /// Distance of the nearest point so far from the robot's center, in mm.
    pub distance_mm: u32,
    /// Bytes of the telegram that had arrived; 0 for a revolution.
    pub bytes_seen: u16,
    /// Beams of the scan that had arrived.
    pub beams_seen: u16,
}

impl FixedPayload for Early {
    fn is_valid(&self) -> bool {
        matches!(self.verdict(), Verdict::Slow | Verdict::Stop)
    }
}

impl Early {
    /// Flag: the warning with this `seq` is withdrawn.
    pub const WITHDRAWN: u8 = 1;

    /// Returns the verdict; unknown if this version does not know its number.
    pub fn verdict(&self) -> Verdict {
        Verdict::of(self.verdict)
    }

    /// Returns whether the warning is withdrawn.
    pub fn is_withdrawn(&self) -> bool {
        self.flags & Early::WITHDRAWN != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_are_numbered_and_the_worse_one_wins() {
        for (number, verdict) in Verdict::ALL.into_iter().enumerate() {
            assert_eq!(verdict as usize, number);
            assert_eq!(verdict.worse(Verdict::Clear), verdict);
            assert_eq!(verdict.worse(Verdict::Stop), Verdict::Stop);
        }
        assert_eq!(Verdict::Slow.worse(Verdict::Unknown), Verdict::Unknown);
        assert_eq!(Zones { verdict: 9, ..Zones::unknown() }.verdict(), Verdict::Unknown);
        assert_eq!((Zones::unknown().nearest(), Zones::unknown().zones()), (None, &[][..]));
    }
}
