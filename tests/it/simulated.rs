//! Tests of `scanhub simulate`: the flags of the simulator determine what a hub or `probe` finds.

use std::io::{Read, Write};
use std::time::Duration;

use crate::testkit::{TERM, TestEnv, is_class, number, open_line, wait_at_least, wait_until};

#[test]
fn simulator_flags_appear_in_the_probe_result() {
    let env = TestEnv::new();
    let flags = [
        "--permanent-baud=38400",
        "--state=installation",
        "--type=lms221",
        "--address=5",
        "--error=3:18",
        "--error=0x84:22",
        "--status=0x13",
        "--pollution=60",
        "--short-configuration",
    ];
    let simulator = env.simulator(&["front"], &flags);
    let outcome = env.search(&["probe", &env.path_argument("front"), "--json"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
    assert_eq!((number(found, "baud"), number(found, "operating_mode")), (38_400, 0), "{found}");
    assert_eq!((&found["type"], number(found, "unit_mm")), (&"LMS221".into(), 10), "{found}");
    assert_eq!(found["permanent_rate"], true, "{found}");
    assert_eq!(found["errors"].as_array().map(Vec::len), Some(2), "{found}");
    assert_eq!(found["configuration"].as_str().map(str::len), Some(64), "{found}");
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn truth_file_names_the_fault_of_each_telegram() {
    let env = TestEnv::new();
    let fault = "--fault=truncate=0.3,length=0.3";
    let simulator = env.simulator(&["front"], &["--baud=500000", "--state=streaming", fault]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    for name in ["truncated", "length", "unread"] {
        wait_until(name, || {
            let text = std::fs::read_to_string(env.path("truth")).unwrap_or_default();
            text.contains(&format!(r#""fault":"{name}""#))
        });
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

#[test]
fn ld_scanner_streams_at_once_and_rejects_bad_flags() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--family=ld", "--model=stl27l", "--world=room"]);
    let mut port = open_line(&env.path("front"), 921_600);
    let mut bytes: Vec<u8> = Vec::new();
    wait_until("packets", || {
        let mut buffer = [0; 4_096];
        let len = port.read(&mut buffer).unwrap_or(0);
        bytes.extend(&buffer[..len]);
        bytes.windows(49).any(|packet| packet[..2] == [0x54, 0x2C] && packet[47..] == [0x54, 0x2C])
    });
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
    let truth = std::fs::read_to_string(env.path("truth")).expect("the truth file");
    assert!(truth.lines().next().is_some_and(|line| line.contains(r#""length":47"#)), "{truth}");
    let refused = |flags: &[&str], message: &str| {
        let port = format!("--port={}", env.path_argument("none"));
        let outcome = env.run(&[&["simulate", &port], flags].concat());
        assert_eq!(outcome.exit_code, Some(78), "{outcome}");
        assert!(outcome.stderr.contains(message), "{outcome}");
    };
    for family in ["scip", "cola"] {
        refused(&[&format!("--family={family}")], "one of: lms, ld, rplidar");
    }
    refused(&["--family=rplidar", "--model=a4"], "one of: a1, a2m8, a2m12, a3, s1, s2, s3, c1");
    refused(
        &["--family=rplidar", "--mode=dense"],
        "one of: standard, express, boost, sensitivity, stability",
    );
    refused(&["--family=rplidar", "--replay=none"], "has no recording to choose");
    refused(&["--family=ld", "--mode=boost"], "one way to measure");
    refused(&["--family=ld", "--model=ld20"], "one of: ld06, ld19, stl19p, stl27l, ld14p");
    refused(&["--model=ld19"], "--type says which LMS");
    refused(&["--family=ld", "--unit=cm"], "has no unit to choose");
}

#[test]
fn rplidar_streams_in_the_requested_mode_and_replies() {
    let env = TestEnv::new();
    let flags = ["--family=rplidar", "--model=a3", "--mode=Stability", "--state=streaming"];
    let simulator = env.simulator(&["front"], &flags);
    let mut port = open_line(&env.path("front"), 256_000);
    let mut bytes: Vec<u8> = Vec::new();
    let mut read = |description: &str, port: &mut std::fs::File, is_there: &dyn Fn(&[u8]) -> bool| {
        bytes.clear();
        wait_until(description, || {
            let mut buffer = [0; 4_096];
            let len = port.read(&mut buffer).unwrap_or(0);
            bytes.extend(&buffer[..len]);
            is_there(&bytes)
        });
    };
    let is_packet = |packet: &[u8]| packet[0] >> 4 == 0xA && packet[1] >> 4 == 5 && packet[132] >> 4 == 0xA;
    read("a stream", &mut port, &|bytes| bytes.windows(133).any(is_packet));
    port.write_all(&[0xA5, 0x25]).expect("a written request");
    // Request the recommended mode of the scanner (parameter 7Ch). The reply has the number of this mode.
    port.write_all(&[0xA5, 0x84, 4, 0x7C, 0, 0, 0, 0xA5 ^ 0x84 ^ 4 ^ 0x7C]).expect("a written request");
    let answer = [0xA5, 0x5A, 6, 0, 0, 0, 0x20, 0x7C, 0, 0, 0, 4, 0];
    read("an answer", &mut port, &|bytes| bytes.ends_with(&answer));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn hub_reads_sensors_behind_tcp() {
    let env = TestEnv::new();
    let server = |flags: &[&str]| {
        let mut simulator = env.start(&[&["simulate", "--json", "--tcp=127.0.0.1:0"], flags].concat());
        let ready = simulator.await_line("ready", is_class("ready"));
        let [port] = &ready["ports"].as_array().expect("ports")[..] else { panic!("{ready}") };
        assert!(port["pty"].is_null(), "{ready}");
        (simulator, port["port"].as_str().expect("a port").to_owned())
    };
    let (lms, front) = server(&["--baud=38400"]);
    let (ld, side) = server(&["--family=ld", "--model=ld19"]);
    assert!(front.starts_with("tcp:127.0.0.1:") && front != side);
    let family = ["--set=link.front.baud=38400", "--set=link.side.family=ld"];
    let links = [format!("--link=front={front}"), format!("--link=side={side}")];
    let hub = env.hub(&[&links.each_ref().map(String::as_str)[..], &family].concat());
    for sensor in ["front", "side"] {
        let info = env.await_info(sensor, |info| info["state"] == "streaming");
        assert!(info["port"] == front.as_str() || info["port"] == side.as_str(), "{info}");
    }
    for program in [hub, lms, ld] {
        assert_eq!(program.end(TERM).exit_code, Some(0));
    }
}

#[test]
fn simulator_sends_recorded_packets_again() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--family=ld", "--model=ld19"]);
    let hub = env.hub(&[&env.link("front"), "--set=link.front.family=ld"]);
    env.await_info("front", |info| info["state"] == "streaming");
    let file = env.path_argument("day.mcap");
    let outcome = env.run(&["record", "-o", &file, "front/telegram", "-n", "200"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    for program in [hub, simulator] {
        assert_eq!(program.end(TERM).exit_code, Some(0));
    }
    let sent: Vec<_> = env.truth("front").into_iter().map(|sent| sent.hash).collect();
    let again = env.simulator(&["again"], &["--family=ld", "--replay", &file, "--sensor=front"]);
    wait_until("packets are sent again", || env.truth("again").len() > 100);
    assert_eq!(again.end(TERM).exit_code, Some(0));
    let replayed: Vec<_> = env.truth("again").into_iter().map(|sent| sent.hash).collect();
    // The packets that the second simulator has replayed are some of those that the first one sent, in the same order.
    let mut rest = sent.iter();
    assert!(replayed.iter().all(|packet| rest.any(|sent| sent == packet)), "{} packets", replayed.len());
}

/// If a host pauses in the middle of a request, it receives no reply. The simulator's log then has the reason.
#[test]
fn dropped_request_is_reported_with_its_reason() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=3"]);
    let mut port = open_line(&env.path("front"), 9_600);
    // Send a status request (Telegram listing, 31h), but its second half far too late.
    port.write_all(&[0x02, 0x00, 0x01]).expect("a written request");
    wait_at_least(Duration::from_secs(1));
    port.write_all(&[0x00, 0x31, 0x15, 0x12]).expect("a written request");
    // Send a complete request. Its ACK shows that the simulator has handled all earlier bytes.
    port.write_all(&[0x02, 0x00, 0x01, 0x00, 0x31, 0x15, 0x12]).expect("a written request");
    let mut acknowledge = [0];
    wait_until("a reply", || port.read(&mut acknowledge).is_ok_and(|len| len > 0));
    assert_eq!(acknowledge, [0x06]);
    let outcome = simulator.end(TERM);
    let message = format!(
        "{}: a request was dropped: more than 6 ms of silence after 3 of its bytes",
        env.path_argument("front")
    );
    assert_eq!(outcome.exit_code, Some(0));
    assert!(outcome.stderr.contains(&message), "{outcome}");
}
