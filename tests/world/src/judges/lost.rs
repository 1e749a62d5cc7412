//! Judges of losses: bytes, telegrams, and packets that the line loses.

use std::collections::VecDeque;
use std::rc::Rc;

use scanhub_schema::{Counter, MILLIS, Nanos, State, Status, Topic};
use scanhub_sim::ld::TruePoint;

use super::{Judge, Say};
use crate::event::{Event, Figures, Telegram};
use crate::family::Family;

/// Judge: no byte disappears. The bytes that a status reports as read are those that the port returned to the running hub, and
/// each of them is in a telegram, in an acknowledgement, discarded, or still in the buffer.
pub(crate) struct Bytes(Vec<u64>);

impl Bytes {
    pub(crate) fn new(sensors: usize) -> Bytes {
        Bytes(vec![0; sensors])
    }
}

impl Judge for Bytes {
    fn name(&self) -> &'static str {
        "bytes"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match event {
            Event::HubBegins { .. } => self.0.fill(0),
            Event::Read { sensor, len, .. } => self.0[*sensor] += *len as u64,
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = |counter| status.counters[counter];
                let read = of(Counter::BytesRead);
                let parts = [
                    Counter::BytesInTelegrams,
                    Counter::BytesAcknowledge,
                    Counter::BytesDiscarded,
                    Counter::BytesBuffered,
                ];
                let known: u64 = parts.into_iter().map(of).sum();
                let handed = self.0[*sensor];
                if (read, known) != (handed, handed) {
                    say.broken(format!("sensor {sensor}: {handed} handed out, {read} read, {known} known"));
                }
            }
            _ => {}
        }
    }
}

/// Judge: a running hub loses no intact telegram. A telegram is due if the port returned all its bytes as they were
/// sent, while the hub reported that it streams. The hub publishes it once and in order, unless there was no memory
/// for it.
pub(crate) struct NothingLost {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    family: Rc<dyn Family>,
    sent: VecDeque<Sent>,
    /// Place of the first byte that the session on the line can know.
    valid_from: u64,
    /// Place behind the last byte that the hub had read when it began to say that it streams, if it still says so.
    streams_from: Option<u64>,
    read: u64,
    /// Sensors that were there before this one, and whether the hub has heard a scan of this one: one whose scans are others
    /// is met only after a silence.
    exchanged: u32,
    is_other: bool,
    /// Until when something of the sensor before this one may still be on the line.
    mixed_until: Nanos,
    /// Telegrams for which there was no memory.
    holes: usize,
    /// Place behind the last telegram, and how many of the next ones may be lost with damaged bytes before them.
    end: u64,
    spared: usize,
    /// What was published last, if nobody sent it.
    foreign: Vec<u8>,
    /// From when until when the hub does not run.
    stalled: (Nanos, Nanos),
}

struct Sent {
    bytes: Vec<u8>,
    span: (u64, u64),
    /// Of which sensor.
    exchanged: u32,
    is_whole: bool,
    /// All of its bytes arrived as they were sent.
    is_intact: bool,
    is_read: bool,
    /// When the hub had all of it, if it has to be published.
    due_at: Option<Nanos>,
}

impl NothingLost {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> NothingLost {
        NothingLost { sensors: sensors.iter().cloned().map(OfSensor::new).collect() }
    }
}

impl Judge for NothingLost {
    fn name(&self) -> &'static str {
        "nothing_lost"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Sent { sensor, telegram } => self.sensors[sensor].send(telegram),
            Event::Flushed { sensor, from, .. } => self.sensors[sensor].flush(from),
            Event::Opened { sensor, offset } => {
                let of = &mut self.sensors[sensor];
                (of.valid_from, of.read, of.streams_from) = (offset, offset, None);
            }
            Event::Retuned { sensor } => {
                let of = &mut self.sensors[sensor];
                of.valid_from = of.read;
            }
            Event::Exchanged { sensor } => {
                let of = &mut self.sensors[sensor];
                (of.streams_from, of.is_other) = (None, true);
                of.exchanged += 1;
                of.mixed_until = at + HELD_BACK;
                of.break_off(at);
            }
            Event::Closed { sensor } => self.sensors[sensor].break_off(at),
            Event::HubEnds { .. } => self.sensors.iter_mut().for_each(|of| of.break_off(at)),
            Event::Stalled { until } => {
                self.sensors.iter_mut().for_each(|of| {
                    let from = if of.stalled.1 < at { at } else { of.stalled.0 };
                    of.stalled = (from, until);
                });
            }
            Event::Read { sensor, to, .. } => self.sensors[sensor].read(at, to),
            Event::Lacking { sensor, topic: Topic::Telegram } => {
                let of = &mut self.sensors[sensor];
                of.holes += of.family.most_units();
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                for unit in of.family.clone().units(&sample.bytes) {
                    if sample.header.reasons == 0 && of.is_beside_damage(unit) {
                        say.broken(format!("sensor {sensor}: beside damage, and not marked"));
                    }
                    if let Some(lost) = of.publish(at, unit) {
                        say.broken(format!("sensor {sensor}: {lost}"));
                    }
                }
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = &mut self.sensors[sensor];
                if status.state() != Some(State::Streaming) {
                    of.streams_from = None;
                    of.break_off(at);
                } else if of.streams_from.is_none() && !of.is_other {
                    of.streams_from = Some(of.read);
                }
            }
            Event::Over { .. } => {
                for (sensor, of) in self.sensors.iter().enumerate() {
                    let is_lost = |sent: &&Sent| sent.due_at.is_some_and(|due| due + HELD < at);
                    let lost = of.sent.iter().filter(is_lost).count();
                    if lost > of.holes {
                        say.broken(format!("sensor {sensor}: {lost} lost at the end"));
                    }
                }
            }
            _ => {}
        }
    }
}

