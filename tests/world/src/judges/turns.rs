//! A turn of a head is what the head measured in one turn, no more and, unless it is marked, no less: each point of a scan
//! is where a point was measured, at the time that the scan says, and all of one turn. Scans of a topic's life have as many
//! beams.
//!
//! A stamp can only be right once the hub has heard a packet without delay: before that, nobody can tell a line that is
//! late from a scanner that is.

use std::cell::Cell;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::datagram::Packed;
use scanhub_schema::{Code, Header, MICROS, MILLIS, Nanos, Scan, State, Status, Topic};
use scanhub_sim::ld::TruePoint;

use super::{Judge, Say};
use crate::event::{Event, Figures, Telegram};
use crate::family::{Begin, Exactness, Family};
use crate::hash::History;
use crate::topics::Sample;

/// What each sensor whose head turns measured.
pub(crate) struct Turns {
    sensors: Vec<OfSensor>,
    /// Until when the hub does not run, or did not lately.
    stalled_until: Nanos,
    figures: Figures,
}

struct OfSensor {
    family: Rc<dyn Family>,
    /// All that was measured lately, in the order of time.
    points: VecDeque<Point>,
    /// Hashes of what was sent lately, and in their order.
    sent: HashMap<u64, u32>,
    order: VecDeque<u64>,
    /// How many of these were forgotten, and how many came before the one that is published next.
    forgotten: usize,
    passed: usize,
    /// How exactly the packets tell that were published last.
    exactness: Exactness,
    /// When something was published last that was not sent, or was not published for lack of memory, so that nobody saw
    /// whether it was sent; and the number of the last telegram that was.
    foreign_at: Option<Nanos>,
    seen: Option<u64>,
    /// Run of the hub, number of beams, and time of the first scan with this number since the port was opened.
    beams: Option<(u64, usize, Nanos)>,
    /// Place behind the last packet that came without delay, and when it did.
    prompt: Option<(u64, Nanos)>,
    /// How many were read without delay since the session began, and when the last one of the first few was.
    prompts: u32,
    settled_at: Option<Nanos>,
    prompt_at: Option<Nanos>,
    /// Place behind the last packet that was sent, and when bytes came that took no time on the line: what was read with them
    /// looks earlier than it was.
    end: u64,
    crowded_at: Option<Nanos>,
    /// When a packet was on the line last that arrived as it was sent.
    arrived_at: Nanos,
    /// By how much the stamp of the last scan was off that is judged.
    off: Cell<Option<i64>>,
}

impl Turns {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Turns {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            points: VecDeque::new(),
            sent: HashMap::new(),
            order: VecDeque::new(),
            forgotten: 0,
            passed: 0,
            exactness: Exactness::default(),
            foreign_at: None,
            seen: None,
            beams: None,
            prompt: None,
            prompts: 0,
            settled_at: None,
            prompt_at: None,
            end: 0,
            crowded_at: None,
            arrived_at: 0,
            off: Cell::default(),
        };
        Turns { sensors: sensors.iter().map(sensor).collect(), stalled_until: 0, figures: Figures::default() }
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
                if is_prompt {
                    of.be_prompt(at);
                }
            }
            Event::Retuned { sensor } => self.sensors[sensor].begin(),
            Event::Opened { sensor, .. } => {
                self.sensors[sensor].begin();
                self.sensors[sensor].beams = None;
            }
            Event::Exchanged { sensor } => {
                self.sensors[sensor].begin();
                self.sensors[sensor].beams = None;
            }
            Event::HubBegins { .. } => {
                self.stalled_until = 0;
                self.sensors.iter_mut().for_each(OfSensor::begin);
            }
            Event::Stalled { until } => self.stalled_until = until,
            Event::Healed => self.stalled_until = self.stalled_until.min(at),
            Event::Published { sensor, sample } if self.sensors[sensor].family.turns() => {
                let waited = at < self.stalled_until + CATCHES_UP;
                match self.sensors[sensor].publish(at, sample, waited) {
                    Ok(figures) => self.figures.add(&figures),
                    Err(words) => say.broken(format!("sensor {sensor}: {words}")),
                }
            }
            _ => {}
        }
    }
}

impl OfSensor {
    /// What the session knew of the scanner's clock is void.
    fn begin(&mut self) {
        (self.prompts, self.settled_at, self.off) = (0, None, Cell::default());
    }

    /// A packet was read without delay at `at`.
    fn be_prompt(&mut self, at: Nanos) {
        let before = self.prompt_at.replace(at).unwrap_or(0);
        if !self.exactness.has_clock && before + LONG_GAP < at {
            self.begin();
        }
        self.prompt = None;
        self.prompts += 1;
        if self.prompts >= FEW {
            self.settled_at.get_or_insert(at);
        }
    }

