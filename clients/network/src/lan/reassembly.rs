//! Reassembly of samples that are sent in parts. Parts may arrive in any order, twice, or not at all. Memory is
//! bounded, whatever anyone sends.

use scanhub_schema::datagram::{Datagram, Head, MAX_PART_LEN};

/// Samples that are not complete yet. A sample that is evicted is not reported here: it counts as lost, because its
/// sequence number never arrives.
#[derive(Default)]
pub(super) struct Reassembler {
    partial: Vec<PartialSample>,
    /// Finished or evicted samples, whose memory is used for the next ones.
    free: Vec<PartialSample>,
    /// Number of parts that have arrived.
    count: u64,
}

/// A sample with missing parts.
struct PartialSample {
    /// Header of the sample's parts, with 0 as the index of the part.
    head: Head,
    from: u64,
    /// Whether the sample is a duplicate.
    is_known: bool,
    /// Value of [`Reassembler::count`] when the last part of this sample arrived.
    last: u64,
    /// Length of each part; `None` for a missing part.
    lengths: Vec<Option<usize>>,
    /// Bytes of all parts. Each part has room for the maximum length.
    bytes: Vec<u8>,
}

/// Maximum number of partial samples of one sender, sensor and topic.
const MAX_PER_TOPIC: usize = 4;
/// Maximum number of partial samples of all senders. They take 23 MB if all are as long as possible.
const MAX_TOTAL: usize = 64;

impl Reassembler {
    /// Takes a part from the sender `from`. `is_known` is true if the sample is a duplicate. Once the sample is
    /// complete, writes it to `whole`, and returns its header.
    pub(super) fn take(
        &mut self,
        part: &Datagram<'_>,
        from: u64,
        is_known: bool,
        whole: &mut Vec<u8>,
    ) -> Option<Head> {
        self.count += 1;
        let head = Head { part: 0, ..part.head };
        let known = self.partial.iter().position(|it| it.from == from && it.head == head);
        let at = match known {
            Some(at) => at,
            None => self.begin(head, from, is_known)?,
        };
        let it = &mut self.partial[at];
        it.last = self.count;
        let number = usize::from(part.head.part);
        let begin = MAX_PART_LEN * number;
        it.bytes[begin..begin + part.payload.len()].copy_from_slice(part.payload);
        it.lengths[number] = Some(part.payload.len());
        if it.lengths.iter().any(Option::is_none) {
            return None;
        }
        let it = self.partial.swap_remove(at);
        whole.clear();
        for (bytes, len) in it.bytes.chunks(MAX_PART_LEN).zip(it.lengths.iter().flatten()) {
            whole.extend_from_slice(&bytes[..*len]);
        }
        self.free.push(it);
        Some(Head { parts: 1, ..head })
    }

