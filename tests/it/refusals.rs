//! Tests of refusals: each kind of failure has an exit code, and a message that names the location, the value and the
//! remedy. With `--json`, the error is a JSON object. Programs print it to stdout, except those whose stdout has only
//! the line `ready`, which print it to stderr.

use std::process::{Command, Stdio};

use crate::testkit;
use crate::testkit::{Child, Outcome, TERM, TestEnv, run_concurrently, spawn};
use serde_json::Value;

/// Asserts that the program exits with `code` and prints an error of `kind`. Its message must contain all of `words`,
/// both as text and as JSON.
fn assert_refused(env: &TestEnv, arguments: &[&str], code: i32, kind: &str, words: &[&str]) {
    let outcome = env.run(arguments);
    assert_eq!((outcome.exit_code, outcome.stdout.is_empty()), (Some(code), true), "{outcome}");
    check_contains_all(&outcome.stderr, words, &outcome);

    let outcome = env.run(&[arguments, &["--json"]].concat());
    assert_eq!(outcome.exit_code, Some(code), "{outcome}");
    let text = match arguments.first() {
        // These verbs also write their log to stderr, so the error is the last line.
        Some(&("run" | "replay" | "simulate")) if kind != "usage" => {
            assert!(outcome.stdout.is_empty(), "{outcome}");
            outcome.stderr.lines().last().unwrap_or_default().to_owned()
        }
        _ => {
            let out = String::from_utf8_lossy(&outcome.stdout).into_owned();
            assert_eq!(out.lines().count(), 1, "{outcome}");
            out
        }
    };
    let line: Value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {outcome}"));
    assert_eq!((line["class"].as_str(), line["kind"].as_str()), (Some("error"), Some(kind)), "{outcome}");
    let [message, hint] = ["message", "hint"].map(|key| line[key].as_str().unwrap_or_default());
    assert!(!message.is_empty() && !hint.is_empty(), "{outcome}");
    if kind != "usage" {
        check_contains_all(&format!("{message}\n{hint}"), words, &outcome);
    }
}

fn check_contains_all(text: &str, words: &[&str], outcome: &Outcome) {
    for word in words {
        assert!(text.contains(word), "does not say {word:?}: {outcome}");
    }
}

#[test]
fn rejects_invalid_command_lines() {
    let env = TestEnv::new();
    for (arguments, word) in [
        (&["fly"][..], "fly"),
        (&["lst"], "list"),
        (&["list", "--colour"], "--colour"),
        (&["echo"], "SENSOR/TOPIC"),
        (&["echo", "front/scan", "-n", "0"], "0"),
        (&["echo", "front/scan", "-n", "many"], "many"),
        (&["echo", "front/scan", "--for", "10"], "10"),
        (&["echo", "front/scan", "--csv", "--raw"], "--raw"),
        (&["echo", "front/scan", "--meters"], "--meters"),
        (&["hz", "front/scan", "--window=0.1s"], "at least 500ms"),
        (&["simulate"], "--port"),
        (&["simulate", "--port=a", "--world=room", "--replay=x"], "--replay"),
        (&["run", "--link"], "--link"),
    ] {
        assert_refused(&env, arguments, 2, "usage", &[word]);
    }
    for (arguments, flag) in [
        (&["--json", "echo", "front/scan", "--csv"], "--csv"),
        (&["--json", "probe", "/dev/null", "--toml"], "--toml"),
    ] {
        let outcome = env.run(arguments);
        let error = &outcome.of_class("error")[0];
        let message = format!("the argument '{flag}' cannot be used with '--json'");
        assert_eq!((outcome.exit_code, error["message"].as_str()), (Some(2), Some(&*message)), "{outcome}");
    }
    let help = env.run(&["--help"]);
    assert_eq!((help.exit_code, help.stderr.as_str()), (Some(0), ""));
}

