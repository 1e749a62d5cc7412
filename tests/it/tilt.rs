//! Tests of `scanhub tilt`, from telegrams and angles to points and an obstacle. The tests use the commands of the page
//! about `tilt`, and also check what happens when angles are missing.

use std::cell::Cell;

use scanhub_client::Subscriber;
use scanhub_schema::Tilt;
use scanhub_sim::world::World;
use serde_json::Value;

use crate::pages::{commands_on, examples_on};
use crate::publishers::{TestPublisher, languages};
use crate::recorded_world::{START_NS, recorded_world};
use crate::testkit::{INT, Outcome, Program, TestEnv, is_class, number};
use crate::tilted::TiltedPublisher;

/// World with a hall, a post ahead of the sensor, and a mount that tilts slowly. Because the mount is slow, the late
/// stamps on a busy machine displace points only a little.
const TILT_WORLD: &str = "
[[sensor]]
pose = [0, 0, 90]
[sensor.mount]
height_mm = 900
arm_mm = [60, 40]
from_deg = 0
to_deg = 24
deg_s = 12
[noise]
bias_mm = 0
[[thing]]
line = [[-3000, -2000], [3000, -2000], [3000, 4000], [-3000, 4000], [-3000, -2000]]
[[thing]]
legs = [1, 1]
radius_mm = 100
height_mm = 800
pose = [0, 1500]
";

/// Flag with a box around the post. Obstacles in this box are marked as near.
pub(crate) const NEAR_FLAG: &str = "--near=1,2,-0.5,0.5,0.1,0.7";

pub(crate) struct TiltHub {
    pub(crate) env: TestEnv,
    hub: Program,
    simulator: Option<Program>,
}

impl TiltHub {
    pub(crate) fn new() -> TiltHub {
        TiltHub::with_encoder("mount")
    }

    /// Starts a hub with a scanner on a mount. The angles of the mount are published under the name `name`.
    fn with_encoder(name: &str) -> TiltHub {
        let env = TestEnv::new();
        let world = env.file("hall.toml", TILT_WORLD);
        let flags = [format!("--world={world}"), format!("--angles={name}"), "--baud=500000".into()];
        let simulator = env.simulator(&["front"], &flags);
        let hub = env.hub(&[env.link("front")]);
        env.await_info("front", |info| info["state"] == "streaming");
        TiltHub { env, hub, simulator: Some(simulator) }
    }

    pub(crate) fn tilt(&self, more: &[&str]) -> Program {
        tilt(&self.env, more)
    }
}

fn tilt(env: &TestEnv, more: &[&str]) -> Program {
    let place = ["tilt", "front", "--angles=mount", "--axis-at=0,0,0.9", "--sensor-at=0.06,0,0.94", "--json"];
    env.start(&[&place[..], more].concat())
}

/// Replays a recording of `world` in a loop. The stamps of the replay are exact, however busy the machine is.
fn replay_tilt(env: &TestEnv, world: &str) -> Program {
    let file = recorded_world(env, &World::of_toml("hall", world).expect("a world"), &["front"], 20);
    env.start(&["replay", &file, "--loop", "--json", "--no-system-config"]).ready()
}

/// Returns the distance of a point from the nearest of floor, walls and post, in meters.
fn distance_from_wall(point: &[f64]) -> f64 {
    let [x, y, z] = point[..] else { panic!("{point:?}") };
    let post = ((x - 1.5).hypot(y) - 0.1).abs();
    let walls = [(x - 4.0).abs(), (x + 2.0).abs(), (y - 3.0).abs(), (y + 3.0).abs()];
    walls.into_iter().chain([post, z.abs()]).fold(f64::INFINITY, f64::min)
}

fn has_obstacles(line: &Value) -> bool {
    is_class("obstacles")(line) && line["obstacles"] != Value::Array(Vec::new())
}

/// Returns whether `outcome` has an error whose message contains `words`.
fn reports_error(outcome: &Outcome, words: &str) -> bool {
    outcome.of_class("error").iter().any(|line| line["message"].to_string().contains(words))
}

pub(crate) fn numbers(list: &Value) -> Vec<f64> {
    list.as_array().expect("a list").iter().map(|value| value.as_f64().expect("a number")).collect()
}

