//! Datagrams with a key: a listener with the key accepts each datagram of its gateway once, and no other datagrams.

use std::net::UdpSocket;
use std::os::unix::fs::PermissionsExt;

use crate::testkit::{
    Outcome, Program, TERM, TestEnv, TestGateway, USR1, decode_datagram, in_a_network, is_class, number,
};
use scanhub_schema::datagram::{Announce, LanFlags, group};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::Value;

const STREAM_FLAGS: [&str; 2] = ["--seed=61", "--baud=500000"];

/// Creates a key file, and returns the command-line flag that names the file.
fn key(env: &TestEnv, name: &str) -> String {
    let made = env.run(&["key", "new", &env.path_argument(name), "--json"]);
    assert_eq!(made.exit_code, Some(0), "{made}");
    format!("--key-file={}", env.path_argument(name))
}

fn listener(env: &TestEnv, key: &str) -> Program {
    env.start(&["listen", "--json", "--topic=zones", "--topic=scan", key]).ready()
}

/// Returns the number of datagrams that the listener refused for this reason.
fn refusal_count(outcome: &Outcome, reason: &str) -> u64 {
    number(outcome.of_class("lan_refused").last().expect("the statistics have a line of refusals"), reason)
}

/// Requests statistics from `program`, and returns the line of class `class`.
fn request_statistics(program: &mut Program, class: &str) -> Value {
    program.signal(USR1);
    program.await_line(class, is_class(class))
}

/// Returns the datagrams that have arrived at `socket` so far.
fn drain(socket: &UdpSocket) -> Vec<Vec<u8>> {
    let mut buffer = [0; 2000];
    std::iter::from_fn(|| socket.recv(&mut buffer).ok().map(|len| buffer[..len].to_vec())).collect()
}

#[test]
fn listener_with_key_accepts_only_its_gateway() {
    in_a_network("keyed::listener_with_key_accepts_only_its_gateway", || {
        let env = TestEnv::new();
        let (ours, other) = (key(&env, "ours"), key(&env, "other"));
        let copy = UdpSocket::bind("127.0.0.1:22299").expect("a port");
        copy.set_nonblocking(true).expect("the socket can be made nonblocking");
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let mut with_key = listener(&env, &ours);
        let with_other_key = listener(&env, &other);
        let gateway = env.gateway(&["--interface=lo", "--to=127.0.0.1:22299", &ours]);
        let scans = with_key.await_lines(20, "a scan", is_class("scan"));
        // Another sender has no key, so the listener must refuse its datagrams.
        let mut sender = TestGateway::new(5, 7, 0, "front");
        sender.announce(&Topic::ALL);
        sender.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
        assert!(scans.iter().all(|scan| scan["authenticated"] == true && scan["sensor"] == "front"));
        assert_eq!(gateway.end(TERM).exit_code, Some(0));
        let recorded = drain(&copy);
        let next = env.gateway(&["--interface=lo", &ours]);
        with_key.await_line("sample of the next run", |line| {
            is_class("scan")(line) && line["epoch"] != scans[0]["epoch"]
        });
        assert_eq!(next.end(TERM).exit_code, Some(0));
        assert!(
            recorded.iter().all(|bytes| decode_datagram(bytes).head.flags & LanFlags::AUTHENTICATED != 0)
        );
        // Send the recorded datagrams again. They go to the listener that has already received them, and to a new
        // listener.
        let replay = |mut program: Program| {
            for bytes in &recorded {
                let topic = Topic::of_number(decode_datagram(bytes).head.topic);
                sender.send_to_group(topic.map_or(Announce::GROUP, group), bytes);
            }
            // A datagram that is too short, sent to each group that the listener has joined, marks the end. As soon as
            // the listener has counted these short datagrams, it has processed all earlier ones.
            let groups = [Announce::GROUP, group(Topic::Zones), group(Topic::Scan)];
            groups.iter().for_each(|&group| sender.send_to_group(group, b"the end"));
            while number(&request_statistics(&mut program, "lan_refused"), "short") < groups.len() as u64 {}
            program.end(TERM)
        };
        let replayed = replay(with_key);
        assert_eq!(refusal_count(&replayed, "unauthenticated"), 2, "{replayed}");
        // The gateway has restarted since, so the listener has seen a later epoch. It refuses all of these datagrams.
        assert_eq!(refusal_count(&replayed, "epoch"), recorded.len() as u64, "{replayed}");
        let late_joiner = replay(listener(&env, &ours));
        assert!(
            late_joiner.of_class("scan").is_empty() && late_joiner.of_class("zones").is_empty(),
            "{late_joiner}"
        );
        let outcome_of_other_key = with_other_key.end(TERM);
        assert!(
            outcome_of_other_key.of_class("scan").is_empty()
                && refusal_count(&outcome_of_other_key, "mac") > 20,
            "{outcome_of_other_key}"
        );
    });
}

#[test]
fn key_file_that_others_can_use_is_refused() {
    let env = TestEnv::new();
    let made = env.run(&["key", "new", &env.path_argument("key")]);
    assert!(made.exit_code == Some(0) && String::from_utf8_lossy(&made.stdout).contains(": key "), "{made}");
    let mode =
        || std::fs::metadata(env.path("key")).expect("the key file exists").permissions().mode() & 0o777;
    assert_eq!(mode(), 0o600);
    let again = env.run(&["key", "new", &env.path_argument("key")]);
    assert!(again.exit_code == Some(73) && again.stderr.contains("key exists"), "{again}");
    let short = env.file("short", "00ff\n");
    std::fs::set_permissions(env.path("short"), PermissionsExt::from_mode(0o600))
        .expect("the file belongs to this user");
    let open = env.file("open", "0".repeat(64));
    std::fs::set_permissions(env.path("open"), PermissionsExt::from_mode(0o644))
        .expect("the file belongs to this user");
    let missing = env.path_argument("missing");
    for (file, message, code) in
        [(&short, "are not a key", 78), (&open, "its mode is 0644", 78), (&missing, "No such file", 66)]
    {
        for verb in [&["listen"][..], &["gateway", "--interface=lo", "--no-system-config"]] {
            let refused = env.run(&[verb, &[&format!("--key-file={file}")]].concat());
            assert!(refused.exit_code == Some(code) && refused.stderr.contains(message), "{refused}");
        }
    }
    let bare = format!("--set=gateway.key_file=\"{}\"", env.path_argument("key"));
    let bare = env.run(&["gateway", "--interface=lo", "--no-system-config", "--bare", &bare]);
    assert!(bare.exit_code == Some(78) && bare.stderr.contains("no room for a MAC"), "{bare}");
}
