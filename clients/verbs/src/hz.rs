//! `scanhub hz`: prints rate, jitter, extremes and losses of topics on arrival, once a second.

use std::collections::VecDeque;
use std::io::Write;
use std::rc::Rc;
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::clock;
use scanhub_schema::{Failure, Status, Topic};
use serde::Serialize;

use crate::context::Context;
use crate::follow::{Event, Notice, RunLimits, TopicRun};
use crate::names::{Selection, TopicName};
use crate::output::{ExitReason, Output, verb_result};
use crate::receive_stats::ReceiveStats;
use crate::{duration, json, text};

/// Measure rate, jitter and loss of topics
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub hz front/scan --for 10s")]
pub struct HzArgs {
    /// Topics to measure: front/scan, */scan for all sensors, or front/* for all topics of a sensor [default: all]
    #[arg(value_name = "SENSOR/TOPIC")]
    pub topics: Vec<String>,
    /// Time span that each line covers, at least 0.5s
    #[arg(long, default_value = "10s", value_name = "DURATION", value_parser = parse_window)]
    pub window: Duration,
    /// Limits of the run.
    #[command(flatten)]
    pub limits: RunLimits,
}

/// Parses the time span that a line covers. In a span below [`MIN_WINDOW`], no two samples would be far enough apart to
/// compute a rate.
fn parse_window(text: &str) -> Result<Duration, String> {
    match duration::parse(text)? {
        window if window >= MIN_WINDOW => Ok(window),
        _ => Err(format!("{text:?} is too short for a rate: at least {MIN_WINDOW:?}")),
    }
}

const MIN_WINDOW: Duration = Duration::from_millis(500);

impl HzArgs {
    /// Writes a line per topic and second to stdout, and summaries at the end. Notices go to stderr without `--json`.
    /// Ends in the same way as [`EchoArgs::run`](crate::echo::EchoArgs::run).
    ///
    /// # Errors
    ///
    /// Returns the errors of [`EchoArgs::run`](crate::echo::EchoArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let Selection { named, of_all } = Selection::parse(&self.topics)?;
        let of_all = if self.topics.is_empty() { Topic::ALL.to_vec() } else { of_all };
        let mut hz = Hz {
            json: context.json,
            length: self.window,
            windows: Vec::new(),
            lines: Vec::new(),
            next: Instant::now() + LINE_INTERVAL,
            out: Output::new(&mut context.out),
            notes: Output::new(&mut context.notes),
        };
        let mut following = TopicRun::new(&named, &of_all, &locations, &self.limits, &stop).with_lines();
        let end = hz.run(&mut following);
        verb_result(following.finish(end, |name, stats| hz.summary(name, stats)))
    }
}

const LINE_INTERVAL: Duration = Duration::from_secs(1);

struct Hz<'a> {
    json: bool,
    length: Duration,
    windows: Vec<TopicWindow>,
    lines: Vec<LineWindow>,
    next: Instant,
    out: Output<'a>,
    notes: Output<'a>,
}

/// A topic with its window. `since_ns` is the time, on CLOCK_MONOTONIC in ns, since which the run has been ready to
/// receive. Samples that were sent earlier come from the history, so their arrival times show no rate.
struct TopicWindow {
    name: Rc<TopicName>,
    since_ns: u64,
    window: Window,
}

