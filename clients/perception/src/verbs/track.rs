//! `scanhub track`: tracks people with the sensors of a site, and prints and publishes tracks and events.

use std::io::{self, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::clock;
use scanhub_client::streams::{Join, Sample};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Event, Failure, Foreground, Header, Kind, Scan, Topic, Tracks, WakeEvent};
use scanhub_shm::Domain;
use scanhub_verbs::context::Context;
use scanhub_verbs::follow::{self, RunLimits, TopicRun};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::{ExitReason, verb_result};
use scanhub_verbs::{duration, json, text};
use serde::{Serialize, Serializer};

use super::own_name;
use super::results::{Results, Topics};
use crate::track::{self, Counts, MisplacedSensor, PeopleTracker, SNAPSHOT_INTERVAL_NS, Site, Snapshot};

/// Track people across the sensors and rooms of a site, and count them at doors
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLES)]
pub struct TrackArgs {
    /// Site file with sensors, rooms and doors
    #[arg(long, value_name = "FILE")]
    site: PathBuf,
    /// Also publish the topics NAME/tracks and NAME/events. NAME must not be in use
    #[arg(long = "as", value_name = "NAME", value_parser = own_name)]
    name: Option<String>,
    /// Print only how many people went through this door in each direction, whenever someone does. Can be repeated
    #[arg(long, value_name = "DOOR")]
    count: Vec<String>,
    /// Time to wait for a scan of one sensor after a later scan of another sensor has arrived
    #[arg(long, default_value = "80ms", value_name = "DURATION", value_parser = duration::parse)]
    delay: Duration,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Exit with code 3 if no scan arrives for this time
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    timeout: Option<Duration>,
}

const EXAMPLES: &str = "\
Examples:
  scanhub track --site house.toml
  scanhub track --site house.toml --count left";

impl TrackArgs {
    /// Subscribes to the scans and foregrounds of the site's sensors, and writes tracks and events to stdout, or only
    /// the counts of some doors. Without `--json`, notices go to stderr. Ends at a limit of the arguments, by a signal,
    /// or when the reader closes stdout.
    ///
    /// # Errors
    ///
    /// - The errors of [`Site::read`].
    /// - [`Kind::Configuration`] if the site does not have a given door.
    /// - [`Kind::NoTopic`] if a sensor does not exist; the message lists the sensors.
    /// - [`Kind::NoHub`] if the run is bounded and no hub runs at its start.
    /// - [`Kind::Timeout`] if no scan arrives in time.
    /// - [`Kind::Interrupted`] if a signal stops a bounded run before its end.
    /// - The errors of [`PublishSession::open_named`](scanhub_client::PublishSession::open_named) if the run publishes.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let site = Site::read(&self.site)?;
        let counted = self.count.iter().map(|name| door(&site, name)).collect::<Result<_, _>>()?;
        let topics = |sensor: &track::site::Sensor| {
            [Topic::Scan, Topic::Foreground].map(|topic| TopicName { sensor: sensor.name.clone(), topic })
        };
        let names: Vec<TopicName> = site.sensors.iter().flat_map(topics).collect();
        let limits = RunLimits { count: None, run_for: self.run_for, timeout: self.timeout };
        let name = self.name.as_deref().unwrap_or(DEFAULT_NAME);
        let mut results = Results::new(name, context.json, &mut context.out, &mut context.notes);
        results.header.period_us = (SNAPSHOT_INTERVAL_NS / 1000) as u32;
        let mut run = TrackRun {
            args: self,
            locations: &locations,
            tracker: PeopleTracker::new(
                site.clone(),
                u64::try_from(self.delay.as_nanos()).unwrap_or(u64::MAX),
            ),
            joins: site.sensors.iter().map(|_| Join::default()).collect(),
            late: LateReports::new(site.sensors.len()),
            is_subscribed: false,
            writer: SnapshotWriter {
                counted,
                passages: vec![[0; 2]; site.doors.len()],
                appeared: 0,
                tracks: Box::default(),
                samples: [0; 2],
                site,
                results,
            },
        };
        verb_result(run.follow(&mut TopicRun::new(&names, &[], &locations, &limits, &stop)))
    }
}

/// Returns the index of the door `name`.
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

/// Name in the lines of a tracker that does not publish.
const DEFAULT_NAME: &str = "people";

type StampedScan = (Header, Box<Scan>);