impl OfSensor {
    fn new(family: Rc<dyn Family>) -> OfSensor {
        OfSensor {
            family,
            sent: VecDeque::new(),
            valid_from: 0,
            streams_from: None,
            read: 0,
            exchanged: 0,
            is_other: false,
            mixed_until: 0,
            holes: 0,
            end: 0,
            spared: 0,
            foreign: Vec::new(),
            stalled: (0, 0),
        }
    }

    fn send(&mut self, telegram: &Telegram<'_>) {
        let Telegram { bytes, span, damage, aborted, .. } = *telegram;
        let is_intact = damage.is_none() && !aborted;
        let near = self.family.exactness(bytes).neighbours;
        // What is asked of one whose head turns is asked again until it answers.
        let is_promised = !self.family.turns() || self.family.is_data(bytes);
        let is_plain = span.1 - span.0 == bytes.len() as u64 && span.0 <= self.end;
        self.end = span.1;
        if !is_intact || !is_plain || !is_promised {
            self.spared = near + 1;
            self.sent.iter_mut().rev().take(near).for_each(|sent| {
                (sent.is_whole, sent.due_at) = (false, None);
            });
        }
        self.spared = self.spared.saturating_sub(1);
        let is_whole = is_intact && is_promised && (self.spared == 0 || near == 0);
        let (bytes, exchanged) = (bytes.to_vec(), self.exchanged);
        self.sent.push_back(Sent {
            bytes,
            span,
            exchanged,
            is_whole,
            is_intact,
            is_read: false,
            due_at: None,
        });
        while self.sent.len() > MOST * self.family.most_units() && self.sent[0].due_at.is_none() {
            self.sent.pop_front();
        }
    }

    fn flush(&mut self, from: u64) {
        for sent in self.sent.iter_mut().rev().take_while(|sent| sent.span.1 > from) {
            sent.is_whole = false;
        }
    }

    fn read(&mut self, at: Nanos, to: u64) {
        self.read = to;
        for sent in self.sent.iter_mut().rev().take_while(|sent| !sent.is_read) {
            if sent.span.1 <= to {
                sent.is_read = true;
                let is_known = |from: u64| sent.span.0 >= from;
                let is_due = sent.is_whole && is_known(self.valid_from);
                sent.due_at = (is_due && self.streams_from.is_some_and(is_known)).then_some(at);
            }
        }
    }

    /// The stream ends: what came just before may still have been held back, to see what follows.
    fn break_off(&mut self, at: Nanos) {
        let at = if self.stalled.1 >= at { self.stalled.0 } else { at };
        for sent in self.sent.iter_mut().filter(|sent| sent.due_at.is_some_and(|due| due + HELD > at)) {
            sent.due_at = None;
        }
        // Where only what follows tells that it is one, nothing follows the last one.
        if let Some(last) = self.sent.iter_mut().rfind(|sent| sent.is_read)
            && self.family.exactness(&last.bytes).neighbours > 0
        {
            last.due_at = None;
        }
    }

    /// Whether damaged bytes came before `unit`, which has a checksum and is published now: then it has to be marked.
    fn is_beside_damage(&self, unit: &[u8]) -> bool {
        let exactness = self.family.exactness(unit);
        if !self.foreign.is_empty()
            || exactness.has_clock
            || exactness.neighbours > 0
            || !self.family.is_data(unit)
        {
            return false;
        }
        let Some(found) = self.sent.iter().position(|sent| sent.is_read && sent.bytes == unit) else {
            return false;
        };
        let before = found.checked_sub(1).and_then(|before| self.sent.get(before));
        let is_known = |from: u64| self.streams_from.is_some_and(|streams_from| streams_from <= from);
        before.is_some_and(|before| {
            !before.is_intact && before.span.1 > before.span.0 && is_known(before.span.0)
        })
    }

