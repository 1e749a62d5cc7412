//! What does a SIGKILL of the hub cost where a service manager keeps its line, as the unit in hub/dist does? Kills at moments
//! that are spread evenly over a telegram, and kills in the 0.6 ms in which one is being read, the only time in which it has
//! left the line and is not yet sent. It compares what a consumer got with what the simulated sensor says that it sent.

use std::collections::HashSet;
use std::thread;
use std::time::Duration;

use super::supervisor::Supervisor;
use super::support::child::Child;
use super::support::figures::{Figure, Target};
use super::support::stage::{PATIENCE, PROGRAM, SENSORS, Stage};
use super::support::truth::Truth;
use super::support::{Outcome, clock};

/// The figures of `kills` and of half as many in the midst of reading.
pub(crate) fn figures(kills: usize) -> Outcome<Vec<Figure>> {
    let spread = run(kills, |n| PERIOD_NS * (2 * n + 1) / (2 * kills as u64))?;
    let reading = run(kills.div_ceil(2), |_| PERIOD_NS - READING_NS / 2)?;
    let series = |name, hub, target| Figure { name, unit: "ms", hub, floor: Vec::new(), target };
    let count = |name, value: usize, target| Figure {
        name,
        unit: "1",
        hub: vec![value as f64],
        floor: Vec::new(),
        target,
    };
    let longest = |silences: &[f64]| silences.iter().copied().fold(0.0, f64::max);
    Ok(vec![
        series("kept: silence of telegrams", spread.telegrams_ms.clone(), Target::None),
        series("kept: the longest", vec![longest(&spread.telegrams_ms)], Target::Most(300.0)),
        series("kept: silence of scans", spread.scans_ms.clone(), Target::None),
        series("kept: the longest", vec![longest(&spread.scans_ms)], Target::Most(300.0)),
        count("kept: kills", kills, Target::None),
        count("kept: telegrams sent", spread.sent, Target::None),
        count("kept: telegrams lost", spread.lost, Target::Most(0.0)),
        count("kept: lost without being read", spread.lost_otherwise, Target::Most(0.0)),
        count("kept: broken off by the sensor", spread.aborted, Target::None),
        count("kept, while reading: kills", kills.div_ceil(2), Target::None),
        count("kept, while reading: lost", reading.lost, Target::None),
        count("kept, while reading: lost otherwise", reading.lost_otherwise, Target::Most(0.0)),
    ])
}

/// What came of some kills.
#[derive(Default)]
struct Cost {
    /// From the last telegram of a life in a consumer's hands to the first of the next one.
    telegrams_ms: Vec<f64>,
    /// The same of scans.
    scans_ms: Vec<f64>,
    /// Whole telegrams of measured data from the first that was received to the last.
    sent: usize,
    lost: usize,
    /// Of them those that no hub was reading when it was killed.
    lost_otherwise: usize,
    /// Telegrams that the sensor broke off meanwhile, to answer the next hub.
    aborted: usize,
}

/// A consumer, and when it got the last sample of each life.
struct Follower {
    process: Child,
    /// Words of a line: when the sample was received, and which life it is of.
    words: (usize, usize),
    boot: u64,
    last_ns: u64,
    silences_ms: Vec<f64>,
    /// All lines that it wrote.
    lines: Vec<Vec<String>>,
}

impl Follower {
    fn new(process: Child, words: (usize, usize)) -> Follower {
        Follower { process, words, boot: 0, last_ns: 0, silences_ms: Vec::new(), lines: Vec::new() }
    }

