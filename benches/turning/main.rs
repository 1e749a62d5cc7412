//! What do scanners whose head turns cost the hub, beside a reader that coalesces their packets alike and does nothing
//! else? And what do their scans say after the hub was stopped for half a second? Simulated scanners on ptys, two
//! consumers each, as processes. It does not tell what a real adapter costs, nor what consumers do.

#[path = "../support/mod.rs"]
mod support;

mod floor;
mod follow;

use std::process::{Command, ExitCode};
use std::thread;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use schema::{Counter, Status};
use support::child::Child;
use support::figures::{self, Figure, Target};
use support::options::Options;
use support::stage::{PATIENCE, PROGRAM, Stage};
use support::truth::Truth;
use support::work::Work;
use support::{Outcome, clock, consumer};

fn main() -> ExitCode {
    let play = |words: &[&str]| match *words {
        ["coalesce", turn, ref ports @ ..] => floor::coalesce(turn.parse()?, ports),
        ["follow", domain, sensor] => follow::scans(domain, sensor),
        ["packets", domain, sensor, len] => follow::packets(domain, sensor, len.parse()?),
        _ => support::play(words),
    };
    support::main_with(play, measure)
}

/// Scanners of one kind.
struct Fleet {
    family: &'static str,
    model: &'static str,
    /// Bytes that one sends in a turn, about.
    turn: usize,
    /// Bytes of a packet, and nanoseconds from one to the next.
    packet: (usize, u64),
    load: &'static str,
    missed: &'static str,
    off: &'static str,
    wrong: &'static str,
    stood: &'static str,
    uneven: &'static str,
    incomplete: &'static str,
}

const FLEETS: [Fleet; 2] = [
    Fleet {
        family: "ld",
        model: "ld19",
        turn: 450 / 12 * 47,
        packet: (47, 12 * 1_000_000_000 / 4_500),
        load: "8 LD19: processor time",
        missed: "8 LD19: scans that a consumer missed, and packets that the hub lost",
        off: "LD19, 20 stalls of 0.5 s: stamps of packets off by at most",
        wrong: "LD19, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stood: "LD19, 20 stalls of 0.5 s: for so long the simulator was kept from sending",
        uneven: "LD19, 20 stalls of 0.5 s: stamps of scans uneven by at most",
        incomplete: "LD19, 20 stalls of 0.5 s: turns marked incomplete",
    },
    Fleet {
        family: "rplidar",
        model: "s2",
        turn: 3_200 / 40 * 84,
        packet: (84, 40 * 1_000_000_000 / 32_000),
        load: "8 RPLIDAR S2: processor time",
        missed: "8 RPLIDAR S2: scans that a consumer missed, and packets that the hub lost",
        off: "RPLIDAR S2, 20 stalls of 0.5 s: stamps of packets off by at most",
        wrong: "RPLIDAR S2, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stood: "RPLIDAR S2, 20 stalls of 0.5 s: for so long the simulator was kept from sending",
        uneven: "RPLIDAR S2, 20 stalls of 0.5 s: stamps of scans uneven by at most",
        incomplete: "RPLIDAR S2, 20 stalls of 0.5 s: turns marked incomplete",
    },
];

fn measure(options: &Options) -> Outcome<()> {
    let mut figures = Vec::new();
    for fleet in &FLEETS {
        figures.extend(load(fleet, options)?);
        figures.extend(stalls(fleet, options)?);
    }
    figures::print("turning", options.json, &figures);
    Ok(())
}

/// Processor time of the hub and of its floor, in turns on the same lines.
fn load(fleet: &Fleet, options: &Options) -> Outcome<[Figure; 2]> {
    let stage = Stage::new()?;
    let _simulator = fleet.simulate(&stage, &SENSORS)?;
    let span = Duration::from_secs(options.seconds(20));
    let (mut hub, mut floor, mut lost) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        for turn in 0..2 {
            if (pair + turn) % 2 == 0 {
                let (busy, gone) = fleet.load_of_hub(&stage, span)?;
                hub.push(busy);
                lost.push(gone);
            } else {
                floor.push(fleet.load_of_floor(&stage, span)?);
            }
        }
    }
    Ok([
        Figure { name: fleet.load, unit: "% of a processor", hub, floor, target: Target::Ratio(2.0) },
        Figure { name: fleet.missed, unit: "1", hub: lost, floor: Vec::new(), target: Target::Most(0.0) },
    ])
}

