//! CPU time of the hub for rotating scanners. The baseline is a reader that reads several packets at a time, as the hub
//! does, and does nothing else. The bench also measures how accurate the stamps of packets and scans are after the hub
//! was stopped for half a second. The simulated scanners are on ptys, and each of them has two subscribers, which are
//! processes. The bench does not measure the cost of a real adapter, or of subscribers.

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
use support::baseline::{self, SerialLine as PtyLine};
use support::environment::{BenchEnvironment, Child, GuardedProcess, OutputLine, PROGRAM, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::truth::SensorTruth;
use support::usage::ThreadUsage;
use support::{Options, Outcome, clock, subscriber, truth};

fn main() -> ExitCode {
    let play = |words: &[&str]| match *words {
        ["coalesce", turn, ref ports @ ..] => coalesce(turn.parse()?, ports),
        ["scans", domain, sensor] => print_scans(domain, sensor),
        ["packets", domain, sensor, len] => print_packets(domain, sensor, len.parse()?),
        _ => support::run_part(words),
    };
    support::main_with(play, measure)
}

/// Scanners of one model, with the names of their figures.
struct ScannerGroup {
    family: &'static str,
    model: &'static str,
    /// Approximate number of bytes that a scanner sends per revolution.
    revolution_len: usize,
    /// Number of bytes in a packet, and time from one packet to the next in nanoseconds.
    packet: (usize, u64),
    load_figure: &'static str,
    missed_figure: &'static str,
    stamp_error_figure: &'static str,
    wrong_figure: &'static str,
    stall_figure: &'static str,
    unevenness_figure: &'static str,
    incomplete_figure: &'static str,
}

const SCANNER_GROUPS: [ScannerGroup; 2] = [
    ScannerGroup {
        family: "ld",
        model: "ld19",
        revolution_len: 450 / 12 * 47,
        packet: (47, 12 * 1_000_000_000 / 4_500),
        load_figure: "8 LD19: CPU time",
        missed_figure: "8 LD19: scans that a subscriber missed, and packets that the hub lost",
        stamp_error_figure: "LD19, 20 stalls of 0.5 s: maximum error of the stamps of packets",
        wrong_figure: "LD19, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stall_figure: "LD19, 20 stalls of 0.5 s: time for which the simulator was kept from sending",
        unevenness_figure: "LD19, 20 stalls of 0.5 s: maximum unevenness of the stamps of scans",
        incomplete_figure: "LD19, 20 stalls of 0.5 s: revolutions marked incomplete",
    },
    ScannerGroup {
        family: "rplidar",
        model: "s2",
        revolution_len: 3_200 / 40 * 84,
        packet: (84, 40 * 1_000_000_000 / 32_000),
        load_figure: "8 RPLIDAR S2: CPU time",
        missed_figure: "8 RPLIDAR S2: scans that a subscriber missed, and packets that the hub lost",
        stamp_error_figure: "RPLIDAR S2, 20 stalls of 0.5 s: maximum error of the stamps of packets",
        wrong_figure: "RPLIDAR S2, 20 stalls of 0.5 s: samples of packets with stamps off by more than 5 ms",
        stall_figure: "RPLIDAR S2, 20 stalls of 0.5 s: time for which the simulator was kept from sending",
        unevenness_figure: "RPLIDAR S2, 20 stalls of 0.5 s: maximum unevenness of the stamps of scans",
        incomplete_figure: "RPLIDAR S2, 20 stalls of 0.5 s: revolutions marked incomplete",
    },
];

fn measure(options: &Options) -> Outcome<()> {
    let mut figures = Vec::new();
    for fleet in &SCANNER_GROUPS {
        figures.extend(load(fleet, options)?);
        figures.extend(stalls(fleet, options)?);
    }
    figures::print("rotating", options.json, &figures);
    Ok(())
}

/// Measures the CPU time of the hub and of the baseline. They run alternately on the same lines.
fn load(group: &ScannerGroup, options: &Options) -> Outcome<[Figure; 2]> {
    let environment = BenchEnvironment::new()?;
    let _simulator = group.simulate(&environment, &SENSORS)?;
    let span = Duration::from_secs(options.seconds(20));
    let (mut hub, mut baseline, mut lost) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        for round in 0..2 {
            if (pair + round) % 2 == 0 {
                let (busy, missed_share) = group.load_of_hub(&environment, span)?;
                hub.push(busy);
                lost.push(missed_share);
            } else {
                baseline.push(group.load_of_baseline(&environment, span)?);
            }
        }
    }
    Ok([
        Figure {
            name: group.load_figure,
            unit: "% of a processor",
            hub,
            baseline,
            target: Target::Ratio(2.0),
        },
        Figure {
            name: group.missed_figure,
            unit: "1",
            hub: lost,
            baseline: Vec::new(),
            target: Target::Max(0.0),
        },
    ])
}

