//! Cost of the hub per telegram. The bench measures the CPU time and the number of sleeps of the hub while 1, 2 or 4
//! sensors stream, with one sleeping subscriber per sensor. The baseline is a minimal reader of ptys that makes only
//! the necessary system calls, and wakes a process for each telegram. The hub and the baselines run at the same time
//! (`support/simultaneous.rs`). With `--beside PROGRAM`, the hub of another build also runs at the same time. The bench
//! does not measure the cost of subscribers or of a real adapter.

mod support;

use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use scanhub_schema::{Counter, Status};
use support::environment::{BenchEnvironment, STEP_TIMEOUT};
use support::figures::{self, SimultaneousFigure, Target, percentile};
use support::simultaneous::{Comparison, MeasuredProgram, SETTLE_TIME};
use support::truth::SensorTruth;
use support::usage::ThreadUsage;
use support::{Options, Outcome, clock, subscriber};

fn main() -> ExitCode {
    support::main(|options| {
        options.sensors(&[1, 2, 4]).into_iter().try_for_each(|sensors| measure(options, sensors))
    })
}

fn measure(options: &Options, sensors: usize) -> Outcome<()> {
    let comparison = Comparison::start(options, sensors)?;
    let seconds = options.seconds(20);
    let mut rounds = Vec::new();
    for round in 0..comparison.rounds(options) {
        rounds.push(load_of_round(&comparison, round, seconds)?);
    }
    let figure = |name, unit, of: fn(&Load) -> Option<f64>, target| {
        // Take the median of the seconds of a round. Because of other programs on the machine, the hub needs far more
        // CPU time in some seconds than in most.
        let in_round = |loads: &Vec<Load>| {
            let mut seconds: Vec<f64> = loads.iter().filter_map(of).collect();
            seconds.sort_by(f64::total_cmp);
            percentile(&seconds, 0.5)
        };
        let series = |number: usize| rounds.iter().filter_map(|loads| in_round(&loads[number])).collect();
        let programs = (0..comparison.programs.len()).map(series).collect();
        SimultaneousFigure { name, unit, programs, target }
    };
    let figures = [
        figure(
            "CPU time per telegram",
            "us",
            |load| load.each(load.process.busy_ns / 1000),
            Target::Ratio(2.0),
        ),
        figure(
            "of it in threads that read",
            "us",
            |load| load.each(load.readers.busy_ns / 1000),
            Target::None,
        ),
        figure("sleeps per telegram", "1", |load| load.each(load.process.voluntary), Target::Max(6.0)),
        figure("of it in threads that read", "1", |load| load.each(load.readers.voluntary), Target::None),
        figure("preemptions per telegram", "1", |load| load.each(load.process.involuntary), Target::None),
        figure("counter wakeups per telegram", "1", |load| load.wakeups, Target::None),
        figure("telegrams per second", "1", |load| Some(load.telegram_count), Target::None),
    ];
    let names = comparison.names();
    figures::print_simultaneous("hub_load", sensors, options.json, &names, &figures);
    Ok(())
}

/// Resources that a program used in a second.
struct Load {
    telegram_count: f64,
    process: ThreadUsage,
    readers: ThreadUsage,
    wakeups: Option<f64>,
}

impl Load {
    fn each(&self, count: u64) -> Option<f64> {
        Some(count as f64 / self.telegram_count)
    }
}

/// Runs all programs of a round. Returns the resources that each program used per second.
fn load_of_round(comparison: &Comparison, round: usize, seconds: u64) -> Outcome<Vec<Vec<Load>>> {
    let sensors = comparison.sensors;
    let mut running = Vec::new();
    let mut subscribers = Vec::new();
    let mut stages = Vec::new();
    for (number, candidate) in comparison.programs.iter().enumerate() {
        let lines = comparison.lines(comparison.line_index(number, round));
        let program = candidate.start(lines, sensors, 0)?;
        if candidate.is_hub() {
            subscribers.push(candidate.subscribe_to_scans(sensors)?);
        } else {
            program.wait_for_line("woken", STEP_TIMEOUT)?;
        }
        running.push(program);
        stages.push(lines);
    }
    thread::sleep(SETTLE_TIME);
    let counters = || -> Outcome<Vec<Option<(f64, f64)>>> {
        let of =
            |candidate: &MeasuredProgram| candidate.is_hub().then(|| counters(&candidate.stage, sensors));
        comparison.programs.iter().map(|candidate| of(candidate).transpose()).collect()
    };
    let look = || -> Outcome<Vec<Sample>> {
        let of = |number: usize| {
            Sample::take(running[number].guard.pid(), comparison.programs[number].is_hub().then_some(sensors))
        };
        (0..running.len()).map(of).collect()
    };
    let counted = counters()?;
    let mut looks = vec![look()?];
    for _ in 0..seconds {
        thread::sleep(Duration::from_secs(1));
        looks.push(look()?);
    }
    let mut loads = Vec::new();
    for (number, (counted, environment)) in counted.into_iter().zip(counters()?).zip(stages).enumerate() {
        let truths = sensors.iter().map(|sensor| SensorTruth::read(&environment.truth(), sensor));
        let truths = truths.collect::<Outcome<Vec<_>>>()?;
        let of_second = |looks: &[Vec<Sample>]| {
            let (before, after) = (&looks[0][number], &looks[1][number]);
            Load {
                telegram_count: truths.iter().map(|truth| truth.count(before.now, after.now)).sum::<usize>()
                    as f64,
                process: after.process.since(before.process),
                readers: after.readers.since(before.readers),
                wakeups: match counted {
                    (Some(before), Some(after)) => Some((after.0 - before.0) / (after.1 - before.1)),
                    _ => None,
                },
            }
        };
        loads.push(looks.windows(2).map(of_second).filter(|load| load.telegram_count > 0.0).collect());
    }
    running.into_iter().try_for_each(|program| program.guard.kill())?;
    Ok(loads)
}

/// Resources that a process has used since its start.
struct Sample {
    now: u64,
    process: ThreadUsage,
    readers: ThreadUsage,
}

impl Sample {
    /// Reads the counters of `pid`. The reading threads of a hub have the names of its sensors. In the baseline, all
    /// threads except the first one read. The first thread only waits for the others.
    fn take(pid: u32, sensors: Option<&[&str]>) -> Outcome<Sample> {
        let now = clock::now();
        let process = ThreadUsage::of(pid, |_| true)?;
        let readers = match sensors {
            Some(sensors) => ThreadUsage::of(pid, |name| sensors.contains(&name))?,
            None => process,
        };
        Ok(Sample { now, process, readers })
    }
}

/// Returns the numbers of wake-ups and telegrams that the hub itself counts, as sums over all links. The bench must not
/// call this during the measured time, because the call adds a subscriber.
fn counters(environment: &BenchEnvironment, sensors: &[&str]) -> Outcome<(f64, f64)> {
    let mut sum = (0, 0);
    for sensor in sensors {
        let mut statuses =
            subscriber::builder::<Status>(environment.domain.name(), sensor).timeout(STEP_TIMEOUT).open()?;
        let status = statuses.next()?.ok_or("no status")?;
        sum.0 += status.counters[Counter::Wakeups];
        sum.1 += status.counters[Counter::Telegrams];
    }
    Ok((sum.0 as f64, sum.1 as f64))
}
