//! Invariant on revolutions: a scan of a rotating scanner contains only points of one revolution. The scan contains all
//! points of this revolution, or the hub marks it as incomplete. The scanner measured each point of the scan at its
//! angle, with its range, at the time that the scan states. While the port stays open, the number of beams changes at
//! most every ten seconds.
//!
//! A stamp can be right only after the hub has received a packet without delay. Before that, the hub cannot distinguish
//! a delayed line from a delayed scanner.

use std::cell::Cell;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Code, Header, MICROS, MILLIS, Nanos, Scan, State, Status, Topic};
use scanhub_sim::ld::TruePoint;

use super::{Invariant, ViolationReporter};
use crate::event::{Event, RevolutionFigures, Telegram};
use crate::family::{Family, FirstPoint, PointAccuracy};
use crate::hash::HistoryHash;
use crate::topics::Sample;

/// Points and packets of all rotating scanners.
pub(crate) struct Revolutions {
    sensors: Vec<SensorPoints>,
    /// Time until which the hub is stalled, or the end of its last stall.
    stalled_until: Nanos,
    figures: RevolutionFigures,
}

struct SensorPoints {
    family: Rc<dyn Family>,
    /// Recently measured points, in order of time.
    points: VecDeque<Point>,
    /// Number of times that the scanner sent each recent packet, by the packet's hash; and these hashes in the order of
    /// sending.
    sent: HashMap<u64, u32>,
    sent_order: VecDeque<u64>,
    /// Number of packets that were removed from the start of `sent_order`; and number of all sent packets up to the
    /// last one that the hub published.
    dropped: usize,
    matched: usize,
    /// Accuracy of the packets that were published last.
    exactness: PointAccuracy,
    /// Time at which the hub published the last unit of unknown origin. No scanner sent this unit, or the hub could not
    /// publish an earlier unit for lack of memory. The second field is the sequence number of the last published
    /// telegram that a scanner sent.
    foreign_at: Option<Nanos>,
    last_known: Option<u64>,
    /// Boot ID of the hub, number of beams, and time of the first scan with this number of beams since the port was
    /// opened.
    beams: Option<(u64, usize, Nanos)>,
    /// Position after the last packet that arrived without delay, and time at which that packet arrived.
    prompt: Option<(u64, Nanos)>,
    /// Number of packets that were read without delay since the session began; time at which this number reached
    /// `MIN_PROMPT_PACKETS`; and time of the last of these packets.
    prompts: u32,
    settled_at: Option<Nanos>,
    last_prompt_at: Option<Nanos>,
    /// Position after the last sent packet; and time of the last bytes that arrived all at once, without time on the
    /// line. A packet that is read together with such bytes seems to arrive early.
    end: u64,
    queued_at: Option<Nanos>,
    /// Time at which an intact packet was last on the line.
    arrived_at: Nanos,
    /// Error of the stamp of the last scan whose stamp was checked.
    last_error: Cell<Option<i64>>,
}

impl Revolutions {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Revolutions {
        let sensor = |family: &Rc<dyn Family>| SensorPoints {
            family: family.clone(),
            points: VecDeque::new(),
            sent: HashMap::new(),
            sent_order: VecDeque::new(),
            dropped: 0,
            matched: 0,
            exactness: PointAccuracy::default(),
            foreign_at: None,
            last_known: None,
            beams: None,
            prompt: None,
            prompts: 0,
            settled_at: None,
            last_prompt_at: None,
            end: 0,
            queued_at: None,
            arrived_at: 0,
            last_error: Cell::default(),
        };
        Revolutions {
            sensors: sensors.iter().map(sensor).collect(),
            stalled_until: 0,
            figures: RevolutionFigures::default(),
        }
    }
}

impl Invariant for Revolutions {
    fn figures(&self) -> RevolutionFigures {
        self.figures
    }

