//! Upper bounds for the hub's instructions and system calls per telegram, so that a change shows its cost. Both are counted
//! by single steps, which hardly depend on the load of the machine; `benches/path` shows where they come from.

#[cfg(not(target_arch = "x86_64"))]
#[test]
fn a_telegram_costs_no_more_than_before() {
    crate::testkit::skip("ptrace", "single steps are implemented for x86-64 only");
}

#[cfg(target_arch = "x86_64")]
#[test]
fn a_telegram_costs_no_more_than_before() {
    use crate::testkit::steps::{Cost, Stepper};
    use crate::testkit::{TERM, TestEnv, is_class, skip, until};
    use std::fs;
    use std::time::Duration;

    /// Upper bounds, a quarter above the values that were measured for the profile `dev` with a learned background. They
    /// contain the status, which at this rate is published with most telegrams.
    const MOST_INSTRUCTIONS: u64 = 409_000;
    const MOST_SYSTEM_CALLS: u64 = 12;
    const TELEGRAMS: usize = 10;
    /// Time between two telegrams at 9,600 baud.
    const INTERVAL: Duration = Duration::from_millis(773);
    /// Learns the background within a second.
    const SOON: &str = "--set=background.scans=20";

    /// A wall around the sensor, without the noise on which the number of instructions depends.
    const ROOM: &str = "[noise]\nerrors = 0\ntail = 0\n\n\
         [[thing]]\nline = [[3000, -500], [3000, 3000], [-3000, 3000], [-3000, -500]]\n";

    let env = TestEnv::new();
    let world = format!("--world={}", env.file("world.toml", ROOM));
    let _simulator = env.simulator(&["front"], &["--seed=48", "--baud=500000", &world]);
    let link = env.lms_link("front");
    let saved = env.path("state/scanhub").join(env.place().name()).join("front.background.json");
    let hub = env.hub(&[link.as_str(), SOON]);
    until("the background is saved", || saved.exists());
    assert_eq!(hub.end(TERM).code, Some(0));

    let hub = env.hub(&[link.as_str(), SOON, "--set=link.front.baud=9600"]);
    let mut subscriber = env.echo(&["front/scan"]);
    subscriber.await_lines(2, "a scan", is_class("scan"));
    let tasks = fs::read_dir(format!("/proc/{}/task", hub.pid())).expect("the hub runs").flatten();
    // The thread of a link has the name of its sensor.
    let is_link = |task: &fs::DirEntry| {
        fs::read_to_string(task.path().join("comm")).is_ok_and(|name| name.trim() == "front")
    };
    let task = tasks.into_iter().find(is_link).expect("the link has a thread");
    let thread = task.file_name().to_string_lossy().parse().expect("a thread ID");
    let mut stepper = match Stepper::attach(thread) {
        Ok(stepper) => stepper,
        Err(reason) => return skip("ptrace", reason),
    };
    let costs: Vec<Cost> = (0..TELEGRAMS)
        .map(|_| {
            // The steps of the previous telegram have delayed the hub.
            stepper.pass(INTERVAL).expect("the hub publishes");
            stepper.telegram(|_, _, _| {}).expect("the hub publishes")
        })
        .collect();
    stepper.detach();
    // A preempted hub may take another path. If two telegrams were complete before it read, it sleeps once for both.
    let median = |value: fn(&Cost) -> u64| {
        let each = |cost: &Cost| value(cost).div_ceil(cost.telegrams);
        let mut values: Vec<u64> = costs.iter().map(each).collect();
        values.sort_unstable();
        values[TELEGRAMS / 2]
    };
    let (instructions, calls) =
        (median(|cost| cost.instructions), median(|cost| cost.system_calls.values().sum()));
    println!("{instructions} instructions, {calls} system calls");
    assert!(instructions <= MOST_INSTRUCTIONS, "{instructions} instructions: {costs:?}");
    assert!(calls <= MOST_SYSTEM_CALLS, "{calls} system calls: {costs:?}");
    assert_eq!(hub.end(TERM).code, Some(0));
}
