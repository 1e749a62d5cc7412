//! The verb on real ptys: a host opens the port, asks, and reads; what it got is compared with the truth. Every wait
//! is for something, with a deadline far beyond what it takes.

use std::fs;
use std::io::Write;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use lms::command::Request;
use lms::framer::{Found, Framer};
use lms::measured;
use lms::reply::Reply;
use lms::telegram::Telegram;
use lms::variant::{Baud, Unit, Variant};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use schema::Failure;
use sim::fault::{Fault, Faults};
use sim::options::SimulateOptions;
use sim::truth::{Record, Summary};
use sim::{Ready, simulate};

const PATIENCE: Duration = Duration::from_secs(20);

/// A directory of this test that is gone with it.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Folder {
        let path = std::env::temp_dir().join(format!("scanhub-port-{}-{name}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A simulator in a thread.
struct Simulator {
    stop: Option<UnixStream>,
    thread: Option<thread::JoinHandle<Result<Vec<Summary>, Failure>>>,
    records: Receiver<Record>,
    ready: Vec<Ready>,
}

impl Simulator {
    fn start(options: SimulateOptions) -> Simulator {
        let (stop, stopped) = UnixStream::pair().unwrap();
        let (send_record, records) = channel();
        let (send_ready, ready) = channel();
        let thread = thread::spawn(move || {
            let send_record = Mutex::new(send_record);
            let tell = |record: &Record| {
                let _ = send_record.lock().unwrap().send(record.clone());
            };
            simulate(&options, &stopped, |ready| send_ready.send(ready.to_vec()).unwrap(), tell)
        });
        let ready = ready.recv_timeout(PATIENCE).expect("ready");
        Simulator { stop: Some(stop), thread: Some(thread), records, ready }
    }

    fn record(&self) -> Record {
        self.records.recv_timeout(PATIENCE).expect("a telegram is sent")
    }

    /// The first record from now on that `wanted` is about.
    fn record_where(&self, wanted: impl Fn(&Record) -> bool) -> Record {
        let end = Instant::now() + PATIENCE;
        while Instant::now() < end {
            let record = self.record();
            if wanted(&record) {
                return record;
            }
        }
        panic!("no such telegram was sent");
    }

    fn end(mut self) -> (Vec<Summary>, Vec<Record>) {
        self.stop.take().unwrap().write_all(b"x").unwrap();
        let summaries = self.thread.take().unwrap().join().unwrap().unwrap();
        (summaries, self.records.iter().collect())
    }
}

/// A host with the port open.
struct Host {
    port: OwnedFd,
    framer: Framer,
}

impl Host {
    fn open(path: &Path, rate: u32) -> Host {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let port = open(path, flags, Mode::empty()).unwrap();
        let host = Host { port, framer: Framer::default() };
        host.set_rate(rate);
        host
    }

    fn set_rate(&self, rate: u32) {
        let mut termios = tcgetattr(&self.port).unwrap();
        termios.make_raw();
        termios.set_speed(rate).unwrap();
        tcsetattr(&self.port, OptionalActions::Now, &termios).unwrap();
    }

    /// Says `request` with the gaps that the sensor wants.
    fn say(&self, request: Request, rate: u32) {
        let byte_time = Duration::from_nanos(lms::line_time(1, rate)) + Duration::from_micros(80);
        let mut next = Instant::now();
        for &byte in request.encode(0).bytes() {
            while Instant::now() < next {
                std::hint::spin_loop();
            }
            assert_eq!(rustix::io::write(&self.port, &[byte]), Ok(1));
            next = Instant::now() + byte_time;
        }
    }

    /// The next telegram that comes within `patience`.
    fn telegram(&mut self, patience: Duration) -> Option<Vec<u8>> {
        let end = Instant::now() + patience;
        loop {
            while let Some(found) = self.framer.poll() {
                if let Found::Telegram(framed) = found {
                    return Some(framed.telegram.bytes().to_vec());
                }
            }
            let left = end.saturating_duration_since(Instant::now());
            let timeout = Timespec { tv_sec: left.as_secs() as _, tv_nsec: left.subsec_nanos() as _ };
            let mut fds = [PollFd::new(&self.port, PollFlags::IN)];
            if poll(&mut fds, Some(&timeout)).unwrap() == 0 {
                // A frame whose end looks like a beginning is delivered when nothing follows.
                self.framer.release(lms::framer::VETO_HOLD);
                if let Some(Found::Telegram(framed)) = self.framer.poll() {
                    return Some(framed.telegram.bytes().to_vec());
                }
                return None;
            }
            let count = rustix::io::read(&self.port, self.framer.spare()).unwrap_or(0);
            self.framer.commit(count);
        }
    }

    /// Asks until it is answered: a request may be said too slowly on a busy machine.
    fn ask(&mut self, request: Request, rate: u32) -> Vec<u8> {
        for _ in 0..10 {
            self.say(request, rate);
            let end = Instant::now() + Duration::from_secs(1);
            while let Some(telegram) = self.telegram(end.saturating_duration_since(Instant::now())) {
                if telegram[4] == request.command() | 0x80 {
                    return telegram;
                }
            }
        }
        panic!("no answer to {request:?}");
    }
}

fn options(port: PathBuf) -> SimulateOptions {
    SimulateOptions { ports: vec![port], baud: Baud::B500000, seed: 5, ..SimulateOptions::default() }
}

fn is_data(record: &Record) -> bool {
    !record.is_reply
}

#[test]
fn from_9600_to_a_stream_at_500k_bit_for_bit_as_the_truth_says() {
    let folder = Folder::new("stream");
    let (port, truth) = (folder.path("front"), folder.path("truth.jsonl"));
    std::os::unix::fs::symlink("/dev/pts/999999", &port).unwrap();
    let simulator = Simulator::start(SimulateOptions {
        baud: Baud::B9600,
        truth: Some(truth.clone()),
        ..options(port.clone())
    });
    assert_eq!(simulator.ready[0].port, port);
    assert_eq!(fs::read_link(&port).unwrap(), simulator.ready[0].pty);
    let mut host = Host::open(&port, 9_600);
    let status = host.ask(Request::Status, 9_600);
    let Some(Reply::Status(status)) = Reply::decode(Telegram::check(&status).unwrap()) else { panic!() };
    assert_eq!(status.variant(), Some(Variant::HALF));
    host.ask(Request::Baud(Baud::B500000), 9_600);
    host.set_rate(500_000);
    let begin = host.ask(Request::Stream, 500_000);
    assert_eq!(begin[4], 0xA0);
    let received: Vec<Vec<u8>> = (0..40).map(|_| host.telegram(PATIENCE).expect("a scan")).collect();
    let (summaries, records) = simulator.end();
    assert!(fs::symlink_metadata(&port).is_err(), "the symlink is left");
    let sent: Vec<&Record> = records.iter().filter(|record| is_data(record)).collect();
    let first = sent.iter().position(|record| record.sha256 == Record::hash(&received[0])).expect("was sent");
    let sent = &sent[first..];
    for (telegram, record) in received.iter().zip(sent) {
        assert_eq!((Record::hash(telegram), record.fault), (record.sha256, None));
        assert_eq!(record.length, 732);
    }
    // They were sent at the pace of the sensor, whatever the machine did in between.
    let span = (sent[39].sent_ns - sent[0].sent_ns) as f64 / 39.0;
    assert!((span / 26_640_000.0 - 1.0).abs() < 0.1, "{span} ns");
    let lines: Vec<serde_json::Value> =
        fs::read_to_string(&truth).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), records.len() + 1);
    let last = lines.last().unwrap();
    assert_eq!(
        (last["class"].as_str(), last["sent"].as_u64()),
        (Some("simulated"), Some(records.len() as u64))
    );
    assert_eq!((last["eeprom_writes"].as_u64(), summaries[0].sent), (Some(0), records.len() as u64));
}

