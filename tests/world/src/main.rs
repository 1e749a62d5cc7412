//! Command-line program that runs worlds: `cargo run --release -p scanhub-world -- --seeds 0..200`. For each violation,
//! it prints the seed and the shortest list of actions found that still causes the violation.

use std::io::{IsTerminal, Write};
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clap::Parser;
use scanhub_world::{Detail, Outcome, Runner, Scenario, Totals, corpus, run, shrink};

/// Simulate whole hubs in virtual time, and check invariants
#[derive(Debug, Parser)]
struct Arguments {
    /// Seeds of the worlds, such as 0..200
    #[arg(long, value_parser = range, default_value = "0..200")]
    seeds: (u64, u64),
    /// Run one seed, and print its events
    #[arg(long)]
    seed: Option<u64>,
    /// With --seed or --plan: also print every verdict
    #[arg(long)]
    all: bool,
    /// Duration of each world
    #[arg(long, default_value_t = 60)]
    virtual_seconds: u64,
    /// Run this number of worlds twice, from the first one on. Both runs must have the same hash
    #[arg(long, default_value_t = 0)]
    twice: usize,
    /// Remove the family from half of the links, so that the hub searches for their scanners
    #[arg(long)]
    auto: bool,
    /// Number of worlds that run at the same time
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Run the scenario in this file instead
    #[arg(long)]
    plan: Option<std::path::PathBuf>,
    /// Run the scenarios that once failed instead
    #[arg(long)]
    corpus: bool,
    /// Print the totals as a line of JSON
    #[arg(long)]
    json: bool,
    /// Do not shorten scenarios that fail
    #[arg(long)]
    no_shrink: bool,
}

fn range(text: &str) -> Result<(u64, u64), String> {
    let ends = text.split_once("..").and_then(|(from, to)| Some((from.parse().ok()?, to.parse().ok()?)));
    ends.filter(|(from, to)| from < to).ok_or_else(|| "write FROM..TO, such as 0..200".to_owned())
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let is_over = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        // A second signal ends the program at once.
        let _ = signal_hook::flag::register_conditional_shutdown(signal, 130, is_over.clone());
        let _ = signal_hook::flag::register(signal, is_over.clone());
    }
    let scenarios = match scenarios(&arguments) {
        Ok(scenarios) => scenarios,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(2);
        }
    };
    if let ([scenario], true) = (&scenarios[..], arguments.seed.is_some() || arguments.plan.is_some()) {
        print!("{scenario}");
        let outcome = run(scenario, if arguments.all { Detail::All } else { Detail::Rare });
        outcome.violations.iter().for_each(|violation| println!("{violation}"));
        println!("hash {:016x}", outcome.hash);
        return ExitCode::from(u8::from(!outcome.violations.is_empty()));
    }
    let before = descriptors();
    let started = Instant::now();
    let (count, is_terminal) = (scenarios.len(), std::io::stderr().is_terminal());
    let runner = Runner { scenarios, run_twice: arguments.twice, threads: arguments.threads };
    let totals = runner.run(&is_over, |totals| {
        if is_terminal {
            eprint!("\r{} of {count} worlds, {} failed ", totals.worlds, totals.failed.len());
            let _ = std::io::stderr().flush();
        }
    });
    if is_terminal {
        eprintln!();
    }
    for (scenario, outcome, is_same) in &totals.failed {
        report(scenario, outcome, *is_same, arguments.no_shrink || is_over.load(Ordering::Relaxed));
    }
    let left = descriptors().saturating_sub(before);
    if left > 0 {
        println!("{left} file descriptors were not closed");
    }
    print_totals(&totals, started.elapsed().as_secs_f64(), arguments.json);
    let is_well = totals.failed.is_empty() && left == 0 && !is_over.load(Ordering::Relaxed);
    ExitCode::from(u8::from(!is_well))
}

fn scenarios(arguments: &Arguments) -> Result<Vec<Scenario>, String> {
    let of_seed =
        |seed| Scenario { is_auto: arguments.auto, ..Scenario::from_seed(seed, arguments.virtual_seconds) };
    if let Some(path) = &arguments.plan {
        let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
        return Ok(vec![text.parse()?]);
    }
    if arguments.corpus {
        return Ok(corpus().into_iter().map(|(_, scenario)| scenario).collect());
    }
    Ok(match arguments.seed {
        Some(seed) => vec![of_seed(seed)],
        None => (arguments.seeds.0..arguments.seeds.1).map(of_seed).collect(),
    })
}

/// Prints the violations, and the shortest scenario that still causes the first one.
fn report(scenario: &Scenario, outcome: &Outcome, is_same: bool, is_long: bool) {
    println!("SEED={}{} COMMIT={}", scenario.seed, if scenario.is_auto { " --auto" } else { "" }, commit());
    if !is_same {
        println!("the second run has another hash than the first one");
    }
    outcome.violations.iter().take(5).for_each(|violation| println!("  {violation}"));
    let first_violation = |scenario: &Scenario| {
        run(scenario, Detail::Nothing).violations.first().map(|violation| violation.invariant)
    };
    let shortest = if is_long { scenario.clone() } else { shrink(scenario, first_violation) };
    println!("{shortest}");
}

fn print_totals(totals: &Totals, took_s: f64, is_json: bool) {
    let Totals { worlds, sensor_seconds, samples, busy, failed } = totals;
    let per_core = *sensor_seconds as f64 / busy.as_secs_f64().max(1e-9);
    if is_json {
        let line = serde_json::json!({
            "worlds": worlds,
            "failed": failed.len(),
            "sensor_seconds": sensor_seconds,
            "samples": samples,
            "seconds": took_s,
            "sensor_seconds_per_second_of_a_core": per_core,
        });
        println!("{line}");
    } else {
        println!(
            "{worlds} worlds, {} failed; {sensor_seconds} sensor-seconds and {samples} samples in {took_s:.1} s: \
             {per_core:.0} sensor-seconds per second of CPU time",
            failed.len()
        );
    }
}

/// Returns the number of open file descriptors of this process.
fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count)
}

fn commit() -> String {
    let git_output = Command::new("git").args(["rev-parse", "--short", "HEAD"]).output();
    let text = git_output.ok().filter(|output| output.status.success()).map(|output| output.stdout);
    String::from_utf8_lossy(&text.unwrap_or_default()).trim().to_owned()
}
