//! What a listener with a key believes: datagrams of that key, and none that was recorded and is sent again. A sensor is
//! believed from an announcement on that was sent just now by our own clock; from then on numbers only go forward. Refuses
//! to know where the epochs are kept.

use std::collections::{HashMap, VecDeque};

use crate::lan::StreamStats;
use scanhub_schema::datagram::{Announce, Datagram, DatagramError, Head};

use crate::lan::Key;

/// A key, and the greatest epoch of each gateway that had it.
pub(super) struct Guard {
    key: Key,
    epochs: HashMap<u64, u32>,
    /// The hubs of these, the one that has been known for longest first.
    order: VecDeque<u64>,
    is_changed: bool,
}

impl Guard {
    /// With the `epochs` of gateways that were heard before, of too many the greatest.
    pub(super) fn new(key: Key, epochs: HashMap<u64, u32>) -> Guard {
        let mut known: Vec<_> = epochs.into_iter().collect();
        known.sort_unstable_by_key(|&(hub, epoch)| (epoch, hub));
        let known = known.split_off(known.len().saturating_sub(GATEWAYS));
        let order = known.iter().map(|&(hub, _)| hub).collect();
        Guard { key, epochs: known.into_iter().collect(), order, is_changed: false }
    }

    /// Whether `datagram`, which was read from `bytes` and came at `wall_ns`, is to be believed; `stats` is what was taken
    /// before it.
    ///
    /// # Errors
    ///
    /// Why not.
    pub(super) fn check(
        &self,
        bytes: &[u8],
        datagram: &Datagram<'_>,
        stats: &StreamStats,
        wall_ns: u64,
    ) -> Result<(), DatagramError> {
        let mac = datagram.mac.ok_or(DatagramError::Unauthenticated)?;
        if !self.key.is_of(bytes, mac) {
            return Err(DatagramError::Mac);
        }
        let head = &datagram.head;
        if self.epochs.get(&head.hub).is_some_and(|greatest| head.epoch < *greatest) {
            return Err(DatagramError::Epoch);
        }
        if stats.is_announced(head.hub, head.epoch, head.sensor) || self.is_timely(head, wall_ns) {
            return Ok(());
        }
        Err(DatagramError::Untimely)
    }

    /// Whether `head` is that of an announcement which was sent just now by our own clock, which is at `wall_ns`.
    pub(super) fn is_timely(&self, head: &Head, wall_ns: u64) -> bool {
        head.topic == Announce::NUMBER && wall_ns.abs_diff(head.stamp_ns) <= FIRST_WITHIN_NS
    }

    /// Something of this life of `hub` was taken. Whoever has the key may be as many gateways as he likes: of too many the one
    /// is forgotten that has been known for longest.
    pub(super) fn note(&mut self, hub: u64, epoch: u32) {
        if let Some(greatest) = self.epochs.get_mut(&hub) {
            self.is_changed |= epoch > *greatest;
            *greatest = epoch.max(*greatest);
            return;
        }
        if self.order.len() == GATEWAYS
            && let Some(first) = self.order.pop_front()
        {
            self.epochs.remove(&first);
        }
        self.order.push_back(hub);
        self.epochs.insert(hub, epoch);
        self.is_changed = true;
    }

    /// The epochs, if there is a greater one since this was asked last.
    pub(super) fn take_changed(&mut self) -> Option<&HashMap<u64, u32>> {
        std::mem::take(&mut self.is_changed).then_some(&self.epochs)
    }
}

/// The first announcement of a sensor is stamped by a clock that differs from ours by no more.
const FIRST_WITHIN_NS: u64 = 5_000_000_000;
/// The most gateways whose epochs are known. A recording of one that is forgotten is refused by its time.
pub const GATEWAYS: usize = 1024;

#[cfg(test)]
mod tests {
    use scanhub_schema::datagram::{Announced, HEAD, PORT, Packed, group};
    use scanhub_schema::{Topic, Zones};

    use super::super::{Arrived, Incoming};
    use super::*;
    use crate::lan::Stamp;

    const SECOND: u64 = 1_000_000_000;

    fn key() -> Key {
        Key::new(&[7; 32])
    }

    fn sealed(head: Head, pack: impl FnOnce(&mut [u8]) -> Option<usize>) -> Vec<u8> {
        let mut buffer = [0; 400];
        let len = pack(&mut buffer[HEAD..]).unwrap();
        let head = Head { revision: 1, hub: 5, ..head };
        head.seal_with(&mut buffer, len, |covered| key().mac(covered)).unwrap().to_vec()
    }