    fn name(&self) -> &'static str {
        "turns"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Measured { sensor, points } => self.sensors[sensor].measure(points),
            Event::Sent { sensor, telegram } => self.sensors[sensor].send(at, telegram),
            Event::Read { sensor, to, .. } => {
                let of = &mut self.sensors[sensor];
                let is_prompt =
                    of.prompt.is_some_and(|(place, read_at)| place <= to && at < read_at + MAX_PROMPT_DELAY);
                if is_prompt {
                    of.on_prompt_packet(at);
                }
            }
            Event::RateChanged { sensor } => self.sensors[sensor].restart(),
            Event::PortOpened { sensor, .. } => {
                self.sensors[sensor].restart();
                self.sensors[sensor].beams = None;
            }
            Event::ScannerExchanged { sensor } => {
                self.sensors[sensor].restart();
                self.sensors[sensor].beams = None;
            }
            Event::HubStarted { .. } => {
                self.stalled_until = 0;
                self.sensors.iter_mut().for_each(SensorPoints::restart);
            }
            Event::Stalled { until } => self.stalled_until = until,
            Event::FaultsCleared => self.stalled_until = self.stalled_until.min(at),
            Event::Published { sensor, sample } if self.sensors[sensor].family.is_rotating() => {
                let waited = at < self.stalled_until + CATCH_UP_TIME;
                match self.sensors[sensor].publish(at, sample, waited) {
                    Ok(figures) => self.figures.add(&figures),
                    Err(words) => reporter.report(format!("sensor {sensor}: {words}")),
                }
            }
            _ => {}
        }
    }
}

impl SensorPoints {
    /// Discards the estimate of the scanner's clock.
    fn restart(&mut self) {
        (self.prompts, self.settled_at, self.last_error) = (0, None, Cell::default());
    }

    /// Handles a packet that was read without delay at `at`.
    fn on_prompt_packet(&mut self, at: Nanos) {
        let before = self.last_prompt_at.replace(at).unwrap_or(0);
        if !self.exactness.has_clock && before + MAX_GAP < at {
            self.restart();
        }
        self.prompt = None;
        self.prompts += 1;
        if self.prompts >= MIN_PROMPT_PACKETS {
            self.settled_at.get_or_insert(at);
        }
    }

    fn measure(&mut self, points: &[TruePoint]) {
        for &truth in points {
            let rotated_deg = match self.points.back() {
                Some(last) => {
                    // After a power cycle, a new revolution starts at any angle. Points may be out of order.
                    let is_new = truth.at_ns > last.truth.at_ns + MIN_POWER_OFF;
                    let step_deg = (truth.clockwise_deg - last.truth.clockwise_deg).rem_euclid(360.0);
                    let is_back = step_deg > 360.0 - MAX_REORDER_DEG && !is_new;
                    let turns_deg = if is_new { 720.0 } else { 0.0 } - if is_back { 360.0 } else { 0.0 };
                    last.rotated_deg + step_deg + turns_deg
                }
                None => truth.clockwise_deg,
            };
            if self.points.back().is_some_and(|last| truth.at_ns > last.truth.at_ns + MIN_POWER_OFF) {
                self.restart();
            }
            self.points.push_back(Point { truth, rotated_deg });
        }
        let newest = self.points.back().map_or(0, |last| last.truth.at_ns);
        while self.points.front().is_some_and(|first| first.truth.at_ns + HISTORY_TIME < newest) {
            self.points.pop_front();
        }
    }

    /// Returns the time at which the scanner measured the last point of `packet`. The last byte of the packet arrived
    /// at `at`.
    fn last_point_time(&self, at: Nanos, packet: &FirstPoint, exactness: PointAccuracy) -> Option<Nanos> {
        let (of, maximum) = (self.points.len(), at.saturating_sub(MAX_PACKET_TIME + packet.line_time));
        let lately = (0..of).rev().skip(packet.points - 1);
        let mut lately = lately.take_while(|&first| self.points[first].truth.at_ns > maximum);
        let first = lately
            .find(|&first| self.points[first].deviation_deg(packet.clockwise_deg) < exactness.angle_deg)?;
        Some(self.points[first + packet.points - 1].truth.at_ns)
    }