#[test]
fn rejects_formats_unsuitable_for_the_topics() {
    let env = TestEnv::new();
    for (arguments, word) in [
        (["echo", "front/telegram", "--csv"], "--csv takes one topic"),
        (["echo", "front/status", "--csv"], "--csv takes one topic"),
    ] {
        let outcome = env.run(&arguments);
        assert_eq!(outcome.exit_code, Some(2), "{outcome}");
        check_contains_all(&outcome.stderr, &[word], &outcome);
    }
    let outcome = env.run(&["echo", "front/telegram", "rear/telegram", "--raw"]);
    assert_eq!(outcome.exit_code, Some(2), "{outcome}");
}

#[test]
fn rejects_invalid_configurations() {
    let env = TestEnv::new();
    let file = env.file("hub.toml", "[[link]]\nname = \"front\"\nport = \"/dev/x\"\nbaud = 115200\n");
    let unknown = env.file("key.toml", "[[link]]\nname = \"front\"\nprot = \"/dev/x\"\n");
    let broken = env.file("toml.toml", "[[link]\n");
    let (place, key) = (format!("{file}:4:8"), format!("{unknown}:3:1"));
    for (arguments, words) in [
        (&["run", "--set", "link.front.prot=/dev/x"][..], &["link.front.prot", "`prot`", "`port`"][..]),
        (
            &["run", "--link=front=/dev/x", "--set", "link.front.angle=170"],
            &["--set", "angle = 170", "100 or 180"],
        ),
        (
            &["run", "--link=front=/dev/x", "--set", "link.front.resolution=0.25"],
            &["180", "0.25", "0.5 or 1"],
        ),
        (&["run", "--link=a=/x", "--link=b=/y", "--set", "link.side.angle=100"], &["no link side", "a, b"]),
        (&["run", "--no-system-config"], &["no link is configured", "--link NAME=PORT", "config default"]),
        (&["run", "--set", "speed=3"], &["speed=3", "link.NAME.KEY"]),
        (&["run", "--link", "front"], &["--link front", "NAME=PORT"]),
        (&["run", "--link", "Front=/dev/x"], &["Front"]),
        (&["run", "--link", "front=file:x?rate=2"], &["rate=max"]),
        (&["run", "--config", &file], &[&place, "baud = 115200", "38400"]),
        (&["run", "--config", &unknown], &[&key, "`prot`", "`port`"]),
        (&["run", "--config", &broken], &["toml.toml:1:"]),
        (&["simulate", "--port=a", "--fault=los=1"], &["los=1", "loss, burst"]),
        (&["simulate", "--port=a", "--baud=115200"], &["115200", "9600"]),
        (&["simulate", "--port=a", "--variant=180/0.25"], &["180/0.25", "one of"]),
        (&["simulate", "--port=a", "--speed=0"], &["speed"]),
        (&["simulate", "--port=a", "--state=asleep"], &["asleep", "installation"]),
        (&["simulate", "--port=a", "--fault=silence=-1"], &["silence=-1", "from 0 to"]),
        (&["simulate", "--port=a", "--type=lms211", "--variant=180/0.5"], &["180/0.5", "100 degrees"]),
    ] {
        assert_refused(&env, arguments, 78, "configuration", words);
    }
}

