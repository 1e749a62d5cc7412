//! `scanhub track`: people across the sensors of a site, as lines and as topics. Refuses to know how they are found.

mod late;
mod lines;
mod publish;

use std::io::Write;
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use crate::track::{Kind as EventKind, Misplaced, People, Picture, Site};
use late::LateReports;
use publish::Samples;
use scanhub_client::streams::Sample;
use scanhub_schema::{Failure, Foreground, Header, Kind, Scan, Topic};
use scanhub_shm::Domain;

use scanhub_verbs::follow::ReceiveStats;
use scanhub_verbs::follow::{Bounds, Notice, Sink, follow};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::{End, Output, quiet};
use scanhub_verbs::{json, text};

/// What `track` is asked for.
#[derive(Clone, Debug)]
pub struct TrackOptions {
    /// Sensors, rooms and doors.
    pub site: Site,
    /// The name that its topics are published under; none: it publishes nothing.
    pub name: Option<String>,
    /// Only the counts of these doors are told; none: everything.
    pub count: Vec<String>,
    /// How long a scan is waited for.
    pub delay: Duration,
    /// Lines of JSON.
    pub json: bool,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Follows people by scans and foregrounds of the site's sensors, and writes to `out` who is where, or what happens at doors;
/// what is neither to `notes` (stderr) if `out` is not JSON. Ends when the bounds are reached, `stop` is set, or nobody reads
/// any more.
///
/// # Errors
///
/// [`Kind::Configuration`] if a door is not in the site, [`Kind::NoTopic`] with the sensors that there are,
/// [`Kind::NoHub`] if bounded and there is none at the start, [`Kind::Timeout`], [`Kind::Interrupted`] if bounded and
/// `stop` came first; those of publishing if it has a name.
pub fn track(
    options: &TrackOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let doors = options.count.iter().map(|name| door(&options.site, name)).collect::<Result<Vec<_>, _>>()?;
    let topics = [Topic::Scan, Topic::Foreground];
    let names = options
        .site
        .sensors
        .iter()
        .flat_map(|sensor| topics.map(|topic| TopicName { sensor: sensor.name.clone(), topic }));
    let names: Vec<TopicName> = names.collect();
    let name = options.name.as_deref().unwrap_or(UNNAMED);
    let delay_ns = u64::try_from(options.delay.as_nanos()).unwrap_or(u64::MAX);
    let mut verb = Verb {
        options,
        people: People::new(options.site.clone(), delay_ns),
        halves: names.iter().map(|_| Half::default()).collect(),
        teller: Teller {
            options,
            name,
            counted: doors,
            passed: vec![[0; 2]; options.site.doors.len()],
            appeared: 0,
            samples: Samples::new(name),
            out: Output::new(out),
            notes: Output::new(notes),
        },
        missed: 0,
        late: LateReports::new(options.site.sensors.len()),
        is_there: false,
        flags: 0,
        summaries: names.len(),
    };
    quiet(follow(&names, &[], &options.places, &options.bounds, stop, &mut verb))
}

fn door(site: &Site, name: &str) -> Result<usize, Failure> {
    site.doors.iter().position(|door| door.name == name).ok_or_else(|| {
        let known: Vec<&str> = site.doors.iter().map(|door| door.name.as_str()).collect();
        let hint = match known.is_empty() {
            true => "the site has no [[door]]".to_owned(),
            false => format!("doors of the site: {}", known.join(", ")),
        };
        Failure::new(Kind::Configuration, format!("--count {name}: no such door"), hint)
    })
}

/// Scans of a sensor whose foregrounds have not come, and the other way round: the two come one after the other.
#[derive(Default)]
struct Half {
    scans: Vec<(Header, Box<Scan>)>,
    foregrounds: Vec<(Header, Box<Foreground>)>,
}

/// Whether both were made of the same telegram.
fn is_same(one: &Header, other: &Header) -> bool {
    (one.boot, one.seq) == (other.boot, other.seq)
}

/// What lines call a tracker that publishes nothing.
const UNNAMED: &str = "people";
/// So many wait for their other half.
const WAITING: usize = 32;

struct Verb<'a> {
    options: &'a TrackOptions,
    people: People,
    /// By the number of the sensor in the site.
    halves: Vec<Half>,
    teller: Teller<'a>,
    missed: u64,
    late: LateReports,
    /// A topic of a sensor was there.
    is_there: bool,
    /// Flags of the last scan.
    flags: u8,
    /// Topics that are not yet over.
    summaries: usize,
}

