//! `scanhub latency`: measures the age of samples on arrival, split into spans. Other programs get the same results if
//! they use the client library with the same method of waiting.

mod spans;

use std::io::{self, Write};
use std::thread;
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::time::{ClockId, Timespec, clock_getres};
use scanhub_client::streams::Sample;
use scanhub_client::{Wait, clock};
use scanhub_schema::{Failure, Flags, Kind};
use serde::Serialize;
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use self::spans::{Quantiles, Span, Spans};
use crate::context::Context;
use crate::follow::{Arrival, Event, Notice, RunLimits, TopicRun};
use crate::names::TopicName;
use crate::output::{ExitReason, Output, table, verb_result};
use crate::receive_stats::ReceiveStats;
use crate::{duration, json, text};

/// Measure the age of samples on arrival, as percentiles of line, hub and wake-up
#[derive(Args, Clone, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct LatencyArgs {
    /// Topics to measure, for example front/scan, rear/telegram or robot1.front/zones
    #[arg(required = true, value_name = "SENSOR/TOPIC")]
    topics: Vec<String>,
    /// Maximum age on arrival, for example 1ms. The exit code is 5 if more than 1 in 100 samples of a topic is older
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    max_p99: Option<Duration>,
    /// Method of waiting for samples
    #[arg(long, value_enum, default_value = "doorbell")]
    wait: WaitMethod,
    /// Do not request real-time priority and locked memory
    #[arg(long)]
    no_realtime: bool,
    #[command(flatten)]
    limits: RunLimits,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum WaitMethod {
    /// Sleep on a word in shared memory. One call of the hub wakes all subscribers
    Doorbell,
    /// Sleep on the library's event service. The hub sends one message to each subscriber
    Event,
    /// Poll without sleeping, which uses a whole CPU
    Spin,
}

const AFTER_HELP: &str = "\
Example:
  scanhub latency front/scan --for 10s --max-p99 1ms

Times of a sample:
  line     from the telegram's first byte to its last byte
  hub      from the last byte until the hub sent the sample
  wake     from then until this program received the sample
  age      hub and wake together, which --max-p99 checks
  total    line, hub and wake together
  network  from a remote sensor's first byte to the arrival on this machine, by the wall clocks of both machines.
           For a remote sensor, age starts at the arrival, and total is network and age together

To check a hundred scans: scanhub latency front/scan -n 100 --timeout 5s --max-p99 1ms";

/// Interval between two lines of a topic.
const LINE_INTERVAL: Duration = Duration::from_secs(1);

impl LatencyArgs {
    /// Writes the conditions, a line for each topic once a second, and the result of each topic at the end. Each line
    /// covers the time since the start of the run. Without `--json`, conditions and notices go to stderr. On a
    /// terminal, the result includes bars.
    ///
    /// # Errors
    ///
    /// - [`Kind::Check`] if the age of a topic exceeds `--max-p99`, or is unknown.
    /// - The errors of [`echo`](crate::echo::EchoArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let mut names: Vec<TopicName> = Vec::new();
        for text in &self.topics {
            let name = TopicName::parse(text)?;
            if !names.contains(&name) {
                names.push(name);
            }
        }
        let wait = match self.wait {
            WaitMethod::Doorbell => Wait::Doorbell,
            WaitMethod::Event => Wait::Event,
            WaitMethod::Spin => Wait::Spin,
        };
        let mut latency = Latency {
            is_json: context.json,
            is_terminal: context.is_terminal,
            topics: names.iter().map(|name| (name.clone(), Spans::new())).collect(),
            next: Instant::now() + LINE_INTERVAL,
            out: Output::new(&mut context.out),
            notes: Output::new(&mut context.notes),
        };
        let written = latency.conditions(&Conditions::take(wait, !self.no_realtime));
        let mut following = TopicRun::new(&names, &[], &locations, &self.limits, &stop).receiving_first(wait);
        let end = written.and_then(|()| {
            let end = latency.run(&mut following);
            following.finish(end, |name, stats| latency.summary(name, stats))
        });
        verb_result(end.and_then(|()| self.max_p99.map_or(Ok(()), |limit| Ok(latency.check(limit)?))))
    }
}