#[test]
fn points_match_the_hall_and_the_post_is_an_obstacle() {
    let hall = TiltHub::new();
    let mut tilt = hall.tilt(&["--as=hall", NEAR_FLAG]);
    tilt.await_line("a sweep", is_class("obstacles"));
    let mut clouds = hall.env.echo(&["hall/cloud"]);
    let found = tilt.await_line("the post", has_obstacles);
    assert_eq!(found["sensor"], "hall", "{found}");
    let post = found["obstacles"].as_array().expect("a list").first().expect("the post");
    let [x, y] = ["x_m", "y_m"].map(|key| post[key].as_f64().expect("a number"));
    assert!((x - 1.42).abs() < 0.1 && y.abs() < 0.1 && post["near"] == true, "{post}");
    assert!((post["distance_m"].as_f64().expect("a number") - 1.4).abs() < 0.1, "{post}");
    let is_last = |line: &Value| is_class("cloud")(line) && line["last"] == true;
    let before = number(&clouds.await_line("the end of a sweep", is_last), "sweep");
    let sweep = number(&clouds.await_line("the end of the next one", is_last), "sweep");
    assert!(sweep > before, "{sweep} {before}");
    // On a busy machine, scans are lost, so a sweep may have few points. Collect the points of several sweeps.
    let count = Cell::new(0);
    clouds.await_line("enough points", |line| {
        count.set(count.get() + line["points"].as_array().map_or(0, Vec::len));
        count.get() > 1_000
    });
    let clouds = clouds.end(INT).of_class("cloud");
    let of_sweep: Vec<&Value> = clouds.iter().filter(|line| number(line, "sweep") == sweep).collect();
    let firsts = of_sweep.iter().filter(|line| line["first"] == true).count();
    assert!(firsts == 1 && of_sweep[0]["first"] == true, "{firsts}");
    let points = clouds.iter().flat_map(|line| line["points"].as_array().expect("a list")).map(numbers);
    let points: Vec<Vec<f64>> = points.collect();
    let mut off: Vec<f64> = points.iter().map(|point| distance_from_wall(point)).collect();
    off.sort_by(f64::total_cmp);
    // Only nine of ten points must be near a surface, because the hub stamps scans late if the machine stalls.
    assert!(off[off.len() * 9 / 10] < 0.08, "{:?}", [off[off.len() / 2], off[off.len() * 9 / 10]]);
    // `tilt` must not use a name that a link, a mount or another `tilt` uses.
    let again = hall.tilt(&["--as=hall"]).wait();
    let held = |name: &str, pid: u32| format!("the name {name} is published by process {pid} (scanhub)");
    assert!(again.exit_code == Some(75) && reports_error(&again, &held("hall", tilt.pid())), "{again}");
    let taken = hall.tilt(&["--as=front"]).wait();
    assert!(taken.exit_code == Some(75) && reports_error(&taken, &held("front", hall.hub.pid())), "{taken}");
    let outcome = tilt.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let sum = &outcome.of_class("summary")[0];
    assert!(
        number(sum, "sweeps") > 2 && number(sum, "points") > 1_000 && number(sum, "angles") > 100,
        "{sum}"
    );
    end_cleanly(hall);
}

#[test]
fn page_programs_publish_mount_angles() {
    let page = TestEnv::new();
    for example in examples_on("docs/tilt.md", "mount", &page) {
        // Use a new domain for each program, because an interrupted program leaves its topic in the domain until
        // another program replaces it.
        let env = TestEnv::new();
        let _hub = env.hub(&[env.link("front")]);
        let mount = Program::start(example.command(&env));
        let mut echo = env.echo(&["mount/tilt"]);
        let angle_deg = |line: &Value| line["angle_deg"].as_f64().expect("a number");
        let lines = echo.await_lines(50, &example.location, is_class("tilt"));
        let is_right = |line: &Value| (0.0..28.7).contains(&angle_deg(line)) && line["rate_deg_s"].is_null();
        assert!(lines.iter().all(is_right), "{}: {lines:?}", example.location);
        assert!(
            angle_deg(&lines[0]) != angle_deg(&lines[49]),
            "{}: the angle does not change",
            example.location
        );
        let outcome = mount.end(INT);
        // A Python program prints a traceback when it is interrupted.
        assert!(outcome.stderr.is_empty() || outcome.stderr.contains("KeyboardInterrupt"), "{outcome}");
    }
}

