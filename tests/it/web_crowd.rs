//! Tests of the server of `web` with many, slow and hostile viewers: the server serves well-behaved viewers, and uses
//! little memory and CPU time. When a resource of the system runs out, the server reports this and waits. Messages can
//! be counted only in `clients/viewer/tests/crowd.rs`. That file tests that no viewer misses a message because of other
//! viewers.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crate::testkit::{INT, Program, TestEnv, WAIT_TIMEOUT, is_class, wait_until};
use crate::web::{channels, connect, connect_viewer, status, subscribe, web};
use rustix::net::sockopt::set_socket_recv_buffer_size;
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};
use serde_json::json;
use tungstenite::{Message, WebSocket};

/// Waits for the channel `topic` and subscribes to it.
fn subscribe_to(viewer: &mut WebSocket<TcpStream>, topic: &str) {
    let [channel] = channels(viewer, [topic]);
    subscribe(viewer, &[(1, &channel["id"])]);
}

/// Sets its flag when it is dropped, even in a panic.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Receives `count` messages. Panics if one of them takes longer than the timeout.
fn await_messages(viewer: &mut WebSocket<TcpStream>, count: u32) {
    for number in 1..=count {
        let give_up_at = Instant::now() + WAIT_TIMEOUT;
        while !viewer.read().expect("an open connection").is_binary() {
            assert!(Instant::now() < give_up_at, "message {number} of {count} did not arrive in time");
        }
    }
}

/// Returns the resident memory of a process in kilobytes.
fn memory(of: &Program) -> u64 {
    let text =
        fs::read_to_string(format!("/proc/{}/status", of.pid())).expect("the status of a running process");
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("a line");
    line.trim().trim_end_matches(" kB").parse().expect("a number")
}

#[test]
fn slow_viewer_and_full_server_do_not_block_others() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (server, host) = web(&env, &[]);
    let mut reader = connect_viewer(&host, "/", None).expect("an accepted viewer");
    subscribe_to(&mut reader, "/front/scan");
    let mut slow = connect_viewer(&host, "/", None).expect("an accepted viewer");
    set_socket_recv_buffer_size(slow.get_ref(), 4096).expect("a small receive buffer");
    subscribe_to(&mut slow, "/front/scan");
    let before = memory(&server);
    let rest: Vec<_> =
        (0..30).map(|_| connect_viewer(&host, "/", None).expect("an accepted viewer")).collect();
    let refused = (0..20).map(|_| connect_viewer(&host, "/", None).err());
    assert!(refused.into_iter().all(|status| status == Some(503)));
    let idle: Vec<_> = (0..148).map(|_| connect(&host)).collect();
    let mut read = 0;
    for _ in 0..8 {
        // The slow viewer reads 1 kB while the other viewer reads 12 messages (15 kB).
        await_messages(&mut reader, 12);
        read += slow.get_mut().read(&mut [0; 1000]).expect("an open connection");
    }
    assert!(read > 4000, "{read} bytes");
    let grown = memory(&server).saturating_sub(before);
    assert!(grown < 8192, "{grown} kB more with 200 connections");
    drop((slow, rest, idle));
    assert_eq!(server.end(INT).exit_code, Some(0));
}

#[test]
fn hostile_frames_do_not_disturb_other_viewers() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (server, host) = web(&env, &[]);
    let mut reader = connect_viewer(&host, "/", None).expect("an accepted viewer");
    subscribe_to(&mut reader, "/front/scan");
    let before = memory(&server);

    // Send frames of random bytes: with and without a mask, complete and truncated, with every opcode.
    let mut random = fastrand::Rng::with_seed(25);
    for _ in 0..60 {
        let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
        let mut bytes: Vec<u8> = (0..random.usize(1..4000)).map(|_| random.u8(..)).collect();
        if random.bool() {
            bytes[0] = 0x80 | random.u8(0..16);
        }
        let _ = viewer.get_mut().write_all(&bytes);
    }
    // Send more subscriptions than the server allows, and then a message that never ends.
    let mut greedy = connect_viewer(&host, "/", None).expect("an accepted viewer");
    let expected: Vec<_> = (0..400).map(|id| json!({ "id": id, "channelId": 1 })).collect();
    let wish = json!({ "op": "subscribe", "subscriptions": expected });
    greedy.send(Message::text(wish.to_string())).expect("a sent message");
    while greedy.read().is_ok() {}
    let mut endless = connect_viewer(&host, "/", None).expect("an accepted viewer");
    let part = [&[0x01, 0xFE, 0x40, 0, 0, 0, 0, 0][..], &[b' '; 0x4000]].concat();
    while endless.get_mut().write_all(&part).is_ok() {}

    // A viewer that sends without pause must not keep the server from serving the others.
    let mut talker = connect_viewer(&host, "/", None).expect("an accepted viewer");
    talker.get_ref().set_write_timeout(Some(WAIT_TIMEOUT)).expect("a timeout");
    let (is_served, sent) = (AtomicBool::new(false), AtomicUsize::new(0));
    thread::scope(|scope| {
        scope.spawn(|| {
            let ping = [0x89, 0x80, 0, 0, 0, 0].repeat(2000);
            while !is_served.load(Ordering::Relaxed) && talker.get_mut().write_all(&ping).is_ok() {
                sent.fetch_add(ping.len(), Ordering::Relaxed);
            }
        });
        let end = SetOnDrop(&is_served);
        await_messages(&mut reader, 60);
        wait_until("the server reads pings", || sent.load(Ordering::Relaxed) > 0);
        drop(end);
    });
    let grown = memory(&server).saturating_sub(before);
    assert!(grown < 8192, "{grown} kB more");
    let outcome = server.end(INT);
    assert!(outcome.exit_code == Some(0) && !outcome.stderr.contains("panicked"), "{outcome}");
}

