//! Scans of several sensors in the order of their time, with a bounded wait for the latest, and the offsets of the clocks that
//! stamped them. Refuses to know what scans show.

use std::collections::VecDeque;

use scanhub_schema::{Foreground, Scan};

use crate::track::picture::Picture;
use crate::track::site::Site;
use crate::track::tracker::{PICTURE_NS, Tracker};

/// Scans of one sensor that may wait: with one more the oldest is taken at once.
const WAITING: usize = 64;
/// A stamp so far from all others is of a clock that jumped.
const JUMP_NS: u64 = 2_000_000_000;
/// So many such stamps in a row are the time.
const JUMPS: u32 = 50;
/// Share of an offset that is corrected at once.
const GAIN: f64 = 0.05;
/// Weight, in (m/s)2, of what has to be seen before an offset is corrected.
const ENOUGH: f64 = 40.0;
/// Clocks of hubs that know each other are not farther apart.
const MOST_OFFSET_NS: f64 = 250e6;

/// What was not as it should be, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Scans that were taken.
    pub scans: u64,
    /// Scans that came later than was waited for; they were left out.
    pub late: u64,
    /// Scans whose stamp was seconds away from all others; they were left out.
    pub jumped: u64,
    /// Scans without a foreground of the same beams, or of no sensor of the site; they were left out.
    pub unfit: u64,
}

struct Waiting {
    /// As stamped: what the clock is off by is known when it is taken.
    wall_ns: u64,
    scan: Box<Scan>,
    foreground: Box<Foreground>,
}

/// Persons from the scans of a site's sensors.
pub struct People {
    tracker: Tracker,
    delay_ns: u64,
    /// In the order of time, per sensor.
    queues: Vec<VecDeque<Waiting>>,
    /// The hub of each sensor, by its first sensor.
    hub_of: Vec<usize>,
    /// How far the clock of each hub is ahead of the first one's, in ns; by its first sensor.
    offsets: Vec<f64>,
    /// The latest stamp.
    latest_ns: u64,
    /// What was taken last.
    taken_ns: u64,
    next_picture_ns: u64,
    jumps: u32,
    counts: Counts,
    /// Late scans of each sensor.
    late: Vec<u64>,
    picture: Picture,
    spare: Vec<Waiting>,
}

impl People {
    /// Waits for the latest scan for `delay_ns`.
    pub fn new(site: Site, delay_ns: u64) -> People {
        let hub_of = site
            .sensors
            .iter()
            .map(|one| site.sensors.iter().position(|other| other.hub() == one.hub()).unwrap_or_default());
        let hub_of: Vec<usize> = hub_of.collect();
        let count = site.sensors.len();
        People {
            tracker: Tracker::new(site),
            delay_ns,
            queues: (0..count).map(|_| VecDeque::with_capacity(WAITING)).collect(),
            hub_of,
            offsets: vec![0.0; count],
            latest_ns: 0,
            taken_ns: 0,
            next_picture_ns: 0,
            jumps: 0,
            counts: Counts::default(),
            late: vec![0; count],
            picture: Picture::default(),
            spare: Vec::new(),
        }
    }

    /// Returns the site.
    pub fn site(&self) -> &Site {
        &self.tracker.site
    }

    /// Returns what was not as it should be.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Returns the number of late scans of each sensor, by its index in the site. Their sum is [`Counts::late`].
    pub fn late(&self) -> &[u64] {
        &self.late
    }

    /// Returns how far the clock that stamps `sensor` is ahead of the first sensor's, in seconds, as far as people whom both
    /// see tell.
    pub fn offset_s(&self, sensor: usize) -> f64 {
        self.hub_of.get(sensor).map_or(0.0, |&hub| self.offsets[hub] * 1e-9)
    }

    /// Takes a scan of `sensor`, a number in the site, with its foreground and its stamp of the wall clock, and hands each
    /// picture that is due to `show`. Scans that come within the delay are taken in the order of their stamps, however
    /// they come.
    pub fn take(
        &mut self,
        sensor: usize,
        wall_ns: u64,
        scan: &Scan,
        foreground: &Foreground,
        mut show: impl FnMut(&Picture),
    ) {
        if sensor >= self.queues.len() || usize::from(foreground.count) != scan.beams() || scan.beams() == 0 {
            self.counts.unfit += 1;
            return;
        }
        let at_ns = self.corrected(sensor, wall_ns);
        if self.latest_ns > 0 && at_ns.abs_diff(self.latest_ns) > JUMP_NS && !self.is_new_time(at_ns) {
            self.counts.jumped += 1;
            return;
        }
        if at_ns <= self.taken_ns {
            self.counts.late += 1;
            self.late[sensor] += 1;
            return;
        }
        self.jumps = 0;
        self.latest_ns = self.latest_ns.max(at_ns);
        let mut one = self.spare.pop().unwrap_or_else(|| Waiting {
            wall_ns,
            scan: scan.boxed(),
            foreground: foreground.boxed(),
        });
        one.wall_ns = wall_ns;
        Scan::grow(&mut one.scan, scan.bytes().len());
        Foreground::grow(&mut one.foreground, foreground.bytes().len());
        one.scan.copy_from(scan.bytes());
        one.foreground.copy_from(foreground.bytes());
        let queue = &mut self.queues[sensor];
        let place = queue.partition_point(|other| other.wall_ns <= wall_ns);
        queue.insert(place, one);
        let until_ns = self.latest_ns.saturating_sub(self.delay_ns);
        self.advance(until_ns, &mut show);
    }

