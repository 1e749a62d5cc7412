//! Datagrams with a key: who has it believes its gateway, and nobody else, and nothing that is sent again.

use std::net::UdpSocket;
use std::os::unix::fs::PermissionsExt;

use crate::testkit::{Outcome, Program, Sender, TERM, TestEnv, USR1, in_a_network, is_class, number, read};
use scanhub_schema::datagram::{Announce, LanFlags, group};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::Value;

const STREAM: [&str; 2] = ["--seed=61", "--baud=500000"];

/// A new key.
fn key(env: &TestEnv, name: &str) -> String {
    let made = env.run(&["key", "new", &env.word(name), "--json"]);
    assert_eq!(made.code, Some(0), "{made}");
    format!("--key-file={}", env.word(name))
}

fn listener(env: &TestEnv, key: &str) -> Program {
    env.start(&["listen", "--json", "--topic=zones", "--topic=scan", key]).ready()
}

/// Datagrams that were refused for this reason.
fn refused(outcome: &Outcome, why: &str) -> u64 {
    number(outcome.of_class("lan_refused").last().expect("the account"), why)
}

/// The line of this class of the account that it gives when asked.
fn asked(program: &mut Program, class: &str) -> Value {
    program.signal(USR1);
    program.await_line(class, is_class(class))
}

/// Datagrams that came to `socket` so far.
fn drain(socket: &UdpSocket) -> Vec<Vec<u8>> {
    let mut buffer = [0; 2000];
    std::iter::from_fn(|| socket.recv(&mut buffer).ok().map(|len| buffer[..len].to_vec())).collect()
}

#[test]
fn who_has_the_key_believes_its_gateway_alone() {
    in_a_network("keyed::who_has_the_key_believes_its_gateway_alone", || {
        let env = TestEnv::new();
        let (ours, other) = (key(&env, "ours"), key(&env, "other"));
        let copy = UdpSocket::bind("127.0.0.1:22299").expect("a port");
        copy.set_nonblocking(true).expect("need not wait");
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        let mut believer = listener(&env, &ours);
        let stranger = listener(&env, &other);
        let gateway = env.gateway(&["--interface=lo", "--to=127.0.0.1:22299", &ours]);
        let scans = believer.await_lines(20, "a scan", is_class("scan"));
        // Somebody without a key.
        let mut sender = Sender::new(5, 7, 0, "front");
        sender.announce(&Topic::ALL);
        sender.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
        assert!(scans.iter().all(|scan| scan["authenticated"] == true && scan["sensor"] == "front"));
        assert_eq!(gateway.end(TERM).code, Some(0));
        let recorded = drain(&copy);
        let next = env.gateway(&["--interface=lo", &ours]);
        believer
            .await_line("the next life", |line| is_class("scan")(line) && line["epoch"] != scans[0]["epoch"]);
        assert_eq!(next.end(TERM).code, Some(0));
        assert!(recorded.iter().all(|bytes| read(bytes).head.flags & LanFlags::AUTHENTICATED != 0));
        // It is sent again to who heard it, and to who has just come.
        let again = |mut program: Program| {
            for bytes in &recorded {
                let topic = Topic::of_number(read(bytes).head.topic);
                sender.to(topic.map_or(Announce::GROUP, group), bytes);
            }
            // What comes after all of it in each of the groups that are heard has arrived after all of it.
            let heard = [Announce::GROUP, group(Topic::Zones), group(Topic::Scan)];
            heard.iter().for_each(|&group| sender.to(group, b"the end"));
            while number(&asked(&mut program, "lan_refused"), "short") < heard.len() as u64 {}
            program.end(TERM)
        };
        let heard = again(believer);
        assert_eq!(refused(&heard, "unauthenticated"), 2, "{heard}");
        // Each of its life is known to be over.
        assert_eq!(refused(&heard, "epoch"), recorded.len() as u64, "{heard}");
        let come_late = again(listener(&env, &ours));
        assert!(
            come_late.of_class("scan").is_empty() && come_late.of_class("zones").is_empty(),
            "{come_late}"
        );
        let stranger = stranger.end(TERM);
        assert!(stranger.of_class("scan").is_empty() && refused(&stranger, "mac") > 20, "{stranger}");
    });
}

#[test]
fn a_key_file_that_others_can_use_is_refused() {
    let env = TestEnv::new();
    let made = env.run(&["key", "new", &env.word("key")]);
    assert!(made.code == Some(0) && String::from_utf8_lossy(&made.out).contains(": key "), "{made}");
    let mode = || std::fs::metadata(env.path("key")).expect("it was made").permissions().mode() & 0o777;
    assert_eq!(mode(), 0o600);
    let again = env.run(&["key", "new", &env.word("key")]);
    assert!(again.code == Some(73) && again.errors.contains("key exists"), "{again}");
    let short = env.file("short", "00ff\n");
    std::fs::set_permissions(env.path("short"), PermissionsExt::from_mode(0o600)).expect("it is ours");
    let open = env.file("open", "0".repeat(64));
    std::fs::set_permissions(env.path("open"), PermissionsExt::from_mode(0o644)).expect("it is ours");
    let missing = env.word("missing");
    for (file, said, code) in
        [(&short, "are no key", 78), (&open, "its mode is 0644", 78), (&missing, "No such file", 66)]
    {
        for verb in [&["listen"][..], &["gateway", "--interface=lo", "--no-system-config"]] {
            let refused = env.run(&[verb, &[&format!("--key-file={file}")]].concat());
            assert!(refused.code == Some(code) && refused.errors.contains(said), "{refused}");
        }
    }
    let bare = format!("--set=gateway.key_file=\"{}\"", env.word("key"));
    let bare = env.run(&["gateway", "--interface=lo", "--no-system-config", "--bare", &bare]);
    assert!(bare.code == Some(78) && bare.errors.contains("no room for a MAC"), "{bare}");
}
