//! Invariants on losses of bytes, telegrams and packets.

use std::collections::VecDeque;
use std::rc::Rc;

use scanhub_schema::{Counter, MILLIS, Nanos, State, Status, Topic};
use scanhub_sim::ld::TruePoint;

use super::{Invariant, ViolationReporter};
use crate::event::{Event, RevolutionFigures, Telegram};
use crate::family::Family;

/// Invariant: no byte disappears. A status reports exactly the number of bytes that the running hub has read from the
/// port. The status also assigns each of these bytes: to a telegram, to an acknowledgement, to the discarded bytes, or
/// to the bytes still in the buffer.
pub(crate) struct ByteCounters(Vec<u64>);

impl ByteCounters {
    pub(crate) fn new(sensors: usize) -> ByteCounters {
        ByteCounters(vec![0; sensors])
    }
}

impl Invariant for ByteCounters {
    fn name(&self) -> &'static str {
        "bytes"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match event {
            Event::HubStarted { .. } => self.0.fill(0),
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
                    reporter.report(format!(
                        "sensor {sensor}: {handed} returned by the port, {read} read, {known} in the counters"
                    ));
                }
            }
            _ => {}
        }
    }
}

/// Invariant: a running hub loses no intact telegram. A telegram is due if the hub read all its bytes as the scanner
/// sent them, while the hub reported that the scanner streams. The hub publishes each due telegram once and in order,
/// unless there was no memory for it.
pub(crate) struct NothingLost {
    sensors: Vec<SensorTelegrams>,
}

struct SensorTelegrams {
    family: Rc<dyn Family>,
    sent: VecDeque<SentTelegram>,
    /// Position of the first byte that the current session can have received.
    valid_from: u64,
    /// Position after the last byte that the hub had read when it reported that the scanner streams, or `None` if the
    /// hub does not report this.
    streams_from: Option<u64>,
    read_end: u64,
    /// Number of earlier scanners on this line, and whether the hub has not yet received a scan from the current
    /// scanner. If the scans of a new scanner have a different form, the session accepts them only after a silence.
    exchanged: u32,
    is_other: bool,
    /// Time until which bytes of the previous scanner may still be on the line.
    mixed_until: Nanos,
    /// Number of telegrams for which there was no memory.
    lacked_memory: usize,
    /// Position after the last telegram; and how many of the next telegrams may be lost together with the damaged bytes
    /// before them.
    sent_end: u64,
    allowed_losses: usize,
    /// The last published unit, if no scanner sent it.
    foreign: Vec<u8>,
    /// Start and end of the last stall of the hub.
    stall: (Nanos, Nanos),
}

struct SentTelegram {
    bytes: Vec<u8>,
    span: (u64, u64),
    /// Number of exchanges before the scanner that sent the telegram was connected.
    exchanged: u32,
    is_whole: bool,
    /// Whether all bytes of the telegram arrived as they were sent.
    is_intact: bool,
    is_read: bool,
    /// Time at which the hub had read the whole telegram, or `None` if the hub need not publish it.
    due_at: Option<Nanos>,
}

impl NothingLost {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> NothingLost {
        NothingLost { sensors: sensors.iter().cloned().map(SensorTelegrams::new).collect() }
    }
}

