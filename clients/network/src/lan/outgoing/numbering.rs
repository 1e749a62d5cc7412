//! The datagrams of a gateway: each sample is numbered, sealed in one datagram or in parts, and handed over once, in a
//! buffer that is always the same; at once, or when it is asked for. Refuses to know where samples come from and where
//! datagrams go.

use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Announced, HEAD, Head, MAC, MTU_ETHERNET, PARTS, group};

use super::slots::Slots;
use crate::lan::{Key, Stamp};

/// What takes datagrams: sockets, or a model of a network.
pub trait Transmit {
    /// Takes a whole datagram for the group with this last byte, and for the port so much `above` the usual one. Returns
    /// whether it was sent: a number that was not is counted as failed, and is lost to who receives.
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool;
}

/// How a payload becomes a datagram.
#[derive(Clone, Debug)]
pub enum Form {
    /// Behind a header.
    Sealed,
    /// Between a header and a MAC of this key.
    Authenticated(Key),
    /// By itself, to a port of its sensor.
    Bare,
}

impl Form {
    /// Bytes around a payload.
    fn around(&self) -> usize {
        if matches!(self, Form::Authenticated(_)) { HEAD + MAC } else { HEAD }
    }

    fn is_bare(&self) -> bool {
        matches!(self, Form::Bare)
    }
}

/// Numbers what goes out, and keeps the account of it.
pub(super) struct Numbering {
    hub: u64,
    epoch: u32,
    sensors: Vec<Rows>,
    form: Form,
    longest: usize,
    /// What did not fit into a datagram.
    unfit: u64,
    /// A header, and the longest payload that can go out.
    buffer: Vec<u8>,
    waiting: Option<Waiting>,
}

/// Where samples wait until they are asked for.
#[derive(Default)]
struct Waiting {
    slots: Slots,
    /// Of announcements, statuses and backgrounds the last one that was handed on.
    last: Vec<(Head, Vec<u8>)>,
}

/// A sample that was asked for, with its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Handed<'a> {
    /// The sensor's number in the hub, and what it is called.
    pub sensor: (u8, &'a str),
    /// Of which topic; announcements are of none.
    pub topic: Option<Topic>,
    /// All of it, in one piece.
    pub datagram: &'a [u8],
}

/// The account of one sensor.
#[derive(Default)]
pub struct Rows {
    /// Who had this number last.
    pub name: String,
    rows: [Row; KINDS],
}

/// The account of one sensor and topic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Row {
    /// Samples that were sent.
    pub sent: u64,
    /// Samples that have a number and were not sent, or not all parts of them.
    pub failed: u64,
    /// Bytes in what was sent.
    pub bytes: u64,
    /// Samples that the hub sent and the gateway did not receive; they have no number.
    pub missed: u64,
    /// Samples that waited until a newer one took their place; they have no number.
    pub replaced: u64,
    fit: Fit,
}

/// Whether all samples of a topic fit into datagrams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Fit {
    #[default]
    All,
    NotAll,
    /// And that is told.
    Told,
}

impl Row {
    /// Returns the number of the next sample.
    pub fn next(&self) -> u32 {
        (self.sent + self.failed) as u32
    }
}

impl Rows {
    /// Returns all topics of which anything was sent or ought to have been, announcements as nothing.
    pub fn used(&self) -> impl Iterator<Item = (Option<Topic>, &Row)> {
        let numbered = self.rows.iter().enumerate().filter(|(_, row)| **row != Row::default());
        numbered.map(|(number, row)| (Topic::of_number(number as u8), row))
    }

    /// Writes the `payload` that waited behind `head` to the start of `room`; returns its length. An announcement says what
    /// is so now: with the numbers of when it began to wait, who comes late would take for lost what was sent before.
    fn write(&self, head: &Head, payload: &[u8], room: &mut [u8]) -> Option<usize> {
        if head.topic == Announce::NUMBER {
            return self.renewed(&Announce::unpack(payload)?).pack(room);
        }
        room.get_mut(..payload.len())?.copy_from_slice(payload);
        Some(payload.len())
    }

