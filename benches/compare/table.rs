//! The tables and the charts: each mechanism's latencies and costs, one table for each length of messages, number of
//! receivers and rate. Refuses to judge.

use std::path::Path;

use serde_json::{Value, json};

use super::Cell;
use super::run::{Case, Measured};
use super::schedule::PHASES;
use super::way::Way;
use crate::support::Outcome;
use crate::support::chart::{Chart, Point, Scale, Series};
use crate::support::figures::{self, Spread, percentile};
use crate::support::options::Options;

/// What a figure is taken from.
pub(crate) type Of = fn(&Measured) -> Option<f64>;

/// Prints them all, after the machine. With `--json`: a line `{class: "machine", bench, machine, processors, runs}`, the
/// digests as cells, and a line of class `compared` with all figures of a mechanism, length, number and rate.
pub(crate) fn print(options: &Options, processors: usize, pairs: usize, cells: &[Cell]) {
    let digests = cells.iter().flat_map(digests).collect::<Vec<_>>();
    if options.json {
        let line = json!({
            "class": "machine", "bench": "compare", "machine": machine(), "processors": processors, "runs": pairs,
        });
        println!("{line}");
        figures::print_cells("compare", true, &in_tables(digests));
        cells.iter().for_each(|cell| println!("{}", compared(cell)));
        return;
    }
    println!("{}, {processors} processors, {pairs} runs each: median [least .. most]", machine());
    println!(
        "With more receivers than processors the last one waits for the others' processor time, by every mechanism. \
         Datagrams of UDP hold 65507 bytes and those of Unix sockets 65536 here: longer messages are sent in parts. \
         Flat out, streams, pipes and Unix datagrams wait for their receivers, multicast and topics lose."
    );
    figures::print_cells("compare", false, &in_tables(cells.iter().flat_map(columns).collect()));
    figures::print_cells("compare", false, &in_tables(digests));
}

const LATENCY: [(&str, &str, Of); 6] = [
    ("p50", "us", |run| run.latency[0]),
    ("p99", "us", |run| run.latency[1]),
    ("p99.9", "us", |run| run.latency[2]),
    ("last, p50", "us", |run| run.last[0]),
    ("last, p99", "us", |run| run.last[1]),
    ("last, p99.9", "us", |run| run.last[2]),
];
const COST: [(&str, &str, Of); 6] = [
    ("sender, a message", "us", |run| Some(run.sender_us)),
    ("of it sending", "us", |run| run.sending_us),
    ("receiver, a message", "us", |run| run.receiver_us),
    ("received, a second", "1/s", |run| Some(run.rate_hz)),
    ("missed", "%", |run| Some(run.missed_percent)),
    ("sent, of the rate", "%", |run| run.kept_percent),
];

/// All figures, for who reads.
fn columns(cell: &Cell) -> Vec<figures::Cell> {
    let Case { way, payload, receivers } = cell.case;
    let figure = |what: &str, (column, unit, of): (&str, &'static str, Of)| figures::Cell {
        table: format!("{payload} B to {receivers}, {}: {what}", PHASES[cell.phase].name),
        row: way.name().into(),
        column: column.into(),
        unit,
        values: values(cell, of),
    };
    let latency = LATENCY.into_iter().map(|column| figure("latency", column));
    latency.chain(COST.into_iter().map(|column| figure("cost", column))).collect()
}

/// The figures that tell most, over the number of receivers.
fn digests(cell: &Cell) -> Vec<figures::Cell> {
    const PACED: [(&str, &str, Of); 2] = [
        ("latency of the last receiver, p50", "us", |run| run.last[0]),
        ("processor time of the sender for a message", "us", |run| Some(run.sender_us)),
    ];
    const FLAT_OUT: [(&str, &str, Of); 1] = [("received by each, a second", "1/s", |run| Some(run.rate_hz))];
    let Case { way, payload, receivers } = cell.case;
    let figure = |(what, unit, of): &(&str, &'static str, Of)| figures::Cell {
        table: format!("{payload} B, {}: {what}", PHASES[cell.phase].name),
        row: way.name().into(),
        column: format!("to {receivers}"),
        unit,
        values: values(cell, *of),
    };
    let all: &[_] = if cell.is_paced() { &PACED } else { &FLAT_OUT };
    all.iter().map(figure).collect()
}

/// Those that could be measured.
fn in_tables(mut cells: Vec<figures::Cell>) -> Vec<figures::Cell> {
    cells.retain(|cell| !cell.values.is_empty());
    cells
}

fn compared(cell: &Cell) -> Value {
    let Case { way, payload, receivers } = cell.case;
    let mut line = json!({
        "class": "compared", "bench": "compare", "way": way.name(), "bytes": payload, "receivers": receivers,
        "rate": PHASES[cell.phase].name,
    });
    for (name, unit, of) in LATENCY.into_iter().chain(COST) {
        line[format!("{name}, {unit}")] = json!(Spread::of(&values(cell, of)).map(|spread| spread.json()));
    }
    line
}

/// One value of each run that has it.
pub(crate) fn values(cell: &Cell, of: Of) -> Vec<f64> {
    cell.runs.iter().filter_map(of).collect()
}

/// Latency and sender's cost over the number of receivers, for each length of messages at the hub's rate, as SVG. Who
/// spins is left out: there are hardly processors for more than one.
pub(crate) fn draw(directory: &Path, cells: &[Cell]) -> Outcome<()> {
    const QUANTITIES: [(&str, &str, Of); 2] = [
        ("last", "last receiver's latency, p50, us", |run| run.last[0]),
        ("sender", "sender's processor time for a message, us", |run| Some(run.sender_us)),
    ];
    const DRAWN: usize = 1;
    let mut payloads: Vec<usize> = cells.iter().map(|cell| cell.case.payload).collect();
    payloads.dedup();
    for payload in payloads {
        for (name, label, of) in QUANTITIES {
            let ways = Way::ALL
                .into_iter()
                .filter(|way| way.is_rival() || matches!(way, Way::Doorbell | Way::Event));
            let series: Vec<_> = ways
                .map(|way| {
                    let drawn = cells.iter().filter(|cell| {
                        (cell.case.way, cell.case.payload, cell.phase) == (way, payload, DRAWN)
                    });
                    Series {
                        name: way.name().into(),
                        points: drawn.filter_map(|cell| point(cell, of)).collect(),
                    }
                })
                .collect();
            let title = format!("{payload} bytes, {}", PHASES[DRAWN].name);
            let chart = Chart::new(&title, "receivers", label).x(Scale::Log).y(Scale::Log).lines(&series);
            chart.write(&directory.join(format!("compare-{payload}-{name}.svg")))?;
        }
    }
    Ok(())
}

fn point(cell: &Cell, of: Of) -> Option<Point> {
    let mut values = values(cell, of);
    values.sort_by(f64::total_cmp);
    Some(Point {
        x: cell.case.receivers as f64,
        y: percentile(&values, 0.5)?,
        least: *values.first()?,
        most: *values.last()?,
    })
}

/// Processor and kernel.
fn machine() -> String {
    let read = |path| std::fs::read_to_string(path).unwrap_or_default();
    let (processor, kernel) = (read("/proc/cpuinfo"), read("/proc/sys/kernel/osrelease"));
    let model = processor.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    format!("{}, Linux {}", model.map_or("unknown processor", |(_, model)| model), kernel.trim())
}
