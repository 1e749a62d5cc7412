//! The ways in which programs receive the data of two sensors. Each setup is a set of processes. Some processes belong
//! to the host, and the others only simulate hardware outside of the host. This module starts the processes and
//! measures their CPU time.

use std::thread;
use std::time::Duration;

use crate::cpu_time::{Share, Snapshot, Span};
use crate::datagrams;
use crate::support::Outcome;
use crate::support::environment::{BenchEnvironment, Child, SENSORS, STEP_TIMEOUT};

/// The way in which data reaches the subscribers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Setup {
    /// Each subscriber has its own two serial lines, reads the lines byte by byte, and processes the bytes itself.
    Bytes,
    /// Like `Bytes`, but each subscriber reads all bytes that have arrived.
    Blocks,
    /// Each subscriber receives plain telegrams by multicast and processes the telegrams itself.
    Datagrams,
    /// Each subscriber receives the scans of the hub.
    Scans,
    /// Each subscriber receives the zones and the foreground of the hub.
    Results,
}

impl Setup {
    /// All setups in the order of the tables.
    pub(crate) const ALL: [Setup; 5] =
        [Setup::Bytes, Setup::Blocks, Setup::Datagrams, Setup::Scans, Setup::Results];

    /// Returns the name in tables.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Setup::Bytes => "raw bytes",
            Setup::Blocks => "raw bytes in blocks",
            Setup::Datagrams => "datagrams",
            Setup::Scans => "hub, scans",
            Setup::Results => "hub, zones and foreground",
        }
    }

    /// Starts the processes for `count` subscribers. If `count` is 0, only the other processes run: the sender of
    /// datagrams, or the simulators and the hub.
    pub(crate) fn start(self, count: usize) -> Outcome<SetupProcesses> {
        let environment = BenchEnvironment::new()?;
        let part = |words: &[&str]| environment.start_part(&[&[PART_NAME], words].concat());
        let domain = environment.domain.name();
        let (mut subscribers, mut hub, mut drivers) = (Vec::new(), None, Vec::new());
        match self {
            Setup::Bytes | Setup::Blocks => {
                let maximum = if self == Setup::Bytes { "1" } else { "4096" };
                for number in 0..count {
                    let lines = SENSORS.map(|sensor| format!("{sensor}-{number}"));
                    drivers.push(environment.simulate_streaming(&lines.each_ref().map(String::as_str))?);
                    let [front, rear] = lines.map(|line| environment.port(&line));
                    subscribers.push(part(&["bytes", maximum, &front, &rear])?);
                }
            }
            Setup::Datagrams => {
                let port = datagrams::port().to_string();
                for _ in 0..count {
                    subscribers.push(part(&["datagrams", &port])?);
                }
                let sender = part(&["unit", &port])?;
                sender.wait_for_line("ready", STEP_TIMEOUT)?;
                drivers.push(sender);
            }
            Setup::Scans | Setup::Results => {
                drivers.push(environment.simulate_streaming(&SENSORS)?);
                hub.insert(environment.start_hub(&SENSORS)?).wait_for_line("ready", STEP_TIMEOUT)?;
                let topics = if self == Setup::Scans { "scans" } else { "results" };
                for _ in 0..count {
                    subscribers.push(part(&[topics, domain])?);
                }
            }
        }
        for subscriber in &subscribers {
            for sensor in SENSORS {
                subscriber.wait_for_line(&format!("had {sensor}"), STEP_TIMEOUT)?;
            }
        }
        Ok(SetupProcesses { subscribers, hub, drivers, _stage: environment })
    }
}

/// All processes of a setup. Dropping the setup ends them in this order.
pub(crate) struct SetupProcesses {
    pub(crate) subscribers: Vec<Child>,
    pub(crate) hub: Option<Child>,
    /// Processes that simulate hardware.
    pub(crate) drivers: Vec<Child>,
    _stage: BenchEnvironment,
}

impl SetupProcesses {
    /// Measures the CPU time of all processes during `span`.
    pub(crate) fn measure(&self, span: Duration) -> Outcome<Load> {
        thread::sleep(SETTLE_TIME);
        let before = Snapshot::take()?;
        thread::sleep(span);
        let after = Snapshot::take()?;
        Load::of(&Span::new(&before, &after), self, self.hz(before.at_ns(), after.at_ns())?)
    }

