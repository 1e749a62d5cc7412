//! Test that the hub's memory is fixed once a scanner streams. For a scan and its results, a link allocates only what
//! iceoryx2 needs for each loan: one small block, which is freed when the sample is sent. Telegrams, marks and
//! foreground without a subscriber need no loan.

#![expect(clippy::disallowed_methods, reason = "limits and periods of real time")]

mod counting;

use std::fs;
use std::os::fd::OwnedFd;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc::channel;
use std::thread;
use std::time::{Duration, Instant};

use counting::{ALLOCATIONS, HELD_BYTES, WATCHED_THREAD};
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::io::Errno;
use rustix::process::{Signal, getpid, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::tcgetattr;
use scanhub_config::{Config, Sources};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::reply::{self, SimulatedStatus};
use scanhub_drivers::lms::telegram::{ACK, EncodedTelegram, FRAME_LEN, MAX_TELEGRAM, STX, Telegram};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_schema::{Foreground, Marks, Scan};
use scanhub_shm::Domain;
use scanhub_shm::{Payload, Subscriber};

/// Scanner at the other end of a pty. Like a real scanner, it neither sends nor receives anything while the hub's port
/// has another rate, and it streams until it gets a request to stop.
struct PtyScanner {
    line: OwnedFd,
    received: Vec<u8>,
    is_streaming: bool,
    scans: u64,
}

impl PtyScanner {
    fn new() -> (PtyScanner, String) {
        let make = || -> rustix::io::Result<_> {
            let line = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
            grantpt(&line)?;
            unlockpt(&line)?;
            let name = ptsname(&line, Vec::new())?;
            fcntl_setfl(&line, OFlags::RDWR | OFlags::NONBLOCK)?;
            Ok((line, name))
        };
        let (line, name) = make().expect("a pty");
        let name = name.into_string().expect("a name of ASCII");
        (PtyScanner { line, received: Vec::new(), is_streaming: true, scans: 0 }, name)
    }

    /// Writes all `bytes`, even if a busy machine delays the hub's reads.
    fn send(&self, mut bytes: &[u8]) {
        let give_up_at = Instant::now() + Duration::from_secs(60);
        while !bytes.is_empty() {
            match rustix::io::write(&self.line, bytes) {
                Ok(len) => bytes = &bytes[len..],
                Err(Errno::AGAIN) => thread::sleep(Duration::from_millis(1)),
                Err(errno) => panic!("the line is gone: {errno}"),
            }
            assert!(Instant::now() < give_up_at, "the hub does not read");
        }
    }

    fn has_matching_rate(&self) -> bool {
        tcgetattr(&self.line).is_ok_and(|termios| termios.output_speed() == Baud::B500000.rate())
    }

    fn send_scan(&mut self) {
        if self.is_streaming && self.has_matching_rate() {
            self.scans += 1;
            let words = [1000 + (self.scans % 1000) as u16; 361];
            self.send(lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes());
        }
    }

    /// Replies to all requests that have arrived.
    fn reply_to_all(&mut self) {
        let mut buffer = [0; 64];
        while let Ok(len @ 1..) = rustix::io::read(&self.line, &mut buffer) {
            self.received.extend(&buffer[..len]);
        }
        if !self.has_matching_rate() {
            self.received.clear();
        }
        while let Some(request) = self.next_request() {
            if let Some(reply) = self.reply(request) {
                self.send(&[&[ACK], reply.bytes()].concat());
            }
        }
    }

    /// Removes the next request from the received bytes, once it is complete.
    fn next_request(&mut self) -> Option<Request> {
        loop {
            let begin = self.received.iter().position(|&byte| byte == STX).unwrap_or(self.received.len());
            self.received.drain(..begin);
            let [_, _, low, high, ..] = self.received[..] else { return None };
            let len = usize::from(u16::from_le_bytes([low, high])) + FRAME_LEN;
            if len <= MAX_TELEGRAM && self.received.len() < len {
                return None;
            }
            let telegram = self.received.get(..len).and_then(Telegram::check);
            let request = telegram.and_then(Request::decode);
            // Skip only one byte, so that an incomplete request does not hide a later one.
            self.received.drain(..if telegram.is_some() { len } else { 1 });
            if request.is_some() {
                return request;
            }
        }
    }

    fn reply(&mut self, request: Request) -> Option<EncodedTelegram> {
        let health = SimulatedStatus {
            software: *b"V02.30 ",
            operating_mode: if self.is_streaming { 0x24 } else { 0x25 },
            mode: Mode(1),
            variant: Variant::HALF,
            unit: Unit::Mm,
            baud: Baud::B500000,
        };
        match request {
            Request::Status => Some(reply::status_reply(0, &health, 0x10)),
            Request::Type => Some(reply::type_reply(0, b"LMS200;301063;V02.30 ", 0x10)),
            Request::Configuration => Some(reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10)),
            Request::Variant(variant) => {
                Some(reply::variant_reply(0, variant == Variant::HALF, variant, 0x10))
            }
            Request::Baud(baud) => Some(reply::mode_reply(0, baud == Baud::B500000, 0x10)),
            Request::Stop | Request::Stream => {
                self.is_streaming = request == Request::Stream;
                Some(reply::mode_reply(0, true, 0x10))
            }
            _ => None,
        }
    }
}

