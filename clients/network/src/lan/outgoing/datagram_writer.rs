//! Writes the datagrams of a gateway: numbers each sample, and seals it in one datagram or in parts. Without a queue, a
//! sample is transmitted at once. With a queue, the newest sample of each topic waits until it is taken.

use std::collections::VecDeque;

use scanhub_schema::Topic;
use scanhub_schema::datagram::{
    Announce, Announced, HEADER_LEN, Head, MAC_LEN, MAX_PARTS, MTU_ETHERNET, group,
};

use crate::lan::{Key, WallTimestamp};

/// Destination of datagrams: sockets, or a model of a network.
pub trait Transmit {
    /// Sends a whole datagram to the port that is `above` ports after the usual one. `group` is the last byte of the
    /// group's address. Returns whether the datagram was sent. If not, its sequence number counts as failed here, and
    /// as lost at receivers.
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool;
}

/// Form of a datagram.
#[derive(Clone, Debug)]
pub enum Form {
    /// A header and the payload.
    Sealed,
    /// A header, the payload and a MAC of this key.
    Authenticated(Key),
    /// Only the payload. Each sensor has its own port.
    Bare,
}

impl Form {
    /// Returns the number of bytes that are reserved for the header and the MAC, besides the payload.
    fn overhead(&self) -> usize {
        if matches!(self, Form::Authenticated(_)) { HEADER_LEN + MAC_LEN } else { HEADER_LEN }
    }

    fn is_bare(&self) -> bool {
        matches!(self, Form::Bare)
    }
}

/// Numbers and writes the datagrams of one run of a gateway, and counts them.
pub(super) struct DatagramWriter {
    hub: u64,
    epoch: u32,
    sensors: Vec<SensorStats>,
    form: Form,
    /// Maximum length of a datagram, in bytes.
    max_datagram_len: usize,
    /// Samples that did not fit into the maximum number of parts.
    oversized_samples: u64,
    /// Room for a header and the longest payload.
    buffer: Vec<u8>,
    queue: Option<Queue>,
}

/// Samples that wait until they are taken, and taken samples that may be sent again.
#[derive(Default)]
struct Queue {
    waiting: LatestQueue,
    /// Last announcement, status and background of each sensor that were taken from the queue.
    last: Vec<(Head, Vec<u8>)>,
}

/// A sample that was taken from the queue, with its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueuedSample<'a> {
    /// Number of the sensor in the hub, and its name.
    pub sensor: (u8, &'a str),
    /// Topic of the sample; `None` for an announcement.
    pub topic: Option<Topic>,
    /// Whole datagram.
    pub datagram: &'a [u8],
}

/// Counters of one sensor.
#[derive(Default)]
pub struct SensorStats {
    /// Name of the sensor to which this number was assigned last.
    pub name: String,
    topics: [TopicStats; STREAM_COUNT],
}

/// Counters of one sensor and topic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TopicStats {
    /// Samples that were sent.
    pub sent: u64,
    /// Samples that have a sequence number, but were not sent, or not with all parts.
    pub failed: u64,
    /// Bytes of the datagrams that were sent.
    pub bytes: u64,
    /// Samples that the hub sent and the gateway did not receive; they have no sequence number.
    pub missed: u64,
    /// Samples that were replaced by newer ones while they waited; they have no sequence number.
    pub replaced: u64,
    oversize: Oversize,
}

/// Whether a sample of a topic did not fit into datagrams, and whether that was reported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Oversize {
    #[default]
    None,
    Unreported,
    Reported,
}

impl TopicStats {
    /// Returns the sequence number of the next sample.
    pub fn next_number(&self) -> u32 {
        (self.sent + self.failed) as u32
    }
}

impl SensorStats {
    /// Returns all topics with a counter that is not 0; `None` stands for announcements.
    pub fn used_topics(&self) -> impl Iterator<Item = (Option<Topic>, &TopicStats)> {
        let numbered = self.topics.iter().enumerate().filter(|(_, row)| **row != TopicStats::default());
        numbered.map(|(number, row)| (Topic::of_number(number as u8), row))
    }