    /// Checks a published sample. `was_backlogged` means that the packets of the sample may have been buffered while
    /// the hub was stalled.
    ///
    /// # Errors
    ///
    /// Returns a description of the error.
    fn publish(
        &mut self,
        at: Nanos,
        sample: &Sample,
        was_backlogged: bool,
    ) -> Result<RevolutionFigures, String> {
        match sample.topic {
            Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                if status.state() != Some(State::Streaming) {
                    self.restart();
                }
                Ok(RevolutionFigures::default())
            }
            Topic::Telegram => {
                let seq = sample.header.seq;
                let is_gap = self.last_known.replace(seq).is_some_and(|last_seq| seq > last_seq + 1);
                let family = self.family.clone();
                let units = family.telegrams(&sample.bytes);
                let mut is_foreign = is_gap;
                for unit in units.into_iter().filter(|unit| family.is_data(unit)) {
                    self.exactness = family.point_accuracy(unit);
                    is_foreign |= !self.was_sent(unit);
                }
                if is_foreign {
                    self.foreign_at = Some(at);
                }
                Ok(RevolutionFigures::default())
            }
            Topic::Scan => {
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    return Err("a sample that is not a valid scan".to_owned());
                }
                let (boot, beams) = (sample.header.boot, scan.beams());
                let before = self.beams.filter(|(of, ..)| *of == boot);
                match before {
                    Some((_, before, _)) if before == beams => {}
                    // While the port stays open, the number of beams changes only after the number of points per
                    // revolution has been different for `MIN_BEAM_COUNT_TIME`.
                    Some((_, before, since)) if at < since + MIN_BEAM_COUNT_TIME => {
                        return Err(format!("{beams} beams after {before}"));
                    }
                    _ => self.beams = Some((boot, beams, at)),
                }
                if self.last_known.is_some_and(|last_seq| sample.header.seq > last_seq) {
                    self.foreign_at = Some(at);
                }
                self.check(at, &sample.header, &scan, was_backlogged)
            }
            _ => Ok(RevolutionFigures::default()),
        }
    }

    /// Checks `scan`, whose `header` has the time of its first beam.
    ///
    /// # Errors
    ///
    /// Returns a description of the error.
    fn check(
        &self,
        at: Nanos,
        header: &Header,
        scan: &Scan,
        was_backlogged: bool,
    ) -> Result<RevolutionFigures, String> {
        let stamp = header.stamp_first_ns;
        let is_marked = scan.is_incomplete() || header.reasons != 0;
        let is_foreign = self.foreign_at.is_some_and(|foreign_at| at < foreign_at + FOREIGN_POINTS_TIME);
        let reported = reported_points(stamp, scan);
        let Some(begin) = reported.first().map(|first| first.at_ns) else {
            return Ok(RevolutionFigures::default());
        };
        let lenience =
            |reported: &ReportedPoint| MAX_STAMP_ERROR + reported.at_ns.max(begin).saturating_sub(stamp) / 10;
        let found = |shift: i64| -> Vec<Option<&Point>> {
            reported.iter().map(|reported| self.find(reported, shift, lenience(reported))).collect()
        };
        let is_crowded = self.queued_at.is_some_and(|crowded_at| at < crowded_at + DELAY_WINDOW);
        let settles = if self.exactness.has_clock { SETTLE_TIME } else { CLOCK_LEARNING_TIME };
        // While the hub is stalled, its estimate of the scanner's clock does not improve, so the last prompt packet
        // counts.
        let learned_at = if self.exactness.has_clock { Some(at) } else { self.last_prompt_at };
        let is_learned =
            |settled_at: Nanos| learned_at.is_some_and(|learned_at| settled_at + settles < learned_at);
        let is_settled = self.settled_at.is_some_and(is_learned) && !is_crowded;
        let (mut points, mut shift) = (found(0), 0);
        // If packets have no timestamp and are backlogged, the hub determines only later how many revolutions are
        // missing in a gap.
        let is_open = was_backlogged && scan.is_incomplete() && !self.exactness.has_clock;
        if let Some(gap) = points.iter().position(Option::is_none).filter(|gap| is_open && *gap > 0)
            && self.is_from_later_revolution(
                &reported[gap..],
                Nanos::from(header.period_us) * MICROS,
                lenience,
            )
        {
            return Ok(RevolutionFigures { scans: 1, incomplete: 1, ..RevolutionFigures::default() });
        }
        if points.contains(&None) {
            shift = self.best_shift(&reported);
            points = found(shift);
            let count = points.iter().flatten().count();
            if is_settled && 2 * count > reported.len() && shift.unsigned_abs() > MAX_STAMP_ERROR {
                return Err(format!("the stamp is off by {} us", shift / 1_000));
            }
        }
        let wrong = if is_marked || !points.contains(&None) { 0 } else { self.count_wrong(&reported, shift) };
        if is_foreign {
            let scans = RevolutionFigures {
                scans: 1,
                incomplete: scan.is_incomplete().into(),
                ..RevolutionFigures::default()
            };
            return Ok(RevolutionFigures { wrong, ..scans });
        }
        if let Some(beam) = points.iter().position(Option::is_none) {
            let reported = &reported[beam];
            let is_it = |point: &&Point| point.matches(reported, &self.exactness);
            let off = |point: &Point| point.truth.at_ns as i64 - reported.at_ns as i64;
            let nearest = self.points.iter().filter(is_it).map(off).min_by_key(|off| off.abs());
            let when = nearest.map_or("never".to_owned(), |off| format!("{} us later", off / 1_000));
            let (missing, of) = (points.iter().filter(|point| point.is_none()).count(), points.len());
            let (stamp_us, shift) = (stamp / 1_000, shift / 1_000);
            return Err(format!(
                "{missing} of {of} points not found, stamp {stamp_us} us, {shift} us off, first {reported:?} was measured {when}"
            ));
        }
        let edge_deg = 180.0 / scan.beams() as f64;
        let turned = |point: &&Point| point.rotated_deg + edge_deg;
        let revolution =
            points[points.len() / 2].as_ref().map_or(0.0, |point| (turned(point) / 360.0).floor());
        let (first_deg, end_deg) = (360.0 * revolution, 360.0 * (revolution + 1.0));
        let is_outside = |point: &&Point| {
            let turned = turned(point);
            let off_deg = self.exactness.angle_deg.max(self.exactness.no_return_deg);
            turned < first_deg - off_deg || turned > end_deg + off_deg
        };
        if let Some(point) = points.iter().flatten().copied().find(is_outside) {
            let (deg, us) = (point.truth.clockwise_deg, (point.truth.at_ns as i64 - stamp as i64) / 1_000);
            return Err(format!("a point of another revolution, at {deg} degrees, {us} us after the stamp"));
        }
        let begin = self.points.partition_point(|point| turned(&point) < first_deg - MAX_REORDER_DEG);
        let around = self.points.range(begin..).map(|point| turned(&point));
        let around = around.take_while(|turned| *turned < end_deg + MAX_REORDER_DEG);
        let measured = around.filter(|turned| (first_deg..end_deg).contains(turned)).count();
        let there = reported.len() + usize::from(scan.collisions);
        // Points at the edge may belong to this revolution or to a neighboring one.
        if !scan.is_incomplete() && measured.abs_diff(there) > self.exactness.points {
            return Err(format!("{there} of {measured} points in a scan that is not marked"));
        }
        let mut figures =
            RevolutionFigures { wrong, ..RevolutionFigures::from_scan(scan, &reported, &points) };
        if let Some(point) = points[0].filter(|_| is_settled && !scan.is_incomplete()) {
            let off = point.truth.at_ns as i64 - reported[0].at_ns as i64;
            figures.stamp_ns = off.unsigned_abs();
            figures.uneven_ns = self.last_error.replace(Some(off)).map_or(0, |before| before.abs_diff(off));
        }
        Ok(figures)
    }

    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let (begin, end) = (std::mem::replace(&mut self.end, telegram.span.1), telegram.span.1);
        if telegram.is_reply {
            return;
        }
        if telegram.damage.is_none() {
            // The line lost all packets for longer than `MAX_GAP`. If packets have no timestamp, the hub must estimate
            // the scanner's clock again.
            if !self.exactness.has_clock && self.arrived_at + MAX_GAP < at {
                self.restart();
            }
            self.arrived_at = at;
        }
        let key = HistoryHash::hash_bytes(telegram.bytes);
        let is_double = self.sent_order.back() == Some(&key);
        *self.sent.entry(key).or_default() += 1;
        self.sent_order.push_back(key);
        if is_double || end - begin > telegram.bytes.len() as u64 {
            self.queued_at = Some(at);
        }
        self.dropped += usize::from(self.sent_order.len() > MAX_SENT);
        if self.sent_order.len() > MAX_SENT
            && let Some(Entry::Occupied(mut oldest)) =
                self.sent_order.pop_front().map(|oldest| self.sent.entry(oldest))
        {
            *oldest.get_mut() -= 1;
            if *oldest.get() == 0 {
                oldest.remove();
            }
        }
        if telegram.damage.is_none()
            && let Some(begin) = self.family.first_point(telegram.bytes)
            && let Some(measured) =
                self.last_point_time(at, &begin, self.family.point_accuracy(telegram.bytes))
            && at < measured + begin.line_time + MAX_PROMPT_DELAY
        {
            self.prompt = Some((telegram.span.1, at));
        }
    }

    /// Returns whether a scanner sent the published `unit`. Standard packets are very short, so parts of two damaged
    /// packets often equal a packet that was sent before. Standard packets must therefore be published in the order in
    /// which they were sent.
    fn was_sent(&mut self, unit: &[u8]) -> bool {
        let key = HistoryHash::hash_bytes(unit);
        if self.exactness.neighbors == 0 {
            return self.sent.contains_key(&key);
        }
        let begin = self.matched.saturating_sub(self.dropped);
        // If the line duplicated a packet, the scanner sent it only once.
        let is_last = begin.checked_sub(1).and_then(|last| self.sent_order.get(last)) == Some(&key);
        let ahead = self.sent_order.iter().skip(begin).position(|sent| *sent == key);
        if !is_last && let Some(ahead) = ahead {
            self.matched = self.dropped + begin + ahead + 1;
        }
        is_last || ahead.is_some()
    }

    /// Returns the measured point that matches `reported`. The time of the measurement is the reported time plus
    /// `shift`, within `tolerance`.
    fn find(&self, reported: &ReportedPoint, shift: i64, tolerance: Nanos) -> Option<&Point> {
        let at_ns = reported.at_ns.saturating_add_signed(shift);
        let begin = self.points.partition_point(|point| point.truth.at_ns + tolerance < at_ns);
        let near = self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + tolerance);
        near.into_iter().find(|point| point.matches(reported, &self.exactness))
    }

    /// Returns whether all `reported` points were measured later than their reported times. The difference must be the
    /// same for all points, and must be more than half a `period`.
    fn is_from_later_revolution(
        &self,
        reported: &[ReportedPoint],
        period: Nanos,
        tolerance: impl Fn(&ReportedPoint) -> Nanos,
    ) -> bool {
        let shift = self.best_shift(reported);
        shift > period as i64 / 2
            && reported.iter().all(|reported| self.find(reported, shift, tolerance(reported)).is_some())
    }

    /// Returns the number of `reported` points without a measurement within 5 cm.
    fn count_wrong(&self, reported: &[ReportedPoint], shift: i64) -> u64 {
        let exactness = PointAccuracy { angle_deg: 1.0, range_mm: 50.0, ..self.exactness };
        let is_wrong = |reported: &&ReportedPoint| {
            let at_ns = reported.at_ns.saturating_add_signed(shift);
            let begin = self.points.partition_point(|point| point.truth.at_ns + POINT_MATCH_NS < at_ns);
            let mut near =
                self.points.range(begin..).take_while(|point| point.truth.at_ns <= at_ns + POINT_MATCH_NS);
            !near.any(|point| point.matches(reported, &exactness))
        };
        reported.iter().filter(is_wrong).count() as u64
    }

    /// Returns the time from the reported time of a point to its measurement, as the difference that fits the most
    /// points. Points are nearly the same in each revolution, so all revolutions are compared.
    fn best_shift(&self, reported: &[ReportedPoint]) -> i64 {
        let Some(first) = reported.iter().find(|reported| reported.range_mm.is_some()) else { return 0 };
        let fit = |reported: &mut dyn Iterator<Item = &ReportedPoint>, shift: i64| {
            reported.filter(|reported| self.find(reported, shift, MAX_STAMP_ERROR).is_some()).count()
        };
        let some = reported.len().div_ceil(16);
        let candidates = self.points.iter().filter(|point| point.matches(first, &self.exactness));
        let shifts = candidates.map(|point| point.truth.at_ns as i64 - first.at_ns as i64);
        let mut shifts: Vec<_> =
            shifts.map(|shift| (fit(&mut reported.iter().step_by(some), shift), shift)).collect();
        let maximum = shifts.iter().map(|(count, _)| *count).max().unwrap_or(0);
        shifts.retain(|(count, _)| count + 1 >= maximum);
        let best = shifts.iter().max_by_key(|(_, shift)| (fit(&mut reported.iter(), *shift), -shift.abs()));
        best.map_or(0, |(_, shift)| *shift)
    }
}

