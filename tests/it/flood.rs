//! Floods of garbage. Ten megabytes arrive as fast as the hub reads, with a few telegrams among them. The hub publishes
//! each telegram, and its memory does not grow. From a serial server, the hub reads at most twice as many bytes as the
//! line can carry, and it uses little CPU time.

use std::io::Write;
use std::net::TcpListener;
use std::thread;
use std::time::{Duration, Instant};

use crate::testkit::{INT, Program, TERM, TestEnv, TestLine, bytes_of, is_class, number, scan, wait_until};
use fastrand::Rng;

/// Returns garbage that is expensive for a framer: noise, start bytes, and heads of telegrams whose end never arrives.
fn garbage(random: &mut Rng, len: usize) -> Vec<u8> {
    let head = &scan(0)[..7];
    let mut bytes = Vec::with_capacity(len + 64);
    while bytes.len() < len {
        match random.u8(..8) {
            0 => bytes.extend(head),
            1 => bytes.extend([0x02, 0x80].repeat(random.usize(1..20))),
            2 => bytes.extend(&scan(random.u16(..5_000))[..random.usize(7..600)]),
            _ => bytes.extend((0..random.usize(1..200)).map(|_| random.u8(..))),
        }
    }
    bytes.truncate(len);
    // End with zeros, so that the framer does not take the last bytes and the next telegram for one telegram.
    bytes.extend([0; 8]);
    bytes
}

/// Returns the resident memory of a process in kilobytes.
fn resident_kb(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("the hub runs");
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).expect("the status has VmRSS");
    line.split_whitespace().nth(1).and_then(|number| number.parse().ok()).expect("a number")
}

/// Waits for all telegrams in `sent`, in order and with the same bytes. Random bytes can form a telegram, too, because
/// one in 65,536 random checksums is right by chance. The hub must mark each telegram of this kind as suspect. Returns
/// their number.
fn receive(subscriber: &mut Program, sent: &[Vec<u8>]) -> u64 {
    let mut wrong = 0;
    for sent in sent {
        while let line = subscriber.await_line("a telegram in garbage", is_class("telegram"))
            && bytes_of(&line) != *sent
        {
            assert_eq!(line["quality"], "suspect", "{line}");
            wrong += 1;
        }
    }
    wrong
}

#[test]
fn hub_finds_telegrams_in_a_flood_of_garbage() {
    let env = TestEnv::new();
    let line = TestLine::create(&env.path("front"));
    let hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.echo(&["front/telegram"]);
    line.wait_until_open();
    let mut random = Rng::with_seed(4);
    let mut sent = Vec::new();
    let mut flood = |sent: &mut Vec<Vec<u8>>, telegrams: usize| {
        for _ in 0..telegrams {
            line.send(&garbage(&mut random, 200_000));
            sent.push(scan(1000 + sent.len() as u16));
            line.send(&sent[sent.len() - 1]);
        }
    };
    // Send two scans, so that the hub adopts the stream and no longer requests the scanner's mode. (This test does not
    // reply to requests.) During the first flood, the hub touches all memory that it will ever use.
    let steady = scan(0);
    line.send(&[&steady[..], &steady].concat());
    subscriber.await_lines(2, "the stream", is_class("telegram"));
    flood(&mut sent, 10);
    let mut wrong = receive(&mut subscriber, &sent);
    let before_kb = resident_kb(hub.pid());
    let started = sent.len();
    flood(&mut sent, 50);
    wrong += receive(&mut subscriber, &sent[started..]);
    let grown_kb = resident_kb(hub.pid()).saturating_sub(before_kb);
    eprintln!("resident memory: {before_kb} kB, {grown_kb} kB more after {} more bytes", 50 * 200_000);
    assert!(grown_kb <= 64, "the hub grew by {grown_kb} kB");
    let all = 2 + wrong + sent.len() as u64;
    let info = env.await_info("front", |info| number(&info["counters"], "telegrams") >= all);
    assert_eq!(number(&info["counters"], "telegrams"), all, "{info}");
    subscriber.end(INT);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

/// Returns the CPU time that all threads of a process have used so far.
fn cpu_time(pid: u32) -> Duration {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).expect("the hub runs").flatten();
    let of_task = |task: std::fs::DirEntry| {
        let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    };
    Duration::from_nanos(tasks.filter_map(of_task).sum())
}

#[test]
fn garbage_from_a_serial_server_is_throttled() {
    let env = TestEnv::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a TCP port is free");
    let link = format!(
        "--link=front=tcp:{},family=lms",
        listener.local_addr().expect("the listener has an address")
    );
    let hub = env.hub(&[link]);
    let mut subscriber = env.echo(&["front/telegram"]);
    let (mut server, _) = listener.accept().expect("the hub connects");
    // Send telegrams with much garbage between them, so that the hub does not accept all bytes at once. Then send
    // garbage without end.
    let mut random = Rng::with_seed(5);
    let sent: Vec<Vec<u8>> = (0..20).map(|number| scan(1000 + number)).collect();
    let steady = scan(0);
    let mut flood = [&steady[..], &steady].concat();
    for telegram in &sent {
        flood.extend(garbage(&mut random, 15_000));
        flood.extend(telegram);
    }
    let endless = garbage(&mut random, 1 << 20);
    let writer = thread::spawn(move || {
        server.write_all(&flood).expect("the hub reads");
        while server.write_all(&endless).is_ok() {}
    });
    subscriber.await_lines(2, "the stream", is_class("telegram"));
    receive(&mut subscriber, &sent);
    subscriber.end(INT);
    let says = "the server sends more than a line of 500000 baud carries";
    env.await_info("front", |info| info["last_error"].as_str().is_some_and(|error| error.starts_with(says)));
    let bytes = || number(&env.info("front")["counters"], "bytes_read");
    // The counters come from the last status, which is up to a second old. The limit below allows for this.
    let (before, since, idle) = (bytes(), Instant::now(), cpu_time(hub.pid()));
    wait_until("the hub reads a part of the garbage", || bytes() > before + 300_000);
    let worked = cpu_time(hub.pid()).saturating_sub(idle);
    let (read, elapsed) = (bytes() - before, since.elapsed());
    let maximum = 100_000.0 * (elapsed.as_secs_f64() + 2.0);
    let share = worked.as_secs_f64() / elapsed.as_secs_f64();
    eprintln!("{read} bytes in {elapsed:?}, {:.1} % of a processor", 100.0 * share);
    assert!(read as f64 <= maximum, "{read} bytes in {elapsed:?}");
    assert!(share < 0.5, "{:.1} % CPU time in an unoptimized build", 100.0 * share);
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let message_count = outcome.stderr.lines().filter(|line| line.contains(says)).count();
    assert!((1..=2).contains(&message_count), "{outcome}");
    writer.join().expect("the writer ends with the hub");
}
