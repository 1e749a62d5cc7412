//! Time without telegrams and CPU time that it costs to unplug a sensor. While a hub runs, the pty of a simulated
//! sensor that streams is removed, and returns under the same name. This is repeated twenty times. In every second
//! repetition, the pty returns with another number. The figures are the time until the hub reports the port as absent,
//! the time until a subscriber has a telegram again, and the CPU time of the hub in between. The same figures are
//! measured for rotating scanners. These scanners also lose their power for a short time.
//!
//! The bench does not measure how long the kernel takes to detect the loss of an adapter, or how long udev takes to
//! create the name of its port.

mod support;

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::fs;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{ExitCode, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_setfl, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Unit};
use scanhub_sim::options::{Scanner, SimulateOptions};
use scanhub_sim::{Event, simulate_with};

use support::environment::{BenchEnvironment, Child, PROGRAM, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::usage::ThreadUsage;
use support::{Options, Outcome, clock};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let name = environment.port("front");
    let mut plug = PluggedSensor::plug_in(&name)?;
    let hub = environment.start_hub(&["front"])?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let telegrams = environment.start_subscriber("telegram", "front", &["0"])?;
    let statuses = environment.start_subscriber("status", "front", &[])?;
    telegrams.wait_for_line("telegram", STEP_TIMEOUT)?;
    let (mut noticed, mut back, mut busy, mut torn) = (Vec::new(), Vec::new(), Vec::new(), 0.0);
    for round in 0..options.count(20) {
        // Unplug the sensor at another phase of the stream in each round.
        clock::sleep_until(clock::now() + (300 + 11 * (round as u64 % 20)) * MILLIS);
        telegrams.lines_so_far();
        statuses.lines_so_far();
        let pulled = plug.unplug(&name)?;
        let absent = statuses.wait_for_line("status front absent", STEP_TIMEOUT)?.number(3)?;
        noticed.push(absent.saturating_sub(pulled) as f64 / 1e6);
        let (before, started) = (ThreadUsage::of(hub.guard.pid(), |_| true)?, clock::now());
        // Plug the sensor in at another phase of the hub's polls in each round.
        clock::sleep_until(started + (1_000 + 37 * (round as u64 % 20)) * MILLIS);
        let work = ThreadUsage::of(hub.guard.pid(), |_| true)?.since(before);
        busy.push(100.0 * work.busy_ns as f64 / (clock::now() - started) as f64);
        // Drop the lines that arrived before the sensor was unplugged.
        telegrams.lines_so_far();
        let other_number = (round % 2 == 1).then(make_pty).transpose()?;
        plug = PluggedSensor::plug_in(&name)?;
        let line = telegrams.wait_for_line("telegram", STEP_TIMEOUT)?;
        back.push((line.number(2)? - plug.plugged_ns) as f64 / 1e6);
        torn += f64::from(u8::from(line.words().get(5) != Some(&"true")));
        drop(other_number);
    }
    drop((telegrams, statuses, hub));
    plug.unplug(&name)?;
    let figure = |name, unit, hub, target| Figure { name, unit, hub, baseline: Vec::new(), target };
    let worst = |values: &[f64]| vec![values.iter().copied().fold(0.0, f64::max)];
    let mut figures = vec![
        figure("unplugged until absent, longest", "ms", worst(&noticed), Target::Max(50.0)),
        figure("unplugged until absent", "ms", noticed, Target::None),
        figure("plugged in until a telegram, longest", "ms", worst(&back), Target::Max(500.0)),
        figure("plugged in until a telegram", "ms", back, Target::None),
        figure("hub while absent, maximum", "% of a core", worst(&busy), Target::Max(2.0)),
        figure("hub while absent", "% of a core", busy, Target::None),
        figure("torn telegrams", "1", vec![torn], Target::Max(0.0)),
    ];
    drop(environment);
    figures.extend(rotating_scanners(options)?);
    figures::print("replug", options.json, &figures);
    Ok(())
}

