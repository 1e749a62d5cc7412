//! CPU time of the machine and of its processes. The kernel counts it in two ways. For `/proc/stat`, it adds a whole
//! tick to the thread that runs at the time of the tick. The scheduler counts the nanoseconds of each thread.

use std::collections::BTreeMap;
use std::fs::{read_dir, read_to_string};
use std::path::Path;

use crate::support::{Outcome, clock};

/// All counters at one time.
pub(crate) struct Snapshot {
    at_ns: u64,
    ticks: Ticks,
    processes: BTreeMap<u32, Usage>,
}

/// CPU time in percent of one processor, separately for user and system.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Share {
    pub(crate) user: f64,
    pub(crate) system: f64,
}

impl Share {
    pub(crate) fn total(self) -> f64 {
        self.user + self.system
    }

    /// Returns the sum with `other`.
    pub(crate) fn add(self, other: Share) -> Share {
        Share { user: self.user + other.user, system: self.system + other.system }
    }

    /// Returns the difference to `other`.
    pub(crate) fn subtract(self, other: Share) -> Share {
        Share { user: self.user - other.user, system: self.system - other.system }
    }
}

/// CPU time between two snapshots.
pub(crate) struct Span<'a> {
    before: &'a Snapshot,
    after: &'a Snapshot,
}

impl Snapshot {
    /// Reads all counters.
    pub(crate) fn take() -> Outcome<Snapshot> {
        let ticks = Ticks::read()?;
        let at_ns = clock::now();
        let mut processes = BTreeMap::new();
        for entry in read_dir("/proc")? {
            let entry = entry?;
            if let Ok(pid) = entry.file_name().to_string_lossy().parse() {
                // Leave out a process that exits at this moment.
                processes.extend(Usage::of(&entry.path()).map(|usage| (pid, usage)));
            }
        }
        Ok(Snapshot { at_ns, ticks, processes })
    }

    /// Returns the time of the snapshot, in ns of CLOCK_MONOTONIC.
    pub(crate) fn at_ns(&self) -> u64 {
        self.at_ns
    }
}

impl<'a> Span<'a> {
    pub(crate) fn new(before: &'a Snapshot, after: &'a Snapshot) -> Span<'a> {
        Span { before, after }
    }

    /// Returns the CPU time of the whole machine as `/proc/stat` counts it. Interrupts count as system time.
    pub(crate) fn machine(&self) -> Share {
        let (before, after) = (self.before.ticks, self.after.ticks);
        let part = |ticks: u64| self.percent(ticks as f64 / USER_HZ * 1e9);
        Share {
            user: part(after.user.saturating_sub(before.user)),
            system: part(after.system.saturating_sub(before.system)),
        }
    }

    /// Returns the time that the hypervisor used for other machines, in percent of one processor.
    pub(crate) fn stolen(&self) -> f64 {
        let stolen = self.after.ticks.stolen.saturating_sub(self.before.ticks.stolen);
        self.percent(stolen as f64 / USER_HZ * 1e9)
    }

    /// Returns the CPU time of these processes as the scheduler counts it. Fails if one of the processes has ended.
    pub(crate) fn of(&self, pids: &[u32]) -> Outcome<Share> {
        let mut sum = Usage::default();
        for pid in pids {
            let after = self.after.processes.get(pid).ok_or_else(|| format!("process {pid} has ended"))?;
            sum.add(after.since(self.before.processes.get(pid)));
        }
        Ok(sum.share(self.percent(sum.busy_ns as f64)))
    }

    /// Returns the CPU time of the kernel's threads as the scheduler counts it, in percent of one processor. Some
    /// threads of the kernel transfer the bytes of ttys.
    pub(crate) fn kernel(&self) -> f64 {
        self.sum(|usage| usage.is_kernel)
    }

    /// Returns the CPU time of all processes that existed at the second snapshot, as the scheduler counts it, in
    /// percent of one processor.
    pub(crate) fn all_processes(&self) -> f64 {
        self.sum(|_| true)
    }

    fn sum(&self, is_counted: impl Fn(&Usage) -> bool) -> f64 {
        let expected = self.after.processes.iter().filter(|(_, usage)| is_counted(usage));
        let busy: u64 =
            expected.map(|(pid, usage)| usage.since(self.before.processes.get(pid)).busy_ns).sum();
        self.percent(busy as f64)
    }

    fn percent(&self, ns: f64) -> f64 {
        100.0 * ns / (self.after.at_ns - self.before.at_ns).max(1) as f64
    }
}

