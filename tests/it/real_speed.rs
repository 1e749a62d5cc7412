//! A scenario of the simulated world at real speed, with the real program, ptys, shared memory and processes. The test
//! checks the same invariants as in virtual time, as far as they are visible from outside the program. It fails if the
//! simulation and the kernel behave differently. The variable `SCANHUB_SEED` selects another scenario, and CI runs
//! another one for each commit.

mod environment;
mod invariants;
mod sensors;

use environment::RealSpeedEnvironment;
use scanhub_schema::MILLIS;
use scanhub_world::Scenario;

/// Seed of the scenario if `SCANHUB_SEED` is not set.
const SCENARIO_SEED: u64 = 7;
/// Duration of the scenario. Its last seconds have no actions.
const SCENARIO_SECONDS: u64 = 24;

#[test]
fn scenario_keeps_its_invariants_at_real_speed() {
    let seed = std::env::var("SCANHUB_SEED").map_or(SCENARIO_SEED, |seed| seed.parse().expect("a number"));
    let plan = Scenario::from_seed(seed, SCENARIO_SECONDS);
    // Print the seed, so that a developer can run a failed scenario again.
    println!("SCANHUB_SEED={seed}\n{plan}");
    let mut environment = RealSpeedEnvironment::new(seed);
    for action in &plan.actions {
        environment.wait_until(action.at_ms * MILLIS);
        environment.perform(action);
    }
    environment.wait_until(plan.faults_clear_at());
    environment.clear_faults();
    environment.check_invariants();
}