/// Sends scans until the hub has published `count` further scans.
fn stream(sensor: &mut PtyScanner, subscriber: &Subscriber<Scan>, count: u64) {
    for number in 0..count {
        let give_up_at = Instant::now() + Duration::from_secs(60);
        sensor.reply_to_all();
        sensor.send_scan();
        let mut next_scan = Instant::now() + Duration::from_millis(50);
        while !matches!(Scan::receive(subscriber), Ok(Some(_))) {
            assert!(
                Instant::now() < give_up_at,
                "scan {number} of {count} was not published; the scanner streams: {}, the port has its rate: {}, {} bytes of \
                 a request wait",
                sensor.is_streaming,
                sensor.has_matching_rate(),
                sensor.received.len()
            );
            sensor.reply_to_all();
            if Instant::now() > next_scan {
                // The hub cannot decode scans until it has requested the scanner's mode.
                sensor.send_scan();
                next_scan += Duration::from_millis(50);
            }
            thread::sleep(Duration::from_micros(100));
        }
    }
}

/// Waits until the link is idle: it has freed the memory of the last loans, and taken the loans for the next telegram.
fn wait_until_idle() {
    let (mut held, mut same) = (HELD_BYTES.load(Relaxed), 0);
    while same < 20 {
        thread::sleep(Duration::from_millis(10));
        let now = HELD_BYTES.load(Relaxed);
        same = if now == held { same + 1 } else { 0 };
        held = now;
    }
}

/// Domain that is removed at the end of the test, even after a failure.
struct TestDomain(Domain);

