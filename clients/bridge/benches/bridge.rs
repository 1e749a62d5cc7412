//! Benchmark of a bridge: its costs and its losses. Routers are bridges that listen. The parts are:
//! - `hop`: the time of a scan from shared memory to a plain Zenoh client behind a router, compared with the time from
//!   a plain Zenoh publisher
//! - `killed`: losses and recovery while a router is killed repeatedly
//! - `slow`: the age of scans and the losses on a link of 0.5 Mbit/s and 100 ms each way
//! - `stalls`: the same as `slow`, but the link forwards nothing for 2 s of every 20 s
//! - `loss`: losses and CPU time with all topics of two sensors through a router, for MINUTES
//! - `plain`: the losses of a plain Zenoh subscriber behind a router with Zenoh's own configuration, for MINUTES
//!
//! The bench does not measure a real network.
//!
//! To run it after `cargo build --release`:
//! `cargo bench -p scanhub-bridge --bench bridge [-- MINUTES] [hop|killed|slow|stalls|loss|plain ..]`. By default,
//! MINUTES is 10, and all parts run.

mod environment;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::streams::{Session, Source};
use scanhub_client::{Flags, Topic, clock};
use scanhub_schema::datagram::{Datagram, HEADER_LEN, Head};
use serde_json::Value;
use socket2::{Domain, Protocol, Socket, Type};
use zenoh::Wait;

use environment::{
    BenchEnvironment, SENSORS, SendTimes, free_port, percentile, session, wait_until_listening,
};
use zenoh::sample::Sample;

