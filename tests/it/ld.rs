//! Hub with simulated LDROBOT scanners. It publishes their points as scans with an even grid, and it publishes their
//! packets unchanged. These scanners have no EEPROM, and the hub sends them no bytes.

use serde_json::Value;

use crate::testkit::{
    INT, Program, TERM, TestEnv, contiguous_numbers, exists_or_is_symlink, hash, is_class, number,
};

/// Length in bytes of a packet with twelve points.
const PACKET_LEN: usize = 47;
/// First bytes of each packet.
const PACKET_HEADER: [u8; 2] = [0x54, 0x2C];

fn ld19(env: &TestEnv) -> Program {
    env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room", "--seed=7"])
}

/// Starts a hub with one link and these settings.
fn hub(env: &TestEnv, settings: &[&str]) -> Program {
    let set = ["family=ld"].iter().chain(settings).map(|setting| format!("--set=link.front.{setting}"));
    env.hub(&[vec![env.link("front")], set.collect()].concat())
}

/// Asserts that a line of class `scan` has a whole revolution in `beams` beams.
fn check_scan(scan: &Value, beams: usize) {
    let step = -360.0 / beams as f64;
    let values = |key: &str| scan[key].as_array().unwrap_or_else(|| panic!("no {key}: {scan}"));
    let of = |key: &str| scan[key].as_f64().unwrap_or_else(|| panic!("no {key}: {scan}"));
    assert_eq!((&scan["family"], number(scan, "unit_um")), (&"ld".into(), 1000));
    assert_eq!(number(scan, "count"), beams as u64);
    assert_eq!(of("first_angle_deg"), 0.0);
    assert!((of("step_deg") - step).abs() < 1e-6, "{}", of("step_deg"));
    let (ranges, levels, angles) = (values("ranges"), values("intensities"), values("angles_deg"));
    assert_eq!([ranges.len(), levels.len(), angles.len()], [beams; 3]);
    let mut exact = 0;
    for (beam, (angle, range)) in angles.iter().zip(ranges).enumerate() {
        assert_eq!(angle.is_null(), range.is_null(), "beam {beam}");
        let Some(angle) = angle.as_f64() else { continue };
        // Each angle lies within the width of its beam. The center of beam 0 is the scanner's zero angle.
        let off = (angle - step * beam as f64 + 180.0).rem_euclid(360.0) - 180.0;
        assert!(off.abs() <= step.abs() / 2.0 + 1e-3, "beam {beam} at {angle}");
        exact += usize::from(off.abs() > 1e-3);
    }
    assert!(exact > beams / 4, "{exact} of {beams} angles are not those of the grid");
}

#[test]
fn rotating_scanner_is_published_with_all_topics() {
    let env = TestEnv::new();
    let hub = hub(&env, &["model=ld19"]);
    let mut scans = env.echo(&["front/scan"]);
    let mut zones = env.echo(&["front/zones"]);
    let mut raw = env.start(&["echo", "--raw", "front/telegram"]);
    let simulator = ld19(&env);
    scans.await_lines(20, "a scan", is_class("scan"));
    zones.await_line("a verdict", |line| is_class("zones")(line) && line["verdict"] != "unknown");
    raw.await_bytes(100 * PACKET_LEN);
    let info = env.await_info("front", |info| info["hz"].as_f64().is_some_and(|hz| hz > 8.0));
    let facts =
        ["state", "family", "model", "type", "baud", "unit_mm", "angle_deg", "step_deg", "last_error"];
    let expected: [Value; 9] = [
        "streaming".into(),
        "ld".into(),
        "ld19".into(),
        "LD19".into(),
        230_400.into(),
        1.into(),
        360.into(),
        0.8.into(),
        "".into(),
    ];
    assert_eq!(facts.map(|key| info[key].clone()), expected, "{info}");

    let scans = scans.end(INT).of_class("scan");
    contiguous_numbers(&scans, "topic_seq");
    for scan in &scans {
        check_scan(scan, 450);
    }
    let outcome = raw.end(INT);
    let packets: Vec<&[u8]> = outcome.stdout.chunks(PACKET_LEN).collect();
    assert!(packets.iter().all(|packet| packet.len() == PACKET_LEN && packet.starts_with(&PACKET_HEADER)));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    let truth = env.truth("front");
    let arrived: Vec<String> = packets.into_iter().map(hash).collect();
    let begin =
        truth.iter().position(|sent| sent.hash == arrived[0]).expect("the first received packet was sent");
    let sent = truth[begin..].iter().map(|sent| &sent.hash).take(arrived.len());
    assert!(sent.eq(&arrived), "the packets differ from those that were sent");
}