#[test]
fn every_verb_rejects_unknown_topic_and_sensor_names() {
    let env = TestEnv::new();
    for (arguments, words) in [
        (&["echo", "front/scam"][..], &["front/scam", "front/scan"][..]),
        (&["hz", "front/scam"], &["front/scam", "front/scan"]),
        (&["latency", "front/scam"], &["front/scam", "front/scan"]),
        (&["record", "front/scam"], &["front/scam", "front/scan"]),
        (&["gateway", "--topic=front/scam"], &["front/scam", "front/scan"]),
        (&["listen", "--topic=scam"], &["scam", "scan"]),
        (&["listen", "--publish", "--subscribers=251"], &["251", "1..=250"]),
        (&["listen", "--subscribers=3"], &["--publish"]),
        (&["listen", "--publish", "--consumers=3"], &["'--consumers'", "--subscribers"]),
        (&["listen", "--memory=3"], &["--publish"]),
        (&["listen", "--publish", "--memory=0"], &["0", "1.."]),
        (&["echo", "*/scam"], &["*/scam", "*/scan"]),
        (&["echo", "*"], &["topics are"]),
        (&["record", "*/scam"], &["*/scam", "*/scan"]),
        (&["gateway", "--topic=*/scam"], &["*/scam", "*/scan"]),
        // Topics whose form these verbs do not accept.
        (&["echo", "*/scan", "--csv"], &["--csv"]),
        (&["echo", "front/*", "--raw"], &["--raw"]),
        (&["latency", "*/scan"], &["*"]),
        (&["record", "robot/zones"], &["robot/zones", "*/zones"]),
        (&["gateway", "--topic=robot/zones"], &["robot/zones", "*/zones"]),
        (&["gateway", "--topic=front/status:every=2"], &["thinned"]),
        // Invalid sensor names.
        (&["echo", "Front/scan"], &["Front"]),
        (&["info", "Front"], &["Front"]),
        (&["control", "Front", "pause"], &["Front"]),
        (&["background", "Front", "show"], &["Front"]),
        (&["zones", "Front", "mask"], &["Front"]),
        (&["leds", "Front"], &["Front"]),
    ] {
        let outcome = env.run(arguments);
        assert_eq!((outcome.exit_code, outcome.stdout.is_empty()), (Some(2), true), "{outcome}");
        check_contains_all(&outcome.stderr, words, &outcome);
        let outcome = env.run(&[arguments, &["--json"]].concat());
        // The parser of the command line reports unknown flags, also as an error of kind `usage`.
        let kind = outcome.of_class("error").pop().map(|line| line["kind"].clone());
        assert_eq!((outcome.exit_code, kind), (Some(2), Some("usage".into())), "{outcome}");
    }
    let config = env.file("topics.toml", "[gateway]\ntopics = [\"front/scam\"]\n");
    let arguments = ["gateway", "--no-system-config", "--config", &config];
    assert_refused(&env, &arguments, 78, "configuration", &["gateway", "front/scam"]);
}

#[test]
fn unreadable_input_exits_with_66() {
    let env = TestEnv::new();
    let missing = env.path_argument("missing");
    let output = env.path_argument("out.mcap");
    for arguments in [
        &["run", "--no-system-config", "--config", &missing][..],
        &["run", "--no-system-config", &format!("--link=front=file:{missing}")],
        &["config", "check", "--no-system-config", "--config", &missing],
        &["config", "show", "--no-system-config", "--config", &missing],
        &["replay", &missing],
        &["replay", "/etc/passwd"],
        &[
            "replay",
            "--config",
            &missing,
            concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap"),
        ],
        &["simulate", "--port=a", "--replay", &missing],
        &["simulate", "--port=a", "--replay=/etc/passwd"],
        &["simulate", "--port=a", "--world", &missing],
        &["convert", &missing, &output],
        &["convert", "/etc/passwd", &output],
        &["telegram", "decode", &missing],
        &["background", "front", "load", &missing],
        &["background", "front", "load", "/etc/passwd"],
        &["gateway", "--no-system-config", "--config", &missing],
    ] {
        let is_there = arguments.iter().any(|word| word.ends_with("/etc/passwd"));
        let named = if is_there { "/etc/passwd" } else { &missing };
        assert_refused(&env, arguments, 66, "input", &[named]);
    }
    // A file that can be read, but has a wrong value.
    let wrong = env.file("wrong.toml", "[background]\nmethod = \"magic\"\n");
    assert_refused(
        &env,
        &["run", "--no-system-config", "--link=a=/x", "--config", &wrong],
        78,
        "configuration",
        &["magic"],
    );
}

