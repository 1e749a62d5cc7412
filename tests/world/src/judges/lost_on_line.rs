//! What a scanner sent and the hub did not get is counted: of a scanner whose packets follow each other without a number, as
//! many as are missing between two packets that came, as exactly as their times and angles can tell.

use std::collections::VecDeque;
use std::rc::Rc;

use lms::{MILLIS, Nanos};
use schema::{Counter, State, Status, Topic};
use sim::ld::TruePoint;

use super::{Judge, Say};
use crate::event::{Event, Figures};
use crate::family::Family;

/// What is missing of each scanner whose head turns.
pub(crate) struct LostOnLine {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    family: Rc<dyn Family>,
    /// What was sent and not published yet, one after the other; nothing where the power went off or the scanner was exchanged.
    sent: VecDeque<Vec<u8>>,
    /// The last one that was published.
    last: Vec<u8>,
    /// What the last status counted, if all was known since, and what should have come to that.
    counted: Option<u64>,
    missing: u64,
    lenience: u64,
    /// Something came between that nobody can count: another session, a packet that nobody sent.
    is_broken: bool,
    measured_at: Nanos,
    /// What statuses counted in all, and the last one of this hub.
    told: u64,
    told_before: u64,
}

impl LostOnLine {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> LostOnLine {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            sent: VecDeque::new(),
            last: Vec::new(),
            counted: None,
            missing: 0,
            lenience: 0,
            is_broken: true,
            measured_at: 0,
            told: 0,
            told_before: 0,
        };
        LostOnLine { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Judge for LostOnLine {
    fn name(&self) -> &'static str {
        "lost_on_line"
    }

    fn figures(&self) -> Figures {
        Figures { lost: self.sensors.iter().map(|of| of.told).sum(), ..Figures::default() }
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Measured { sensor, points } => self.sensors[sensor].measure(points),
            Event::Sent { sensor, telegram } if !telegram.is_reply => {
                self.sensors[sensor].send(telegram.bytes);
            }
            Event::Exchanged { sensor } => self.sensors[sensor].send(&[]),
            Event::Opened { sensor, .. } | Event::Retuned { sensor } | Event::Lacking { sensor, .. } => {
                self.sensors[sensor].is_broken = true
            }
            Event::HubBegins { .. } => {
                self.sensors.iter_mut().for_each(|of| (of.is_broken, of.told_before) = (true, 0));
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
                        of.told += status.counters[Counter::LostOnLine].saturating_sub(of.told_before);
                        of.told_before = status.counters[Counter::LostOnLine];
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

impl OfSensor {
    /// After its power was off nobody knows how many there were.
    fn measure(&mut self, points: &[TruePoint]) {
        let Some(last) = points.last() else { return };
        if last.at_ns > self.measured_at + POWER_OFF {
            self.send(&[]);
        }
        self.measured_at = last.at_ns;
    }

    fn send(&mut self, unit: &[u8]) {
        // What a line doubles was sent once.
        let before = self.sent.back().map_or(&self.last[..], Vec::as_slice);
        if self.family.turns() && before != unit {
            self.sent.push_back(unit.to_vec());
        }
        if self.sent.len() > MOST {
            self.sent.pop_front();
            self.is_broken = true;
        }
    }

    fn publish(&mut self, unit: &[u8]) {
        if unit == self.last {
            return;
        }
        let Some(missing) = self.sent.iter().position(|sent| sent == unit) else {
            self.is_broken = true;
            return;
        };
        self.is_broken |= self.sent.drain(..=missing).any(|sent| sent.is_empty());
        self.last.clear();
        self.last.extend_from_slice(unit);
        let missing = missing as u64;
        if missing > LONGEST_GAP {
            self.is_broken = true;
        }
        self.missing += missing;
        // How many fit between two packets is rounded, and a head may change its speed between them.
        let exactness = self.family.exactness(unit);
        let unmarked = if exactness.neighbours > 0 { UNMARKED + missing / 10 } else { 1 };
        self.lenience += match missing {
            0 => 0,
            _ if !exactness.has_clock && missing > SURE => missing,
            _ => unmarked + missing / 20,
        };
    }

    /// What is wrong with what `status` counts.
    fn check(&mut self, status: &Status) -> Result<(), String> {
        let counted = status.counters[Counter::LostOnLine];
        let is_whole = !self.is_broken && status.state() == Some(State::Streaming);
        let before = self.counted.replace(counted).filter(|_| is_whole);
        let (missing, lenience) = (std::mem::take(&mut self.missing), std::mem::take(&mut self.lenience));
        self.is_broken = status.state() != Some(State::Streaming);
        match before.map(|before| counted.saturating_sub(before)) {
            Some(told) if told.abs_diff(missing) > lenience => {
                Err(format!("{missing} packets are missing, {told} are told"))
            }
            _ => Ok(()),
        }
    }
}

/// Without a clock in packets more may be a turn more or less, or begin another sequence.
const SURE: u64 = 8;
/// Where nothing tells what is missing but how many there were in a turn.
const UNMARKED: u64 = 30;
/// So many are remembered: of the fastest scanner for as long as a tty keeps.
const MOST: usize = 20_000;
/// After more the scanner's clock may be another one: 1.5 s of the slowest.
const LONGEST_GAP: u64 = 400;
/// Nobody switches a power off and on sooner.
const POWER_OFF: Nanos = 50 * MILLIS;
