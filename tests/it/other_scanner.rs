//! Tests of a hub whose link has another family than the scanner on the line. Bytes arrive, but the hub cannot decode
//! them.

use std::fs::File;
use std::path::Path;

use scanhub_config::{Config, Sources};
use scanhub_drivers::ld;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{Family, MILLIS, Nanos, Status};
use scanhub_shm::Payload;
use scanhub_sim::Arrival;
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::machine::{self, LmsSimulator, StartState};
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator, RplidarStart};
use serde_json::Value;

use crate::replayed::recorded_rooms::virtual_hub::{VirtualLink, virtual_hub};
use crate::testkit::{INT, TERM, TestEnv};

const REMEDY: &str = "Remove family from link front and restart the hub: it finds the scanner";

/// Flags of `simulate` for scanners that stream, each with two families to which the scanner does not belong. The
/// scanners in [`IDLE_SCANNERS`] wait for requests instead. They include no LDROBOT scanner, which always streams.
const STREAMING_SCANNERS: [(&[&str], [&str; 2]); 3] = [
    (&["--family=ld", "--model=ld19"], ["lms", "rplidar"]),
    (&["--baud=500000", "--state=streaming"], ["ld", "rplidar"]),
    (&["--family=rplidar", "--model=a1", "--state=streaming"], ["lms", "ld"]),
];
const IDLE_SCANNERS: [(&[&str], [&str; 2]); 2] =
    [(&[], ["ld", "rplidar"]), (&["--family=rplidar", "--model=a1"], ["lms", "ld"])];

/// Calls `check` concurrently for each scanner with each of its wrong families.
fn check_each_scanner(scanners: &[(&[&str], [&str; 2])], check: impl Fn(&[&str], &str) + Sync) {
    std::thread::scope(|scope| {
        let cases =
            scanners.iter().flat_map(|(simulated, families)| families.map(|family| (*simulated, family)));
        for (simulated, family) in cases {
            let check = &check;
            scope.spawn(move || check(simulated, family));
        }
    });
}

#[test]
fn reports_byte_rate_of_a_scanner_of_another_family() {
    check_each_scanner(&STREAMING_SCANNERS, |simulated, family| {
        let missing = match family {
            "lms" => "LMS replies",
            "ld" => "LDROBOT packets",
            _ => "RPLIDAR replies",
        };
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &[&["--seed=43"], simulated].concat());
        let hub = env.hub(&[format!("{},family={family}", env.link("front"))]);
        let message = format!(" bytes/s arrive, but no {missing}; is it another scanner? {REMEDY}");
        let error = |info: &Value| info["last_error"].as_str().unwrap_or_default().to_owned();
        let info = env.await_info("front", |info| error(info).contains(" bytes/s arrive"));
        let error = error(&info);
        let rate = error.strip_suffix(&message).unwrap_or_else(|| panic!("{message}: {info}"));
        let rate: u64 = rate.replace(',', "").parse().unwrap_or_else(|_| panic!("{info}"));
        assert!((100..50_000).contains(&rate), "{info}");
        let outcome = hub.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        for wrong in ["no reply", "power, cable"] {
            assert!(!outcome.stderr.contains(wrong), "{outcome}");
        }
    });
}

#[test]
fn silent_line_error_suggests_probe() {
    check_each_scanner(&IDLE_SCANNERS, |simulated, family| {
        let message = match family {
            "lms" => "no reply at 9600, 19200, 38400 or 500000 baud",
            "ld" => "no packets at 230400 and 921600 baud",
            _ => "no reply at 115200, 256000, 460800 and 1000000 baud",
        };
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], simulated);
        let _hub = env.hub(&[format!("{},family={family}", env.link("front"))]);
        let error = |info: &Value| info["last_error"].as_str().unwrap_or_default().to_owned();
        let info = env.await_info("front", |info| error(info).starts_with(message));
        let remedy = error(&info).split_once(" Another scanner? ").map(|(_, remedy)| remedy.to_owned());
        let is_probe = |remedy: &String| {
            let port = remedy.split_once("top the hub and try: scanhub probe ").map(|(_, port)| port);
            port.is_some_and(|port| {
                Path::new(port).canonicalize().ok() == env.path("front").canonicalize().ok()
            })
        };
        assert!(remedy.as_ref().is_some_and(is_probe), "{info}");
    });
}

