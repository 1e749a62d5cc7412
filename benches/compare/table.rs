//! The tables and the charts: each mechanism's latencies and costs, one table for each length of messages, number of
//! receivers and rate. Refuses to judge.

use std::path::Path;

use serde_json::json;

use super::Cell;
use super::run::{Case, Measured};
use super::schedule::PHASES;
use super::way::Way;
use crate::support::Outcome;
use crate::support::chart::{Chart, Point, Scale, Series};
use crate::support::figures::{self, percentile};
use crate::support::options::Options;

/// Prints them all, after the machine: with `--json` a line `{class: "machine", bench, machine, processors, runs}`.
pub(crate) fn print(options: &Options, processors: usize, pairs: usize, cells: &[Cell]) {
    if options.json {
        let line = json!({
            "class": "machine", "bench": "compare", "machine": machine(), "processors": processors, "runs": pairs,
        });
        println!("{line}");
    } else {
        println!("{}, {processors} processors, {pairs} runs each: median [least .. most]", machine());
        println!(
            "With more receivers than processors the last one waits for the others' processor time, by every mechanism. \
             Datagrams of UDP hold 65507 bytes and those of Unix sockets 65536 here: longer messages are sent in parts. \
             Flat out, streams, pipes and Unix datagrams wait for their receivers, multicast and topics lose."
        );
    }
    figures::print_cells("compare", options.json, &cells.iter().flat_map(columns).collect::<Vec<_>>());
}

/// What a figure is taken from.
pub(crate) type Of = fn(&Measured) -> Option<f64>;

fn columns(cell: &Cell) -> Vec<figures::Cell> {
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
    let Case { way, payload, receivers } = cell.case;
    let figure = |what: &str, (column, unit, of): (&str, &'static str, Of)| figures::Cell {
        table: format!("{payload} B to {receivers}, {}: {what}", PHASES[cell.phase].name),
        row: way.name().into(),
        column: column.into(),
        unit,
        values: values(cell, of),
    };
    let latency = LATENCY.into_iter().map(|column| figure("latency", column));
    let all = latency.chain(COST.into_iter().map(|column| figure("cost", column)));
    all.filter(|figure| !figure.values.is_empty()).collect()
}

/// One value of each run that has it.
pub(crate) fn values(cell: &Cell, of: Of) -> Vec<f64> {
    cell.runs.iter().filter_map(of).collect()
}

/// Latency and sender's cost over the number of receivers, for each length of messages and each rate, as SVG.
pub(crate) fn draw(directory: &Path, cells: &[Cell]) -> Outcome<()> {
    const QUANTITIES: [(&str, &str, Of); 2] = [
        ("last", "last receiver's latency, p50, us", |run| run.last[0]),
        ("sender", "sender's processor time for a message, us", |run| Some(run.sender_us)),
    ];
    let mut payloads: Vec<usize> = cells.iter().map(|cell| cell.case.payload).collect();
    payloads.dedup();
    for payload in payloads {
        for (phase, about) in PHASES.iter().enumerate().skip(1) {
            for (name, label, of) in QUANTITIES {
                let title = format!("{payload} bytes, {}", about.name);
                let ways = Way::ALL.into_iter().filter(|way| !way.is_floor() && *way != Way::Attachment);
                let is_drawn = |cell: &Cell, way| {
                    (cell.case.way, cell.case.payload, cell.phase) == (way, payload, phase)
                };
                let series = ways.map(|way| Series {
                    name: way.name().into(),
                    points: cells
                        .iter()
                        .filter(|cell| is_drawn(cell, way))
                        .filter_map(|cell| point(cell, of))
                        .collect(),
                });
                let series: Vec<_> = series.filter(|series| !series.points.is_empty()).collect();
                let chart = Chart::new(&title, "receivers", label).x(Scale::Log).y(Scale::Log).lines(&series);
                let rate = about.name.replace(' ', "-");
                chart.write(&directory.join(format!("compare-{payload}-{rate}-{name}.svg")))?;
            }
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
