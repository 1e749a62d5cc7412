//! What the comparisons with bare floors share: a stage with simulator, hub and consumers as processes, the floors,
//! the processes' accounts, and figures with their spread. Refuses to judge: a bench prints what it measured.
#![allow(dead_code)] // Every bench takes what it needs.

pub(crate) mod bare;
pub(crate) mod chart;
pub(crate) mod child;
pub(crate) mod clock;
pub(crate) mod consumer;
pub(crate) mod crowd;
pub(crate) mod figures;
pub(crate) mod host;
pub(crate) mod line;
pub(crate) mod memory;
pub(crate) mod options;
pub(crate) mod stage;
pub(crate) mod truth;
pub(crate) mod work;

use std::error::Error;
use std::process::ExitCode;

use rustix::process::{Signal, set_parent_process_death_signal};

/// What may go wrong, in words.
pub(crate) type Outcome<T> = Result<T, Box<dyn Error>>;

/// The body of every bench: plays the part that the command line names (a bench starts itself as consumer and as
/// floor), else measures.
pub(crate) fn main(measure: impl FnOnce(&options::Options) -> Outcome<()>) -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match words.first().map(String::as_str) {
        Some(PART) => play(&words[1..]),
        _ => stage::Stage::sweep()
            .and_then(|()| options::Options::parse(&words))
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

fn play(words: &[String]) -> Outcome<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["consume", "scan", domain, sensor] => consumer::scans(domain, sensor),
        ["consume", "telegram", domain, sensor, count] => consumer::telegrams(domain, sensor, count.parse()?),
        ["ages", topic, domain, sensor, count] => consumer::ages(topic, domain, sensor, count.parse()?),
        ["consume", "status", domain, sensor] => consumer::statuses(domain, sensor),
        ["crowd", domain, sensor, count, seconds] => {
            crowd::follow(domain, sensor, count.parse()?, seconds.parse()?)
        }
        ["hold", domain, sensor, count] => crowd::hold(domain, sensor, count.parse()?),
        ["stay", domain, sensor, count] => crowd::stay(domain, sensor, count.parse()?),
        ["bare", count, ref ports @ ..] => bare::chain(ports, count.parse()?),
        ["sleeper", number, count] => bare::sleeper(number, count.parse()?),
        ["host", port, rate] => host::start(port.as_ref(), rate.parse()?),
        _ => Err(format!("no part {words:?}").into()),
    }
}

/// First word of the command line of a part.
pub(crate) const PART: &str = "part";
