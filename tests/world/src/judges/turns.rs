//! A turn of a head is what the head measured in one turn, no more and, unless it is marked, no less: each point of a scan
//! is where a point was measured, at the time that the scan says, and all of one turn. Scans of a topic's life have as many
//! beams.
//!
//! A stamp can only be right once the hub has heard a packet without delay: before that, nobody can tell a line that is
//! late from a scanner that is.

use std::collections::{HashSet, VecDeque};
use std::rc::Rc;

use lms::{MILLIS, Nanos};
use schema::datagram::Packed;
use schema::{Code, Scan, State, Status, Topic};
use sim::ld::TruePoint;

use super::{Judge, Say};
use crate::event::{Event, Figures, Telegram};
use crate::family::Family;
use crate::hash::History;
use crate::topics::Sample;

/// What each sensor whose head turns measured.
pub(crate) struct Turns {
    sensors: Vec<OfSensor>,
    figures: Figures,
}

struct OfSensor {
    family: Rc<dyn Family>,
    /// All that was measured lately, in the order of time.
    points: VecDeque<Point>,
    /// Hashes of what was sent lately, and in their order.
    sent: HashSet<u64>,
    order: VecDeque<u64>,
    /// When something was published last that was not sent, or was not published for lack of memory, so that nobody saw
    /// whether it was sent; and the number of the last telegram that was.
    foreign_at: Option<Nanos>,
    seen: Option<u64>,
    /// Of the scans of this life of the topic.
    beams: Option<(u64, usize)>,
    /// Place behind the last packet that came without delay, and when it did.
    prompt: Option<(u64, Nanos)>,
    /// How many were read without delay since the session began, and when the last one of the first few was.
    prompts: u32,
    settled_at: Option<Nanos>,
    /// Place behind the last packet that was sent, and when bytes came that took no time on the line: what was read with them
    /// looks earlier than it was.
    end: u64,
    crowded_at: Option<Nanos>,
}

/// A point that was measured.
#[derive(Clone, Copy, PartialEq)]
struct Point {
    truth: TruePoint,
    /// Degrees since the first one, turns and all.
    turned_deg: f64,
}

impl Turns {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Turns {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            points: VecDeque::new(),
            sent: HashSet::new(),
            order: VecDeque::new(),
            foreign_at: None,
            seen: None,
            beams: None,
            prompt: None,
            prompts: 0,
            settled_at: None,
            end: 0,
            crowded_at: None,
        };
        Turns { sensors: sensors.iter().map(sensor).collect(), figures: Figures::default() }
    }
}

impl Judge for Turns {
    fn figures(&self) -> Figures {
        self.figures
    }

    fn name(&self) -> &'static str {
        "turns"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Measured { sensor, points } => self.sensors[sensor].measure(points),
            Event::Sent { sensor, telegram } => self.sensors[sensor].send(at, telegram),
            Event::Read { sensor, to, .. } => {
                let of = &mut self.sensors[sensor];
                let is_prompt = of.prompt.is_some_and(|(place, came)| place <= to && at < came + PROMPT);
                of.prompts += u32::from(is_prompt);
                if is_prompt && of.prompts >= FEW {
                    of.settled_at.get_or_insert(at);
                }
            }
            Event::Opened { sensor, .. } | Event::Retuned { sensor } | Event::Exchanged { sensor } => {
                self.sensors[sensor].begin();
            }
            Event::HubBegins { .. } => self.sensors.iter_mut().for_each(OfSensor::begin),
            Event::Published { sensor, sample } if self.sensors[sensor].family.turns() => {
                match self.sensors[sensor].publish(at, sample) {
                    Ok(figures) => self.figures.add(&figures),
                    Err(words) => say.broken(format!("sensor {sensor}: {words}")),
                }
            }
            _ => {}
        }
    }
}