struct Latency<'a> {
    is_json: bool,
    is_terminal: bool,
    topics: Vec<(TopicName, Spans)>,
    next: Instant,
    out: Output<'a>,
    notes: Output<'a>,
}

impl Latency<'_> {
    fn conditions(&mut self, conditions: &Conditions) -> Result<(), ExitReason> {
        if self.is_json { self.out.json(conditions) } else { conditions.text(&mut self.notes) }
    }

    fn check(&self, limit: Duration) -> Result<(), Failure> {
        for (name, spans) in &self.topics {
            let Some(age) = spans.ages(Span::Age).quantiles() else {
                if spans.received == 0 {
                    let (what, hint) = (format!("{name}: {NO_SAMPLES}"), no_samples_reason(name));
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

    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
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
                        // Samples that the new hub sent earlier have waited for this process.
                        let now_ns = clock::now_ns();
                        self.topics.iter_mut().for_each(|(_, spans)| spans.begin(now_ns));
                    }
                    notice.report(&names, self.is_json, &mut self.out, &mut self.notes)?;
                }
                Event::Tick(now) => self.tick(now)?,
                Event::Added(_) | Event::ResourceExhausted(..) | Event::Line(..) => {}
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

    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        if now < self.next {
            return Ok(());
        }
        while self.next <= now {
            self.next += LINE_INTERVAL;
        }
        for (name, spans) in &self.topics {
            if self.is_json {
                self.out.json(&result(name, spans))?;
            } else {
                self.out.line(|line| brief(line, name, spans))?;
            }
        }
        Ok(())
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), ExitReason> {
        let Some((_, spans)) = self.topics.iter().find(|(known, _)| known == name) else { return Ok(()) };
        if self.is_json {
            self.out.json(&result(name, spans))?;
            return self.out.json(&json::summary(name, stats));
        }
        self.out.line(|line| text::summary(line, name, stats))?;
        full(&mut self.out, name, spans, self.is_terminal)
    }
}

/// Returns the line of class `latency`. A span whose time is unknown is null. The keys are a contract: keys may be
/// added, but never changed.
fn result<'a>(name: &'a TopicName, spans: &Spans) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct LatencyJson<'a> {
        class: &'static str,
        sensor: &'a str,
        topic: &'static str,
        received: u64,
        before: u64,
        in_future: u64,
        flags: Vec<&'static str>,
        age: Option<Quantiles>,
        line: Option<Quantiles>,
        hub: Option<Quantiles>,
        wake: Option<Quantiles>,
        total: Option<Quantiles>,
        network: Option<Quantiles>,
    }
    let of = |span| spans.ages(span).quantiles();
    LatencyJson {
        class: "latency",
        sensor: &name.sensor,
        topic: name.topic.name(),
        received: spans.received,
        before: spans.before,
        in_future: spans.in_future,
        flags: Flags::names(spans.flags).collect(),
        age: of(Span::Age),
        line: of(Span::Line),
        hub: of(Span::Hub),
        wake: of(Span::Wake),
        total: of(Span::Total),
        network: of(Span::Network),
    }
}

/// Writes one line with the ages of a topic since the start of the run.
fn brief(line: &mut Vec<u8>, name: &TopicName, spans: &Spans) -> io::Result<()> {
    let topic = name.to_string();
    match spans.ages(Span::Age).quantiles() {
        Some(age) => write!(
            line,
            "{topic:<16} {:>7} age p50 {:>9} p99 {:>9} max {:>9} us",
            age.count,
            us(age.p50_ns),
            us(age.p99_ns),
            us(age.max_ns)
        ),
        None if spans.received == 0 => {
            write!(line, "{topic:<16}       - age, {NO_SAMPLES}; {}", no_samples_reason(name))
        }
        None => write!(line, "{topic:<16}       - age, {} received", spans.received),
    }
}

