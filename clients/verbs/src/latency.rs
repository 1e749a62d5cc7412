//! `scanhub latency`: how old samples are when they are received here, and where they spent that time. The figures are
//! those of any consumer of the client library that waits in the same way.

mod ages;
mod grain;
mod realtime;
mod report;
mod spans;

use std::io::Write;
use std::sync::atomic::AtomicBool;
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::streams::Sample;
use scanhub_client::{Wait, clock};
use scanhub_schema::{Failure, Flags, Kind};
use scanhub_shm::Domain;

use crate::follow::{Arrival, Bounds, Event, Following, Notice};
use crate::names::TopicName;
use crate::output::{End, Output, quiet};
use crate::receive_stats::ReceiveStats;
use crate::{json, text};
use realtime::Realtime;
use report::{Conditions, NOTHING_CAME, why_nothing};
use spans::{Span, Spans};

/// What `latency` is asked for.
#[derive(Clone, Debug)]
pub struct LatencyOptions {
    /// `SENSOR/TOPIC`, at least one.
    pub topics: Vec<String>,
    /// Objects instead of text.
    pub json: bool,
    /// Somebody looks at the text: bars beside the numbers.
    pub terminal: bool,
    /// How it waits for samples.
    pub wait: Wait,
    /// Real-time priority and locked memory if they are permitted; the calling thread and its process keep them.
    pub realtime: bool,
    /// The greatest age on arrival that 99 of 100 samples of each topic may have.
    pub max_p99: Option<Duration>,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Writes the conditions, a line per topic and second, and at the end what came of each topic, to `out`; conditions and
/// notices to `notes` (stderr) if `out` is not JSON. Each line is of the whole run so far.
///
/// [`Kind::Check`] if a topic is older than `max_p99` permits, or its age is not known; else as [`echo`](crate::echo()).
pub fn latency(
    options: &LatencyOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let mut names: Vec<TopicName> = Vec::new();
    for text in &options.topics {
        let name = TopicName::parse(text)?;
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let mut latency = Latency {
        json: options.json,
        terminal: options.terminal,
        topics: names.iter().map(|name| (name.clone(), Spans::new())).collect(),
        next: Instant::now() + EVERY,
        out: Output::new(out),
        notes: Output::new(notes),
    };
    let processors = thread::available_parallelism().map_or(1, usize::from);
    let realtime =
        if options.realtime { Realtime::take(options.wait, processors) } else { Realtime::default() };
    let conditions = Conditions::new(options.wait, &realtime, grain::grain());
    let told = latency.tell(&conditions);
    let following = Following::new(&names, &[], &options.places, &options.bounds, stop);
    let mut following = following.closely(options.wait);
    let end = told.and_then(|()| {
        let end = latency.run(&mut following);
        following.finish(end, |name, stats| latency.summary(name, stats))
    });
    quiet(end.and_then(|()| options.max_p99.map_or(Ok(()), |limit| Ok(latency.judge(limit)?))))
}

const EVERY: Duration = Duration::from_secs(1);

struct Latency<'a> {
    json: bool,
    terminal: bool,
    topics: Vec<(TopicName, Spans)>,
    next: Instant,
    out: Output<'a>,
    notes: Output<'a>,
}

impl Latency<'_> {
    fn tell(&mut self, conditions: &Conditions<'_>) -> Result<(), End> {
        if self.json { self.out.json(conditions) } else { conditions.text(&mut self.notes) }
    }

    fn judge(&self, limit: Duration) -> Result<(), Failure> {
        for (name, spans) in &self.topics {
            let Some(age) = spans.ages(Span::Age).quantiles() else {
                if spans.received == 0 {
                    let (what, hint) = (format!("{name}: {NOTHING_CAME}"), why_nothing(name));
                    return Err(Failure::new(Kind::Check, what, hint));
                }
                let what = format!("{name}: no sample with a known age arrived");
                return Err(Failure::new(Kind::Check, what, "measure for longer: --for 10s"));
            };
            let p99 = Duration::from_nanos(age.p99_ns);
            if p99 > limit {
                let what = format!("{name}: p99 of the age on arrival is {p99:?}, more than {limit:?}");
                let hint = if spans.flags & Flags::REMOTE != 0 {
                    "of a remote sensor it is the time from the datagram's arrival until it was received here: see what else \
                     runs on this machine; `network` is the time before that"
                } else {
                    "hub and wake show where the time goes"
                };
                return Err(Failure::new(Kind::Check, what, hint));
            }
        }
        Ok(())
    }

    fn run(&mut self, following: &mut Following<'_>) -> Result<(), End> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Subscribed(name) => {
                    if let Some(spans) = self.spans(&name) {
                        spans.begin(clock::now_ns());
                    }
                }
                Event::Sample(name, sample, arrival) => self.sample(&name, &sample, arrival),
                Event::Notice(names, notice) => {
                    if notice == Notice::HubBack {
                        // Samples that the new hub sent before this moment waited for the verb.
                        let now_ns = clock::now_ns();
                        self.topics.iter_mut().for_each(|(_, spans)| spans.begin(now_ns));
                    }
                    notice.tell(&names, self.json, &mut self.out, &mut self.notes)?;
                }
                Event::Tick(now) => self.tick(now)?,
                Event::Begun(_) | Event::Short(..) | Event::Line(..) => {}
            }
        }
        Ok(())
    }

    fn spans(&mut self, name: &TopicName) -> Option<&mut Spans> {
        self.topics.iter_mut().find(|(known, _)| known == name).map(|(_, spans)| spans)
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample, arrival: Arrival) {
        if let (Some(header), Some(spans)) = (sample.header(), self.spans(name)) {
            spans.take(header, arrival);
        }
    }

    fn tick(&mut self, now: Instant) -> Result<(), End> {
        if now < self.next {
            return Ok(());
        }
        while self.next <= now {
            self.next += EVERY;
        }
        for (name, spans) in &self.topics {
            if self.json {
                self.out.json(&report::json(name, spans))?;
            } else {
                self.out.line(|line| report::brief(line, name, spans))?;
            }
        }
        Ok(())
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), End> {
        let Some((_, spans)) = self.topics.iter().find(|(known, _)| known == name) else { return Ok(()) };
        if self.json {
            self.out.json(&report::json(name, spans))?;
            return self.out.json(&json::summary(name, stats));
        }
        self.out.line(|line| text::summary(line, name, stats))?;
        report::full(&mut self.out, name, spans, self.terminal)
    }
}
