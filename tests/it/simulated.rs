//! `scanhub simulate`, as somebody runs it: what its flags say is what is there to be found.

use std::io::{Read, Write};
use std::thread::sleep;
use std::time::Duration;

use crate::testkit::{TERM, TestEnv, number, open_line, until};

#[test]
fn a_sensor_with_a_past_tells_it_when_it_is_asked() {
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
    let outcome = env.run(&["probe", &env.word("front"), "--json"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
    assert_eq!((number(found, "baud"), number(found, "operating_mode")), (38_400, 0), "{found}");
    assert_eq!((&found["type"], number(found, "unit_mm")), (&"LMS221".into(), 10), "{found}");
    assert_eq!(found["permanent_rate"], true, "{found}");
    assert_eq!(found["errors"].as_array().map(Vec::len), Some(2), "{found}");
    assert_eq!(found["configuration"].as_str().map(str::len), Some(64), "{found}");
    assert_eq!(simulator.end(TERM).code, Some(0));
    assert_eq!(env.simulated("front").1, 0);
}

#[test]
fn faults_are_named_in_the_truth() {
    let env = TestEnv::new();
    let fault = "--fault=truncate=0.3,length=0.3";
    let simulator = env.simulator(&["front"], &["--baud=500000", "--state=streaming", fault]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    for name in ["truncated", "length", "unread"] {
        until(name, || {
            let text = std::fs::read_to_string(env.path("truth")).unwrap_or_default();
            text.contains(&format!(r#""fault":"{name}""#))
        });
    }
    assert_eq!(hub.end(TERM).code, Some(0));
    assert_eq!(simulator.end(TERM).code, Some(0));
}

#[test]
fn a_scanner_that_never_listens_speaks_at_once_and_others_are_refused() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--family=ld", "--model=stl27l", "--world=room"]);
    let mut port = open_line(&env.path("front"), 921_600);
    let mut bytes: Vec<u8> = Vec::new();
    until("packets", || {
        let mut buffer = [0; 4_096];
        let len = port.read(&mut buffer).unwrap_or(0);
        bytes.extend(&buffer[..len]);
        bytes.windows(49).any(|packet| packet[..2] == [0x54, 0x2C] && packet[47..] == [0x54, 0x2C])
    });
    assert_eq!(simulator.end(TERM).code, Some(0));
    assert_eq!(env.simulated("front").1, 0);
    let truth = std::fs::read_to_string(env.path("truth")).expect("a truth");
    assert!(truth.lines().next().is_some_and(|line| line.contains(r#""length":47"#)), "{truth}");
    let refused = |flags: &[&str], says: &str| {
        let port = format!("--port={}", env.word("none"));
        let outcome = env.run(&[&["simulate", &port], flags].concat());
        assert_eq!(outcome.code, Some(78), "{outcome}");
        assert!(outcome.errors.contains(says), "{outcome}");
    };
    for family in ["scip", "cola", "rplidar"] {
        refused(&[&format!("--family={family}")], "one of: lms, ld");
    }
    refused(&["--family=ld", "--model=ld20"], "one of: ld06, ld19, stl19p, stl27l, ld14p");
    refused(&["--model=ld19"], "--type says which LMS");
    refused(&["--family=ld", "--unit=cm"], "has no unit to choose");
}

/// A host that stopped in the middle of a request and finds no answer is told why.
#[test]
fn a_request_that_is_dropped_is_said() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=3"]);
    let mut port = open_line(&env.path("front"), 9_600);
    // A status request (Telegram listing, 31h), its second half far too late: a machine that stands still meanwhile does
    // not excuse half a second.
    port.write_all(&[0x02, 0x00, 0x01]).expect("room");
    sleep(Duration::from_millis(500));
    port.write_all(&[0x00, 0x31, 0x15, 0x12]).expect("room");
    // A whole one, at once: its ACK says that all before it was heard.
    port.write_all(&[0x02, 0x00, 0x01, 0x00, 0x31, 0x15, 0x12]).expect("room");
    let mut acknowledge = [0];
    until("an answer", || port.read(&mut acknowledge).is_ok_and(|len| len > 0));
    assert_eq!(acknowledge, [0x06]);
    let outcome = simulator.end(TERM);
    let said = format!(
        "{}: a request was dropped: more than 6 ms of silence after 3 of its bytes",
        env.word("front")
    );
    assert_eq!(outcome.code, Some(0));
    assert!(outcome.errors.contains(&said), "{outcome}");
}
