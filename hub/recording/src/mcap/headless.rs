//! Whether a file without its start is an MCAP file. Its end shows it, or an intact chunk, or messages of the hub, each
//! with a telegram whose own CRC is right. Refuses to know what is in them.

use std::io::{self, Read};

use super::knowledge::fits;
use super::salvage::{Found, Lone, Salvage};

/// Whether `input`, which does not begin as MCAP files do, is the rest of one. Reads no further than it must.
pub(crate) fn is_mcap(input: impl Read) -> io::Result<bool> {
    let mut salvage = Salvage::new(input);
    let (mut proofs, mut bare) = (0, 0);
    while proofs < PROOFS && bare < BARE {
        match salvage.next()? {
            None => return Ok(salvage.account().has_end),
            Some(Found::Proven(_)) => return Ok(true),
            // Its fields may fill anything.
            Some(Found::Likely(_)) => {}
            Some(Found::Lone(lone)) => {
                proofs += proofs_of(&lone);
                bare += u32::from(lone.message.is_none());
            }
        }
    }
    Ok(proofs >= PROOFS)
}

/// One for a message that is as long as its telegram wants it, and another for a header that says the same as its message:
/// no line brings either.
fn proofs_of(lone: &Lone) -> u32 {
    let Some(message) = lone.message else { return 0 };
    let header = schema::file::parts(&lone.header);
    1 + u32::from(header.is_some_and(|(header, _)| fits(&header, &message)))
}

/// So many are enough.
const PROOFS: u32 = 2;
/// After so many telegrams that are in no message it is a stream.
const BARE: u32 = 256;
