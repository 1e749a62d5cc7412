//! Somebody on the network who hears all that reaches the listener's machine, and sends what looks like it. Refuses to know the
//! key of the others, and who believes.

use std::collections::VecDeque;

use scanhub_network::lan::Key;
use scanhub_schema::Nanos;
use scanhub_schema::datagram::{Datagram, HEADER_LEN, Head, LanFlags, MAC_LEN};

/// What somebody sends who has not the key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Forgery {
    /// Datagrams without a MAC.
    Plain,
    /// With one of another key.
    OtherKey,
    /// With the MAC of another one.
    OtherMac,
    /// Datagrams of the gateway that were recorded.
    Recording,
}

/// What was recorded.
#[derive(Default)]
pub(super) struct Forger {
    /// The datagrams, with the time by the listener's wall clock; the oldest first.
    recorded: VecDeque<(Nanos, Vec<u8>)>,
}

impl Forger {
    /// A datagram reached the listener's machine at `wall_ns` of its clock.
    pub(super) fn record(&mut self, wall_ns: Nanos, bytes: &[u8]) {
        if self.recorded.len() == MAX_RECORDED {
            self.recorded.pop_front();
        }
        self.recorded.push_back((wall_ns, bytes.to_vec()));
    }

    /// So many datagrams as `forgery` says, made of what was heard last, or recorded at least 8 s before `wall_ns`: what is
    /// younger may be believed by a listener that has just begun (docs/datagram.md).
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

/// A datagram that says otherwise and comes next.
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

/// Datagrams that are recorded.
const MAX_RECORDED: usize = 4_000;
/// Recorded so long ago, a datagram is believed by nobody.
const MIN_REPLAY_AGE: Nanos = 8_000_000_000;