/// Maximum angle by which a point may lie behind a point that was measured before it, in degrees.
const MAX_REORDER_DEG: f64 = 40.0;
/// Minimum time with the same number of beams while the port stays open.
const MIN_BEAM_COUNT_TIME: Nanos = 10_000 * MILLIS;
/// Maximum time between the first and the last point of a packet.
const MAX_PACKET_TIME: Nanos = 60 * MILLIS;
/// Maximum error of a stamp. While the speed of the head changes, the time of a point of the scan may have an
/// additional error: a tenth of the time from the stamp to the point.
const MAX_STAMP_ERROR: Nanos = 5 * MILLIS;
/// Maximum delay at which a packet is regarded as not delayed. It limits two times: the time from the measurement to
/// the arrival of the packet, without the packet's time on the line; and the time from the arrival until the hub reads
/// the packet.
const MAX_PROMPT_DELAY: Nanos = 15 * MILLIS;
/// Number of packets without delay after which the session has estimated the scanner's clock.
const MIN_PROMPT_PACKETS: u32 = 10;
/// Time from the last of these packets after which stamps must be right.
const SETTLE_TIME: Nanos = 10 * MILLIS;
/// Two times that are used if packets have no timestamp: time that the session needs to estimate the scanner's clock;
/// and time without a packet after which a different scanner may be connected.
const CLOCK_LEARNING_TIME: Nanos = 1_500 * MILLIS;
const MAX_GAP: Nanos = 300 * MILLIS;
/// Length of the time window in which the session determines the smallest delay of a packet.
const DELAY_WINDOW: Nanos = 9_000 * MILLIS;
/// Maximum time after a foreign packet in which revolutions may contain points of that packet.
const FOREIGN_POINTS_TIME: Nanos = 2_000 * MILLIS;
/// Maximum time that a hub needs to read its backlog after a stall.
const CATCH_UP_TIME: Nanos = 10 * MILLIS;
/// Minimum duration of a power cycle.
const MIN_POWER_OFF: Nanos = 50 * MILLIS;
/// Time for which this invariant stores measured points; and maximum number of stored packets.
const HISTORY_TIME: Nanos = 12_000 * MILLIS;
const MAX_SENT: usize = 65_536;
/// Maximum time between a reported point and its measurement, when wrong points are counted.
const POINT_MATCH_NS: Nanos = 15 * MILLIS;