    fn measure(&mut self, points: &[TruePoint]) {
        for &truth in points {
            let turned_deg = match self.points.back() {
                Some(last) => {
                    // After its power was off it is another turn, whatever the angle; and points may come out of order.
                    let is_new = truth.at_ns > last.truth.at_ns + POWER_OFF;
                    let step_deg = (truth.clockwise_deg - last.truth.clockwise_deg).rem_euclid(360.0);
                    let is_back = step_deg > 360.0 - BACK_DEG && !is_new;
                    let turns_deg = if is_new { 720.0 } else { 0.0 } - if is_back { 360.0 } else { 0.0 };
                    last.turned_deg + step_deg + turns_deg
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

    /// When the last point was measured of a packet that was through at `at`.
    fn last_of(&self, at: Nanos, packet: &Begin, exactness: Exactness) -> Option<Nanos> {
        let (of, most) = (self.points.len(), at.saturating_sub(LONGEST + packet.on_line));
        let lately = (0..of).rev().skip(packet.points - 1);
        let mut lately = lately.take_while(|&first| self.points[first].truth.at_ns > most);
        let first =
            lately.find(|&first| self.points[first].off_deg(packet.clockwise_deg) < exactness.angle_deg)?;
        Some(self.points[first + packet.points - 1].truth.at_ns)
    }

    /// What is wrong with what is published, if it is a scan; it may be of packets that `waited` for a hub that stood still.
    fn publish(&mut self, at: Nanos, sample: &Sample, waited: bool) -> Result<Figures, String> {
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
                let family = self.family.clone();
                let units = family.units(&sample.bytes);
                let mut is_foreign = is_gap;
                for unit in units.into_iter().filter(|unit| family.is_data(unit)) {
                    self.exactness = family.exactness(unit);
                    is_foreign |= !self.was_sent(unit);
                }
                if is_foreign {
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
                let before = self.beams.filter(|(of, ..)| *of == boot);
                match before {
                    Some((_, before, _)) if before == beams => {}
                    // While the port stays open, only after a scanner's points per revolution were others for so long.
                    Some((_, before, since)) if at < since + OTHER_BEAMS => {
                        return Err(format!("{beams} beams after {before}"));
                    }
                    _ => self.beams = Some((boot, beams, at)),
                }
                if self.seen.is_some_and(|seen| sample.header.seq > seen) {
                    self.foreign_at = Some(at);
                }
                self.check(at, &sample.header, &scan, waited)
            }
            _ => Ok(Figures::default()),
        }
    }

    /// What is wrong with `scan`, whose `header` says when its first beam was measured.
    fn check(&self, at: Nanos, header: &Header, scan: &Scan, waited: bool) -> Result<Figures, String> {
        let stamp = header.stamp_first_ns;
        let is_marked = scan.is_incomplete() || header.reasons != 0;
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
        let settles = if self.exactness.has_clock { SETTLED } else { LEARNED };
        // A hub that stands still learns nothing meanwhile.
        let learned_at = if self.exactness.has_clock { Some(at) } else { self.prompt_at };
        let is_learned =
            |settled_at: Nanos| learned_at.is_some_and(|learned_at| settled_at + settles < learned_at);
        let is_settled = self.settled_at.is_some_and(is_learned) && !is_crowded;
        let (mut points, mut shift) = (found(0), 0);
        // Of packets without a clock that waited it is seen later how many whole turns are missing in a gap between them.
        let is_open = waited && scan.is_incomplete() && !self.exactness.has_clock;
        if let Some(gap) = points.iter().position(Option::is_none).filter(|gap| is_open && *gap > 0)
            && self.is_of_later_turn(&told[gap..], Nanos::from(header.period_us) * MICROS, lenience)
        {
            return Ok(Figures { scans: 1, incomplete: 1, ..Figures::default() });
        }
        if points.contains(&None) {
            shift = self.shift(&told);
            points = found(shift);
            let count = points.iter().flatten().count();
            if is_settled && 2 * count > told.len() && shift.unsigned_abs() > NEAR {
                return Err(format!("the stamp is off by {} us", shift / 1_000));
            }
        }
        let wrong = if is_marked || !points.contains(&None) { 0 } else { self.wrong(&told, shift) };
        if is_foreign {
            let scans = Figures { scans: 1, incomplete: scan.is_incomplete().into(), ..Figures::default() };
            return Ok(Figures { wrong, ..scans });
        }
        if let Some(beam) = points.iter().position(Option::is_none) {
            let told = &told[beam];
            let is_it = |point: &&Point| point.is(told, &self.exactness);
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
            let off_deg = self.exactness.angle_deg.max(self.exactness.nothing_deg);
            turned < first_deg - off_deg || turned > end_deg + off_deg
        };
        if let Some(point) = points.iter().flatten().copied().find(is_outside) {
            let (deg, us) = (point.truth.clockwise_deg, (point.truth.at_ns as i64 - stamp as i64) / 1_000);
            return Err(format!("a point of another turn, at {deg} degrees, {us} us after the stamp"));
        }
        let begin = self.points.partition_point(|point| turned(&point) < first_deg - BACK_DEG);
        let around = self.points.range(begin..).map(|point| turned(&point));
        let around = around.take_while(|turned| *turned < end_deg + BACK_DEG);
        let measured = around.filter(|turned| (first_deg..end_deg).contains(turned)).count();
        let there = told.len() + usize::from(scan.collisions);
        // Those at the very edge may be of either turn.
        if !scan.is_incomplete() && measured.abs_diff(there) > self.exactness.points {
            return Err(format!("{there} of {measured} points, and it is not marked"));
        }
        let mut figures = Figures { wrong, ..Figures::of(scan, &told, &points) };
        if let Some(point) = points[0].filter(|_| is_settled && !scan.is_incomplete()) {
            let off = point.truth.at_ns as i64 - told[0].at_ns as i64;
            figures.stamp_ns = off.unsigned_abs();
            figures.uneven_ns = self.off.replace(Some(off)).map_or(0, |before| before.abs_diff(off));
        }
        Ok(figures)
    }

    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let (begin, end) = (std::mem::replace(&mut self.end, telegram.span.1), telegram.span.1);
        if telegram.is_reply {
            return;
        }
        if telegram.damage.is_none() {
            // The line lost all packets between. Without a clock in the packets, the next ones have no time yet.
            if !self.exactness.has_clock && self.arrived_at + LONG_GAP < at {
                self.begin();
            }
            self.arrived_at = at;
        }
        let key = History::of(telegram.bytes);
        let is_double = self.order.back() == Some(&key);
        *self.sent.entry(key).or_default() += 1;
        self.order.push_back(key);
        if is_double || end - begin > telegram.bytes.len() as u64 {
            self.crowded_at = Some(at);
        }
        self.forgotten += usize::from(self.order.len() > MOST);
        if self.order.len() > MOST
            && let Some(Entry::Occupied(mut oldest)) =
                self.order.pop_front().map(|oldest| self.sent.entry(oldest))
        {
            *oldest.get_mut() -= 1;
            if *oldest.get() == 0 {
                oldest.remove();
            }
        }
        if telegram.damage.is_none()
            && let Some(begin) = self.family.begin(telegram.bytes)
            && let Some(measured) = self.last_of(at, &begin, self.family.exactness(telegram.bytes))
            && at < measured + begin.on_line + PROMPT
        {
            self.prompt = Some((telegram.span.1, at));
        }
    }

    /// Whether `unit`, which is published, was sent. Single points without a checksum are so short that pieces of two often
    /// are one that was sent before: they have to come in their order, too.
    fn was_sent(&mut self, unit: &[u8]) -> bool {
        let key = History::of(unit);
        if self.exactness.neighbours == 0 {
            return self.sent.contains_key(&key);
        }
        let begin = self.passed.saturating_sub(self.forgotten);
        // A packet that the line duplicates was sent once.
        let is_last = begin.checked_sub(1).and_then(|last| self.order.get(last)) == Some(&key);
        let ahead = self.order.iter().skip(begin).position(|sent| *sent == key);
        if !is_last && let Some(ahead) = ahead {
            self.passed = self.forgotten + begin + ahead + 1;
        }
        is_last || ahead.is_some()
    }

    /// Returns the measured point of `told` at its time plus `shift`, within `lenience`.
    fn find(&self, told: &Told, shift: i64, lenience: Nanos) -> Option<&Point> {
        let at_ns = told.at_ns.saturating_add_signed(shift);
        let begin = self.points.partition_point(|point| point.truth.at_ns + lenience < at_ns);
        let near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + lenience);
        near.into_iter().find(|point| point.is(told, &self.exactness))
    }

    /// Whether all of `told` were measured one or several turns of `period` later than told, the same for all.
    fn is_of_later_turn(&self, told: &[Told], period: Nanos, lenience: impl Fn(&Told) -> Nanos) -> bool {
        let shift = self.shift(told);
        shift > period as i64 / 2 && told.iter().all(|told| self.find(told, shift, lenience(told)).is_some())
    }

    /// Returns the number of points of `told` without a measurement within 5 cm.
    fn wrong(&self, told: &[Told], shift: i64) -> u64 {
        let exactness = Exactness { angle_deg: 1.0, range_mm: 50.0, ..self.exactness };
        let is_wrong = |told: &&Told| {
            let at_ns = told.at_ns.saturating_add_signed(shift);
            let begin = self.points.partition_point(|point| point.truth.at_ns + FAR_NS < at_ns);
            let mut near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + FAR_NS);
            !near.any(|point| point.is(told, &exactness))
        };
        told.iter().filter(is_wrong).count() as u64
    }