impl Drop for TestDomain {
    fn drop(&mut self) {
        let _ = self.0.root().parent().map(fs::remove_dir_all);
        for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.0.prefix()) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

/// Returns the ID of this process's thread with this name.
fn thread_named(name: &str) -> i32 {
    let tasks = fs::read_dir("/proc/self/task").expect("threads").flatten();
    let found = tasks
        .filter(|task| fs::read_to_string(task.path().join("comm")).is_ok_and(|comm| comm.trim() == name))
        .find_map(|task| task.file_name().to_str()?.parse().ok());
    found.expect("the link has a thread")
}

/// Allocations of the link during a window of scans.
struct AllocationWindow {
    scans: u64,
    seconds: u64,
    /// Number of allocations.
    allocations: u64,
    /// Number of bytes that were not freed.
    held_bytes: i64,
}

/// Returns the allocations of the link of a hub with these settings in four windows of scans. With `follow_all`, marks
/// and foreground have subscribers too.
fn windows(letter: char, follow_all: bool, set: &[&str]) -> [AllocationWindow; 4] {
    let name = format!("{letter}{}", std::process::id());
    let test_domain = TestDomain(Domain::at(&name, format!("/tmp/{name}").as_ref()).expect("a domain"));
    let domain = &test_domain.0;
    let (mut sensor, port) = PtyScanner::new();
    let sources = Sources {
        // Name the family, because a search could restart on a busy machine.
        links: vec![format!("heap={port},family=lms")],
        // Write nothing to the state directory of the user who runs the tests.
        set: set.iter().chain(&["background.keep=false"]).map(|flag| (*flag).to_owned()).collect(),
        ..Sources::default()
    };
    let (send, ready) = channel();
    let hub = thread::spawn({
        let domain = domain.clone();
        move || {
            scanhub_daemon::run(&|| Config::load(&sources), &domain, |_| send.send(()).unwrap_or_default())
        }
    });
    ready.recv_timeout(Duration::from_secs(60)).expect("the hub is up");
    let node = scanhub_shm::client_node(domain).expect("a node");
    let topic = Scan::open(&node, "heap").expect("a topic").expect("is there");
    let subscriber = Scan::subscriber(&node, &topic).expect("a subscriber");
    let subscribers = follow_all.then(|| {
        let marks = Marks::open(&node, "heap").expect("a topic").expect("is there");
        let foreground = Foreground::open(&node, "heap").expect("a topic").expect("is there");
        (
            Marks::subscriber(&node, &marks).expect("a subscriber"),
            Foreground::subscriber(&node, &foreground).expect("a subscriber"),
        )
    });
    // During these scans, the hub finds the rate, sends both requests, and makes the allocations of its start.
    stream(&mut sensor, &subscriber, 50);
    WATCHED_THREAD.store(thread_named("heap"), Relaxed);
    stream(&mut sensor, &subscriber, 50);
    wait_until_idle();
    let windows = [50, 400, 50, 400].map(|count| {
        let (scans, allocations, held_bytes) =
            (sensor.scans, ALLOCATIONS.load(Relaxed), HELD_BYTES.load(Relaxed));
        let started = Instant::now();
        stream(&mut sensor, &subscriber, count);
        wait_until_idle();
        AllocationWindow {
            scans: sensor.scans - scans,
            seconds: started.elapsed().as_secs(),
            allocations: ALLOCATIONS.load(Relaxed) - allocations,
            held_bytes: HELD_BYTES.load(Relaxed) - held_bytes,
        }
    });
    WATCHED_THREAD.store(0, Relaxed);
    if let Some((marks, foreground)) = &subscribers {
        assert!(matches!(Marks::receive(marks), Ok(Some(_))), "marks came");
        assert!(matches!(Foreground::receive(foreground), Ok(Some(_))), "foreground came");
    }
    drop((subscribers, subscriber, topic, node));
    kill_process(getpid(), Signal::TERM).expect("a signal");
    assert_eq!(hub.join().expect("no panic"), Ok(()));
    windows
}

/// One test runs all hubs one after the other, because a signal ends all hubs of a process.
#[test]
fn hub_allocates_only_loans_per_scan() {
    for (letter, follow_all, set, topics) in [
        // Scan and zones have a subscriber, and telegrams have none.
        ('a', false, &["background.method=paper"][..], 2),
        ('b', true, &["background.publish=every-scan"][..], 5),
    ] {
        for AllocationWindow { scans, seconds, allocations, held_bytes } in windows(letter, follow_all, set) {
            // A scan takes one loan in each topic. A silence, a change of state and the status of each second take
            // further loans. If the scanner has sent a scan twice, the hub may have missed the first one.
            let loans =
                topics * (scans - MAX_MISSED_SCANS)..=topics * scans + MAX_OTHER_ALLOCATIONS + 4 * seconds;
            assert!(
                loans.contains(&allocations),
                "{allocations} pieces of memory for {scans} scans and {topics} topics"
            );
            assert_eq!(held_bytes, 0, "bytes kept of {scans} scans and {topics} topics");
        }
    }
}

/// Maximum number of scans in a window that a busy machine may miss.
const MAX_MISSED_SCANS: u64 = 15;
/// Maximum number of loans for other samples than scans. It is less than the number of scans in a window.
const MAX_OTHER_ALLOCATIONS: u64 = 20;