/// Writes the result of a topic: a row for each span with known times, and the ages as bars if `has_bars` is set.
fn full(out: &mut Output<'_>, name: &TopicName, spans: &Spans, has_bars: bool) -> Result<(), ExitReason> {
    let heads = ["us", "count", "min", "p50", "p90", "p99", "p99.9", "max"].map(str::to_owned).to_vec();
    let row = |span: Span| {
        let Quantiles { count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns } =
            spans.ages(span).quantiles()?;
        let times = [min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns].map(us);
        Some([vec![span.name().to_owned(), count.to_string()], times.to_vec()].concat())
    };
    let rows: Vec<_> = Span::ALL.into_iter().filter_map(row).collect();
    if !rows.is_empty() {
        table(out, &[vec![heads], rows].concat())?;
    }
    if has_bars {
        bars(out, spans)?;
    }
    remarks(name, spans).iter().try_for_each(|remark| out.line(|line| write!(line, "{remark}")))
}

fn remarks(name: &TopicName, spans: &Spans) -> Vec<String> {
    let mut remarks = Vec::new();
    if spans.received == 0 {
        remarks.push(format!("{name}: {NO_SAMPLES}; {}", no_samples_reason(name)));
    }
    if spans.before > 0 {
        let word = if spans.before == 1 { "was" } else { "were" };
        remarks
            .push(format!("{name}: {} {word} sent before the subscription, and not measured", spans.before));
    }
    if spans.flags & Flags::REMOTE != 0 {
        remarks.push(format!(
            "{name}: the network's time is measured with the wall clocks of two machines, and contains their difference"
        ));
    }
    if spans.in_future > 0 {
        remarks.push(format!(
            "{name}: {} have stamps ahead of the clock here: the clocks differ",
            spans.in_future
        ));
    }
    let kinds: Vec<_> = Flags::names(spans.flags).filter(|flag| *flag != "remote").collect();
    if !kinds.is_empty() {
        remarks.push(format!("{name}: {}", kinds.join(", ")));
    }
    remarks
}

const NO_SAMPLES: &str = "no sample arrived";

fn no_samples_reason(name: &TopicName) -> String {
    if name.is_robot() {
        "`scanhub info` shows why".into()
    } else {
        format!("`scanhub info {}` shows why", name.sensor)
    }
}

fn bars(out: &mut Output<'_>, spans: &Spans) -> Result<(), ExitReason> {
    let bars = spans.ages(Span::Age).bins();
    let most = bars.iter().map(|bar| bar.count).max().unwrap_or_default().max(1);
    for bar in bars {
        // Every bar with a count is visible.
        let length = (bar.count * MAX_BAR_LEN).div_ceil(most) as usize;
        out.line(|line| {
            let (from, to) = (time(bar.from_ns), time(bar.to_ns));
            write!(line, "{from:>7} .. {to:<7} {:>7}", bar.count)?;
            if length > 0 { write!(line, " {}", "#".repeat(length)) } else { Ok(()) }
        })?;
    }
    Ok(())
}

const MAX_BAR_LEN: u64 = 40;

fn us(ns: u64) -> String {
    format!("{:.1}", ns as f64 / 1e3)
}

/// Formats the time at an edge between two bars, as a whole number with a unit.
fn time(ns: u64) -> String {
    match ns {
        0..1_000_000 => format!("{} us", ns / 1_000),
        1_000_000..1_000_000_000 => format!("{} ms", ns / 1_000_000),
        _ => format!("{} s", ns / 1_000_000_000),
    }
}

/// Conditions of a measurement, as a line of class `conditions`: priority and memory of the process, and the cost of
/// reading the clock.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "class", rename = "conditions")]
struct Conditions {
    wait: &'static str,
    /// Whether the thread has SCHED_FIFO with the lowest priority. The thread then runs before all threads without
    /// real-time priority.
    realtime: bool,
    memory_locked: bool,
    /// Duration of one read of the clock in ns.
    clock_read_ns: f64,
    clock_resolution_ns: u64,
    /// Requests that the system refused, with the reason and a remedy.
    refused: Vec<String>,
}

