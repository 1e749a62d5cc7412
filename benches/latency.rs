//! How old is a telegram when a subscriber receives it? Measured from the last byte written into the pty, by the
//! simulator's own stamp, to the sample in another process that sleeps in the client library, at 37.5 Hz from each of
//! two sensors. The baseline is a bare chain with the same late read: pty, process, eventfd, process. Sent and received
//! telegrams are matched by hash. The bench does not measure when a beam was measured, or what an adapter adds.

mod support;

use std::collections::HashMap;
use std::process::ExitCode;
use std::time::Duration;

use support::figures::{self, Figure, Target, percentile};
use support::stage::{Child, Line, PATIENCE, SENSORS, Stage};
use support::truth::Truth;
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let simulator = stage.simulate(&SENSORS, 500_000)?;
    let count = options.count(800);
    // The first hub sets the sensors going; from then on they stream to whoever reads.
    through_hub(&stage, SETTLING)?;
    let (mut hub, mut baseline) = (Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        if pair % 2 == 0 {
            hub.push(through_hub(&stage, count)?);
            baseline.push(through_baseline(&stage, count)?);
        } else {
            baseline.push(through_baseline(&stage, count)?);
            hub.push(through_hub(&stage, count)?);
        }
    }
    drop(simulator);
    let sent = sent(&stage)?;
    let series = |runs: &[Run]| -> Outcome<Vec<_>> { runs.iter().map(|run| run.latencies(&sent)).collect() };
    let (hub, baseline) = (series(&hub)?, series(&baseline)?);
    let figure = |name, of: fn(&Latencies) -> &[f64], part, target| {
        let at = |runs: &[Latencies]| runs.iter().filter_map(|run| percentile(of(run), part)).collect();
        Figure { name, unit: "us", hub: at(&hub), baseline: at(&baseline), target }
    };
    let sizes = |runs: &[Latencies]| runs.iter().map(|run| run.whole.len() as f64).collect();
    let figures = [
        figure("p50", |run| &run.whole, 0.5, Target::Ratio(1.5)),
        figure("p90", |run| &run.whole, 0.9, Target::None),
        figure("p99", |run| &run.whole, 0.99, Target::Ratio(1.5)),
        figure("max", |run| &run.whole, 1.0, Target::None),
        figure("until read, p50", |run| &run.read, 0.5, Target::None),
        figure("until read, p99", |run| &run.read, 0.99, Target::None),
        Figure {
            name: "telegrams",
            unit: "1",
            hub: sizes(&hub),
            baseline: sizes(&baseline),
            target: Target::None,
        },
    ];
    figures::print("latency", options.json, &figures);
    Ok(())
}

/// What was received in a run.
struct Run(Vec<Arrived>);

struct Arrived {
    sensor: usize,
    hash: String,
    /// When whoever has the pty open had its last byte.
    read_ns: u64,
    /// When the consumer had it.
    at_ns: u64,
}

impl Run {
    /// Microseconds from sent to received and from sent to read, each sorted. The first telegrams are left out: the
    /// reader had to learn how long one takes.
    fn latencies(&self, sent: &HashMap<(usize, String), u64>) -> Outcome<Latencies> {
        let mut latencies = Latencies::default();
        for sensor in 0..SENSORS.len() {
            for arrived in self.0.iter().filter(|arrived| arrived.sensor == sensor).skip(SETTLING) {
                let key = (sensor, arrived.hash.clone());
                let sent_ns = *sent.get(&key).ok_or("received what was not sent")? as f64;
                latencies.whole.push((arrived.at_ns as f64 - sent_ns) / 1e3);
                latencies.read.push((arrived.read_ns as f64 - sent_ns) / 1e3);
            }
        }
        latencies.whole.sort_by(f64::total_cmp);
        latencies.read.sort_by(f64::total_cmp);
        Ok(latencies)
    }
}

#[derive(Default)]
struct Latencies {
    whole: Vec<f64>,
    read: Vec<f64>,
}

fn through_hub(stage: &Stage, count: usize) -> Outcome<Run> {
    let count = count + SETTLING;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let start = |sensor: &&str| stage.consumer("telegram", sensor, &[&count.to_string()]);
    let consumers: Vec<Child> = SENSORS.iter().map(start).collect::<Outcome<_>>()?;
    let mut run = Run(Vec::new());
    for (sensor, consumer) in consumers.iter().enumerate() {
        for line in consumer.lines_until("end", patience(count))? {
            if let ["telegram", _, _, _, _, _, hash, _] = line.words()[..] {
                let (hash, at_ns, read_ns) = (hash.to_owned(), line.number(2)?, line.number(7)?);
                run.0.push(Arrived { sensor, hash, read_ns, at_ns });
            }
        }
    }
    hub.guard.kill()?;
    Ok(run)
}

fn through_baseline(stage: &Stage, count: usize) -> Outcome<Run> {
    let count = count + SETTLING;
    let baseline = stage.bare(&SENSORS, count)?;
    let lines = baseline.lines_until("end", patience(count))?;
    let of = |what: &str, sensor: usize| -> Vec<&Line> {
        let number = sensor.to_string();
        lines.iter().filter(|line| line.words().get(..2) == Some(&[what, &number])).collect()
    };
    let mut run = Run(Vec::new());
    for sensor in 0..SENSORS.len() {
        // The wake-up carries no bytes: the nth is that of the nth telegram.
        for (read, woken) in of("read", sensor).into_iter().zip(of("woken", sensor)) {
            let (hash, at_ns, read_ns) = (read.words()[2].to_owned(), woken.number(2)?, read.number(3)?);
            run.0.push(Arrived { sensor, hash, read_ns, at_ns });
        }
    }
    Ok(run)
}

/// When each telegram was sent, by sensor and hash.
fn sent(stage: &Stage) -> Outcome<HashMap<(usize, String), u64>> {
    let mut sent = HashMap::new();
    for (number, sensor) in SENSORS.iter().enumerate() {
        let truth = Truth::read(&stage.truth(), sensor)?;
        sent.extend(truth.sent.into_iter().map(|one| ((number, one.hash), one.at_ns)));
    }
    Ok(sent)
}

fn patience(count: usize) -> Duration {
    PATIENCE + Duration::from_millis(50) * count as u32
}

/// Telegrams at the start of a run that do not count.
const SETTLING: usize = 40;
