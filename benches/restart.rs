//! Time and telegrams that a crash of the hub costs its subscribers. Twenty times, the hub is killed with SIGKILL and
//! started again. No service manager keeps the hub's lines open. One process per sensor receives the telegrams. The
//! bench measures the time until the hub's topics exist, and the time until each subscriber has a telegram. The
//! baseline is a minimal reader that opens the same streaming ptys and wakes a process. The bench also counts damaged
//! telegrams, telegrams missed within a run, and writes to the sensors' EEPROM.
//!
//! The second part repeats this under a service manager that keeps the line of one sensor open. This part measures how
//! long no telegram arrives, and which telegrams are lost. The bench does not measure how long a service manager takes
//! to detect the exit of a service.

#[path = "../tests/testkit/supervisor.rs"]
mod supervisor;
mod support;

use std::collections::HashSet;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use supervisor::Supervisor;
use support::baseline;
use support::environment::{
    BenchEnvironment, Child, PROGRAM, SENSORS, STEP_TIMEOUT, STEP_TIMEOUT as WAIT_TIMEOUT,
};
use support::figures::{self, Figure, Target};
use support::truth::SensorTruth;
use support::{Options, Outcome, clock};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let simulator = environment.simulate(&SENSORS, 500_000)?;
    let follow = |sensor: &&str| environment.start_subscriber("telegram", sensor, &["0"]);
    let subscribers: Vec<Child> = SENSORS.iter().map(follow).collect::<Outcome<_>>()?;
    let mut runs = HubRuns {
        stage: &environment,
        subscribers: &subscribers,
        hub: None,
        incomplete: 0,
        missed: 0,
        received: 0,
    };
    runs.restart()?;
    let (mut hub, mut baseline) = (Vec::new(), Vec::new());
    // Alternate a series of kills with a series of starts of the baseline on the same streams. Both series have the
    // same length.
    let each = options.count(20).div_ceil(options.pairs());
    for _ in 0..options.pairs() {
        for _ in 0..each {
            thread::sleep(run_time(hub.len()));
            hub.push(runs.restart()?);
        }
        runs.kill()?;
        for _ in 0..each {
            thread::sleep(run_time(baseline.len()));
            baseline.push(start_baseline(&environment)?);
        }
        runs.restart()?;
    }
    runs.kill()?;
    let (torn, missed, received) = (runs.incomplete as f64, runs.missed as f64, runs.received as f64);
    drop(subscribers);
    drop(simulator);
    let writes: Outcome<Vec<_>> = SENSORS
        .iter()
        .map(|sensor| {
            Ok(SensorTruth::read(&environment.truth(), sensor)?.eeprom_writes.ok_or("no summary")?)
        })
        .collect();
    let writes = writes?.iter().sum::<u64>() as f64;
    let figure = |name, of: fn(&StartTimes) -> f64, target| {
        let baseline = baseline.iter().map(of).collect();
        Figure { name, unit: "ms", hub: hub.iter().map(of).collect(), baseline, target }
    };
    let count =
        |name, value, target| Figure { name, unit: "1", hub: vec![value], baseline: Vec::new(), target };
    let mut figures = vec![
        figure("exec to services up", |start| start.up_ms, Target::Max(50.0)),
        figure("exec to first telegram, sooner", |start| start.first_ms[0], Target::Max(500.0)),
        figure("exec to first telegram, later", |start| start.first_ms[1], Target::Max(500.0)),
        count("telegrams received", received, Target::None),
        count("of them torn", torn, Target::Max(0.0)),
        count("missed within a run", missed, Target::Max(0.0)),
        count("EEPROM writes", writes, Target::Max(0.0)),
    ];
    drop(environment);
    figures.extend(measure_kept_line(options.count(20))?);
    figures::print("restart", options.json, &figures);
    Ok(())
}

/// Times of a start, in milliseconds from exec.
struct StartTimes {
    up_ms: f64,
    /// Times of the first telegram at the two subscribers, the earlier time first.
    first_ms: [f64; 2],
}

