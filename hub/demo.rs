//! `scanhub demo`: simulators, a hub, a subscriber for each sensor, and a people tracker, all in one terminal. Each of
//! them is a separate process, as in real use. This process starts them, reads their output, compares sent with
//! received telegrams, and shows the picture of `watch`.

mod delivery_stats;
mod environment;
mod participants;

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use scanhub_schema::{Failure, Family, Kind};
use scanhub_shm::Domain;
use scanhub_verbs::context::Context;
use scanhub_verbs::duration;
use scanhub_viewer::{WatchArgs, can_show_pictures};
use serde::Serialize;
use serde_json::Value;

use delivery_stats::{DeliveryStats, Sensor, counted};
use environment::{ChildEvent, DemoEnvironment};
use participants::{Families, World};

/// Run simulated scanners, a hub and subscribers in one terminal, with the live picture
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Demo {
    /// Show no picture. At the end, print a line for each sensor, and exit with code 5 if a telegram was lost
    #[arg(long)]
    headless: bool,
    /// Stop after this time, for example 10s [default: at Ctrl-C]
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Simulated surroundings. demo: two sensors on a robot. house: four sensors that track people through two rooms. tilt: a
    /// tilting scanner that finds obstacles in 3D
    #[arg(long, default_value = "demo", value_name = "WORLD", value_parser = worlds())]
    world: World,
    /// Seed of rooms and people
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Family of the scanners. mixed: one of each family
    #[arg(long, default_value = Family::ALL[0].name(), value_name = "FAMILY", value_parser = families())]
    family: Families,
}

const EXAMPLES: &str = "\
Examples:
  scanhub demo
  scanhub demo --world house
  scanhub demo --family mixed
  scanhub demo --headless --for 10s";

impl Demo {
    /// Runs until the configured time has elapsed, the picture is closed, or a signal arrives. Then prints a summary
    /// for each sensor.
    ///
    /// # Errors
    ///
    /// - [`Kind::Check`] if a telegram that a sensor sent did not arrive.
    /// - [`Kind::Interrupted`] if a bounded run was stopped.
    /// - [`Kind::Timeout`] if a sensor does not stream within 30 seconds.
    /// - [`Kind::Failed`] if a process ends early.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let stop = context.signals.any_stop()?;
        let json = context.json;
        let shows = !self.headless && !json;
        let has_picture = shows && can_show_pictures();
        let sensors = self.world.sensors(self.family)?;
        let environment = DemoEnvironment::new(has_picture, self.world, sensors)?;
        // If the page cannot be served, the demonstration runs without it.
        let web = if shows { environment.start_web().ok() } else { None };
        let url = web.as_ref().map(|(_, url)| url.as_str());
        let played = if has_picture {
            play_with_picture(self, &environment, url, &mut context.out, &stop)
        } else {
            let (mut view, mut is_ready_printed) = (View::new(attach_hint(&environment), url), false);
            let mut show = |stats: &DeliveryStats, elapsed: Duration| {
                if shows {
                    view.draw(&mut context.out, stats, elapsed);
                } else if !std::mem::replace(&mut is_ready_printed, true) {
                    print_ready(&mut context.out, &environment, json);
                }
            };
            play(self, &environment, &mut show, &|| stop.swap(false, Ordering::Relaxed))
        };
        drop(web);
        environment.print_errors();
        let (stats, end) = played?;
        crate::print_own(&stats.summary(json).join("\n"))?;
        if end == EndReason::Interrupted {
            return Err(Failure::new(Kind::Interrupted, "interrupted before all telegrams had arrived", ""));
        }
        if let Some(loss) = stats.loss() {
            return Err(Failure::new(Kind::Check, loss, "is the machine too busy to run all processes?"));
        }
        if end == EndReason::Stopped && self.run_for.is_some() {
            return Err(Failure::new(Kind::Interrupted, "interrupted before the end of the time", ""));
        }
        Ok(())
    }
}

