//! What every sample carries besides its payload: numbers that show loss, stamps that join topics, the run of the hub.
//! Refuses to know what the payload is.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::Family;

/// The user header of every topic, 64 bytes, the same for all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Header.v2"))]
#[repr(C)]
pub struct Header {
    /// Number of the telegram that the sample was made from: per sensor and run of the hub, from 0. In a status, the
    /// number of the last telegram.
    pub seq: u64,
    /// Number of the sample in its topic, from 0, gap-free as sent: a gap is what a consumer missed.
    pub topic_seq: u64,
    /// CLOCK_MONOTONIC of the telegram's first byte, in ns.
    pub stamp_first_ns: u64,
    /// CLOCK_MONOTONIC of the telegram's last byte, in ns.
    pub stamp_last_ns: u64,
    /// The wall clock of the telegram's first byte, ns since 1970.
    pub wall_ns: u64,
    /// Random per start of the hub: another value means that the numbers began again.
    pub boot: u64,
    /// Position of the sensor's link in the hub's configuration, from 0.
    pub sensor: u8,
    /// 0 clean, 1 suspect; see [`Quality`].
    pub quality: u8,
    /// Bits of [`Flags`].
    pub flags: u8,
    /// Of which family the sensor is, a number of [`Family`]; see [`family`](Self::family).
    pub family: u8,
    /// Nominal time between two samples of a scan, in us; 0 unknown.
    pub period_us: u32,
    /// Process of the hub.
    pub hub_pid: u32,
    /// Why the telegram is suspect: bits of [`Reasons`]; 0 if it is clean.
    pub reasons: u8,
    /// From the telegram's last byte until the sample was sent, in units of 256 ns, rounded up; little-endian. FFFFFFh:
    /// that or more; 0: not known, for samples without a telegram and those of other machines. See
    /// [`hub_time_ns`](Self::hub_time_ns).
    pub hub_time: [u8; 3],
}

impl Header {
    /// Returns the time from the telegram's last byte until the sample was sent, in ns, at most 256 too much; nothing if it
    /// is not told, or was more than four seconds.
    pub fn hub_time_ns(&self) -> Option<u64> {
        let [low, middle, high] = self.hub_time;
        let units = u32::from_le_bytes([low, middle, high, 0]);
        (1..HUB_TIME_MORE).contains(&units).then(|| u64::from(units) * HUB_TIME_UNIT_NS)
    }

    /// Sets the moment at which the sample is sent to `now_ns` of CLOCK_MONOTONIC; the telegram's stamps must be set.
    pub fn set_sent_at(&mut self, now_ns: u64) {
        let units = now_ns.saturating_sub(self.stamp_last_ns).div_ceil(HUB_TIME_UNIT_NS);
        let units = units.clamp(1, HUB_TIME_MORE.into()) as u32;
        let [low, middle, high, _] = units.to_le_bytes();
        self.hub_time = [low, middle, high];
    }

    /// Returns the family of the sensor; nothing if this version does not know it.
    pub fn family(&self) -> Option<Family> {
        Family::of_number(self.family)
    }

    /// Returns the quality as a word; unknown values are suspect.
    ///
    /// # Examples
    ///
    /// ```
    /// use schema::{Header, Quality, Reasons};
    ///
    /// let header = Header { quality: 1, reasons: Reasons::SLOW, ..Header::default() };
    /// assert_eq!(header.quality(), Quality::Suspect);
    /// assert_eq!(Reasons::names(header.reasons).collect::<Vec<_>>(), ["slow"]);
    /// ```
    pub fn quality(&self) -> Quality {
        if self.quality == Quality::Clean as u8 { Quality::Clean } else { Quality::Suspect }
    }
}

const HUB_TIME_UNIT_NS: u64 = 256;
const HUB_TIME_MORE: u32 = 0xFF_FFFF;

/// What the hub thinks of a telegram whose CRC was right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Quality {
    /// Nothing speaks against it.
    Clean = 0,
    /// Something around it was wrong.
    Suspect = 1,
}

impl Quality {
    /// Returns `clean` or `suspect`.
    pub fn name(self) -> &'static str {
        match self {
            Quality::Clean => "clean",
            Quality::Suspect => "suspect",
        }
    }
}

/// The bits of [`Header::reasons`].
pub struct Reasons;

impl Reasons {
    /// The line's error counters moved.
    pub const LINE_ERROR: u8 = 1;
    /// Bytes just before it belonged to nothing.
    pub const NEIGHBOUR: u8 = 2;
    /// It took longer than usual.
    pub const SLOW: u8 = 4;
    /// Bits are set that the measuring mode never sets.
    pub const FORBIDDEN_BITS: u8 = 8;
    /// The header of another telegram began inside.
    pub const HEADER_INSIDE: u8 = 16;

    /// Returns the names of the bits that are set, as in all output.
    pub fn names(reasons: u8) -> impl Iterator<Item = &'static str> {
        let named = [
            (Reasons::LINE_ERROR, "line_error"),
            (Reasons::NEIGHBOUR, "neighbour"),
            (Reasons::SLOW, "slow"),
            (Reasons::FORBIDDEN_BITS, "forbidden_bits"),
            (Reasons::HEADER_INSIDE, "header_inside"),
        ];
        named.into_iter().filter(move |(bit, _)| reasons & bit != 0).map(|(_, name)| name)
    }
}

/// The bits of [`Header::flags`]; the numbers are those of the LAN form.
pub struct Flags;

impl Flags {
    /// The port resolves to a pty.
    pub const SIMULATED: u8 = 2;
    /// The link is a recording.
    pub const REPLAYED: u8 = 4;
    /// The stamps were computed, not taken when the bytes arrived.
    pub const STAMP_ESTIMATED: u8 = 8;
    /// The sample came from another machine.
    pub const REMOTE: u8 = 32;

    /// Returns the names of the bits that are set, as in all output.
    pub fn names(flags: u8) -> impl Iterator<Item = &'static str> {
        let named = [
            (Flags::SIMULATED, "simulated"),
            (Flags::REPLAYED, "replayed"),
            (Flags::STAMP_ESTIMATED, "stamp_estimated"),
            (Flags::REMOTE, "remote"),
        ];
        named.into_iter().filter(move |(bit, _)| flags & bit != 0).map(|(_, name)| name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hub_time() {
        let mut header = Header { stamp_last_ns: 1_000_000, ..Header::default() };
        assert_eq!(header.hub_time_ns(), None);
        for (now_ns, told) in [
            (1_000_000, Some(256)),
            (1_000_256, Some(256)),
            (1_000_257, Some(512)),
            (1_072_000, Some(282 * 256)),
            (1_000_000 + 0xFF_FFFE * 256, Some(0xFF_FFFE * 256)),
            (1_000_001 + 0xFF_FFFE * 256, None),
            (u64::MAX, None),
            (5, Some(256)),
        ] {
            header.set_sent_at(now_ns);
            assert_eq!(header.hub_time_ns(), told, "{now_ns}");
        }
    }
}