/// Stops the hub repeatedly for half a second, while two scanners continue to send. Measures the errors of stamps.
fn stalls(group: &ScannerGroup, options: &Options) -> Outcome<[Figure; 5]> {
    let environment = BenchEnvironment::new()?;
    let sensors = &SENSORS[..2];
    let alone = |sensor: &&str| environment.simulate_one(sensor, &group.flags());
    let simulators: Vec<Child> = sensors.iter().map(alone).collect::<Outcome<_>>()?;
    let (hub, subscribers) = group.start_hub(&environment, sensors, 1)?;
    let (len, every_ns) = group.packet;
    let stamps = |sensor: &&str| {
        environment.start_part(&["packets", environment.domain.name(), sensor, &len.to_string()])
    };
    let stamps: Vec<Child> = sensors.iter().map(stamps).collect::<Outcome<_>>()?;
    let process = Pid::from_raw(hub.guard.pid() as i32).ok_or("no process")?;
    thread::sleep(SETTLE_TIME);
    subscribers.iter().chain(&stamps).for_each(|subscriber| drop(subscriber.lines_so_far()));
    for round in 0..options.count(20) as u64 {
        // Stop the hub at another phase of the revolution in each round.
        thread::sleep(Duration::from_millis(1500 + 17 * (round % 10)));
        kill_process(process, Signal::STOP)?;
        thread::sleep(STALL_TIME);
        kill_process(process, Signal::CONT)?;
    }
    thread::sleep(SETTLE_TIME);
    let (mut uneven, mut incomplete) = (Vec::new(), Vec::new());
    for subscriber in &subscribers {
        let scans = ReceivedScans::of(&subscriber.lines_so_far())?;
        uneven.push(scans.unevenness_ms());
        incomplete.push(scans.incomplete as f64);
    }
    hub.guard.kill()?;
    drop(simulators);
    let (mut off, mut wrong, mut stood) = (Vec::new(), Vec::new(), Vec::new());
    for (sensor, stamps) in sensors.iter().zip(&stamps) {
        let truth = SensorTruth::read(&environment.own_truth(sensor), sensor)?;
        let (due, stood_ns) = truth.due(every_ns);
        let (worst, count) = stamp_error_ms(&stamps.lines_so_far(), &due, MAX_STAMP_ERROR_MS)?;
        off.push(worst);
        wrong.push(count as f64);
        stood.push(stood_ns as f64 / 1e6);
    }
    let none = Vec::new;
    Ok([
        Figure {
            name: group.stamp_error_figure,
            unit: "ms",
            hub: off,
            baseline: none(),
            target: Target::Max(MAX_STAMP_ERROR_MS),
        },
        Figure {
            name: group.wrong_figure,
            unit: "1",
            hub: wrong,
            baseline: none(),
            target: Target::Max(0.0),
        },
        // Time for which the simulator did not send, although a real scanner would have. The errors of stamps and the
        // unevenness may be as long as this time.
        Figure { name: group.stall_figure, unit: "ms", hub: stood, baseline: none(), target: Target::None },
        Figure {
            name: group.unevenness_figure,
            unit: "ms",
            hub: uneven,
            baseline: Vec::new(),
            target: Target::Max(MAX_STAMP_ERROR_MS),
        },
        Figure {
            name: group.incomplete_figure,
            unit: "1",
            hub: incomplete,
            baseline: Vec::new(),
            target: Target::None,
        },
    ])
}

impl ScannerGroup {
    /// Starts one simulator with scanners of this model at ptys.
    fn simulate(&self, environment: &BenchEnvironment, sensors: &[&str]) -> Outcome<Child> {
        environment.simulate_as(sensors, &self.flags())
    }

    fn flags(&self) -> [&'static str; 6] {
        ["--family", self.family, "--model", self.model, "--world", "room"]
    }

