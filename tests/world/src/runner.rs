//! Many worlds, each in one thread, as many at a time as there are threads. Refuses to know what is printed.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use crate::event::Detail;
use crate::scenario::Scenario;
use crate::world::{Outcome, run};

/// What is to be run.
#[derive(Clone, Debug)]
pub struct Runner {
    /// The plans.
    pub scenarios: Vec<Scenario>,
    /// So many of the first are run twice, and must have the same hash.
    pub run_twice: usize,
    /// Worlds at a time.
    pub threads: usize,
}

/// What came of all.
#[derive(Clone, Debug, Default)]
pub struct Totals {
    /// Worlds that were run, those that were run twice once.
    pub worlds: usize,
    /// Virtual seconds, times sensors.
    pub sensor_seconds: u64,
    /// Samples that hubs published.
    pub samples: u64,
    /// Time that threads had a core.
    pub busy: Duration,
    /// Plans that ended in violations, or differently the second time.
    pub failed: Vec<(Scenario, Outcome, bool)>,
}

impl Runner {
    /// Runs all until `is_over`; tells `progress` after each.
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
                        // Nobody hears it who has ended.
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

/// How long this thread has had a core: others may want it, too.
fn thread_cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec as u32)
}