    /// Writes `payload`, which waited with `head`, to the start of `room`, and returns its length. An announcement gets
    /// the current sequence numbers. With the numbers from the time at which it was queued, a receiver that starts late
    /// would count samples as lost that were sent before the announcement.
    fn write(&self, head: &Head, payload: &[u8], room: &mut [u8]) -> Option<usize> {
        if head.topic == Announce::NUMBER {
            return self.updated_announcement(&Announce::unpack(payload)?).pack(room);
        }
        room.get_mut(..payload.len())?.copy_from_slice(payload);
        Some(payload.len())
    }

    /// Returns the announcement `old` with the current sequence numbers.
    fn updated_announcement(&self, old: &Announce) -> Announce {
        let mut announce = Announce::new(old.boot, old.sensor(), old.kind());
        for topic in old.topics() {
            let row = self.topics.get(usize::from(topic.topic)).copied().unwrap_or_default();
            announce.add(Announced { next: row.next_number(), ..*topic });
            announce.add_replaced(row.replaced);
        }
        announce
    }
}

impl DatagramWriter {
    /// Creates the writer of gateway `hub` in its run `epoch`. Datagrams have at most `longest` bytes.
    pub(super) fn new(hub: u64, epoch: u32, form: Form, longest: usize) -> DatagramWriter {
        let overhead = form.overhead();
        let longest = longest.clamp(overhead + 1, MTU_ETHERNET);
        // A bare telegram is never sent in parts, because it has no header with the index of a part.
        let parts = if form.is_bare() { 1 } else { MAX_PARTS };
        let buffer = vec![0; overhead + parts * (longest - overhead)];
        DatagramWriter {
            hub,
            epoch,
            sensors: Vec::new(),
            form,
            max_datagram_len: longest,
            oversized_samples: 0,
            buffer,
            queue: None,
        }
    }

    /// Creates a writer with a queue. Each sample is one datagram, however long it is, and waits until it is taken.
    pub(super) fn with_queue(hub: u64, epoch: u32) -> DatagramWriter {
        let buffer = vec![0; MAX_SAMPLE_LEN];
        let queue = Some(Queue::default());
        let (form, longest) = (Form::Sealed, MAX_SAMPLE_LEN);
        DatagramWriter {
            hub,
            epoch,
            sensors: Vec::new(),
            form,
            max_datagram_len: longest,
            oversized_samples: 0,
            buffer,
            queue,
        }
    }

    /// Returns whether announcements contain the number of replaced samples.
    pub(super) fn counts_replaced(&self) -> bool {
        self.queue.is_some()
    }

    /// Returns how many samples of this sensor and topic were replaced.
    pub(super) fn replaced(&self, number: u8, topic: Topic) -> u64 {
        let stats = self.sensors.get(usize::from(number));
        stats.map_or(0, |stats| stats.topics[usize::from(topic.number())].replaced)
    }

