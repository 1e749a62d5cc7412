//! What do rotating scanners cost the hub, compared with a reader that coalesces their packets in the same way and does
//! nothing else? And how exact are the stamps of packets and scans after the hub was stopped for half a second?
//! Simulated scanners on ptys with two subscribers each, as processes. The bench does not measure what a real adapter
//! costs, or what subscribers do.

mod support;

use std::collections::HashMap;
use std::io::Write;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::thread;
use std::time::Duration;

use rustix::event::{EventfdFlags, eventfd};
use rustix::process::{Pid, Signal, kill_process};
use scanhub_schema::{Counter, Scan, Status};
use support::baseline::{self, Line as PtyLine};
use support::figures::{self, Figure, Target};
use support::stage::{Child, Guard, Line, PATIENCE, PROGRAM, Stage};
use support::truth::Truth;
use support::usage::Work;
use support::{Options, Outcome, clock, consumer, truth};

fn main() -> ExitCode {
    let play = |words: &[&str]| match *words {
        ["coalesce", turn, ref ports @ ..] => coalesce(turn.parse()?, ports),
        ["scans", domain, sensor] => print_scans(domain, sensor),
        ["packets", domain, sensor, len] => print_packets(domain, sensor, len.parse()?),
        _ => support::play(words),
    };
    support::main_with(play, measure)
}

/// Scanners of one model, with the names of their figures.
struct Fleet {
    family: &'static str,
    model: &'static str,
    /// Approximate number of bytes per revolution.
    turn: usize,
    /// Bytes of a packet, and nanoseconds from one packet to the next.
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
        load: "8 LD19: CPU time",
        missed: "8 LD19: scans that a subscriber missed, and packets that the hub lost",
        off: "LD19, 20 stalls of 0.5 s: maximum error of the stamps of packets",
        wrong: "LD19, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stood: "LD19, 20 stalls of 0.5 s: time for which the simulator was kept from sending",
        uneven: "LD19, 20 stalls of 0.5 s: maximum unevenness of the stamps of scans",
        incomplete: "LD19, 20 stalls of 0.5 s: revolutions marked incomplete",
    },
    Fleet {
        family: "rplidar",
        model: "s2",
        turn: 3_200 / 40 * 84,
        packet: (84, 40 * 1_000_000_000 / 32_000),
        load: "8 RPLIDAR S2: CPU time",
        missed: "8 RPLIDAR S2: scans that a subscriber missed, and packets that the hub lost",
        off: "RPLIDAR S2, 20 stalls of 0.5 s: maximum error of the stamps of packets",
        wrong: "RPLIDAR S2, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stood: "RPLIDAR S2, 20 stalls of 0.5 s: time for which the simulator was kept from sending",
        uneven: "RPLIDAR S2, 20 stalls of 0.5 s: maximum unevenness of the stamps of scans",
        incomplete: "RPLIDAR S2, 20 stalls of 0.5 s: revolutions marked incomplete",
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

/// Measures the CPU time of the hub and of its baseline, alternating on the same lines.
fn load(fleet: &Fleet, options: &Options) -> Outcome<[Figure; 2]> {
    let stage = Stage::new()?;
    let _simulator = fleet.simulate(&stage, &SENSORS)?;
    let span = Duration::from_secs(options.seconds(20));
    let (mut hub, mut baseline, mut lost) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        for turn in 0..2 {
            if (pair + turn) % 2 == 0 {
                let (busy, gone) = fleet.load_of_hub(&stage, span)?;
                hub.push(busy);
                lost.push(gone);
            } else {
                baseline.push(fleet.load_of_baseline(&stage, span)?);
            }
        }
    }
    Ok([
        Figure { name: fleet.load, unit: "% of a processor", hub, baseline, target: Target::Ratio(2.0) },
        Figure { name: fleet.missed, unit: "1", hub: lost, baseline: Vec::new(), target: Target::Most(0.0) },
    ])
}

