//! Load that programs which use two sensors cause on a machine (the paper's Fig. 7), in five setups.
//!
//! - a: Each program reads the raw bytes from its own two lines, one byte at a time, and processes them itself.
//! - b: Like a, but each program reads all bytes that have arrived.
//! - c: Each program receives plain telegrams by multicast, as from the paper's unit, and does the rest itself.
//! - d: Each program receives the scans of the hub.
//! - e: Each program receives the zones and the foreground of the hub.
//!
//! Each program is a process, and must receive 37.5 scans per second of each sensor. A table shows the rate that each
//! program reached. Processes that simulate hardware do not count: the simulators, and in setup c the paper's unit.
//! Their CPU time is subtracted from that of the machine.
//!
//! The CPU time of each run is counted in two ways. The first one is `/proc/stat`, which the paper used. It covers the
//! whole machine with all other programs that run, and counts interrupts as system time. A kernel that counts by ticks
//! (CONFIG_TICK_CPU_ACCOUNTING) adds a tick of 1 to 10 ms to the thread that runs at the tick. Most threads here run
//! for less than 0.1 ms at a time. The table "/proc/stat, as a share of the scheduler's count" shows the error, and 100
//! % would be exact. The share is larger if other processes ended during the run, because the scheduler's count does
//! not contain these processes.
//!
//! The second way is the scheduler's count of the CPU time of each process, in nanoseconds (schedstat). Only the
//! division into user and system time comes from ticks, over the whole run time of a process. The targets apply to the
//! scheduler's count. It excludes the CPU time that threads of the kernel need for ptys, which increases with the
//! number of ptys. Another table shows this CPU time.
//!
//! The bench does not measure the cost of a real UART, because a pty has no interrupts. No other programs should run on
//! the machine.
//!
//! Figures are shares of one processor. A rate below 37.5 Hz means that the programs of the setup could not keep up.
//! The load is then that of an overloaded machine.

mod cpu_time;
mod datagrams;
#[path = "../../hub/drivers/tests/lms/line.rs"]
#[allow(dead_code)] // Only the simplest parser is used.
mod line;
mod setup;
mod subscriber;
#[path = "../support/mod.rs"]
mod support;

use std::io::IsTerminal;
use std::process::ExitCode;
use std::time::Duration;

use setup::{Host, Load, PART_NAME, Setup};
use support::figures::{self, Cell, Figure, Target};
use support::{Options, Outcome};

fn main() -> ExitCode {
    support::main_with(run_part, measure)
}

fn run_part(words: &[&str]) -> Outcome<()> {
    match *words {
        [PART_NAME, "bytes", most, front, rear] => subscriber::read_bytes([front, rear], most.parse()?),
        [PART_NAME, "datagrams", port] => subscriber::receive_datagrams(port.parse()?),
        [PART_NAME, "scans", domain] => subscriber::receive_scans(domain),
        [PART_NAME, "results", domain] => subscriber::receive_results(domain),
        [PART_NAME, "unit", port] => datagrams::send(port.parse()?),
        _ => support::run_part(words),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let counts: &[usize] = if options.quick { &[1, 4] } else { &[1, 2, 4, 8, 16] };
    let seconds = options.seconds(if options.quick { 5 } else { 60 });
    let pairs = options.pairs_or(match seconds {
        _ if options.quick => 2,
        ..30 => 5,
        _ => 1,
    });
    let span = Duration::from_secs(seconds);
    let mut runs = Vec::new();
    for pair in 0..pairs {
        // CPU time of the sender of datagrams when there are no receivers.
        let deaf = Setup::Datagrams.start(0)?.measure(span)?.drivers;
        for (round, &count) in counts.iter().enumerate() {
            let mut setups = Setup::ALL;
            setups.rotate_left((pair + round) % Setup::ALL.len());
            for setup in setups {
                if std::io::stderr().is_terminal() {
                    eprintln!("{} of {pairs}: {count} subscribers, {}", pair + 1, setup.name());
                }
                let load = setup.start(count)?.measure(span)?;
                runs.push(MeasuredLoad {
                    setup,
                    count,
                    host: load.of_host((setup == Setup::Datagrams).then_some(deaf)),
                    load,
                });
            }
        }
    }
    Tables::of(&runs, counts)?.print(options);
    Ok(())
}

/// One run of a setup.
struct MeasuredLoad {
    setup: Setup,
    count: usize,
    host: Host,
    load: Load,
}

/// All runs.
struct Tables<'a> {
    runs: &'a [MeasuredLoad],
    counts: &'a [usize],
    processors: usize,
}

/// One table.
struct Table {
    name: &'static str,
    unit: &'static str,
    rows: &'static [Setup],
    value_of: Value,
}