/// Returns the number of processors.
pub(crate) fn processors() -> Outcome<usize> {
    let stat = read_to_string("/proc/stat")?;
    Ok(stat.lines().filter(|line| line.starts_with("cpu") && !line.starts_with("cpu ")).count().max(1))
}

/// Values of `/proc/stat` for all processors, in units of 1 / [`USER_HZ`] s.
#[derive(Clone, Copy)]
struct Ticks {
    user: u64,
    system: u64,
    stolen: u64,
}

impl Ticks {
    fn read() -> Outcome<Ticks> {
        let stat = read_to_string("/proc/stat")?;
        let first =
            stat.lines().next().and_then(|line| line.strip_prefix("cpu ")).ok_or("no cpu in /proc/stat")?;
        let ticks: Vec<u64> = first.split_whitespace().map(str::parse).collect::<Result<_, _>>()?;
        let [user, nice, system, _idle, _iowait, irq, softirq, stolen, ..] = ticks[..] else {
            return Err("/proc/stat is too short".into());
        };
        Ok(Ticks { user: user + nice, system: system + irq + softirq, stolen })
    }
}

/// CPU time of a process since its start.
#[derive(Clone, Copy, Debug, Default)]
struct Usage {
    /// CPU time in nanoseconds, as the scheduler counts it.
    busy_ns: u64,
    /// Ticks in user mode and in system mode. Their ratio determines the user part and the system part of `busy_ns`.
    user: u64,
    system: u64,
    is_kernel: bool,
}

impl Usage {
    /// Returns the counters of the process whose directory in `/proc` is `process`, or `None` if the process has
    /// exited.
    fn of(process: &Path) -> Option<Usage> {
        let stat = read_to_string(process.join("stat")).ok()?;
        // The name may contain spaces and brackets. The first field after the name is field 3.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
        let mut usage =
            Usage { user: field(14)?, system: field(15)?, is_kernel: field(4)? == KTHREADD_PID, busy_ns: 0 };
        for task in read_dir(process.join("task")).ok()?.flatten() {
            let schedstat = read_to_string(task.path().join("schedstat")).unwrap_or_default();
            usage.busy_ns += schedstat.split_whitespace().next().map_or(Some(0), |ns| ns.parse().ok())?;
        }
        Some(usage)
    }

    fn since(&self, before: Option<&Usage>) -> Usage {
        let before = before.copied().unwrap_or_default();
        Usage {
            busy_ns: self.busy_ns.saturating_sub(before.busy_ns),
            user: self.user.saturating_sub(before.user),
            system: self.system.saturating_sub(before.system),
            is_kernel: self.is_kernel,
        }
    }

    fn add(&mut self, other: Usage) {
        self.busy_ns += other.busy_ns;
        self.user += other.user;
        self.system += other.system;
    }

    /// Returns `busy` divided into user and system time.
    fn share(&self, busy: f64) -> Share {
        // Add half a tick to each of the two counts, so that the time can be divided even if no tick was counted.
        let system = busy * (self.system as f64 + 0.5) / ((self.user + self.system) as f64 + 1.0);
        Share { user: busy - system, system }
    }
}

/// Ticks per second in the figures that the kernel reports. The kernel's own tick may differ.
const USER_HZ: f64 = 100.0;
/// Parent of all threads of the kernel.
const KTHREADD_PID: u64 = 2;
