//! Upper bounds for the hub's instructions and system calls per telegram, so that a change that increases the cost
//! fails the test. Both numbers hardly depend on the load of the machine. `benches/path` shows where the cost arises.

#[cfg(not(target_arch = "x86_64"))]
#[test]
fn telegram_costs_no_more_than_before() {
    crate::testkit::skip("ptrace", "single steps are implemented for x86-64 only");
}

#[cfg(target_arch = "x86_64")]
#[test]
fn telegram_costs_no_more_than_before() {
    use crate::testkit::steps::{Stepper, TelegramCost, link_thread};
    use crate::testkit::{TERM, TestEnv, is_class, skip, wait_until};
    use std::time::Duration;

    // The two maximums are a quarter above the values that this test prints with `cargo test --test it -- path_cost
    // --nocapture`. After a change that reduces the cost, set the maximums to 1.25 times the new values, so that a
    // later regression fails. Run the test five times and take the highest value, because values vary: the hub
    // publishes the status with most of the stepped telegrams, but not with all.
    /// Maximum number of instructions per telegram, with a learned background and in the profile `dev`. 182,000 to
    /// 217,000 instructions were measured.
    const MAX_INSTRUCTIONS: u64 = 271_000;
    /// Maximum number of system calls per telegram at 500,000 baud. 7 calls were measured, and 5 to 9 on a busy
    /// machine.
    const MAX_SYSTEM_CALLS: u64 = 9;

    /// Number of telegrams that are stepped through. Stepping through one telegram takes some seconds.
    const STEPPED_TELEGRAMS: usize = 10;
    /// Number of telegrams whose system calls are counted. The first [`LEARNING_TELEGRAMS`] telegrams are not counted.
    /// During these, the hub estimates how long before the end of a telegram it has to wake up.
    const COUNTED_TELEGRAMS: usize = 40;
    const LEARNING_TELEGRAMS: usize = 110;
    /// Time between two telegrams at 9,600 baud.
    const TELEGRAM_INTERVAL: Duration = Duration::from_millis(773);
    /// Setting with which the hub learns the background within a second.
    const SHORT_LEARNING: &str = "--set=background.scans=20";

    /// World with a wall around the sensor, without the noise on which the number of instructions depends.
    const ROOM_WORLD: &str = "[noise]\nerrors = 0\ntail = 0\n\n\
         [[thing]]\nline = [[3000, -500], [3000, 3000], [-3000, 3000], [-3000, -500]]\n";

    /// Returns the values per telegram in ascending order. A cost may cover two telegrams, because the hub sleeps only
    /// once if both were complete before it read them.
    fn sorted(costs: &[TelegramCost], value: fn(&TelegramCost) -> u64) -> Vec<u64> {
        let mut values: Vec<u64> = costs.iter().map(|cost| value(cost).div_ceil(cost.telegrams)).collect();
        values.sort_unstable();
        values
    }

    let env = TestEnv::new();
    let world = format!("--world={}", env.file("world.toml", ROOM_WORLD));
    let _simulator = env.simulator(&["front"], &["--seed=48", "--baud=500000", &world]);
    let link = env.lms_link("front");
    let saved = env.path("state/scanhub").join(env.domain().name()).join("front.background.json");

    let hub = env.hub(&[link.as_str(), SHORT_LEARNING]);
    let mut subscriber = env.echo(&["front/scan"]);
    subscriber.await_lines(2, "a scan", is_class("scan"));
    wait_until("the background is saved", || saved.exists());
    let mut stepper = match Stepper::attach(link_thread(hub.pid(), "front").expect("the hub runs")) {
        Ok(stepper) => stepper,
        Err(reason) => return skip("ptrace", reason),
    };
    let costs: Vec<TelegramCost> = (0..LEARNING_TELEGRAMS + COUNTED_TELEGRAMS)
        .map(|_| stepper.run_telegram().expect("the hub publishes"))
        .collect();
    stepper.detach();
    // On a busy machine, sleeps end at other times, and most telegrams need one or two calls more. The lower quartile
    // hardly depends on these calls.
    let calls =
        sorted(&costs[LEARNING_TELEGRAMS..], |cost| cost.system_calls.values().sum())[COUNTED_TELEGRAMS / 4];
    drop(subscriber);
    assert_eq!(hub.end(TERM).exit_code, Some(0));

    let hub = env.hub(&[link.as_str(), SHORT_LEARNING, "--set=link.front.baud=9600"]);
    let mut subscriber = env.echo(&["front/scan"]);
    subscriber.await_lines(2, "a scan", is_class("scan"));
    let mut stepper =
        Stepper::attach(link_thread(hub.pid(), "front").expect("the hub runs")).expect("ptrace is allowed");
    let stepped: Vec<TelegramCost> = (0..STEPPED_TELEGRAMS)
        .map(|_| {
            // The steps of the previous telegram have delayed the hub, so let it catch up first.
            stepper.run_past_telegram(TELEGRAM_INTERVAL).expect("the hub publishes");
            stepper.step_telegram(|_, _, _| {}).expect("the hub publishes")
        })
        .collect();
    stepper.detach();
    // Use the median, because a hub that was preempted may execute other code.
    let instructions = sorted(&stepped, |cost| cost.instructions)[STEPPED_TELEGRAMS / 2];
    println!("{instructions} instructions, {calls} system calls");
    assert!(instructions <= MAX_INSTRUCTIONS, "{instructions} instructions: {stepped:?}");
    assert!(calls <= MAX_SYSTEM_CALLS, "{calls} system calls: {costs:?}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
