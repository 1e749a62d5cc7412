//! Does pre-processing make anybody wait? From the last byte that the hub read to the zone verdict in the hands of
//! another process, beside the scan of a hub that does not pre-process: the build of the program that SCANHUB_RIVAL
//! names, from before it could. Both hubs take turns on the same lines. Without a rival the scan of the same hub is
//! measured, which is woken by the same event.

mod support;

use std::process::ExitCode;
use std::time::Duration;

use support::Outcome;
use support::child::Child;
use support::figures::{self, Figure, Target, percentile};
use support::options::Options;
use support::stage::{PATIENCE, SENSORS, Stage};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let rival = std::env::var("SCANHUB_RIVAL").ok();
    if rival.is_none() {
        eprintln!("SCANHUB_RIVAL names no program: zones and scans of the same hub are compared");
    }
    let (count, own) = (options.count(800), env!("CARGO_BIN_EXE_scanhub"));
    let rival = rival.as_deref().unwrap_or(own);
    // The first hub sets the sensors going; from then on they stream to whoever reads.
    ages(&stage, own, "zones", SETTLING)?;
    let (mut verdicts, mut scans) = (Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        if pair % 2 == 0 {
            verdicts.push(ages(&stage, own, "zones", count)?);
            scans.push(ages(&stage, rival, "scan", count)?);
        } else {
            scans.push(ages(&stage, rival, "scan", count)?);
            verdicts.push(ages(&stage, own, "zones", count)?);
        }
    }
    let figure = |name, part| {
        let at = |runs: &[Vec<f64>]| runs.iter().filter_map(|run| percentile(run, part)).collect();
        Figure { name, unit: "us", hub: at(&verdicts), floor: at(&scans), target: Target::None }
    };
    figures::print("verdict", options.json, &[figure("p50", 0.5), figure("p90", 0.9), figure("p99", 0.99)]);
    Ok(())
}

/// Ages of the samples of `topic` in microseconds, sorted, of both sensors together.
fn ages(stage: &Stage, program: &str, topic: &str, count: usize) -> Outcome<Vec<f64>> {
    let count = count + SETTLING;
    let hub = stage.hub_of(program, &SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let start = |sensor: &&str| stage.part(&["ages", topic, stage.domain.name(), sensor, &count.to_string()]);
    let consumers: Vec<Child> = SENSORS.iter().map(start).collect::<Outcome<_>>()?;
    let mut ages = Vec::new();
    for consumer in &consumers {
        let lines = consumer.lines_until("end", PATIENCE + Duration::from_millis(50) * count as u32)?;
        let aged = lines.iter().filter(|line| line.text.starts_with("aged")).skip(SETTLING);
        for line in aged {
            ages.push(line.number(2)? as f64 / 1e3);
        }
    }
    hub.guard.kill()?;
    ages.sort_by(f64::total_cmp);
    Ok(ages)
}

/// Samples at the start of a run that do not count.
const SETTLING: usize = 40;