struct TrackRun<'a> {
    args: &'a TrackArgs,
    locations: &'a [Domain],
    tracker: PeopleTracker,
    /// Scans and foregrounds of each sensor of the site. A scan and a foreground with the same `seq` are joined.
    joins: Vec<Join<StampedScan, Box<Foreground>>>,
    late: LateReports,
    /// Whether the run has subscribed to a topic of a sensor.
    is_subscribed: bool,
    writer: SnapshotWriter<'a>,
}

impl TrackRun<'_> {
    fn follow(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        let end = self.take_events(following);
        if !matches!(end, Err(ExitReason::ReaderClosed)) {
            self.sum_up()?;
        }
        end
    }

    fn take_events(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                follow::Event::Subscribed(_) => self.is_subscribed = true,
                follow::Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                follow::Event::Notice(names, notice) => self.writer.results.notice(&names, &notice)?,
                follow::Event::Tick(now) => {
                    if following.is_caught_up() {
                        let now_ns = clock::now_ns();
                        self.joins.iter_mut().for_each(|join| join.expire(now_ns));
                    }
                    self.tick(now)?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Reports late scans, and creates the topics if the run publishes and has subscribed to a topic.
    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        for (sensor, count) in self.late.due(now, self.tracker.late()) {
            self.writer.report_late(sensor, count, self.args.delay)?;
        }
        let results = &mut self.writer.results;
        if self.args.name.is_some() && self.is_subscribed && results.topics.is_none() {
            results.publish(TopicLimits::default(), self.locations)?;
        }
        Ok(())
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), ExitReason> {
        let sensors = &self.tracker.site().sensors;
        let Some(sensor) = sensors.iter().position(|one| one.name == name.sensor) else { return Ok(()) };
        let (join, now_ns) = (&mut self.joins[sensor], clock::now_ns());
        let pair = match sample {
            Sample::Scan(scan) => join.first(scan.header(), (*scan.header(), scan.boxed()), now_ns),
            Sample::Foreground(found) => join.second(found.header(), found.boxed(), now_ns),
            _ => None,
        };
        let Some(((header, scan), foreground)) = pair else { return Ok(()) };
        self.writer.results.take_flags(&header);
        let mut written = Ok(());
        self.tracker.take(sensor, header.wall_ns, &scan, &foreground, |snapshot| {
            if written.is_ok() {
                written = self.writer.write(snapshot);
            }
        });
        written
    }

    fn sum_up(&mut self) -> Result<(), ExitReason> {
        let writer = &mut self.writer;
        let mut written = Ok(());
        self.tracker.finish(|snapshot| {
            if written.is_ok() {
                written = writer.write(snapshot);
            }
        });
        written?;
        for (sensor, count) in self.late.unreported(self.tracker.late()) {
            writer.report_late(sensor, count, self.args.delay)?;
        }
        writer.sum_up(self.tracker.counts())
    }
}

/// Writer and publisher of snapshots.
struct SnapshotWriter<'a> {
    site: Site,
    /// Indexes of the doors whose counts are printed. If there are none, all tracks and events are printed.
    counted: Vec<usize>,
    /// For each door, the number of people who went from `from` to `to`, and the number of people who went back.
    passages: Vec<[u64; 2]>,
    appeared: u64,
    /// Tracks of the last snapshot.
    tracks: Box<Tracks>,
    /// Number of published samples of topic `tracks`, and of topic `events`.
    samples: [u64; 2],
    results: Results<'a, Tracks, Event>,
}

