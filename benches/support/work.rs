//! What a process has used: processor time and switches of its threads, as the kernel counts them.

use std::fs::{read_dir, read_to_string};

use super::Outcome;

/// The account of a process, or of some of its threads.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Work {
    /// Time on a processor, in ns.
    pub(crate) busy_ns: u64,
    /// How often a thread went to sleep.
    pub(crate) voluntary: u64,
    /// How often a thread was made to wait.
    pub(crate) involuntary: u64,
}

impl Work {
    /// The account of the threads of `pid` whose names `wanted` likes.
    pub(crate) fn of(pid: u32, wanted: impl Fn(&str) -> bool) -> Outcome<Work> {
        let mut work = Work::default();
        for task in read_dir(format!("/proc/{pid}/task"))? {
            let task = task?.path();
            if !wanted(read_to_string(task.join("comm"))?.trim()) {
                continue;
            }
            let schedstat = read_to_string(task.join("schedstat"))?;
            work.busy_ns += schedstat.split_whitespace().next().ok_or("no schedstat")?.parse::<u64>()?;
            let status = read_to_string(task.join("status"))?;
            work.voluntary += field(&status, "voluntary_ctxt_switches:")?;
            work.involuntary += field(&status, "nonvoluntary_ctxt_switches:")?;
        }
        Ok(work)
    }

    /// What was added since `before`.
    pub(crate) fn since(&self, before: Work) -> Work {
        Work {
            busy_ns: self.busy_ns.saturating_sub(before.busy_ns),
            voluntary: self.voluntary.saturating_sub(before.voluntary),
            involuntary: self.involuntary.saturating_sub(before.involuntary),
        }
    }
}

fn field(status: &str, name: &str) -> Outcome<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix(name)).ok_or_else(|| format!("no {name}"))?;
    Ok(line.trim().parse()?)
}