/// Programs in several languages act as the program of the mount. Each of them receives the angles of the simulated
/// encoder and publishes them again.
#[test]
fn tilt_accepts_angles_of_programs_in_all_languages() {
    let hall = TiltHub::with_encoder("encoder");
    for start in languages(&hall.env) {
        let mut mount = TestPublisher::start_and_publish(start("mount"));
        let mut tilt = hall.tilt(&[NEAR_FLAG]);
        let mut encoder =
            Subscriber::<Tilt>::builder("encoder").in_domain(&hall.env.domain()).open().expect("a name");
        let mut sent = 0;
        let found = loop {
            assert!(sent < 10_000, "no obstacle at this number of angles");
            sent += 1;
            let angle = encoder.next().expect("a working subscriber").expect("an angle");
            mount.send(&angle, angle.header().stamp_first_ns);
            drop(angle);
            if tilt.prints(has_obstacles) {
                break tilt.end(INT);
            }
        };
        assert_eq!(mount.end().exit_code, Some(0));
        let obstacles = found.of_class("obstacles").into_iter().find(has_obstacles).expect("the post");
        let [x, y] = ["x_m", "y_m"].map(|key| obstacles["obstacles"][0][key].as_f64().expect("a number"));
        assert!((x - 1.42).abs() < 0.1 && y.abs() < 0.1, "{obstacles}");
        let sum = &found.of_class("summary")[0];
        // On a busy machine, `tilt` may miss angles, but no angle may be wrong.
        let invalid =
            ["angles_out_of_order", "angles_in_future", "angles_invalid"].map(|key| number(sum, key));
        assert_eq!(invalid, [0; 3], "{sum}");
    }
    end_cleanly(hall);
}

pub(crate) fn end_cleanly(hall: TiltHub) {
    let outcome = hall.hub.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
}

#[test]
fn commands_of_the_page_find_an_obstacle() {
    let hall = TiltHub::new();
    let lines = commands_on("docs/tilt.md", &["scanhub tilt front --angles", "scanhub echo hall/"]);
    // Another test checks the third command, which has the flag `--check`.
    let [tilt, echo, _] = &lines[..] else { panic!("{lines:?}") };
    let start = |words: &[String]| hall.env.start(&[words, &["--json".to_owned()]].concat());
    let mut tilt = start(tilt);
    tilt.await_line("an obstacle", has_obstacles);
    let mut echo = start(echo);
    echo.await_line("an obstacle", has_obstacles);
    assert_eq!((tilt.end(INT).exit_code, echo.end(INT).exit_code), (Some(0), Some(0)));
    end_cleanly(hall);
}

#[test]
fn tilt_processes_a_replayed_recording() {
    let env = TestEnv::new();
    let file = recorded_world(&env, &World::of_toml("hall", TILT_WORLD).expect("a world"), &["front"], 12);
    let player = env.start(&["replay", &file, "--paused", "--json", "--no-system-config"]).ready();
    let mut echo = env.echo(&["mount/tilt"]);
    let mut tilt = tilt(&env, &[NEAR_FLAG]);
    env.await_info("front", |info| info["state"] == "paused");
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    let angles = echo.await_lines(100, "angles", is_class("tilt"));
    for pair in angles.windows(2) {
        // At rate 1, the intervals between the stamps of the replay are the same as in the recording.
        assert_eq!(number(&pair[1], "stamp_ns") - number(&pair[0], "stamp_ns"), 10_000_000, "{pair:?}");
        assert_eq!(number(&pair[1], "wall_ns") - number(&pair[0], "wall_ns"), 10_000_000, "{pair:?}");
    }
    assert!((START_NS..START_NS + 12_000_000_000).contains(&number(&angles[0], "wall_ns")), "{}", angles[0]);
    assert!(angles[0]["flags"].to_string().contains("replayed"), "{}", angles[0]);
    tilt.await_line("the post", has_obstacles);
    let played = player.wait();
    assert_eq!(played.exit_code, Some(0), "{played}");
    let outcome = tilt.end(INT);
    let sum = &outcome.of_class("summary")[0];
    // Four whole sweeps are enough to detect stamps that are off by 8 ms.
    assert!(number(sum, "sweeps") >= 4 && sum["late_ms"] == 0.0, "{sum}");
    assert!(number(sum, "points") > 50_000, "{sum}");
    let points_dropped =
        ["jumped", "inconsistent", "standing"].map(|why| number(&sum["points_dropped"], why));
    assert_eq!(points_dropped, [0; 3], "{sum}");
}

