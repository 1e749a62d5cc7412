//! Conditions of a latency measurement: priority and memory of the process, and resolution of the clock.

use std::io::{self, Write};
use std::thread;

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::time::{ClockId, Timespec, clock_getres};
use scanhub_client::Wait;
use scanhub_client::clock::now_ns;
use serde::Serialize;
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::output::{End, Output};

/// Line of class `conditions`.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "class", rename = "conditions")]
pub(super) struct Conditions {
    wait: &'static str,
    /// Whether the thread has SCHED_FIFO with the lowest priority, which precedes all threads without one.
    realtime: bool,
    memory_locked: bool,
    /// Time that one read of the clock takes.
    clock_read_ns: f64,
    clock_resolution_ns: u64,
    /// Requests that the system refused, with the reason and a remedy.
    refused: Vec<String>,
}

impl Conditions {
    /// Takes real-time priority for the calling thread and locks the memory of its process if `is_realtime` and as far as
    /// permitted, so that other programs do not add to the latency. Both stay.
    pub(super) fn take(wait: Wait, is_realtime: bool) -> Conditions {
        let processors = thread::available_parallelism().map_or(1, usize::from);
        let normal = Conditions {
            wait: match wait {
                Wait::Doorbell => "doorbell",
                Wait::Event => "event",
                Wait::Spin => "spin",
            },
            realtime: false,
            memory_locked: false,
            clock_read_ns: (clock_read_ns() * 10.0).round() / 10.0,
            clock_resolution_ns: clock_resolution_ns(),
            refused: Vec::new(),
        };
        if is_realtime { normal.with_realtime(wait, processors) } else { normal }
    }

    fn with_realtime(self, wait: Wait, processors: usize) -> Conditions {
        let priority = may_spin(wait, processors).and_then(|()| take_priority());
        // Later mappings are not locked: beyond the limit, mapping the topics would fail.
        let locked = mlockall(MlockAllFlags::CURRENT).map_err(|error| {
            format!("memory is not locked: {}; `ulimit -l unlimited` permits it", io::Error::from(error))
        });
        Conditions {
            realtime: priority.is_ok(),
            memory_locked: locked.is_ok(),
            refused: [priority.err(), locked.err()].into_iter().flatten().collect(),
            ..self
        }
    }

    pub(super) fn text(&self, notes: &mut Output<'_>) -> Result<(), End> {
        notes.line(|line| {
            let priority = if self.realtime { "real-time priority" } else { "normal priority" };
            let locked = if self.memory_locked { "locked" } else { "not locked" };
            write!(line, "wait by {}, {priority}, memory {locked}; ", self.wait)?;
            write!(line, "the clock takes {} ns to read, ", self.clock_read_ns)?;
            write!(line, "its resolution is {} ns", self.clock_resolution_ns)
        })?;
        self.refused.iter().try_for_each(|refused| notes.line(|line| write!(line, "{refused}")))
    }
}

/// Refuses priority for a thread that never sleeps, unless the hub has a processor of its own.
fn may_spin(wait: Wait, processors: usize) -> Result<(), String> {
    if wait == Wait::Spin && processors < MIN_PROCESSORS {
        return Err(format!(
            "no real-time priority: on {processors} processors it would keep the hub from running while it spins"
        ));
    }
    Ok(())
}

/// One for the thread that spins, one for the hub, and one for everything else.
const MIN_PROCESSORS: usize = 3;

fn take_priority() -> Result<(), String> {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, fifo).map_err(|error| {
        let why = match error {
            Error::OS(number) => io::Error::from_raw_os_error(number).to_string(),
            other => format!("{other:?}"),
        };
        format!("no real-time priority: {why}; `ulimit -r 1` or CAP_SYS_NICE permits it")
    })
}

/// Measures the time that one read of the clock takes: the best of several runs, which nothing interrupted.
fn clock_read_ns() -> f64 {
    const RUNS: usize = 8;
    const READS: u32 = 256;
    let run = || {
        let begin = now_ns();
        for _ in 1..READS {
            std::hint::black_box(now_ns());
        }
        (now_ns() - begin) as f64 / f64::from(READS)
    };
    (0..RUNS).map(|_| run()).fold(f64::INFINITY, f64::min)
}

fn clock_resolution_ns() -> u64 {
    let Timespec { tv_sec, tv_nsec } = clock_getres(ClockId::Monotonic);
    tv_sec as u64 * 1_000_000_000 + tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_spins_leaves_the_hub_a_processor() {
        for wait in [Wait::Doorbell, Wait::Event] {
            assert_eq!(may_spin(wait, 1), Ok(()));
        }
        assert_eq!(may_spin(Wait::Spin, 3), Ok(()));
        assert!(may_spin(Wait::Spin, 2).is_err_and(|why| why.contains("on 2 processors")));
    }

    #[test]
    fn what_is_not_had_is_explained() {
        // The thread would keep the priority.
        let take = || Conditions::take(Wait::Spin, false).with_realtime(Wait::Spin, 2);
        let taken = thread::spawn(take).join().expect("no panic");
        assert!(!taken.realtime);
        assert_eq!(taken.refused.len(), 1 + usize::from(!taken.memory_locked), "{taken:?}");
    }
}