    /// Starts the hub and `per_sensor` subscribers per sensor, and waits until each subscriber has received scans.
    fn start_hub(
        &self,
        environment: &BenchEnvironment,
        sensors: &[&str],
        per_sensor: usize,
    ) -> Outcome<(Child, Vec<Child>)> {
        let mut command: Command = environment.hub_command(PROGRAM, sensors);
        for sensor in sensors {
            command.arg(format!("--set=link.{sensor}.family={}", self.family));
            command.arg(format!("--set=link.{sensor}.model={}", self.model));
        }
        let hub = Child::spawn(command, std::process::Stdio::null())?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        let mut subscribers = Vec::new();
        for sensor in sensors {
            for _ in 0..per_sensor {
                subscribers.push(environment.start_part(&["scans", environment.domain.name(), sensor])?);
            }
        }
        subscribers
            .iter()
            .try_for_each(|subscriber| subscriber.wait_for_line("scan", STEP_TIMEOUT).map(drop))?;
        Ok((hub, subscribers))
    }

    /// Returns the CPU time of the hub, and the number of scans and packets that the subscribers missed.
    fn load_of_hub(&self, environment: &BenchEnvironment, span: Duration) -> Outcome<(f64, f64)> {
        let (hub, subscribers) = self.start_hub(environment, &SENSORS, 2)?;
        thread::sleep(SETTLE_TIME);
        subscribers.iter().for_each(|subscriber| drop(subscriber.lines_so_far()));
        let before = lost(environment)?;
        let busy = cpu_percent(hub.guard.pid(), span)?;
        let mut missed_share = lost(environment)? - before;
        for subscriber in &subscribers {
            missed_share += ReceivedScans::of(&subscriber.lines_so_far())?.missed;
        }
        hub.guard.kill()?;
        Ok((busy, missed_share as f64))
    }

    fn load_of_baseline(&self, environment: &BenchEnvironment, span: Duration) -> Outcome<f64> {
        let ports = SENSORS.map(|sensor| environment.port(sensor));
        let revolution_len = self.revolution_len.to_string();
        let words: Vec<&str> =
            ["coalesce", &revolution_len].into_iter().chain(ports.iter().map(String::as_str)).collect();
        let baseline = environment.start_part(&words)?;
        baseline.wait_for_line("woken", STEP_TIMEOUT)?;
        thread::sleep(SETTLE_TIME);
        let busy = cpu_percent(baseline.guard.pid(), span)?;
        baseline.guard.kill()?;
        Ok(busy)
    }
}

/// Returns the CPU time that the process `pid` needs in `span`, in percent of one processor.
fn cpu_percent(pid: u32, span: Duration) -> Outcome<f64> {
    let (before, started) = (ThreadUsage::of(pid, |_| true)?, clock::now());
    thread::sleep(span);
    let work = ThreadUsage::of(pid, |_| true)?.since(before);
    Ok(100.0 * work.busy_ns as f64 / (clock::now() - started) as f64)
}

/// Returns the number of packets that the hub counts as lost.
fn lost(environment: &BenchEnvironment) -> Outcome<u64> {
    let mut sum = 0;
    for sensor in SENSORS {
        let mut statuses = subscriber::builder::<Status>(environment.domain.name(), sensor)
            .timeout(Duration::from_secs(3))
            .open()?;
        sum += statuses.next()?.ok_or("no status")?.counters[Counter::LostOnLine];
    }
    Ok(sum)
}

/// Names of eight scanners, as many as a large vehicle has.
const SENSORS: [&str; 8] = ["a", "b", "c", "d", "e", "f", "g", "h"];
/// Time after which the hub has started, and has estimated rates and clocks.
const SETTLE_TIME: Duration = Duration::from_secs(3);
/// Time for which the hub is stopped, as it may happen on an overloaded machine.
const STALL_TIME: Duration = Duration::from_millis(500);
/// Minimum error of a stamp that counts as wrong, in milliseconds.
const MAX_STAMP_ERROR_MS: f64 = 5.0;

