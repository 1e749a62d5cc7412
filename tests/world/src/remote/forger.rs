//! An attacker on the network. The attacker receives all datagrams for the listener's machine and sends similar
//! datagrams, but does not have the key.

use std::collections::VecDeque;

use scanhub_network::lan::Key;
use scanhub_schema::Nanos;
use scanhub_schema::datagram::{Datagram, HEADER_LEN, Head, LanFlags, MAC_LEN};

/// A kind of datagram that the attacker sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Forgery {
    /// Datagrams without a MAC.
    Plain,
    /// Datagrams with a MAC of another key.
    OtherKey,
    /// Datagrams with the MAC of another datagram.
    OtherMac,
    /// Recorded datagrams of the gateway.
    Recording,
}

/// Datagrams that the attacker has recorded.
#[derive(Default)]
pub(super) struct Forger {
    /// Recorded datagrams, oldest first, with their times of arrival on the wall clock of the listener's machine.
    recorded: VecDeque<(Nanos, Vec<u8>)>,
}

impl Forger {
    /// Records a datagram that arrived at the listener's machine at `wall_ns` on the machine's wall clock.
    pub(super) fn record(&mut self, wall_ns: Nanos, bytes: &[u8]) {
        if self.recorded.len() == MAX_RECORDED {
            self.recorded.pop_front();
        }
        self.recorded.push_back((wall_ns, bytes.to_vec()));
    }

    /// Returns up to `count` datagrams of the kind `forgery`. For `Recording`, these are recorded datagrams that
    /// arrived at least 8 s before or after `wall_ns`. A listener that has just started may accept younger datagrams
    /// (docs/datagram.md). For the other kinds, the datagrams are derived from those that were recorded last.
    pub(super) fn forge(&self, forgery: Forgery, count: usize, wall_ns: Nanos) -> Vec<Vec<u8>> {
        let is_old = |at: Nanos| at.abs_diff(wall_ns) > MIN_REPLAY_AGE;
        let all = self.recorded.iter();
        match forgery {
            Forgery::Recording => {
                let old: Vec<_> = all.filter(|(at, _)| is_old(*at)).map(|(_, bytes)| bytes.clone()).collect();
                old[old.len().saturating_sub(count)..].to_vec()
            }
            _ => {
                let last = all.rev().take(count).rev();
                last.filter_map(|(_, bytes)| forge_next(bytes, forgery)).collect()
            }
        }
    }
}

/// Returns a datagram with different contents that follows `bytes` in sequence.
fn forge_next(bytes: &[u8], forgery: Forgery) -> Option<Vec<u8>> {
    let Datagram { head, payload, mac } = Datagram::read(bytes).ok()?;
    let head = Head {
        sequence: head.sequence.wrapping_add(1),
        epoch: head.epoch + u32::from(head.sequence % 4 == 0),
        flags: head.flags & !LanFlags::AUTHENTICATED,
        ..head
    };
    let mut buffer = vec![0; HEADER_LEN + payload.len() + MAC_LEN];
    buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
    let len = payload.len();
    let sealed = match forgery {
        Forgery::Plain => head.seal(&mut buffer, len),
        Forgery::OtherMac => head.seal_with(&mut buffer, len, |_| mac.copied().unwrap_or_default()),
        _ => head.seal_with(&mut buffer, len, |covered| Key::new(&[0x66; Key::LEN]).mac(covered)),
    };
    sealed.map(<[u8]>::to_vec)
}

/// Maximum number of recorded datagrams.
const MAX_RECORDED: usize = 4_000;
/// Age from which on no listener accepts a recorded datagram, in ns.
const MIN_REPLAY_AGE: Nanos = 8_000_000_000;
