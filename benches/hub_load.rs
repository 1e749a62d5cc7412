//! What does the hub cost while two sensors stream? Measures its CPU time and its sleeps per telegram, with one
//! sleeping subscriber per sensor. The baseline is a bare reader of the same ptys that makes only the necessary system
//! calls and wakes a process per telegram. Each run is long; runs of the hub and of the baseline alternate on the same
//! two lines. The bench does not measure what subscribers cost, or what happens on a real adapter.

mod support;

use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use scanhub_schema::{Counter, Status};
use support::figures::{self, Figure, Target};
use support::stage::{Child, PATIENCE, SENSORS, Stage};
use support::truth::Truth;
use support::usage::Work;
use support::{Options, Outcome, clock, consumer};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let span = Duration::from_secs(options.seconds(20));
    // The first hub sets the sensors going; from then on they stream to whoever reads.
    start_hub(&stage)?.0.guard.kill()?;
    let (mut hub, mut baseline) = (Series::default(), Series::default());
    for pair in 0..options.pairs() {
        if pair % 2 == 0 {
            hub.push(load_of_hub(&stage, span)?);
            baseline.push(load_of_baseline(&stage, span)?);
        } else {
            baseline.push(load_of_baseline(&stage, span)?);
            hub.push(load_of_hub(&stage, span)?);
        }
    }
    let figure = |name, unit, hub, baseline, target| Figure { name, unit, hub, baseline, target };
    let figures = [
        figure("CPU time per telegram", "us", hub.busy_us, baseline.busy_us, Target::Ratio(2.0)),
        figure("of it in threads that read", "us", hub.readers_us, baseline.readers_us, Target::None),
        figure("sleeps per telegram", "1", hub.sleeps, baseline.sleeps, Target::Most(6.0)),
        figure("of it in threads that read", "1", hub.readers_sleeps, baseline.readers_sleeps, Target::None),
        figure("preemptions per telegram", "1", hub.preempted, baseline.preempted, Target::None),
        figure("counter wakeups per telegram", "1", hub.wakeups, Vec::new(), Target::None),
        figure("telegrams per run", "1", hub.telegrams, baseline.telegrams, Target::None),
    ];
    figures::print("hub_load", options.json, &figures);
    Ok(())
}

/// One run.
#[derive(Default)]
struct Load {
    telegrams: f64,
    all: Work,
    readers: Work,
    wakeups: Option<f64>,
}

/// The figures of all runs, in their order.
#[derive(Default)]
struct Series {
    telegrams: Vec<f64>,
    busy_us: Vec<f64>,
    readers_us: Vec<f64>,
    sleeps: Vec<f64>,
    readers_sleeps: Vec<f64>,
    preempted: Vec<f64>,
    wakeups: Vec<f64>,
}

impl Series {
    fn push(&mut self, load: Load) {
        let each = |count: u64| count as f64 / load.telegrams;
        self.telegrams.push(load.telegrams);
        self.busy_us.push(each(load.all.busy_ns) / 1e3);
        self.readers_us.push(each(load.readers.busy_ns) / 1e3);
        self.sleeps.push(each(load.all.voluntary));
        self.readers_sleeps.push(each(load.readers.voluntary));
        self.preempted.push(each(load.all.involuntary));
        self.wakeups.extend(load.wakeups);
    }
}

fn load_of_hub(stage: &Stage, span: Duration) -> Outcome<Load> {
    let (hub, _consumers) = start_hub(stage)?;
    thread::sleep(SETTLING);
    let before = counters(stage)?;
    let mut load = observe(stage, hub.guard.pid(), span)?;
    let after = counters(stage)?;
    load.wakeups = Some((after.0 - before.0) / (after.1 - before.1));
    hub.guard.kill()?;
    Ok(load)
}

fn load_of_baseline(stage: &Stage, span: Duration) -> Outcome<Load> {
    let baseline = stage.bare(&SENSORS, 0)?;
    baseline.await_line("woken", PATIENCE)?;
    thread::sleep(SETTLING);
    let load = observe(stage, baseline.guard.pid(), span)?;
    baseline.guard.kill()?;
    Ok(load)
}

/// The hub and a consumer per sensor, once scans come.
fn start_hub(stage: &Stage) -> Outcome<(Child, Vec<Child>)> {
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let consumers: Vec<Child> =
        SENSORS.iter().map(|sensor| stage.consumer("scan", sensor, &[])).collect::<Outcome<_>>()?;
    consumers.iter().try_for_each(|consumer| consumer.await_line("scan", PATIENCE).map(drop))?;
    Ok((hub, consumers))
}

/// What process `pid` uses in `span`, and how many telegrams were sent meanwhile.
fn observe(stage: &Stage, pid: u32, span: Duration) -> Outcome<Load> {
    let leader = std::fs::read_to_string(format!("/proc/{pid}/comm"))?;
    let is_reader = |name: &str| SENSORS.contains(&name);
    // The baseline's readers have their process's name; its first thread only waits for them.
    let is_baseline = !leader.starts_with("scanhub");
    let look = || -> Outcome<(u64, Work, Work)> {
        let all = Work::of(pid, |_| true)?;
        Ok((clock::now(), all, if is_baseline { all } else { Work::of(pid, is_reader)? }))
    };
    let before = look()?;
    thread::sleep(span);
    let after = look()?;
    let sent: Outcome<Vec<usize>> = SENSORS
        .iter()
        .map(|sensor| Ok(Truth::read(&stage.truth(), sensor)?.count(before.0, after.0)))
        .collect();
    Ok(Load {
        telegrams: sent?.iter().sum::<usize>() as f64,
        all: after.1.since(before.1),
        readers: after.2.since(before.2),
        wakeups: None,
    })
}

/// What the hub itself counted: wake-ups and telegrams, of both links. Looked at outside of a run, because who looks is
/// one consumer more.
fn counters(stage: &Stage) -> Outcome<(f64, f64)> {
    let mut sum = (0, 0);
    for sensor in SENSORS {
        let mut statuses =
            consumer::subscribe::<Status>(stage.domain.name(), sensor)?.timeout(Duration::from_secs(3));
        let status = statuses.next()?.ok_or("no status")?;
        sum.0 += status.counters[Counter::Wakeups];
        sum.1 += status.counters[Counter::Telegrams];
    }
    Ok((sum.0 as f64, sum.1 as f64))
}

/// Until the rhythm is learned and start-up is over.
const SETTLING: Duration = Duration::from_secs(2);
