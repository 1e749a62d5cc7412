//! How fast can a recording be replayed? Two sensors at 37.5 Hz, recorded in made-up time with all their topics, played as
//! fast as they can be read, everything made of them anew. It does not tell what consumers get of it: nobody waits for them.

#[path = "support/rooms.rs"]
mod rooms;
mod support;

use std::time::Duration;

use serde_json::Value;

use support::Outcome;
use support::child::Child;
use support::figures::{self, Figure, Target};
use support::options::Options;
use support::stage::{PROGRAM, Stage};

fn main() -> std::process::ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let file = stage.file("two.mcap");
    let scans = options.seconds(600) * 1_000_000_000 / rooms::period();
    rooms::record(&stage.domain, &file, scans, None, |_, _| {});
    let new = |name, unit, target| Figure { name, unit, hub: Vec::new(), floor: Vec::new(), target };
    let mut figures = [
        new("times as fast as it was recorded", "1", Target::Least(1000.0)),
        new("telegrams a second", "1/s", Target::None),
        new("from exec to the first telegram", "ms", Target::None),
        new("telegrams lacking", "1", Target::Most(0.0)),
    ];
    for _ in 0..options.pairs() {
        let path = file.display().to_string();
        let words =
            ["replay", &path, "--rate=max", "--json", "--no-system-config", "--domain", stage.domain.name()];
        let player = Child::start(PROGRAM, &words.map(str::to_owned))?;
        let ready = player.await_line(r#"{"class":"ready""#, PATIENCE)?;
        let end: Value = serde_json::from_str(&player.await_line(r#"{"class":"replayed""#, PATIENCE)?.text)?;
        let of = |key: &str| end[key].as_f64().ok_or(format!("no {key}: {end}"));
        let (position, took, telegrams) = (of("position_s")?, of("took_s")?, of("telegrams")?);
        let lacking = (2 * (scans + 1)) as f64 - telegrams;
        let up_ms = (ready.at_ns - player.started_ns) as f64 / 1e6;
        let values = [position / took, telegrams / took, up_ms, lacking];
        figures.iter_mut().zip(values).for_each(|(figure, value)| figure.hub.push(value));
    }
    figures::print("replay", options.json, &figures);
    Ok(())
}

/// A minute of replay is ten hours of recording.
const PATIENCE: Duration = Duration::from_secs(60);
