//! One list of actions of the simulated world, at real speed: the real program, ptys, shared memory and processes. What holds
//! there in virtual time is held here as far as it can be seen from outside, so that the simulation does not drift from the
//! kernel. `SCANHUB_SEED` names another list; CI plays one of its own each time.

mod judges;
mod sensors;
mod stage;

use scanhub_schema::MILLIS;
use scanhub_world::Plan;
use stage::Stage;

/// The list that is played if none is named.
const SEED: u64 = 7;
/// How long it lasts; nothing happens in the last seconds.
const SECONDS: u64 = 24;

#[test]
fn a_list_of_actions_does_to_the_program_what_it_does_in_virtual_time() {
    let seed = std::env::var("SCANHUB_SEED").map_or(SEED, |seed| seed.parse().expect("a number"));
    let plan = Plan::of_seed(seed, SECONDS);
    // Whoever reads a failure wants to play it again.
    println!("SCANHUB_SEED={seed}\n{plan}");
    let mut stage = Stage::new(seed);
    for action in &plan.actions {
        stage.await_moment(action.at_ms * MILLIS);
        stage.act(action);
    }
    stage.await_moment(plan.heals_at());
    stage.heal();
    stage.judge();
}