#[test]
fn check_reports_a_wrong_level() {
    let env = TestEnv::new();
    let world = TILT_WORLD.replace("to_deg = 24", "to_deg = 36").replace("deg_s = 12", "deg_s = 36");
    let player = replay_tilt(&env, &world);
    let state = |outcome: &Outcome, name: &str| {
        let lines = outcome.of_class("tilt_check");
        let line = lines.into_iter().find(|line| line["name"] == name);
        line.unwrap_or_else(|| panic!("no {name}: {outcome}"))
    };
    let well = tilt(&env, &["--check"]).wait();
    assert!(well.exit_code == Some(0) && well.of_class("tilt_check").len() == 4, "{well}");
    assert!(state(&well, "arm")["state"] == "ok" && well.of_class("obstacles").is_empty(), "{well}");
    let wrong = tilt(&env, &["--check", "--level=0.05"]).wait();
    let level = state(&wrong, "level");
    assert!(wrong.exit_code == Some(5) && level["state"] == "failed", "{wrong}");
    let remedy = level["remedy"].as_str().and_then(|remedy| remedy.strip_prefix("--level "));
    let right: f64 = remedy.and_then(|number| number.parse().ok()).expect("a number");
    assert!(right.abs() < 0.01, "{level}");
    let short = tilt(&env, &["--check", "--for=1s"]).wait();
    assert!(short.exit_code == Some(3) && format!("{short}").contains("of 6 whole sweeps"), "{short}");
    assert_eq!(player.end(INT).exit_code, Some(0));
}

#[test]
fn replay_refuses_a_mount_name_that_is_in_use() {
    let env = TestEnv::new();
    let file = recorded_world(&env, &World::of_toml("hall", TILT_WORLD).expect("a world"), &["front"], 2);
    let _made = TiltedPublisher::start_publisher(&env);
    let refused = env.run(&["replay", &file, "--json", "--no-system-config"]);
    assert!(
        refused.exit_code == Some(75) && format!("{refused}").contains("the name mount is published by"),
        "{refused}"
    );
}

#[test]
fn stamps_of_angles_that_are_late_are_reported() {
    let fault = r#"faults = [{ kind = "stamps_late", by_s = 0.1 }]"#;
    let world = TILT_WORLD.replace("deg_s = 12", &format!("deg_s = 12\n{fault}"));
    let env = TestEnv::new();
    let player = replay_tilt(&env, &world);
    let mut tilt = tilt(&env, &[]);
    let is_late = |line: &Value| is_class("angles")(line) && line["late_ms"] != 0.0;
    let late = tilt.await_line("the delay", is_late);
    let late_ms = late["late_ms"].as_f64().expect("a number");
    assert!((98.0..102.0).contains(&late_ms) && late["problem"].is_null(), "{late}");
    let outcome = tilt.end(INT);
    assert!(outcome.of_class("summary")[0]["late_ms"].as_f64().expect("a number") > 98.0, "{outcome}");
    assert_eq!(player.end(INT).exit_code, Some(0));
}

#[test]
fn reports_missing_angles_and_bad_arguments() {
    let mut hall = TiltHub::new();
    let mut tilt = hall.tilt(&[]);
    tilt.await_line("a sweep", is_class("obstacles"));
    // The angles end when their simulator exits. Another simulator then continues the scans.
    drop(hall.simulator.take().map(|simulator| simulator.end(INT)));
    hall.simulator = Some(hall.env.simulator(&["front"], &["--world=room", "--baud=500000"]));
    let report = tilt.await_line("no angles", |line| is_class("angles")(line) && line["problem"] == "silent");
    assert_eq!(report["sensor"], "tilted", "wrong sensor in the report");
    let outcome = tilt.end(INT);
    let sum = &outcome.of_class("summary")[0];
    assert!(outcome.exit_code == Some(0) && number(&sum["points_dropped"], "silent") > 0, "{outcome}");
    let none = hall.env.run(&["tilt", "front", "--angles=none", "--axis-at=0,0,1", "--timeout=2s"]);
    assert!(none.exit_code == Some(3) && none.stderr.contains("none"), "{none}");
    let wrong = hall.env.run(&["tilt", "front", "--angles=mount", "--axis-at=0,0"]);
    assert!(wrong.exit_code == Some(2) && wrong.stderr.contains("expected 3 numbers, found 2"), "{wrong}");
    let nowhere = hall.env.run(&["simulate", "--port=x", "--angles=mount"]);
    assert!(nowhere.exit_code == Some(2) && nowhere.stderr.contains("--world tilt"), "{nowhere}");
}
