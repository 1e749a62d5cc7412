//! Age of a telegram when a subscriber receives it, at 37.5 Hz from each of two sensors. The age starts when the
//! simulator has written the last byte into the pty, by the simulator's own stamp. It ends when a process that sleeps
//! in the client library has the sample. The baseline is a minimal chain of pty, process, eventfd and process, which
//! reads as late as the hub does. The bench matches sent and received telegrams by their hashes. The hub and the
//! baselines run at the same time (`support/simultaneous.rs`). With `--beside PROGRAM`, the hub of another build also
//! runs at the same time. The ages do not include the time from the measurement of a beam to the line, or the delay of
//! an adapter.
//!
//! The path up to the last byte is the same for the hub and the baseline, so their difference arises between the read
//! and the subscriber. The 99th percentile and the maximum depend on the machine as much as on the hub, because the
//! simulator runs on the same cores.

mod support;

use std::collections::HashMap;
use std::process::ExitCode;
use std::time::Duration;

use support::environment::{BenchEnvironment, Child, OutputLine, SENSORS, STEP_TIMEOUT};
use support::figures::{self, SimultaneousFigure, Target, percentile};
use support::simultaneous::{Comparison, MeasuredProgram, SETTLE_TIME};
use support::truth::SensorTruth;
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main(|options| {
        options.sensors(&[SENSORS.len()]).into_iter().try_for_each(|sensors| measure(options, sensors))
    })
}

fn measure(options: &Options, sensors: usize) -> Outcome<()> {
    let comparison = Comparison::start(options, sensors)?;
    let count = options.count((options.seconds(20) * SCAN_RATE_MHZ / 1000) as usize);
    let mut rounds = Vec::new();
    for round in 0..comparison.rounds(options) {
        rounds.push(receive_round(&comparison, round, count)?);
    }
    let places = 0..comparison.programs.len();
    let sent = places.map(|place| sent(comparison.lines(place), comparison.sensors));
    let sent = sent.collect::<Outcome<Vec<_>>>()?;
    let mut latencies = Vec::new();
    for (round, runs) in rounds.iter().enumerate() {
        let of = |(number, run): (usize, &ReceivedTelegrams)| {
            let is_hub = comparison.programs[number].is_hub();
            run.latencies(&sent[comparison.line_index(number, round)], shared_span(runs), is_hub)
        };
        latencies.push(runs.iter().enumerate().map(of).collect::<Outcome<Vec<_>>>()?);
    }
    let series = |of: &dyn Fn(&Latencies) -> Option<f64>| {
        let programs = 0..comparison.programs.len();
        programs.map(|number| latencies.iter().filter_map(|round| of(&round[number])).collect()).collect()
    };
    let figure = |name, of: fn(&Latencies) -> &[f64], part, target| {
        let programs = series(&|run| percentile(of(run), part));
        SimultaneousFigure { name, unit: "us", programs, target }
    };
    let figures = [
        figure("p50", |run| &run.whole, 0.5, Target::Ratio(1.5)),
        figure("p90", |run| &run.whole, 0.9, Target::None),
        figure("p99", |run| &run.whole, 0.99, Target::Ratio(1.5)),
        figure("max", |run| &run.whole, 1.0, Target::None),
        figure("until read, p50", |run| &run.read, 0.5, Target::None),
        figure("until read, p99", |run| &run.read, 0.99, Target::None),
        SimultaneousFigure {
            name: "telegrams",
            unit: "1",
            programs: series(&|run| Some(run.whole.len() as f64)),
            target: Target::None,
        },
    ];
    figures::print_simultaneous("latency", sensors, options.json, &comparison.names(), &figures);
    Ok(())
}

/// Telegrams received from one program in a round.
struct ReceivedTelegrams(Vec<ReceivedTelegram>);

struct ReceivedTelegram {
    sensor: usize,
    hash: String,
    /// Time at which the reader of the pty had the last byte of the telegram.
    read_ns: u64,
    /// Time at which the subscriber received the telegram.
    at_ns: u64,
}

impl ReceivedTelegrams {
    /// Returns the start and the end of the time whose telegrams count. This time starts when all sensors stream, and
    /// ends when the first sensor stops.
    fn span(&self) -> (u64, u64) {
        let mut ends = HashMap::<usize, (u64, u64)>::new();
        for arrived in &self.0 {
            ends.entry(arrived.sensor).or_insert((arrived.at_ns, 0)).1 = arrived.at_ns;
        }
        let first = ends.values().map(|ends| ends.0).max().unwrap_or_default();
        let last = ends.values().map(|ends| ends.1).min().unwrap_or_default();
        (first + SETTLE_TIME.as_nanos() as u64, last)
    }