/// `doctor` tries only the family that a link names, and `configure` writes only to an LMS. Both therefore suggest
/// `probe`.
#[test]
fn doctor_and_configure_suggest_scanhub_probe() {
    let try_this = |port: &str| format!("is it another scanner? Try: scanhub probe {port}; ");
    let check = |simulated: &[&str], family: &str| {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &[&["--seed=43"], simulated].concat());
        let (port, link) = (env.path_argument("front"), format!("{},family={family}", env.link("front")));
        let outcome = env.run(&["doctor", &port, &link, "--json", "--no-system-config"]);
        assert_eq!(outcome.exit_code, Some(5), "{outcome}");
        let findings = outcome.of_class("check");
        let sensor = findings.iter().find(|line| line["name"] == "sensor").expect("the check of the sensor");
        let remedy = sensor["remedy"].as_str().expect("a string");
        assert!(sensor["state"] == "failed" && remedy.starts_with(&try_this(&port)), "{sensor}");
        if family == "lms" {
            let outcome = env.run(&["configure", &port, "unit=mm", "--json"]);
            let failure = &outcome.of_class("error")[0];
            let hint = failure["hint"].as_str().expect("a string");
            assert!(outcome.exit_code == Some(3) && hint.starts_with(&try_this(&port)), "{outcome}");
        }
        // The suggested command finds the scanner.
        assert_eq!(env.search(&["probe", &port, "--json"]).exit_code, Some(0));
    };
    check_each_scanner(&STREAMING_SCANNERS, check);
    check_each_scanner(&IDLE_SCANNERS, check);
}

/// While a hub uses a port, `probe` cannot search the port, and its message names two remedies. After the hub has been
/// stopped, the suggested command finds the scanner. Without the key `family`, a hub finds the scanner, too.
#[test]
fn refusal_of_a_busy_port_shows_hub_error_and_remedy() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    let _simulator = env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room"]);
    let (port, name) = (env.path_argument("front"), env.domain().name().to_owned());
    let hub = env.hub(&[format!("{},family=lms", env.link("front"))]);
    let error = |info: &Value| info["last_error"].as_str().unwrap_or_default().to_owned();
    let info = env.await_info("front", |info| error(info).ends_with(REMEDY));
    let stop = format!("stop the hub: kill {}", hub.pid());
    let refused = |env: &TestEnv, verb: &[&str]| {
        let outcome = env.run(&[verb, &["--json"]].concat());
        let failure = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &failure["kind"]), (Some(4), &"port_busy".into()), "{outcome}");
        ["message", "hint"].map(|key| failure[key].as_str().expect("a string").to_owned())
    };
    for verb in [&["probe", &port][..], &["configure", &port, "unit=mm"]] {
        let [message, hint] = refused(&env, verb);
        let begin = format!("{port}: in use by the hub, process {}; its link front is ", hub.pid());
        let remedy = "is it another scanner? Remove family from link front";
        assert!(message.starts_with(&begin) && message.contains(remedy), "{message}");
        assert_eq!(hint, format!("scanhub info front; before another program may use the port, {stop}"));
    }
    // From another domain, the suggested command names the domain of the hub.
    let [message, hint] = refused(&other, &["probe", &port]);
    assert!(
        message.contains("in use by the hub, process ") && message.contains("its link front"),
        "{message}"
    );
    assert!(hint.contains(&format!(" info --domain {name} ")) && hint.ends_with(&stop), "{hint}");

    let doctor = |env: &TestEnv, port: &str| {
        let outcome = env.run(&["doctor", port, "--json", "--no-system-config"]);
        assert_eq!(outcome.exit_code, Some(5), "{outcome}");
        let findings = outcome.of_class("check");
        let of = |name: &str| {
            let found = findings.iter().find(|line| line["name"] == name && !line["port"].is_null());
            found.unwrap_or_else(|| panic!("no {name}: {outcome}")).clone()
        };
        [of("holder"), of("sensor")]
    };
    for (env, port) in [(&env, &port), (&env, &"front".to_owned()), (&other, &port)] {
        let [holder, sensor] = doctor(env, port);
        let text = |line: &Value, key: &str| line[key].as_str().unwrap_or_default().to_owned();
        assert!(text(&holder, "finding").contains(&format!("process {}", hub.pid())), "{holder}");
        assert!(text(&sensor, "finding").contains("is it another scanner? Remove family"), "{sensor}");
        let next = format!("or stop the hub (kill {}), then search the port: scanhub probe ", hub.pid());
        assert!(sensor["state"] == "failed" && text(&sensor, "remedy").contains(&next), "{sensor}");
        assert!(text(&sensor, "remedy").contains(" info "), "{sensor}");
    }

    // Another process (this test) now also reads from the port, and takes bytes away from the hub.
    let reader = File::options().read(true).open(env.path("front")).expect("the port");
    let [message, hint] = refused(&env, &["probe", &port]);
    let process = format!("process {} (", std::process::id());
    assert!(message.contains(&format!(", and read by {process}")), "{message}");
    assert!(hint.starts_with(&format!("end {process}")) && hint.ends_with(&stop), "{hint}");
    drop(reader);

    assert_eq!(hub.end(TERM).exit_code, Some(0), "{info}");
    // Each of the two remedies works: `probe` finds the scanner, and so does a hub without `family`.
    assert_eq!(env.search(&["probe", &port, "--json"]).lines()[0]["model"], "ld19");
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming" && info["model"] == "ld19");
}

