//! Real-time priority and locked memory for a measurement, as far as the system permits: the load of other programs
//! must not count as latency. Refuses to know what is measured.

use scanhub_client::Wait;
use std::io;

use rustix::mm::{MlockAllFlags, mlockall};
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// What the calling thread has got.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Realtime {
    /// SCHED_FIFO with the least priority, which is before all threads without one.
    pub(super) priority: bool,
    /// What the process has in memory stays there.
    pub(super) memory_locked: bool,
    /// What it has not got, why, and what would help.
    pub(super) refused: Vec<String>,
}

impl Realtime {
    /// Takes both for the calling thread and its process, for good, on a machine with so many processors.
    pub(super) fn take(wait: Wait, processors: usize) -> Realtime {
        let priority = may_spin(wait, processors).and_then(|()| go_first());
        // Not of what is mapped later: beyond the limit, mapping the topics would fail.
        let locked = mlockall(MlockAllFlags::CURRENT).map_err(|error| {
            format!("memory is not locked: {}; `ulimit -l unlimited` permits it", io::Error::from(error))
        });
        Realtime {
            priority: priority.is_ok(),
            memory_locked: locked.is_ok(),
            refused: [priority.err(), locked.err()].into_iter().flatten().collect(),
        }
    }
}

/// Who never sleeps and is before all others needs a processor that the hub does not.
fn may_spin(wait: Wait, processors: usize) -> Result<(), String> {
    if wait == Wait::Spin && processors < ENOUGH {
        return Err(format!(
            "no real-time priority: on {processors} processors it would keep the hub from running while it spins"
        ));
    }
    Ok(())
}

/// One that spins, one for the hub, one for all else.
const ENOUGH: usize = 3;

fn go_first() -> Result<(), String> {
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, fifo).map_err(|error| {
        let why = match error {
            Error::OS(number) => io::Error::from_raw_os_error(number).to_string(),
            other => format!("{other:?}"),
        };
        format!("no real-time priority: {why}; `ulimit -r 1` or CAP_SYS_NICE permits it")
    })
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
        // A thread of its own: it keeps the priority.
        let taken = std::thread::spawn(|| Realtime::take(Wait::Spin, 2)).join().expect("no panic");
        assert!(!taken.priority);
        assert_eq!(taken.refused.len(), 1 + usize::from(!taken.memory_locked), "{taken:?}");
    }
}