/// A simulated sensor that is plugged in under a name, and streams.
struct PluggedSensor {
    is_unplugged: Arc<AtomicBool>,
    sensor: JoinHandle<OwnedFd>,
    /// Time at which the name of the sensor appeared.
    plugged_ns: u64,
}

impl PluggedSensor {
    fn plug_in(name: &str) -> Outcome<PluggedSensor> {
        let (line, pty) = make_pty()?;
        let is_unplugged = Arc::new(AtomicBool::new(false));
        let sensor = thread::spawn({
            let is_unplugged = is_unplugged.clone();
            move || stream(line, &is_unplugged)
        });
        symlink(OsStr::from_bytes(&pty), name)?;
        Ok(PluggedSensor { is_unplugged, sensor, plugged_ns: clock::now() })
    }

    /// Unplugs the sensor, and returns the time at which this was done.
    fn unplug(self, name: &str) -> Outcome<u64> {
        self.is_unplugged.store(true, Ordering::Relaxed);
        let line = self.sensor.join().map_err(|_| "the sensor panicked")?;
        fs::remove_file(name)?;
        let at = clock::now();
        drop(line);
        Ok(at)
    }
}

/// Sends scans like a sensor while a program has the line open. The time between two scans is that of two revolutions
/// of the mirror. Each scan is sent in two parts.
fn stream(line: OwnedFd, is_unplugged: &AtomicBool) -> OwnedFd {
    let mut at = clock::now();
    let mut buffer = [0; 256];
    for number in 0_u16.. {
        let words: [u16; 361] = std::array::from_fn(|beam| 500 + (number % 1000) + beam as u16);
        let scan = lms::measured::encode(0, Unit::Mm, &words, 0x10);
        let (first, second) = scan.bytes().split_at(508);
        for part in [first, second] {
            at += MIRROR_PERIOD;
            clock::sleep_until(at);
            if is_unplugged.load(Ordering::Relaxed) {
                break;
            }
            while rustix::io::read(&line, &mut buffer).is_ok_and(|len| len > 0) {}
            if is_open(&line) {
                let _ = rustix::io::write(&line, part);
            }
        }
        if is_unplugged.load(Ordering::Relaxed) {
            break;
        }
    }
    line
}

fn is_open(line: &OwnedFd) -> bool {
    let mut fds = [PollFd::new(line, PollFlags::IN)];
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().contains(PollFlags::HUP)
}

/// Returns the sensor's end of a raw pty, and the name of the other end.
fn make_pty() -> Outcome<(OwnedFd, Vec<u8>)> {
    let line = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&line)?;
    unlockpt(&line)?;
    let name = ptsname(&line, Vec::new())?;
    fcntl_setfl(&line, OFlags::RDWR | OFlags::NONBLOCK)?;
    // Open and close the other end once, because a pty reports that it is closed only after a program has opened it.
    let other = open(&*name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut termios = tcgetattr(&other)?;
    termios.make_raw();
    tcsetattr(&other, OptionalActions::Now, &termios)?;
    Ok((line, name.into_bytes()))
}

const MILLIS: u64 = 1_000_000;

/// A model of rotating scanner, with the names of its figures.
struct RotatingScanner {
    family: &'static str,
    scanner: Scanner,
    replug_figure: &'static str,
    power_figure: &'static str,
}

const SCANNERS: [RotatingScanner; 2] = [
    RotatingScanner {
        family: "ld",
        scanner: Scanner::Ld(scanhub_sim::ld::Model::Ld19),
        replug_figure: "LD19: plugged in until a scan, longest",
        power_figure: "LD19: powered on until a scan, without 0.5 s of booting, longest",
    },
    RotatingScanner {
        family: "rplidar",
        scanner: Scanner::Rplidar { model: scanhub_sim::rplidar::Model::A1, mode: 3 },
        replug_figure: "RPLIDAR A1: plugged in until a scan, longest",
        power_figure: "RPLIDAR A1: powered on until a scan, without 0.5 s of booting, longest",
    },
];

