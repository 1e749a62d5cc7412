//! Tests of `scanhub probe`: the command reports the scanner at a port, and leaves the scanner in its previous state.

use std::io::Read;

use crate::testkit;
use crate::testkit::{INT, REAL_REPLY_TIME, TERM, TestEnv, TestLine, number, open_line};
use serde_json::Value;

#[test]
fn reports_identity_without_changing_the_scanner() {
    let env = TestEnv::new();
    let simulator =
        env.simulator(&["front"], &["--baud=19200", "--type=lms291", "--unit=cm", REAL_REPLY_TIME]);
    let port = env.path_argument("front");
    for _ in 0..2 {
        let outcome = env.search(&["probe", &port, "--json"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
        let text = String::from_utf8_lossy(&outcome.stdout);
        let begin = format!(
            r#"{{"class":"probe","port":"{port}","family":"lms","model":"lms291","baud":19200,"type":"LMS291","number":"301063""#
        );
        assert!(text.starts_with(&begin), "{text}");
        assert_eq!((number(found, "operating_mode"), number(found, "unit_mm")), (0x25, 10), "{found}");
        assert_eq!(
            (&found["permanent_rate"], &found["defective"]),
            (&Value::Bool(false), &Value::Bool(false))
        );
        assert_eq!(found["errors"], Value::Array(Vec::new()));
        assert_eq!(found["configuration"].as_str().map(str::len), Some(68), "{found}");
        assert_eq!(outcome.stderr, "", "no progress without a terminal");
    }
    let outcome = env.search(&["probe", &port]);
    let text = String::from_utf8_lossy(&outcome.stdout);
    for word in ["LMS291", "19200 Bd", "values on request", "10 mm", "180 degrees", "errors"] {
        assert!(text.contains(word), "{word}: {outcome}");
    }
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

/// The last line of the output is a shell command that starts a hub. With `--toml`, the output is a section of a
/// configuration file. A hub that is started with the command or with the section streams.
#[test]
fn printed_link_and_section_start_a_hub() {
    let families: [(&str, &[&str], &str); 3] = [
        ("lms", &["--type=lms211"], "family=lms,type=lms211"),
        ("ld", &["--family=ld", "--model=ld19", "--world=room"], "family=ld,model=ld19"),
        ("rplidar", &["--family=rplidar", "--model=a2m8", "--world=room"], "family=rplidar,model=a2m8"),
    ];
    for (family, flags, keys) in families {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], flags);
        let port = env.path_argument("front");
        let probed = env.search(&["probe", &port]);
        let text = String::from_utf8_lossy(&probed.stdout).into_owned();
        let next = text.lines().last().and_then(|line| line.strip_prefix("next: scanhub run --link "));
        let link = next.unwrap_or_else(|| panic!("{probed}"));
        assert_eq!(link, format!("front={port},{keys}"), "{probed}");
        let json = env.search(&["probe", &port, "--json"]);
        assert_eq!(json.lines()[0]["link"], link, "{json}");
        let toml = env.search(&["probe", &port, "--toml"]);
        assert_eq!((toml.exit_code, toml.stderr.as_str()), (Some(0), ""), "{toml}");
        let section = String::from_utf8_lossy(&toml.stdout).into_owned();
        assert!(section.starts_with("[[link]]\nname = \"front\"\nport = "), "{section}");
        let file = env.file("scanhub.toml", &section);
        for flags in [&["--link", link][..], &["--config", file.as_str()]] {
            let hub = env.hub(flags);
            let info = env.await_info("front", |info| info["state"] == "streaming");
            assert_eq!(info["family"], family, "{info}");
            assert_eq!(hub.end(TERM).exit_code, Some(0));
        }
        assert_eq!(simulator.end(TERM).exit_code, Some(0));
    }
}

#[test]
fn probe_toml_requires_a_port() {
    let env = TestEnv::new();
    let outcome = env.run(&["probe", "--toml"]);
    assert_eq!((outcome.exit_code, outcome.stdout.len()), (Some(2), 0), "{outcome}");
    assert!(outcome.stderr.contains("PORT"), "{outcome}");
    let outcome = env.run(&["probe", "/dev/null", "--toml", "--json"]);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(2), &"usage".into()),
        "{outcome}"
    );
}