    /// Takes the sample that has waited for longest, numbers it, and returns its datagram for sending at `now`. `None`
    /// if no sample waits.
    pub(super) fn take_next(&mut self, now: WallTimestamp) -> Option<QueuedSample<'_>> {
        let Queue { waiting, last } = self.queue.as_mut()?;
        let (head, payload) = waiting.take()?;
        let stats = self.sensors.get_mut(usize::from(head.sensor))?;
        let len = stats.write(&head, payload, &mut self.buffer[HEADER_LEN..])?;
        let row = stats.topics.get_mut(usize::from(head.topic))?;
        let stamp_ns = stamp_ns(&head, now);
        let head = Head { hub: self.hub, epoch: self.epoch, sequence: row.next_number(), stamp_ns, ..head };
        let datagram = head.seal(&mut self.buffer, len)?;
        row.sent += 1;
        row.bytes += datagram.len() as u64;
        let topic = Topic::of_number(head.topic);
        if topic.is_none_or(is_stored) {
            let same = |(other, _): &(Head, _)| (other.sensor, other.topic) == (head.sensor, head.topic);
            match last.iter_mut().find(|kept| same(kept)) {
                Some((kept, bytes)) => {
                    *kept = head;
                    bytes.clear();
                    bytes.extend_from_slice(payload);
                }
                None => last.push((head, payload.to_vec())),
            }
        }
        let name = &self.sensors[usize::from(head.sensor)].name;
        Some(QueuedSample { sensor: (head.sensor, name), topic, datagram })
    }

    /// Returns the last sample of a stored topic for sending it again at `now`. It keeps its sequence number.
    pub(super) fn resend_last(
        &mut self,
        name: &str,
        topic: Option<Topic>,
        now: WallTimestamp,
    ) -> Option<&[u8]> {
        let number = topic.map_or(Announce::NUMBER, Topic::number);
        let last = &self.queue.as_ref()?.last;
        let is_requested =
            |head: &Head| self.sensors[usize::from(head.sensor)].name == name && head.topic == number;
        // After a restart of the hub, samples of the sensor may be stored under two sensor numbers. The later one is
        // valid.
        let (head, payload) = last.iter().rev().find(|(head, _)| is_requested(head))?;
        let head = Head { stamp_ns: stamp_ns(head, now), ..*head };
        let len =
            self.sensors[usize::from(head.sensor)].write(&head, payload, &mut self.buffer[HEADER_LEN..])?;
        head.seal(&mut self.buffer, len)
    }

    /// Returns the sensors and topics with a kept sample, in the order in which they were sent first.
    pub(super) fn stored_samples(&self) -> impl Iterator<Item = (&str, Option<Topic>)> {
        self.queue
            .iter()
            .flat_map(|queue| &queue.last)
            .map(|(head, _)| (&*self.sensors[usize::from(head.sensor)].name, Topic::of_number(head.topic)))
    }

    /// Drops all kept samples.
    pub(super) fn drop_kept(&mut self) {
        if let Some(queue) = &mut self.queue {
            queue.last.clear();
        }
    }

    /// Counts the last sample of this sensor and topic, of `bytes` bytes, as failed instead of sent.
    pub(super) fn mark_failed(&mut self, number: u8, topic: Option<Topic>, bytes: usize) {
        if let Some(row) = self.row(number, topic.map_or(Announce::NUMBER, Topic::number)) {
            row.sent -= 1;
            row.bytes -= bytes as u64;
            row.failed += 1;
        }
    }

    /// Returns whether a sample waits.
    pub(super) fn is_waiting(&self) -> bool {
        self.queue.as_ref().is_some_and(|queue| !queue.waiting.is_empty())
    }

    /// Returns whether announcements are sent.
    pub(super) fn announces(&self) -> bool {
        !self.form.is_bare()
    }

    /// Returns the maximum length of a datagram, in bytes.
    pub(super) fn max_datagram_len(&self) -> usize {
        self.max_datagram_len
    }

    /// Returns the number of samples that did not fit into the maximum number of parts.
    pub(super) fn oversized_samples(&self) -> u64 {
        self.oversized_samples
    }

    /// Assigns sensor number `number` to the sensor called `name`.
    pub(super) fn claim(&mut self, number: u8, name: &str) {
        let at = usize::from(number);
        if self.sensors.len() <= at {
            self.sensors.resize_with(at + 1, SensorStats::default);
        }
        if self.sensors[at].name == name {
            return;
        }
        name.clone_into(&mut self.sensors[at].name);
        if let Some(Queue { waiting, last }) = &mut self.queue {
            last.retain(|(head, _)| head.sensor != number);
            for topic in waiting.drop_sensor(number) {
                self.sensors[at].topics[usize::from(topic)].replaced += 1;
            }
        }
    }

    /// Returns whether `number` is still assigned to `name`. After a restart, a hub may number its sensors differently.
    pub(super) fn is_claimed(&self, number: u8, name: &str) -> bool {
        self.sensors.get(usize::from(number)).is_some_and(|stats| stats.name == name)
    }

    /// Returns the sequence number of the next sample of this sensor and topic.
    pub(super) fn next(&self, number: u8, topic: Topic) -> u32 {
        let stats = self.sensors.get(usize::from(number));
        stats.map_or(0, |stats| stats.topics[usize::from(topic.number())].next_number())
    }

    /// Counts samples that the hub sent and the gateway did not receive.
    pub(super) fn count_missed(&mut self, number: u8, topic: Topic, missed: u64) {
        if let Some(row) = self.row(number, topic.number()) {
            row.missed += missed;
        }
    }

    /// Returns the counters of each sensor, by its number.
    pub(super) fn sensors(&self) -> impl Iterator<Item = &SensorStats> {
        self.sensors.iter()
    }

    /// Sends the payload that `pack` writes, under the next number of this sensor and topic. `head` has no hub, epoch
    /// and sequence number yet. A sample that fails uses its number up. With a queue, the payload waits and gets no
    /// number yet.
    pub(super) fn send(
        &mut self,
        head: Head,
        to: &mut impl Transmit,
        pack: impl FnOnce(&mut [u8]) -> Option<usize>,
    ) {
        let (hub, epoch) = (self.hub, self.epoch);
        if let Some(Queue { waiting, .. }) = &mut self.queue {
            let payload = pack(&mut self.buffer[HEADER_LEN..]);
            let is_replaced =
                payload.is_some_and(|len| waiting.put(head, &self.buffer[HEADER_LEN..HEADER_LEN + len]));
            self.oversized_samples += u64::from(payload.is_none());
            if let Some(row) = self.row(head.sensor, head.topic) {
                row.replaced += u64::from(is_replaced);
            }
            return;
        }
        let Some(row) = self.row(head.sensor, head.topic) else { return };
        let head = Head { hub, epoch, sequence: row.next_number(), ..head };
        let end = self.buffer.len() + HEADER_LEN - self.form.overhead();
        let payload = pack(&mut self.buffer[HEADER_LEN..end]);
        let group = Topic::of_number(head.topic).map_or(Announce::GROUP, group);
        let sent = payload.and_then(|len| match self.form {
            Form::Sealed | Form::Authenticated(_) => self.send_sealed(head, len, group, to),
            Form::Bare => {
                to.transmit(&self.buffer[HEADER_LEN..HEADER_LEN + len], group, head.sensor).then_some(len)
            }
        });
        if let Some(row) = self.row(head.sensor, head.topic) {
            match sent {
                Some(len) => {
                    row.sent += 1;
                    row.bytes += len as u64;
                }
                None => row.failed += 1,
            }
            if payload.is_none() && row.oversize == Oversize::None {
                row.oversize = Oversize::Unreported;
            }
        }
        self.oversized_samples += u64::from(payload.is_none());
    }

    /// Sends the payload of `len` bytes in the buffer, in as few parts as possible. Returns the bytes of all datagrams
    /// if all were sent.
    ///
    /// The parts are sealed in place. The header of a part overwrites the end of the previous part, which was already
    /// sent. The MAC of a part overwrites the start of the next part, which is restored afterward.
    fn send_sealed(&mut self, head: Head, len: usize, group: u8, to: &mut impl Transmit) -> Option<usize> {
        let room = self.max_datagram_len - self.form.overhead();
        let parts = len.div_ceil(room).max(1);
        let mut bytes = Some(0);
        for part in 0..parts {
            let begin = part * room;
            let head = Head { part: part as u8, parts: parts as u8, ..head };
            let (buffer, len) = (&mut self.buffer[begin..], room.min(len - begin));
            let mut after = [0; MAC_LEN];
            let datagram = match &self.form {
                Form::Authenticated(key) => {
                    after.copy_from_slice(buffer.get(HEADER_LEN + len..HEADER_LEN + len + MAC_LEN)?);
                    head.seal_with(buffer, len, |covered| key.mac(covered))?
                }
                _ => head.seal(buffer, len)?,
            };
            // Send the other parts even if one fails: another destination may have received all parts.
            let is_sent = to.transmit(datagram, group, 0);
            bytes = bytes.filter(|_| is_sent).map(|bytes| bytes + datagram.len());
            if matches!(self.form, Form::Authenticated(_)) {
                buffer[HEADER_LEN + len..][..MAC_LEN].copy_from_slice(&after);
            }
        }
        bytes
    }

    /// Returns the `SENSOR/TOPIC` of a sample that did not fit into datagrams. Returns each name only once.
    pub(super) fn take_oversized(&mut self) -> Option<String> {
        self.sensors.iter_mut().find_map(|SensorStats { name, topics }| {
            let (number, row) =
                topics.iter_mut().enumerate().find(|(_, row)| row.oversize == Oversize::Unreported)?;
            row.oversize = Oversize::Reported;
            let topic = Topic::of_number(number as u8).map_or("announce", Topic::name);
            Some(format!("{name}/{topic}"))
        })
    }

    fn row(&mut self, number: u8, topic: u8) -> Option<&mut TopicStats> {
        self.sensors.get_mut(usize::from(number))?.topics.get_mut(usize::from(topic))
    }
}