#[test]
fn a_closed_port_loses_what_is_sent_and_keeps_nothing_for_the_next_host() {
    let folder = Folder::new("closed");
    let port = folder.path("front");
    let simulator = Simulator::start(options(port.clone()));
    let mut host = Host::open(&port, 500_000);
    rustix::termios::ioctl_tiocexcl(&host.port).unwrap();
    host.ask(Request::Stream, 500_000);
    simulator.record_where(|record| is_data(record) && record.fault.is_none());
    drop(host);
    for _ in 0..5 {
        simulator.record_where(|record| record.fault == Some(Fault::Unread));
    }
    let mut host = Host::open(&port, 500_000);
    let first = Record::hash(&host.telegram(PATIENCE).expect("a scan"));
    let mut next = simulator.record();
    while next.sha256 != first {
        assert!(next.fault.is_some(), "an intact telegram was not read");
        next = simulator.record();
    }
    assert_eq!(next.fault, None);
    simulator.end();
}

#[test]
fn at_another_rate_nothing_is_understood_on_either_side() {
    let folder = Folder::new("rate");
    let port = folder.path("front");
    let simulator = Simulator::start(options(port.clone()));
    let mut host = Host::open(&port, 38_400);
    host.say(Request::Status, 38_400);
    assert_eq!(host.telegram(Duration::from_millis(300)), None, "answered at the wrong rate");
    host.set_rate(500_000);
    host.ask(Request::Stream, 500_000);
    host.set_rate(250_000);
    for _ in 0..3 {
        simulator.record_where(|record| record.fault == Some(Fault::Baud));
    }
    // What is in the host's buffer now was garbled, except for a scan that came before.
    let mut buffer = vec![0; 30_000];
    assert!(rustix::io::read(&host.port, &mut buffer).unwrap() > 0);
    host.set_rate(500_000);
    assert_eq!(host.telegram(PATIENCE).expect("a scan").len(), 732);
    simulator.end();
}