/// A row of the result table.
struct TableRow {
    name: String,
    value: String,
    /// The target, and whether it was met.
    target: Option<(&'static str, bool)>,
}

fn row(name: &str, value: impl Into<String>, target: Option<(&'static str, bool)>) -> TableRow {
    TableRow { name: name.to_owned(), value: value.into(), target }
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with("--")).collect();
    let minutes = words.iter().find_map(|word| word.parse().ok()).unwrap_or(10.0);
    let is_selected = |part: &str| words.iter().all(|word| word.parse::<f64>().is_ok() || word == part);
    type Measurement<'a> = (&'static str, &'a dyn Fn(&BenchEnvironment) -> Vec<TableRow>);
    let parts: [Measurement<'_>; 6] = [
        ("hop", &latency),
        ("killed", &killed_router),
        ("slow", &|environment| slow_link(environment, None)),
        ("stalls", &|environment| {
            slow_link(environment, Some(StallPattern { interval: STALL_INTERVAL, length: STALL_TIME }))
        }),
        ("loss", &|environment| loss(environment, minutes)),
        ("plain", &|environment| plain_router(environment, minutes)),
    ];
    for (name, part) in parts {
        if is_selected(name) || words.iter().any(|word| word == name) {
            let Some(environment) = BenchEnvironment::new(name) else { return };
            for TableRow { name: what, value, target } in part(&environment) {
                let target = target.map_or(String::new(), |(target, is_met)| {
                    format!(" ({target}: {})", if is_met { "met" } else { "missed" })
                });
                println!("{what}: {value}{target}");
            }
        }
    }
}

/// Number of runs of [`latency`], which reports the median.
const RUN_COUNT: usize = 5;
/// Length of a run of [`latency`].
const RUN_TIME: Duration = Duration::from_secs(10);

/// Measures the time of a scan from shared memory through a router to a plain client, compared with the same bytes from
/// a plain publisher through the same router in the same run.
fn latency(environment: &BenchEnvironment) -> Vec<TableRow> {
    let (robot, between) = (environment.machine("robot"), environment.machine("router"));
    let at = free_port();
    let _router = between.start_bridge(&[&format!("--listen=tcp/{at}")]);
    wait_until_listening(at);
    let _hub = robot.robot();
    let _bridge = robot.start_bridge(&[&format!("--connect=tcp/{at}")]);
    let (mut memory, mut sources) = robot.subscribe(SENSORS.map(|sensor| (sensor, Topic::Scan)));

    // Time on CLOCK_MONOTONIC at which a scan was in shared memory, by sensor and telegram number.
    let mut sent: HashMap<(u8, u32), u64> = HashMap::new();
    let (through, plain): (Arc<Mutex<Vec<_>>>, SendTimes) = Default::default();
    let (listener, speaker) = (session(at), session(at));
    let arrivals = through.clone();
    let _ours = listener
        .declare_subscriber("scanhub/*/*/scan")
        .callback(move |sample| {
            let now_ns = clock::now_ns();
            let bytes = sample.payload().to_bytes();
            let head = Datagram::read(&bytes).expect("a datagram").head;
            arrivals.lock().expect("no panic").push(((head.sensor, head.counter), now_ns));
        })
        .wait()
        .expect("a subscriber");
    let ages = plain.clone();
    let _bare = listener
        .declare_subscriber("bare/scan")
        .callback(move |sample| {
            let now_ns = clock::now_ns();
            let bytes = sample.payload().to_bytes();
            let sent_ns = Datagram::read(&bytes).expect("a datagram").head.stamp_ns;
            ages.lock().expect("no panic").push(now_ns.saturating_sub(sent_ns));
        })
        .wait()
        .expect("a subscriber");
    let publisher = speaker.declare_publisher("bare/scan").express(true).wait().expect("a publisher");
    thread::sleep(Duration::from_secs(1));

    let mut pairs = Vec::new();
    let mut buffer = vec![0; HEADER_LEN + usize::from(u16::MAX)];
    for _ in 0..RUN_COUNT {
        let started = Instant::now();
        while started.elapsed() < RUN_TIME {
            memory.check_hub().expect("a domain");
            for source in &mut sources {
                while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                    let Some(header) = sample.header().copied() else { continue };
                    let sent_ns = header.stamp_last_ns + header.hub_time_ns().unwrap_or_default();
                    sent.insert((header.sensor, header.seq as u32), sent_ns);
                    let len = sample.pack(&mut buffer[HEADER_LEN..]).expect("it fits");
                    let head = Head { topic: Topic::Scan.number(), revision: 1, ..Head::default() };
                    let head = Head { stamp_ns: clock::now_ns(), ..head };
                    let bytes = head.seal(&mut buffer, len).expect("it fits");
                    publisher.put(bytes).wait().expect("to send");
                }
            }
            memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
        }
        thread::sleep(Duration::from_millis(200));
        let ours = std::mem::take(&mut *through.lock().expect("no panic")).into_iter();
        let ours = ours.filter_map(|(key, now_ns): (_, u64)| Some(now_ns.saturating_sub(sent.remove(&key)?)));
        let both = [ours.collect(), std::mem::take(&mut *plain.lock().expect("no panic"))];
        pairs.push(both.map(|mut times: Vec<u64>| [0.5, 0.99].map(|share| percentile(&mut times, share))));
    }
    pairs.sort_by(|a, b| (a[0][0] / a[1][0]).total_cmp(&(b[0][0] / b[1][0])));
    let [ours, theirs] = pairs[RUN_COUNT / 2];
    let ratio = |pair: &[[f64; 2]; 2]| pair[0][0] / pair[1][0];
    let times = ratio(&pairs[RUN_COUNT / 2]);
    let spread = format!("{:.2} to {:.2}", ratio(&pairs[0]), ratio(&pairs[RUN_COUNT - 1]));
    let value = |[p50, p99]: [f64; 2]| format!("p50 {p50:.0} us, p99 {p99:.0} us");
    vec![
        row("shared memory over a router to a plain client", value(ours), None),
        row("plain publisher over the same router to the same client", value(theirs), None),
        row(
            "p50 beside p50, median of five runs",
            format!("{times:.2} times, {spread}"),
            Some(("at most 2", times <= 2.0)),
        ),
    ]
}

/// Number of times that the router is killed.
const KILLS: usize = 20;
/// Time for which the router does not run after it was killed.
const ROUTER_DOWNTIME: Duration = Duration::from_millis(700);

