//! Why datagrams are refused: one list for all receivers and all output.

/// Why a datagram is refused, in the order of the checks: the first that fails names the reason. [`super::Datagram::read`] knows
/// those up to the checksum; the others are an [`super::Account`]'s.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Refusal {
    /// Fewer bytes than a header.
    Short,
    /// It does not begin with `SHUB`.
    Magic,
    /// Another version.
    Version,
    /// The header is shorter than this version's, or longer than the datagram.
    Header,
    /// The lengths do not add up to the datagram's.
    Length,
    /// The checksum is wrong.
    Crc,
    /// A key is given and there is no MAC. No receiver here has keys yet.
    Unauthenticated,
    /// A key is given and the MAC is not of it.
    Mac,
    /// A later epoch of the same hub was seen.
    Epoch,
    /// Of another sender than the hub's epoch was taken from, which is not known to be the same gateway's: of another one
    /// with the same number.
    Twin,
    /// Older than the window, so that nobody knows whether it came before.
    Stale,
    /// More hubs that deliver, or more topics of theirs, than there is memory for.
    Capacity,
    /// A topic that is not known here.
    Skipped,
    /// The payload is shorter than its own counts say, contradicts itself or has no revision.
    Payload,
}

impl Refusal {
    /// All reasons, in the order of the checks.
    pub const ALL: [Refusal; 14] = [
        Refusal::Short,
        Refusal::Magic,
        Refusal::Version,
        Refusal::Header,
        Refusal::Length,
        Refusal::Crc,
        Refusal::Unauthenticated,
        Refusal::Mac,
        Refusal::Epoch,
        Refusal::Twin,
        Refusal::Stale,
        Refusal::Capacity,
        Refusal::Skipped,
        Refusal::Payload,
    ];

    /// The reason's name in all output.
    pub fn name(self) -> &'static str {
        match self {
            Refusal::Short => "short",
            Refusal::Magic => "magic",
            Refusal::Version => "version",
            Refusal::Header => "header",
            Refusal::Length => "length",
            Refusal::Crc => "crc",
            Refusal::Unauthenticated => "unauthenticated",
            Refusal::Mac => "mac",
            Refusal::Epoch => "epoch",
            Refusal::Twin => "twin",
            Refusal::Stale => "stale",
            Refusal::Capacity => "capacity",
            Refusal::Skipped => "skipped",
            Refusal::Payload => "payload",
        }
    }
}