#[test]
fn reports_dirty_window_despite_ok_status() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--type=lms291", "--pollution=20"]);
    let port = env.path_argument("front");
    let found = env.search(&["probe", &port, "--json"]);
    assert_eq!(found.lines()[0]["polluted"], true, "{found}");
    let outcome = env.search(&["probe", &port]);
    let text = String::from_utf8_lossy(&outcome.stdout);
    assert!(text.contains("ok, window polluted"), "{outcome}");
    assert!(text.contains("20 % clear: clean it"), "{outcome}");
}

#[test]
fn resumes_an_abandoned_stream() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=500000"]);
    // Kill a hub, which leaves its scanner streaming.
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    hub.end(testkit::KILL);
    let found = env.search(&["probe", &env.path_argument("front"), "--json"]);
    assert_eq!((found.exit_code, number(&found.lines()[0], "operating_mode")), (Some(0), 0x24), "{found}");
    let sent = env.truth("front").len();
    testkit::wait_until("a continued stream", || env.truth("front").len() > sent + 20);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn reports_silent_and_unusable_ports() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--fault=mute=1"]);
    let outcome = env.run(&["probe", &env.path_argument("front"), "--json"]);
    let error = &outcome.of_class("error")[0];
    assert_eq!((outcome.exit_code, &error["kind"]), (Some(3), &"timeout".into()), "{outcome}");
    for (port, code, kind) in [("/dev/null", 4, "port_not_tty"), ("/no/such", 4, "port_missing")] {
        let outcome = env.run(&["probe", port, "--json"]);
        assert_eq!((outcome.exit_code, &outcome.of_class("error")[0]["kind"]), (Some(code), &kind.into()));
        assert!(
            !outcome.of_class("error")[0].to_string().contains("file:"),
            "no recording is requested: {outcome}"
        );
    }
    let outcome = env.run(&["probe", "file:/etc/hostname", "--json"]);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(78), &"configuration".into())
    );
}

/// Verbs that search for a scanner in the same way, each with the exit code that it has on a silent line.
const SEARCH_COMMANDS: [(&[&str], i32); 2] = [(&["probe"], 3), (&["doctor", "--no-system-config"], 5)];

/// Asserts that `sent` consists only of requests of the search, complete or interrupted. Returns how often each request
/// was sent completely.
fn count_requests(mut sent: &[u8]) -> [usize; 4] {
    const REQUESTS: [&[u8]; 4] = [
        &[0x02, 0x00, 0x01, 0x00, 0x3A, 0x1E, 0x12],
        &[0x02, 0x00, 0x01, 0x00, 0x31, 0x15, 0x12],
        &[0xA5, 0x25],
        &[0xA5, 0x50],
    ];
    let mut counts = [0; 4];
    while !sent.is_empty() {
        // If the search would send the next byte of a request too late, it starts the request again. So `sent` may have
        // only the first bytes of a request.
        let len_of = |request: &[u8]| request.iter().zip(sent).take_while(|(a, b)| a == b).count();
        let (len, number) =
            (0..4).map(|number| (len_of(REQUESTS[number]), number)).max().expect("one of four requests");
        assert!(len > 0, "{sent:02X?}");
        counts[number] += usize::from(len == REQUESTS[number].len());
        sent = &sent[len..];
    }
    counts
}

#[test]
fn sends_only_search_requests_to_unknown_scanner() {
    for (verb, code) in SEARCH_COMMANDS {
        let env = TestEnv::new();
        let line = TestLine::create(&env.path("front"));
        let program = env.start(&[verb, &[&env.path_argument("front"), "--json"]].concat());
        let mut sent = Vec::new();
        testkit::wait_until("the end of the program", || {
            sent.extend(line.received());
            program.has_ended()
        });
        let outcome = program.wait();
        sent.extend(line.received());
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        let text = outcome.to_string();
        for part in [
            "no byte arrived; looked for lms at 9600, 19200, 38400 or 500000 Bd, ld at ",
            "; lms: ",
            "; ld: ",
            "; rplidar: ",
        ] {
            assert!(text.contains(part), "{part}: {outcome}");
        }
        // The search has two rounds. In each round, it searches for an LMS at four rates, and sends each RPLIDAR
        // request four times.
        let counts = count_requests(&sent);
        assert!(counts[0] >= 4 && counts[1] >= 4 && counts[2] >= 8 && counts[3] >= 8, "{counts:?}");
    }
}