    /// Waits for the next sample.
    fn next(&mut self) -> Outcome<()> {
        let line = self.process.next_line(PATIENCE)?;
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

    /// Follows until it got something at or after `until_ns` and, if there was a life before, of another than that.
    fn follow(&mut self, until_ns: u64, silences: usize) -> Outcome<()> {
        while self.last_ns < until_ns || self.silences_ms.len() < silences {
            self.next()?;
        }
        Ok(())
    }
}

/// Kills the hub `kills` times, number n so long after the last byte of a telegram as `moment` says.
fn run(kills: usize, moment: impl Fn(u64) -> u64) -> Outcome<Cost> {
    let stage = Stage::new()?;
    let sensor = SENSORS[0];
    let simulator = stage.simulate_one(sensor, &["--baud", "500000"])?;
    let mut supervisor = Supervisor::new(stage.file("notify").display().to_string());
    let command = stage.hub_command(PROGRAM, &[sensor]);
    let mut start = || -> Outcome<Child> {
        let (command, stdin) = supervisor.service(&command, None);
        let hub = Child::of(command, stdin)?;
        hub.await_line("ready", PATIENCE)?;
        supervisor.hear(&format!("FDNAME={sensor}"));
        Ok(hub)
    };
    let mut hub = start()?;
    let mut telegrams = Follower::new(stage.consumer("telegram", sensor, &["0"])?, (2, 3));
    let mut scans = Follower::new(stage.part(&["consume", "each", stage.domain.name(), sensor])?, (2, 3));
    let mut killed_ns = Vec::new();
    for n in 0..kills {
        let settled_ns = clock::now() + SETTLING.as_nanos() as u64;
        telegrams.follow(settled_ns, n)?;
        scans.follow(settled_ns, n)?;
        let last_byte_ns: u64 = telegrams.lines.last().ok_or("no telegram")?[7].parse()?;
        clock::rest(last_byte_ns + moment(n as u64) + PERIOD_NS);
        killed_ns.push(clock::now());
        hub.guard.kill()?;
        thread::sleep(RESTART);
        hub = start()?;
    }
    let settled_ns = clock::now() + SETTLING.as_nanos() as u64;
    telegrams.follow(settled_ns, kills)?;
    scans.follow(settled_ns, kills)?;
    hub.guard.kill()?;
    drop(simulator);
    let truth = Truth::read(&stage.own_truth(sensor), sensor)?;
    let received: HashSet<&str> = telegrams.lines.iter().map(|words| words[6].as_str()).collect();
    let is_received = |hash: &String| received.contains(hash.as_str());
    let first = truth.sent.iter().position(|sent| is_received(&sent.hash)).ok_or("nothing was sent")?;
    let last = truth.sent.iter().rposition(|sent| is_received(&sent.hash)).ok_or("nothing was sent")?;
    let span = &truth.sent[first..=last];
    let lost: Vec<u64> = span.iter().filter(|sent| !is_received(&sent.hash)).map(|sent| sent.at_ns).collect();
    let is_reading = |end_ns: u64, killed_ns: u64| {
        (end_ns.saturating_sub(READING_NS + NOISE_NS)..end_ns + LATE_NS).contains(&killed_ns)
    };
    let otherwise = |end_ns: &&u64| !killed_ns.iter().any(|killed_ns| is_reading(**end_ns, *killed_ns));
    let meanwhile = span[0].at_ns..span[span.len() - 1].at_ns;
    Ok(Cost {
        telegrams_ms: telegrams.silences_ms,
        scans_ms: scans.silences_ms,
        sent: span.len(),
        lost: lost.len(),
        lost_otherwise: lost.iter().filter(otherwise).count(),
        aborted: truth.aborted_ns.iter().filter(|at_ns| meanwhile.contains(*at_ns)).count(),
    })
}

/// Between two telegrams of 361 values: two turns of the mirror.
const PERIOD_NS: u64 = 26_640_000;
/// The hub begins to read so long before a telegram's end.
const READING_NS: u64 = 600_000;
/// What two processes differ in when they say that something happened.
const NOISE_NS: u64 = 400_000;
/// So much later a hub may come to it that shares its processors with others.
const LATE_NS: u64 = 4_000_000;
/// Long after it knows the rhythm of its sensor.
const SETTLING: Duration = Duration::from_millis(700);
/// A service manager takes so long: RestartSec of the unit.
const RESTART: Duration = Duration::from_millis(20);