/// Stops the hub for half a second, again and again, while two scanners continue.
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
        // A different phase of the revolution in each round.
        thread::sleep(Duration::from_millis(1500 + 17 * (round % 10)));
        kill_process(process, Signal::STOP)?;
        thread::sleep(STALL);
        kill_process(process, Signal::CONT)?;
    }
    thread::sleep(SETTLING);
    let (mut uneven, mut incomplete) = (Vec::new(), Vec::new());
    for consumer in &consumers {
        let scans = Scans::of(&consumer.lines_so_far())?;
        uneven.push(scans.unevenness_ms());
        incomplete.push(scans.incomplete as f64);
    }
    hub.guard.kill()?;
    drop(simulators);
    let (mut off, mut wrong, mut stood) = (Vec::new(), Vec::new(), Vec::new());
    for (sensor, stamps) in sensors.iter().zip(&stamps) {
        let truth = Truth::read(&stage.own_truth(sensor), sensor)?;
        let (due, stood_ns) = truth.due(every_ns);
        let (worst, count) = off_ms(&stamps.lines_so_far(), &due, LIMIT_MS)?;
        off.push(worst);
        wrong.push(count as f64);
        stood.push(stood_ns as f64 / 1e6);
    }
    let none = Vec::new;
    Ok([
        Figure { name: fleet.off, unit: "ms", hub: off, baseline: none(), target: Target::Most(LIMIT_MS) },
        Figure { name: fleet.wrong, unit: "1", hub: wrong, baseline: none(), target: Target::Most(0.0) },
        // A real scanner would have sent in this time: stamps are off by it, and uneven.
        Figure { name: fleet.stood, unit: "ms", hub: stood, baseline: none(), target: Target::None },
        Figure {
            name: fleet.uneven,
            unit: "ms",
            hub: uneven,
            baseline: Vec::new(),
            target: Target::Most(LIMIT_MS),
        },
        Figure {
            name: fleet.incomplete,
            unit: "1",
            hub: incomplete,
            baseline: Vec::new(),
            target: Target::None,
        },
    ])
}

impl Fleet {
    /// Starts scanners of this model at ptys, in one simulator.
    fn simulate(&self, stage: &Stage, sensors: &[&str]) -> Outcome<Child> {
        stage.simulate_as(sensors, &self.flags())
    }

    fn flags(&self) -> [&'static str; 6] {
        ["--family", self.family, "--model", self.model, "--world", "room"]
    }

    /// Starts the hub and `each` subscribers per sensor, and waits for scans.
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
                consumers.push(stage.part(&["scans", stage.domain.name(), sensor])?);
            }
        }
        consumers.iter().try_for_each(|consumer| consumer.await_line("scan", PATIENCE).map(drop))?;
        Ok((hub, consumers))
    }

    /// Returns the CPU time of the hub, and what subscribers should have received and did not.
    fn load_of_hub(&self, stage: &Stage, span: Duration) -> Outcome<(f64, f64)> {
        let (hub, consumers) = self.start_hub(stage, &SENSORS, 2)?;
        thread::sleep(SETTLING);
        consumers.iter().for_each(|consumer| drop(consumer.lines_so_far()));
        let before = lost(stage)?;
        let busy = share(hub.guard.pid(), span)?;
        let mut gone = lost(stage)? - before;
        for consumer in &consumers {
            gone += Scans::of(&consumer.lines_so_far())?.missed;
        }
        hub.guard.kill()?;
        Ok((busy, gone as f64))
    }

    fn load_of_baseline(&self, stage: &Stage, span: Duration) -> Outcome<f64> {
        let ports = SENSORS.map(|sensor| stage.port(sensor));
        let turn = self.turn.to_string();
        let words: Vec<&str> =
            ["coalesce", &turn].into_iter().chain(ports.iter().map(String::as_str)).collect();
        let baseline = stage.part(&words)?;
        baseline.await_line("woken", PATIENCE)?;
        thread::sleep(SETTLING);
        let busy = share(baseline.guard.pid(), span)?;
        baseline.guard.kill()?;
        Ok(busy)
    }
}

/// Returns the CPU time of process `pid` in `span`, in percent.
fn share(pid: u32, span: Duration) -> Outcome<f64> {
    let (before, begun) = (Work::of(pid, |_| true)?, clock::now());
    thread::sleep(span);
    let work = Work::of(pid, |_| true)?.since(before);
    Ok(100.0 * work.busy_ns as f64 / (clock::now() - begun) as f64)
}

/// Returns the transmissions that must have been sent and did not arrive, by the hub's own count.
fn lost(stage: &Stage) -> Outcome<u64> {
    let mut sum = 0;
    for sensor in SENSORS {
        let mut statuses = consumer::builder::<Status>(stage.domain.name(), sensor)
            .timeout(Duration::from_secs(3))
            .open()?;
        sum += statuses.next()?.ok_or("no status")?.counters[Counter::LostOnLine];
    }
    Ok(sum)
}

/// Number of scanners of a large vehicle.
const SENSORS: [&str; 8] = ["a", "b", "c", "d", "e", "f", "g", "h"];
/// Time after which rates and clocks are known and the start is complete.
const SETTLING: Duration = Duration::from_secs(3);
/// Length of a stall, as on an overloaded machine.
const STALL: Duration = Duration::from_millis(500);
/// Error from which a stamp is wrong, in ms.
const LIMIT_MS: f64 = 5.0;

