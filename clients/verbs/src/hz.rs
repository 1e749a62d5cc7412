//! `scanhub hz`: rate, jitter, minimum, maximum and loss of topics, once a second, as they arrive here.

use std::collections::VecDeque;
use std::io::Write;
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_schema::{Failure, Status, Topic};
use scanhub_shm::Domain;
use serde::Serialize;

use crate::follow::{Bounds, Event, Following, Notice};
use crate::names::TopicName;
use crate::output::{End, Output, quiet};
use crate::receive_stats::ReceiveStats;
use crate::selection::Selection;
use crate::window::Window;
use crate::{json, text};

/// What `hz` is asked for.
#[derive(Clone, Debug)]
pub struct HzOptions {
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`; none: all topics of the hub.
    pub topics: Vec<String>,
    /// Objects instead of text.
    pub json: bool,
    /// The sliding window; ten seconds is a good one.
    pub window: Duration,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Writes a line per topic and second to `out`, notices to `notes` (stderr) if `out` is not JSON, the summaries at the
/// end. Ends and fails as [`echo`](crate::echo()).
pub fn hz(
    options: &HzOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let Selection { named, of_all } = Selection::parse(&options.topics)?;
    let of_all = if options.topics.is_empty() { Topic::ALL.to_vec() } else { of_all };
    let mut hz = Hz {
        json: options.json,
        length: options.window,
        windows: Vec::new(),
        lines: Vec::new(),
        next: Instant::now() + EVERY,
        out: Output::new(out),
        notes: Output::new(notes),
    };
    let mut following = Following::new(&named, &of_all, &options.places, &options.bounds, stop).with_lines();
    let end = hz.run(&mut following);
    quiet(following.finish(end, |name, stats| hz.summary(name, stats)))
}

const EVERY: Duration = Duration::from_secs(1);

struct Hz<'a> {
    json: bool,
    length: Duration,
    windows: Vec<Followed>,
    lines: Vec<LineWindow>,
    next: Instant,
    out: Output<'a>,
    notes: Output<'a>,
}

/// A topic, and since when of CLOCK_MONOTONIC its samples are received as they are sent, in ns: what it keeps for late
/// joiners comes before that, and at no rate.
struct Followed {
    name: Rc<TopicName>,
    since_ns: u64,
    window: Window,
}

impl Hz<'_> {
    fn run(&mut self, following: &mut Following<'_>) -> Result<(), End> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Begun(name) => {
                    let window = Window::new(self.length);
                    self.windows.push(Followed { name, since_ns: u64::MAX, window });
                }
                Event::Subscribed(name) => self.begin(&name),
                Event::Sample(name, sample, _) if !sample.is_silence() => {
                    let followed = self.windows.iter_mut().find(|followed| followed.name == name);
                    if let Some(followed) = followed.filter(|it| !sample.is_of_before(it.since_ns)) {
                        followed.window.arrived(Instant::now(), sample.missed());
                    }
                }
                Event::Notice(names, notice) => {
                    if notice == Notice::HubBack {
                        names.iter().for_each(|name| self.begin(name));
                    }
                    notice.tell(&names, self.json, &mut self.out, &mut self.notes)?;
                }
                Event::Line(sensor, status) => self.line(&sensor, &status),
                Event::Tick(now) => self.tick(now)?,
                Event::Sample(..) | Event::Short(..) => {}
            }
        }
        Ok(())
    }

    /// Takes samples of `name` into account from now on.
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

    fn tick(&mut self, now: Instant) -> Result<(), End> {
        if now < self.next {
            return Ok(());
        }
        while self.next <= now {
            self.next += EVERY;
        }
        for Followed { name, window, .. } in &mut self.windows {
            window.slide(now);
            let lost = self.lines.iter().find(|line| line.sensor == name.sensor);
            let line = Line::new(name, window, lost);
            if self.json {
                self.out.json(&line)?;
            } else {
                self.out.line(|out| line.text(out))?;
            }
        }
        Ok(())
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), End> {
        if self.json {
            return self.out.json(&json::summary(name, stats));
        }
        self.out.line(|line| text::summary(line, name, stats))
    }
}

/// What the line of a sensor took away within the window.
struct LineWindow {
    sensor: String,
    /// When statuses came, and what was lost by then, the newest last.
    lost: VecDeque<(Instant, Option<u64>)>,
    /// The last one.
    status: Status,
}

impl LineWindow {
    fn new(sensor: &str) -> LineWindow {
        LineWindow { sensor: sensor.to_owned(), lost: VecDeque::new(), status: Status::default() }
    }

    fn note(&mut self, now: Instant, status: &Status, length: Duration) {
        // A restarted hub counts from 0.
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

/// Class `hz`. Rate, jitter and extremes are null while the arrivals span less than [`scanhub_schema::MIN_RATE_SPAN`].
#[derive(Serialize)]
struct Line<'a> {
    class: &'static str,
    sensor: &'a str,
    topic: &'static str,
    hz: Option<f64>,
    jitter_ms: Option<f64>,
    min_ms: Option<f64>,
    max_ms: Option<f64>,
    received: u64,
    lost: u64,
    window_s: f64,
    damaged: Option<f64>,
    lost_on_line: Option<u64>,
    #[serde(skip)]
    loss: Option<String>,
}

impl<'a> Line<'a> {
    fn new(name: &'a TopicName, window: &Window, line: Option<&LineWindow>) -> Line<'a> {
        let rate = window.rate();
        Line {
            class: "hz",
            sensor: &name.sensor,
            topic: name.topic.name(),
            hz: rate.map(|rate| rate.hz),
            jitter_ms: rate.map(|rate| rate.jitter_ms),
            min_ms: rate.map(|rate| rate.min_ms),
            max_ms: rate.map(|rate| rate.max_ms),
            received: window.received(),
            lost: window.lost(),
            window_s: window.span().as_secs_f64(),
            damaged: line.map(|line| line.status.damaged()),
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
                self.lost,
                self.loss.as_ref().map_or(String::new(), |loss| format!(", {loss}"))
            ),
            _ => write!(line, "{name:<16}        - Hz {} received", self.received),
        }
    }
}