impl Hz<'_> {
    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Added(name) => {
                    let window = Window::new(self.length);
                    self.windows.push(TopicWindow { name, since_ns: u64::MAX, window });
                }
                Event::Subscribed(name) => self.begin(&name),
                Event::Sample(name, sample, _) if !sample.is_silence() => {
                    let followed = self.windows.iter_mut().find(|followed| followed.name == name);
                    if let Some(followed) = followed.filter(|it| !sample.is_older_than(it.since_ns)) {
                        followed.window.add(Instant::now(), sample.missed());
                    }
                }
                Event::Notice(names, notice) => {
                    if notice == Notice::HubBack {
                        names.iter().for_each(|name| self.begin(name));
                    }
                    notice.report(&names, self.json, &mut self.out, &mut self.notes)?;
                }
                Event::Line(sensor, status) => self.line(&sensor, &status),
                Event::Tick(now) => self.tick(now)?,
                Event::Sample(..) | Event::ResourceExhausted(..) => {}
            }
        }
        Ok(())
    }

    /// Counts samples of `name` that are sent from now on.
    fn begin(&mut self, name: &TopicName) {
        let now_ns = clock::now_ns();
        self.windows.iter_mut().filter(|it| *it.name == *name).for_each(|it| it.since_ns = now_ns);
    }

    fn line(&mut self, sensor: &str, status: &Status) {
        if self.lines.iter().all(|line| line.sensor != sensor) {
            self.lines.push(LineWindow::new(sensor));
        }
        if let Some(line) = self.lines.iter_mut().find(|line| line.sensor == sensor) {
            line.note(Instant::now(), status, self.length);
        }
    }

    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        if now < self.next {
            return Ok(());
        }
        while self.next <= now {
            self.next += LINE_INTERVAL;
        }
        for TopicWindow { name, window, .. } in &mut self.windows {
            window.slide(now);
            let lost = self.lines.iter().find(|line| line.sensor == name.sensor);
            let line = HzJson::new(name, window, lost);
            if self.json {
                self.out.json(&line)?;
            } else {
                self.out.line(|out| line.text(out))?;
            }
        }
        Ok(())
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), ExitReason> {
        if self.json {
            return self.out.json(&json::summary(name, stats));
        }
        self.out.line(|line| text::summary(line, name, stats))
    }
}

/// Losses on the line of a sensor in the window.
struct LineWindow {
    sensor: String,
    /// Arrival time of each status, with the number of scans that were lost until then. The newest is last.
    lost: VecDeque<(Instant, Option<u64>)>,
    /// Last status.
    status: Status,
}

impl LineWindow {
    fn new(sensor: &str) -> LineWindow {
        LineWindow { sensor: sensor.to_owned(), lost: VecDeque::new(), status: Status::default() }
    }

    fn note(&mut self, now: Instant, status: &Status, length: Duration) {
        // Counters of a restarted hub start at 0.
        if self.lost.back().is_some_and(|(_, lost)| *lost > status.lost_on_line()) {
            self.lost.clear();
        }
        while self.lost.get(1).is_some_and(|(at, _)| now - *at >= length) {
            self.lost.pop_front();
        }
        self.lost.push_back((now, status.lost_on_line()));
        self.status = *status;
    }

    fn lost_on_line(&self) -> Option<u64> {
        let (_, first) = self.lost.front()?;
        Some(self.status.lost_on_line()? - first.unwrap_or(0))
    }
}

/// JSON line of class `hz`. Rate, jitter and extremes are null while the arrivals span less than
/// [`scanhub_schema::MIN_RATE_SPAN`].
#[derive(Serialize)]
struct HzJson<'a> {
    class: &'static str,
    sensor: &'a str,
    topic: &'static str,
    hz: Option<f64>,
    jitter_ms: Option<f64>,
    min_ms: Option<f64>,
    max_ms: Option<f64>,
    received: u64,
    missed: u64,
    window_s: f64,
    damaged: Option<f64>,
    lost_on_line: Option<u64>,
    #[serde(skip)]
    loss: Option<String>,
}

impl<'a> HzJson<'a> {
    fn new(name: &'a TopicName, window: &Window, line: Option<&LineWindow>) -> HzJson<'a> {
        let rate = window.rate();
        HzJson {
            class: "hz",
            sensor: &name.sensor,
            topic: name.topic.name(),
            hz: rate.map(|rate| rate.hz),
            jitter_ms: rate.map(|rate| rate.jitter_ms),
            min_ms: rate.map(|rate| rate.min_ms),
            max_ms: rate.map(|rate| rate.max_ms),
            received: window.received(),
            missed: window.missed(),
            window_s: window.span().as_secs_f64(),
            damaged: line.map(|line| line.status.damaged_share()),
            lost_on_line: line.and_then(LineWindow::lost_on_line),
            loss: line.and_then(|line| line.status.line_loss()),
        }
    }

    fn text(&self, line: &mut Vec<u8>) -> std::io::Result<()> {
        let name = format!("{}/{}", self.sensor, self.topic);
        match (self.hz, self.jitter_ms, self.min_ms, self.max_ms) {
            (Some(hz), Some(jitter), Some(min), Some(max)) => write!(
                line,
                "{name:<16} {hz:8.2} Hz  jitter {jitter:.1} ms, interval {min:.1} to {max:.1} ms, missed {}{}",
                self.missed,
                self.loss.as_ref().map_or(String::new(), |loss| format!(", {loss}"))
            ),
            _ => write!(line, "{name:<16}        - Hz {} received", self.received),
        }
    }
}

/// Arrivals within the last `length`.
struct Window {
    length: Duration,
    arrivals: VecDeque<(Instant, u64)>,
}

/// Statistics of a window. Times between arrivals are in ms.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rate {
    /// Arrivals per second.
    hz: f64,
    /// Standard deviation of the time between arrivals.
    jitter_ms: f64,
    /// Shortest time between two arrivals.
    min_ms: f64,
    /// Longest time between two arrivals.
    max_ms: f64,
}

