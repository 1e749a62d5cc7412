//! The server of `web` among many, slow and hostile ones: who behaves well is served at the full rate, memory and processor
//! time stay small, and where the system is short of something it waits, or says so.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread;
use std::time::{Duration, Instant};

use crate::testkit::{INT, PATIENCE, Program, TestEnv, hold_in_time};
use crate::web::{connect, text, view, web};
use rustix::net::sockopt::set_socket_recv_buffer_size;
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};
use serde_json::json;
use tungstenite::{Message, WebSocket};

/// Subscribes to the channel `topic`, which there will be; messages of it that came meanwhile are not counted.
fn subscribe(viewer: &mut WebSocket<TcpStream>, topic: &str) {
    let begun = Instant::now();
    loop {
        assert!(begun.elapsed() < PATIENCE, "there is no {topic}");
        let told = text(viewer);
        let mut channels = told["channels"].as_array().into_iter().flatten();
        if let Some(channel) = channels.find(|channel| channel["topic"] == topic) {
            let one = json!({ "id": 1, "channelId": channel["id"] });
            let wish = json!({ "op": "subscribe", "subscriptions": [one] });
            return viewer.send(Message::text(wish.to_string())).expect("it reads");
        }
    }
}

/// Messages that come within `span`.
fn count(viewer: &mut WebSocket<TcpStream>, span: Duration) -> u32 {
    let (begun, mut count) = (Instant::now(), 0);
    while begun.elapsed() < span {
        count += u32::from(viewer.read().expect("the server lives").is_binary());
    }
    count
}

/// What a process keeps in memory, in kB.
fn memory(of: &Program) -> u64 {
    let text = fs::read_to_string(format!("/proc/{}/status", of.pid())).expect("it lives");
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("a line");
    line.trim().trim_end_matches(" kB").parse().expect("a number")
}

#[test]
fn one_who_reads_slowly_and_a_crowd_cost_the_others_nothing() {
    hold_in_time(crowd);
}

fn crowd() {
    let env = TestEnv::in_time();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (server, host) = web(&env, &[]);
    let mut well = view(&host, "/", None).expect("let in");
    subscribe(&mut well, "/front/scan");
    let mut slow = view(&host, "/", None).expect("let in");
    set_socket_recv_buffer_size(slow.get_ref(), 4096).expect("a small one");
    subscribe(&mut slow, "/front/scan");
    let before = memory(&server);
    let slowly = thread::spawn(move || {
        let mut read = 0;
        for _ in 0..8 {
            // 1 kB a second.
            let mut piece = [0; 1000];
            read += slow.get_mut().read(&mut piece).expect("it is not given up");
            thread::sleep(Duration::from_secs(1));
        }
        (slow, read)
    });
    let rest: Vec<_> = (0..30).map(|_| view(&host, "/", None).expect("let in")).collect();
    let refused = (0..20).map(|_| view(&host, "/", None).err());
    assert!(refused.into_iter().all(|status| status == Some(503)));
    let idle: Vec<_> = (0..148).map(|_| connect(&host)).collect();
    // 37.5 a second.
    let scans = count(&mut well, Duration::from_secs(6));
    assert!(scans >= 215, "{scans} scans in 6 s");
    let (slow, read) = slowly.join().expect("no panic");
    assert!(read > 4000, "{read} bytes");
    let grown = memory(&server).saturating_sub(before);
    assert!(grown < 8192, "{grown} kB more with 200 connections");
    drop((slow, rest, idle));
    assert_eq!(server.end(INT).code, Some(0));
}

#[test]
fn hostile_frames_cost_who_sends_them_his_place_and_others_nothing() {
    hold_in_time(hostile);
}

fn hostile() {
    let env = TestEnv::in_time();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let (server, host) = web(&env, &[]);
    let mut well = view(&host, "/", None).expect("let in");
    subscribe(&mut well, "/front/scan");
    let before = memory(&server);

    // Frames of any bytes; of the client's that are masked or not, whole or cut, of every opcode.
    let mut random = fastrand::Rng::with_seed(25);
    for _ in 0..60 {
        let mut viewer = view(&host, "/", None).expect("let in");
        let mut bytes: Vec<u8> = (0..random.usize(1..4000)).map(|_| random.u8(..)).collect();
        if random.bool() {
            bytes[0] = 0x80 | random.u8(0..16);
        }
        let _ = viewer.get_mut().write_all(&bytes);
    }
    // More subscriptions than there may be, and a message that never ends.
    let mut greedy = view(&host, "/", None).expect("let in");
    let wanted: Vec<_> = (0..400).map(|id| json!({ "id": id, "channelId": 1 })).collect();
    let wish = json!({ "op": "subscribe", "subscriptions": wanted });
    greedy.send(Message::text(wish.to_string())).expect("it reads");
    while greedy.read().is_ok() {}
    let mut endless = view(&host, "/", None).expect("let in");
    let part = [&[0x01, 0xFE, 0x40, 0, 0, 0, 0, 0][..], &[b' '; 0x4000]].concat();
    while endless.get_mut().write_all(&part).is_ok() {}

    // Who does not stop talking is heard no more than the others are served.
    let mut talker = view(&host, "/", None).expect("let in");
    let talk = thread::spawn(move || {
        let (begun, ping) = (Instant::now(), [0x89, 0x80, 0, 0, 0, 0].repeat(2000));
        while begun.elapsed() < Duration::from_secs(5) && talker.get_mut().write_all(&ping).is_ok() {}
    });
    let scans = count(&mut well, Duration::from_secs(4));
    // He has to share one thread with him, and both a processor with other tests.
    assert!(scans >= 30, "{scans} scans in 4 s");
    talk.join().expect("no panic");
    let grown = memory(&server).saturating_sub(before);
    assert!(grown < 8192, "{grown} kB more");
    let outcome = server.end(INT);
    assert!(outcome.code == Some(0) && !outcome.errors.contains("panicked"), "{outcome}");
}

#[test]
fn where_there_are_no_descriptors_the_server_ends() {
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    let (server, host) = web(&env, &[]);
    let mut viewer = view(&host, "/", None).expect("let in");
    subscribe(&mut viewer, "/front/scan");
    count(&mut viewer, Duration::from_secs(1));
    let pid = Pid::from_raw(i32::try_from(server.pid()).expect("a process"));
    let limits = getrlimit(Resource::Nofile);
    let limit = |most: u64| Rlimit { current: Some(most), maximum: limits.maximum };
    // It may not even wait any more: better to end than to serve nobody.
    prlimit(pid, Resource::Nofile, limit(1)).expect("its limit");
    let outcome = server.wait();
    assert!(outcome.code.is_some_and(|code| code != 0), "{outcome}");
    assert!(!outcome.errors.contains("panicked"), "{outcome}");
}
