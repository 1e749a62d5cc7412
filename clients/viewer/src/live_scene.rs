//! Scene of a running hub, for `watch` and `web`. Selects the topics to subscribe to, updates the scene with samples
//! and notices, joins each scan with its foreground, and measures the CPU time of the hub.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;
use std::time::{Duration, Instant};

use scanhub_client::streams::{Join, Sample};
use scanhub_client::{clock, live_topics};
use scanhub_schema::{Foreground, Header, PublisherKind, Scan, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::TopicName;

use crate::scene::Scene;

/// Topics of every picture. The status is first, because it has the pose of the sensor. [`Topic::Lines`] costs the hub
/// CPU time while it has a subscriber, so a picture subscribes to it only while it shows lines.
pub(crate) const TOPICS: [Topic; 8] = [
    Topic::Status,
    Topic::Scan,
    Topic::Marks,
    Topic::Zones,
    Topic::Foreground,
    Topic::Background,
    Topic::Lines,
    Topic::Tracks,
];

/// Returns the topics to subscribe to for the named `sensors`, and the topics to subscribe to for every sensor. Without
/// names, the second list has all requested topics: those of sensors, and those of programs that publish. If a name
/// belongs to a program that publishes in the first live domain of `locations`, the second list has the topics of all
/// sensors, so that the picture has the sensors too.
pub(crate) fn topics_to_follow(
    sensors: &[String],
    requested: &[Topic],
    locations: &[Domain],
) -> (Vec<TopicName>, Vec<Topic>) {
    let live = live_topics(locations);
    let publisher_kind = |sensor: &str| {
        let is_live = |topic: &&Topic| live.contains(&format!("{sensor}/{}", topic.name()));
        requested.iter().find(is_live).map_or(PublisherKind::Link, |topic| topic.publisher_kind())
    };
    let named = |sensor: &String| {
        let kind = publisher_kind(sensor);
        let of = requested.iter().filter(move |topic| topic.publisher_kind() == kind);
        of.map(|topic| TopicName { sensor: sensor.clone(), topic: *topic }).collect::<Vec<_>>()
    };
    let names: Vec<_> = sensors.iter().flat_map(named).collect();
    let has_other = names.iter().any(|name| name.topic.publisher_kind() != PublisherKind::Link);
    let of_all =
        |topic: &&Topic| names.is_empty() || has_other && topic.publisher_kind() == PublisherKind::Link;
    let of_all = requested.iter().filter(of_all).copied().collect();
    (names, of_all)
}

/// Scene of a running hub.
#[derive(Default)]
pub(crate) struct LiveScene {
    pub(crate) scene: Scene,
    /// For each sensor, the scans that wait for their foreground, and the foregrounds that wait for their scan.
    joins: BTreeMap<String, Join<StampedScan, Box<Foreground>>>,
    cpu: CpuUsage,
}

type StampedScan = (Header, Box<Scan>);

/// A scan with its header, and the foreground that the hub computed from the same telegram. The scene shows a scan at
/// once, without its foreground. A trail needs the scan and the foreground.
pub(crate) type Pair = (StampedScan, Box<Foreground>);

impl LiveScene {
    /// Adds the sensor of the topic `name`, to which the caller will subscribe, if the topic belongs to a link.
    pub(crate) fn begin(&mut self, name: &TopicName) {
        if name.topic.publisher_kind() == PublisherKind::Link {
            self.scene.sensor(&name.sensor);
        }
    }

    /// Updates the scene with a `sample` of `name`. If `sample` completes a pair of scan and foreground, returns the
    /// pair.
    pub(crate) fn take(&mut self, name: &TopicName, sample: &Sample) -> Option<Pair> {
        let now_ns = clock::now_ns();
        if let Sample::Tracks(tracks) = sample {
            self.scene.take_tracks(&name.sensor, tracks, now_ns);
            return None;
        }
        let sensor = self.scene.sensor_of_sample(&name.sensor, sample.header());
        match sample {
            Sample::Scan(scan) => return self.take_scan(&name.sensor, scan.header(), scan, now_ns),
            Sample::Foreground(found) => {
                return self.take_foreground(&name.sensor, found.header(), found, now_ns);
            }
            Sample::Marks(marks) => sensor.marks = marks.is_available().then_some(**marks),
            Sample::Zones(update) => sensor.zones = update.zones,
            Sample::Background(model) => sensor.background = Some(model.boxed()),
            Sample::Lines(lines) => sensor.lines = Some(Box::new(**lines)),
            Sample::Status(status) => sensor.take_status(status),
            // The other topics are not part of any picture.
            _ => {}
        }
        None
    }

    fn take_scan(&mut self, sensor: &str, header: &Header, scan: &Scan, now_ns: u64) -> Option<Pair> {
        self.scene.sensor(sensor).take_scan(header, scan, now_ns);
        let pair = self.join(sensor).first(header, (*header, scan.boxed()), now_ns);
        self.take_pair(sensor, pair, now_ns)
    }

    fn take_foreground(
        &mut self,
        sensor: &str,
        header: &Header,
        foreground: &Foreground,
        now_ns: u64,
    ) -> Option<Pair> {
        self.scene.sensor(sensor).take_foreground(foreground);
        let pair = self.join(sensor).second(header, foreground.boxed(), now_ns);
        self.take_pair(sensor, pair, now_ns)
    }

    fn join(&mut self, sensor: &str) -> &mut Join<StampedScan, Box<Foreground>> {
        self.joins.entry(sensor.to_owned()).or_default()
    }

    fn take_pair(&mut self, sensor: &str, pair: Option<Pair>, now_ns: u64) -> Option<Pair> {
        let ((_, scan), foreground) = pair.as_ref()?;
        self.scene.sensor(sensor).take_pair(scan, foreground, now_ns);
        pair
    }

    /// Updates the scene after a notice about the streams of `names`.
    pub(crate) fn take_notice(&mut self, names: &[Rc<TopicName>], notice: &Notice) {
        match (notice, names) {
            (Notice::Missed(missed), [name]) if name.topic == Topic::Scan => {
                self.scene.sensor(&name.sensor).missed += *missed;
            }
            (Notice::NoHub(_) | Notice::HubGone, _) => {
                self.joins.clear();
                self.scene.on_hub_exit();
            }
            (Notice::HubBack, _) => self.scene.hub_is_running = true,
            _ => {}
        }
    }

    /// Deletes data that is too old. Returns whether any data was deleted.
    pub(crate) fn expire(&mut self) -> bool {
        self.scene.expire(clock::now_ns())
    }

    /// Drops scans whose foreground has not arrived in time, and foregrounds whose scan has not. Call this function
    /// after all waiting samples were taken.
    pub(crate) fn expire_joins(&mut self) {
        let now_ns = clock::now_ns();
        self.joins.values_mut().for_each(|join| join.expire(now_ns));
    }

    /// Updates the CPU time of the hub. Returns whether this value has changed.
    pub(crate) fn measure_hub(&mut self, now: Instant) -> bool {
        if self.scene.hub_pid == 0 {
            return false;
        }
        let percent = self.cpu.measure(self.scene.hub_pid, now);
        std::mem::replace(&mut self.scene.hub_percent, percent) != percent
    }
}

/// CPU time of one process over the last seconds.
#[derive(Debug, Default)]
struct CpuUsage {
    pid: u32,
    /// Time of each measurement, and the total CPU time of the process at that time, in ns.
    samples: VecDeque<(Instant, u64)>,
}

impl CpuUsage {
    /// Measures the CPU time of process `pid`, at most once a second. Returns the CPU time over the last five seconds
    /// in percent of one processor; `None` if it is unknown.
    fn measure(&mut self, pid: u32, now: Instant) -> Option<f64> {
        if self.pid != pid {
            *self = CpuUsage { pid, samples: VecDeque::new() };
        }
        if self.samples.back().is_none_or(|(at, _)| now - *at >= MEASUREMENT_INTERVAL) {
            self.samples.push_back((now, used_ns(pid)?));
            while self.samples.len() > MAX_MEASUREMENTS {
                self.samples.pop_front();
            }
        }
        let ((first, before), (last, after)) = (self.samples.front()?, self.samples.back()?);
        let span = last.duration_since(*first);
        (!span.is_zero()).then(|| 100.0 * after.saturating_sub(*before) as f64 / span.as_nanos() as f64)
    }
}

/// Returns the CPU time of process `pid` in ns: user and system time, including threads that have ended. Returns `None`
/// if the process is not accessible.
///
/// The sum over the running threads would have a finer resolution than a tick, but it decreases when a thread ends.
fn used_ns(pid: u32) -> Option<u64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name of the program is in parentheses and may contain anything. User and system time are fields 14 and 15
    // (proc(5)).
    let (_, fields) = text.rsplit_once(')')?;
    let ticks = fields.split_whitespace().skip(11).take(2).map(|field| field.parse::<u64>().ok());
    Some(ticks.sum::<Option<u64>>()? * TICK_NS)
}

