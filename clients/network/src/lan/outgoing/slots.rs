//! What waits until it can be handed on: of each sensor and topic the newest sample, and nothing else. A way that is slow
//! or closed makes a newer sample take the place of an older one, so that what goes out is never old. The topics have their
//! turns in the order in which they began to wait. Refuses to know numbers, and what a payload says.

use std::collections::VecDeque;

use scanhub_schema::datagram::Head;

/// Samples that have no number yet, by sensor and topic.
#[derive(Default)]
pub(super) struct Slots {
    slots: Vec<Slot>,
    /// Positions in `slots` of those that wait, the first one for longest.
    turns: VecDeque<usize>,
}

/// The place of one sensor and topic.
struct Slot {
    /// Of the sample, without hub, epoch and sequence.
    head: Head,
    /// As it goes over a network.
    payload: Vec<u8>,
    is_waiting: bool,
}

impl Slots {
    /// Lets `payload` wait, behind which `head` will stand; whether it took the place of one that waited.
    pub(super) fn put(&mut self, head: Head, payload: &[u8]) -> bool {
        let at = self.slots.iter().position(|slot| slot.is_of(head.sensor, head.topic));
        let at = at.unwrap_or_else(|| {
            self.slots.push(Slot { head, payload: Vec::new(), is_waiting: false });
            self.slots.len() - 1
        });
        let slot = &mut self.slots[at];
        slot.head = head;
        slot.payload.clear();
        slot.payload.extend_from_slice(payload);
        let is_replaced = std::mem::replace(&mut slot.is_waiting, true);
        if !is_replaced {
            self.turns.push_back(at);
        }
        is_replaced
    }

    /// The sample that is next, which waits no more.
    pub(super) fn take(&mut self) -> Option<(Head, &[u8])> {
        let slot = &mut self.slots[self.turns.pop_front()?];
        slot.is_waiting = false;
        Some((slot.head, &slot.payload))
    }

    /// Whether nothing waits.
    pub(super) fn is_empty(&self) -> bool {
        self.turns.is_empty()
    }

    /// The sensor with this number is another one now; the topics of which a sample of the former one waited.
    pub(super) fn drop_sensor(&mut self, sensor: u8) -> Vec<u8> {
        let slots = &mut self.slots;
        let mut dropped = Vec::new();
        self.turns.retain(|&at| {
            let slot = &mut slots[at];
            if slot.head.sensor == sensor {
                slot.is_waiting = false;
                dropped.push(slot.head.topic);
            }
            slot.is_waiting
        });
        dropped
    }
}

impl Slot {
    fn is_of(&self, sensor: u8, topic: u8) -> bool {
        (self.head.sensor, self.head.topic) == (sensor, topic)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(sensor: u8, topic: u8) -> Head {
        Head { sensor, topic, ..Head::default() }
    }

    #[test]
    fn only_the_newest_waits_and_every_topic_has_its_turn() {
        let mut slots = Slots::default();
        assert!(!slots.put(head(0, 2), b"a") && !slots.put(head(0, 4), b"b"));
        assert!(slots.put(head(0, 2), b"newer") && !slots.put(head(1, 2), b"c"));
        let mut order = Vec::new();
        while let Some((head, payload)) = slots.take() {
            order.push((head.sensor, head.topic, payload.to_vec()));
        }
        assert_eq!(order, [(0, 2, b"newer".to_vec()), (0, 4, b"b".to_vec()), (1, 2, b"c".to_vec())]);
        assert!(slots.is_empty() && !slots.put(head(0, 2), b"d"));
    }

    #[test]
    fn what_waits_of_a_sensor_that_is_another_one_now_is_dropped() {
        let mut slots = Slots::default();
        slots.put(head(0, 2), b"a");
        slots.put(head(1, 2), b"b");
        assert_eq!((slots.drop_sensor(0), slots.drop_sensor(0)), (vec![2], vec![]));
        assert_eq!(slots.take(), Some((head(1, 2), &b"b"[..])));
        assert!(!slots.put(head(0, 2), b"c") && slots.take().is_some());
    }
}