    /// A telegram is published. What was lost before it.
    fn publish(&mut self, at: Nanos, bytes: &[u8]) -> Option<String> {
        let is_it = |sent: &Sent| sent.is_read && sent.bytes == bytes;
        // Replies are often the same, and single points sometimes: of those that are, the one that has to come, or a whole one.
        let due = self.sent.iter().position(|sent| sent.due_at.is_some() && is_it(sent));
        let whole = due.or_else(|| self.sent.iter().position(|sent| sent.is_whole && is_it(sent)));
        let first = self.sent.iter().position(is_it);
        // The first of two alike, if the other would mean that something between them is lost; what is lost shows later.
        let is_due = |sent: &Sent| sent.due_at.is_some();
        let skips = whole.is_some_and(|whole| self.sent.range(first.unwrap_or(0)..whole).any(is_due));
        let found = if skips { first } else { whole.or(first) };
        let foreign = std::mem::take(&mut self.foreign);
        let Some(found) = found else {
            self.foreign = bytes.to_vec();
            return None;
        };
        let is_of_this = self.family.is_data(bytes) && self.sent[found].exchanged == self.exchanged;
        self.is_other &= !is_of_this || at < self.mixed_until;
        // One that lost its first byte is whole again with the last one of the one before it, if that is the same: either is.
        let is_lent = !self.sent[found].is_whole;
        let passed = self.sent.drain(..=found).take(found);
        let mut lost: Vec<Sent> = passed.filter(|sent| sent.due_at.is_some()).collect();
        // A checksum of one byte is right by chance in 1 of 256: what damage made of two packets has a part of the intact one.
        if let Some(torn) = lost.iter().position(|sent| overlaps(&foreign, &sent.bytes)) {
            lost.remove(torn);
        }
        if is_lent && lost.last().is_some_and(|sent| sent.bytes.last() == bytes.first()) {
            lost.pop();
        }
        let (count, holes) = (lost.len(), self.holes);
        self.holes = holes.saturating_sub(count);
        (count > holes).then(|| {
            let Sent { bytes, span, .. } = &lost[0];
            format!("{count} lost, first at {span:?}: {:02X?}", &bytes[..bytes.len().min(8)])
        })
    }
}

/// Whether one of both ends, by a header at least, with what the other begins with.
fn overlaps(foreign: &[u8], sent: &[u8]) -> bool {
    let is_end = |len: usize| foreign.ends_with(&sent[..len]) || sent.ends_with(&foreign[..len]);
    (HEADER..foreign.len().min(sent.len())).any(is_end)
}

/// Bytes by which what has a checksum is known to begin.
const HEADER: usize = 2;
/// A telegram is held back no longer than so.
const HELD: Nanos = 100 * MILLIS;
/// A line holds bytes back for no longer than so (action `silence`).
const HELD_BACK: Nanos = 4_000 * MILLIS;
/// So many samples that were never due are remembered.
const MOST: usize = 64;

/// Judge: the hub counts packets that a scanner sent and the hub did not receive. Packets without a number follow each other;
/// the hub counts as many as are missing between two packets that arrived, as exactly as their times and angles permit.
pub(crate) struct LostOnLine {
    sensors: Vec<HeadOfSensor>,
}

struct HeadOfSensor {
    family: Rc<dyn Family>,
    /// Packets that were sent and not published yet, in order. An empty one marks a power cycle or an exchange.
    sent: VecDeque<Vec<u8>>,
    /// The last one that was published.
    last: Vec<u8>,
    /// Count in the last status of this hub. The other fields apply since the last agreement: reported packets,
    /// missing packets, and their allowed difference.
    counted: Option<u64>,
    told: u64,
    missing: u64,
    lenience: u64,
    /// Sum of reported and missing packets at the last status.
    seen: u64,
    /// Whether both disagreed then. After a stall of the hub, and for points without a checksum, the hub detects the
    /// number of missing packets later.
    is_open: bool,
    /// Number of the next statuses that are not checked, after something that cannot be counted: another session, or a
    /// packet that was not sent.
    unsure: u8,
    /// Packets were not published for lack of memory.
    is_lacking: bool,
    measured_at: Nanos,
    /// Total count of all statuses.
    told_in_all: u64,
}

