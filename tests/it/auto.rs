//! Hub whose link has `family = "auto"`. The hub finds the scanner, reports it and saves it, or reports that no scanner
//! is connected.

use std::fs;

use serde_json::Value;

use crate::replay_packets::recorder;
use crate::testkit::{INT, KILL, Program, TERM, TestEnv, contiguous_numbers, is_class};

const LMS_FLAGS: &[&str] = &["--seed=17", "--world=room"];
const LD19_FLAGS: &[&str] = &["--family=ld", "--model=ld19", "--world=room", "--seed=17"];
const A1_FLAGS: &[&str] = &["--family=rplidar", "--model=a1", "--world=room", "--seed=17"];

fn hub(env: &TestEnv) -> Program {
    env.hub(&[format!("{},family=auto", env.link("front"))])
}

fn text<'a>(line: &'a Value, key: &str) -> &'a str {
    line[key].as_str().unwrap_or_default()
}

/// Returns the text of the file in which the hub saves the scanner that it found.
fn saved_scanner(env: &TestEnv) -> String {
    let file = env.path("state/scanhub").join(env.domain().name()).join("front.scanner");
    fs::read_to_string(file).unwrap_or_default()
}

#[test]
fn scanners_of_every_family_are_found_and_saved() {
    for (simulated, family, model, beams, rate) in [
        (LMS_FLAGS, "lms", "lms200", 361, "500000"),
        (LD19_FLAGS, "ld", "ld19", 450, "230400"),
        (A1_FLAGS, "rplidar", "a1", 1079, "115200"),
    ] {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], simulated);
        let first = hub(&env);
        let mut scans = env.echo(&["front/scan"]);
        let scan = scans.await_line("a scan", is_class("scan"));
        assert_eq!((text(&scan, "family"), &scan["count"]), (family, &beams.into()));
        let info = env.await_info("front", |info| info["state"] == "streaming" && info["model"] == model);
        assert_eq!((text(&info, "family"), text(&info, "last_error")), (family, ""), "{info}");
        assert_eq!(info["baud"].to_string(), rate, "{info}");
        contiguous_numbers(&scans.end(INT).of_class("scan"), "topic_seq");
        crate::testkit::wait_until("the hub saves the scanner", || saved_scanner(&env).contains(model));
        assert!(
            saved_scanner(&env).starts_with(&format!("{family} {model} {rate} ")),
            "{}",
            saved_scanner(&env)
        );
        let log = first.end(TERM).stderr;
        assert!(log.contains(&format!("front: found {model} at {rate} baud")), "{log}");

        let second = hub(&env);
        env.echo(&["front/scan"]).await_line("a scan", is_class("scan"));
        env.await_info("front", |info| info["family"] == family && info["model"] == model);
        let outcome = second.end(TERM);
        assert_eq!((outcome.exit_code, outcome.stderr.contains("is now")), (Some(0), false), "{outcome}");
        assert_eq!(simulator.end(TERM).exit_code, Some(0));
        if family != "ld" {
            assert_eq!(env.simulator_totals("front").1, 0, "EEPROM");
        }
    }
}

#[test]
fn reports_replaced_scanner_and_continues_numbering() {
    let env = TestEnv::new();
    let first = env.simulator(&["front"], LD19_FLAGS);
    let hub = hub(&env);
    let mut subscriber = env.echo(&["front/scan", "front/status"]);
    subscriber
        .await_line("a scan of the first scanner", |line| is_class("scan")(line) && line["family"] == "ld");
    env.await_info("front", |info| info["model"] == "ld19");
    env.kill_port_simulator(first, "front");
    subscriber.await_line("absent", |line| line["state"] == "absent");
    let _second = env.simulator(&["front"], A1_FLAGS);
    subscriber.await_line("a search", |line| is_class("status")(line) && line["family"].is_null());
    subscriber.await_line("a scan", |line| is_class("scan")(line) && line["family"] == "rplidar");
    env.await_info("front", |info| info["family"] == "rplidar" && info["model"] == "a1");
    crate::testkit::wait_until("the hub saves the scanner", || {
        saved_scanner(&env).starts_with("rplidar a1 ")
    });
    contiguous_numbers(&subscriber.end(INT).of_class("scan"), "topic_seq");
    let outcome = hub.end(TERM);
    assert!(outcome.stderr.contains("front: was ld19, is now a1"), "{}", outcome.stderr);
}