fn worlds() -> impl TypedValueParser<Value = World> {
    PossibleValuesParser::new(World::NAMES)
        .map(|name| World::parse(&name).expect("one of the possible names"))
}

fn families() -> impl TypedValueParser<Value = Families> {
    PossibleValuesParser::new(Families::names())
        .map(|name| Families::parse(&name).expect("one of the possible names"))
}

/// Runs [`play`] while the terminal shows the picture. Closing the picture ends the demonstration.
fn play_with_picture(
    options: &Demo,
    environment: &DemoEnvironment,
    url: Option<&str>,
    out: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(DeliveryStats, EndReason), Failure> {
    let note = url.map_or_else(|| attach_hint(environment), |url| page_hint(url, &environment.domain));
    let locations = [environment.domain.clone()];
    let (closed, over) = (AtomicBool::new(false), AtomicBool::new(false));
    thread::scope(|scope| {
        let play = scope.spawn(|| {
            let _over = SetOnDrop(&over);
            let must_end = || stop.swap(false, Ordering::Relaxed) | closed.swap(false, Ordering::Relaxed);
            play(options, environment, &mut |_, _| {}, &must_end)
        });
        let closing = SetOnDrop(&closed);
        let shown = WatchArgs::default().show(&note, &locations, out, &over);
        drop(closing);
        let played = play.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        shown.and(played)
    })
}

/// Guard that sets a flag when it is dropped, even by a panic, so that the other thread ends.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Output of a demonstration without the picture: lines for files and pipes, once a second.
struct View {
    /// Command that shows a topic in another terminal.
    attach: String,
    /// Address of the page.
    url: Option<String>,
    /// Time of the next lines, in seconds.
    next_s: u64,
}

impl View {
    fn new(attach: String, url: Option<&str>) -> View {
        View { attach, url: url.map(str::to_owned), next_s: 0 }
    }

    /// Writes the counts after `elapsed`, once a second.
    fn draw(&mut self, out: &mut dyn Write, stats: &DeliveryStats, elapsed: Duration) {
        if elapsed.as_secs() >= self.next_s {
            self.next_s = elapsed.as_secs() + 1;
            let text = self.lines(stats, elapsed).join("\n") + "\n\n";
            let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
        }
    }

    fn lines(&self, stats: &DeliveryStats, elapsed: Duration) -> Vec<String> {
        let seconds = elapsed.as_secs();
        let mut lines = vec![
            format!(
                "scanhub demo  {:02}:{:02}   the hub uses {:.1} % of a processor   Ctrl-C quits",
                seconds / 60,
                seconds % 60,
                stats.hub_cpu_percent
            ),
            self.attach.clone(),
        ];
        lines.extend(self.url.iter().map(|url| format!("browser: {url}")));
        lines.extend(stats.tracker_line.iter().map(|line| format!("people: {line}")));
        for sensor in &stats.sensors {
            lines.push(String::new());
            lines.extend(sensor_lines(sensor));
        }
        lines.extend(stats.tilt_summary());
        lines
    }
}

/// Returns the counts of a sensor and the profile of its scan.
fn sensor_lines(sensor: &Sensor) -> [String; 3] {
    // Telegrams on their way are not lost: the simulators are a little ahead of the subscribers.
    let lost_count = sensor.lost().saturating_sub(MAX_IN_FLIGHT);
    let nearest = match sensor.nearest_mm {
        Some(mm) => format!("nearest {:.2} m at {:.1} degrees", mm as f64 / 1000.0, sensor.nearest_deg),
        None => "nothing seen".to_owned(),
    };
    [
        format!(
            "{:6} {:9} {:6} Bd  {:>5} Hz   {}   {} lost, {} on the line",
            sensor.name,
            sensor.state,
            sensor.baud,
            sensor.hz().map_or("-".into(), |hz| format!("{hz:.2}")),
            counted(sensor.received_count, "telegram"),
            lost_count,
            sensor.lost_on_line().unwrap_or_default(),
        ),
        format!("  left  {}  right", profile(sensor)),
        format!("        {:<PROFILE_COLUMNS$}", format!("(the taller, the nearer)   {nearest}")),
    ]
}

/// Returns the scan from left to right. The nearer the nearest beam of a column, the taller its block.
fn profile(sensor: &Sensor) -> String {
    if sensor.ranges.is_empty() {
        return "waiting for the first scan".to_owned();
    }
    let beams = sensor.ranges.len();
    let column = |n: usize| {
        let nearest = sensor.ranges[n * beams / PROFILE_COLUMNS..(n + 1) * beams / PROFILE_COLUMNS]
            .iter()
            .flatten()
            .min();
        nearest.map_or(' ', |&mm| {
            PROFILE_BLOCKS[(PROFILE_BLOCKS.len() - 1)
                - (mm as usize * PROFILE_BLOCKS.len() / MAX_PROFILE_RANGE_MM).min(PROFILE_BLOCKS.len() - 1)]
        })
    };
    // Beam 0 is on the right.
    (0..PROFILE_COLUMNS).rev().map(column).collect()
}

/// Number of columns of a profile.
const PROFILE_COLUMNS: usize = 60;
const PROFILE_BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// Range of the lowest block.
const MAX_PROFILE_RANGE_MM: usize = 8000;
/// Maximum number of telegrams on their way at an update.
const MAX_IN_FLIGHT: u64 = 12;

/// Returns the command that shows a topic of the demonstration in another terminal.
fn attach_hint(environment: &DemoEnvironment) -> String {
    format!("other terminal: scanhub echo {} {}", environment.world.topic(), environment.domain.flags())
}

/// Returns the hint with the address of the page. It fits in 80 columns together with the keys.
fn page_hint(url: &str, domain: &Domain) -> String {
    format!("browser: {url}  domain: {}", domain.name())
}

/// Prints the domain of the demonstration.
fn print_ready(out: &mut dyn Write, environment: &DemoEnvironment, json: bool) {
    let domain = &environment.domain;
    let ready =
        ReadyLine { class: "ready", domain: domain.name(), root: domain.root(), pid: std::process::id() };
    let line = match json {
        true => crate::to_json_line(&ready),
        false => format!("ready {} in {}; {}", ready.domain, ready.root.display(), attach_hint(environment)),
    };
    let _ = out.write_all(format!("{line}\n").as_bytes());
}

/// JSON line of class `ready`. The order of the keys is part of the contract.
#[derive(Serialize)]
struct ReadyLine<'a> {
    class: &'static str,
    domain: &'a str,
    root: &'a Path,
    pid: u32,
}

