//! Costs of many subscribers, effects of broken subscribers on the others, and growth of the hub's costs.
//!
//! At first, a hundred subscribers receive the scans of one sensor at the same time. Then a process that holds samples
//! is killed twenty times, a subscriber is stopped for two seconds, and subscribers take all slots of a topic. Another
//! subscriber, the witness, must not lose a sample. After that, the hub must be in the same state as before.
//!
//! CPU time and memory are then measured for several numbers of subscribers, of sensors on lines, of sensors in virtual
//! time, and of beams. A fit shows how each of these costs grows. Subscribers are threads of four processes. Lines are
//! ptys of this machine. The table shows the rate of the sensors, which drops if simulators and hub cannot keep up. The
//! bench does not measure real adapters.
//!
//! How to read the figures:
//!
//! - In virtual time, the whole hub runs without ports and without waiting (`tests/testkit/virtual_hub.rs`). Simulated
//!   telegrams arrive in three reads and pass framer, session, decoding and all processors into all topics in shared
//!   memory. One system call wakes the subscribers, and one subscriber to each topic takes all samples. Reads, sleeps
//!   and wake-ups of subscribers are not included; `sensors on ptys` and `subscribers of one sensor` include them.
//! - If there are many sensors, they run in hubs of 125 sensors at the same time. From about ten to about a hundred
//!   sensors, the cost per sensor increases because of the second-level cache. For each sample, the library checks all
//!   possible subscriber slots of the topic, which are 1168 bytes apart.
//! - A table of growth has the fit `fixed + for each * n`, which minimizes the squares of relative errors. It also has
//!   the slope of the logarithms, for numbers from a sixteenth of the largest number upward. If this slope exceeds the
//!   slope of linear growth by 0.25, the growth is reported as worse than linear.
//! - Latency is that of the last subscriber that receives a scan. Numbers of sensors above 125 are measured only once.
//! - `program and libraries` are pages of the executable, which the machine holds only once. Touched shared memory is
//!   the part of the memory for samples that is in use. It is small because the same few samples are used repeatedly.

mod growth;
mod many_subscribers;
mod sensors;
#[path = "../support/mod.rs"]
mod support;
#[path = "../../tests/testkit/virtual_hub.rs"]
mod virtual_hub;

use std::fs;
use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use scanhub_schema::{Counter, Status};
use support::environment::{BenchEnvironment, Child, OutputLine, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::usage::{ResidentMemory, ThreadUsage};
use support::{Options, Outcome, subscriber};

fn main() -> ExitCode {
    let play = |words: &[&str]| match *words {
        ["driven", begin, beams, sensors, telegrams, followed] => {
            let followed = followed.parse()?;
            sensors::drive(begin.as_ref(), beams.parse()?, sensors.parse()?, telegrams.parse()?, followed)
        }
        ["followers", domain, sensor, count, seconds, wait] => {
            many_subscribers::subscribe_many(domain, sensor, count.parse()?, seconds.parse()?, wait)
        }
        _ => support::run_part(words),
    };
    support::main_with(play, measure)
}

fn measure(options: &Options) -> Outcome<()> {
    faults(options)?;
    sensors::measure_virtual_time(options)?;
    sensors::measure_variants(options)?;
    many_subscribers::measure_subscribers(options)?;
    many_subscribers::measure_memory(options)?;
    sensors::measure_lines(options)
}

/// Measures many subscribers, and the effects of broken subscribers on the others.
fn faults(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate(&[SENSOR], 500_000)?;
    let hub = environment.hub_with_many_slots(&[SENSOR])?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let mut figures = measure_many_subscribers(&environment, &hub, options.count(100), options.seconds(20))?;
    figures.extend(measure_kills(&environment, &hub)?);
    figures.extend(measure_stopped(&environment)?);
    figures.extend(fill_slots(&environment)?);
    // Wait until the slots of the many subscribers are free, because the next call needs a slot of topic `status`.
    thread::sleep(CLEANUP_TIMEOUT);
    let failed = counter(&environment, Counter::LoanFailed)?;
    figures.push(figure("samples without memory", "1", failed, Target::Max(0.0)));
    figures::print("subscribers", options.json, &figures);
    Ok(())
}

/// Measures `count` subscribers for `seconds`.
fn measure_many_subscribers(
    environment: &BenchEnvironment,
    hub: &Child,
    count: usize,
    seconds: u64,
) -> Outcome<Vec<Figure>> {
    let before = start_subscriber(environment)?;
    let each = count.div_ceil(PROCESS_COUNT).to_string();
    let start =
        |_| environment.start_part(&["many", environment.domain.name(), SENSOR, &each, &seconds.to_string()]);
    let children: Vec<Child> = (0..PROCESS_COUNT).map(start).collect::<Outcome<_>>()?;
    for child in &children {
        child.wait_for_line("following", STEP_TIMEOUT)?;
    }
    let (from, telegrams) =
        (ThreadUsage::of(hub.guard.pid(), |_| true)?, counter(environment, Counter::Telegrams)?);
    let mut lines = Vec::new();
    for child in &children {
        lines.extend(child.lines_until("end", STEP_TIMEOUT + Duration::from_secs(seconds))?);
    }
    let work = ThreadUsage::of(hub.guard.pid(), |_| true)?.since(from);
    let telegrams = counter(environment, Counter::Telegrams)? - telegrams;
    let sum =
        |i| lines.iter().map(|line: &OutputLine| line.number(i)).sum::<Outcome<u64>>().map(|sum| sum as f64);
    let [received, missed, published] = [sum(1)?, sum(2)?, sum(3)?];
    drop(before);
    Ok(vec![
        figure("subscribers", "1", lines.len() as f64, Target::None),
        figure("scans received by them", "1", received, Target::None),
        figure("missed", "1", missed, Target::Max(0.0)),
        figure("not accounted for", "1", (published - received - missed).abs(), Target::Max(0.0)),
        figure("CPU time of the hub per telegram", "us", work.busy_ns as f64 / 1e3 / telegrams, Target::None),
    ])
}

/// Repeatedly kills a process that holds samples.
fn measure_kills(environment: &BenchEnvironment, hub: &Child) -> Outcome<Vec<Figure>> {
    let witness = start_subscriber(environment)?;
    let open = || -> Outcome<usize> { Ok(fs::read_dir(format!("/proc/{}/fd", hub.guard.pid()))?.count()) };
    let segments = || -> Outcome<usize> {
        let entries = fs::read_dir("/dev/shm")?.flatten();
        let prefix = environment.domain.prefix();
        Ok(entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)).count())
    };
    thread::sleep(CLEANUP_TIMEOUT);
    let before = (open()?, segments()?, resident(hub)?);
    let mut held = 0;
    for _ in 0..KILL_COUNT {
        let holder = environment.start_part(&["hold", environment.domain.name(), SENSOR, "12"])?;
        held += holder.wait_for_line("holding", STEP_TIMEOUT)?.number(1)?;
        holder.guard.kill()?;
    }
    thread::sleep(CLEANUP_TIMEOUT);
    let after = (open()?, segments()?, resident(hub)?);
    let grown = |before: usize, after: usize| after as f64 - before as f64;
    Ok(vec![
        figure("samples held by killed processes", "1", held as f64, Target::None),
        figure("missed by the witness", "1", missed(&witness)?, Target::Max(0.0)),
        figure("more descriptors of the hub", "1", grown(before.0, after.0), Target::Max(0.0)),
        figure("more segments", "1", grown(before.1, after.1), Target::Max(0.0)),
        figure("more resident memory of the hub", "kB", grown(before.2, after.2), Target::Max(64.0)),
    ])
}