    /// Announces sensor 0 at `at_s` of the gateway's clock, which has `next` zones.
    fn announcement(epoch: u32, sequence: u32, at_s: u64, next: u32) -> Vec<u8> {
        announced_of(1, epoch, sequence, at_s, next)
    }

    /// The same in this life of its hub.
    fn announced_of(boot: u64, epoch: u32, sequence: u32, at_s: u64, next: u32) -> Vec<u8> {
        let mut announce = Announce::new(boot, "front", "");
        let topic = Topic::Zones;
        announce.add(Announced { topic: topic.number(), group: group(topic), port: PORT, next });
        sealed(Head { epoch, sequence, stamp_ns: at_s * SECOND, ..Head::default() }, |room| {
            announce.pack(room)
        })
    }

    fn zones(epoch: u32, sequence: u32) -> Vec<u8> {
        sealed(Head { topic: Topic::Zones.number(), epoch, sequence, ..Head::default() }, |room| {
            Zones::unknown().pack(room)
        })
    }

    fn listener(epochs: &[(u64, u32)]) -> Incoming {
        Incoming::with_key(&Topic::ALL, key(), epochs.iter().copied().collect())
    }

    /// What becomes of `bytes` from sender 1 at `at_s` of the listener's clock: why it is refused, if it is.
    fn receive(incoming: &mut Incoming, bytes: &[u8], at_s: u64) -> Option<DatagramError> {
        receive_from(1, incoming, bytes, at_s)
    }

    fn receive_from(from: u64, incoming: &mut Incoming, bytes: &[u8], at_s: u64) -> Option<DatagramError> {
        let arrival = Stamp { monotonic_ns: at_s * SECOND, wall_ns: at_s * SECOND };
        match incoming.receive(bytes, from, arrival, &mut Vec::new()) {
            Arrived::Refused { why, .. } => Some(why),
            Arrived::Untimely { .. } => Some(DatagramError::Untimely),
            _ => None,
        }
    }

    #[test]
    fn only_who_has_the_key_is_believed() {
        let mut incoming = listener(&[]);
        let mut plain = [0; 400];
        let len = Zones::unknown().pack(&mut plain[HEAD..]).unwrap();
        let head = Head { topic: Topic::Zones.number(), revision: 1, hub: 5, ..Head::default() };
        let bytes = head.seal(&mut plain, len).unwrap().to_vec();
        assert_eq!(receive(&mut incoming, &bytes, 100), Some(DatagramError::Unauthenticated));
        let other = head.seal_with(&mut plain, len, |covered| Key::new(&[8; 32]).mac(covered)).unwrap();
        assert_eq!(receive(&mut incoming, other, 100), Some(DatagramError::Mac));
        assert_eq!(receive(&mut incoming, &announcement(1, 0, 100, 0), 100), None);
        assert_eq!(receive(&mut incoming, &zones(1, 0), 100), None);
        let refused = |why| incoming.stats().refused(why);
        assert_eq!([DatagramError::Unauthenticated, DatagramError::Mac].map(refused), [1, 1]);
    }

    #[test]
    fn a_recording_that_is_sent_again_is_refused() {
        let recorded = [announcement(1, 3, 100, 40), zones(1, 40), zones(1, 41)];
        let mut incoming = listener(&[]);
        let again = recorded.each_ref().map(|bytes| receive(&mut incoming, bytes, 200));
        assert_eq!(again, [Some(DatagramError::Untimely); 3], "the gateway is gone");
        // The gateway goes on: its announcement is believed, and nothing that was sent before.
        assert_eq!(receive(&mut incoming, &zones(1, 90), 200), Some(DatagramError::Untimely));
        assert_eq!(receive(&mut incoming, &announcement(1, 50, 200, 91), 203), None);
        assert_eq!(receive(&mut incoming, &zones(1, 91), 203), None);
        let again = recorded.each_ref().map(|bytes| receive(&mut incoming, bytes, 204));
        assert_eq!(again, [Some(DatagramError::Stale); 3]);
        let clocks = [announcement(2, 0, 94, 0), announcement(2, 0, 106, 0)];
        let refused = clocks.map(|bytes| receive(&mut listener(&[]), &bytes, 100));
        assert_eq!(refused, [Some(DatagramError::Untimely); 2]);
    }