#[test]
fn replay_drops_telegrams_of_another_family() {
    let env = TestEnv::new();
    let first = env.simulator(&["front"], A1_FLAGS);
    let live = hub(&env);
    let recorder = recorder(&env, "swap.mcap", &["front/telegram", "front/scan", "front/status"]);
    let mut scans = env.echo(&["front/scan"]);
    let of = |family: &'static str| move |line: &Value| is_class("scan")(line) && line["family"] == family;
    scans.await_lines(5, "a scan of the first scanner", of("rplidar"));
    env.kill_port_simulator(first, "front");
    let _second = env.simulator(&["front"], LD19_FLAGS);
    scans.await_lines(5, "a scan of the second scanner", of("ld"));
    assert_eq!(
        [recorder.end(INT).exit_code, scans.end(INT).exit_code, live.end(TERM).exit_code],
        [Some(0); 3]
    );

    let played = env.hub(&[format!("--link=front=file:{}", env.path_argument("swap.mcap"))]);
    let scan = env.echo(&["front/scan"]).await_line("a scan", is_class("scan"));
    assert_eq!((text(&scan, "family"), &scan["count"]), ("rplidar", &1079.into()));
    env.await_info("front", |info| info["state"] == "silent");
    let log = played.end(TERM).stderr;
    assert!(log.contains("telegrams are dropped, because their scanner is not of family rplidar"), "{log}");
}

#[test]
fn silent_line_is_reported_with_unknown_family() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--fault=mute=1"]);
    let hub = hub(&env);
    let expected = "no scanner replies (looked for lms, ld, rplidar for 10 s): power, cable?";
    let info = env.await_info("front", |info| text(info, "last_error") == expected);
    assert_eq!((&info["family"], text(&info, "state")), (&Value::Null, "probing"), "{info}");
    assert_eq!((&info["model"], &info["baud"]), (&Value::Null, &Value::Null), "{info}");
    let shown = String::from_utf8_lossy(&env.run(&["info", "front"]).stdout).into_owned();
    assert!(shown.lines().any(|line| line.split_whitespace().eq(["family", "unknown"])), "{shown}");
    let listed = String::from_utf8_lossy(&env.run(&["list"]).stdout).into_owned();
    assert!(listed.contains(&format!("front: probing: {expected}")), "{listed}");
    let log = hub.end(TERM).stderr;
    assert_eq!(log.matches(expected).count(), 1, "{log}");
}

#[test]
fn unrecognized_bytes_are_reported_with_probe_command() {
    let env = TestEnv::new();
    // Every telegram is damaged, so the hub cannot recognize any.
    let damage = ["--baud=500000", "--state=streaming", "--fault=flip=0.5,flip_bits=64,overlook=1"];
    let _simulator = env.simulator(&["front"], &damage);
    let _hub = hub(&env);
    let end = format!(
        " bytes/s arrive, but scanhub does not recognize the scanner: stop the hub, then: scanhub probe {}",
        env.path_argument("front")
    );
    let info = env.await_info("front", |info| text(info, "last_error").ends_with(&end));
    assert_eq!(info["family"], Value::Null, "{info}");
}