    /// The announcement `said`, with the numbers as they are now.
    fn renewed(&self, said: &Announce) -> Announce {
        let mut announce = Announce::new(said.boot, said.sensor(), said.kind());
        for topic in said.topics() {
            let row = self.rows.get(usize::from(topic.topic)).copied().unwrap_or_default();
            announce.add(Announced { next: row.next(), ..*topic });
            announce.add_replaced(row.replaced);
        }
        announce
    }
}

impl Numbering {
    /// Datagrams of at most `longest` bytes, as gateway `hub` in this `epoch`.
    pub(super) fn new(hub: u64, epoch: u32, form: Form, longest: usize) -> Numbering {
        let around = form.around();
        let longest = longest.clamp(around + 1, MTU_ETHERNET);
        // Telegrams by themselves have no header that could say which part one is.
        let parts = if form.is_bare() { 1 } else { PARTS };
        let buffer = vec![0; around + parts * (longest - around)];
        Numbering { hub, epoch, sensors: Vec::new(), form, longest, unfit: 0, buffer, waiting: None }
    }

    /// Whole samples, however long, each of which waits until it is asked for.
    pub(super) fn waiting(hub: u64, epoch: u32) -> Numbering {
        let buffer = vec![0; WHOLE_LONGEST];
        let waiting = Some(Waiting::default());
        let (form, longest) = (Form::Sealed, WHOLE_LONGEST);
        Numbering { hub, epoch, sensors: Vec::new(), form, longest, unfit: 0, buffer, waiting }
    }

    /// Whether announcements say how many samples were replaced.
    pub(super) fn tells_replaced(&self) -> bool {
        self.waiting.is_some()
    }

    /// How many samples of this sensor and topic were replaced.
    pub(super) fn replaced(&self, number: u8, topic: Topic) -> u64 {
        let rows = self.sensors.get(usize::from(number));
        rows.map_or(0, |rows| rows.rows[usize::from(topic.number())].replaced)
    }

    /// Numbers the sample that waits for longest and returns it, as it is sent `now`; nothing if none waits.
    pub(super) fn hand(&mut self, now: Stamp) -> Option<Handed<'_>> {
        let Waiting { slots, last } = self.waiting.as_mut()?;
        let (head, payload) = slots.take()?;
        let rows = self.sensors.get_mut(usize::from(head.sensor))?;
        let len = rows.write(&head, payload, &mut self.buffer[HEAD..])?;
        let row = rows.rows.get_mut(usize::from(head.topic))?;
        let stamp_ns = stamp_ns(&head, now);
        let head = Head { hub: self.hub, epoch: self.epoch, sequence: row.next(), stamp_ns, ..head };
        let datagram = head.seal(&mut self.buffer, len)?;
        row.sent += 1;
        row.bytes += datagram.len() as u64;
        let topic = Topic::of_number(head.topic);
        if topic.is_none_or(is_kept) {
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
        Some(Handed { sensor: (head.sensor, name), topic, datagram })
    }

    /// What was handed on last of a topic that is kept, sent again `now` under the number that it has.
    pub(super) fn again(&mut self, name: &str, topic: Option<Topic>, now: Stamp) -> Option<&[u8]> {
        let number = topic.map_or(Announce::NUMBER, Topic::number);
        let last = &self.waiting.as_ref()?.last;
        let is_it = |head: &Head| self.sensors[usize::from(head.sensor)].name == name && head.topic == number;
        // After a restart of the hub, a sensor may have two numbers: the later one counts.
        let (head, payload) = last.iter().rev().find(|(head, _)| is_it(head))?;
        let head = Head { stamp_ns: stamp_ns(head, now), ..*head };
        let len = self.sensors[usize::from(head.sensor)].write(&head, payload, &mut self.buffer[HEAD..])?;
        head.seal(&mut self.buffer, len)
    }