    /// Takes all that waits, at the end of a recording.
    pub fn finish(&mut self, mut show: impl FnMut(&Picture)) {
        self.advance(u64::MAX, &mut show);
    }

    /// What a stamp of `sensor` is by the clock of the first one.
    fn corrected(&self, sensor: usize, wall_ns: u64) -> u64 {
        wall_ns.saturating_add_signed(-(self.offsets[self.hub_of[sensor]] as i64))
    }

    fn advance(&mut self, until_ns: u64, show: &mut impl FnMut(&Picture)) {
        loop {
            let first = |sensor: usize, queue: &VecDeque<Waiting>| {
                queue.front().map(|one| self.corrected(sensor, one.wall_ns))
            };
            let fronts = self.queues.iter().enumerate().filter_map(|(i, queue)| Some((first(i, queue)?, i)));
            let Some((at_ns, sensor)) = fronts.min() else { break };
            let is_full = self.queues.iter().any(|queue| queue.len() > WAITING);
            if at_ns > until_ns && !is_full {
                break;
            }
            // A corrected clock may step back.
            let at_ns = at_ns.max(self.taken_ns + 1);
            if self.next_picture_ns == 0 {
                self.next_picture_ns = (at_ns / PICTURE_NS + 1) * PICTURE_NS;
            }
            self.pictures_until(at_ns, show);
            if let Some(one) = self.queues[sensor].pop_front() {
                self.tracker.take(sensor, at_ns, &one.scan, &one.foreground);
                self.spare.push(one);
                self.counts.scans += 1;
                self.taken_ns = at_ns;
                self.compare_clocks();
            }
        }
        // Nothing that is still waited for changes these.
        if until_ns < u64::MAX && self.next_picture_ns > 0 && self.next_picture_ns <= until_ns {
            self.pictures_until(until_ns + 1, show);
            self.taken_ns = self.taken_ns.max(self.next_picture_ns - PICTURE_NS);
        }
    }

    /// Pictures before `at_ns`.
    fn pictures_until(&mut self, at_ns: u64, show: &mut impl FnMut(&Picture)) {
        if at_ns.saturating_sub(self.next_picture_ns) > JUMP_NS {
            self.next_picture_ns = (at_ns / PICTURE_NS) * PICTURE_NS;
        }
        while self.next_picture_ns < at_ns {
            self.tracker.show(self.next_picture_ns, &mut self.picture);
            show(&self.picture);
            self.next_picture_ns += PICTURE_NS;
        }
    }

    /// All stamps are far from what was the time, again and again: the time is another one.
    fn is_new_time(&mut self, at_ns: u64) -> bool {
        self.jumps += 1;
        let is_new = self.jumps > JUMPS;
        if is_new {
            self.jumps = 0;
            self.latest_ns = at_ns;
            self.taken_ns = at_ns - 1;
            self.next_picture_ns = 0;
            self.queues.iter_mut().for_each(VecDeque::clear);
        }
        is_new
    }

    /// Who walks is seen ahead of where he should be by a sensor whose clock is late, and behind by one whose clock is early.
    fn compare_clocks(&mut self) {
        for (sensor, &hub) in self.hub_of.iter().enumerate() {
            if hub == 0 || hub != sensor {
                continue;
            }
            let sum = |is_of: &dyn Fn(usize) -> bool| {
                let all = self.tracker.lateness.iter().zip(&self.hub_of).filter(|(_, hub)| is_of(**hub));
                all.fold((0.0, 0.0), |sum, ((a, b), _)| (sum.0 + a, sum.1 + b))
            };
            let (own, others) = (sum(&|of| of == hub), sum(&|of| of == 0));
            if own.1 < ENOUGH || others.1 < ENOUGH {
                continue;
            }
            let ahead_s = own.0 / own.1 - others.0 / others.1;
            let gain = GAIN;
            self.offsets[hub] =
                (self.offsets[hub] - gain * 1e9 * ahead_s * FEEDBACK).clamp(-MOST_OFFSET_NS, MOST_OFFSET_NS);
            for (of, lateness) in self.hub_of.iter().zip(&mut self.tracker.lateness) {
                if *of == hub || *of == 0 {
                    *lateness = (0.0, 0.0);
                }
            }
        }
    }
}