#[test]
fn model_of_an_ld19_is_detected() {
    let env = TestEnv::new();
    let _simulator = ld19(&env);
    let _hub = hub(&env, &[]);
    let info = env.await_info("front", |info| info["state"] == "streaming" && info["type"] == "LD19");
    assert_eq!((number(&info, "baud"), &info["last_error"]), (230_400, &"".into()), "{info}");
    check_scan(&env.echo(&["front/scan"]).await_line("a scan", is_class("scan")), 450);
}

#[test]
fn configured_number_of_beams_is_published() {
    let env = TestEnv::new();
    let _simulator = ld19(&env);
    let _hub = hub(&env, &["model=ld19", "beams=300"]);
    for scan in env.echo(&["front/scan"]).await_lines(5, "a scan", is_class("scan")) {
        check_scan(&scan, 300);
        assert!(number(&scan, "collisions") > 0, "450 points in 300 beams: {scan}");
    }
}

#[test]
fn reconnects_to_a_returning_ld19() {
    let env = TestEnv::new();
    let simulator = ld19(&env);
    let hub = hub(&env, &["model=ld19"]);
    let mut subscriber = env.echo(&["front/scan", "front/status"]);
    subscriber.await_lines(5, "a scan", is_class("scan"));
    env.kill_port_simulator(simulator, "front");
    assert!(!exists_or_is_symlink(&env.path("front")));
    subscriber.await_line("absent", |line| line["state"] == "absent");
    let _simulator = ld19(&env);
    subscriber.await_line("streaming", |line| line["state"] == "streaming");
    for scan in subscriber.await_lines(5, "a scan", is_class("scan")) {
        check_scan(&scan, 450);
    }
    let info = env.info("front");
    assert_eq!((number(&info["counters"], "reconnects"), &info["last_error"]), (1, &"".into()), "{info}");
    // During one run of a hub, `topic_seq` has no gap, even if the scanner was disconnected.
    contiguous_numbers(&subscriber.end(INT).of_class("scan"), "topic_seq");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn ld_marks_need_a_configured_level() {
    let env = TestEnv::new();
    let _simulator = ld19(&env);
    let without = hub(&env, &["model=ld19"]);
    let marks = env.echo(&["front/marks"]).await_line("marks", is_class("marks"));
    assert_eq!((&marks["available"], &marks["marks"]), (&false.into(), &Value::Array(Vec::new())), "{marks}");
    let outcome = env.run(&["echo", "front/marks", "-n", "1"]);
    assert!(String::from_utf8_lossy(&outcome.stdout).contains("set link.NAME.marks.level"), "{outcome}");
    let offer = |env: &TestEnv| env.info("front")["marks"].clone();
    let remedy = "set link.front.marks.level";
    assert_eq!(offer(&env), serde_json::json!({ "available": false, "remedy": remedy }));
    let shown = |env: &TestEnv| String::from_utf8_lossy(&env.run(&["info", "front"]).stdout).into_owned();
    let info = shown(&env);
    assert!(info.contains(&format!("unavailable: {remedy}")), "{info}");
    assert_eq!(without.end(TERM).exit_code, Some(0));
    // Reflectors of the simulated room have an intensity of 255, the maximum.
    let _hub = hub(&env, &["model=ld19", "marks.level=250"]);
    let is_found = |line: &Value| line["marks"].as_array().is_some_and(|marks| !marks.is_empty());
    let marks = env.echo(&["front/marks"]).await_line("marks", is_found);
    assert_eq!(marks["available"], true, "{marks}");
    assert!(marks["marks"][0]["peak"].as_u64().is_some_and(|peak| peak >= 250), "{marks}");
    assert_eq!(offer(&env), serde_json::json!({ "available": true, "remedy": null }));
    let info = shown(&env);
    let is_available = |line: &str| line.split_whitespace().eq(["marks", "available"]);
    assert!(info.lines().any(is_available), "{info}");
    let checked = env.run(&["doctor", "front", "--json", "--no-system-config"]).of_class("check");
    let found = checked.iter().find(|line| line["name"] == "marks").expect("a check");
    assert_eq!((&found["state"], &found["finding"]), (&"ok".into(), &"marks.level is set".into()));
}

#[test]
fn probe_identifies_both_models() {
    let env = TestEnv::new();
    let models = [("front", "ld19", 230_400, 4_500.0), ("side", "stl27l", 921_600, 21_600.0)];
    for (name, model, rate, points) in models {
        let model_of = format!("--model={model}");
        let simulator = env.simulator(&[name], &["--family=ld", &model_of, "--world=room", "--seed=7"]);
        let outcome = env.search(&["probe", &env.path_argument(name), "--json"]);
        let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
        assert_eq!(
            (outcome.exit_code, &found["class"], &found["family"]),
            (Some(0), &"probe".into(), &"ld".into())
        );
        assert_eq!((found["model"].as_str(), number(found, "baud")), (Some(model), rate), "{found}");
        let of = |key: &str| found[key].as_f64().unwrap_or_else(|| panic!("no {key}: {found}"));
        assert!((of("points_per_second") / points - 1.0).abs() < 0.02, "{found}");
        assert!((of("revolutions_per_second") / 10.0 - 1.0).abs() < 0.05 && of("damaged") == 0.0, "{found}");
        assert!(number(found, "packets") > 20 && found["problem"].is_null(), "{found}");
        assert_eq!(outcome.stderr, "", "no progress without a terminal");
        let text = env.search(&["probe", &env.path_argument(name)]).to_string();
        for word in ["family", "ld", model, "Bd", "revolutions per second"] {
            assert!(text.contains(word), "{word}: {text}");
        }
        assert_eq!(simulator.end(TERM).exit_code, Some(0));
    }
}

#[test]
fn doctor_checks_a_rotating_scanner() {
    let env = TestEnv::new();
    let port = env.path_argument("front");
    let check = |arguments: &[&str], code: i32| {
        let outcome = env.run(&[&["doctor", "--json", "--no-system-config"], arguments].concat());
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        let found = outcome.of_class("check");
        move |name: &str| {
            let of = found.iter().find(|line| line["name"] == name && !line["port"].is_null());
            let of = of.unwrap_or_else(|| panic!("no {name}: {outcome}"));
            let words = format!("{} {}", of["finding"].as_str().unwrap(), of["remedy"].as_str().unwrap());
            (of["state"].as_str().unwrap().to_owned(), words)
        }
    };
    let simulator = ld19(&env);
    let of_port = check(&[&port], 0);
    for name in ["access", "rate", "sensor", "settings", "health", "line-loss"] {
        assert_eq!(of_port(name).0, "ok", "{}", of_port(name).1);
    }
    assert!(of_port("sensor").1.contains("LD19 at 230400 Bd, family ld"), "{}", of_port("sensor").1);
    assert!(of_port("health").1.contains("revolutions per second"));
    let link = env.link("front");
    let wrong = check(&[&link, "--set=link.front.family=ld", "--set=link.front.model=stl27l"], 0);
    assert_eq!(wrong("settings").0, "warning");
    assert!(wrong("settings").1.contains("link.front.model=ld19"), "{}", wrong("settings").1);
    let hub = hub(&env, &[]);
    env.await_info("front", |info| info["state"] == "streaming");
    let of_hub = check(&["front"], 0);
    assert!(of_hub("sensor").1.contains("streaming, family ld, LD19, 230400 Bd"), "{}", of_hub("sensor").1);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));

    let _lossy = env.simulator(&["front"], &["--family=ld", "--world=room", "--fault=loss=0.02,burst=3"]);
    let lossy = check(&[&port], 0);
    assert_eq!(lossy("line-loss").0, "warning");
    assert!(lossy("line-loss").1.contains("bytes damaged"), "{}", lossy("line-loss").1);
    let _mute = env.simulator(&["mute"], &["--fault=mute=1"]);
    let link = env.link("mute");
    let mute = check(&[&link, "--set=link.mute.family=ld"], 5);
    assert_eq!(mute("sensor").0, "failed");
    assert!(
        mute("sensor").1.contains("no byte arrived; looked for ld at 230400 or 921600 Bd"),
        "{}",
        mute("sensor").1
    );
}