impl SnapshotWriter<'_> {
    fn write(&mut self, snapshot: &Snapshot) -> Result<(), ExitReason> {
        let events = self.publish(snapshot);
        let SnapshotWriter { site, counted, passages: passed, appeared, tracks, results, .. } = self;
        let (name, prints_all) = (results.name, counted.is_empty());
        // Positions of all people would be too much text, so print them only as JSON.
        if prints_all && results.is_json {
            let header = results.header;
            results.result(&json::tracks(name, &header, tracks), |_| Ok(()))?;
        }
        for &MisplacedSensor { sensor, other, offset: [dx_m, dy_m] } in &snapshot.misplaced {
            let [sensor, other] = [sensor, other].map(|number| site.sensors[number].name.as_str());
            let line = TrackJson::Misplaced {
                sensor: name,
                wall_ns: snapshot.wall_ns,
                name: sensor,
                other,
                dx_m,
                dy_m,
            };
            results.note(&line, |out| line.text(out))?;
        }
        for (event, (header, payload)) in snapshot.events.iter().zip(&events) {
            if prints_all {
                results.result(&json::event(name, header, payload), |out| text::event_text(out, payload))?;
            }
            *appeared += u64::from(event.kind == track::Kind::Appeared);
            let track::Kind::Door { door, from, .. } = event.kind else { continue };
            passed[door][usize::from(site.doors[door].from != from)] += 1;
            if counted.contains(&door) {
                let door = PassageCounts::of(&site.doors[door].name, passed[door]);
                let line = TrackJson::Count { sensor: name, wall_ns: event.wall_ns, door };
                results.result(&line, |out| line.text(out))?;
            }
        }
        Ok(())
    }

    /// Publishes a snapshot if the topics exist. Returns its events with their headers.
    fn publish(&mut self, snapshot: &Snapshot) -> Vec<(Header, Event)> {
        let SnapshotWriter { site, tracks, samples: [snapshots, events], results, .. } = self;
        let now_ns = clock::now_ns();
        let header = Header {
            seq: *snapshots,
            topic_seq: *snapshots,
            stamp_first_ns: now_ns,
            stamp_last_ns: now_ns,
            wall_ns: snapshot.wall_ns,
            ..results.header
        };
        results.header = header;
        **tracks = snapshot.payload(site);
        let numbered = snapshot.events.iter().zip(*events..).map(|(event, topic_seq)| {
            (Header { topic_seq, wall_ns: event.wall_ns, ..header }, event.payload(site))
        });
        let numbered: Vec<_> = numbered.collect();
        *snapshots += 1;
        *events += numbered.len() as u64;
        if let Some(Topics { publications, sensor }) = &mut results.topics {
            // Ignore errors. Subscribers detect a missing sample by the gap in the sequence numbers, and poll if they
            // cannot be woken.
            for (header, event) in &numbered {
                let _ = publications.1.send_with(header, |sample| *sample = *event);
            }
            let _ = publications.0.send_with(&header, |sample| *sample = **tracks);
            let _ = sensor.wake(WakeEvent::Telegram);
        }
        numbered
    }

    /// Reports `late` late scans of a sensor.
    fn report_late(&mut self, sensor: usize, late: u64, delay: Duration) -> Result<(), ExitReason> {
        let (sensor, name) = (self.results.name, &self.site.sensors[sensor].name);
        let line = TrackJson::Late { sensor, wall_ns: self.results.header.wall_ns, name, late, delay };
        self.results.note(&line, |out| line.text(out))
    }

    fn sum_up(&mut self, counts: Counts) -> Result<(), ExitReason> {
        let doors = self.site.doors.iter().zip(&self.passages);
        let line = TrackJson::Summary {
            sensor: self.results.name,
            samples: self.samples[0],
            appeared: self.appeared,
            doors: doors.map(|(door, &passed)| PassageCounts::of(&door.name, passed)).collect(),
            counts,
            missed: self.results.missed,
            failed: self.results.failed(),
        };
        self.results.result(&line, |out| line.text(out))
    }
}

/// Lines that only `track` writes. The variant determines the class.
#[derive(Serialize)]
#[serde(tag = "class", rename_all = "snake_case")]
enum TrackJson<'a> {
    Count {
        sensor: &'a str,
        wall_ns: u64,
        #[serde(flatten)]
        door: PassageCounts<'a>,
    },
    Misplaced {
        sensor: &'a str,
        wall_ns: u64,
        name: &'a str,
        other: &'a str,
        #[serde(serialize_with = "hundredths")]
        dx_m: f64,
        #[serde(serialize_with = "hundredths")]
        dy_m: f64,
    },
    Late {
        sensor: &'a str,
        wall_ns: u64,
        name: &'a str,
        late: u64,
        #[serde(rename = "delay_ms", serialize_with = "milliseconds")]
        delay: Duration,
    },
    Summary {
        sensor: &'a str,
        samples: u64,
        appeared: u64,
        doors: Vec<PassageCounts<'a>>,
        #[serde(flatten)]
        counts: Counts,
        missed: u64,
        /// Number of samples that were not published because memory was short.
        failed: u64,
    },
}