impl StartTimes {
    fn new(started_ns: u64, up_ns: u64, mut first_ns: [u64; 2]) -> StartTimes {
        first_ns.sort_unstable();
        let since = |at: u64| (at - started_ns) as f64 / 1e6;
        StartTimes { up_ms: since(up_ns), first_ms: first_ns.map(since) }
    }
}

/// The current run of the hub, and the subscribers, which stay attached over all runs.
struct HubRuns<'a> {
    stage: &'a BenchEnvironment,
    subscribers: &'a [Child],
    hub: Option<Child>,
    incomplete: u64,
    missed: u64,
    received: u64,
}

impl HubRuns<'_> {
    fn kill(&mut self) -> Outcome<()> {
        if let Some(hub) = self.hub.take() {
            hub.guard.kill()?;
        }
        for subscriber in self.subscribers {
            for line in subscriber.lines_so_far() {
                self.count(&line.words());
            }
        }
        Ok(())
    }

    /// Kills the hub, if one runs, and starts the next one. Returns the time at which the new hub is up and the times
    /// at which the subscribers have a telegram of the new hub.
    fn restart(&mut self) -> Outcome<StartTimes> {
        self.kill()?;
        let hub = self.stage.start_hub(&SENSORS)?;
        let up_ns = hub.wait_for_line("ready", STEP_TIMEOUT)?.at_ns;
        let mut first_ns = [0; 2];
        for (first_ns, subscriber) in first_ns.iter_mut().zip(self.subscribers) {
            // Lines about the last telegrams of the killed hub may still be in the pipe.
            while *first_ns < hub.started_ns {
                let line = subscriber.wait_for_line("telegram", STEP_TIMEOUT)?;
                self.count(&line.words());
                *first_ns = line.number(2)?;
            }
        }
        let start = StartTimes::new(hub.started_ns, up_ns, first_ns);
        self.hub = Some(hub);
        Ok(start)
    }

    fn count(&mut self, words: &[&str]) {
        if let ["telegram", _, _, _, missed, intact, ..] = words {
            self.received += 1;
            self.missed += missed.parse().unwrap_or(1);
            self.incomplete += u64::from(*intact != "true");
        }
    }
}

fn start_baseline(environment: &BenchEnvironment) -> Outcome<StartTimes> {
    let baseline = environment.start_baseline(&SENSORS, 0, baseline::WAKE_AHEAD_NS)?;
    let up_ns = baseline.wait_for_line("ready", STEP_TIMEOUT)?.at_ns;
    let mut first_ns = [0; 2];
    while first_ns.contains(&0) {
        let line = baseline.wait_for_line("woken", STEP_TIMEOUT)?;
        let first_ns = &mut first_ns[line.number(1)? as usize];
        if *first_ns == 0 {
            *first_ns = line.number(2)?;
        }
    }
    let start = StartTimes::new(baseline.started_ns, up_ns, first_ns);
    baseline.guard.kill()?;
    Ok(start)
}

/// Returns the duration of run number `n`. The durations differ, so that each run ends at a different phase of the
/// stream.
fn run_time(n: usize) -> Duration {
    Duration::from_millis(700 + 11 * (n as u64 % 20))
}