/// The filter follows each sensor in part, so that only a part of an offset shows: what that part is multiplied with.
const FEEDBACK: f64 = 3.0;

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use scanhub_preprocess::background::{Model, Settings};
    use scanhub_schema::ScanHead;

    use super::*;

    const ROOM: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.1, y = 3.0, yaw = 0.0 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 6], [0, 6]]
"#;
    const BEAMS: usize = 361;
    const SCANS: usize = 75;

    fn capacity(people: &People) -> usize {
        let queues: usize = people.queues.iter().map(VecDeque::capacity).sum();
        let picture = people.picture.tracks.capacity() + people.picture.events.capacity();
        people.tracker.capacity() + queues + people.spare.capacity() + picture
    }

    /// A scan of a sensor that sees a wall 3 m around it, and two legs around a beam 2 m before it.
    fn scan(legs: Option<usize>) -> Box<Scan> {
        let head = ScanHead {
            first_angle: -std::f64::consts::FRAC_PI_2,
            step: std::f64::consts::PI / 360.0,
            unit_um: 1000,
            valid_to: 8182,
            no_return: 8191,
            beyond: 8191,
            ..ScanHead::default()
        };
        let is_leg = |beam: usize| legs.is_some_and(|middle| (3..=8).contains(&beam.abs_diff(middle)));
        let words: Vec<u16> = (0..BEAMS).map(|beam| if is_leg(beam) { 2000 } else { 3000 }).collect();
        Scan::of(head, &words)
    }

    #[test]
    fn memory_does_not_grow_and_no_identity_comes_again_however_many_come_and_go() {
        let site = Site::parse("room.toml", ROOM).expect("a room");
        let mut people = People::new(site, 80_000_000);
        let mut model = Model::new(Settings::default(), BEAMS);
        let (mut foreground, mut now_ns) = (Foreground::of(BEAMS), 1_700_000_000_000_000_000);
        let (mut gone, mut here) = (BTreeSet::new(), BTreeSet::new());
        let mut turn = |people: &mut People, legs: Option<usize>| {
            let scan = scan(legs);
            model.update(&scan, &mut foreground);
            now_ns += PICTURE_NS;
            people.take(0, now_ns, &scan, &foreground, |picture| {
                let now: BTreeSet<u64> = picture.tracks.iter().map(|track| track.id).collect();
                gone.extend(here.difference(&now).copied());
                assert!(now.is_disjoint(&gone), "{now:?} after {gone:?}");
                here = now;
            });
        };
        (0..300).for_each(|_| turn(&mut people, None));
        let mut visit = |people: &mut People, number: usize| {
            // 40 of 75 scans with somebody who walks by: he is gone, and known to be, before the next one comes.
            for i in 0..SCANS {
                turn(people, (i < 40).then_some(60 + number % 100 + 3 * i));
            }
        };
        // Every way that there is, once.
        (0..100).for_each(|number| visit(&mut people, number));
        let begin = capacity(&people);
        (100..300).for_each(|number| visit(&mut people, number));
        assert_eq!(capacity(&people), begin);
        assert!(gone.len() >= 200, "{}", gone.len());
        assert_eq!(people.counts().late, 0);
    }

    #[test]
    fn a_picture_comes_as_soon_as_nothing_before_it_is_waited_for() {
        const MS: u64 = 1_000_000;
        const BEGIN: u64 = 1_700_000_000_000_000_000;
        let mut people = People::new(Site::parse("room.toml", ROOM).expect("a room"), 80 * MS);
        let (scan, foreground) = (scan(None), Foreground::of(BEAMS));
        let mut take = |after_ms: u64| {
            let mut pictures = Vec::new();
            let show = |picture: &Picture| pictures.push((picture.wall_ns - BEGIN) / MS);
            people.take(0, BEGIN + after_ms * MS, &scan, &foreground, show);
            (pictures, people.counts().late)
        };
        assert_eq!([take(0), take(100)], [(vec![], 0), (vec![], 0)]);
        assert_eq!(take(200), (vec![40, 80, 120], 0));
        assert_eq!(take(110), (vec![], 1), "a picture that was shown holds");
        assert_eq!(take(240), (vec![160], 1));
    }
}