impl Invariant for NothingLost {
    fn name(&self) -> &'static str {
        "nothing_lost"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Sent { sensor, telegram } => self.sensors[sensor].send(telegram),
            Event::Flushed { sensor, from, .. } => self.sensors[sensor].flush(from),
            Event::PortOpened { sensor, offset } => {
                let of = &mut self.sensors[sensor];
                (of.valid_from, of.read_end, of.streams_from) = (offset, offset, None);
            }
            Event::RateChanged { sensor } => {
                let of = &mut self.sensors[sensor];
                of.valid_from = of.read_end;
            }
            Event::ScannerExchanged { sensor } => {
                let of = &mut self.sensors[sensor];
                (of.streams_from, of.is_other) = (None, true);
                of.exchanged += 1;
                of.mixed_until = at + MAX_LINE_DELAY;
                of.end_stream(at);
            }
            Event::PortClosed { sensor } => self.sensors[sensor].end_stream(at),
            Event::HubEnded { .. } => self.sensors.iter_mut().for_each(|of| of.end_stream(at)),
            Event::Stalled { until } => {
                self.sensors.iter_mut().for_each(|of| {
                    let from = if of.stall.1 < at { at } else { of.stall.0 };
                    of.stall = (from, until);
                });
            }
            Event::Read { sensor, to, .. } => self.sensors[sensor].read(at, to),
            Event::OutOfMemory { sensor, topic: Topic::Telegram } => {
                let of = &mut self.sensors[sensor];
                of.lacked_memory += of.family.max_telegrams();
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                for unit in of.family.clone().telegrams(&sample.bytes) {
                    if sample.header.reasons == 0 && of.is_after_damage(unit) {
                        reporter.report(format!("sensor {sensor}: next to damaged bytes, and not marked"));
                    }
                    if let Some(lost) = of.publish(at, unit) {
                        reporter.report(format!("sensor {sensor}: {lost}"));
                    }
                }
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = &mut self.sensors[sensor];
                if status.state() != Some(State::Streaming) {
                    of.streams_from = None;
                    of.end_stream(at);
                } else if of.streams_from.is_none() && !of.is_other {
                    of.streams_from = Some(of.read_end);
                }
            }
            Event::WorldEnded { .. } => {
                for (sensor, of) in self.sensors.iter().enumerate() {
                    let is_lost =
                        |sent: &&SentTelegram| sent.due_at.is_some_and(|due| due + MAX_HOLD_TIME < at);
                    let lost = of.sent.iter().filter(is_lost).count();
                    if lost > of.lacked_memory {
                        reporter.report(format!("sensor {sensor}: {lost} lost at the end"));
                    }
                }
            }
            _ => {}
        }
    }
}

impl SensorTelegrams {
    fn new(family: Rc<dyn Family>) -> SensorTelegrams {
        SensorTelegrams {
            family,
            sent: VecDeque::new(),
            valid_from: 0,
            streams_from: None,
            read_end: 0,
            exchanged: 0,
            is_other: false,
            mixed_until: 0,
            lacked_memory: 0,
            sent_end: 0,
            allowed_losses: 0,
            foreign: Vec::new(),
            stall: (0, 0),
        }
    }

    fn send(&mut self, telegram: &Telegram<'_>) {
        let Telegram { bytes, span, damage, aborted, .. } = *telegram;
        let is_intact = damage.is_none() && !aborted;
        let near = self.family.point_accuracy(bytes).neighbors;
        // The session of a rotating scanner repeats a request until a reply arrives, so a lost reply is not an error.
        let is_promised = !self.family.is_rotating() || self.family.is_data(bytes);
        let is_plain = span.1 - span.0 == bytes.len() as u64 && span.0 <= self.sent_end;
        self.sent_end = span.1;
        if !is_intact || !is_plain || !is_promised {
            self.allowed_losses = near + 1;
            self.sent.iter_mut().rev().take(near).for_each(|sent| {
                (sent.is_whole, sent.due_at) = (false, None);
            });
        }
        self.allowed_losses = self.allowed_losses.saturating_sub(1);
        let is_whole = is_intact && is_promised && (self.allowed_losses == 0 || near == 0);
        let (bytes, exchanged) = (bytes.to_vec(), self.exchanged);
        self.sent.push_back(SentTelegram {
            bytes,
            span,
            exchanged,
            is_whole,
            is_intact,
            is_read: false,
            due_at: None,
        });
        while self.sent.len() > MAX_REMEMBERED * self.family.max_telegrams() && self.sent[0].due_at.is_none()
        {
            self.sent.pop_front();
        }
    }

    fn flush(&mut self, from: u64) {
        for sent in self.sent.iter_mut().rev().take_while(|sent| sent.span.1 > from) {
            sent.is_whole = false;
        }
    }

    fn read(&mut self, at: Nanos, to: u64) {
        self.read_end = to;
        for sent in self.sent.iter_mut().rev().take_while(|sent| !sent.is_read) {
            if sent.span.1 <= to {
                sent.is_read = true;
                let is_known = |from: u64| sent.span.0 >= from;
                let is_due = sent.is_whole && is_known(self.valid_from);
                sent.due_at = (is_due && self.streams_from.is_some_and(is_known)).then_some(at);
            }
        }
    }

