//! What a session says of itself, in plain values.

use core::fmt;

/// Why a session is not where it should be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No packets come.
    NoPackets {
        /// The only rate at which was listened; `None`: at all of them.
        baud: Option<u32>,
        /// For how long already, in steps that grow.
        seconds: u32,
    },
    /// One second without a packet.
    Silence,
    /// Packets come, but the head does not turn.
    StandsStill,
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoPackets { baud, seconds } => {
                f.write_str("no packets at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("230400 and 921600")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Trouble::Silence => f.write_str("no packet for one second"),
            Trouble::StandsStill => f.write_str("packets come, but the head does not turn: is it blocked?"),
        }
    }
}