impl Sink for Verb<'_> {
    fn subscribed(&mut self, _: &TopicName) {
        self.is_there = true;
    }

    /// Reports late scans, and publishes from the moment that there is a domain.
    fn tick(&mut self, now: Instant) -> Result<(), End> {
        for (sensor, count) in self.late.due(now, self.people.late()) {
            self.teller.report_late(sensor, count)?;
        }
        let samples = &mut self.teller.samples;
        match &self.options.name {
            Some(name) if self.is_there && !samples.is_published() => {
                Ok(samples.publish(name, &self.options.places)?)
            }
            _ => Ok(()),
        }
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        let Some(sensor) = self.options.site.sensors.iter().position(|one| one.name == name.sensor) else {
            return Ok(());
        };
        let half = &mut self.halves[sensor];
        let of = match sample {
            Sample::Scan(scan) => {
                half.scans.push((*scan.header(), scan.boxed()));
                *scan.header()
            }
            Sample::Foreground(foreground) => {
                half.foregrounds.push((*foreground.header(), foreground.boxed()));
                *foreground.header()
            }
            _ => return Ok(()),
        };
        let scan = half.scans.iter().position(|(header, _)| is_same(header, &of));
        let foreground = half.foregrounds.iter().position(|(header, _)| is_same(header, &of));
        let (Some(scan), Some(foreground)) = (scan, foreground) else {
            half.scans.drain(..half.scans.len().saturating_sub(WAITING));
            half.foregrounds.drain(..half.foregrounds.len().saturating_sub(WAITING));
            return Ok(());
        };
        let (Header { wall_ns, flags, .. }, scan) = half.scans.swap_remove(scan);
        let (_, foreground) = half.foregrounds.swap_remove(foreground);
        let mut told = Ok(());
        let teller = &mut self.teller;
        self.flags = flags;
        self.people.take(sensor, wall_ns, &scan, &foreground, |picture| {
            if told.is_ok() {
                told = teller.tell(picture, flags);
            }
        });
        told
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), End> {
        if let Notice::Missed(count) = notice {
            self.missed += count;
        }
        notice.tell(names, self.options.json, &mut self.teller.out, &mut self.teller.notes)
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        self.summaries -= 1;
        if self.summaries > 0 {
            return Ok(());
        }
        let mut told = Ok(());
        let (teller, flags) = (&mut self.teller, self.flags);
        self.people.finish(|picture| {
            if told.is_ok() {
                told = teller.tell(picture, flags);
            }
        });
        told?;
        for (sensor, count) in self.late.unreported(self.people.late()) {
            teller.report_late(sensor, count)?;
        }
        teller.sum_up(&self.people, self.missed)
    }
}

/// What writes the lines.
struct Teller<'a> {
    options: &'a TrackOptions,
    /// What lines call the tracker.
    name: &'a str,
    /// Numbers of the doors whose counts alone are told; none: everything.
    counted: Vec<usize>,
    /// Who went through each door: from its `from` to its `to`, and back.
    passed: Vec<[u64; 2]>,
    appeared: u64,
    samples: Samples,
    out: Output<'a>,
    notes: Output<'a>,
}

impl Teller<'_> {
    fn tell(&mut self, picture: &Picture, flags: u8) -> Result<(), End> {
        let Teller { options, name, counted, passed, appeared, samples, out, notes } = self;
        let TrackOptions { site, json: is_json, .. } = options;
        samples.take(picture, site, flags);
        let tells_all = counted.is_empty();
        if tells_all && *is_json {
            let (header, tracks) = samples.tracks();
            out.json(&json::tracks(name, header, tracks))?;
        }
        for &Misplaced { sensor, other, off } in &picture.misplaced {
            let [sensor, other] = [sensor, other].map(|number| site.sensors[number].name.as_str());
            match is_json {
                true => out.json(&lines::misplaced(name, picture.wall_ns, sensor, other, off))?,
                false => notes.line(|line| lines::misplaced_text(line, sensor, other, off))?,
            }
        }
        for (event, (header, payload)) in picture.events.iter().zip(samples.events()) {
            match (tells_all, is_json) {
                (true, true) => out.json(&json::event(name, header, payload))?,
                (true, false) => out.line(|line| text::event_words(line, payload))?,
                (false, _) => {}
            }
            *appeared += u64::from(event.kind == EventKind::Appeared);
            let EventKind::Door { door, from, .. } = event.kind else { continue };
            passed[door][usize::from(site.doors[door].from != from)] += 1;
            if counted.contains(&door) {
                let (door, passed) = (&site.doors[door].name, passed[door]);
                match is_json {
                    true => out.json(&lines::count(name, door, passed, event.wall_ns))?,
                    false => out.line(|line| lines::count_text(line, door, passed))?,
                }
            }
        }
        Ok(())
    }

    /// Reports `count` late scans of `sensor`.
    fn report_late(&mut self, sensor: usize, count: u64) -> Result<(), End> {
        let (name, delay) = (&self.options.site.sensors[sensor].name, self.options.delay);
        match self.options.json {
            true => {
                let wall_ns = self.samples.tracks().0.wall_ns;
                self.out.json(&lines::late(self.name, wall_ns, name, count, delay))
            }
            false => self.notes.line(|line| lines::late_text(line, name, count, delay)),
        }
    }

    fn sum_up(&mut self, people: &People, missed: u64) -> Result<(), End> {
        let site = &self.options.site;
        let doors = site.doors.iter().zip(&self.passed).map(|(door, passed)| (door.name.as_str(), *passed));
        let doors: Vec<_> = doors.collect();
        let (pictures, failed) = (self.samples.pictures(), self.samples.failed());
        let sum = lines::Sum { pictures, appeared: self.appeared, counts: people.counts(), missed, failed };
        if self.options.json {
            return self.out.json(&lines::summary(self.name, &sum, &doors));
        }
        self.out.line(|line| lines::summary_text(line, &sum, &doors))
    }
}