/// Baseline of a hub whose scanners send packets without pause: sleeps until there are bytes, waits 5 ms as the hub
/// does, reads all of them, and wakes two sleeping processes once per revolution. No framing, no checksum, no shared
/// memory.
///
/// Reads each of `ports` forever in a separate thread; a revolution has `turn` bytes.
fn coalesce(turn: usize, ports: &[&str]) -> Outcome<()> {
    let mut sleepers: Vec<Guard> = Vec::new();
    let mut readers = Vec::new();
    for (number, port) in ports.iter().enumerate() {
        let mut ends: Vec<OwnedFd> = Vec::new();
        for _ in 0..CONSUMERS {
            let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
            sleepers.push(baseline::start_sleeper(number, 0, wake.try_clone()?)?);
            ends.push(wake);
        }
        // The rate does not matter to a pty.
        let line = PtyLine::open(Path::new(port), 115_200)?;
        readers.push(thread::spawn(move || {
            if let Err(error) = read_revolutions(&line, &ends, turn) {
                // With one reader less, the baseline would be too low.
                eprintln!("baseline: {error}");
                std::process::exit(1)
            }
        }));
    }
    for reader in readers {
        reader.join().map_err(|_| "a reader panicked")?;
    }
    Ok(())
}

fn read_revolutions(line: &PtyLine, ends: &[OwnedFd], turn: usize) -> Outcome<()> {
    let mut buffer = [0; 4096];
    let mut since = 0;
    loop {
        clock::readable(line, None)?;
        clock::rest(clock::now() + REST);
        since += line.read(&mut buffer)?;
        if since >= turn {
            since -= turn;
            for end in ends {
                rustix::io::write(end, &1u64.to_ne_bytes())?;
            }
        }
    }
}

/// Subscribers of a scanner.
const CONSUMERS: usize = 2;
/// Time for which the hub leaves packets in the line, in ns.
const REST: u64 = 5_000_000;

/// Receives the scans of `sensor` forever, and prints each: `scan STAMP_NS MISSED INCOMPLETE`.
fn print_scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = consumer::subscribe::<Scan>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(scan) = scans.next()? else { continue };
        let incomplete = u8::from(scan.is_incomplete());
        writeln!(out, "scan {} {} {incomplete}", scan.header().stamp_first_ns, scan.missed)?;
    }
}

/// Receives the packets of `sensor`, of `len` bytes each, forever. Prints for each sample the stamp and the hash of its
/// last packet: `packets STAMP_NS HASH`.
fn print_packets(domain: &str, sensor: &str, len: usize) -> Outcome<()> {
    let mut samples = consumer::subscribe::<[u8]>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(sample) = samples.next()? else { continue };
        // Responses have other lengths.
        if let Some(last) = sample.rchunks_exact(len).next().filter(|_| sample.len() % len == 0) {
            writeln!(out, "packets {} {}", sample.header().stamp_last_ns, truth::hash(last))?;
        }
    }
}

/// Returns the maximum error, in ms, of the stamps in `lines`, each of which was `due` at one of these times, and how
/// many are off by more than `limit_ms`.
fn off_ms(lines: &[Line], due: &HashMap<&str, Vec<u64>>, limit_ms: f64) -> Outcome<(f64, usize)> {
    let mut off_ms = Vec::new();
    for line in lines {
        let stamp = line.number(1)?;
        let due = line.words().last().and_then(|hash| due.get(hash));
        let off = due.and_then(|due| due.iter().map(|due| due.abs_diff(stamp)).min());
        off_ms.extend(off.map(|ns| ns as f64 / 1e6));
    }
    let worst = off_ms.iter().copied().reduce(f64::max).ok_or("no packet is known to the simulator")?;
    Ok((worst, off_ms.iter().filter(|off| **off > limit_ms).count()))
}

/// The output of a subscriber to scans.
#[derive(Default)]
struct Scans {
    stamps_ns: Vec<u64>,
    missed: u64,
    incomplete: u64,
}

impl Scans {
    fn of(lines: &[Line]) -> Outcome<Scans> {
        let mut scans = Scans::default();
        for line in lines {
            scans.stamps_ns.push(line.number(1)?);
            scans.missed += line.number(2)?;
            scans.incomplete += line.number(3)?;
        }
        Ok(scans)
    }

    /// Returns by how much the distance of two consecutive scans differs from a whole number of revolutions, at most.
    fn unevenness_ms(&self) -> f64 {
        let mut spans: Vec<f64> =
            self.stamps_ns.windows(2).map(|pair| pair[1].abs_diff(pair[0]) as f64 / 1e6).collect();
        let mut sorted = spans.clone();
        sorted.sort_by(f64::total_cmp);
        let Some(&turn) = sorted.get(sorted.len() / 2) else { return f64::NAN };
        spans.iter_mut().for_each(|span| *span = (*span - turn * (*span / turn).round()).abs());
        spans.into_iter().fold(0.0, f64::max)
    }
}