#[test]
fn a_host_that_does_not_read_loses_what_has_no_room() {
    let folder = Folder::new("overrun");
    let port = folder.path("front");
    let simulator = Simulator::start(SimulateOptions { speed: 10.0, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    host.ask(Request::Stream, 500_000);
    simulator.record_where(|record| record.fault == Some(Fault::Overrun));
    drop(host);
    simulator.end();
}

#[test]
fn a_replay_is_sent_once_in_order_and_then_the_line_is_silent() {
    let folder = Folder::new("replay");
    let (port, file) = (folder.path("front"), folder.path("stream.bin"));
    let scans: Vec<Vec<u8>> =
        (0..200u16).map(|i| measured::encode(3, Unit::Cm, &[700 + i; 361], 0x11).bytes().to_vec()).collect();
    let mut bytes = Request::Stop.encode(0).bytes().to_vec();
    bytes.extend_from_slice(lms::reply::mode(3, true, 0x10).bytes());
    bytes.extend(scans.concat());
    fs::write(&file, bytes).unwrap();
    let replay = Some(file);
    let simulator = Simulator::start(SimulateOptions { replay, speed: 4.0, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    let status = host.ask(Request::Status, 500_000);
    let Some(Reply::Status(status)) = Reply::decode(Telegram::check(&status).unwrap()) else { panic!() };
    assert_eq!((status.unit(), status.mode().0), (Some(Unit::Cm), 1));
    host.ask(Request::Stream, 500_000);
    for scan in &scans {
        assert_eq!(&host.telegram(PATIENCE).expect("a scan"), scan);
    }
    assert_eq!(host.telegram(Duration::from_millis(200)), None);
    host.ask(Request::Status, 500_000);
    let (summaries, records) = simulator.end();
    assert_eq!(records.iter().filter(|record| is_data(record)).count(), 200);
    assert_eq!(summaries[0].sent, records.len() as u64);
}

#[test]
fn lost_bytes_damage_exactly_the_telegrams_that_the_truth_names() {
    let folder = Folder::new("loss");
    let port = folder.path("front");
    let faults = Faults { loss: 0.00135, burst: 1.89 };
    let simulator = Simulator::start(SimulateOptions { faults, speed: 4.0, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    host.ask(Request::Stream, 500_000);
    let received: Vec<[u8; 32]> =
        (0..60).map(|_| Record::hash(&host.telegram(PATIENCE).expect("a scan"))).collect();
    let (_, records) = simulator.end();
    let data: Vec<&Record> = records.iter().filter(|record| is_data(record)).collect();
    let last = data.iter().position(|record| record.sha256 == received[59]).expect("was sent");
    let intact: Vec<[u8; 32]> =
        data[..=last].iter().filter(|record| record.fault.is_none()).map(|record| record.sha256).collect();
    assert_eq!(received, intact);
    assert!(data[..=last].iter().filter(|record| record.fault == Some(Fault::Loss)).count() > 15);
}

#[test]
fn two_ports_and_what_is_refused() {
    let folder = Folder::new("two");
    let ports = vec![folder.path("front"), folder.path("rear")];
    let truth = Some(folder.path("truth"));
    let simulator = Simulator::start(SimulateOptions { ports: ports.clone(), truth, ..options("".into()) });
    for port in &ports {
        let mut host = Host::open(port, 500_000);
        host.ask(Request::Stream, 500_000);
        host.telegram(PATIENCE).expect("a scan");
    }
    let (summaries, records) = simulator.end();
    assert_eq!(
        summaries.iter().map(|summary| &summary.port).collect::<Vec<_>>(),
        ports.iter().collect::<Vec<_>>()
    );
    assert_eq!(summaries.iter().map(|summary| summary.sent).sum::<u64>(), records.len() as u64);

    let (_keep, stop) = UnixStream::pair().unwrap();
    let file = folder.path("file");
    fs::write(&file, "PARAM a b\n").unwrap();
    for (options, code) in [
        (SimulateOptions::default(), 78),
        (SimulateOptions { ports: vec![file.clone()], ..SimulateOptions::default() }, 4),
        (SimulateOptions { ports: vec![folder.path("no/port")], ..SimulateOptions::default() }, 4),
        (SimulateOptions { ports: vec!["a".into(), "a".into()], ..SimulateOptions::default() }, 78),
        (SimulateOptions { speed: 0.0, ..options(folder.path("x")) }, 78),
        (SimulateOptions { looped: true, ..options(folder.path("x")) }, 78),
        (SimulateOptions { replay: Some(file), ..options(folder.path("x")) }, 78),
        (SimulateOptions { replay: Some("/no/file".into()), ..options(folder.path("x")) }, 78),
        (SimulateOptions { truth: Some("/no/file".into()), ..options(folder.path("x")) }, 1),
    ] {
        let failure = simulate(&options, &stop, |_| panic!("ready"), |_| {}).unwrap_err();
        assert_eq!(failure.kind.exit_code(), code, "{failure}");
        assert!(!failure.hint.is_empty(), "{failure}");
        assert!(fs::symlink_metadata(folder.path("x")).is_err());
    }
}