/// Returns the stamp of a sample with this `head` that is sent at `now`. Announcements and statuses have the time at
/// which they are sent, however long they waited, because receivers compare clocks by them.
fn stamp_ns(head: &Head, now: WallTimestamp) -> u64 {
    match Topic::of_number(head.topic) {
        None | Some(Topic::Status) => now.wall_ns,
        Some(_) => head.stamp_ns,
    }
}

/// Returns whether the last sample of this topic is kept for receivers that query it. Such a sample is valid until the
/// next one.
fn is_stored(topic: Topic) -> bool {
    matches!(topic, Topic::Status | Topic::Background)
}

/// Maximum length of a sample in one datagram: a header, and the longest payload whose length it can contain.
const MAX_SAMPLE_LEN: usize = HEADER_LEN + u16::MAX as usize;

/// Number of counted streams: announcements, and the topics by their numbers.
const STREAM_COUNT: usize = 1 + Topic::ALL.len();

/// Queue that holds only the newest sample of each sensor and topic. When the network is slow or down, a newer sample
/// replaces the older one, so nothing stale is sent. Topics are served in the order in which they started to wait.
#[derive(Default)]
struct LatestQueue {
    slots: Vec<Slot>,
    /// Indices in `slots` of the waiting samples. The first one has waited for longest.
    order: VecDeque<usize>,
}

