//! Shared code of the benches that start processes. It has an environment with simulator, hub and subscribers, and
//! minimal programs as baselines. It also measures the CPU time and memory of processes, and prints figures with their
//! spread. A bench that misses a target prints this, but does not fail.

#![allow(dead_code)] // Each bench uses only some items of this module.

pub(crate) mod baseline;
pub(crate) mod clock;
pub(crate) mod environment;
pub(crate) mod figures;
pub(crate) mod simultaneous;
pub(crate) mod source;
pub(crate) mod subscriber;
pub(crate) mod truth;
pub(crate) mod usage;

use std::error::Error;
use std::process::ExitCode;

use rustix::process::{Signal, set_parent_process_death_signal};

/// Result of a step of a bench. The error is a message.
pub(crate) type Outcome<T> = Result<T, Box<dyn Error>>;

/// Runs a bench. A bench starts its own program as subscriber and as baseline, which are parts of the bench. If the
/// command line names a part, this function runs the part. Otherwise, it measures.
pub(crate) fn main(measure: impl FnOnce(&Options) -> Outcome<()>) -> ExitCode {
    main_with(run_part, measure)
}

/// Runs a bench that has its own parts. For a part that is not its own, the bench calls [`run_part`].
pub(crate) fn main_with(
    run_part: impl FnOnce(&[&str]) -> Outcome<()>,
    measure: impl FnOnce(&Options) -> Outcome<()>,
) -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        // A part must end when the process that has started it ends.
        [PART_WORD, ref part @ ..] => set_parent_process_death_signal(Some(Signal::TERM))
            .map_err(Into::into)
            .and_then(|()| run_part(part)),
        _ => environment::BenchEnvironment::remove_leftovers()
            .and_then(|()| Options::parse(&words))
            .and_then(|options| measure(&options)),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// Runs one of the parts that benches share.
pub(crate) fn run_part(words: &[&str]) -> Outcome<()> {
    match *words {
        ["consume", "scan", domain, sensor] => subscriber::print_first_scans(domain, sensor),
        ["consume", "each", domain, sensor] => subscriber::print_scans(domain, sensor),
        ["consume", "telegram", domain, sensor, count] => {
            subscriber::print_telegrams(domain, sensor, count.parse()?)
        }
        ["ages", domain, sensor, count] => subscriber::print_ages(domain, sensor, count.parse()?),
        ["consume", "status", domain, sensor] => subscriber::print_statuses(domain, sensor),
        ["many", domain, sensor, count, seconds] => {
            subscriber::count_samples(domain, sensor, count.parse()?, seconds.parse()?)
        }
        ["hold", domain, sensor, count] => subscriber::hold_samples(domain, sensor, count.parse()?),
        ["stay", domain, sensor, count] => subscriber::hold_slots(domain, sensor, count.parse()?),
        ["bare", count, lead, ref ports @ ..] => baseline::run_baseline(ports, count.parse()?, lead.parse()?),
        ["sleeper", number, count] => baseline::run_sleeper(number, count.parse()?),
        ["host", "blindly", port, rate] => baseline::start_scanner_unchecked(port.as_ref(), rate.parse()?),
        ["host", port, rate] => baseline::start_scanner(port.as_ref(), rate.parse()?),
        _ => Err(format!("unknown part {words:?}").into()),
    }
}

/// First word of the command line of a part.
pub(crate) const PART_WORD: &str = "part";

/// Options of a bench. Each option has a default, which depends on the bench.
#[derive(Clone, Debug, Default)]
pub(crate) struct Options {
    /// Print one line of JSON per figure instead of tables.
    pub(crate) json: bool,
    /// Measure less, so that a long bench takes only a few minutes.
    pub(crate) quick: bool,
    pairs: Option<usize>,
    seconds: Option<u64>,
    count: Option<usize>,
    sensors: Option<usize>,
    /// Program of another build that is measured at the same time.
    pub(crate) other_program: Option<String>,
}

impl Options {
    pub(crate) fn parse(words: &[String]) -> Outcome<Options> {
        let mut options = Options::default();
        let mut words = words.iter();
        while let Some(word) = words.next() {
            let mut value = || {
                // Cargo passes `--bench` to every bench.
                let value = words.next().filter(|value| *value != "--bench");
                value.ok_or_else(|| format!("{word} needs a value"))
            };
            match word.as_str() {
                "--json" => options.json = true,
                "--quick" => options.quick = true,
                "--pairs" => options.pairs = Some(number(word, value()?)?),
                "--seconds" => options.seconds = Some(number(word, value()?)?),
                "--count" => options.count = Some(number(word, value()?)?),
                "--sensors" => options.sensors = Some(number(word, value()?)?),
                "--beside" => options.other_program = Some(value()?.clone()),
                "--bench" => {}
                _ => {
                    let known =
                        "--json, --quick, --pairs N, --seconds N, --count N, --sensors N, --beside PROGRAM";
                    return Err(format!("{word} is not an option of this bench; use {known}").into());
                }
            }
        }
        Ok(options)
    }

    /// Returns the number of pairs or rounds. A pair consists of one run of the hub and one run of the baseline. In a
    /// round, all programs run at the same time.
    pub(crate) fn pairs(&self) -> usize {
        self.pairs_or(5)
    }

    /// Returns the number of pairs for a bench whose default is `default` instead of five.
    pub(crate) fn pairs_or(&self, default: usize) -> usize {
        self.pairs.unwrap_or(default).clamp(1, 100)
    }

    /// Returns the duration of a run in seconds.
    pub(crate) fn seconds(&self, default: u64) -> u64 {
        self.seconds.unwrap_or(default).clamp(1, 3600)
    }

    /// Returns the numbers of sensors with which the bench measures, one after the other.
    pub(crate) fn sensors(&self, default: &[usize]) -> Vec<usize> {
        self.sensors.map_or(default.to_vec(), |sensors| vec![sensors.clamp(1, environment::ALL_AROUND.len())])
    }

    /// Returns the number of telegrams or repetitions.
    pub(crate) fn count(&self, default: usize) -> usize {
        self.count.unwrap_or(default).clamp(1, 1_000_000)
    }
}

/// Returns `value` as a number of at least 1.
fn number<T: TryFrom<u64>>(flag: &str, value: &str) -> Outcome<T> {
    let number =
        value.parse::<u64>().ok().filter(|&number| number > 0).and_then(|number| number.try_into().ok());
    Ok(number.ok_or_else(|| format!("{flag} {value}: expected a number of at least 1"))?)
}
