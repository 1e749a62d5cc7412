//! What does a message from one process to N others cost by this hub's topics, and what by the mechanisms that a user
//! would take instead? UDP multicast, Unix sockets, TCP and pipes beside topics with each of their waits, and under all of
//! them the bare wake-ups. One run after the other, in turning order, so that what the machine does meets them all.
//! It does not tell what a network or another machine adds.

mod datagrams;
mod floors;
mod message;
mod receiver;
mod run;
mod schedule;
mod sender;
mod streams;
#[path = "../support/mod.rs"]
mod support;
mod table;
mod targets;
mod topic;
mod way;

use std::fmt;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::thread::available_parallelism;

use run::{Case, Measured};
use sender::Task;
use support::Outcome;
use support::options::Options;
use support::stage::Stage;
use way::Way;

/// One result of each pair, in the order in which they were taken.
pub(crate) struct Cell {
    pub(crate) case: Case,
    /// Position in the schedule.
    pub(crate) phase: usize,
    pub(crate) runs: Vec<Measured>,
}

impl Cell {
    /// Messages come at a rate.
    fn is_paced(&self) -> bool {
        schedule::PHASES[self.phase].period_ns > 0
    }

    /// The same messages, receivers and rate.
    fn is_beside(&self, other: &Cell) -> bool {
        let place = |cell: &Cell| (cell.case.payload, cell.case.receivers, cell.phase);
        place(self) == place(other)
    }
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Case { way, payload, receivers } = self.case;
        write!(f, "{}, {payload} B to {receivers}, {}", way.name(), schedule::PHASES[self.phase].name)
    }
}

fn main() -> ExitCode {
    support::main_with(play, measure)
}

/// A process of a run.
fn play(words: &[&str]) -> Outcome<()> {
    let [part, way, payload, receivers, domain, place, ref rest @ ..] = *words else {
        return Err(format!("no part {words:?}").into());
    };
    let way = Way::named(way)?;
    let task = Task { way, payload: payload.parse()?, receivers: receivers.parse()?, domain, place };
    match (part, rest) {
        ("send", []) => sender::play(&task),
        ("receive", [number, address]) => receiver::play(&task, number.parse()?, address),
        _ => Err(format!("no part {words:?}").into()),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let pairs = if options.quick { options.pairs().min(2) } else { options.pairs() };
    let (payloads, receivers): (&[usize], &[usize]) =
        if options.quick { (&[TELEGRAM, MEBIBYTE], &[1, 16]) } else { (&PAYLOADS, &RECEIVERS) };
    let stage = Stage::new()?;
    let processors = available_parallelism()?.get();
    let mut cells = Vec::new();
    for (number, payload) in payloads.iter().enumerate() {
        for receivers in receivers {
            tell(&format!("{payload} bytes to {receivers}, length {} of {}", number + 1, payloads.len()));
            cells.extend(compare(&stage, *payload, *receivers, processors, pairs)?);
        }
    }
    drop(stage);
    table::print(options, processors, pairs, &cells);
    targets::print(options, &cells);
    match &options.draw {
        Some(directory) => Ok(table::draw(directory, &cells)?),
        None => Ok(()),
    }
}

/// All mechanisms with the same messages and the same number of receivers, `pairs` times, each time another one first.
fn compare(
    stage: &Stage,
    payload: usize,
    receivers: usize,
    processors: usize,
    pairs: usize,
) -> Outcome<Vec<Cell>> {
    let ways = Way::ALL.into_iter().filter(|way| way.runs(receivers, payload, processors));
    let mut cases: Vec<_> = ways.map(|way| Case { way, payload, receivers }).collect();
    let mut cells: Vec<Cell> = Vec::new();
    for case in &cases {
        let phases = 1..schedule::PHASES.len();
        let phases = phases.filter(|phase| schedule::PHASES[*phase].count(case.way) > 0);
        cells.extend(phases.map(|phase| Cell { case: *case, phase, runs: Vec::new() }));
    }
    for _ in 0..pairs {
        for case in &cases {
            let measured = case.measure(stage).map_err(|error| format!("{case:?}: {error}"))?;
            for (phase, measured) in measured {
                let cell = cells.iter_mut().find(|cell| cell.case == *case && cell.phase == phase);
                cell.ok_or("no such phase")?.runs.push(measured);
            }
        }
        cases.rotate_left(1);
    }
    Ok(cells)
}

/// Says how far it is to who watches.
fn tell(progress: &str) {
    if std::io::stderr().is_terminal() {
        eprintln!("{progress}");
    }
}

/// A telegram of 361 values.
const TELEGRAM: usize = 732;
const MEBIBYTE: usize = 1 << 20;
const PAYLOADS: [usize; 4] = [TELEGRAM, message::SCAN, 1 << 16, MEBIBYTE];
const RECEIVERS: [usize; 4] = [1, 4, 16, 64];
