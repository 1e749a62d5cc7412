//! Why datagrams are refused: one list for all receivers and all output.

/// Why a datagram is refused, in the order of the checks: the first that fails names the reason. [`super::Datagram::read`] knows
/// those up to the checksum; the others are those of [`super::StreamStats`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DatagramError {
    /// Fewer bytes than a header.
    Short,
    /// It does not begin with `SHUB`.
    Magic,
    /// Another version.
    Version,
    /// The header is shorter than this version's, or longer than the datagram, or its part is none of the sample's parts.
    Header,
    /// The lengths do not add up to the datagram's, or a part is longer than one can be.
    Length,
    /// The checksum is wrong.
    Crc,
    /// A key is given and there is no MAC.
    Unauthenticated,
    /// A key is given and the MAC is not of it.
    Mac,
    /// A later epoch of the same hub was seen.
    Epoch,
    /// A key is given, and the sensor or the topic was not announced within 5 s of this machine's clock: the datagram may be
    /// a recorded one.
    Untimely,
    /// Of another sender than the hub's epoch was taken from, which is not known to be the same gateway's: of another one
    /// with the same number.
    Twin,
    /// Older than the window, so that nobody knows whether it came before.
    Stale,
    /// More hubs that deliver, or more topics of theirs, than there is memory for.
    Capacity,
    /// A topic that is not known here.
    Skipped,
    /// The payload is shorter than its own counts say, contradicts itself or has no revision, or it is a part by itself.
    Payload,
}

impl DatagramError {
    /// All reasons, in the order of the checks.
    pub const ALL: [DatagramError; 15] = [
        DatagramError::Short,
        DatagramError::Magic,
        DatagramError::Version,
        DatagramError::Header,
        DatagramError::Length,
        DatagramError::Crc,
        DatagramError::Unauthenticated,
        DatagramError::Mac,
        DatagramError::Epoch,
        DatagramError::Untimely,
        DatagramError::Twin,
        DatagramError::Stale,
        DatagramError::Capacity,
        DatagramError::Skipped,
        DatagramError::Payload,
    ];

    /// Returns the reason's name in all output.
    pub fn name(self) -> &'static str {
        match self {
            DatagramError::Short => "short",
            DatagramError::Magic => "magic",
            DatagramError::Version => "version",
            DatagramError::Header => "header",
            DatagramError::Length => "length",
            DatagramError::Crc => "crc",
            DatagramError::Unauthenticated => "unauthenticated",
            DatagramError::Mac => "mac",
            DatagramError::Epoch => "epoch",
            DatagramError::Untimely => "untimely",
            DatagramError::Twin => "twin",
            DatagramError::Stale => "stale",
            DatagramError::Capacity => "capacity",
            DatagramError::Skipped => "skipped",
            DatagramError::Payload => "payload",
        }
    }
}
