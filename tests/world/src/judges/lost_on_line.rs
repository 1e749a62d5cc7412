//! What a scanner sent and the hub did not get is counted: of a scanner whose packets follow each other without a number, as
//! many as are missing between two packets that came, as exactly as their times and angles can tell.

use std::collections::VecDeque;
use std::rc::Rc;

use scanhub_schema::{Counter, MILLIS, Nanos, State, Status, Topic};
use scanhub_sim::ld::TruePoint;

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
    /// What the last status of this hub counted, and since nothing was missing for a while: what was told, what is missing, and
    /// how much may lie between.
    counted: Option<u64>,
    told: u64,
    missing: u64,
    lenience: u64,
    /// What was told and missing when the last status came.
    seen: u64,
    /// Both did not agree then: of what waited while the hub did not run, and of points without a checksum,
    /// it is seen afterwards only how much was missing.
    is_open: bool,
    /// Something came between that nobody can count: another session, a packet that nobody sent. So many statuses say nothing.
    unsure: u8,
    /// Packets were not published for lack of memory.
    is_lacking: bool,
    measured_at: Nanos,
    /// What statuses counted in all.
    told_in_all: u64,
}

impl LostOnLine {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> LostOnLine {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
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

    /// What is wrong with what `status` counts.
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

/// The status behind what nobody can count, and the one behind that: it may tell what was seen afterwards.
const UNSURE: u8 = 2;
/// Where nothing tells what is missing but how many there were in a turn.
const UNMARKED: u64 = 30;
/// So many are remembered: of the fastest scanner for as long as a tty keeps.
const MOST: usize = 20_000;
/// After more the scanner's clock may be another one: 1.5 s of the slowest.
const LONGEST_GAP: u64 = 400;
/// Nobody switches a power off and on sooner.
const POWER_OFF: Nanos = 50 * MILLIS;
