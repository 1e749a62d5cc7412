//! A long run of the tracker. New people arrive every ten minutes, and one scan per minute is late. The run shows that
//! the tracker's memory does not grow, and that no ID is used twice.

use std::time::Instant;

use scanhub_perception::track::{PeopleTracker, Site, Snapshot};
use scanhub_preprocess::background::{BackgroundModel, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Foreground, Pose, Scan};

use crate::house::{BEAMS, House, HouseSensor};
use crate::walkers::Crowd;

const SECONDS_PER_HOUR: u64 = 3600;
/// Share of rests that end with a change of the room, and share of rests on a chair.
const CHANGE_SHARES: (f64, f64) = (0.25, 0.25);
/// Scans per second, from all sensors together. The sensors take turns.
const SCAN_RATE_HZ: u64 = 100;
const SCAN_DELAY_NS: u64 = 80_000_000;
/// Time in seconds after which the people are replaced.
const VISIT_TIME_S: u64 = 600;
/// Delay of a late scan in ns.
const LATE_DELAY_NS: u64 = 300_000_000;
const START_NS: u64 = 1_800_000_000_000_000_000;

/// Tracks `people` people at a time for `hours` hours of virtual time, and prints a line after each of these hours.
pub(crate) fn run(hours: u64, people: usize) {
    let house = House { is_ideal: false };
    let site = Site::parse("house.toml", &house.site()).expect("the house is right");
    let mut eyes: Vec<(HouseSensor, BackgroundModel, Segmenter)> = (0..site.sensors.len())
        .map(|sensor| {
            let segmenter = Segmenter::new(Pose::default(), BEAMS);
            (
                HouseSensor::new(house, sensor, hours),
                BackgroundModel::new(Settings::default(), BEAMS),
                segmenter,
            )
        })
        .collect();
    let sensors = eyes.len() as u64;
    let mut tracker = PeopleTracker::new(site, SCAN_DELAY_NS);
    let mut ids = TrackIds::default();
    let mut held: Option<(usize, u64, Box<Scan>, Box<Foreground>)> = None;
    let (mut sent_late, mut tracker_s) = (0, 0.0);
    let mut crowd = Crowd::new(house, 0, 0.0, CHANGE_SHARES, 0);
    for step in 0..hours * SECONDS_PER_HOUR * SCAN_RATE_HZ {
        if step % (VISIT_TIME_S * SCAN_RATE_HZ) == 0 {
            crowd = Crowd::new(house, people, 12.0, CHANGE_SHARES, step);
        }
        let visit_s = (step % (VISIT_TIME_S * SCAN_RATE_HZ)) as f64 / SCAN_RATE_HZ as f64;
        crowd.step(visit_s, 1.0 / SCAN_RATE_HZ as f64);
        let sensor = (step % sensors) as usize;
        let (eye, model, segmenter) = &mut eyes[sensor];
        let scan = eye.scan(&|_| crowd.shapes(), step * 1_000_000_000 / SCAN_RATE_HZ);
        let mut foreground = Foreground::of(BEAMS);
        model.update(&scan, &mut foreground);
        segmenter.update(&scan, &mut foreground);
        let now_ns = START_NS + step * 1_000_000_000 / SCAN_RATE_HZ;
        if step % (60 * SCAN_RATE_HZ) == 30 * SCAN_RATE_HZ {
            held = Some((sensor, now_ns, scan, foreground));
            continue;
        }
        let begin = Instant::now();
        tracker.take(sensor, now_ns, &scan, &foreground, |sample| ids.take(sample));
        if let Some((sensor, at_ns, scan, foreground)) = held.take_if(|held| held.1 + LATE_DELAY_NS < now_ns)
        {
            sent_late += 1;
            tracker.take(sensor, at_ns, &scan, &foreground, |sample| ids.take(sample));
        }
        tracker_s += begin.elapsed().as_secs_f64();
        if (step + 1) % (SECONDS_PER_HOUR * SCAN_RATE_HZ) == 0 {
            let hour = (step + 1) / (SECONDS_PER_HOUR * SCAN_RATE_HZ);
            println!(
                "{hour} h: {} kB at most, {} identities shown, {} used again, {} of {sent_late} scans late, {:.0} times the clock",
                peak_kb(),
                ids.track_count,
                ids.reused,
                tracker.counts().late,
                (hour * SECONDS_PER_HOUR) as f64 / tracker_s
            );
        }
    }
}

/// Counts of track IDs. IDs only increase, so a new ID that is not above all earlier IDs was reused.
#[derive(Default)]
struct TrackIds {
    highest: u64,
    last: Vec<u64>,
    track_count: u64,
    reused: u64,
}

impl TrackIds {
    fn take(&mut self, sample: &Snapshot) {
        let highest = self.highest;
        for track in &sample.tracks {
            if !self.last.contains(&track.id) {
                self.track_count += 1;
                self.reused += u64::from(track.id <= highest);
            }
            self.highest = self.highest.max(track.id);
        }
        self.last.clear();
        self.last.extend(sample.tracks.iter().map(|track| track.id));
    }
}

/// Returns the peak memory of the program in kB, including the simulation.
fn peak_kb() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.split_whitespace().next()).unwrap_or("?").to_owned()
}
