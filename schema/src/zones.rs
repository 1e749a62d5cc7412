//! What is near the robot: circles around its centre, and the verdict. Refuses to know how beams and circles intersect.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The most circles of a sensor.
pub const ZONES: usize = 8;

/// The payload of topic `zones`, 76 bytes: one sample per scan, and one with verdict unknown when scans stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Zones.v2"))]
#[repr(C)]
pub struct Zones {
    /// See [`Zones::verdict`].
    pub verdict: u8,
    /// Circles used, at most [`ZONES`].
    pub count: u8,
    /// The beam whose point is nearest to the robot's centre; [`Zones::NO_BEAM`] if no beam has a valid reading.
    pub nearest_beam: u16,
    /// That point's distance from the centre in mm, rounded down; [`Zones::NO_DISTANCE`] if there is none.
    pub nearest_mm: u32,
    /// Beams that see into the largest circle, without a valid reading.
    pub invalid_beams: u16,
    /// [`Zones::PROVISIONAL`] or 0.
    pub flags: u8,
    /// 0.
    pub reserved: u8,
    /// The circles, the largest first; 0 beyond `count`.
    pub zone_array: [Zone; ZONES],
}

/// One circle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Zone.v2"))]
#[repr(C)]
pub struct Zone {
    /// Radius around the robot's centre in mm.
    pub radius_mm: u16,
    /// Beams that hit something inside, in this scan.
    pub beams: u16,
    /// 1: there were enough of them in enough scans.
    pub violated: u8,
    /// 0.
    pub reserved: [u8; 3],
}

impl Default for Zones {
    fn default() -> Self {
        Zones::unknown()
    }
}

impl Zones {
    /// [`Zones::nearest_beam`] if there is none.
    pub const NO_BEAM: u16 = u16::MAX;
    /// [`Zones::nearest_mm`] if there is none.
    pub const NO_DISTANCE: u32 = u32::MAX;
    /// Flag: fewer scans were seen than a violation takes, so that nothing can be violated yet.
    pub const PROVISIONAL: u8 = 1;

    /// Returns zones of which nothing is known: no circles, verdict unknown.
    ///
    /// # Examples
    ///
    /// ```
    /// use schema::{Verdict, Zones};
    ///
    /// assert_eq!(Zones::unknown().verdict(), Verdict::Unknown);
    /// // What is seen inside outweighs what is not known.
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

    /// Returns the circles that are used, the largest first.
    pub fn zones(&self) -> &[Zone] {
        &self.zone_array[..usize::from(self.count).min(ZONES)]
    }

    /// Returns the verdict; what this program does not know is unknown.
    pub fn verdict(&self) -> Verdict {
        Verdict::of(self.verdict)
    }

    /// Returns beam and distance from the robot's centre, in mm, of what is nearest to it.
    pub fn nearest(&self) -> Option<(u16, u32)> {
        (self.nearest_beam != Zones::NO_BEAM).then_some((self.nearest_beam, self.nearest_mm))
    }
}

/// The result for all circles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Verdict {
    /// Nothing is inside.
    Clear = 0,
    /// Something is inside, but not inside the smallest circle.
    Slow = 1,
    /// Something is inside the smallest circle.
    Stop = 2,
    /// Not known: too many beams without a reading, or no scans. Treat it as stop.
    Unknown = 3,
}

impl Verdict {
    /// All verdicts, by their number.
    pub const ALL: [Verdict; 4] = [Verdict::Clear, Verdict::Slow, Verdict::Stop, Verdict::Unknown];

    /// Returns the verdict of `number`; what this program does not know is unknown.
    pub(crate) fn of(number: u8) -> Verdict {
        Verdict::ALL.into_iter().find(|verdict| *verdict as u8 == number).unwrap_or(Verdict::Unknown)
    }

    /// Returns the verdict's name in all output.
    pub fn name(self) -> &'static str {
        match self {
            Verdict::Clear => "clear",
            Verdict::Slow => "slow",
            Verdict::Stop => "stop",
            Verdict::Unknown => "unknown",
        }
    }

    /// Returns the worse of two: stop, then unknown, then slow, then clear. What is seen inside outweighs what is not known.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_stand_at_their_numbers_and_the_worse_wins() {
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