/// Measures how soon scans arrive again after a router was killed and restarted, and checks that both ends count the
/// same losses.
fn killed_router(environment: &BenchEnvironment) -> Vec<TableRow> {
    let [robot, between, desk] = ["robot", "router", "desk"].map(|name| environment.machine(name));
    let at = free_port();
    let listen = format!("--listen=tcp/{at}");
    let mut router = between.start_bridge(&[&listen]);
    wait_until_listening(at);
    let connect = format!("--connect=tcp/{at}");
    let here = desk.start_bridge(&[&connect, "--publish"]);
    here.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let there = robot.start_bridge(&[&connect, "--topic=*/*"]);
    there.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    let name = here.wait_for_line(|line| line["kind"] == "published")["sensor"]
        .as_str()
        .unwrap_or_default()
        .to_owned();
    let mut local = robot.subscribe(SENSORS.map(|sensor| (sensor, Topic::Scan)));
    let mut remote = desk.subscribe([(&name, Topic::Scan)]);
    let (mut missed, mut received, mut is_first) = (0, 0, true);
    let mut look = |local: &mut (Session, [Source; 2])| {
        for source in &mut local.1 {
            while let Some(sample) = source.receive(&mut local.0).expect("a sample") {
                // Samples that waited before the first poll do not count.
                missed += if is_first { 0 } else { sample.missed() };
                received += 1;
            }
        }
        is_first = false;
    };
    look(&mut local);
    let mut back_ms = Vec::new();
    for _ in 0..KILLS {
        drop(router);
        let killed = Instant::now();
        while killed.elapsed() < ROUTER_DOWNTIME {
            look(&mut local);
            newest(&mut remote);
            thread::sleep(Duration::from_millis(10));
        }
        router = between.start_bridge(&[&listen]);
        let back = Instant::now();
        while !newest(&mut remote) {
            assert!(back.elapsed() < Duration::from_secs(30), "no scan arrives any more");
            look(&mut local);
            thread::sleep(Duration::from_millis(1));
        }
        back_ms.push(back.elapsed().as_secs_f64() * 1e3);
        let well = Instant::now();
        while well.elapsed() < Duration::from_secs(1) {
            look(&mut local);
            newest(&mut remote);
            thread::sleep(Duration::from_millis(10));
        }
    }
    look(&mut local);
    let sent = there.end();
    thread::sleep(Duration::from_secs(1));
    let totals = compare(&sent, &here.end());
    back_ms.sort_by(f64::total_cmp);
    let longest = back_ms[KILLS - 1];
    vec![
        row(
            "router killed and started 20 times: from its start to the next scan, median and longest",
            format!("{:.0} ms, {longest:.0} ms", back_ms[KILLS / 2]),
            Some(("at most 1000 ms", longest <= 1000.0)),
        ),
        row(
            "samples sent, received, lost, replaced",
            format!("{}, {}, {}, {}", totals.sent, totals.received, totals.lost, totals.replaced),
            None,
        ),
        totals.agreement_row(),
        row(
            "scans that a local subscriber missed",
            format!("{missed} of {received}"),
            Some(("0", missed == 0)),
        ),
    ]
}

/// Receives the samples that have arrived, and returns whether a scan of a remote sensor was among them.
fn newest((memory, sources): &mut (Session, [Source; 1])) -> bool {
    let mut has_new = false;
    memory.check_hub().expect("a domain");
    for source in sources {
        while let Some(sample) = source.receive(memory).expect("a sample") {
            has_new |= sample.header().is_some_and(|header| header.flags & Flags::REMOTE != 0);
        }
    }
    has_new
}

/// Measures losses and CPU time of the bridges, with all topics of two sensors through a router, for `minutes`.
fn loss(environment: &BenchEnvironment, minutes: f64) -> Vec<TableRow> {
    let [robot, between, desk] = ["robot", "router", "desk"].map(|name| environment.machine(name));
    let at = free_port();
    let _router = between.start_bridge(&[&format!("--listen=tcp/{at}")]);
    wait_until_listening(at);
    let here = desk.start_bridge(&[&format!("--connect=tcp/{at}"), "--publish"]);
    here.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let there = robot.start_bridge(&[&format!("--connect=tcp/{at}"), "--topic=*/*"]);
    there.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    here.wait_for_line(|line| line["kind"] == "published");
    thread::sleep(Duration::from_secs(3));
    let (started, before) = (Instant::now(), [there.cpu_ticks(), here.cpu_ticks()]);
    thread::sleep(Duration::from_secs_f64(60.0 * minutes));
    let seconds = started.elapsed().as_secs_f64();
    let busy =
        [there.cpu_ticks() - before[0], here.cpu_ticks() - before[1]].map(|ticks| ticks as f64 / seconds);
    let sent = there.end();
    thread::sleep(Duration::from_secs(1));
    let totals = compare(&sent, &here.end());
    let all = totals.sent + totals.replaced + totals.missed;
    vec![
        row(
            &format!(
                "all topics of two sensors over a router for {minutes} minutes: samples lost on the way"
            ),
            format!("{} of {}", totals.lost, totals.sent),
            Some(("0", totals.lost == 0)),
        ),
        row(
            "of these, replaced by newer ones before they were sent, or missed in the hub",
            format!("{} of {all}", totals.replaced + totals.missed),
            None,
        ),
        totals.agreement_row(),
        row("bytes a second", format!("{:.0}", totals.bytes as f64 / seconds), None),
        row(
            "CPU time of the bridge that sends",
            format!("{:.2} % of a core", busy[0]),
            Some(("at most 3 %", busy[0] <= 3.0)),
        ),
        row("of the one that publishes", format!("{:.2} % of a core", busy[1]), None),
    ]
}