/// Returns streaming scanners, each with the name that the hub's message has for it.
fn scanners() -> [(&'static str, Box<dyn Device>); 3] {
    let room = || Room::new(&"room".parse().expect("a world"), 7);
    let head = LdSettings { seed: 7, ..LdSettings::of(ld::Model::Ld19) };
    let machine = machine::Settings {
        baud: Baud::B500000,
        start: StartState::Operating(OperatingMode::All),
        seed: 7,
        ..machine::Settings::default()
    };
    let unit = RplidarSettings { start: RplidarStart::Streaming, seed: 7, ..RplidarSettings::of(Model::A1) };
    [
        ("ld19", Box::new(LdSimulator::new(head, room()))),
        (
            "lms scanner",
            Box::new(LmsSimulator::new(machine, scanhub_sim::operating::ScanSource::Room(room()))),
        ),
        ("a1", Box::new(RplidarSimulator::new(unit, room()))),
    ]
}

/// Connects `device` to a link of the hub from `begin` to `end`. Bytes arrive intact at every baud rate that the hub
/// sets. Calls `note` with the time after each step of 10 ms.
fn connect(
    device: &mut dyn Device,
    link: &mut VirtualLink<'_>,
    (begin, end): (Nanos, Nanos),
    mut note: impl FnMut(Nanos),
) {
    for now in (begin..end).step_by(10 * MILLIS as usize) {
        let mut bytes = Vec::new();
        while let Some(chunk) = device.poll_transmit(now) {
            bytes.extend(chunk.bytes);
        }
        // Discard what the device sent before it was connected.
        link.read(now, if now == begin { &[] } else { &bytes });
        for (number, byte) in link.take_written().into_iter().enumerate() {
            device.receive(byte, Arrival::at(now + number as Nanos * MILLIS / 4));
        }
        note(now);
    }
}

const ONE_SECOND: Nanos = 1_000 * MILLIS;
/// Time at which the scanner is replaced by another one.
const REPLACED_AT: Nanos = 10 * ONE_SECOND;

/// Time at which a status was received, and the family and the last error in the status.
type ReportedStatus = (Nanos, Option<Family>, String);

/// Runs a hub in virtual time until `end`. At first, the scanner with the index `number` streams. At [`REPLACED_AT`],
/// the next scanner replaces it on the same line. `keys` are added to the link. Returns the name of the first scanner
/// and all published statuses.
fn replace_scanner(keys: &str, number: usize, end: Nanos) -> (&'static str, Vec<ReportedStatus>) {
    let env = TestEnv::new();
    let (name, mut first) = scanners().into_iter().nth(number).expect("one of three scanners");
    let (_, mut second) = scanners().into_iter().nth((number + 1) % 3).expect("one of three scanners");
    let sources = Sources { links: vec![format!("a=/dev/none{keys}")], ..Sources::default() };
    let config = Config::load(&sources).expect("a configuration");
    let domain = env.domain();
    let driven = virtual_hub(&config, &domain, |links| {
        let node = scanhub_shm::client_node(&domain).expect("a node");
        let topic = Status::open(&node, "a").expect("a topic").expect("an existing topic");
        let statuses = Status::subscriber(&node, &topic).expect("a subscriber");
        let mut reported = Vec::new();
        let mut note = |now: Nanos| {
            while let Ok(Some(sample)) = Status::receive(&statuses) {
                let status = Status::read(&sample);
                reported.push((now, status.family(), status.last_error().to_owned()));
            }
        };
        connect(&mut *first, &mut links[0], (0, REPLACED_AT), &mut note);
        connect(&mut *second, &mut links[0], (REPLACED_AT, end), &mut note);
        reported
    });
    (name, driven.expect("the domain is free"))
}

/// Asserts that the hub reports within 4 s that the scanner `name` was replaced. The report must have the remedy
/// `remedy`, and the hub must never report damage on the line.
fn check_replacement(name: &str, remedy: &str, reported: &[ReportedStatus]) {
    let message =
        format!(" bytes/s arrive, but nothing from the {name}: another scanner, or a damaged line? {remedy}");
    let is_soon = |(now, ..): &&ReportedStatus| (REPLACED_AT..REPLACED_AT + 4 * ONE_SECOND).contains(now);
    let mut soon = reported.iter().filter(is_soon);
    assert!(soon.any(|(.., error)| error.ends_with(&message)), "{message}: {reported:#?}");
    let is_damaged = reported.iter().any(|(.., error)| error.contains("damaged on the line"));
    assert!(!is_damaged, "{name}: {reported:#?}");
}

#[test]
fn replaced_scanner_is_not_reported_as_damaged_line() {
    for number in 0..3 {
        let (name, reported) = replace_scanner("", number, 35 * ONE_SECOND);
        check_replacement(name, "The search begins after 10 s without it", &reported);
        let before = reported.iter().rfind(|(now, ..)| *now < REPLACED_AT).and_then(|(_, family, _)| *family);
        let (_, family, error) = reported.last().expect("a status");
        assert!(before.is_some() && family.is_some() && before != *family, "{name}: {reported:#?}");
        assert_eq!(error, "", "{name}: {reported:#?}");
    }
    for key in ["family=ld", "model=ld19"] {
        let (name, reported) = replace_scanner(&format!(",{key}"), 0, 16 * ONE_SECOND);
        let key = key.split('=').next().expect("the name of a key");
        let remedy = format!("Remove {key} from link a and restart the hub: it finds the scanner");
        check_replacement(name, &remedy, &reported);
    }
}

/// `doctor` without arguments checks the links of the running hub.
#[test]
fn doctor_reports_each_link_of_the_running_hub() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room"]);
    let server = std::net::TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr());
    let server = format!("tcp:{}", server.expect("a free port"));
    let scan = format!("FLASER 181{} 0 0 0 0 0 0 1.5 host 1.5\n", " 1.5".repeat(181));
    let log = env.file("walk.log", scan);
    let links = [
        env.link("front"),
        env.link("absent"),
        format!("--link=side={server}"),
        format!("--link=walk=file:{log}"),
    ];
    let hub = env.hub(&links);
    env.await_info("front", |info| info["state"] == "streaming");
    env.await_info("walk", |info| info["state"] == "silent");
    env.await_info("side", |info| info["last_error"].as_str().is_some_and(|error| error.contains("refused")));
    let outcome = env.run(&["doctor", "--json", "--no-system-config"]);
    assert_eq!(outcome.exit_code, Some(5), "{outcome}");
    let findings = outcome.of_class("check");
    for (link, port, state, message) in [
        ("front", env.path_argument("front"), "ok", "link front of the hub: streaming, family ld, LD19"),
        ("absent", env.path_argument("absent"), "failed", "link absent of the hub: absent"),
        ("side", server.clone(), "failed", "connection refused; nothing listens there"),
        ("walk", format!("file:{log}"), "ok", "link walk of the hub: silent"),
    ] {
        let found = findings.iter().find(|line| line["name"] == "sensor" && line["link"] == link);
        let found = found.unwrap_or_else(|| panic!("no {link}: {outcome}"));
        let text = |key: &str| found[key].as_str().unwrap_or_default();
        assert_eq!((text("state"), text("port")), (state, &port[..]), "{found}");
        assert!(text("finding").contains(message), "{found}");
        assert!(text("state") == "ok" || text("remedy").contains(&format!("scanhub info {link}")), "{found}");
    }
    let text = env.run(&["doctor", "--no-system-config"]).to_string();
    assert!(text.contains(&format!("{server} (link side)")), "{text}");
    // If `doctor` has a configuration, it checks the links of the configuration in addition to the links of the running
    // hub.
    let named = env.run(&["doctor", "--json", "--no-system-config", &env.link("front"), &env.link("rear")]);
    let findings = named.of_class("check");
    let links = ["front", "rear", "absent", "side"];
    let count = |link: &&str| {
        findings
            .iter()
            .filter(|line| {
                line["link"] == **link && ["port", "holder"].contains(&line["name"].as_str().unwrap_or(""))
            })
            .count()
    };
    assert!(links.iter().all(|link| count(link) > 0), "{named}");
    assert_eq!(hub.end(INT).exit_code, Some(0));
}