/// Number of people who went through a door from `from` to `to`, and number of people who went back.
#[derive(Clone, Copy, Serialize)]
struct PassageCounts<'a> {
    door: &'a str,
    forth: u64,
    back: u64,
}

impl<'a> PassageCounts<'a> {
    fn of(door: &'a str, [forth, back]: [u64; 2]) -> PassageCounts<'a> {
        PassageCounts { door, forth, back }
    }

    fn text(&self, out: &mut Vec<u8>) -> io::Result<()> {
        write!(out, "{}: {} forth, {} back", self.door, self.forth, self.back)
    }
}

impl TrackJson<'_> {
    fn text(&self, out: &mut Vec<u8>) -> io::Result<()> {
        match self {
            TrackJson::Count { door, .. } => door.text(out),
            TrackJson::Misplaced { name, other, dx_m, dy_m, .. } => write!(
                out,
                "{name} sees people ({dx_m:.2}, {dy_m:.2}) m away from where {other} sees them: \
                 correct one of their poses in the site file; until then, the pose of {name} is corrected to fit {other}"
            ),
            TrackJson::Late { name, late, delay, .. } => {
                match late {
                    1 => write!(out, "{name}: 1 scan was dropped because it arrived late")?,
                    _ => write!(out, "{name}: {late} scans were dropped because they arrived late")?,
                }
                write!(out, ": set --delay longer than {delay:?}")
            }
            TrackJson::Summary { appeared, doors, counts, missed, failed, .. } => {
                let Counts { scans, late, jumped, invalid } = counts;
                write!(out, "{appeared} people appeared in {scans} scans")?;
                for door in doors {
                    write!(out, "; ")?;
                    door.text(out)?;
                }
                write!(out, "; dropped: {late} late, {jumped} jumped, {invalid} invalid, {missed} missed")?;
                if *failed > 0 { write!(out, "; {failed} not published: no memory") } else { Ok(()) }
            }
        }
    }
}

fn hundredths<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64((100.0 * value).round() / 100.0)
}

fn milliseconds<S: Serializer>(value: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u64(u64::try_from(value.as_millis()).unwrap_or(u64::MAX))
}

/// Minimum time between two reports of late scans. The first report is sent at once.
const LATE_REPORT_INTERVAL: Duration = Duration::from_secs(5);

/// Limits how often late scans are reported.
struct LateReports {
    /// Number of reported late scans of each sensor.
    reported: Vec<u64>,
    /// Earliest time of the next report; `None` before the first one.
    next: Option<Instant>,
}

impl LateReports {
    fn new(sensors: usize) -> LateReports {
        LateReports { reported: vec![0; sensors], next: None }
    }

    /// If a report is due, returns the index of each sensor with late scans, and the number of its late scans since the
    /// last report. `late` has the number of late scans of every sensor since the start.
    fn due(&mut self, now: Instant, late: &[u64]) -> Vec<(usize, u64)> {
        if late == self.reported || self.next.is_some_and(|next| now < next) {
            return Vec::new();
        }
        self.next = Some(now + LATE_REPORT_INTERVAL);
        self.unreported(late)
    }

    /// Returns the same values as [`due`](Self::due), even if no report is due. Used at the end of a run.
    fn unreported(&mut self, late: &[u64]) -> Vec<(usize, u64)> {
        let since = late.iter().zip(&self.reported).map(|(late, reported)| late - reported).enumerate();
        let since = since.filter(|&(_, count)| count > 0).collect();
        self.reported.copy_from_slice(late);
        since
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_scans_are_reported_at_most_every_5_seconds() {
        let begin = Instant::now();
        let mut reports = LateReports::new(3);
        let mut due = |after_s: u64, late: [u64; 3]| reports.due(begin + Duration::from_secs(after_s), &late);
        assert_eq!(due(0, [0, 0, 0]), []);
        assert_eq!(due(1, [0, 1, 0]), [(1, 1)]);
        assert_eq!(due(5, [0, 40, 2]), []);
        assert_eq!(due(6, [0, 41, 2]), [(1, 40), (2, 2)]);
        assert_eq!(due(60, [0, 41, 2]), []);
        assert_eq!(due(61, [0, 42, 2]), [(1, 1)]);
        assert_eq!(due(62, [7, 42, 2]), []);
        assert_eq!(reports.unreported(&[7, 42, 3]), [(0, 7), (2, 1)]);
        assert_eq!(reports.unreported(&[7, 42, 3]), []);
    }
}
