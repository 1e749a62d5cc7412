//! `scanhub track` and `scanhub site`, from simulated sensors to who is where: one person from room to room, a site file with
//! a sensor that there is not, a plan that is drawn once.

use crate::testkit::{INT, TestEnv, is_class, number};

const SITE: &str = r#"
[[sensor]]
name = "hall"
pose = { x = 0.1, y = 0.1, yaw = 0.7854 }
[[sensor]]
name = "kitchen"
pose = { x = 11.9, y = 0.1, yaw = 2.3562 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 5], [0, 5]]
[[room]]
name = "kitchen"
polygon = [[6, 0], [12, 0], [12, 5], [6, 5]]
[[door]]
name = "middle"
from = "hall"
to = "kitchen"
between = [[6, 2], [6, 3]]
"#;

const WORLD: &str = r#"
[[sensor]]
pose = [100, 100, 45]
[[sensor]]
pose = [11900, 100, 135]
[[thing]]
line = [[0, 0], [12000, 0], [12000, 5000], [0, 5000], [0, 0]]
[[thing]]
line = [[6000, 0], [6000, 2000]]
[[thing]]
line = [[6000, 3000], [6000, 5000]]
[[person]]
path = [[2000, 3500, 2], [5000, 2500], [7000, 2500], [9500, 2000, 60]]
speed_mm_s = 1000
from_s = 12
"#;

#[test]
fn somebody_goes_from_room_to_room_and_is_counted() {
    let env = TestEnv::in_time();
    let site = env.file("site.toml", SITE);
    let world = format!("--world={}", env.file("world.toml", WORLD));
    let links = [env.link("hall"), env.link("kitchen")];
    let _hub = env.hub(&[&links[..], &["--set=background.scans=100".to_owned()]].concat());
    let _simulator = env.simulator(&["hall", "kitchen"], &[&world, "--seed=5", "--baud=500000"]);
    let mut counts = env.start(&["track", "--site", &site, "--count=middle", "--json"]);
    let mut track = env.start(&["track", "--site", &site, "--as=house", "--json"]);
    let event =
        |kind: &'static str| move |line: &serde_json::Value| line["class"] == "event" && line["kind"] == kind;
    let appeared = track.await_line("somebody", event("appeared"));
    assert_eq!((&appeared["room"], &appeared["sensor"]), (&"hall".into(), &"house".into()));
    let door = track.await_line("who goes through the door", event("door"));
    assert_eq!(door["id"], appeared["id"], "the same person: {door}");
    assert_eq!((&door["from"], &door["to"]), (&"hall".into(), &"kitchen".into()));
    assert_eq!(door["door"], "middle");
    let counted = counts.await_line("the count", is_class("count"));
    assert_eq!((number(&counted, "forth"), number(&counted, "back")), (1, 0));
    let stands = |line: &serde_json::Value| {
        let one = &line["tracks"][0];
        let near = |key: &str, at: f64| one[key].as_f64().is_some_and(|value| (value - at).abs() < 0.15);
        one["id"] == door["id"] && one["state"] == "confirmed" && near("x_m", 9.5) && near("y_m", 2.0)
    };
    let last = track.await_line("where he stands", stands);
    assert_eq!((&last["class"], &last["sensor"]), (&"tracks".into(), &"house".into()));
    let outcome = track.end(INT);
    let summary = &outcome.of_class("summary")[0];
    assert_eq!((number(summary, "appeared"), number(summary, "unfit")), (1, 0), "{summary}");
    assert!(number(summary, "scans") > 500, "{summary}");
    assert_eq!(summary["doors"][0]["forth"], 1);
    assert!(counts.end(INT).of_class("tracks").is_empty(), "counts alone");
}

#[test]
fn what_cannot_be_followed_is_told() {
    let env = TestEnv::new();
    let site = env.file("site.toml", SITE);
    let wrong = env.run(&["track", "--site", &site, "--count=rear"]);
    assert_eq!(wrong.code, Some(78), "{wrong}");
    assert!(wrong.errors.contains("rear") && wrong.errors.contains("middle"), "{wrong}");
    let missing = env.run(&["track", "--site", &env.word("none.toml")]);
    assert_eq!(missing.code, Some(66), "{missing}");
    let _hub = env.hub(&[env.link("hall")]);
    let unknown = env.run(&["track", "--site", &site, "--for=20s"]);
    assert_eq!(unknown.code, Some(3), "{unknown}");
    assert!(unknown.errors.contains("kitchen") && unknown.errors.contains("hall"), "{unknown}");
}

#[test]
fn a_plan_is_checked_and_drawn_once() {
    let env = TestEnv::new();
    let (site, svg) = (env.file("site.toml", SITE), env.word("site.svg"));
    let checked = env.run(&["site", "check", &site, "--svg", &svg, "--json"]);
    assert_eq!(checked.code, Some(0), "{checked}");
    assert_eq!(checked.lines()[0]["doors"][0], "middle");
    let drawn = std::fs::read_to_string(&svg).expect("a drawing");
    assert!(drawn.starts_with("<svg ") && drawn.contains(">kitchen<"), "{drawn}");
    assert_eq!(env.run(&["site", "check", &site, "--svg", &svg]).code, Some(73), "it is there");
    let overlapping = env.file("bad.toml", SITE.replace("[[6, 0], [12, 0]", "[[5, 0], [12, 0]"));
    let refused = env.run(&["site", "check", &overlapping]);
    assert_eq!(refused.code, Some(78), "{refused}");
    assert!(refused.errors.contains("bad.toml:13:11: rooms hall and kitchen overlap"), "{refused}");
}
