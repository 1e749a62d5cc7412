//! What memory a hub with two links and 200 consumers takes, and what it is made of: its own, that of the program, what it
//! has touched of the shared memory; and what lies in /dev/shm, by the library's kinds of segments.

use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

use crate::crowd;
use crate::support::Outcome;
use crate::support::figures::{self, Cell, Figure, Target};
use crate::support::memory::{Resident, segments};
use crate::support::options::Options;
use crate::support::stage::{PATIENCE, SENSORS, Stage};

/// Files by the ends of their names: how many, and their bytes.
type Kinds = BTreeMap<String, (usize, f64)>;

/// 100 consumers of the scans of each of two sensors.
pub(crate) fn two_links(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let hub = stage.hub_for_crowd(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let alone = segments(&stage.domain)?;
    // They stay until they are ended: the first ones, too, while the last come.
    let (seconds, long) = (options.seconds(8), 3600);
    let crowds: Vec<_> = SENSORS
        .iter()
        .map(|sensor| crowd::start(&stage, sensor, 100, long, "doorbell"))
        .collect::<Outcome<_>>()?;
    thread::sleep(Duration::from_secs(seconds));
    let resident = Resident::of(hub.guard.pid())?;
    let full = segments(&stage.domain)?;
    drop(crowds);
    let figure = |name, bytes: f64, target| {
        let hub = vec![bytes / 1024.0 / 1024.0];
        Figure { name, unit: "MiB", hub, floor: Vec::new(), target }
    };
    let sum = |kinds: &Kinds| kinds.values().map(|(_, bytes)| bytes).sum();
    let rows = [
        figure("resident, 2 links, 200 consumers", resident.all, Target::Most(16.0)),
        figure("of it own", resident.own, Target::None),
        figure("of it program and libraries", resident.files, Target::None),
        figure("of it shared memory touched", resident.shared, Target::None),
        figure("shared memory, nobody there", sum(&alone), Target::None),
        figure("shared memory, 200 consumers", sum(&full), Target::None),
    ];
    figures::print("scale", options.json, &rows);
    figures::print_cells("scale", options.json, &cells("nobody there", &alone));
    figures::print_cells("scale", options.json, &cells("200 consumers", &full));
    Ok(())
}

fn cells(when: &str, kinds: &Kinds) -> Vec<Cell> {
    let cell = |kind: &String, column: &str, unit, value| Cell {
        table: format!("shared memory of two links, {when}"),
        row: format!(".{kind}"),
        column: column.to_owned(),
        unit,
        values: vec![value],
    };
    let row = |(kind, (count, bytes)): (&String, &(usize, f64))| {
        [cell(kind, "segments", "1", *count as f64), cell(kind, "taken", "kB", bytes / 1024.0)]
    };
    kinds.iter().flat_map(row).collect()
}
