//! Scanners whose heads turn, at ptys of the simulator in this process: their adapter is out of its socket for two seconds, or
//! their power is gone for a moment. How long until a consumer has a scan again: of a whole turn, as all of them are.

use std::collections::VecDeque;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use sim::options::{Scanner, SimulateOptions};
use sim::{Event, simulate_with};

use crate::support::child::Child;
use crate::support::figures::{Figure, Target};
use crate::support::options::Options;
use crate::support::stage::{PATIENCE, PROGRAM, Stage};
use crate::support::{Outcome, clock};

/// A scanner of a family.
struct Head {
    family: &'static str,
    scanner: Scanner,
    back: &'static str,
    powered: &'static str,
}

const HEADS: [Head; 2] = [
    Head {
        family: "ld",
        scanner: Scanner::Ld(sim::ld::Model::Ld19),
        back: "LD19: back, longest until a scan",
        powered: "LD19: power back, longest until a scan, 0.5 s of booting aside",
    },
    Head {
        family: "rplidar",
        scanner: Scanner::Rplidar { model: sim::rplidar::Model::A1, mode: 3 },
        back: "RPLIDAR A1: back, longest until a scan",
        powered: "RPLIDAR A1: power back, longest until a scan, 0.5 s of booting aside",
    },
];

/// The figures of all of them.
pub(crate) fn measure(options: &Options) -> Outcome<Vec<Figure>> {
    let mut figures = Vec::new();
    for head in &HEADS {
        figures.extend(head.measure(options)?);
    }
    Ok(figures)
}

impl Head {
    fn measure(&self, options: &Options) -> Outcome<[Figure; 2]> {
        let stage = Stage::new()?;
        let port = PathBuf::from(stage.port("front"));
        let events = Arc::new(Mutex::new(VecDeque::new()));
        let (stop, stopped) = UnixStream::pair()?;
        let simulator = thread::spawn({
            let (events, port) = (events.clone(), port.clone());
            let scanner = Some(self.scanner);
            let options =
                SimulateOptions { ports: vec![port], scanner, boot: BOOT, ..SimulateOptions::default() };
            let next = move |_: &Path| events.lock().ok()?.pop_front();
            move || simulate_with(&options, &stopped, |_| {}, |_| {}, next, |_, _| {})
        });
        await_name(&port);
        let mut command = stage.hub_command(PROGRAM, &["front"]);
        command.arg(format!("--set=link.front.family={}", self.family));
        let hub = Child::of(command, Stdio::null())?;
        hub.await_line("ready", PATIENCE)?;
        let scans = stage.consumer("each", "front", &[])?;
        scans.await_line("scanned", PATIENCE)?;
        let suffer =
            |event: Event| events.lock().map(|mut events| events.push_back(event)).map_err(|_| "poisoned");
        let (mut back, mut powered) = (Vec::new(), Vec::new());
        for round in 0..options.count(10) as u64 {
            // Another phase of the turn each time.
            clock::rest(clock::now() + (1_000 + 37 * (round % 10)) * MILLIS);
            suffer(Event::Unplug(OUT))?;
            while port.exists() {
                clock::rest(clock::now() + MILLIS);
            }
            scans.lines_so_far();
            await_name(&port);
            let since = clock::now();
            back.push((scans.await_line("scanned", PATIENCE)?.number(2)? - since) as f64 / 1e6);
            clock::rest(clock::now() + (1_000 + 41 * (round % 10)) * MILLIS);
            suffer(Event::PowerCycle)?;
            // What was on its way has come by then, and nothing else can have.
            clock::rest(clock::now() + BOOT.as_nanos() as u64);
            let since = clock::now();
            scans.lines_so_far();
            powered.push((scans.await_line("scanned", PATIENCE)?.number(2)? - since) as f64 / 1e6);
        }
        drop((scans, hub, stop));
        simulator.join().map_err(|_| "the simulator panicked")??;
        let worst = |values: &[f64]| vec![values.iter().copied().fold(0.0, f64::max)];
        let figure = |name, values: &[f64], target| Figure {
            name,
            unit: "ms",
            hub: worst(values),
            floor: Vec::new(),
            target,
        };
        Ok([figure(self.back, &back, Target::Most(500.0)), figure(self.powered, &powered, Target::None)])
    }
}

fn await_name(port: &Path) {
    while !port.exists() {
        clock::rest(clock::now() + MILLIS);
    }
}

/// From power to the first word.
const BOOT: Duration = Duration::from_millis(500);
/// How long an adapter is out of its socket, in ns.
const OUT: u64 = 2_000 * MILLIS;
const MILLIS: u64 = 1_000_000;