    /// Returns the time by which most points were measured later than reported. Points repeat nearly from revolution
    /// to revolution, so the revolution that fits best counts.
    fn shift(&self, told: &[Told]) -> i64 {
        let Some(first) = told.iter().find(|told| told.range_mm.is_some()) else { return 0 };
        let fit = |told: &mut dyn Iterator<Item = &Told>, shift: i64| {
            told.filter(|told| self.find(told, shift, NEAR).is_some()).count()
        };
        let some = told.len().div_ceil(16);
        let candidates = self.points.iter().filter(|point| point.is(first, &self.exactness));
        let shifts = candidates.map(|point| point.truth.at_ns as i64 - first.at_ns as i64);
        let mut shifts: Vec<_> =
            shifts.map(|shift| (fit(&mut told.iter().step_by(some), shift), shift)).collect();
        let most = shifts.iter().map(|(count, _)| *count).max().unwrap_or(0);
        shifts.retain(|(count, _)| count + 1 >= most);
        let best = shifts.iter().max_by_key(|(_, shift)| (fit(&mut told.iter(), *shift), -shift.abs()));
        best.map_or(0, |(_, shift)| *shift)
    }
}

/// A point may lie so far before one that was measured before it.
const BACK_DEG: f64 = 40.0;
/// Minimum time with the same number of beams while the port stays open.
const OTHER_BEAMS: Nanos = 10_000 * MILLIS;
/// The first point of a packet was measured no longer before the last one.
const LONGEST: Nanos = 60 * MILLIS;
/// A stamp is off by no more; a later point by a tenth of the time since it more, while the head changes its speed.
const NEAR: Nanos = 5 * MILLIS;
/// A packet is on its way, or in the port, for no longer.
const PROMPT: Nanos = 15 * MILLIS;
/// A clock is tied by so many packets without delay.
const FEW: u32 = 10;
/// Whoever knows that is right from so much later on.
const SETTLED: Nanos = 10 * MILLIS;
/// Where packets have no clock, it takes so long until it is known how the scanner's goes; after so long without a packet it
/// may be another one.
const LEARNED: Nanos = 1_500 * MILLIS;
const LONG_GAP: Nanos = 300 * MILLIS;
/// The least delays of so many seconds count.
const CROWDED: Nanos = 9_000 * MILLIS;
/// For so long after a packet that nobody sent turns may have points of it.
const FOREIGN: Nanos = 2_000 * MILLIS;
/// A hub that stood still has read all that waited within so long.
const CATCHES_UP: Nanos = 10 * MILLIS;
/// Nobody switches a power off and on sooner.
const POWER_OFF: Nanos = 50 * MILLIS;
/// What was measured is remembered for so long, and so many packets are.
const REMEMBERED: Nanos = 12_000 * MILLIS;
const MOST: usize = 65_536;
/// Time within which a measurement near a point makes it right.
const FAR_NS: Nanos = 15 * MILLIS;

/// A point that was measured.
#[derive(Clone, Copy, PartialEq)]
struct Point {
    truth: TruePoint,
    /// Degrees since the first one, turns and all.
    turned_deg: f64,
}

/// A point as a scan reports it.
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
    /// Returns whether this is the reported point. A scanner may get no return from an object.
    fn is(&self, told: &Told, exactness: &Exactness) -> bool {
        let (is_there, most_deg) = match (told.range_mm, self.truth.range_mm) {
            (Some(told), Some(exact)) => {
                ((f64::from(told) - exact).abs() < exactness.range_mm, exactness.angle_deg)
            }
            (Some(_), None) => (false, 0.0),
            (None, _) => (true, exactness.nothing_deg),
        };
        is_there && self.off_deg(told.clockwise_deg) < most_deg
    }

    fn off_deg(&self, clockwise_deg: f64) -> f64 {
        ((self.truth.clockwise_deg - clockwise_deg + 180.0).rem_euclid(360.0) - 180.0).abs()
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
            ..Figures::default()
        }
    }
}