    /// Returns the sensors and topics with a kept sample, in the order in which they were sent first.
    pub(super) fn kept(&self) -> impl Iterator<Item = (&str, Option<Topic>)> {
        self.waiting
            .iter()
            .flat_map(|waiting| &waiting.last)
            .map(|(head, _)| (&*self.sensors[usize::from(head.sensor)].name, Topic::of_number(head.topic)))
    }

    /// Forgets all kept samples.
    pub(super) fn forget_kept(&mut self) {
        if let Some(waiting) = &mut self.waiting {
            waiting.last.clear();
        }
    }

    /// What was handed on as this sensor's and topic's last sample, of so many bytes, was not taken.
    pub(super) fn not_taken(&mut self, number: u8, topic: Option<Topic>, bytes: usize) {
        if let Some(row) = self.row(number, topic.map_or(Announce::NUMBER, Topic::number)) {
            row.sent -= 1;
            row.bytes -= bytes as u64;
            row.failed += 1;
        }
    }

    /// Whether a sample waits.
    pub(super) fn is_waiting(&self) -> bool {
        self.waiting.as_ref().is_some_and(|waiting| !waiting.slots.is_empty())
    }

    /// Whether announcements go out.
    pub(super) fn announces(&self) -> bool {
        !self.form.is_bare()
    }

    pub(super) fn longest(&self) -> usize {
        self.longest
    }

    pub(super) fn unfit(&self) -> u64 {
        self.unfit
    }

    /// Sensor number `number` is called `name`.
    pub(super) fn claim(&mut self, number: u8, name: &str) {
        let at = usize::from(number);
        if self.sensors.len() <= at {
            self.sensors.resize_with(at + 1, Rows::default);
        }
        if self.sensors[at].name == name {
            return;
        }
        name.clone_into(&mut self.sensors[at].name);
        if let Some(Waiting { slots, last }) = &mut self.waiting {
            last.retain(|(head, _)| head.sensor != number);
            for topic in slots.drop_sensor(number) {
                self.sensors[at].rows[usize::from(topic)].replaced += 1;
            }
        }
    }

    /// Whether `name` was the last to claim `number`: a hub that is started anew may number its sensors otherwise.
    pub(super) fn is_claimed(&self, number: u8, name: &str) -> bool {
        self.sensors.get(usize::from(number)).is_some_and(|rows| rows.name == name)
    }

    /// The number of the next sample of this sensor and topic.
    pub(super) fn next(&self, number: u8, topic: Topic) -> u32 {
        let rows = self.sensors.get(usize::from(number));
        rows.map_or(0, |rows| rows.rows[usize::from(topic.number())].next())
    }

    /// The hub sent so many samples that did not come here.
    pub(super) fn miss(&mut self, number: u8, topic: Topic, missed: u64) {
        if let Some(row) = self.row(number, topic.number()) {
            row.missed += missed;
        }
    }

    /// The account, by the sensors' numbers.
    pub(super) fn sensors(&self) -> impl Iterator<Item = &Rows> {
        self.sensors.iter()
    }