/// Measures a hub whose line a service manager keeps open, as with the unit in hub/dist. The hub is killed `kills`
/// times, evenly distributed over a telegram. In a second series, with half as many kills, the hub is killed in the 0.6
/// ms in which it reads a telegram. Only in this time, a telegram has left the line but is not published yet. The
/// telegrams that a subscriber received are compared with those that the simulated sensor sent.
fn measure_kept_line(kills: usize) -> Outcome<Vec<Figure>> {
    let spread = kill_with_kept_line(kills, |n| SCAN_PERIOD_NS * (2 * n + 1) / (2 * kills as u64))?;
    let reading = kill_with_kept_line(kills.div_ceil(2), |_| SCAN_PERIOD_NS - READ_AHEAD_NS / 2)?;
    let series = |name, hub, target| Figure { name, unit: "ms", hub, baseline: Vec::new(), target };
    let count = |name, value: usize, target| Figure {
        name,
        unit: "1",
        hub: vec![value as f64],
        baseline: Vec::new(),
        target,
    };
    let longest = |silences: &[f64]| silences.iter().copied().fold(0.0, f64::max);
    Ok(vec![
        series("kept: silence of telegrams", spread.telegrams_ms.clone(), Target::None),
        series("kept: longest silence", vec![longest(&spread.telegrams_ms)], Target::Max(300.0)),
        series("kept: silence of scans", spread.scans_ms.clone(), Target::None),
        series("kept: longest silence", vec![longest(&spread.scans_ms)], Target::Max(300.0)),
        count("kept: kills", kills, Target::None),
        count("kept: telegrams sent", spread.sent, Target::None),
        count("kept: telegrams lost", spread.lost, Target::Max(0.0)),
        count("kept: of these, while none was being read", spread.lost_while_idle, Target::Max(0.0)),
        count("kept: aborted by the sensor", spread.aborted, Target::None),
        count("kept, while reading: kills", kills.div_ceil(2), Target::None),
        count("kept, while reading: lost", reading.lost, Target::None),
        count(
            "kept, while reading: of these, while none was being read",
            reading.lost_while_idle,
            Target::Max(0.0),
        ),
    ])
}

/// Results of several kills.
#[derive(Default)]
struct KillResults {
    /// For each kill, the time from the last telegram of a run to the first telegram of the next run, at the
    /// subscriber.
    telegrams_ms: Vec<f64>,
    /// For each kill, the time from the last scan of a run to the first scan of the next run, at the subscriber.
    scans_ms: Vec<f64>,
    /// Number of complete telegrams of measured data that the sensor sent between the first and the last telegram that
    /// was received, including these two.
    sent: usize,
    lost: usize,
    /// Number of lost telegrams that no killed hub can have been reading. (A hub that wakes late reads a telegram later
    /// than usual.)
    lost_while_idle: usize,
    /// Number of telegrams that the sensor aborted between the first and the last received telegram, in order to reply
    /// to the next hub.
    aborted: usize,
}

/// A subscriber, with the time of the last sample that it has received.
struct Receiver {
    process: Child,
    /// Indexes of two words in a line of the subscriber: the time at which a sample was received, and the run of the
    /// hub that sent the sample.
    words: (usize, usize),
    boot: u64,
    last_ns: u64,
    silences_ms: Vec<f64>,
    /// All lines that the subscriber has printed.
    lines: Vec<Vec<String>>,
}

impl Receiver {
    fn new(process: Child, words: (usize, usize)) -> Receiver {
        Receiver { process, words, boot: 0, last_ns: 0, silences_ms: Vec::new(), lines: Vec::new() }
    }

    /// Waits for the next sample. If it is from a new run, stores the silence before it.
    fn next(&mut self) -> Outcome<()> {
        let line = self.process.next_line(STEP_TIMEOUT)?;
        let words = line.words();
        if words.len() <= self.words.1 {
            return Ok(());
        }
        let (at_ns, boot) = (line.number(self.words.0)?, line.number(self.words.1)?);
        if boot != self.boot && self.boot != 0 {
            self.silences_ms.push((at_ns - self.last_ns) as f64 / 1e6);
        }
        (self.boot, self.last_ns) = (boot, at_ns);
        self.lines.push(words.into_iter().map(str::to_owned).collect());
        Ok(())
    }

    /// Receives samples until one has arrived at `until_ns` or later, and until the run of the hub has changed
    /// `run_changes` times in total.
    fn receive_until(&mut self, until_ns: u64, run_changes: usize) -> Outcome<()> {
        while self.last_ns < until_ns || self.silences_ms.len() < run_changes {
            self.next()?;
        }
        Ok(())
    }
}