    /// Returns the number of scans per second that a subscriber received from a sensor. Returns the smallest number of
    /// all subscribers and sensors, or 0 without subscribers.
    fn hz(&self, from_ns: u64, to_ns: u64) -> Outcome<f64> {
        let mut minimum: Option<f64> = None;
        for subscriber in &self.subscribers {
            let lines = subscriber.lines_so_far();
            for sensor in SENSORS {
                let mut counts = Vec::new();
                for line in lines.iter().filter(|line| line.text.starts_with(&format!("had {sensor} "))) {
                    counts.push((line.number(2)?, line.number(3)?));
                }
                counts.retain(|(_, at_ns)| (from_ns..to_ns).contains(at_ns));
                let hz = match counts[..] {
                    [(first, from_ns), .., (last, to_ns)] => {
                        (last - first) as f64 * 1e9 / (to_ns - from_ns) as f64
                    }
                    // The program is too slow, or the measured time is too short to calculate a rate.
                    _ => 0.0,
                };
                minimum = Some(minimum.map_or(hz, |minimum| minimum.min(hz)));
            }
        }
        Ok(minimum.unwrap_or_default())
    }
}

/// Second word of the command line of a part of this bench.
pub(crate) const PART_NAME: &str = "host-load";
/// Time after which buffers, caches and the timing of the hub no longer change.
const SETTLE_TIME: Duration = Duration::from_secs(2);

/// CPU time during a run, in percent of one processor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Load {
    /// The whole machine as `/proc/stat` counts it.
    pub(crate) machine: Share,
    /// Subscribers and hub as the scheduler counts them.
    pub(crate) processes: Share,
    /// The hub's part of `processes`.
    pub(crate) hub: Share,
    /// Threads of the kernel.
    pub(crate) kernel: f64,
    /// Processes that simulate hardware.
    pub(crate) drivers: Share,
    /// This process.
    pub(crate) bench: Share,
    /// All processes and threads of the kernel that existed at the end.
    pub(crate) all_processes: f64,
    /// Time that the hypervisor used for other machines.
    pub(crate) stolen: f64,
    /// Number of scans per second that a subscriber received from a sensor: the smallest number of all subscribers and
    /// sensors.
    pub(crate) hz: f64,
}

/// CPU time of the host, as both ways count it, in percent of one processor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Host {
    /// CPU time as `/proc/stat` counts it, without that of processes that are not part of the host.
    pub(crate) machine: Share,
    /// CPU time of subscribers and hub as the scheduler counts it.
    pub(crate) processes: Share,
}

impl Load {
    /// Returns the CPU time of these processes in `span`.
    pub(crate) fn of(span: &Span<'_>, children: &SetupProcesses, hz: f64) -> Outcome<Load> {
        let hub = span.of(&pids(&children.hub))?;
        Ok(Load {
            machine: span.machine(),
            processes: span.of(&pids(&children.subscribers))?.add(hub),
            hub,
            kernel: span.kernel(),
            drivers: span.of(&pids(&children.drivers))?,
            bench: span.of(&[std::process::id()])?,
            all_processes: span.all_processes(),
            stolen: span.stolen(),
            hz,
        })
    }

    /// Returns the host's part of the CPU time. On a loopback, the system call of the sender also delivers the
    /// datagram. On a network, the interrupt of the receiving host does this. The CPU time that the sender needs for
    /// delivery therefore belongs to the host. It is the time beyond `idle`, which is the CPU time of a sender without
    /// receivers. `idle` is `None` in the other setups.
    pub(crate) fn of_host(&self, idle: Option<Share>) -> Host {
        let delivery = idle.map_or(0.0, |deaf| (self.drivers.total() - deaf.total()).max(0.0));
        let delivery = Share { user: 0.0, system: delivery };
        Host {
            machine: self.machine.subtract(self.drivers).subtract(self.bench).add(delivery),
            processes: self.processes.add(delivery),
        }
    }
}

fn pids<'a>(children: impl IntoIterator<Item = &'a Child>) -> Vec<u32> {
    children.into_iter().map(|child| child.guard.pid()).collect()
}
