//! Runner of many worlds. Each world runs in one thread, and several worlds run at the same time.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use crate::event::Detail;
use crate::scenario::Scenario;
use crate::world::{Outcome, run};

/// Worlds to run.
#[derive(Clone, Debug)]
pub struct Runner {
    /// Scenarios of the worlds.
    pub scenarios: Vec<Scenario>,
    /// Number of worlds that are run twice, counted from the first world. Both runs must have the same hash.
    pub run_twice: usize,
    /// Number of worlds that run at the same time.
    pub threads: usize,
}

/// Sums over all worlds.
#[derive(Clone, Debug, Default)]
pub struct Totals {
    /// Number of worlds. A world that was run twice is counted once.
    pub worlds: usize,
    /// Virtual seconds, multiplied by the number of sensors.
    pub sensor_seconds: u64,
    /// Number of samples that hubs published.
    pub samples: u64,
    /// CPU time of all threads.
    pub busy: Duration,
    /// Scenarios that ended with violations or whose second run had another hash. The flag is false if the hashes of
    /// the two runs differ.
    pub failed: Vec<(Scenario, Outcome, bool)>,
}

impl Runner {
    /// Runs all worlds until `is_over` is true. Calls `progress` after each world.
    pub fn run(&self, is_over: &AtomicBool, mut progress: impl FnMut(&Totals)) -> Totals {
        let next = AtomicU64::new(0);
        let mut totals = Totals::default();
        thread::scope(|scope| {
            let (sender, receiver) = mpsc::channel();
            for _ in 0..self.threads {
                let (sender, next) = (sender.clone(), &next);
                scope.spawn(move || {
                    while !is_over.load(Ordering::Relaxed) {
                        let at = next.fetch_add(1, Ordering::Relaxed) as usize;
                        let Some(scenario) = self.scenarios.get(at) else { return };
                        let started = thread_cpu_time();
                        let outcome = run(scenario, Detail::Nothing);
                        let is_same =
                            at >= self.run_twice || run(scenario, Detail::Nothing).hash == outcome.hash;
                        // Sending fails only if the receiver has panicked.
                        let _ =
                            sender.send((at, outcome, is_same, thread_cpu_time().saturating_sub(started)));
                    }
                });
            }
            drop(sender);
            for (at, outcome, is_same, elapsed) in receiver {
                let runs = if at < self.run_twice { 2 } else { 1 };
                totals.worlds += 1;
                totals.sensor_seconds += runs * outcome.sensor_seconds;
                totals.samples += runs * outcome.samples;
                totals.busy += elapsed;
                if !is_same || !outcome.violations.is_empty() {
                    totals.failed.push((self.scenarios[at].clone(), outcome, is_same));
                }
                progress(&totals);
            }
        });
        totals.failed.sort_by_key(|(scenario, ..)| scenario.seed);
        totals
    }
}

/// Returns the CPU time of this thread, which does not depend on the load of the machine.
fn thread_cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec as u32)
}
