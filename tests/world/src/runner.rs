//! Many worlds, each in one thread, as many at a time as there are threads. Refuses to know what is printed.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use crate::event::Detail;
use crate::plan::Plan;
use crate::world::{Outcome, run};

/// What is to be run.
#[derive(Clone, Debug)]
pub struct Runner {
    /// The plans.
    pub plans: Vec<Plan>,
    /// So many of the first are run twice, and must have the same hash.
    pub twice: usize,
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
    pub failed: Vec<(Plan, Outcome, bool)>,
}

impl Runner {
    /// Runs all until `is_over`; tells `progress` after each.
    pub fn run(&self, is_over: &AtomicBool, mut progress: impl FnMut(&Totals)) -> Totals {
        let next = AtomicU64::new(0);
        let mut totals = Totals::default();
        thread::scope(|scope| {
            let (told, heard) = mpsc::channel();
            for _ in 0..self.threads {
                let (told, next) = (told.clone(), &next);
                scope.spawn(move || {
                    while !is_over.load(Ordering::Relaxed) {
                        let at = next.fetch_add(1, Ordering::Relaxed) as usize;
                        let Some(plan) = self.plans.get(at) else { return };
                        let begun = on_core();
                        let outcome = run(plan, Detail::Nothing);
                        let is_same = at >= self.twice || run(plan, Detail::Nothing).hash == outcome.hash;
                        // Nobody hears it who has ended.
                        let _ = told.send((at, outcome, is_same, on_core().saturating_sub(begun)));
                    }
                });
            }
            drop(told);
            for (at, outcome, is_same, took) in heard {
                let runs = if at < self.twice { 2 } else { 1 };
                totals.worlds += 1;
                totals.sensor_seconds += runs * outcome.sensor_seconds;
                totals.samples += runs * outcome.samples;
                totals.busy += took;
                if !is_same || !outcome.violations.is_empty() {
                    totals.failed.push((self.plans[at].clone(), outcome, is_same));
                }
                progress(&totals);
            }
        });
        totals.failed.sort_by_key(|(plan, ..)| plan.seed);
        totals
    }
}

/// How long this thread has had a core: others may want it, too.
fn on_core() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec as u32)
}
