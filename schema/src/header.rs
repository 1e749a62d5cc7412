//! Header of every sample: sequence numbers whose gaps show missed samples, stamps that relate samples of different
//! topics, and an ID of the hub's run.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::Family;

/// Header of every sample, the same for all topics: the user header of the services in shared memory. 64 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Header.v2"))]
#[repr(C)]
pub struct Header {
    /// Number of the telegram that the sample was computed from, per sensor and run of the hub, from 0. A sample
    /// without a telegram has the number of the last one; 0 before the first one.
    pub seq: u64,
    /// Number of the sample in its topic, from 0. A gap means that the subscriber missed samples.
    pub topic_seq: u64,
    /// Stamp of the telegram's first byte, in ns of CLOCK_MONOTONIC.
    pub stamp_first_ns: u64,
    /// Stamp of the telegram's last byte, in ns of CLOCK_MONOTONIC.
    pub stamp_last_ns: u64,
    /// Wall clock of the telegram's first byte, in ns since 1970; in a replay the recorded one, if the recording has
    /// it.
    pub wall_ns: u64,
    /// Random number of the hub's run. Another value means that `seq` and `topic_seq` started again.
    pub boot: u64,
    /// Position of the sensor's link in the hub's configuration, from 0.
    pub sensor: u8,
    /// Quality of the telegram: [`Quality`].
    pub quality: u8,
    /// Flags: [`Flags`].
    pub flags: u8,
    /// Family of the scanner: [`Family`]; 255 while the hub searches for it.
    pub family: u8,
    /// Nominal period of the scans in microseconds; 0 if unknown.
    pub period_us: u32,
    /// Process ID of the hub.
    pub hub_pid: u32,
    /// Reasons why the telegram is suspect: [`Reasons`]; 0 if it is clean.
    pub reasons: u8,
    /// Time from the telegram's last byte until the sample was sent, in units of 256 ns, rounded up; the low byte is
    /// first. FFFFFFh means 4.3 s or more; 0 means unknown, because the sample has no telegram or is remote. See
    /// [`hub_time_ns`](Self::hub_time_ns).
    pub hub_time: [u8; 3],
}

impl Header {
    /// Returns the time from the telegram's last byte until the sample was sent, in ns, rounded up by at most 256 ns.
    /// Returns `None` if the time is unknown, or 4.3 s or more.
    pub fn hub_time_ns(&self) -> Option<u64> {
        let [low, middle, high] = self.hub_time;
        let units = u32::from_le_bytes([low, middle, high, 0]);
        (1..MAX_HUB_TIME).contains(&units).then(|| u64::from(units) * HUB_TIME_UNIT_NS)
    }

    /// Sets `hub_time` of a sample that is sent at `now_ns` of CLOCK_MONOTONIC. The telegram's stamps must already be
    /// set.
    pub fn set_sent_at(&mut self, now_ns: u64) {
        let units = now_ns.saturating_sub(self.stamp_last_ns).div_ceil(HUB_TIME_UNIT_NS);
        let units = units.clamp(1, MAX_HUB_TIME.into()) as u32;
        let [low, middle, high, _] = units.to_le_bytes();
        self.hub_time = [low, middle, high];
    }

    /// Returns the family of the scanner, or `None` if this version does not know it.
    pub fn family(&self) -> Option<Family> {
        Family::of_number(self.family)
    }

    /// Returns the quality; suspect if this version does not know the value.
    ///
    /// # Examples
    ///
    /// ```
    /// use scanhub_schema::{Header, Quality, Reasons};
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
const MAX_HUB_TIME: u32 = 0xFF_FFFF;

/// Quality of a telegram whose checksum was right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Quality {
    /// No reason to suspect damage.
    Clean = 0,
    /// The telegram may be damaged.
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

/// Reasons to suspect a telegram.
pub struct Reasons;

impl Reasons {
    /// The driver counted line errors during this telegram or the previous one.
    pub const LINE_ERROR: u8 = 1;
    /// The bytes just before the telegram belong to no telegram.
    pub const NEIGHBOUR: u8 = 2;
    /// The telegram took longer to arrive than usual.
    pub const SLOW: u8 = 4;
    /// Bits are set that the measuring mode never sets.
    pub const FORBIDDEN_BITS: u8 = 8;
    /// The header of another telegram started inside this telegram.
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

/// Bits of the field `flags` of a header. Datagrams use the same bits.
pub struct Flags;

impl Flags {
    /// The scanner is simulated, with a pty as its port.
    pub const SIMULATED: u8 = 2;
    /// The link plays a recording.
    pub const REPLAYED: u8 = 4;
    /// The stamps were computed, not taken when the bytes arrived.
    pub const STAMP_ESTIMATED: u8 = 8;
    /// The sample comes from another machine.
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
    fn hub_time_is_rounded_up_to_256_ns() {
        let mut header = Header { stamp_last_ns: 1_000_000, ..Header::default() };
        assert_eq!(header.hub_time_ns(), None);
        for (now_ns, expected) in [
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
            assert_eq!(header.hub_time_ns(), expected, "{now_ns}");
        }
    }
}