/// Stops a subscriber for two seconds.
fn measure_stopped(environment: &BenchEnvironment) -> Outcome<Vec<Figure>> {
    // The witness attaches first, so it reports all samples that the stopped subscriber may miss.
    let (witness, stopped) = (start_subscriber(environment)?, start_subscriber(environment)?);
    let pid = Pid::from_raw(stopped.guard.pid() as i32).ok_or("no process")?;
    thread::sleep(Duration::from_secs(1));
    kill_process(pid, Signal::STOP)?;
    thread::sleep(Duration::from_secs(2));
    kill_process(pid, Signal::CONT)?;
    thread::sleep(Duration::from_secs(1));
    let (stopped, witness) = (measured(&stopped), measured(&witness));
    let read = |line: &OutputLine| line.number(7);
    let span = read(stopped.first().ok_or("no telegram arrived")?)?
        ..=read(stopped.last().ok_or("no telegram arrived")?)?;
    let mut published = 0.0;
    for line in &witness {
        published += f64::from(u8::from(span.contains(&read(line)?)));
    }
    let [lost, others] = [sum_of_missed(&stopped)?, sum_of_missed(&witness)?];
    Ok(vec![
        figure("missed by the stopped subscriber", "1", lost, Target::None),
        figure(
            "of these not reported",
            "1",
            (published - stopped.len() as f64 - lost).abs(),
            Target::Max(0.0),
        ),
        figure("missed by the witness of the stop", "1", others, Target::Max(0.0)),
    ])
}

/// Attaches one subscriber more than a topic has slots.
fn fill_slots(environment: &BenchEnvironment) -> Outcome<Vec<Figure>> {
    let child = environment.start_part(&["stay", environment.domain.name(), SENSOR, "210"])?;
    let refused = child.wait_for_line("refused", 6 * STEP_TIMEOUT)?;
    eprintln!("{}", refused.text);
    Ok(vec![figure("subscribers before one was refused", "1", refused.number(1)? as f64, Target::None)])
}

/// Starts a subscriber that prints each telegram, and waits for the first one.
fn start_subscriber(environment: &BenchEnvironment) -> Outcome<Child> {
    let subscriber = environment.start_subscriber("telegram", SENSOR, &["0"])?;
    subscriber.wait_for_line("telegram", STEP_TIMEOUT)?;
    Ok(subscriber)
}

fn measured(consumer: &Child) -> Vec<OutputLine> {
    consumer.lines_so_far().into_iter().filter(|line| line.text.starts_with("telegram")).collect()
}

fn missed(consumer: &Child) -> Outcome<f64> {
    sum_of_missed(&measured(consumer))
}

fn sum_of_missed(lines: &[OutputLine]) -> Outcome<f64> {
    lines.iter().map(|line| line.number(4)).sum::<Outcome<u64>>().map(|sum| sum as f64)
}

fn counter(stage: &BenchEnvironment, counter: Counter) -> Outcome<f64> {
    let mut status =
        subscriber::builder::<Status>(stage.domain.name(), SENSOR).timeout(STEP_TIMEOUT).open()?;
    Ok(status.next()?.ok_or("no status")?.counters[counter] as f64)
}

/// Returns the resident memory of the hub in kB, without shared memory.
fn resident(hub: &Child) -> Outcome<usize> {
    Ok((ResidentMemory::of(hub.guard.pid())?.heap_and_stacks / 1024.0) as usize)
}

fn figure(name: &'static str, unit: &'static str, value: f64, target: Target) -> Figure {
    Figure { name, unit, hub: vec![value], baseline: Vec::new(), target }
}

const SENSOR: &str = "front";
const PROCESS_COUNT: usize = 4;
const KILL_COUNT: usize = 20;
/// Time after which the hub has certainly cleaned up after dead processes, which it does every 5 s.
const CLEANUP_TIMEOUT: Duration = Duration::from_secs(12);