impl Conditions {
    /// If `is_realtime` is set, requests real-time priority for the calling thread and locks the memory of its process,
    /// so that other programs do not add latency. Requests that the system refuses are reported in the result. Priority
    /// and lock are never undone.
    fn take(wait: Wait, is_realtime: bool) -> Conditions {
        let processors = thread::available_parallelism().map_or(1, usize::from);
        let normal = Conditions {
            wait: match wait {
                Wait::Doorbell => "doorbell",
                Wait::Event => "event",
                Wait::Spin => "spin",
            },
            realtime: false,
            memory_locked: false,
            clock_read_ns: (clock_read_ns() * 10.0).round() / 10.0,
            clock_resolution_ns: clock_resolution_ns(),
            refused: Vec::new(),
        };
        if is_realtime { normal.with_realtime(wait, processors) } else { normal }
    }

    fn with_realtime(self, wait: Wait, processors: usize) -> Conditions {
        let priority = may_spin(wait, processors).and_then(|()| take_priority());
        // Lock only the present mappings. If later mappings were locked, too, they could exceed the limit, and then the
        // topics could not be mapped.
        let locked = mlockall(MlockAllFlags::CURRENT).map_err(|error| {
            format!("memory is not locked: {}; `ulimit -l unlimited` permits it", io::Error::from(error))
        });
        Conditions {
            realtime: priority.is_ok(),
            memory_locked: locked.is_ok(),
            refused: [priority.err(), locked.err()].into_iter().flatten().collect(),
            ..self
        }
    }

    /// Writes the conditions for users.
    fn text(&self, notes: &mut Output<'_>) -> Result<(), ExitReason> {
        notes.line(|line| {
            let priority = if self.realtime { "real-time priority" } else { "normal priority" };
            let locked = if self.memory_locked { "locked" } else { "not locked" };
            write!(line, "wait by {}, {priority}, memory {locked}; ", self.wait)?;
            write!(line, "the clock takes {} ns to read, ", self.clock_read_ns)?;
            write!(line, "its resolution is {} ns", self.clock_resolution_ns)
        })?;
        self.refused.iter().try_for_each(|refused| notes.line(|line| write!(line, "{refused}")))
    }
}

/// Returns an error if there are too few processors for a thread with real-time priority that never sleeps. Such a
/// thread would keep the hub from running.
fn may_spin(wait: Wait, processors: usize) -> Result<(), String> {
    if wait == Wait::Spin && processors < MIN_PROCESSORS {
        return Err(format!(
            "no real-time priority: on {processors} processors it would keep the hub from running while it spins"
        ));
    }
    Ok(())
}

/// Minimum number of processors: one for the spinning thread, one for the hub, and one for everything else.
const MIN_PROCESSORS: usize = 3;

/// Requests the lowest real-time priority for the calling thread. The error has the reason and a remedy.
fn take_priority() -> Result<(), String> {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, fifo).map_err(|error| {
        let why = match error {
            Error::OS(number) => io::Error::from_raw_os_error(number).to_string(),
            other => format!("{other:?}"),
        };
        format!("no real-time priority: {why}; `ulimit -r 1` or CAP_SYS_NICE permits it")
    })
}

/// Measures the duration of one read of the clock in ns. Returns the minimum of several runs, so interruptions do not
/// count.
fn clock_read_ns() -> f64 {
    const RUNS: usize = 8;
    const READS: u32 = 256;
    let run = || {
        let begin = clock::now_ns();
        for _ in 1..READS {
            std::hint::black_box(clock::now_ns());
        }
        (clock::now_ns() - begin) as f64 / f64::from(READS)
    };
    (0..RUNS).map(|_| run()).fold(f64::INFINITY, f64::min)
}

