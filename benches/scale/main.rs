//! How does what the hub costs grow: with sensors on lines, with sensors in made-up time, with consumers of one sensor, with
//! the beams of a scan? A table and a fit for each, and what memory a hub with 200 consumers takes. Lines are ptys of this
//! machine; where their simulators and the hub no longer keep the sensors' pace, the rate in the table tells. It does not
//! tell what happens on real adapters.

mod crowd;
mod driven;
mod lines;
mod made_up;
mod memory;
#[path = "../support/mod.rs"]
mod support;
mod sweep;

use std::process::ExitCode;

use rustix::process::{Signal, set_parent_process_death_signal};
use support::options::Options;
use support::{Outcome, PART};

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let outcome = match words[..] {
        [PART, "driven", begin, beams, sensors, telegrams, followed] => part(|| {
            let followed = followed.parse()?;
            driven::drive(begin.as_ref(), beams.parse()?, sensors.parse()?, telegrams.parse()?, followed)
        }),
        [PART, "followers", domain, sensor, count, seconds, wait] => {
            part(|| crowd::follow(domain, sensor, count.parse()?, seconds.parse()?, wait))
        }
        _ => return support::main(measure),
    };
    outcome.map_or_else(
        |error| {
            eprintln!("{error}");
            ExitCode::FAILURE
        },
        |()| ExitCode::SUCCESS,
    )
}

/// What this process does for another one ends with that.
fn part(play: impl FnOnce() -> Outcome<()>) -> Outcome<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    play()
}

fn measure(options: &Options) -> Outcome<()> {
    made_up::sensors(options)?;
    made_up::beams(options)?;
    crowd::consumers(options)?;
    memory::two_links(options)?;
    lines::sensors(options)
}
