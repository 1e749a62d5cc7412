//! Tests that the bugs found by worlds stay fixed, and that a world depends only on its scenario.

use std::sync::atomic::AtomicBool;
use std::thread;

use scanhub_world::{Detail, Runner, Scenario, corpus, run};

#[test]
fn saved_scenarios_of_fixed_bugs_keep_all_invariants() {
    let scenarios: Vec<Scenario> = corpus().into_iter().map(|(_, scenario)| scenario).collect();
    assert_no_violation(scenarios);
}

#[test]
fn same_seed_has_the_same_hash() {
    let scenarios: Vec<Scenario> = (0..10).map(|seed| Scenario::from_seed(seed, 20)).collect();
    let hashes = |scenarios: &[Scenario]| -> Vec<u64> {
        scenarios.iter().map(|scenario| run(scenario, Detail::Nothing).hash).collect()
    };
    let first = hashes(&scenarios);
    assert_eq!(first, hashes(&scenarios));
    let different: std::collections::HashSet<_> = first.iter().collect();
    assert_eq!(different.len(), scenarios.len());
}

/// The hash is the same in debug and release builds and on every machine.
#[test]
fn world_hash_is_the_same_on_every_machine() {
    let scenario: Scenario = "seed 5 seconds 15\n1000 kill_hub away_ms=500\n".parse().unwrap();
    assert_eq!(run(&scenario, Detail::Nothing).hash, 0xad26_3a4b_b7f0_1116);
}

/// Runs the first seeds of those that `.ci/run` runs.
#[test]
fn random_scenarios_keep_all_invariants() {
    assert_no_violation((0..20).map(|seed| Scenario::from_seed(seed, 60)).collect());
}

/// Runs the first seeds of those that `.ci/run` runs with `--auto`. In these worlds, the hub searches for scanners.
#[test]
fn random_scenarios_with_auto_family_keep_invariants() {
    assert_no_violation((0..10).map(|seed| Scenario::auto_from_seed(seed, 60)).collect());
}

/// Checks that no invariant is violated in these worlds.
fn assert_no_violation(scenarios: Vec<Scenario>) {
    let count = scenarios.len();
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let runner = Runner { scenarios, run_twice: 0, threads };
    let totals = runner.run(&AtomicBool::new(false), |_| ());
    for (scenario, outcome, _) in &totals.failed {
        println!("{:#?}\n{scenario}", outcome.violations);
    }
    assert_eq!((totals.worlds, totals.failed.len()), (count, 0));
}