impl LostOnLine {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> LostOnLine {
        let sensor = |family: &Rc<dyn Family>| HeadOfSensor {
            family: family.clone(),
            sent: VecDeque::new(),
            last: Vec::new(),
            counted: None,
            told: 0,
            missing: 0,
            lenience: 0,
            seen: 0,
            is_open: false,
            unsure: UNSURE,
            is_lacking: false,
            measured_at: 0,
            told_in_all: 0,
        };
        LostOnLine { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Judge for LostOnLine {
    fn name(&self) -> &'static str {
        "lost_on_line"
    }

    fn figures(&self) -> Figures {
        Figures { lost: self.sensors.iter().map(|of| of.told_in_all).sum(), ..Figures::default() }
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Measured { sensor, points } => self.sensors[sensor].measure(points),
            Event::Sent { sensor, telegram } if !telegram.is_reply => {
                self.sensors[sensor].send(telegram.bytes);
            }
            Event::Exchanged { sensor } => self.sensors[sensor].send(&[]),
            Event::Opened { sensor, .. } | Event::Retuned { sensor } => self.sensors[sensor].unsure = UNSURE,
            Event::Lacking { sensor, topic: Topic::Telegram } => self.sensors[sensor].is_lacking = true,
            Event::HubBegins { .. } => {
                self.sensors.iter_mut().for_each(|of| (of.unsure, of.counted) = (UNSURE, None));
            }
            Event::Published { sensor, sample } if self.sensors[sensor].family.turns() => {
                let of = &mut self.sensors[sensor];
                match sample.topic {
                    Topic::Telegram => {
                        let family = of.family.clone();
                        let units = family.units(&sample.bytes).into_iter();
                        units.filter(|unit| family.is_data(unit)).for_each(|unit| of.publish(unit));
                    }
                    Topic::Status => {
                        let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                        if let Err(words) = of.check(&status) {
                            say.broken(format!("sensor {sensor}: {words}"));
                        }
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }
}

impl HeadOfSensor {
    /// Takes measured points. After a power cycle, the number of missing packets is unknown.
    fn measure(&mut self, points: &[TruePoint]) {
        let Some(last) = points.last() else { return };
        if last.at_ns > self.measured_at + POWER_OFF {
            self.send(&[]);
        }
        self.measured_at = last.at_ns;
    }

    fn send(&mut self, unit: &[u8]) {
        // A packet that the line duplicates was sent once.
        let before = self.sent.back().map_or(&self.last[..], Vec::as_slice);
        if self.family.turns() && before != unit {
            self.sent.push_back(unit.to_vec());
        }
        if self.sent.len() > MOST_SENT {
            self.sent.pop_front();
            self.unsure = UNSURE;
        }
    }

    fn publish(&mut self, unit: &[u8]) {
        if unit == self.last {
            return;
        }
        let Some(missing) = self.sent.iter().position(|sent| sent == unit) else {
            self.unsure = UNSURE;
            return;
        };
        let is_other = self.sent.drain(..=missing).any(|sent| sent.is_empty());
        self.last.clear();
        self.last.extend_from_slice(unit);
        let missing = missing as u64;
        if std::mem::take(&mut self.is_lacking) || is_other || missing > LONGEST_GAP {
            self.unsure = UNSURE;
        }
        self.missing += missing;
        // How many fit between two packets is rounded, and a head may change its speed between them.
        let exactness = self.family.exactness(unit);
        let unmarked = if exactness.neighbours > 0 { UNMARKED + missing / 10 } else { 1 };
        self.lenience += if missing > 0 { unmarked + missing / 20 } else { 0 };
    }

    /// Returns the error of the count in `status`.
    fn check(&mut self, status: &Status) -> Result<(), String> {
        let counted = status.counters[Counter::LostOnLine];
        let told = counted.saturating_sub(self.counted.replace(counted).unwrap_or(0));
        self.told_in_all += told;
        self.told += told;
        if status.state() != Some(State::Streaming) {
            self.unsure = UNSURE + 1;
        }
        let is_sure = self.unsure == 0;
        self.unsure = self.unsure.saturating_sub(1);
        let (told, missing) = (self.told, self.missing);
        let is_still = std::mem::replace(&mut self.seen, told + missing) == told + missing;
        let agree = told.abs_diff(missing) <= self.lenience;
        let was_open = std::mem::replace(&mut self.is_open, is_sure && !agree);
        if is_sure && (agree && !is_still || !agree && !was_open) {
            return Ok(());
        }
        (self.told, self.missing, self.lenience, self.seen, self.is_open) = (0, 0, 0, 0, false);
        if is_sure && !agree {
            return Err(format!("{missing} packets are missing, {told} are told"));
        }
        Ok(())
    }
}

/// The status after something that cannot be counted, and the next one, which may contain losses that the hub detected
/// later.
const UNSURE: u8 = 2;
/// Allowed difference if only the number of points per revolution shows a loss.
const UNMARKED: u64 = 30;
/// Number of packets that are kept: as many as a tty buffers of the fastest scanner.
const MOST_SENT: usize = 20_000;
/// Longest countable gap, in packets: 1.5 s of the slowest scanner. The scanner's clock may have changed in a longer
/// one.
const LONGEST_GAP: u64 = 400;
/// Minimum duration of a power cycle.
const POWER_OFF: Nanos = 50 * MILLIS;