/// Measures all rotating scanners, at ptys of the simulator in this process. The adapter is unplugged for two seconds,
/// or the power is off for a short time. The figures are the times until a subscriber has a scan of a whole revolution
/// again.
fn rotating_scanners(options: &Options) -> Outcome<Vec<Figure>> {
    let mut figures = Vec::new();
    for scanner in &SCANNERS {
        figures.extend(scanner.measure(options)?);
    }
    Ok(figures)
}

impl RotatingScanner {
    fn measure(&self, options: &Options) -> Outcome<[Figure; 2]> {
        let environment = BenchEnvironment::new()?;
        let port = PathBuf::from(environment.port("front"));
        let events = Arc::new(Mutex::new(VecDeque::new()));
        let (stop, stopped) = UnixStream::pair()?;
        let simulator = thread::spawn({
            let (events, port) = (events.clone(), port.clone());
            let scanner = Some(self.scanner);
            let options =
                SimulateOptions { ports: vec![port], scanner, boot: BOOT_TIME, ..SimulateOptions::default() };
            let next = move |_: &Path| events.lock().ok()?.pop_front();
            move || simulate_with(&options, &stopped, |_| {}, |_| {}, next, |_, _| {})
        });
        wait_for_name(&port);
        let mut command = environment.hub_command(PROGRAM, &["front"]);
        command.arg(format!("--set=link.front.family={}", self.family));
        let hub = Child::spawn(command, Stdio::null())?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        let scans = environment.start_subscriber("each", "front", &[])?;
        scans.wait_for_line("scanned", STEP_TIMEOUT)?;
        let inject =
            |event: Event| events.lock().map(|mut events| events.push_back(event)).map_err(|_| "poisoned");
        let (mut back, mut powered) = (Vec::new(), Vec::new());
        for round in 0..options.count(10) as u64 {
            // Unplug the adapter at another phase of the revolution in each round.
            clock::sleep_until(clock::now() + (1_000 + 37 * (round % 10)) * MILLIS);
            inject(Event::Unplug(UNPLUGGED_NS))?;
            while port.exists() {
                clock::sleep_until(clock::now() + MILLIS);
            }
            scans.lines_so_far();
            wait_for_name(&port);
            let since = clock::now();
            back.push((scans.wait_for_line("scanned", STEP_TIMEOUT)?.number(2)? - since) as f64 / 1e6);
            clock::sleep_until(clock::now() + (1_000 + 41 * (round % 10)) * MILLIS);
            inject(Event::PowerCycle)?;
            // Wait until all bytes in transit have arrived. The scanner sends nothing from the loss of its power until
            // its boot message.
            clock::sleep_until(clock::now() + BOOT_TIME.as_nanos() as u64);
            let since = clock::now();
            scans.lines_so_far();
            powered.push((scans.wait_for_line("scanned", STEP_TIMEOUT)?.number(2)? - since) as f64 / 1e6);
        }
        drop((scans, hub, stop));
        simulator.join().map_err(|_| "the simulator panicked")??;
        let worst = |values: &[f64]| vec![values.iter().copied().fold(0.0, f64::max)];
        let figure = |name, values: &[f64], target| Figure {
            name,
            unit: "ms",
            hub: worst(values),
            baseline: Vec::new(),
            target,
        };
        Ok([
            figure(self.replug_figure, &back, Target::Max(500.0)),
            figure(self.power_figure, &powered, Target::None),
        ])
    }
}

fn wait_for_name(port: &Path) {
    while !port.exists() {
        clock::sleep_until(clock::now() + MILLIS);
    }
}

/// Time from power-on of a scanner to its boot message.
const BOOT_TIME: Duration = Duration::from_millis(500);
/// Time for which the adapter is unplugged, in nanoseconds.
const UNPLUGGED_NS: u64 = 2_000 * MILLIS;