#[test]
fn recording_has_the_family_of_its_scanner() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], LD19_FLAGS);
    let live = hub(&env);
    let recorder = crate::replay_packets::recorder(&env, "front.mcap", &["--all"]);
    env.echo(&["front/scan"]).await_lines(20, "a scan", is_class("scan"));
    assert_eq!(recorder.end(INT).exit_code, Some(0));
    assert_eq!((live.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
    let (recording, bytes) = (env.path_argument("front.mcap"), env.path_argument("front.bin"));
    assert_eq!(env.run(&["convert", &recording, &bytes]).exit_code, Some(0));
    for file in [recording, bytes] {
        let replayed = env.hub(&[format!("--link=front=file:{file},family=auto")]);
        let scan = env.echo(&["front/scan"]).await_line("a scan", is_class("scan"));
        assert_eq!((text(&scan, "family"), &scan["count"]), ("ld", &450.into()), "{file}");
        env.await_info("front", |info| info["family"] == "ld");
        assert_eq!(replayed.end(TERM).exit_code, Some(0));
    }
    let noise = env.file("noise.bin", [0; 4_096]);
    let refused = env.run(&["run", &format!("--link=front=file:{noise},family=auto")]);
    assert_eq!(refused.exit_code, Some(66), "{refused}");
    assert!(refused.stderr.contains("family"), "{refused}");
}

#[test]
fn number_of_beams_survives_a_hub_restart() {
    let env = TestEnv::new();
    let ld14p = env.simulator(&["front"], &["--family=ld", "--model=ld14p", "--world=room", "--seed=17"]);
    let counts = |outcome: &crate::testkit::Outcome| -> Vec<Value> {
        outcome.of_class("scan").iter().map(|scan| scan["count"].clone()).collect()
    };
    for how in [TERM, KILL, TERM] {
        let hub = hub(&env);
        let mut scans = env.echo(&["front/scan"]);
        scans.await_lines(10, "a scan", is_class("scan"));
        crate::testkit::wait_until("the hub saves the number of beams", || {
            saved_scanner(&env).contains(" 666 ")
        });
        let counts = counts(&scans.end(INT));
        assert!(counts.iter().all(|count| *count == 666), "{counts:?}");
        hub.end(how);
    }
    // Connect another model that uses the same rate. The hub publishes its first scans with the saved number of beams,
    // and changes this number as soon as it has measured the number of the new scanner.
    env.kill_port_simulator(ld14p, "front");
    let _ld19 = env.simulator(&["front"], LD19_FLAGS);
    let hub = hub(&env);
    let mut scans = env.echo(&["front/scan"]);
    scans.await_line("a scan with the other number", |line| is_class("scan")(line) && line["count"] == 450);
    let message =
        "scans have 450 beams instead of 666, because the scanner measures 450 points per revolution";
    env.await_info("front", |info| text(info, "last_error") == message);
    let counts = counts(&scans.end(INT));
    let change = counts.iter().position(|count| *count == 450).expect("the loop above waited for this scan");
    assert!(change >= 1 && counts[..change].iter().all(|count| *count == 666), "{counts:?}");
    assert!(counts[change..].iter().all(|count| *count == 450), "{counts:?}");
    crate::testkit::wait_until("the hub saves the other number of beams", || {
        saved_scanner(&env).contains(" 450 ")
    });
    let log = hub.end(TERM).stderr;
    assert_eq!(log.matches(message).count(), 1, "{log}");
}

/// A recording that starts during a stream contains no reply with the scanner's type. The test records topic `status`,
/// too, which has the type.
#[test]
fn recording_has_the_model_of_its_scanner() {
    for (simulated, model) in [(LMS_FLAGS, "lms200"), (LD19_FLAGS, "ld19"), (A1_FLAGS, "a1")] {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], simulated);
        let live = hub(&env);
        let shown = env.await_info("front", |info| info["state"] == "streaming" && info["model"] == model);
        let recorder = recorder(&env, "front.mcap", &["front/telegram", "front/status"]);
        let mut echo = env.echo(&["front/scan", "front/status"]);
        echo.await_lines(10, "a scan", is_class("scan"));
        echo.await_line("a status", is_class("status"));
        assert_eq!(
            [recorder.end(INT).exit_code, echo.end(INT).exit_code, live.end(TERM).exit_code],
            [Some(0); 3]
        );
        assert_eq!(simulator.end(TERM).exit_code, Some(0));

        let replayed = env.hub(&[format!("--link=front=file:{}", env.path_argument("front.mcap"))]);
        for state in ["streaming", "silent"] {
            let info = env.await_info("front", |info| info["state"] == state || info["state"] == "silent");
            assert_eq!((text(&info, "model"), &info["family"]), (model, &shown["family"]), "{info}");
        }
        assert_eq!(replayed.end(TERM).exit_code, Some(0));
    }
}
