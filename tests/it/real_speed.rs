//! One list of actions of the simulated world, at real speed: the real program, ptys, shared memory and processes. What holds
//! there in virtual time is held here as far as it can be seen from outside, so that the simulation does not drift from the
//! kernel. `SCANHUB_SEED` names another list; CI plays one of its own each time.

mod environment;
mod invariants;
mod sensors;

use environment::RealSpeedEnvironment;
use scanhub_schema::MILLIS;
use scanhub_world::Scenario;

/// The list that is played if none is named.
const SCENARIO_SEED: u64 = 7;
/// How long it lasts; nothing happens in the last seconds.
const SCENARIO_SECONDS: u64 = 24;

#[test]
fn scenario_keeps_its_invariants_at_real_speed() {
    let seed = std::env::var("SCANHUB_SEED").map_or(SCENARIO_SEED, |seed| seed.parse().expect("a number"));
    let plan = Scenario::from_seed(seed, SCENARIO_SECONDS);
    // Whoever reads a failure wants to play it again.
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
