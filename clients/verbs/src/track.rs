//! `scanhub track`: people across the sensors of a site, as lines. Refuses to know how they are found.

mod lines;

use std::io::Write;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use ::track::{Kind as EventKind, People, Picture, Site};
use scanhub_client::streams::Sample;
use schema::{Domain, Failure, Foreground, Kind, Scan, Topic};

use crate::follow::{Bounds, Notice, Sink, follow};
use crate::names::TopicName;
use crate::output::{End, Output, quiet};
use crate::receive_stats::ReceiveStats;
use crate::{json, text};

/// What `track` is asked for.
#[derive(Clone, Debug)]
pub struct TrackOptions {
    /// Sensors, rooms and doors.
    pub site: Site,
    /// The name that lines call the tracker by.
    pub name: String,
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
/// `stop` came first.
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
    let delay_ns = u64::try_from(options.delay.as_nanos()).unwrap_or(u64::MAX);
    let mut verb = Verb {
        options,
        people: People::new(options.site.clone(), delay_ns),
        halves: names.iter().map(|_| Half::default()).collect(),
        teller: Teller {
            options,
            counted: doors,
            passed: vec![[0; 2]; options.site.doors.len()],
            pictures: 0,
            appeared: 0,
            out: Output::new(out),
        },
        notes: Output::new(notes),
        missed: 0,
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
    scans: Vec<(u64, u64, Box<Scan>)>,
    foregrounds: Vec<(u64, Box<Foreground>)>,
}

/// So many wait for their other half.
const WAITING: usize = 32;

struct Verb<'a> {
    options: &'a TrackOptions,
    people: People,
    /// By the number of the sensor in the site.
    halves: Vec<Half>,
    teller: Teller<'a>,
    notes: Output<'a>,
    missed: u64,
    /// Topics that are not yet over.
    summaries: usize,
}

impl Sink for Verb<'_> {
    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        let Some(sensor) = self.options.site.sensors.iter().position(|one| one.name == name.sensor) else {
            return Ok(());
        };
        let half = &mut self.halves[sensor];
        let seq = match sample {
            Sample::Scan(scan) => {
                let header = scan.header();
                half.scans.push((header.seq, header.wall_ns, scan.boxed()));
                header.seq
            }
            Sample::Foreground(foreground) => {
                half.foregrounds.push((foreground.header().seq, foreground.boxed()));
                foreground.header().seq
            }
            _ => return Ok(()),
        };
        let scan = half.scans.iter().position(|(of, ..)| *of == seq);
        let foreground = half.foregrounds.iter().position(|(of, _)| *of == seq);
        let (Some(scan), Some(foreground)) = (scan, foreground) else {
            half.scans.drain(..half.scans.len().saturating_sub(WAITING));
            half.foregrounds.drain(..half.foregrounds.len().saturating_sub(WAITING));
            return Ok(());
        };
        let (_, wall_ns, scan) = half.scans.swap_remove(scan);
        let (_, foreground) = half.foregrounds.swap_remove(foreground);
        let mut told = Ok(());
        let teller = &mut self.teller;
        self.people.take(sensor, wall_ns, &scan, &foreground, |picture| {
            if told.is_ok() {
                told = teller.tell(picture);
            }
        });
        told
    }

    fn notice(&mut self, names: &[&TopicName], notice: Notice) -> Result<(), End> {
        if let Notice::Missed(count) = notice {
            self.missed += count;
        }
        match self.options.json {
            true => json::notices(&mut self.teller.out, names, notice),
            false => self.notes.line(|line| text::notice(line, names, notice)),
        }
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        self.summaries -= 1;
        if self.summaries > 0 {
            return Ok(());
        }
        let mut told = Ok(());
        let teller = &mut self.teller;
        self.people.finish(|picture| {
            if told.is_ok() {
                told = teller.tell(picture);
            }
        });
        told?;
        teller.sum_up(&self.people, self.missed)
    }
}

/// What writes the lines.
struct Teller<'a> {
    options: &'a TrackOptions,
    /// Numbers of the doors whose counts alone are told; none: everything.
    counted: Vec<usize>,
    /// Who went through each door: from its `from` to its `to`, and back.
    passed: Vec<[u64; 2]>,
    pictures: u64,
    appeared: u64,
    out: Output<'a>,
}

impl Teller<'_> {
    fn tell(&mut self, picture: &Picture) -> Result<(), End> {
        let (site, name) = (&self.options.site, self.options.name.as_str());
        if self.counted.is_empty() && self.options.json {
            self.out.json(&lines::tracks(site, name, self.pictures, picture))?;
        }
        self.pictures += 1;
        for event in &picture.events {
            let mut passed_door = None;
            match event.kind {
                EventKind::Appeared => self.appeared += 1,
                EventKind::Left => {}
                EventKind::Door { door, from, .. } => {
                    let back = usize::from(site.doors[door].from != from);
                    self.passed[door][back] += 1;
                    passed_door = Some(door);
                }
            }
            match (self.counted.is_empty(), passed_door) {
                (true, _) if self.options.json => self.out.json(&lines::event(site, name, event))?,
                (true, _) => self.out.line(|line| lines::event_text(line, site, event))?,
                (false, Some(door)) if self.counted.contains(&door) => {
                    let (door, passed) = (&site.doors[door].name, self.passed[door]);
                    match self.options.json {
                        true => self.out.json(&lines::count(name, door, passed, event.wall_ns))?,
                        false => self.out.line(|line| lines::count_text(line, door, passed))?,
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn sum_up(&mut self, people: &People, missed: u64) -> Result<(), End> {
        let site = &self.options.site;
        let doors = site.doors.iter().zip(&self.passed).map(|(door, passed)| (door.name.as_str(), *passed));
        let doors: Vec<_> = doors.collect();
        let counts = people.counts();
        let (name, json) = (self.options.name.as_str(), self.options.json);
        let sum = lines::Sum { pictures: self.pictures, appeared: self.appeared, counts, missed };
        if json {
            return self.out.json(&lines::summary(name, &sum, &doors));
        }
        self.out.line(|line| lines::summary_text(line, &sum, &doors))
    }
}
