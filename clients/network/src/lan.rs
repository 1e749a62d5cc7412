//! Both ends of a network as pure computation: a gateway turns samples of a hub into datagrams, and a listener turns
//! datagrams into samples.
//!
//! Bytes and time are arguments, so that sockets, the bridge and simulations run the same code. `tests/it/tidy` keeps
//! clocks, sockets, files and threads out of this folder.

pub mod address;
mod gateways;
pub mod incoming;
pub mod outgoing;
mod reassembly;
pub mod republish;
mod senders;
mod sequence;

use hmac::{Hmac, KeyInit, Mac};
use scanhub_schema::datagram::{MAC_LEN, mac_input};
use sha2::Sha256;

pub(crate) use gateways::MAX_EPOCHS;
pub use gateways::{EvictedTotals, GatewayTable, MAX_ROWS, MAX_RUNS};
pub use sequence::{SequenceStatus, StreamCounters, WINDOW_LEN};

/// One moment as two clocks show it, in ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WallTimestamp {
    /// Time of a clock that is never set, such as CLOCK_MONOTONIC.
    pub monotonic_ns: u64,
    /// Time of the wall clock, since 1970.
    pub wall_ns: u64,
}

/// Key that the gateways and listeners of one network share. Listeners accept every datagram that is authenticated with
/// this key.
#[derive(Clone)]
pub struct Key(Hmac<Sha256>);

impl Key {
    /// Length of a key, in bytes.
    pub const LEN: usize = 32;

    /// Creates a key from these bytes.
    pub fn new(bytes: &[u8; Key::LEN]) -> Key {
        let mut block = [0; 64];
        block[..Key::LEN].copy_from_slice(bytes);
        // A key is padded with zeros to a block of the hash (RFC 2104).
        Key(Hmac::new(&block.into()))
    }

    /// Returns the MAC of `covered`, the header and payload of a datagram with 0 as the checksum. The MAC is the first
    /// half of HMAC-SHA256.
    pub fn mac(&self, covered: &[u8]) -> [u8; MAC_LEN] {
        let whole = self.0.clone().chain_update(covered).finalize().into_bytes();
        std::array::from_fn(|at| whole[at])
    }

    /// Returns whether `mac` was computed with this key for the datagram `bytes`, whose header is valid.
    pub fn is_of(&self, bytes: &[u8], mac: &[u8; MAC_LEN]) -> bool {
        let digest =
            mac_input(bytes).into_iter().fold(self.0.clone(), |digest, piece| digest.chain_update(piece));
        digest.verify_truncated_left(mac).is_ok()
    }

    /// Returns a name of 16 hex digits that does not reveal the key.
    pub fn name(&self) -> String {
        self.mac(b"name").iter().take(8).map(|byte| format!("{byte:02x}")).collect()
    }
}

impl std::fmt::Debug for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Key({})", self.name())
    }
}

#[cfg(test)]
mod tests {
    use scanhub_schema::datagram::{Datagram, HEADER_LEN, Head};

    use super::*;

    #[test]
    fn mac_belongs_to_one_key() {
        let (key, other) = (Key::new(&[7; 32]), Key::new(&[8; 32]));
        let mut buffer = [0; 200];
        buffer[HEADER_LEN..HEADER_LEN + 3].copy_from_slice(b"abc");
        let bytes =
            Head { hub: 3, ..Head::default() }.seal_with(&mut buffer, 3, |covered| key.mac(covered)).unwrap();
        let mac = *Datagram::read(bytes).unwrap().mac.unwrap();
        assert!(key.is_of(bytes, &mac) && !other.is_of(bytes, &mac));
        let mut other = bytes.to_vec();
        other[HEADER_LEN] ^= 1;
        assert!(!key.is_of(&other, &mac));
        assert!(!key.is_of(bytes, &[0; MAC_LEN]));
    }

    #[test]
    fn debug_output_does_not_reveal_the_key() {
        let shown = format!("{:?}", Key::new(&[0x61; 32]));
        assert!(!shown.contains("6161") && !shown.contains("aaa") && shown.len() == 21, "{shown}");
    }
}
