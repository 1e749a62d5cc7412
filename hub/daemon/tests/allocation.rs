//! The hub's memory is fixed once a sensor streams, however many scans come. Its link takes nothing from the heap for a
//! scan and what is made of it but what the shared-memory library takes for each loan of a sample: one small piece, given
//! back when it is sent. For telegrams, marks and foreground that nobody follows there is no loan.

mod counting;

use std::fs;
use std::os::fd::OwnedFd;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc::channel;
use std::thread;
use std::time::{Duration, Instant};

use config::{Config, Sources};
use counting::{HELD, TAKEN, WATCHED};
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::io::Errno;
use rustix::process::{Signal, getpid, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::reply::{self, Health};
use scanhub_drivers::lms::telegram::ACK;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use schema::ipc::{self, Payload, Subscriber};
use schema::{Domain, Foreground, Marks, Scan};

/// A sensor of few words at the other end of a pty: it streams when it is told to, and answers two questions.
struct Sensor {
    line: OwnedFd,
    heard: Vec<u8>,
    scans: u64,
}

impl Sensor {
    fn new() -> (Sensor, String) {
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
        (Sensor { line, heard: Vec::new(), scans: 0 }, name)
    }

    /// Writes all of it, however long a busy machine keeps the hub from reading.
    fn say(&self, mut bytes: &[u8]) {
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

    fn send_scan(&mut self) {
        self.scans += 1;
        let words = [1000 + (self.scans % 1000) as u16; 361];
        self.say(lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes());
    }

    /// Answers what was asked.
    fn answer(&mut self) {
        let mut buffer = [0; 64];
        let len = rustix::io::read(&self.line, &mut buffer).unwrap_or(0);
        self.heard.extend(&buffer[..len]);
        let health = Health {
            software: *b"V02.30 ",
            operating_mode: 0x24,
            mode: Mode(1),
            variant: Variant::HALF,
            unit: Unit::Mm,
            baud: Baud::B500000,
        };
        let answer = if self.heard.ends_with(Request::Status.encode(0).bytes()) {
            reply::status(0, &health, 0x10)
        } else if self.heard.ends_with(Request::Type.encode(0).bytes()) {
            reply::kind(0, b"LMS200;301063;V02.30 ", 0x10)
        } else {
            return;
        };
        self.heard.clear();
        self.say(&[&[ACK], answer.bytes()].concat());
    }
}

/// Sends scans until `count` more were published.
fn stream(sensor: &mut Sensor, subscriber: &Subscriber<Scan>, count: u64) {
    let give_up_at = Instant::now() + Duration::from_secs(60);
    for number in 0..count {
        sensor.send_scan();
        let mut next_scan = Instant::now() + Duration::from_millis(50);
        while !matches!(Scan::receive(subscriber), Ok(Some(_))) {
            assert!(Instant::now() < give_up_at, "scan {number} of {count} did not come");
            sensor.answer();
            if Instant::now() > next_scan {
                // Until the sensor was asked for its mode a scan cannot be read, and is none.
                sensor.send_scan();
                next_scan += Duration::from_millis(50);
            }
            thread::sleep(Duration::from_micros(100));
        }
    }
}

/// Waits until the link rests: it has given back what the last loans took, and taken those for the next telegram.
fn settle() {
    let (mut held, mut same) = (HELD.load(Relaxed), 0);
    while same < 20 {
        thread::sleep(Duration::from_millis(10));
        let now = HELD.load(Relaxed);
        same = if now == held { same + 1 } else { 0 };
        held = now;
    }
}

/// A domain that goes with the test, however it ends.
struct Place(Domain);

impl Drop for Place {
    fn drop(&mut self) {
        let _ = self.0.root().parent().map(fs::remove_dir_all);
        for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.0.prefix()) {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

/// The thread of this process with this name.
fn thread_named(name: &str) -> i32 {
    let tasks = fs::read_dir("/proc/self/task").expect("threads").flatten();
    let found = tasks
        .filter(|task| fs::read_to_string(task.path().join("comm")).is_ok_and(|comm| comm.trim() == name))
        .find_map(|task| task.file_name().to_str()?.parse().ok());
    found.expect("the link has a thread")
}

/// A hub with these settings, and what its link took for windows of scans: scans, pieces taken, bytes kept. Who follows
/// all topics follows marks and foreground, too.
fn windows(letter: char, follow_all: bool, set: &[&str]) -> [(u64, u64, i64); 4] {
    let name = format!("{letter}{}", std::process::id());
    let place = Place(Domain::at(&name, format!("/tmp/{name}").as_ref()).expect("a domain"));
    let domain = &place.0;
    let (mut sensor, port) = Sensor::new();
    let sources = Sources {
        links: vec![format!("heap={port}")],
        // In the state directory of whoever runs the tests nothing is left.
        set: set.iter().chain(&["background.keep=false"]).map(|flag| (*flag).to_owned()).collect(),
        ..Sources::default()
    };
    let (send, ready) = channel();
    let hub = thread::spawn({
        let domain = domain.clone();
        move || daemon::run(&|| Config::load(&sources), &domain, |_| send.send(()).unwrap_or_default())
    });
    ready.recv_timeout(Duration::from_secs(60)).expect("the hub is up");
    let node = ipc::client_node(domain).expect("a node");
    let topic = Scan::open(&node, "heap").expect("a topic").expect("is there");
    let subscriber = Scan::subscriber(&topic).expect("a subscriber");
    let followers = follow_all.then(|| {
        let marks = Marks::open(&node, "heap").expect("a topic").expect("is there");
        let foreground = Foreground::open(&node, "heap").expect("a topic").expect("is there");
        (
            Marks::subscriber(&marks).expect("a subscriber"),
            Foreground::subscriber(&foreground).expect("a subscriber"),
        )
    });
    // The rate, both questions, and what is made once.
    stream(&mut sensor, &subscriber, 50);
    WATCHED.store(thread_named("heap"), Relaxed);
    stream(&mut sensor, &subscriber, 50);
    settle();
    let windows = [50, 400, 50, 400].map(|count| {
        let (scans, taken, held) = (sensor.scans, TAKEN.load(Relaxed), HELD.load(Relaxed));
        stream(&mut sensor, &subscriber, count);
        settle();
        (sensor.scans - scans, TAKEN.load(Relaxed) - taken, HELD.load(Relaxed) - held)
    });
    WATCHED.store(0, Relaxed);
    if let Some((marks, foreground)) = &followers {
        assert!(matches!(Marks::receive(marks), Ok(Some(_))), "marks came");
        assert!(matches!(Foreground::receive(foreground), Ok(Some(_))), "foreground came");
    }
    drop((followers, subscriber, topic, node));
    kill_process(getpid(), Signal::TERM).expect("a signal");
    assert_eq!(hub.join().expect("no panic"), Ok(()));
    windows
}

/// One after the other: a signal ends all hubs of a process.
#[test]
fn a_scan_takes_nothing_from_the_heap() {
    for (letter, follow_all, set, topics) in [
        // Scan and zones, and telegrams that nobody follows.
        ('a', false, &["background.method=paper"][..], 2),
        ('b', true, &["background.publish=every-scan"][..], 5),
    ] {
        for (scans, taken, held) in windows(letter, follow_all, set) {
            // A loan for each; one that says that scans stay out; now and then one for the status. Of the scans that
            // the sensor sent twice, the first may not have been one.
            let loans = topics * (scans - UNHEARD)..=topics * scans + OTHERS;
            assert!(loans.contains(&taken), "{taken} pieces of memory for {scans} scans and {topics} topics");
            assert_eq!(held, 0, "bytes kept of {scans} scans and {topics} topics");
        }
    }
}

/// Scans in a window that may go unheard on a busy machine.
const UNHEARD: u64 = 15;
/// Loans for what is no scan: fewer than scans in a window.
const OTHERS: u64 = 20;