/// Baseline for scanners that send packets without a pause. It sleeps until there are bytes, waits for 5 ms like the
/// hub, reads all bytes, and wakes two sleeping processes once per revolution. It has no framing, no checksum and no
/// shared memory.
///
/// Reads each of `ports` forever in a separate thread. A revolution has `revolution_len` bytes.
fn coalesce(revolution_len: usize, ports: &[&str]) -> Outcome<()> {
    let mut sleepers: Vec<GuardedProcess> = Vec::new();
    let mut readers = Vec::new();
    for (number, port) in ports.iter().enumerate() {
        let mut ends: Vec<OwnedFd> = Vec::new();
        for _ in 0..SUBSCRIBERS_PER_SENSOR {
            let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
            sleepers.push(baseline::start_sleeper(number, 0, wake.try_clone()?)?);
            ends.push(wake);
        }
        // A pty ignores the rate.
        let line = PtyLine::open(Path::new(port), 115_200)?;
        readers.push(thread::spawn(move || {
            if let Err(error) = read_revolutions(&line, &ends, revolution_len) {
                // Exit on an error, because the load of the baseline would be too low without one of its readers.
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

fn read_revolutions(line: &PtyLine, ends: &[OwnedFd], revolution_len: usize) -> Outcome<()> {
    let mut buffer = [0; 4096];
    let mut since = 0;
    loop {
        clock::readable(line, None)?;
        clock::sleep_until(clock::now() + READ_INTERVAL_NS);
        since += line.read(&mut buffer)?;
        if since >= revolution_len {
            since -= revolution_len;
            for end in ends {
                rustix::io::write(end, &1u64.to_ne_bytes())?;
            }
        }
    }
}

/// Number of subscribers to a scanner.
const SUBSCRIBERS_PER_SENSOR: usize = 2;
/// Time for which the hub leaves packets unread in the line, in nanoseconds.
const READ_INTERVAL_NS: u64 = 5_000_000;

/// Receives the scans of `sensor` forever, and prints a line `scan STAMP_NS MISSED INCOMPLETE` for each scan.
fn print_scans(domain: &str, sensor: &str) -> Outcome<()> {
    let mut scans = subscriber::subscribe::<Scan>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(scan) = scans.next()? else { continue };
        let incomplete = u8::from(scan.is_incomplete());
        writeln!(out, "scan {} {} {incomplete}", scan.header().stamp_first_ns, scan.missed)?;
    }
}

/// Receives the packets of `sensor` forever. Each packet has `len` bytes. Prints a line `packets STAMP_NS HASH` for
/// each sample, with the stamp and the hash of the sample's last packet.
fn print_packets(domain: &str, sensor: &str, len: usize) -> Outcome<()> {
    let mut samples = subscriber::subscribe::<[u8]>(domain, sensor)?;
    let mut out = std::io::stdout().lock();
    loop {
        let Some(sample) = samples.next()? else { continue };
        // Leave out replies, which have other lengths.
        if let Some(last) = sample.rchunks_exact(len).next().filter(|_| sample.len() % len == 0) {
            writeln!(out, "packets {} {}", sample.header().stamp_last_ns, truth::hash(last))?;
        }
    }
}

/// Returns the maximum error of the stamps in `lines` in milliseconds, and the number of stamps whose error exceeds
/// `limit_ms`. `due` has the times at which each packet was due, by the hash of the packet.
fn stamp_error_ms(
    lines: &[OutputLine],
    due: &HashMap<&str, Vec<u64>>,
    limit_ms: f64,
) -> Outcome<(f64, usize)> {
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

/// Output of a subscriber to scans.
#[derive(Default)]
struct ReceivedScans {
    stamps_ns: Vec<u64>,
    missed: u64,
    incomplete: u64,
}

impl ReceivedScans {
    fn of(lines: &[OutputLine]) -> Outcome<ReceivedScans> {
        let mut scans = ReceivedScans::default();
        for line in lines {
            scans.stamps_ns.push(line.number(1)?);
            scans.missed += line.number(2)?;
            scans.incomplete += line.number(3)?;
        }
        Ok(scans)
    }

    /// Returns the unevenness of the scans in milliseconds. It is the maximum difference between the time from one scan
    /// to the next and the time of a whole number of revolutions.
    fn unevenness_ms(&self) -> f64 {
        let mut spans: Vec<f64> =
            self.stamps_ns.windows(2).map(|pair| pair[1].abs_diff(pair[0]) as f64 / 1e6).collect();
        let mut sorted = spans.clone();
        sorted.sort_by(f64::total_cmp);
        let Some(&revolution_ns) = sorted.get(sorted.len() / 2) else { return f64::NAN };
        spans
            .iter_mut()
            .for_each(|span| *span = (*span - revolution_ns * (*span / revolution_ns).round()).abs());
        spans.into_iter().fold(0.0, f64::max)
    }
}