impl Window {
    /// Creates an empty window of this `length`.
    fn new(length: Duration) -> Window {
        Window { length, arrivals: VecDeque::new() }
    }

    /// Adds an arrival at `now`. Before it, `missed` samples did not arrive.
    fn add(&mut self, now: Instant, missed: u64) {
        self.arrivals.push_back((now, missed));
    }

    /// Removes arrivals that are older than the window.
    fn slide(&mut self, now: Instant) {
        while self.arrivals.front().is_some_and(|(at, _)| now - *at > self.length) {
            self.arrivals.pop_front();
        }
    }

    /// Returns the number of arrivals in the window.
    fn received(&self) -> u64 {
        self.arrivals.len() as u64
    }

    /// Returns the number of samples that did not arrive within the window.
    fn missed(&self) -> u64 {
        self.arrivals.iter().map(|(_, missed)| missed).sum()
    }

    /// Returns the time between the first and the last arrival in the window.
    fn span(&self) -> Duration {
        match (self.arrivals.front(), self.arrivals.back()) {
            (Some((first, _)), Some((last, _))) => *last - *first,
            _ => Duration::ZERO,
        }
    }

    /// Returns the rate, or `None` if the arrivals span less than [`scanhub_schema::MIN_RATE_SPAN`].
    fn rate(&self) -> Option<Rate> {
        let span = self.span();
        let times_ms = || {
            self.arrivals
                .iter()
                .zip(self.arrivals.iter().skip(1))
                .map(|(a, b)| (b.0 - a.0).as_secs_f64() * 1e3)
        };
        let count = times_ms().count();
        let hz = scanhub_schema::rate_hz(count as u64, span)?;
        let mean = span.as_secs_f64() * 1e3 / count as f64;
        let variance = times_ms().map(|time| (time - mean).powi(2)).sum::<f64>() / count as f64;
        Some(Rate {
            hz,
            jitter_ms: variance.sqrt(),
            min_ms: times_ms().fold(f64::INFINITY, f64::min),
            max_ms: times_ms().fold(0.0, f64::max),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn window_has_rate_jitter_and_extremes() {
        let start = Instant::now();
        let mut window = Window::new(Duration::from_secs(1));
        assert_eq!(window.rate(), None);
        let mut burst = Window::new(Duration::from_secs(1));
        for at_us in [0, 1, 3] {
            burst.add(start + Duration::from_micros(at_us), 0);
        }
        assert_eq!((burst.received(), burst.rate()), (3, None));
        for (at_ms, missed) in [(0, 9), (500, 0), (600, 1), (800, 0), (1200, 0)] {
            window.add(start + Duration::from_millis(at_ms), missed);
        }
        window.slide(start + Duration::from_millis(1200));
        assert_eq!((window.received(), window.missed()), (4, 1));
        let rate = window.rate().unwrap();
        let expected = Rate { hz: 3.0 / 0.7, jitter_ms: 124.72, min_ms: 100.0, max_ms: 400.0 };
        assert!((rate.hz - expected.hz).abs() < 1e-6 && (rate.jitter_ms - expected.jitter_ms).abs() < 0.01);
        assert!((rate.min_ms - expected.min_ms).abs() < 1e-6 && (rate.max_ms - expected.max_ms).abs() < 1e-6);
    }
}