/// Measures the losses of a plain subscriber to `scanhub/**`, with all topics of two sensors through a router with
/// Zenoh's own configuration, for `minutes`.
fn plain_router(environment: &BenchEnvironment, minutes: f64) -> Vec<TableRow> {
    let robot = environment.machine("robot");
    let at = free_port();
    let _router = environment::plain_router(at);
    wait_until_listening(at);
    let received: Arc<Mutex<HashMap<(u8, u8), u64>>> = Arc::default();
    let (counts, listener) = (received.clone(), session(at));
    let _subscriber = listener
        .declare_subscriber("scanhub/**")
        .callback(move |sample: Sample| {
            let bytes = sample.payload().to_bytes();
            let head = Datagram::read(&bytes).expect("a datagram").head;
            *counts.lock().expect("no panic").entry((head.sensor, head.topic)).or_default() += 1;
        })
        .wait()
        .expect("a subscriber");
    let there = robot.start_bridge(&[&format!("--connect=tcp/{at}"), "--topic=*/*"]);
    there.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    thread::sleep(Duration::from_secs_f64(60.0 * minutes));
    let sent = there.end();
    thread::sleep(Duration::from_secs(1));
    let of_all = last(&sent, "sent").into_values().filter_map(|row| row["sent"].as_u64()).sum::<u64>();
    let received = received.lock().expect("no panic").values().sum::<u64>();
    vec![row(
        &format!(
            "all topics of two sensors through a plain router for {minutes} minutes: samples and announcements lost"
        ),
        format!("{} of {of_all}", of_all as i64 - received as i64),
        Some(("0", received == of_all)),
    )]
}

const SLOW_LINK_TIME: Duration = Duration::from_secs(40);
const STALLED_LINK_TIME: Duration = Duration::from_secs(80);
const STALL_INTERVAL: Duration = Duration::from_secs(20);
const STALL_TIME: Duration = Duration::from_secs(2);
const BYTES_PER_SECOND: f64 = 500_000.0 / 8.0;
const LINK_DELAY: Duration = Duration::from_millis(100);