    /// Returns two series of times for the telegrams received in `span`, in us: from sent to received, and from sent to
    /// read. A hub checks checksums, so the sensors must have sent all telegrams that it received. A baseline does not
    /// check them, so it may take parts of two telegrams for one telegram.
    fn latencies(&self, sent: &SentTimes, span: (u64, u64), is_hub: bool) -> Outcome<Latencies> {
        let mut latencies = Latencies::default();
        for arrived in self.0.iter().filter(|arrived| (span.0..=span.1).contains(&arrived.at_ns)) {
            let Some(&sent_ns) = sent.get(&(arrived.sensor, arrived.hash.clone())) else {
                if is_hub {
                    return Err("the hub delivered a telegram that was not sent".into());
                }
                continue;
            };
            latencies.whole.push((arrived.at_ns as f64 - sent_ns as f64) / 1e3);
            latencies.read.push((arrived.read_ns as f64 - sent_ns as f64) / 1e3);
        }
        latencies.whole.sort_by(f64::total_cmp);
        latencies.read.sort_by(f64::total_cmp);
        Ok(latencies)
    }
}

/// Returns the time whose telegrams count in all runs of a round.
fn shared_span(runs: &[ReceivedTelegrams]) -> (u64, u64) {
    let spans = runs.iter().map(ReceivedTelegrams::span);
    spans.fold((0, u64::MAX), |all, span| (all.0.max(span.0), all.1.min(span.1)))
}

/// Latencies of a run. Each series is sorted.
#[derive(Default)]
struct Latencies {
    whole: Vec<f64>,
    read: Vec<f64>,
}

/// Runs all programs until each one has received `count` telegrams of each sensor after the settling time. Returns the
/// received telegrams of each program.
fn receive_round(comparison: &Comparison, round: usize, count: usize) -> Outcome<Vec<ReceivedTelegrams>> {
    let count = count + (SETTLE_TIME.as_millis() as u64 * SCAN_RATE_MHZ / 1_000_000) as usize;
    let start = |(number, candidate): (usize, &MeasuredProgram)| -> Outcome<_> {
        let program = candidate.start(
            comparison.lines(comparison.line_index(number, round)),
            comparison.sensors,
            count,
        )?;
        let subscribe =
            |sensor: &&str| candidate.stage.start_subscriber("telegram", sensor, &[&count.to_string()]);
        let subscribed = if candidate.is_hub() { comparison.sensors } else { &[] };
        Ok((program, subscribed.iter().map(subscribe).collect::<Outcome<Vec<_>>>()?))
    };
    let running = comparison.programs.iter().enumerate().map(start).collect::<Outcome<Vec<_>>>()?;
    let mut runs = Vec::new();
    for (candidate, (program, subscribers)) in comparison.programs.iter().zip(&running) {
        let run = match candidate.is_hub() {
            true => through_hub(subscribers, count),
            false => through_baseline(program, comparison.sensors.len(), count),
        };
        runs.push(run.map_err(|error| format!("{}: {error}", candidate.name))?);
    }
    for (candidate, (program, _)) in comparison.programs.iter().zip(running) {
        match candidate.is_hub() {
            true => program.guard.kill()?,
            false => program.guard.wait()?,
        }
    }
    Ok(runs)
}

fn through_hub(subscribers: &[Child], count: usize) -> Outcome<ReceivedTelegrams> {
    let mut run = ReceivedTelegrams(Vec::new());
    for (sensor, subscriber) in subscribers.iter().enumerate() {
        for line in subscriber.lines_until("end", timeout(count))? {
            if let ["telegram", _, _, _, _, _, hash, _] = line.words()[..] {
                let (hash, at_ns, read_ns) = (hash.to_owned(), line.number(2)?, line.number(7)?);
                run.0.push(ReceivedTelegram { sensor, hash, read_ns, at_ns });
            }
        }
    }
    Ok(run)
}

fn through_baseline(baseline: &Child, sensors: usize, count: usize) -> Outcome<ReceivedTelegrams> {
    let lines = baseline.lines_until("end", timeout(count))?;
    let of = |description: &str, sensor: usize| -> Vec<&OutputLine> {
        let number = sensor.to_string();
        lines.iter().filter(|line| line.words().get(..2) == Some(&[description, &number])).collect()
    };
    let mut run = ReceivedTelegrams(Vec::new());
    for sensor in 0..sensors {
        // A wake-up has no content, but the nth wake-up belongs to the nth telegram.
        for (read, woken) in of("read", sensor).into_iter().zip(of("woken", sensor)) {
            let (hash, at_ns, read_ns) = (read.words()[2].to_owned(), woken.number(2)?, read.number(3)?);
            run.0.push(ReceivedTelegram { sensor, hash, read_ns, at_ns });
        }
    }
    Ok(run)
}

/// Time at which each telegram was sent, by sensor and hash.
type SentTimes = HashMap<(usize, String), u64>;

fn sent(environment: &BenchEnvironment, sensors: &[&str]) -> Outcome<SentTimes> {
    let mut sent = HashMap::new();
    for (number, sensor) in sensors.iter().enumerate() {
        let truth = SensorTruth::read(&environment.truth(), sensor)?;
        sent.extend(truth.sent.into_iter().map(|one| ((number, one.hash), one.at_ns)));
    }
    Ok(sent)
}

fn timeout(count: usize) -> Duration {
    STEP_TIMEOUT + Duration::from_millis(50) * count as u32
}

/// Telegrams per second of a sensor, times 1000.
const SCAN_RATE_MHZ: u64 = 37_500;