fn clock_resolution_ns() -> u64 {
    let Timespec { tv_sec, tv_nsec } = clock_getres(ClockId::Monotonic);
    tv_sec as u64 * 1_000_000_000 + tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Header;

    use super::*;

    fn measured() -> (TopicName, Spans) {
        let mut spans = Spans::new();
        spans.begin(1_000_000);
        for (last_ns, age_ns) in
            [(500_000, 700_000), (1_000_000, 1_500), (2_000_000, 1_600), (3_000_000, 15_000)]
        {
            let mut header =
                Header { stamp_first_ns: 400_000, stamp_last_ns: last_ns, flags: 2, ..Header::default() };
            header.set_sent_at(last_ns + 512);
            spans.take(&header, Arrival { monotonic_ns: last_ns + age_ns, wall_ns: 0 });
        }
        (TopicName::parse("front/scan").expect("a topic"), spans)
    }

    #[test]
    fn writes_result_as_object() {
        let (name, spans) = measured();
        let line = serde_json::to_string(&result(&name, &spans)).expect("an object");
        let begin = r#"{"class":"latency","sensor":"front","topic":"scan","received":4,"before":1,"in_future":0,"flags":["simulated"],"age":{"count":3,"min_ns":1500,"p50_ns":1600,"p90_ns":15000,"p99_ns":15000,"p999_ns":15000,"max_ns":15000},"line":{"count":3,"#;
        assert!(line.starts_with(begin), "{line}");
        assert!(line.contains(r#""hub":{"count":3,"min_ns":512,"p50_ns":512,"#), "{line}");
        assert!(line.ends_with(r#","network":null}"#), "{line}");
    }

    #[test]
    fn names_command_that_shows_reason_for_silence() {
        for (topic, verb) in [("front/scan", "info front"), ("robot/zones", "info")] {
            let (name, spans) = (TopicName::parse(topic).expect("a topic"), Spans::new());
            let (mut line, mut text) = (Vec::new(), Vec::new());
            brief(&mut line, &name, &spans).expect("written");
            full(&mut Output::new(&mut text), &name, &spans, false).expect("written");
            let why = format!("no sample arrived; `scanhub {verb}` shows why");
            assert_eq!(String::from_utf8_lossy(&line), format!("{topic:<16}       - age, {why}"));
            assert_eq!(String::from_utf8_lossy(&text), format!("{topic}: {why}\n"));
        }
    }

    #[test]
    fn writes_result_as_table() {
        let (name, spans) = measured();
        let mut text = Vec::new();
        full(&mut Output::new(&mut text), &name, &spans, true).expect("written");
        let text = String::from_utf8(text).expect("text");
        let expected = "\
us     count  min    p50     p90     p99     p99.9   max
line       3  600.0  1600.5  2600.0  2600.0  2600.0  2600.0
hub        3    0.5     0.5     0.5     0.5     0.5     0.5
wake       3    1.0     1.1    14.5    14.5    14.5    14.5
age        3    1.5     1.6    15.0    15.0    15.0    15.0
total      3  601.5  1602.6  2615.0  2615.0  2615.0  2615.0
   1 us .. 2 us          2 ########################################
   2 us .. 3 us          0
   3 us .. 4 us          0
   4 us .. 5 us          0
   5 us .. 6 us          0
   6 us .. 8 us          0
   8 us .. 10 us         0
  10 us .. 20 us         1 ####################
front/scan: 1 was sent before the subscription, and not measured
front/scan: simulated
";
        assert_eq!(text, expected);
        let mut line = Vec::new();
        brief(&mut line, &name, &spans).expect("written");
        let line = String::from_utf8(line).expect("text");
        assert_eq!(line, "front/scan             3 age p50       1.6 p99      15.0 max      15.0 us");
    }
    #[test]
    fn spinning_thread_leaves_the_hub_a_processor() {
        for wait in [Wait::Doorbell, Wait::Event] {
            assert_eq!(may_spin(wait, 1), Ok(()));
        }
        assert_eq!(may_spin(Wait::Spin, 3), Ok(()));
        assert!(may_spin(Wait::Spin, 2).is_err_and(|why| why.contains("on 2 processors")));
    }

    #[test]
    fn explains_refused_requests() {
        // Use a separate thread, because the thread keeps its priority.
        let take = || Conditions::take(Wait::Spin, false).with_realtime(Wait::Spin, 2);
        let taken = thread::spawn(take).join().expect("no panic");
        assert!(!taken.realtime);
        assert_eq!(taken.refused.len(), 1 + usize::from(!taken.memory_locked), "{taken:?}");
    }
}