/// Reason for the end of a demonstration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum EndReason {
    /// The configured time has elapsed.
    TimeOver,
    /// The user stopped the demonstration.
    Stopped,
    /// The user stopped the demonstration, and then stopped waiting for telegrams on their way.
    Interrupted,
}

/// Starts all processes, and compares sent telegrams with received ones until the configured time has elapsed or the
/// user stops the demonstration. `must_end` returns whether the user has requested the end since the last call.
/// Telegrams on their way still arrive after that, unless there is another request.
fn play(
    options: &Demo,
    environment: &DemoEnvironment,
    show: &mut dyn FnMut(&DeliveryStats, Duration),
    must_end: &dyn Fn() -> bool,
) -> Result<(DeliveryStats, EndReason), Failure> {
    let (lines, received) = mpsc::channel();
    let hub = environment.start_hub(lines.clone())?;
    let subscribers = environment.start_subscribers(&lines)?;
    let tracker = environment.start_tracker(&lines)?;
    let mut stats = DeliveryStats::new(&environment.sensors);
    // Start the simulators last, so that the subscribers receive everything from the beginning.
    let mut simulators = Vec::new();
    let mut tilted = None;
    let mut ready = 0;
    let mut first_sample: Option<Instant> = None;
    let start = Instant::now();
    let mut next_update = start;
    let mut end = None;
    let end = loop {
        match received.recv_timeout(next_update.saturating_duration_since(Instant::now()).min(MAX_LINE_WAIT))
        {
            Ok(ChildEvent::Line { child: TRACKER, text }) => stats.set_tracker_line(text),
            Ok(ChildEvent::Line { child: SIMULATOR, text }) => stats.take_simulator_line(&text),
            Ok(ChildEvent::Line { child: of, text }) => {
                let value: Value = serde_json::from_str(&text).unwrap_or_default();
                if value["class"] == "status" && simulators.is_empty() {
                    ready |= 1 << of;
                    if ready == (1 << environment.sensors.len()) - 1 {
                        simulators = environment.start_simulators(options.seed, &lines)?;
                        tilted = environment.start_tilt(&lines)?;
                    }
                }
                stats.handle_line(of, &value);
                if stats.all_stream() {
                    first_sample.get_or_insert_with(Instant::now);
                }
            }
            Ok(ChildEvent::Ended { child: of }) => return Err(ended(of)),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
        }
        let now = Instant::now();
        if now >= next_update {
            next_update = now + REFRESH_INTERVAL;
            stats.update_cpu_time(hub.pid());
            show(&stats, start.elapsed());
        }
        if first_sample.is_none() && start.elapsed() > START_TIMEOUT {
            return Err(Failure::new(
                Kind::Timeout,
                "not every sensor streams after 30 seconds",
                "run with SCANHUB_LOG=debug to see the hub's log",
            ));
        }
        let over = options.run_for.zip(first_sample).is_some_and(|(limit, first)| first.elapsed() >= limit);
        match (end, must_end()) {
            (Some(_), true) => break EndReason::Interrupted,
            (Some(end), false) if stats.is_complete(STREAM_TIMEOUT) => break end,
            (None, is_asked) if is_asked || over => {
                // Telegrams that were sent by now arrive before any process is stopped.
                stats.cut();
                end = Some(if is_asked { EndReason::Stopped } else { EndReason::TimeOver });
            }
            _ => {}
        }
    };
    drop(tilted);
    drop(tracker);
    drop(subscribers);
    drop(hub);
    let mut open = simulators.len();
    drop(simulators);
    // The last lines of the simulators are their summaries.
    while open > 0
        && let Ok(line) = received.recv_timeout(SUMMARY_TIMEOUT)
    {
        match line {
            ChildEvent::Line { child: SIMULATOR, text } => stats.take_simulator_line(&text),
            ChildEvent::Ended { child: SIMULATOR } => open -= 1,
            _ => {}
        }
    }
    Ok((stats, end))
}

fn ended(child: usize) -> Failure {
    let process = match child {
        HUB => "the hub",
        SIMULATOR => "a simulator",
        TILTED => "the assembler of tilted scans",
        TRACKER => "the tracker of people",
        WEB => "the picture for browsers",
        _ => "a subscriber",
    };
    Failure::new(Kind::Failed, format!("{process} ended early"), "its output is above")
}

/// Numbers of the processes. A subscriber has the number of its sensor.
const HUB: usize = 100;
const SIMULATOR: usize = 101;
const WEB: usize = 102;
const TILTED: usize = 103;
const TRACKER: usize = 104;
/// Interval between updates of the view.
const REFRESH_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum wait for a line before the time is checked.
const MAX_LINE_WAIT: Duration = Duration::from_millis(50);
/// Timeout until all sensors stream. The sensors need far less time unless the machine is busy.
const START_TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum wait for the last lines of a simulator that has ended.
const SUMMARY_TIMEOUT: Duration = Duration::from_secs(2);
/// Time without a telegram after which a sensor counts as stopped.
const STREAM_TIMEOUT: Duration = Duration::from_secs(10);