    /// Sends what `pack` writes, under the next number of this sensor and topic; `head` lacks hub, epoch and sequence. A
    /// failure uses the number up. Where samples wait, nothing is sent and no number used.
    pub(super) fn send(
        &mut self,
        head: Head,
        to: &mut impl Transmit,
        pack: impl FnOnce(&mut [u8]) -> Option<usize>,
    ) {
        let (hub, epoch) = (self.hub, self.epoch);
        if let Some(Waiting { slots, .. }) = &mut self.waiting {
            let payload = pack(&mut self.buffer[HEAD..]);
            let is_replaced = payload.is_some_and(|len| slots.put(head, &self.buffer[HEAD..HEAD + len]));
            self.unfit += u64::from(payload.is_none());
            if let Some(row) = self.row(head.sensor, head.topic) {
                row.replaced += u64::from(is_replaced);
            }
            return;
        }
        let Some(row) = self.row(head.sensor, head.topic) else { return };
        let head = Head { hub, epoch, sequence: row.next(), ..head };
        let end = self.buffer.len() + HEAD - self.form.around();
        let payload = pack(&mut self.buffer[HEAD..end]);
        let group = Topic::of_number(head.topic).map_or(Announce::GROUP, group);
        let taken = payload.and_then(|len| match self.form {
            Form::Sealed | Form::Authenticated(_) => self.send_sealed(head, len, group, to),
            Form::Bare => to.transmit(&self.buffer[HEAD..HEAD + len], group, head.sensor).then_some(len),
        });
        if let Some(row) = self.row(head.sensor, head.topic) {
            match taken {
                Some(len) => {
                    row.sent += 1;
                    row.bytes += len as u64;
                }
                None => row.failed += 1,
            }
            if payload.is_none() && row.fit == Fit::All {
                row.fit = Fit::NotAll;
            }
        }
        self.unfit += u64::from(payload.is_none());
    }

    /// Sends the payload of `len` bytes that lies in the buffer, in as few parts as possible; the bytes of all datagrams if all
    /// were taken. The header of each part but the first is written over the end of the part before it, which is sent; a MAC
    /// over the begin of the part after it, which is put back.
    fn send_sealed(&mut self, head: Head, len: usize, group: u8, to: &mut impl Transmit) -> Option<usize> {
        let room = self.longest - self.form.around();
        let parts = len.div_ceil(room).max(1);
        let mut bytes = Some(0);
        for part in 0..parts {
            let begin = part * room;
            let head = Head { part: part as u8, parts: parts as u8, ..head };
            let (buffer, len) = (&mut self.buffer[begin..], room.min(len - begin));
            let mut behind = [0; MAC];
            let datagram = match &self.form {
                Form::Authenticated(key) => {
                    behind.copy_from_slice(buffer.get(HEAD + len..HEAD + len + MAC)?);
                    head.seal_with(buffer, len, |covered| key.mac(covered))?
                }
                _ => head.seal(buffer, len)?,
            };
            // Whoever else it goes to may get all of it, although one did not get this part.
            let is_taken = to.transmit(datagram, group, 0);
            bytes = bytes.filter(|_| is_taken).map(|bytes| bytes + datagram.len());
            if matches!(self.form, Form::Authenticated(_)) {
                buffer[HEAD + len..][..MAC].copy_from_slice(&behind);
            }
        }
        bytes
    }

    /// `SENSOR/TOPIC` of which something did not fit into a datagram; each is told once.
    pub(super) fn misfit(&mut self) -> Option<String> {
        self.sensors.iter_mut().find_map(|Rows { name, rows }| {
            let (number, row) = rows.iter_mut().enumerate().find(|(_, row)| row.fit == Fit::NotAll)?;
            row.fit = Fit::Told;
            let topic = Topic::of_number(number as u8).map_or("announce", Topic::name);
            Some(format!("{name}/{topic}"))
        })
    }

    fn row(&mut self, number: u8, topic: u8) -> Option<&mut Row> {
        self.sensors.get_mut(usize::from(number))?.rows.get_mut(usize::from(topic))
    }
}

/// The stamp of a sample with this `head` that is sent `now`: announcements and statuses say when they are sent, however long
/// they waited; by them clocks are compared.
fn stamp_ns(head: &Head, now: Stamp) -> u64 {
    match Topic::of_number(head.topic) {
        None | Some(Topic::Status) => now.wall_ns,
        Some(_) => head.stamp_ns,
    }
}

/// Whether the last sample of this topic is given to who asks: what it says holds until the next one.
fn is_kept(topic: Topic) -> bool {
    matches!(topic, Topic::Status | Topic::Background)
}

/// A header, and the longest payload of which it can say the length.
const WHOLE_LONGEST: usize = HEAD + u16::MAX as usize;

/// Announcements, and the topics by their numbers.
const KINDS: usize = 1 + Topic::ALL.len();
