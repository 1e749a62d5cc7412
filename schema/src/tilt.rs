//! How a mount stands at an instant. Refuses to know what is mounted on it, and how the angle is measured.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The payload of topic `tilt`, 16 bytes: the angle of a mount. Both stamps of the sample are when the mount was there, not when
/// that was said.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Tilt.v2"))]
#[repr(C)]
pub struct Tilt {
    /// In radians, right-handed around the mount's axis.
    pub angle_rad: f64,
    /// How fast it grows in radians a second; nan: not known.
    pub rate_rad_s: f64,
}

impl Default for Tilt {
    /// Angle 0 with an unknown rate.
    fn default() -> Self {
        Tilt { angle_rad: 0.0, rate_rad_s: f64::NAN }
    }
}

impl Tilt {
    /// Returns how fast the angle grows in radians a second, if that is known.
    pub fn rate_rad_s(&self) -> Option<f64> {
        Some(self.rate_rad_s).filter(|rate| rate.is_finite())
    }
}