    #[test]
    fn epochs_only_go_forward_over_restarts_of_the_listener() {
        let mut incoming = listener(&[]);
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 0), 100), None);
        let kept: Vec<_> =
            incoming.take_epochs().unwrap().iter().map(|(hub, epoch)| (*hub, *epoch)).collect();
        assert_eq!((kept.as_slice(), incoming.take_epochs()), (&[(5, 7)][..], None));
        let mut next = listener(&kept);
        assert_eq!(receive(&mut next, &announcement(6, 0, 100, 0), 100), Some(DatagramError::Epoch));
        assert_eq!(receive(&mut next, &announcement(7, 1, 101, 0), 101), None);
        assert_eq!(
            (receive(&mut next, &announcement(8, 0, 102, 0), 102), next.take_epochs().is_some()),
            (None, true)
        );
        assert_eq!(receive(&mut next, &zones(7, 0), 102), Some(DatagramError::Epoch));
    }

    #[test]
    fn whoever_has_the_key_cannot_fill_the_memory() {
        let mut guard = Guard::new(key(), (0..2000).map(|hub| (hub, 2000 - hub as u32)).collect());
        assert_eq!(guard.take_changed(), None);
        (10_000..10_001).for_each(|hub| guard.note(hub, 1));
        let known = guard.take_changed().unwrap();
        assert_eq!((known.len(), known.get(&0), known.get(&1023)), (GATEWAYS, Some(&2000), None));
        (20_000..100_000).for_each(|hub| guard.note(hub, 1));
        let known = guard.take_changed().unwrap();
        assert_eq!((known.len(), known.contains_key(&99_999)), (GATEWAYS, true));
        assert_eq!(guard.order.len(), GATEWAYS);
    }

    #[test]
    fn another_sender_is_not_the_next_life_of_a_silent_gateway() {
        let mut incoming = listener(&[]);
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 0), 100), None);
        assert_eq!(receive_from(2, &mut incoming, &zones(7, 0), 110), Some(DatagramError::Twin));
    }

    #[test]
    fn a_gateway_may_change_its_address_while_its_hub_starts_again() {
        let mut incoming = listener(&[]);
        let twin = Some(DatagramError::Twin);
        assert_eq!(receive(&mut incoming, &announcement(7, 4, 100, 0), 100), None);
        assert_eq!(receive(&mut incoming, &zones(7, 0), 100), None);
        let mut moved = |bytes: &[u8], at_s| receive_from(2, &mut incoming, bytes, at_s);
        assert_eq!(moved(&announced_of(2, 7, 5, 102, 1), 102), twin, "the other one was heard just now");
        assert_eq!(moved(&announced_of(2, 7, 6, 104, 1), 110), twin, "recorded");
        assert_eq!(moved(&announced_of(2, 7, 4, 110, 1), 110), twin, "of a number that came");
        assert_eq!(moved(&zones(7, 1), 110), twin, "nothing was announced there yet");
        assert_eq!(moved(&announced_of(2, 7, 8, 110, 1), 110), None);
        assert_eq!(moved(&zones(7, 0), 110), None, "which is a duplicate");
        assert_eq!(moved(&zones(7, 1), 110), None);
        assert_eq!(incoming.stats().rows().map(|row| row.received).sum::<u64>(), 4);
        assert_eq!(receive(&mut incoming, &announcement(7, 9, 110, 1), 110), None, "and back, the same boot");
        assert_eq!(receive(&mut incoming, &zones(7, 2), 110), None);
    }

    #[test]
    fn parts_of_a_recording_are_refused_before_memory_is_spent_on_them() {
        let mut incoming = listener(&[]);
        let part = |sequence, part| {
            let topic = Topic::Zones.number();
            let head = Head { topic, epoch: 7, sequence, part, parts: 2, ..Head::default() };
            sealed(head, |room| {
                let len = Zones::unknown().pack(room)? / 2;
                room.copy_within(len * usize::from(part)..len * (usize::from(part) + 1), 0);
                Some(len)
            })
        };
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 40), 100), None);
        assert_eq!(receive(&mut incoming, &part(39, 0), 100), Some(DatagramError::Stale));
        assert_eq!([0, 1].map(|at| receive(&mut incoming, &part(40, at), 100)), [None; 2]);
        // A sample that is new goes on waiting, however many of those that came are sent again meanwhile.
        assert_eq!(receive(&mut incoming, &part(60, 0), 101), None);
        for sequence in (41..50).chain(52..60) {
            [0, 1].iter().for_each(|&at| assert_eq!(receive(&mut incoming, &part(sequence, at), 101), None));
        }
        for sequence in 41..50 {
            assert_eq!(receive(&mut incoming, &part(sequence, 0), 101), None);
        }
        assert_eq!(receive(&mut incoming, &part(60, 1), 101), None);
        let received: u64 =
            incoming.stats().rows().filter(|row| row.topic != 0).map(|row| row.received).sum();
        assert_eq!((received, incoming.stats().refused(DatagramError::Stale)), (19, 1));
    }
}