/// A measured point.
#[derive(Clone, Copy, PartialEq)]
struct Point {
    truth: TruePoint,
    /// Angle by which the head has rotated since its very first point, in degrees. It includes whole revolutions.
    rotated_deg: f64,
}

/// A point as a scan reports it.
#[derive(Debug)]
struct ReportedPoint {
    at_ns: Nanos,
    clockwise_deg: f64,
    range_mm: Option<u16>,
}

/// Returns the beams of `scan` that the scanner measured, with or without a range.
fn reported_points(stamp: Nanos, scan: &Scan) -> Vec<ReportedPoint> {
    let beams = (0..scan.beams()).filter(|&i| scan.code(i) != Some(Code::NotMeasured));
    let reported = |i: usize| ReportedPoint {
        at_ns: stamp.saturating_add_signed(scan.beam_ns(i)),
        clockwise_deg: (-scan.angle(i).to_degrees()).rem_euclid(360.0),
        range_mm: scan.range(i),
    };
    beams.map(reported).collect()
}

impl Point {
    /// Returns whether `reported` is this point, within the accuracy. A reported point without a range can match a
    /// point with a range, because a scanner may get no return from an object.
    fn matches(&self, reported: &ReportedPoint, exactness: &PointAccuracy) -> bool {
        let (is_there, most_deg) = match (reported.range_mm, self.truth.range_mm) {
            (Some(reported), Some(exact)) => {
                ((f64::from(reported) - exact).abs() < exactness.range_mm, exactness.angle_deg)
            }
            (Some(_), None) => (false, 0.0),
            (None, _) => (true, exactness.no_return_deg),
        };
        is_there && self.deviation_deg(reported.clockwise_deg) < most_deg
    }

    fn deviation_deg(&self, clockwise_deg: f64) -> f64 {
        ((self.truth.clockwise_deg - clockwise_deg + 180.0).rem_euclid(360.0) - 180.0).abs()
    }
}

impl RevolutionFigures {
    fn from_scan(scan: &Scan, reported: &[ReportedPoint], points: &[Option<&Point>]) -> RevolutionFigures {
        let pairs =
            || reported.iter().zip(points).filter_map(|(measured, point)| Some((measured, (*point)?)));
        let worst = |off: &dyn Fn((&ReportedPoint, &Point)) -> f64| pairs().map(off).fold(0.0, f64::max);
        let range_mm = |(reported, point): (&ReportedPoint, &Point)| {
            reported
                .range_mm
                .zip(point.truth.range_mm)
                .map_or(0.0, |(reported, exact)| (f64::from(reported) - exact).abs())
        };
        RevolutionFigures {
            scans: 1,
            incomplete: scan.is_incomplete().into(),
            points: pairs().count() as u64,
            angle_deg: worst(&|(measured, point)| point.deviation_deg(measured.clockwise_deg)),
            range_mm: worst(&range_mm),
            ..RevolutionFigures::default()
        }
    }
}