/// Measures the age of scans on a link of 0.5 Mbit/s and 100 ms each way, with all topics of two sensors, and checks
/// that both ends count the same losses.
fn slow_link(environment: &BenchEnvironment, stalls: Option<StallPattern>) -> Vec<TableRow> {
    let [robot, desk] = ["robot", "desk"].map(|name| environment.machine(name));
    let at = free_port();
    let there = robot.start_bridge(&[&format!("--listen=tcp/{at}"), "--topic=*/*"]);
    wait_until_listening(at);
    let here = desk.start_bridge(&[
        &format!("--connect=tcp/{}", relay(at, BYTES_PER_SECOND, LINK_DELAY, stalls)),
        "--publish",
    ]);
    here.wait_for_line(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    let published =
        SENSORS.map(|name| here.wait_for_line(|line| line["kind"] == "published" && has_class(line, name)));
    let names = published.map(|line| line["sensor"].as_str().unwrap_or_default().to_owned());
    let (mut local, mut remote) = robot.subscribe(SENSORS.map(|sensor| (sensor, Topic::Scan)));
    let (mut memory, mut sources) = desk.subscribe([(&names[0], Topic::Scan), (&names[1], Topic::Scan)]);
    thread::sleep(Duration::from_secs(3));
    let (mut ages, mut missed, mut received) = (Vec::new(), 0, 0);
    let mut is_first = true;
    let started = Instant::now();
    let run = if stalls.is_some() { STALLED_LINK_TIME } else { SLOW_LINK_TIME };
    while started.elapsed() < run {
        memory.check_hub().expect("a domain");
        for source in &mut sources {
            while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                let header = sample.header().filter(|header| header.flags & Flags::REMOTE != 0);
                // Skip the samples that waited before the first poll, because they are older than later samples.
                if let Some(header) = header.filter(|_| !is_first) {
                    ages.push(clock::wall_ns().saturating_sub(header.wall_ns));
                }
            }
        }
        for source in &mut remote {
            while let Some(sample) = source.receive(&mut local).expect("a sample") {
                missed += if is_first { 0 } else { sample.missed() };
                received += 1;
            }
        }
        is_first = false;
        memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
    }
    let sent = there.end();
    thread::sleep(Duration::from_secs(2));
    let totals = compare(&sent, &here.end());
    let [p50, p95, p99] = [0.5, 0.95, 0.99].map(|share| percentile(&mut ages, share) / 1e3);
    let suffix = if stalls.is_some() { ", stalls of 2 s" } else { "" };
    vec![
        row(
            &format!(
                "0.5 Mbit/s, 100 ms each way{suffix}, all topics of two sensors: age of a scan, median, p95 and p99"
            ),
            format!("{p50:.0} ms, {p95:.0} ms, {p99:.0} ms, {} scans", ages.len()),
            // With stalls, more than 1 % of all samples are in transit when a stall begins. These samples are 2 s late,
            // so p99 has no target.
            stalls.is_none().then_some(("p99 at most 600 ms", p99 <= 600.0)),
        ),
        row(
            "samples sent, received, lost, replaced",
            format!("{}, {}, {}, {}", totals.sent, totals.received, totals.lost, totals.replaced),
            None,
        ),
        totals.agreement_row(),
        row(
            "scans that a local subscriber missed",
            format!("{missed} of {received}"),
            Some(("0", missed == 0)),
        ),
    ]
}

fn has_class(line: &Value, name: &str) -> bool {
    line["sensor"].as_str().is_some_and(|sensor| sensor.ends_with(&format!(".{name}")))
}

/// Buffer size of the relay's sockets at each end, in bytes.
const SOCKET_BUFFER_LEN: usize = 4096;
/// Maximum number of bytes that the relay forwards at once. The payload of a packet in a network has this size. Packets
/// on the loopback are larger.
const PACKET_LEN: usize = 1448;

/// Starts a relay to `to`, and returns the address to connect to. The relay forwards at most `bytes_a_second` in each
/// direction, each byte after `delay`. It has only those bytes in transit that this rate and this delay require. During
/// `stalls`, the relay forwards nothing. (A kernel with netem and tbf can do the same in a network namespace.)
fn relay(to: SocketAddr, bytes_a_second: f64, delay: Duration, stalls: Option<StallPattern>) -> SocketAddr {
    let listener = socket();
    listener.bind(&SocketAddr::from(([127, 0, 0, 1], 0)).into()).expect("a port");
    listener.listen(8).expect("it is bound");
    let listener = TcpListener::from(listener);
    let at = listener.local_addr().expect("it is bound");
    let started = Instant::now();
    // The thread runs until the bench exits.
    thread::spawn(move || {
        for near in listener.incoming().map_while(Result::ok) {
            let far = socket();
            if far.connect(&to.into()).is_err() {
                // The listener has exited.
                continue;
            }
            let far = TcpStream::from(far);
            near.set_nodelay(true).expect("TCP");
            for (from, to) in [(&near, &far), (&far, &near)] {
                let both = [from, to].map(|stream| stream.try_clone().expect("a descriptor"));
                thread::spawn(move || relay_bytes(both, bytes_a_second, delay, started, stalls));
            }
        }
    });
    at
}

/// Creates a socket of the relay, with the packet size and the buffers of a network.
fn socket() -> Socket {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, Some(Protocol::TCP)).expect("a socket");
    socket.set_tcp_mss(PACKET_LEN as u32).expect("a size");
    socket.set_recv_buffer_size(SOCKET_BUFFER_LEN).expect("a size");
    socket.set_send_buffer_size(SOCKET_BUFFER_LEN).expect("a size");
    socket.set_tcp_nodelay(true).expect("TCP");
    socket
}

/// Periodic stalls of a link, each at the end of an interval.
#[derive(Clone, Copy)]
struct StallPattern {
    interval: Duration,
    length: Duration,
}