/// Newest sample of one sensor and topic, which has no number yet.
struct Slot {
    /// Header without hub, epoch and sequence number.
    head: Head,
    payload: Vec<u8>,
    is_waiting: bool,
}

impl LatestQueue {
    /// Adds `payload` with `head`. Returns whether it replaced a sample that waited.
    fn put(&mut self, head: Head, payload: &[u8]) -> bool {
        let key = (head.sensor, head.topic);
        let at = self.slots.iter().position(|slot| (slot.head.sensor, slot.head.topic) == key);
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
            self.order.push_back(at);
        }
        is_replaced
    }

    /// Removes the sample that has waited for longest, and returns it.
    fn take(&mut self) -> Option<(Head, &[u8])> {
        let slot = &mut self.slots[self.order.pop_front()?];
        slot.is_waiting = false;
        Some((slot.head, &slot.payload))
    }

    /// Returns whether no sample waits.
    fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Drops the queued samples of a sensor number that now belongs to another sensor. Returns their topics.
    fn drop_sensor(&mut self, sensor: u8) -> Vec<u8> {
        let slots = &mut self.slots;
        let mut dropped = Vec::new();
        self.order.retain(|&at| {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn head(sensor: u8, topic: u8) -> Head {
        Head { sensor, topic, ..Head::default() }
    }

    #[test]
    fn serves_newest_sample_of_each_topic_in_order() {
        let mut queue = LatestQueue::default();
        assert!(!queue.put(head(0, 2), b"a") && !queue.put(head(0, 4), b"b"));
        assert!(queue.put(head(0, 2), b"newer") && !queue.put(head(1, 2), b"c"));
        let mut order = Vec::new();
        while let Some((head, payload)) = queue.take() {
            order.push((head.sensor, head.topic, payload.to_vec()));
        }
        assert_eq!(order, [(0, 2, b"newer".to_vec()), (0, 4, b"b".to_vec()), (1, 2, b"c".to_vec())]);
        assert!(queue.is_empty() && !queue.put(head(0, 2), b"d"));
    }

    #[test]
    fn drops_samples_of_a_renumbered_sensor() {
        let mut queue = LatestQueue::default();
        queue.put(head(0, 2), b"a");
        queue.put(head(1, 2), b"b");
        assert_eq!((queue.drop_sensor(0), queue.drop_sensor(0)), (vec![2], vec![]));
        assert_eq!(queue.take(), Some((head(1, 2), &b"b"[..])));
        assert!(!queue.put(head(0, 2), b"c") && queue.take().is_some());
    }
}
