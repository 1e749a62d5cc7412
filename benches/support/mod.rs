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
    main_with(play, measure)
}

/// As [`main`], of a bench that has parts of its own; those that it does not know are for [`play`].
pub(crate) fn main_with(
    play: impl FnOnce(&[&str]) -> Outcome<()>,
    measure: impl FnOnce(&options::Options) -> Outcome<()>,
) -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        // What this process does for another one ends with that.
        [PART, ref part @ ..] => {
            set_parent_process_death_signal(Some(Signal::TERM)).map_err(Into::into).and_then(|()| play(part))
        }
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

/// Plays one of the parts that benches share.
pub(crate) fn play(words: &[&str]) -> Outcome<()> {
    match *words {
        ["consume", "scan", domain, sensor] => consumer::scans(domain, sensor),
        ["consume", "each", domain, sensor] => consumer::each_scan(domain, sensor),
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
        ["host", "blindly", port, rate] => host::start_blindly(port.as_ref(), rate.parse()?),
        ["host", port, rate] => host::start(port.as_ref(), rate.parse()?),
        _ => Err(format!("no part {words:?}").into()),
    }
}

/// First word of the command line of a part.
pub(crate) const PART: &str = "part";
