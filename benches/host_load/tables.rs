//! The load of all runs as tables, as figures with their target, and as the paper draws it. Refuses to measure.

use crate::account::{self, Share};
use crate::load::{Host, Load};
use crate::setup::SetUp;
use crate::support::Outcome;
use crate::support::chart::{Chart, Point, Series};
use crate::support::figures::{self, Cell, Figure, Target, percentile};
use crate::support::options::Options;

/// One run of a set-up.
pub(crate) struct Run {
    pub(crate) set_up: SetUp,
    pub(crate) count: usize,
    pub(crate) host: Host,
    pub(crate) load: Load,
}

/// All runs.
pub(crate) struct Tables<'a> {
    runs: &'a [Run],
    counts: &'a [usize],
    processors: usize,
}

/// What is in one table.
struct Table {
    name: &'static str,
    unit: &'static str,
    rows: &'static [SetUp],
    value: Value,
}

/// What a table shows of a run.
type Value = fn(&Run) -> f64;
/// What a colour shows of a bar.
type Part = fn(Share) -> f64;

impl<'a> Tables<'a> {
    /// Of runs with these numbers of consumers.
    pub(crate) fn of(runs: &'a [Run], counts: &'a [usize]) -> Outcome<Tables<'a>> {
        Ok(Tables { runs, counts, processors: account::processors()? })
    }

    /// Prints them, and draws them if that is wanted.
    pub(crate) fn print(&self, options: &Options) -> Outcome<()> {
        figures::print_cells(BENCH, options.json, &self.cells());
        figures::print(BENCH, options.json, &self.figures());
        if let Some(directory) = &options.draw {
            let title = "Load of the host by two sensors: hub and consumers";
            self.chart(title, |run| run.host.processes).write(&directory.join("host_load.svg"))?;
            let title = "Load of the host by two sensors: /proc/stat";
            self.chart(title, |run| run.host.machine).write(&directory.join("host_load_stat.svg"))?;
        }
        Ok(())
    }

    fn cells(&self) -> Vec<Cell> {
        let mut cells = Vec::new();
        for Table { name, unit, rows, value } in TABLES {
            self.table(name.into(), unit, rows, value, &mut cells);
        }
        // Of all processors together, as the paper has it.
        let all = self.processors;
        let parts: [(&str, Value); 2] =
            [("system", |run| run.host.machine.system), ("user", |run| run.host.machine.user)];
        for (part, value) in parts {
            let table = format!("{part}, /proc/stat, of all {all} processors");
            let from = cells.len();
            self.table(table, "%", &SetUp::ALL, value, &mut cells);
            let values = cells[from..].iter_mut().flat_map(|cell| &mut cell.values);
            values.for_each(|value| *value /= all as f64);
        }
        cells
    }

    fn table(&self, table: String, unit: &'static str, rows: &[SetUp], value: Value, cells: &mut Vec<Cell>) {
        for &set_up in rows {
            for &count in self.counts {
                let (row, column) = (set_up.name().into(), consumers(count));
                let values = self.series(set_up, count, value);
                cells.push(Cell { table: table.clone(), row, column, unit, values });
            }
        }
    }

    /// The hub's results beside raw bytes; targets are of the paper: a sixth of the system's load, a third of the user's.
    fn figures(&self) -> Vec<Figure> {
        let of = |name, value: Value, target| {
            let [hub, floor] = [SetUp::Results, SetUp::Bytes].map(|set_up| self.series(set_up, FOUR, value));
            Figure { name, unit: "%", hub, floor, target }
        };
        vec![
            of("system, processes", |run| run.host.processes.system, Target::Ratio(0.166)),
            of("user, processes", |run| run.host.processes.user, Target::Ratio(0.333)),
            of("system, /proc/stat", |run| run.host.machine.system, Target::None),
            of("user, /proc/stat", |run| run.host.machine.user, Target::None),
        ]
    }

    fn chart(&self, title: &str, share: fn(&Run) -> Share) -> Chart {
        let mut groups = Vec::new();
        let parts: [(&str, Part); 2] = [("system", |share| share.system), ("user", |share| share.user)];
        let mut series = parts.map(|(name, _)| Series { name: name.into(), points: Vec::new() });
        for &count in self.counts {
            for (set_up, letter) in SetUp::ALL.into_iter().zip(["a", "b", "c", "d", "e"]) {
                for ((_, part), series) in parts.iter().zip(&mut series) {
                    let mut values: Vec<f64> =
                        self.chosen(set_up, count).map(|run| part(share(run))).collect();
                    values.sort_by(f64::total_cmp);
                    if let (Some(y), [least, ..], [.., most]) =
                        (percentile(&values, 0.5), &values[..], &values[..])
                    {
                        let x = groups.len() as f64;
                        series.points.push(Point { x, y, least: *least, most: *most });
                    }
                }
                groups.push(format!("{letter}\n{count}"));
            }
        }
        let groups: Vec<&str> = groups.iter().map(String::as_str).collect();
        let below =
            "consumers of a: raw bytes, b: these in blocks, c: datagrams, d: scans, e: zones and foreground";
        Chart::new(title, below, "% of one processor").bars(&groups, &series)
    }

    fn series(&self, set_up: SetUp, count: usize, value: Value) -> Vec<f64> {
        self.chosen(set_up, count).map(value).collect()
    }

    fn chosen(&self, set_up: SetUp, count: usize) -> impl Iterator<Item = &Run> {
        self.runs.iter().filter(move |run| run.set_up == set_up && run.count == count)
    }
}

fn consumers(count: usize) -> String {
    if count == 1 { "1 consumer".into() } else { format!("{count} consumers") }
}

const fn load(name: &'static str, rows: &'static [SetUp], value: Value) -> Table {
    Table { name, unit: "%", rows, value }
}

const BENCH: &str = "host_load";
/// Consumers in the paper's set-up, to which its figures belong.
const FOUR: usize = 4;
/// Set-ups with a hub.
const WITH_HUB: [SetUp; 2] = [SetUp::Scans, SetUp::Results];
/// Load is in percent of one processor.
const TABLES: [Table; 11] = [
    load("system, processes of the host", &SetUp::ALL, |run| run.host.processes.system),
    load("user, processes of the host", &SetUp::ALL, |run| run.host.processes.user),
    load("system, of it the hub", &WITH_HUB, |run| run.load.hub.system),
    load("user, of it the hub", &WITH_HUB, |run| run.load.hub.user),
    load("system, /proc/stat", &SetUp::ALL, |run| run.host.machine.system),
    load("user, /proc/stat", &SetUp::ALL, |run| run.host.machine.user),
    load("threads of the kernel", &SetUp::ALL, |run| run.load.kernel),
    load("left out: simulators or unit", &SetUp::ALL, |run| run.load.outside.total()),
    Table {
        name: "scans a second of each sensor, the least",
        unit: "Hz",
        rows: &SetUp::ALL,
        value: |run| run.load.hz,
    },
    load("/proc/stat, of what the scheduler counted", &SetUp::ALL, |run| {
        100.0 * run.load.machine.total() / run.load.everybody
    }),
    load("stolen by the machine below", &SetUp::ALL, |run| run.load.stolen),
];