    /// Ends the stream. The last telegrams are no longer due, because the session may have held them back to wait for
    /// the bytes after them.
    fn end_stream(&mut self, at: Nanos) {
        let at = if self.stall.1 >= at { self.stall.0 } else { at };
        for sent in
            self.sent.iter_mut().filter(|sent| sent.due_at.is_some_and(|due| due + MAX_HOLD_TIME > at))
        {
            sent.due_at = None;
        }
        // If the session confirms a packet only by the next packet, it never confirms the last one.
        if let Some(last) = self.sent.iter_mut().rfind(|sent| sent.is_read)
            && self.family.point_accuracy(&last.bytes).neighbors > 0
        {
            last.due_at = None;
        }
    }

    /// Returns whether damaged bytes arrived before `unit`, which has a checksum and is published now. If damaged bytes
    /// arrived, the hub must mark `unit`.
    fn is_after_damage(&self, unit: &[u8]) -> bool {
        let exactness = self.family.point_accuracy(unit);
        if !self.foreign.is_empty()
            || exactness.has_clock
            || exactness.neighbors > 0
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

    /// Handles the publication of a telegram. Returns a description of the telegrams that were lost before it.
    fn publish(&mut self, at: Nanos, bytes: &[u8]) -> Option<String> {
        let is_it = |sent: &SentTelegram| sent.is_read && sent.bytes == bytes;
        // Replies are often identical, and standard packets are sometimes identical. Among identical units, a due unit
        // is the first choice, and an intact unit the second.
        let due = self.sent.iter().position(|sent| sent.due_at.is_some() && is_it(sent));
        let whole = due.or_else(|| self.sent.iter().position(|sent| sent.is_whole && is_it(sent)));
        let first = self.sent.iter().position(is_it);
        // If a due unit lies between the first identical unit and the chosen one, choose the first one instead, because
        // otherwise the unit between them would be reported as lost. A later check detects a real loss.
        let is_due = |sent: &SentTelegram| sent.due_at.is_some();
        let skips = whole.is_some_and(|whole| self.sent.range(first.unwrap_or(0)..whole).any(is_due));
        let found = if skips { first } else { whole.or(first) };
        let foreign = std::mem::take(&mut self.foreign);
        let Some(found) = found else {
            self.foreign = bytes.to_vec();
            return None;
        };
        let is_of_this = self.family.is_data(bytes) && self.sent[found].exchanged == self.exchanged;
        self.is_other &= !is_of_this || at < self.mixed_until;
        // A unit may have lost its first byte. If the previous unit ends with a byte of the same value, this byte can
        // replace the lost one. Then the previous unit is the one that lost a byte, and it is not due.
        let is_lent = !self.sent[found].is_whole;
        let passed = self.sent.drain(..=found).take(found);
        let mut lost: Vec<SentTelegram> = passed.filter(|sent| sent.due_at.is_some()).collect();
        // A checksum of one byte is valid by chance in 1 of 256 cases. If damage combines two packets into one
        // published unit, the unit contains a part of an intact packet. This packet does not count as lost.
        if let Some(torn) = lost.iter().position(|sent| overlaps(&foreign, &sent.bytes)) {
            lost.remove(torn);
        }
        if is_lent && lost.last().is_some_and(|sent| sent.bytes.last() == bytes.first()) {
            lost.pop();
        }
        let (count, holes) = (lost.len(), self.lacked_memory);
        self.lacked_memory = holes.saturating_sub(count);
        (count > holes).then(|| {
            let SentTelegram { bytes, span, .. } = &lost[0];
            format!("{count} lost, first at {span:?}: {:02X?}", &bytes[..bytes.len().min(8)])
        })
    }
}

/// Returns whether one unit ends with the bytes with which the other unit starts. The common part must be at least as
/// long as a header.
fn overlaps(foreign: &[u8], sent: &[u8]) -> bool {
    let is_end = |len: usize| foreign.ends_with(&sent[..len]) || sent.ends_with(&foreign[..len]);
    (MIN_HEADER_LEN..foreign.len().min(sent.len())).any(is_end)
}

/// Number of bytes in the header of a packet with a checksum.
const MIN_HEADER_LEN: usize = 2;
/// Maximum time for which a session holds back a telegram.
const MAX_HOLD_TIME: Nanos = 100 * MILLIS;
/// Maximum time for which a line holds back bytes (action `silence`).
const MAX_LINE_DELAY: Nanos = 4_000 * MILLIS;
/// Number of samples whose telegrams are stored although they were never due.
const MAX_REMEMBERED: usize = 64;

/// Invariant: the hub counts the packets that a scanner sent but the hub did not receive. Packets have no sequence
/// number, so the hub derives the number of missing packets from the times and angles of the packets before and after a
/// gap. The count must be as exact as these times and angles permit.
pub(crate) struct LostOnLine {
    sensors: Vec<PacketCounters>,
}

struct PacketCounters {
    family: Rc<dyn Family>,
    /// Packets that were sent and not published yet, in order. An empty packet marks a power cycle or an exchange.
    sent: VecDeque<Vec<u8>>,
    /// The last published packet.
    last: Vec<u8>,
    /// Count in the last status of this hub. The next three fields cover the time since the counts last agreed: number
    /// of lost packets that the hub reported, number of packets that are missing, and allowed difference between these
    /// two numbers.
    counted: Option<u64>,
    reported: u64,
    missing: u64,
    allowed_difference: u64,
    /// Sum of reported and missing packets at the last status.
    total_at_last_status: u64,
    /// Whether the counts disagreed at the last status. A single disagreement is allowed, because after a stall, and
    /// for points without a checksum, the hub determines the number of missing packets later.
    disagreed: bool,
    /// Number of the next statuses that are not checked. It is set after an event whose losses cannot be counted: a new
    /// session, or a packet that no scanner sent.
    unchecked_statuses: u8,
    /// Whether a lack of memory prevented the publication of packets.
    lacked_memory: bool,
    measured_at: Nanos,
    /// Sum of the counts that all statuses report.
    reported_total: u64,
}

impl LostOnLine {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> LostOnLine {
        let sensor = |family: &Rc<dyn Family>| PacketCounters {
            family: family.clone(),
            sent: VecDeque::new(),
            last: Vec::new(),
            counted: None,
            reported: 0,
            missing: 0,
            allowed_difference: 0,
            total_at_last_status: 0,
            disagreed: false,
            unchecked_statuses: UNCHECKED_STATUSES,
            lacked_memory: false,
            measured_at: 0,
            reported_total: 0,
        };
        LostOnLine { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Invariant for LostOnLine {
    fn name(&self) -> &'static str {
        "lost_on_line"
    }

    fn figures(&self) -> RevolutionFigures {
        RevolutionFigures {
            lost: self.sensors.iter().map(|of| of.reported_total).sum(),
            ..RevolutionFigures::default()
        }
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Measured { sensor, points } => self.sensors[sensor].measure(points),
            Event::Sent { sensor, telegram } if !telegram.is_reply => {
                self.sensors[sensor].send(telegram.bytes);
            }
            Event::ScannerExchanged { sensor } => self.sensors[sensor].send(&[]),
            Event::PortOpened { sensor, .. } | Event::RateChanged { sensor } => {
                self.sensors[sensor].unchecked_statuses = UNCHECKED_STATUSES
            }
            Event::OutOfMemory { sensor, topic: Topic::Telegram } => {
                self.sensors[sensor].lacked_memory = true
            }
            Event::HubStarted { .. } => {
                self.sensors
                    .iter_mut()
                    .for_each(|of| (of.unchecked_statuses, of.counted) = (UNCHECKED_STATUSES, None));
            }
            Event::Published { sensor, sample } if self.sensors[sensor].family.is_rotating() => {
                let of = &mut self.sensors[sensor];
                match sample.topic {
                    Topic::Telegram => {
                        let family = of.family.clone();
                        let units = family.telegrams(&sample.bytes).into_iter();
                        units.filter(|unit| family.is_data(unit)).for_each(|unit| of.publish(unit));
                    }
                    Topic::Status => {
                        let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                        if let Err(words) = of.check(&status) {
                            reporter.report(format!("sensor {sensor}: {words}"));
                        }
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }
}

impl PacketCounters {
    /// Handles measured points. After a power cycle, the number of missing packets is unknown.
    fn measure(&mut self, points: &[TruePoint]) {
        let Some(last) = points.last() else { return };
        if last.at_ns > self.measured_at + MIN_POWER_OFF {
            self.send(&[]);
        }
        self.measured_at = last.at_ns;
    }

    fn send(&mut self, unit: &[u8]) {
        // If the line duplicated a packet, the scanner sent it only once.
        let before = self.sent.back().map_or(&self.last[..], Vec::as_slice);
        if self.family.is_rotating() && before != unit {
            self.sent.push_back(unit.to_vec());
        }
        if self.sent.len() > MAX_SENT {
            self.sent.pop_front();
            self.unchecked_statuses = UNCHECKED_STATUSES;
        }
    }

    fn publish(&mut self, unit: &[u8]) {
        if unit == self.last {
            return;
        }
        let Some(missing) = self.sent.iter().position(|sent| sent == unit) else {
            self.unchecked_statuses = UNCHECKED_STATUSES;
            return;
        };
        let is_other = self.sent.drain(..=missing).any(|sent| sent.is_empty());
        self.last.clear();
        self.last.extend_from_slice(unit);
        let missing = missing as u64;
        if std::mem::take(&mut self.lacked_memory) || is_other || missing > MAX_GAP_PACKETS {
            self.unchecked_statuses = UNCHECKED_STATUSES;
        }
        self.missing += missing;
        // The hub rounds the number of packets that fit into a gap. In addition, the speed of the head may change
        // during the gap.
        let exactness = self.family.point_accuracy(unit);
        let unmarked = if exactness.neighbors > 0 { MAX_UNMARKED_DIFFERENCE + missing / 10 } else { 1 };
        self.allowed_difference += if missing > 0 { unmarked + missing / 20 } else { 0 };
    }

    /// Checks the count of lost packets in `status`.
    ///
    /// # Errors
    ///
    /// Returns a description of the error.
    fn check(&mut self, status: &Status) -> Result<(), String> {
        let counted = status.counters[Counter::LostOnLine];
        let reported = counted.saturating_sub(self.counted.replace(counted).unwrap_or(0));
        self.reported_total += reported;
        self.reported += reported;
        if status.state() != Some(State::Streaming) {
            self.unchecked_statuses = UNCHECKED_STATUSES + 1;
        }
        let is_sure = self.unchecked_statuses == 0;
        self.unchecked_statuses = self.unchecked_statuses.saturating_sub(1);
        let (reported, missing) = (self.reported, self.missing);
        let is_still =
            std::mem::replace(&mut self.total_at_last_status, reported + missing) == reported + missing;
        let agree = reported.abs_diff(missing) <= self.allowed_difference;
        let was_open = std::mem::replace(&mut self.disagreed, is_sure && !agree);
        if is_sure && (agree && !is_still || !agree && !was_open) {
            return Ok(());
        }
        (self.reported, self.missing, self.allowed_difference, self.total_at_last_status, self.disagreed) =
            (0, 0, 0, 0, false);
        if is_sure && !agree {
            return Err(format!("{missing} packets are missing, {reported} are counted"));
        }
        Ok(())
    }
}

/// Number of statuses that are not checked after an event whose losses cannot be counted. They are the next status and
/// the following one, which may contain losses that the hub detected later.
const UNCHECKED_STATUSES: u8 = 2;
/// Maximum difference of the counts, in packets, if the hub detects a loss only by the number of points per revolution.
const MAX_UNMARKED_DIFFERENCE: u64 = 30;
/// Maximum number of stored packets. The fastest scanner fills a tty with fewer packets.
const MAX_SENT: usize = 20_000;
/// Maximum length of a gap that the hub can count, in packets: 1.5 s of the slowest scanner. During a longer gap,
/// another scanner with another clock may have been connected.
const MAX_GAP_PACKETS: u64 = 400;
/// Minimum duration of a power cycle.
const MIN_POWER_OFF: Nanos = 50 * MILLIS;
