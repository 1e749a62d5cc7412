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
#[path = "../support/virtual_hub.rs"]
mod virtual_hub;

use std::process::ExitCode;

use support::Outcome;
use support::options::Options;

fn main() -> ExitCode {
    support::main_with(play, measure)
}

fn play(words: &[&str]) -> Outcome<()> {
    match *words {
        ["driven", begin, beams, sensors, telegrams, followed] => {
            let followed = followed.parse()?;
            driven::drive(begin.as_ref(), beams.parse()?, sensors.parse()?, telegrams.parse()?, followed)
        }
        ["followers", domain, sensor, count, seconds, wait] => {
            crowd::follow(domain, sensor, count.parse()?, seconds.parse()?, wait)
        }
        _ => support::play(words),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    made_up::sensors(options)?;
    made_up::beams(options)?;
    crowd::consumers(options)?;
    memory::two_links(options)?;
    lines::sensors(options)
}