/// The test prints how many requests the search sent, but has no limit for them. In virtual time, a streaming scanner
/// would receive no byte at all. On a busy machine, there may be gaps between its packets, in which the search
/// continues.
#[test]
fn finds_streaming_scanner_with_search_requests_only() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["scanner"], &["--family=ld", "--model=ld19", "--world=room"]);
    let line = TestLine::create(&env.path("front"));
    let mut scanner = open_line(&env.path("scanner"), 230_400);
    for (verb, _) in SEARCH_COMMANDS {
        let program = env.start(&[verb, &[&env.path_argument("front"), "--json"]].concat());
        let (mut sent, mut packets) = (Vec::new(), [0; 4096]);
        testkit::wait_until("the end of the program", || {
            if let Ok(len) = scanner.read(&mut packets) {
                line.offer(&packets[..len]);
            }
            sent.extend(line.received());
            program.has_ended()
        });
        let outcome = program.wait();
        sent.extend(line.received());
        println!("{:?}", count_requests(&sent));
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert!(outcome.to_string().to_lowercase().contains("ld19"), "{outcome}");
    }
}

/// Another process reads from the port. Without the error, `probe` would receive only a part of the bytes, and would
/// report the line as damaged.
#[test]
fn error_names_another_reader_of_the_port() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room"]);
    let port = env.path_argument("front");
    let reader = std::fs::File::open(env.path("front")).expect("the port");
    for verb in [&["probe", &port][..], &["configure", &port, "unit=mm"]] {
        let outcome = env.run(&[verb, &["--json"]].concat());
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(4), &"port_busy".into()), "{outcome}");
        let holder = format!("{port}: in use by process {} (", std::process::id());
        assert!(error["message"].as_str().is_some_and(|message| message.starts_with(&holder)), "{error}");
        assert_eq!(error["hint"], "stop it first");
    }
    drop(reader);
    assert_eq!(env.search(&["probe", &port, "--json"]).lines()[0]["model"], "ld19");
}

#[test]
fn interrupt_ends_the_probe() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--fault=mute=1"]);
    let mut probe = env.command(&["probe", &env.path_argument("front"), "--json"]);
    probe.env("SCANHUB_LOG", "off");
    let program = testkit::Program::start(probe);
    testkit::wait_until("an opened port", || {
        let device = env.path("front").canonicalize().unwrap();
        let open = std::fs::read_dir(format!("/proc/{}/fd", program.pid())).into_iter().flatten().flatten();
        open.filter_map(|fd| std::fs::read_link(fd.path()).ok()).any(|target| target == device)
    });
    let outcome = program.end(INT);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(130), &"interrupted".into())
    );
}

#[test]
fn probe_without_a_port_lists_candidates() {
    let env = TestEnv::new();
    let outcome = env.run(&["probe", "--json"]);
    match outcome.exit_code {
        // The result depends on the ports of the machine on which the test runs.
        Some(0) => {
            for line in outcome.lines() {
                assert_eq!(line["class"], "candidate", "{outcome}");
                assert!(line["device"].as_str().is_some_and(|device| device.starts_with("/dev/")), "{line}");
            }
        }
        code => {
            let error = &outcome.of_class("error")[0];
            assert_eq!((code, &error["kind"]), (Some(4), &"port_missing".into()), "{outcome}");
        }
    }
}

#[test]
fn reports_busy_serial_server_with_remedy() {
    let env = TestEnv::new();
    let flags = ["--family=ld", "--model=ld19", "--world=room"];
    let mut simulator = env.start(&[&["simulate", "--json", "--tcp=127.0.0.1:0"], &flags[..]].concat());
    let ready = simulator.await_line("ready", |line| line["class"] == "ready");
    let port = ready["ports"][0]["port"].as_str().expect("its address");
    let other = TestEnv::new();
    let hub = other.hub(&[&format!("--link=front={port}"), "--set=link.front.family=ld"]);
    other.await_info("front", |info| info["state"] == "streaming");
    let busy = |env: &TestEnv| {
        let busy = env.run(&["probe", port, "--json"]);
        let error = &busy.of_class("error")[0];
        assert_eq!((busy.exit_code, &error["kind"]), (Some(4), &"port_busy".into()), "{busy}");
        ["message", "hint"].map(|key| error[key].as_str().unwrap_or_default().to_owned())
    };
    let [_, hint] = busy(&env);
    assert!(hint.contains("end the other program"), "{hint}");
    let [message, hint] = busy(&other);
    let begin = format!("{port}: in use by the hub, process {}; its link front is streaming", hub.pid());
    assert!(message.starts_with(&begin) && hint.starts_with("scanhub info front; "), "{message} {hint}");
    assert_eq!(other.info("front")["state"], "streaming", "the hub does not notice");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    testkit::wait_until("a server without a client", || env.run(&["probe", port]).exit_code == Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}