    /// Adds a sample, and returns its index. It replaces a sample of its topic that has the same number but another
    /// header. If there is no room, it evicts the sample of its topic, or of all topics, that has waited for longest.
    /// Duplicates are evicted first. Returns `None` if a duplicate would evict a sample that is not a duplicate.
    fn begin(&mut self, head: Head, from: u64, is_known: bool) -> Option<usize> {
        let topic = |it: &PartialSample| (it.from, it.head.hub, it.head.epoch, it.head.sensor, it.head.topic);
        let of_topic = (from, head.hub, head.epoch, head.sensor, head.topic);
        let same = self.partial.iter().filter(|it| topic(it) == of_topic);
        let other =
            self.partial.iter().position(|it| topic(it) == of_topic && it.head.sequence == head.sequence);
        let is_full = same.count() == MAX_PER_TOPIC;
        let waits = self.partial.iter().enumerate();
        let oldest = waits
            .filter(|(_, it)| !is_full || topic(it) == of_topic)
            .min_by_key(|(_, it)| (!it.is_known, it.last));
        let is_full = is_full || self.partial.len() == MAX_TOTAL;
        if other.is_none() && is_full && is_known && oldest.is_some_and(|(_, it)| !it.is_known) {
            return None;
        }
        if let Some(at) = other.or(oldest.filter(|_| is_full).map(|(at, _)| at)) {
            self.free.push(self.partial.swap_remove(at));
        }
        let new = || PartialSample { head, from, is_known, last: 0, lengths: Vec::new(), bytes: Vec::new() };
        let mut it = self.free.pop().unwrap_or_else(new);
        (it.head, it.from, it.is_known) = (head, from, is_known);
        let parts = usize::from(head.parts);
        it.lengths.clear();
        it.lengths.resize(parts, None);
        it.bytes.resize(parts * MAX_PART_LEN, 0);
        self.partial.push(it);
        Some(self.partial.len() - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(sequence: u32) -> Head {
        Head { topic: 2, hub: 5, sequence, parts: 3, ..Head::default() }
    }

    /// Takes part number `part` of the sample with `head`. Returns the sample once it is complete.
    fn take(parts: &mut Reassembler, head: Head, part: u8, from: u64) -> Option<Vec<u8>> {
        let (payload, mut whole) = ([head.sequence as u8, part].repeat(usize::from(part) + 1), vec![9]);
        let datagram = Datagram { head: Head { part, ..head }, payload: &payload, mac: None };
        let taken = parts.take(&datagram, from, false, &mut whole)?;
        assert_eq!(taken, Head { parts: 1, ..head });
        Some(whole)
    }

    const WHOLE: [u8; 12] = [7, 0, 7, 1, 7, 1, 7, 2, 7, 2, 7, 2];

    #[test]
    fn reassembles_parts_in_any_order_and_duplicates() {
        for order in [&[0, 1, 2][..], &[2, 1, 0], &[1, 1, 2, 1, 0], &[2, 0, 0, 2, 1]] {
            let mut parts = Reassembler::default();
            let (last, first) = order.split_last().unwrap();
            for part in first {
                assert_eq!(take(&mut parts, head(7), *part, 1), None, "{order:?}");
            }
            assert_eq!(take(&mut parts, head(7), *last, 1).as_deref(), Some(&WHOLE[..]), "{order:?}");
            assert!(parts.partial.is_empty());
        }
    }

    #[test]
    fn never_mixes_parts_of_two_samples() {
        let mut parts = Reassembler::default();
        take(&mut parts, head(7), 0, 1);
        take(&mut parts, head(7), 1, 1);
        for (other, from) in [
            (head(8), 1),
            (head(7), 2),
            (Head { hub: 6, ..head(7) }, 1),
            (Head { epoch: 1, ..head(7) }, 1),
            (Head { sensor: 1, ..head(7) }, 1),
        ] {
            assert_eq!(take(&mut parts, other, 2, from), None, "{other:?}");
        }
        assert!(take(&mut parts, head(7), 2, 1).is_some(), "none of them replaced it");
        // A second sample with the same number replaces the first one.
        take(&mut parts, head(9), 0, 1);
        for other in
            [Head { counter: 1, ..head(9) }, Head { stamp_ns: 1, ..head(9) }, Head { parts: 4, ..head(9) }]
        {
            assert_eq!((take(&mut parts, other, 1, 1), take(&mut parts, other, 2, 1)), (None, None));
        }
        assert_eq!(take(&mut parts, head(9), 1, 1), None);
    }

    #[test]
    fn fifth_partial_sample_of_a_topic_evicts_the_oldest() {
        let mut parts = Reassembler::default();
        for sequence in 0..4 {
            take(&mut parts, head(sequence), 0, 1);
        }
        take(&mut parts, head(0), 1, 1);
        take(&mut parts, head(4), 0, 1);
        assert_eq!(parts.partial.len(), 4);
        assert!(take(&mut parts, head(0), 2, 1).is_some(), "it did not wait for longest");
        take(&mut parts, head(1), 1, 1);
        assert_eq!(take(&mut parts, head(1), 2, 1), None, "its first part is gone");
    }

    #[test]
    fn memory_is_bounded() {
        let mut parts = Reassembler::default();
        for hub in 0..1000 {
            for sequence in 0..6 {
                assert_eq!(take(&mut parts, Head { hub, parts: 255, ..head(sequence) }, 0, hub), None);
            }
        }
        let places = parts.partial.iter().chain(&parts.free);
        let bytes: usize = places.clone().map(|it| it.bytes.capacity()).sum();
        assert!(places.count() <= 65 && bytes <= 65 * 255 * MAX_PART_LEN, "{bytes}");
        take(&mut parts, head(7), 0, 1);
        take(&mut parts, head(7), 1, 1);
        assert!(take(&mut parts, head(7), 2, 1).is_some());
    }
}