impl Figures {
    fn of(scan: &Scan, told: &[Told], points: &[Option<&Point>]) -> Figures {
        let pairs = || told.iter().zip(points).filter_map(|(told, point)| Some((told, (*point)?)));
        let worst = |off: &dyn Fn((&Told, &Point)) -> f64| pairs().map(off).fold(0.0, f64::max);
        let range_mm = |(told, point): (&Told, &Point)| {
            told.range_mm
                .zip(point.truth.range_mm)
                .map_or(0.0, |(told, exact)| (f64::from(told) - exact).abs())
        };
        Figures {
            scans: 1,
            incomplete: scan.is_incomplete().into(),
            points: pairs().count() as u64,
            angle_deg: worst(&|(told, point)| point.off_deg(told.clockwise_deg)),
            range_mm: worst(&range_mm),
            stamp_ns: 0,
        }
    }
}

impl OfSensor {
    /// What the session knew of the scanner's clock is void.
    fn begin(&mut self) {
        (self.prompts, self.settled_at) = (0, None);
    }

    fn measure(&mut self, points: &[TruePoint]) {
        for &truth in points {
            let turned_deg = match self.points.back() {
                Some(last) => {
                    let step_deg = (truth.clockwise_deg - last.truth.clockwise_deg).rem_euclid(360.0);
                    // After its power was off it is another turn, whatever the angle.
                    let is_new = truth.at_ns > last.truth.at_ns + POWER_OFF;
                    last.turned_deg + step_deg + if is_new { 720.0 } else { 0.0 }
                }
                None => truth.clockwise_deg,
            };
            if self.points.back().is_some_and(|last| truth.at_ns > last.truth.at_ns + POWER_OFF) {
                self.begin();
            }
            self.points.push_back(Point { truth, turned_deg });
        }
        let newest = self.points.back().map_or(0, |last| last.truth.at_ns);
        while self.points.front().is_some_and(|first| first.truth.at_ns + REMEMBERED < newest) {
            self.points.pop_front();
        }
    }

    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let Some(last_deg) = self.family.last_deg(telegram.bytes) else { return };
        let key = key(telegram.bytes);
        let (begin, end) = (std::mem::replace(&mut self.end, telegram.span.1), telegram.span.1);
        let is_new = self.sent.insert(key);
        if is_new {
            self.order.push_back(key);
        }
        if !is_new || end - begin > telegram.bytes.len() as u64 {
            self.crowded_at = Some(at);
        }
        if self.order.len() > MOST
            && let Some(oldest) = self.order.pop_front()
        {
            self.sent.remove(&oldest);
        }
        let late = self.points.iter().rev().take_while(|point| point.truth.at_ns + PROMPT > at);
        if telegram.damage.is_none() && late.into_iter().any(|point| point.is_at(last_deg)) {
            self.prompt = Some((telegram.span.1, at));
        }
    }

    /// What is wrong with what is published, if it is a scan.
    fn publish(&mut self, at: Nanos, sample: &Sample) -> Result<Figures, String> {
        match sample.topic {
            Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                if status.state() != Some(State::Streaming) {
                    self.begin();
                }
                Ok(Figures::default())
            }
            Topic::Telegram => {
                let seq = sample.header.seq;
                let is_gap = self.seen.replace(seq).is_some_and(|seen| seq > seen + 1);
                let units = self.family.units(&sample.bytes);
                if is_gap || units.into_iter().any(|unit| !self.sent.contains(&key(unit))) {
                    self.foreign_at = Some(at);
                }
                Ok(Figures::default())
            }
            Topic::Scan => {
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    return Err("what is no scan".to_owned());
                }
                let (boot, beams) = (sample.header.boot, scan.beams());
                let before = self.beams.replace((boot, beams)).filter(|(of, _)| *of == boot);
                if let Some((_, before)) = before.filter(|(_, before)| *before != beams) {
                    return Err(format!("{beams} beams after {before}"));
                }
                if self.seen.is_some_and(|seen| sample.header.seq > seen) {
                    self.foreign_at = Some(at);
                }
                self.check(at, sample.header.stamp_first_ns, &scan)
            }
            _ => Ok(Figures::default()),
        }
    }

    /// What is wrong with `scan`, which says that its first beam was measured at `stamp`.
    fn check(&self, at: Nanos, stamp: Nanos, scan: &Scan) -> Result<Figures, String> {
        let is_foreign = self.foreign_at.is_some_and(|foreign_at| at < foreign_at + FOREIGN);
        let told = told(stamp, scan);
        let Some(begin) = told.first().map(|first| first.at_ns) else {
            return Ok(Figures::default());
        };
        let lenience = |told: &Told| NEAR + told.at_ns.max(begin).saturating_sub(stamp) / 10;
        let found = |shift: i64| -> Vec<Option<&Point>> {
            told.iter().map(|told| self.find(told, shift, lenience(told))).collect()
        };
        let is_crowded = self.crowded_at.is_some_and(|crowded_at| at < crowded_at + CROWDED);
        let is_settled = self.settled_at.is_some_and(|settled_at| settled_at + SETTLED < at) && !is_crowded;
        let (mut points, mut shift) = (found(0), 0);
        if points.contains(&None) {
            shift = self.shift(&told);
            points = found(shift);
            let count = points.iter().flatten().count();
            if is_settled && 2 * count > told.len() && shift.unsigned_abs() > NEAR {
                return Err(format!("the stamp is off by {} us", shift / 1_000));
            }
        }
        if is_foreign {
            return Ok(Figures::default());
        }
        if let Some(beam) = points.iter().position(Option::is_none) {
            let told = &told[beam];
            let is_it = |point: &&Point| point.is(told);
            let off = |point: &Point| point.truth.at_ns as i64 - told.at_ns as i64;
            let nearest = self.points.iter().filter(is_it).map(off).min_by_key(|off| off.abs());
            let when = nearest.map_or("never".to_owned(), |off| format!("{} us later", off / 1_000));
            let (missing, of) = (points.iter().filter(|point| point.is_none()).count(), points.len());
            let (stamp_us, shift) = (stamp / 1_000, shift / 1_000);
            return Err(format!(
                "{missing} of {of} points not found, stamp {stamp_us} us, {shift} us off, first {told:?} was measured {when}"
            ));
        }
        let edge_deg = 180.0 / scan.beams() as f64;
        let turned = |point: &&Point| point.turned_deg + edge_deg;
        let turn = points[points.len() / 2].as_ref().map_or(0.0, |point| (turned(point) / 360.0).floor());
        let (first_deg, end_deg) = (360.0 * turn, 360.0 * (turn + 1.0));
        let is_outside = |point: &&Point| {
            let turned = turned(point);
            turned < first_deg - ANGLE_DEG || turned > end_deg + ANGLE_DEG
        };
        if let Some(point) = points.iter().flatten().copied().find(is_outside) {
            let (deg, us) = (point.truth.clockwise_deg, (point.truth.at_ns as i64 - stamp as i64) / 1_000);
            return Err(format!("a point of another turn, at {deg} degrees, {us} us after the stamp"));
        }
        let of_turn = |deg: f64| self.points.partition_point(|point| point.turned_deg + edge_deg < deg);
        let (measured, there) =
            (of_turn(end_deg) - of_turn(first_deg), told.len() + usize::from(scan.collapsed));
        // One at the very edge may be of either turn.
        if !scan.is_incomplete() && measured.abs_diff(there) > 2 {
            return Err(format!("{there} of {measured} points, and it is not marked"));
        }
        let mut figures = Figures::of(scan, &told, &points);
        if let Some(point) = points[0].filter(|_| is_settled && !scan.is_incomplete()) {
            figures.stamp_ns = point.truth.at_ns.abs_diff(told[0].at_ns);
        }
        Ok(figures)
    }

    /// The point that `told` is, if it was measured `shift` after what is told, or less than `lenience` beside.
    fn find(&self, told: &Told, shift: i64, lenience: Nanos) -> Option<&Point> {
        let at_ns = told.at_ns.saturating_add_signed(shift);
        let begin = self.points.partition_point(|point| point.truth.at_ns + lenience < at_ns);
        let near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + lenience);
        near.into_iter().find(|point| point.is(told))
    }

    /// By how much most points were measured later than is told. From turn to turn a head is nearly where it was before: of the
    /// turns that fit, the one that fits best.
    fn shift(&self, told: &[Told]) -> i64 {
        let Some(first) = told.iter().find(|told| told.range_mm.is_some()) else { return 0 };
        let fit = |told: &mut dyn Iterator<Item = &Told>, shift: i64| {
            told.filter(|told| self.find(told, shift, NEAR).is_some()).count()
        };
        let some = told.len().div_ceil(16);
        let candidates = self.points.iter().filter(|point| point.is(first));
        let shifts = candidates.map(|point| point.truth.at_ns as i64 - first.at_ns as i64);
        let mut shifts: Vec<_> =
            shifts.map(|shift| (fit(&mut told.iter().step_by(some), shift), shift)).collect();
        let most = shifts.iter().map(|(count, _)| *count).max().unwrap_or(0);
        shifts.retain(|(count, _)| count + 1 >= most);
        let best = shifts.iter().max_by_key(|(_, shift)| (fit(&mut told.iter(), *shift), -shift.abs()));
        best.map_or(0, |(_, shift)| *shift)
    }
}