/// Lowers the limit of the running server, so that it gets only descriptors below `max`.
fn limit_descriptors(server: &Program, max: u64) {
    let pid = Pid::from_raw(i32::try_from(server.pid()).expect("a process"));
    let limit = Rlimit { current: Some(max), maximum: getrlimit(Resource::Nofile).maximum };
    prlimit(pid, Resource::Nofile, limit).expect("permission to set the limit");
}

/// Topics to which the server subscribes as long as no viewer requests lines.
const SERVER_TOPICS: [&str; 6] =
    ["front/scan", "front/marks", "front/zones", "front/foreground", "front/background", "front/status"];

/// Returns the lowest descriptor number that the server does not use.
fn next_descriptor(server: &Program) -> u64 {
    let open = |number: &u64| !Path::new(&format!("/proc/{}/fd/{number}", server.pid())).exists();
    (0..).find(open).expect("an unused descriptor")
}

/// Returns the CPU time that the server has used.
fn cpu_time(server: &Program) -> Duration {
    let text = fs::read_to_string(format!("/proc/{}/stat", server.pid()))
        .expect("the counters of a running process");
    let fields: Vec<&str> = text.rsplit_once(") ").expect("a name").1.split(' ').collect();
    let ticks: u64 = fields[11..13].iter().map(|field| field.parse::<u64>().expect("a number")).sum();
    // There are 100 ticks per second (proc(5)) on all platforms of this project.
    Duration::from_millis(10 * ticks)
}

#[test]
fn new_viewer_waits_while_descriptors_are_short() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (mut server, host) = web(&env, &[]);
    let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
    subscribe_to(&mut viewer, "/front/scan");
    // Subscriptions take descriptors, too, so wait for all of them before the limit is lowered.
    wait_until("all subscriptions", || SERVER_TOPICS.iter().all(|topic| env.subscribers(topic) > 0));
    await_messages(&mut viewer, 5);
    limit_descriptors(&server, next_descriptor(&server));
    let mut late = connect(&host);
    late.write_all(format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n").as_bytes())
        .expect("room in the backlog");
    let short = server.await_line("the report of a shortage", is_class("web_short"));
    assert!(short["message"].as_str().is_some_and(|text| text.contains("cannot accept viewers")), "{short}");
    assert!(short["hint"].as_str().is_some_and(|text| text.contains("ulimit -n")), "{short}");
    let (started, before) = (Instant::now(), cpu_time(&server));
    await_messages(&mut viewer, 80);
    // While a connection waits for a descriptor, the server must sleep. Otherwise it would use all of the CPU time.
    let (worked, elapsed) = (cpu_time(&server) - before, started.elapsed());
    assert!(worked < elapsed / 2, "{worked:?} of {elapsed:?}");
    limit_descriptors(&server, 1024);
    let mut answer = String::new();
    late.read_to_string(&mut answer).expect("the page");
    assert_eq!(status(&answer), "200");
    assert_eq!(server.end(INT).exit_code, Some(0));
}

#[test]
fn descriptor_shortage_of_a_topic_spares_others() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (mut server, host) = web(&env, &[]);
    let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
    let [scan, lines] = channels(&mut viewer, ["/front/scan", "/lines"]);
    subscribe(&mut viewer, &[(1, &scan["id"])]);
    wait_until("all subscriptions", || SERVER_TOPICS.iter().all(|topic| env.subscribers(topic) > 0));
    await_messages(&mut viewer, 5);
    limit_descriptors(&server, next_descriptor(&server));
    // When a viewer requests lines, the server subscribes to topic `lines`, for which it now lacks descriptors.
    subscribe(&mut viewer, &[(2, &lines["id"])]);
    let short = server.await_line("the report of a shortage", is_class("web_short"));
    assert!(
        short["message"].as_str().is_some_and(|text| text.contains("front/lines is not served")),
        "{short}"
    );
    assert!(!short["hint"].as_str().unwrap_or_default().is_empty(), "{short}");
    await_messages(&mut viewer, 80);
    assert_eq!(env.subscribers("front/lines"), 0);
    limit_descriptors(&server, 1024);
    wait_until("a subscription to lines", || env.subscribers("front/lines") > 0);
    let outcome = server.end(INT);
    assert!(outcome.exit_code == Some(0) && outcome.stderr.is_empty(), "{outcome}");
}

#[test]
fn server_exits_without_descriptors() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    let (server, host) = web(&env, &[]);
    let mut viewer = connect_viewer(&host, "/", None).expect("an accepted viewer");
    subscribe_to(&mut viewer, "/front/scan");
    await_messages(&mut viewer, 5);
    // Without any descriptor, the server cannot even wait, so it ends.
    limit_descriptors(&server, 1);
    let outcome = server.wait();
    assert!(outcome.exit_code.is_some_and(|code| code != 0), "{outcome}");
    assert!(!outcome.stderr.contains("panicked"), "{outcome}");
}
