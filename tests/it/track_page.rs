//! Tests of docs/tracks.md: the site on the page, which has a remote sensor, the commands, and the output that the page
//! shows.

use crate::pages::text_on;
use crate::recorded_world::recorded_world;
use crate::testkit::{INT, Program, TERM, TestEnv, in_a_network, is_class, number, wait_until};
use scanhub_sim::world::World;

const PAGE: &str = "docs/tracks.md";

/// World that matches the site on the page: two rooms and a corridor between them. The first person walks through the
/// corridor from `hall` to `kitchen`. A sensor is in the middle of the outer wall of each room.
const WORLD: &str = r#"
[[sensor]]
pose = [0, 2500, 0]
[[sensor]]
pose = [14000, 2500, 180]
[[thing]]
line = [[-20, 0], [14020, 0], [14020, 5000], [-20, 5000], [-20, 0]]
[[thing]]
line = [[6000, 0], [6000, 2500]]
[[thing]]
line = [[6000, 3500], [6000, 5000]]
[[thing]]
line = [[8000, 0], [8000, 2500]]
[[thing]]
line = [[8000, 3500], [8000, 5000]]
[[thing]]
line = [[6000, 2000], [8000, 2000]]
[[thing]]
line = [[6000, 4000], [8000, 4000]]
[[person]]
path = [[2000, 3500, 2], [5500, 3000], [8500, 3000], [11000, 2500, 60]]
speed_mm_s = 1000
from_s = 12
"#;

/// Replays the recording of `sensor`. The replay takes the place of a hub, on the robot or on the machine in the
/// kitchen.
fn play(env: &TestEnv, file: &str, sensor: &str) -> Program {
    let flags = ["--json", "--paused", "--hold"];
    env.start(&[&["replay", file, "--sensor", sensor][..], &flags].concat()).ready()
}

#[test]
fn commands_of_the_page_print_its_output() {
    in_a_network("track_page::commands_of_the_page_print_its_output", || {
        let [robot, kitchen] = [TestEnv::new(), TestEnv::new()];
        let site = robot.file("house.toml", text_on(PAGE, "toml", "[[sensor]]"));
        let checked = robot.run(&["site", "check", &site]);
        assert_eq!(checked.exit_code, Some(0), "{checked}");

        let world = World::of_toml("world.toml", WORLD).expect("a world");
        let file = recorded_world(&robot, &world, &["front", "rear"], 30);
        let _played = [play(&robot, &file, "front"), play(&kitchen, &file, "rear")];
        // The recordings are still paused, so no samples arrive from the sensor in the kitchen. Because the listener
        // has a key, it publishes the sensor without waiting for samples.
        let made = robot.run(&["key", "new", &robot.path_argument("key")]);
        assert_eq!(made.exit_code, Some(0), "{made}");
        let key = format!("--key-file={}", robot.path_argument("key"));
        let mut gateway =
            kitchen.start_gateway(&["--interface=lo", "--topic=*/scan", "--topic=*/foreground", &key]);
        let hub = gateway.await_line("the first line", is_class("gateway"))["hub"].clone();
        let name = format!("--name=kitchen={}", hub.as_str().expect("the ID of a hub"));
        let mut listen = robot.start(&["listen", "--publish", "--json", &name, &key]).ready();
        listen.await_line("the sensor in the kitchen", |line| line["sensor"] == "kitchen.rear");

        // Start two of the commands on the page. Unlike on the page, they have a longer `--delay`, because the machine
        // may be busy.
        let mut track = robot.start(&["track", "--site", &site, "--delay=2s"]);
        let count = robot.start(&["track", "--site", &site, "--count", "left", "--delay=2s"]);
        wait_until("subscriptions to all sensors", || {
            let listed = robot.run(&["list", "--json"]).of_class("topic");
            let subscribed = listed
                .iter()
                .filter(|line| ["scan", "foreground"].iter().any(|topic| line["topic"] == *topic));
            subscribed.filter(|line| number(line, "subscribers") == 2).count() == 4
        });
        for (env, sensor) in [(&kitchen, "rear"), (&robot, "front")] {
            let resumed = env.run(&["control", sensor, "resume"]);
            assert_eq!(resumed.exit_code, Some(0), "{resumed}");
        }
        for line in text_on(PAGE, "text", "1 appeared in hall").lines() {
            assert_eq!(track.next_text(), line);
        }
        let sum = String::from_utf8(track.end(INT).stdout).expect("text");
        assert!(sum.contains("1 people appeared"), "{sum}");
        let counted = String::from_utf8(count.end(TERM).stdout).expect("text");
        assert!(counted.starts_with("left: 1 forth, 0 back\n"), "{counted}");
    });
}