/// What a scan tells of a point.
#[derive(Debug)]
struct Told {
    at_ns: Nanos,
    clockwise_deg: f64,
    range_mm: Option<u16>,
}

/// The beams of `scan` that were measured.
fn told(stamp: Nanos, scan: &Scan) -> Vec<Told> {
    let beams = (0..scan.beams()).filter(|&i| scan.code(i) != Some(Code::NotMeasured));
    let told = |i: usize| Told {
        at_ns: stamp.saturating_add_signed(scan.beam_ns(i)),
        clockwise_deg: (-scan.angle(i).to_degrees()).rem_euclid(360.0),
        range_mm: scan.range(i),
    };
    beams.map(told).collect()
}

impl Point {
    /// Whether it is what is told: a scanner may see nothing where there is something.
    fn is(&self, told: &Told) -> bool {
        let is_there = match (told.range_mm, self.truth.range_mm) {
            (Some(told), Some(exact)) => (f64::from(told) - exact).abs() < RANGE_MM,
            (Some(_), None) => false,
            (None, _) => true,
        };
        is_there && self.is_at(told.clockwise_deg)
    }

    fn is_at(&self, clockwise_deg: f64) -> bool {
        self.off_deg(clockwise_deg) < ANGLE_DEG
    }

    fn off_deg(&self, clockwise_deg: f64) -> f64 {
        ((self.truth.clockwise_deg - clockwise_deg + 180.0).rem_euclid(360.0) - 180.0).abs()
    }
}

fn key(bytes: &[u8]) -> u64 {
    let mut history = History::new();
    history.bytes(bytes);
    history.value()
}

/// An exact angle is off by no more, and a range by no more: nobody measures with noise here.
const ANGLE_DEG: f64 = 0.05;
const RANGE_MM: f64 = 2.0;
/// A stamp is off by no more; a later point by a tenth of the time since it more, while the head changes its speed.
const NEAR: Nanos = 5 * MILLIS;
/// A packet is on its way, or in the port, for no longer.
const PROMPT: Nanos = 15 * MILLIS;
/// A clock is tied by so many packets without delay.
const FEW: u32 = 10;
/// Whoever knows that is right from so much later on.
const SETTLED: Nanos = 10 * MILLIS;
/// The least delays of so many seconds count.
const CROWDED: Nanos = 9_000 * MILLIS;
/// For so long after a packet that nobody sent turns may have points of it.
const FOREIGN: Nanos = 2_000 * MILLIS;
/// Nobody switches a power off and on sooner.
const POWER_OFF: Nanos = 50 * MILLIS;
/// What was measured is remembered for so long, and so many packets are.
const REMEMBERED: Nanos = 12_000 * MILLIS;
const MOST: usize = 32_768;