/// Length of a clock tick in `/proc`: 100 per second on every Linux machine.
const TICK_NS: u64 = 10_000_000;

/// Minimum interval between measurements.
const MEASUREMENT_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of stored measurements. At one per second, the first and the last one are five seconds apart.
const MAX_MEASUREMENTS: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{ForegroundHead, ScanHead, Status};

    #[test]
    fn scan_is_shown_at_once_and_foreground_as_a_trail() {
        let mut live = LiveScene::default();
        live.scene.sensor("front").take_status(&Status::default());
        let header = |seq| Header { seq, ..Header::default() };
        let scan = Scan::of(ScanHead::lms(9, 0, 1000, 1, 13), &[1000; 9]);
        let mut found = Foreground::of(9);
        found.begin(ForegroundHead { count: 9, ..ForegroundHead::default() }).bits[0] = 0b101;
        let count = |live: &LiveScene| {
            let sensor = &live.scene.sensors[0];
            (sensor.points().count(), sensor.trail.points().count())
        };
        assert!(live.take_scan("front", &header(4), &scan, 0).is_none());
        assert_eq!(count(&live), (9, 0));
        assert!(live.take_foreground("front", &header(5), &found, 1).is_none());
        assert_eq!(count(&live), (9, 0), "the foreground is of another telegram");
        assert!(live.take_foreground("rear", &header(4), &found, 1).is_none(), "of another sensor");
        let ((joined, _), _) = live.take_scan("front", &header(5), &scan, 2).expect("a pair");
        assert_eq!((joined.seq, count(&live)), (5, (9, 2)));
        live.take_scan("front", &header(6), &scan, 3);
        live.take_notice(&[], &Notice::HubGone);
        assert!(live.take_foreground("front", &header(6), &found, 4).is_none(), "the hub has exited");
    }

    #[test]
    fn measures_cpu_usage_of_a_process() {
        let mut cpu = CpuUsage::default();
        let (me, begin) = (std::process::id(), Instant::now());
        assert_eq!(cpu.measure(me, begin), None, "one measurement has no span");
        let before = used_ns(me).unwrap();
        let mut sum = 0_u64;
        // The kernel counts in ticks, so use CPU time until the kernel has counted a tick.
        while used_ns(me).unwrap() == before && begin.elapsed() < Duration::from_secs(20) {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(cpu.measure(me, begin + MEASUREMENT_INTERVAL).unwrap() > 0.0);
        assert_eq!(cpu.measure(u32::MAX, begin), None);
    }
}