/// Stops the hub for half a second, again and again, while two scanners go on.
fn stalls(fleet: &Fleet, options: &Options) -> Outcome<[Figure; 5]> {
    let stage = Stage::new()?;
    let sensors = &SENSORS[..2];
    let alone = |sensor: &&str| stage.simulate_one(sensor, &fleet.flags());
    let simulators: Vec<Child> = sensors.iter().map(alone).collect::<Outcome<_>>()?;
    let (hub, consumers) = fleet.start_hub(&stage, sensors, 1)?;
    let (len, every_ns) = fleet.packet;
    let stamps = |sensor: &&str| stage.part(&["packets", stage.domain.name(), sensor, &len.to_string()]);
    let stamps: Vec<Child> = sensors.iter().map(stamps).collect::<Outcome<_>>()?;
    let process = Pid::from_raw(hub.guard.pid() as i32).ok_or("no process")?;
    thread::sleep(SETTLING);
    consumers.iter().chain(&stamps).for_each(|consumer| drop(consumer.lines_so_far()));
    for round in 0..options.count(20) as u64 {
        // Another phase of the turn each time.
        thread::sleep(Duration::from_millis(1500 + 17 * (round % 10)));
        kill_process(process, Signal::STOP)?;
        thread::sleep(STALL);
        kill_process(process, Signal::CONT)?;
    }
    thread::sleep(SETTLING);
    let (mut uneven, mut incomplete) = (Vec::new(), Vec::new());
    for consumer in &consumers {
        let scans = follow::Scans::of(&consumer.lines_so_far())?;
        uneven.push(scans.unevenness_ms());
        incomplete.push(scans.incomplete as f64);
    }
    hub.guard.kill()?;
    drop(simulators);
    let (mut off, mut wrong, mut stood) = (Vec::new(), Vec::new(), Vec::new());
    for (sensor, stamps) in sensors.iter().zip(&stamps) {
        let truth = Truth::read(&stage.own_truth(sensor), sensor)?;
        let (due, stood_ns) = truth.due(every_ns);
        let (worst, count) = follow::off_ms(&stamps.lines_so_far(), &due, LIMIT_MS)?;
        off.push(worst);
        wrong.push(count as f64);
        stood.push(stood_ns as f64 / 1e6);
    }
    let none = Vec::new;
    Ok([
        Figure { name: fleet.off, unit: "ms", hub: off, floor: none(), target: Target::Most(LIMIT_MS) },
        Figure { name: fleet.wrong, unit: "1", hub: wrong, floor: none(), target: Target::Most(0.0) },
        // Where that is much, a real scanner would have sent: stamps are off by it, and uneven.
        Figure { name: fleet.stood, unit: "ms", hub: stood, floor: none(), target: Target::None },
        Figure {
            name: fleet.uneven,
            unit: "ms",
            hub: uneven,
            floor: Vec::new(),
            target: Target::Most(LIMIT_MS),
        },
        Figure {
            name: fleet.incomplete,
            unit: "1",
            hub: incomplete,
            floor: Vec::new(),
            target: Target::None,
        },
    ])
}

impl Fleet {
    /// Scanners of this kind at the other end of ptys, in a simulator of their own.
    fn simulate(&self, stage: &Stage, sensors: &[&str]) -> Outcome<Child> {
        stage.simulate_as(sensors, &self.flags())
    }

    fn flags(&self) -> [&'static str; 6] {
        ["--family", self.family, "--model", self.model, "--world", "room"]
    }

    /// The hub and so many consumers of each sensor, once scans come.
    fn start_hub(&self, stage: &Stage, sensors: &[&str], each: usize) -> Outcome<(Child, Vec<Child>)> {
        let mut command: Command = stage.hub_command(PROGRAM, sensors);
        for sensor in sensors {
            command.arg(format!("--set=link.{sensor}.family={}", self.family));
            command.arg(format!("--set=link.{sensor}.model={}", self.model));
        }
        let hub = Child::of(command, std::process::Stdio::null())?;
        hub.await_line("ready", PATIENCE)?;
        let mut consumers = Vec::new();
        for sensor in sensors {
            for _ in 0..each {
                consumers.push(stage.part(&["follow", stage.domain.name(), sensor])?);
            }
        }
        consumers.iter().try_for_each(|consumer| consumer.await_line("scan", PATIENCE).map(drop))?;
        Ok((hub, consumers))
    }

    /// Processor time of the hub, and what was lost of what consumers should have.
    fn load_of_hub(&self, stage: &Stage, span: Duration) -> Outcome<(f64, f64)> {
        let (hub, consumers) = self.start_hub(stage, &SENSORS, 2)?;
        thread::sleep(SETTLING);
        consumers.iter().for_each(|consumer| drop(consumer.lines_so_far()));
        let before = lost(stage)?;
        let busy = share(hub.guard.pid(), span)?;
        let mut gone = lost(stage)? - before;
        for consumer in &consumers {
            gone += follow::Scans::of(&consumer.lines_so_far())?.missed;
        }
        hub.guard.kill()?;
        Ok((busy, gone as f64))
    }

    fn load_of_floor(&self, stage: &Stage, span: Duration) -> Outcome<f64> {
        let ports = SENSORS.map(|sensor| stage.port(sensor));
        let turn = self.turn.to_string();
        let words: Vec<&str> =
            ["coalesce", &turn].into_iter().chain(ports.iter().map(String::as_str)).collect();
        let floor = stage.part(&words)?;
        floor.await_line("woken", PATIENCE)?;
        thread::sleep(SETTLING);
        let busy = share(floor.guard.pid(), span)?;
        floor.guard.kill()?;
        Ok(busy)
    }
}

/// The share of a processor that process `pid` uses in `span`, in percent.
fn share(pid: u32, span: Duration) -> Outcome<f64> {
    let (before, begun) = (Work::of(pid, |_| true)?, clock::now());
    thread::sleep(span);
    let work = Work::of(pid, |_| true)?.since(before);
    Ok(100.0 * work.busy_ns as f64 / (clock::now() - begun) as f64)
}

/// Transmissions that must have been sent and did not arrive, by the hub's own count.
fn lost(stage: &Stage) -> Outcome<u64> {
    let mut sum = 0;
    for sensor in SENSORS {
        let mut statuses =
            consumer::subscribe::<Status>(stage.domain.name(), sensor)?.timeout(Duration::from_secs(3));
        sum += statuses.next()?.ok_or("no status")?.counters[Counter::LostOnLine];
    }
    Ok(sum)
}

/// As many as a large vehicle has.
const SENSORS: [&str; 8] = ["a", "b", "c", "d", "e", "f", "g", "h"];
/// Until rates and clocks are learned and the start is over.
const SETTLING: Duration = Duration::from_secs(3);
/// What an overloaded machine does to a process.
const STALL: Duration = Duration::from_millis(500);
/// By more a stamp is wrong.
const LIMIT_MS: f64 = 5.0;