/// Function that returns the value of a run for a table.
type Value = fn(&MeasuredLoad) -> f64;

impl<'a> Tables<'a> {
    /// Creates the tables of runs with these numbers of subscribers.
    fn of(runs: &'a [MeasuredLoad], counts: &'a [usize]) -> Outcome<Tables<'a>> {
        Ok(Tables { runs, counts, processors: cpu_time::processors()? })
    }

    /// Prints the tables.
    fn print(&self, options: &Options) {
        figures::print_cells(BENCH_NAME, options.json, &self.cells());
        figures::print(BENCH_NAME, options.json, &self.figures());
    }

    fn cells(&self) -> Vec<Cell> {
        let mut cells = Vec::new();
        for Table { name, unit, rows, value_of } in TABLES {
            self.table(name.into(), unit, rows, value_of, &mut cells);
        }
        // Share of all processors, as in the paper.
        let all = self.processors;
        let parts: [(&str, Value); 2] =
            [("system", |run| run.host.machine.system), ("user", |run| run.host.machine.user)];
        for (part, value) in parts {
            let table = format!("{part}, /proc/stat, of all {all} processors");
            let from = cells.len();
            self.table(table, "%", &Setup::ALL, value, &mut cells);
            let values = cells[from..].iter_mut().flat_map(|cell| &mut cell.values);
            values.for_each(|value| *value /= all as f64);
        }
        cells
    }

    fn table(&self, table: String, unit: &'static str, rows: &[Setup], value: Value, cells: &mut Vec<Cell>) {
        for &setup in rows {
            for &count in self.counts {
                let (row, column) = (setup.name().into(), subscriber_label(count));
                let values = self.series(setup, count, value);
                cells.push(Cell { table: table.clone(), row, column, unit, values });
            }
        }
    }

    /// Returns the figures for programs that use the results of the hub, compared with programs that read raw bytes.
    /// The targets come from the paper. They are a sixth of the system time and a third of the user time.
    fn figures(&self) -> Vec<Figure> {
        let of = |name, value: Value, target| {
            let [hub, baseline] =
                [Setup::Results, Setup::Bytes].map(|setup| self.series(setup, MAX_SUBSCRIBERS, value));
            Figure { name, unit: "%", hub, baseline, target }
        };
        vec![
            of("system, processes", |run| run.host.processes.system, Target::Ratio(0.166)),
            of("user, processes", |run| run.host.processes.user, Target::Ratio(0.333)),
            of("system, /proc/stat", |run| run.host.machine.system, Target::None),
            of("user, /proc/stat", |run| run.host.machine.user, Target::None),
        ]
    }

    fn series(&self, setup: Setup, count: usize, value: Value) -> Vec<f64> {
        self.chosen(setup, count).map(value).collect()
    }

    fn chosen(&self, setup: Setup, count: usize) -> impl Iterator<Item = &MeasuredLoad> {
        self.runs.iter().filter(move |run| run.setup == setup && run.count == count)
    }
}

fn subscriber_label(count: usize) -> String {
    if count == 1 { "1 subscriber".into() } else { format!("{count} subscribers") }
}

const fn load(name: &'static str, rows: &'static [Setup], value_of: Value) -> Table {
    Table { name, unit: "%", rows, value_of }
}

const BENCH_NAME: &str = "host_load";
/// Number of subscribers in the paper's setup. The figures in the paper are for this number of subscribers.
const MAX_SUBSCRIBERS: usize = 4;
/// Setups with a hub.
const WITH_HUB: [Setup; 2] = [Setup::Scans, Setup::Results];
/// Tables of the bench. All loads are in percent of one processor.
const TABLES: [Table; 11] = [
    load("system, processes of the host", &Setup::ALL, |run| run.host.processes.system),
    load("user, processes of the host", &Setup::ALL, |run| run.host.processes.user),
    load("system, the hub's part", &WITH_HUB, |run| run.load.hub.system),
    load("user, the hub's part", &WITH_HUB, |run| run.load.hub.user),
    load("system, /proc/stat", &Setup::ALL, |run| run.host.machine.system),
    load("user, /proc/stat", &Setup::ALL, |run| run.host.machine.user),
    load("threads of the kernel", &Setup::ALL, |run| run.load.kernel),
    load("left out: simulators or unit", &Setup::ALL, |run| run.load.drivers.total()),
    Table {
        name: "minimum of scans a second of each sensor",
        unit: "Hz",
        rows: &Setup::ALL,
        value_of: |run| run.load.hz,
    },
    load("/proc/stat, as a share of the scheduler's count", &Setup::ALL, |run| {
        100.0 * run.load.machine.total() / run.load.all_processes
    }),
    load("stolen by the hypervisor", &Setup::ALL, |run| run.load.stolen),
];