impl StallPattern {
    /// Returns the remaining time of the current stall; zero if there is none.
    fn time_left(self, since: Instant) -> Duration {
        let phase = since.elapsed().as_nanos() % self.interval.as_nanos();
        let left = self.interval.saturating_sub(Duration::from_nanos(phase as u64));
        if left > self.length { Duration::ZERO } else { left }
    }
}

fn relay_bytes(
    [mut from, mut to]: [TcpStream; 2],
    bytes_a_second: f64,
    delay: Duration,
    started: Instant,
    stalls: Option<StallPattern>,
) {
    let mut in_transit: VecDeque<(Instant, Vec<u8>)> = VecDeque::new();
    let mut room_at = Instant::now();
    let mut packet = [0; PACKET_LEN];
    loop {
        thread::sleep(stalls.map_or(Duration::ZERO, |stalls| stalls.time_left(started)));
        let now = Instant::now();
        while in_transit.front().is_some_and(|(at, _)| *at <= now)
            && let Some((_, bytes)) = in_transit.pop_front()
        {
            if to.write_all(&bytes).is_err() {
                return;
            }
        }
        let next = in_transit.front().map_or(now + delay, |(at, _)| *at);
        if room_at > now {
            thread::sleep(room_at.min(next).saturating_duration_since(now));
            continue;
        }
        let wait = next.saturating_duration_since(now).max(Duration::from_millis(1));
        from.set_read_timeout(Some(wait)).expect("a time");
        match from.read(&mut packet) {
            // Forward the bytes that are still in transit.
            Ok(0) => {
                for (at, bytes) in in_transit {
                    thread::sleep(at.saturating_duration_since(Instant::now()));
                    let _ = to.write_all(&bytes);
                }
                let _ = to.shutdown(Shutdown::Write);
                return;
            }
            Ok(len) => {
                room_at = Instant::now().max(room_at) + Duration::from_secs_f64(len as f64 / bytes_a_second);
                in_transit.push_back((room_at + delay, packet[..len].to_vec()));
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => return,
        }
    }
}

/// Sums over all sensors and topics, except announcements.
#[derive(Default)]
struct CounterTotals {
    sent: u64,
    bytes: u64,
    missed: u64,
    replaced: u64,
    received: u64,
    lost: u64,
    /// Rows in which the two ends disagree.
    wrong: Vec<String>,
}

impl CounterTotals {
    /// Returns a table row that states whether both ends report the same counts.
    fn agreement_row(&self) -> TableRow {
        let first = self.wrong.first().map_or(String::new(), |first| format!(", the first {first}"));
        let value = format!("{}{first}", self.wrong.len());
        row("rows of the statistics in which the two ends differ", value, Some(("0", self.wrong.is_empty())))
    }
}

/// Compares the last statistics of sender and receiver, row by row.
fn compare(sender: &[Value], receiver: &[Value]) -> CounterTotals {
    let (there, here) = (last(sender, "sent"), last(receiver, "received"));
    let mut totals = CounterTotals::default();
    for (name, row) in &there {
        let number = |row: &Value, key: &str| row[key].as_u64().unwrap_or_default();
        let other = here.get(name).cloned().unwrap_or_default();
        let [sent, replaced, missed, bytes] =
            ["sent", "replaced", "missed", "bytes"].map(|key| number(row, key));
        let [received, lost, announced] = ["received", "lost", "replaced"].map(|key| number(&other, key));
        // The counters in an announcement do not include this announcement, and no announcement reports the last one.
        let is_announce = name.ends_with("/announce");
        if sent != received + lost || !is_announce && replaced != announced {
            totals.wrong.push(format!("{name}: {row} and {other}"));
        }
        if !is_announce {
            totals.sent += sent;
            totals.bytes += bytes;
            totals.missed += missed;
            totals.replaced += replaced;
            totals.received += received;
            totals.lost += lost;
        }
    }
    totals
}

/// Returns the last line of statistics that has this key, by sensor and topic.
fn last(lines: &[Value], key: &str) -> BTreeMap<String, Value> {
    let mut rows = BTreeMap::new();
    for line in lines.iter().filter(|line| line["class"] == "bridge" && line[key].is_u64()) {
        let word = |key: &str| line[key].as_str().unwrap_or_default().to_owned();
        rows.insert(format!("{}/{}", word("sensor"), word("topic")), line.clone());
    }
    rows
}
