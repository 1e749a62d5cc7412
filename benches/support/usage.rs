//! CPU time and memory of a process, and shared memory of a domain, as the kernel counts them.

use std::collections::BTreeMap;
use std::fs::{read_dir, read_to_string};
use std::os::unix::fs::MetadataExt;

use scanhub_shm::Domain;

use super::Outcome;

/// CPU time and context switches of a process, or of some of its threads.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ThreadUsage {
    /// CPU time, in nanoseconds.
    pub(crate) busy_ns: u64,
    /// Number of times that a thread went to sleep.
    pub(crate) voluntary: u64,
    /// Number of times that a thread was preempted.
    pub(crate) involuntary: u64,
}

impl ThreadUsage {
    /// Returns the counters of the threads of `pid` for whose names `is_counted` returns true.
    pub(crate) fn of(pid: u32, is_counted: impl Fn(&str) -> bool) -> Outcome<ThreadUsage> {
        let mut work = ThreadUsage::default();
        for task in read_dir(format!("/proc/{pid}/task"))? {
            let task = task?.path();
            if !is_counted(read_to_string(task.join("comm"))?.trim()) {
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

    /// Returns the increase since `before`.
    pub(crate) fn since(&self, before: ThreadUsage) -> ThreadUsage {
        ThreadUsage {
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

/// Resident memory of a process, in bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ResidentMemory {
    /// The whole resident memory.
    pub(crate) all: f64,
    /// Heap and stacks.
    pub(crate) heap_and_stacks: f64,
    /// Pages of programs and libraries.
    pub(crate) files: f64,
    /// Pages of shared memory that the process has touched. Subscribers share them.
    pub(crate) shared: f64,
}

impl ResidentMemory {
    /// Reads the memory of `pid`.
    pub(crate) fn of(pid: u32) -> Outcome<ResidentMemory> {
        let status = read_to_string(format!("/proc/{pid}/status"))?;
        let field = |name: &str| -> Outcome<f64> {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            let kb =
                line.and_then(|line| line.split_whitespace().next()).ok_or_else(|| format!("no {name}"))?;
            Ok(kb.parse::<f64>()? * 1024.0)
        };
        Ok(ResidentMemory {
            all: field("VmRSS:")?,
            heap_and_stacks: field("RssAnon:")?,
            files: field("RssFile:")?,
            shared: field("RssShmem:")?,
        })
    }
}

/// Returns the number and the bytes of the files of `domain` in /dev/shm, by file name extension. The extension shows
/// the purpose of a file.
pub(crate) fn segments(domain: &Domain) -> Outcome<BTreeMap<String, (usize, f64)>> {
    let mut kinds = BTreeMap::<String, (usize, f64)>::new();
    for entry in read_dir("/dev/shm")? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !name.starts_with(&domain.prefix()) {
            continue;
        }
        // Skip a file that no longer exists, because a process that exits at this moment removes its files.
        let Ok(metadata) = entry.metadata() else { continue };
        let kind = kinds.entry(name.rsplit('.').next().unwrap_or_default().to_owned()).or_default();
        kind.0 += 1;
        kind.1 += metadata.blocks() as f64 * 512.0;
    }
    Ok(kinds)
}