#[test]
fn unwritable_or_existing_output_exits_with_73() {
    let env = TestEnv::new();
    let there = env.file("there.mcap", "whole");
    let nowhere = env.path_argument("no/such/directory/out.mcap");
    let input = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap");
    let whole = env.path_argument("whole.mcap");
    std::fs::copy(input, &whole).expect("a copy");
    for (arguments, words) in [
        (&["convert", input, &there][..], &["there.mcap", "--force"][..]),
        (&["convert", input, &nowhere], &["no/such"]),
        (&["convert", &whole, &whole], &["whole.mcap", "both read and written"]),
        (&["record", "-o", &there], &["there.mcap", "--force"]),
        (&["record", "-o", &nowhere], &["no/such"]),
        (&["record", "-o", "/"], &["directory"]),
        (&["man", "/proc/pages"], &["/proc/pages"]),
        (&["simulate", "--port=a", "--truth", &nowhere], &["no/such"]),
        (&["background", "front", "save", &there], &["there.mcap", "--force"]),
    ] {
        assert_refused(&env, arguments, 73, "output", words);
    }
    assert_eq!(std::fs::read(env.path("there.mcap")).unwrap(), b"whole");
}

#[test]
fn reports_a_missing_sensor_or_hub() {
    let env = TestEnv::new();
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap");
    let verbs = [
        &["echo", "side/scan", "--for=9s"][..],
        &["echo", "side/*", "--for=9s"],
        &["hz", "side/scan", "--for=9s"],
        &["latency", "side/scan", "--for=9s", "--no-realtime"],
        &["record", "side/scan", "--for=9s", "-o", &env.path_argument("side.mcap")],
        &["leds", "side", "--for=9s"],
        &["zones", "side", "mask", "--for=9s"],
        &["info", "side"],
        &["control", "side", "pause"],
        &["background", "side", "show"],
        &["background", "side", "save", &env.path_argument("side.json")],
    ];
    let asks = |verb: &[&str], kind: &str| {
        let outcome = env.run(&[verb, &["--json"]].concat());
        let errors = outcome.of_class("error");
        let reported = errors.last().map(|line| line["kind"].clone());
        assert_eq!((outcome.exit_code, reported), (Some(3), Some(kind.into())), "{verb:?}: {outcome}");
    };
    run_concurrently(verbs, |verb| asks(verb, "no_hub"));
    asks(&["list"], "no_hub");
    for verb in [
        &["replay", golden, "--sensor=side"][..],
        &["convert", golden, &env.path_argument("x.bin"), "--sensor=side"],
    ] {
        let outcome = env.run(verb);
        assert_eq!(outcome.exit_code, Some(3), "{outcome}");
    }
    let hub = env.hub(&["--link=front=/no/such/port"]);
    run_concurrently(verbs, |verb| asks(verb, "no_topic"));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn reports_a_full_disk() {
    let env = TestEnv::new();
    let beams = ["1.50"; 181].join(" ");
    let log = env.file("a.log", format!("FLASER 181 {beams} 0 0 0 0 0 0 1000.0 host 1000.0\n"));
    for verb in [
        &["config", "default"][..],
        &["config", "show", "--no-system-config", "--link=front=/dev/x"],
        &["completions", "bash"],
        &["man"],
        &["doctor", "--no-system-config", "/dev/null"],
        &["doctor", "--json", "--no-system-config", "/dev/null"],
        &["replay", "--no-system-config", "--rate", "max", &log],
    ] {
        let full = std::fs::File::options().write(true).open("/dev/full").expect("the device /dev/full");
        let mut command = env.command(verb);
        command.stdin(Stdio::null()).stdout(full).stderr(Stdio::piped());
        let done = spawn(command).and_then(Child::wait_with_output).expect("a started program");
        let errors = String::from_utf8_lossy(&done.stderr);
        assert!(
            done.status.code() == Some(1) && errors.contains("cannot write: No space"),
            "{verb:?}: {done:?}"
        );
    }
}

#[test]
fn rejects_invalid_domains() {
    let at = |domain: &str, root: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
        command.args(["list", "--json", "--domain", domain, "--root", root]);
        testkit::Program::start(command).wait()
    };
    for (domain, root, word) in [
        ("Robot", "/tmp", "a-z"),
        ("a-domain-of-much-too-many-letters", "/tmp", "1 to 16"),
        ("robot", &format!("/tmp/{}", "long".repeat(16)), "shorter --root"),
    ] {
        let outcome = at(domain, root);
        let [line] = &outcome.lines()[..] else { panic!("{outcome}") };
        assert_eq!((outcome.exit_code, &line["kind"]), (Some(78), &"configuration".into()), "{outcome}");
        check_contains_all(line["hint"].as_str().unwrap_or_default(), &[word], &outcome);
    }
}