/// Kills the hub `kills` times. Kill number n happens `moment(n)` nanoseconds after the last byte of a telegram.
fn kill_with_kept_line(kills: usize, moment: impl Fn(u64) -> u64) -> Outcome<KillResults> {
    let environment = BenchEnvironment::new()?;
    let sensor = SENSORS[0];
    let simulator = environment.simulate_one(sensor, &["--baud", "500000"])?;
    let mut supervisor = Supervisor::new(environment.file("notify").display().to_string());
    let command = environment.hub_command(PROGRAM, &[sensor]);
    let mut start = || -> Outcome<Child> {
        let (command, stdin) = supervisor.service(&command, None);
        let hub = Child::spawn(command, stdin)?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        supervisor.wait_for_message(&format!("FDNAME={sensor}"));
        Ok(hub)
    };
    let mut hub = start()?;
    let mut telegrams = Receiver::new(environment.start_subscriber("telegram", sensor, &["0"])?, (2, 3));
    let mut scans = Receiver::new(
        environment.start_part(&["consume", "each", environment.domain.name(), sensor])?,
        (2, 3),
    );
    let mut killed_ns = Vec::new();
    for n in 0..kills {
        let settled_ns = clock::now() + SETTLE_TIME.as_nanos() as u64;
        telegrams.receive_until(settled_ns, n)?;
        scans.receive_until(settled_ns, n)?;
        let last_byte_ns: u64 = telegrams.lines.last().ok_or("no telegram")?[7].parse()?;
        clock::sleep_until(last_byte_ns + moment(n as u64) + SCAN_PERIOD_NS);
        killed_ns.push(clock::now());
        hub.guard.kill()?;
        thread::sleep(RESTART_PAUSE);
        hub = start()?;
    }
    let settled_ns = clock::now() + SETTLE_TIME.as_nanos() as u64;
    telegrams.receive_until(settled_ns, kills)?;
    scans.receive_until(settled_ns, kills)?;
    hub.guard.kill()?;
    drop(simulator);
    let truth = SensorTruth::read(&environment.own_truth(sensor), sensor)?;
    let received: HashSet<&str> = telegrams.lines.iter().map(|words| words[6].as_str()).collect();
    let is_received = |hash: &String| received.contains(hash.as_str());
    let first = truth.sent.iter().position(|sent| is_received(&sent.hash)).ok_or("nothing was sent")?;
    let last = truth.sent.iter().rposition(|sent| is_received(&sent.hash)).ok_or("nothing was sent")?;
    let span = &truth.sent[first..=last];
    let lost: Vec<u64> = span.iter().filter(|sent| !is_received(&sent.hash)).map(|sent| sent.at_ns).collect();
    let is_reading = |end_ns: u64, killed_ns: u64| {
        (end_ns.saturating_sub(READ_AHEAD_NS + CLOCK_NOISE_NS)..end_ns + MAX_DELAY_NS).contains(&killed_ns)
    };
    let otherwise = |end_ns: &&u64| !killed_ns.iter().any(|killed_ns| is_reading(**end_ns, *killed_ns));
    let meanwhile = span[0].at_ns..span[span.len() - 1].at_ns;
    Ok(KillResults {
        telegrams_ms: telegrams.silences_ms,
        scans_ms: scans.silences_ms,
        sent: span.len(),
        lost: lost.len(),
        lost_while_idle: lost.iter().filter(otherwise).count(),
        aborted: truth.aborted_ns.iter().filter(|at_ns| meanwhile.contains(*at_ns)).count(),
    })
}

/// Time from one telegram of 361 beams to the next, in nanoseconds. This is the time of two revolutions of the mirror.
const SCAN_PERIOD_NS: u64 = 26_640_000;
/// Time before the end of a telegram at which the hub starts to read the telegram, in nanoseconds.
const READ_AHEAD_NS: u64 = 600_000;
/// Maximum difference between the times that two processes report for the same event, in nanoseconds.
const CLOCK_NOISE_NS: u64 = 400_000;
/// Maximum delay of a hub that shares its processors with other programs, in nanoseconds.
const MAX_DELAY_NS: u64 = 4_000_000;
/// Time after which the hub has certainly estimated the timing of the sensor.
const SETTLE_TIME: Duration = Duration::from_millis(700);
/// Time that a service manager waits before it restarts the hub: `RestartSec` of the unit.
const RESTART_PAUSE: Duration = Duration::from_millis(20);
