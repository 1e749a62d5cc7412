//! What once went wrong stays mended, and a world depends on nothing but its plan.

use std::sync::atomic::AtomicBool;
use std::thread;

use scanhub_world::{Detail, Plan, Runner, corpus, run};

#[test]
fn what_was_mended_stays_so() {
    let plans: Vec<Plan> = corpus().into_iter().map(|(_, plan)| plan).collect();
    are_well(plans);
}

#[test]
fn the_same_seed_has_the_same_hash() {
    let plans: Vec<Plan> = (0..10).map(|seed| Plan::of_seed(seed, 20)).collect();
    let hashes =
        |plans: &[Plan]| -> Vec<u64> { plans.iter().map(|plan| run(plan, Detail::Nothing).hash).collect() };
    let first = hashes(&plans);
    assert_eq!(first, hashes(&plans));
    let different: std::collections::HashSet<_> = first.iter().collect();
    assert_eq!(different.len(), plans.len());
}

/// Debug and release, this machine and others.
#[test]
fn the_hash_of_a_world_is_known() {
    let plan: Plan = "seed 5 seconds 15\n1000 kill_hub away_ms=500\n".parse().unwrap();
    assert_eq!(run(&plan, Detail::Nothing).hash, 0xad26_3a4b_b7f0_1116);
}

/// The first of those that `.ci/run` has.
#[test]
fn worlds_are_well() {
    are_well((0..20).map(|seed| Plan::of_seed(seed, 60)).collect());
}

/// The first of those in which the hub searches for scanners.
#[test]
fn worlds_with_links_without_a_family_are_well() {
    are_well((0..10).map(|seed| Plan::auto_of_seed(seed, 60)).collect());
}

/// Checks that no judge finds a violation in these worlds.
fn are_well(plans: Vec<Plan>) {
    let count = plans.len();
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let runner = Runner { plans, twice: 0, threads };
    let totals = runner.run(&AtomicBool::new(false), |_| ());
    for (plan, outcome, _) in &totals.failed {
        println!("{:#?}\n{plan}", outcome.violations);
    }
    assert_eq!((totals.worlds, totals.failed.len()), (count, 0));
}