#[test]
fn reports_that_no_hub_is_running() {
    let env = TestEnv::new();
    for arguments in [
        &["list"][..],
        &["info"],
        &["info", "front"],
        &["echo", "front/scan", "-n", "1"],
        &["echo", "front/scan", "--for", "9s"],
        &["hz", "-n", "1"],
    ] {
        let outcome = env.run(arguments);
        assert_eq!(outcome.exit_code, Some(3), "{outcome}");
        check_contains_all(&outcome.stderr, &["no hub", "scanhub run"], &outcome);
    }
    for arguments in [&["list", "--json"][..], &["info", "--json"], &["echo", "a/scan", "-n1", "--json"]] {
        let outcome = env.run(arguments);
        assert_eq!((outcome.exit_code, &outcome.of_class("error")[0]["kind"]), (Some(3), &"no_hub".into()));
    }
}

#[test]
fn reports_unknown_sensors_and_timeouts() {
    let env = TestEnv::new();
    // If a port is missing, the link is `absent`, but the hub does not fail.
    let hub = env.hub(&[env.link("front")]);
    let info = env.await_info("front", |info| info["state"] == "absent");
    assert!(info["last_error"].as_str().is_some_and(|error| error.contains("no such port")), "{info}");
    for (arguments, kind, words) in [
        (&["echo", "side/scan", "-n", "1"][..], "no_topic", &["side", "front"][..]),
        (&["echo", "side/scan"], "no_topic", &["side", "front"]),
        (&["hz", "side/scan"], "no_topic", &["side", "front"]),
        (&["info", "side"], "no_topic", &["side", "front"]),
    ] {
        let outcome = env.run(arguments);
        assert_eq!(outcome.exit_code, Some(3), "{outcome}");
        check_contains_all(&outcome.stderr, words, &outcome);
        let outcome = env.run(&[arguments, &["--json"]].concat());
        assert_eq!(outcome.of_class("error")[0]["kind"], kind, "{outcome}");
    }
    for bound in [&["--timeout", "300ms"][..], &["-n", "1", "--for", "300ms"], &["-n", "1", "--timeout=0.3s"]]
    {
        let outcome = env.run(&[&["echo", "front/scan", "--json"], bound].concat());
        assert_eq!(
            (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
            (Some(3), &"timeout".into()),
            "{outcome}"
        );
        assert_eq!(outcome.of_class("summary")[0]["received"], 0, "{outcome}");
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn rejects_unusable_ports() {
    let env = TestEnv::new();
    let file = env.file("file", "not a tty");
    assert_refused(&env, &["run", "--link=front=/dev/null"], 4, "port_not_tty", &["/dev/null", "name a tty"]);
    assert_refused(
        &env,
        &["run", &format!("--link=front={file}")],
        4,
        "port_not_tty",
        &[&file, "or file:PATH"],
    );
    assert_refused(&env, &["simulate", "--port=/no/where/front"], 4, "port_missing", &["/no/where/front"]);

    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (port, pid) = (env.path_argument("front"), format!("process {}", hub.pid()));
    assert_refused(&TestEnv::new(), &["probe", &port], 4, "port_busy", &[&port, &pid, "stop the hub: kill"]);
    assert_eq!(env.info("front")["state"], "streaming", "the hub was disturbed");
}

#[test]
fn second_hub_in_a_domain_is_refused() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front")]);
    let pid = format!("pid {}", hub.pid());
    assert_refused(&env, &["run", &env.link("front")], 1, "domain_held", &[&pid, "--domain"]);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    // After the hub has exited, another hub can use the domain.
    let hub = env.hub(&[env.link("front")]);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
