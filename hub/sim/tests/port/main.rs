//! Tests of the verb `simulate` on real ptys. A host opens the port, sends requests, and compares the received bytes
//! with the telegrams that the simulator reports. The tests wait for events, and never for a fixed time. The timeout of
//! a wait is far longer than the event needs.

#![expect(clippy::disallowed_methods, reason = "limits and periods of real time")]

mod bench;
mod rotating;
mod server;

use std::fs;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::time::Duration;

use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::lms_model::LmsModel;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Baud, Unit, Variant};
use scanhub_sim::fault::{Fault, Faults};
use scanhub_sim::machine::StartState;
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::options::SimulateOptions;
use scanhub_sim::simulate;
use scanhub_sim::simulate::Record;

use bench::{Host, Simulator, TestFolder};

/// Timeout of every wait. It matters only if a test hangs.
const WAIT_TIMEOUT: Duration = Duration::from_secs(180);

fn options(port: PathBuf) -> SimulateOptions {
    let baud = Some(Baud::B500000);
    SimulateOptions { ports: vec![port], baud, seed: 5, ..SimulateOptions::default() }
}

fn is_data(record: &Record) -> bool {
    !record.is_reply
}

#[test]
fn stream_at_500k_after_9600_matches_ground_truth() {
    let folder = TestFolder::new();
    let (port, truth) = (folder.path("front"), folder.path("truth.jsonl"));
    std::os::unix::fs::symlink("/dev/pts/999999", &port).unwrap();
    let simulator = Simulator::start(SimulateOptions {
        baud: Some(Baud::B9600),
        truth: Some(truth.clone()),
        lossless: true,
        ..options(port.clone())
    });
    assert_eq!(simulator.ready[0].port, port);
    assert_eq!(fs::read_link(&port).ok(), simulator.ready[0].pty);
    let mut host = Host::open(&port, 9_600);
    let status = host.ask(Request::Status);
    let Some(Reply::Status(status)) = Reply::decode(Telegram::check(&status).unwrap()) else { panic!() };
    assert_eq!(status.variant(), Some(Variant::HALF));
    host.ask(Request::Baud(Baud::B500000));
    host.set_rate(500_000);
    let begin = host.ask(Request::Stream);
    assert_eq!(begin[4], 0xA0);
    let received: Vec<Vec<u8>> = (0..40).map(|_| host.telegram(WAIT_TIMEOUT).expect("a scan")).collect();
    let (summaries, records) = simulator.end();
    assert!(fs::symlink_metadata(&port).is_err(), "the symlink is left");
    let sent: Vec<&Record> = records.iter().filter(|record| is_data(record)).collect();
    let first = sent.iter().position(|record| record.sha256 == Record::hash(&received[0])).expect("was sent");
    let sent = &sent[first..];
    for (telegram, record) in received.iter().zip(sent) {
        assert_eq!((Record::hash(telegram), record.fault), (record.sha256, None));
        assert_eq!(record.length, 732);
    }
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
fn requests_written_in_one_call_are_answered_at_9600() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let faults = Faults { answer: 0.001, ..Faults::default() };
    let baud = Some(Baud::B9600);
    let simulator = Simulator::start(SimulateOptions { baud, faults, ..options(port.clone()) });
    let mut host = Host::open(&port, 9_600);
    for number in 0..100 {
        host.write(Request::Stop);
        let reply = host.telegram(WAIT_TIMEOUT).unwrap_or_else(|| panic!("request {number} got no reply"));
        assert_eq!(reply[4], 0xA0);
    }
    assert_eq!(simulator.end().0[0].sent, 100);
}

#[test]
fn closed_port_loses_telegrams_and_buffers_none() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let simulator = Simulator::start(options(port.clone()));
    let mut host = Host::open(&port, 500_000);
    rustix::termios::ioctl_tiocexcl(&host.port).unwrap();
    host.ask(Request::Stream);
    simulator.record_where(|record| is_data(record) && record.fault.is_none());
    drop(host);
    for _ in 0..5 {
        simulator.record_where(|record| record.fault == Some(Fault::Unread));
    }
    let mut host = Host::open(&port, 500_000);
    let first = Record::hash(&host.telegram(WAIT_TIMEOUT).expect("a scan"));
    let mut next = simulator.record();
    while next.sha256 != first {
        assert!(next.fault.is_some(), "an intact telegram was not read");
        next = simulator.record();
    }
    assert_eq!(next.fault, None);
    simulator.end();
}

#[test]
fn wrong_rate_garbles_both_directions() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let simulator = Simulator::start(options(port.clone()));
    let mut host = Host::open(&port, 500_000);
    host.ask(Request::Stream);
    host.set_rate(250_000);
    // Skip the record of the reply to the previous request. The record of the first garbled scan follows.
    while simulator.record().fault != Some(Fault::Baud) {}
    host.write(Request::Status);
    let mut garbled = 1;
    while garbled < 4 {
        let record = simulator.record();
        assert!(!record.is_reply, "replied at the wrong rate");
        garbled += usize::from(record.fault == Some(Fault::Baud));
    }
    // Drop the bytes in the host's buffer. They are garbled, except for a scan that arrived before the change of rate.
    let mut buffer = vec![0; 30_000];
    assert!(rustix::io::read(&host.port, &mut buffer).unwrap() > 0);
    host.set_rate(500_000);
    assert_eq!(host.telegram(WAIT_TIMEOUT).expect("a scan").len(), 732);
    simulator.end();
}

#[test]
fn host_that_does_not_read_causes_an_overrun() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let simulator = Simulator::start(SimulateOptions { speed: 10.0, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    host.ask(Request::Stream);
    simulator.record_where(|record| record.fault == Some(Fault::Overrun));
    drop(host);
    simulator.end();
}

#[test]
fn lossless_line_waits_for_the_host_to_read() {
    let folder = TestFolder::new();
    let ports = ["waits", "loses"].map(|name| folder.path(name));
    let start = |port: &PathBuf, lossless| {
        Simulator::start(SimulateOptions { lossless, speed: 10.0, ..options(port.clone()) })
    };
    let [waits, loses] = [start(&ports[0], true), start(&ports[1], false)];
    let mut hosts = ports.each_ref().map(|port| Host::open(port, 500_000));
    hosts.iter_mut().for_each(|host| drop(host.ask(Request::Stream)));
    for _ in 0..100 {
        loses.record_where(|record| record.fault == Some(Fault::Overrun));
    }
    let received: Vec<Vec<u8>> = (0..40).map(|_| hosts[0].telegram(WAIT_TIMEOUT).expect("a scan")).collect();
    loses.end();
    let (_, records) = waits.end();
    let sent: Vec<&Record> = records.iter().filter(|record| is_data(record)).collect();
    for (telegram, record) in received.iter().zip(sent) {
        assert_eq!((Record::hash(telegram), record.fault), (record.sha256, None));
    }
}

#[test]
fn replay_is_sent_once_in_order_then_line_is_silent() {
    let folder = TestFolder::new();
    let (port, file) = (folder.path("front"), folder.path("stream.bin"));
    let scans: Vec<Vec<u8>> =
        (0..100u16).map(|i| measured::encode(3, Unit::Cm, &[700 + i; 361], 0x11).bytes().to_vec()).collect();
    let mut bytes = Request::Stop.encode(0).bytes().to_vec();
    bytes.extend_from_slice(lms::reply::mode_reply(3, true, 0x10).bytes());
    bytes.extend(scans.concat());
    fs::write(&file, bytes).unwrap();
    let replay = Some(file);
    let lossless = true;
    let simulator = Simulator::start(SimulateOptions { replay, lossless, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    let status = host.ask(Request::Status);
    let Some(Reply::Status(status)) = Reply::decode(Telegram::check(&status).unwrap()) else { panic!() };
    assert_eq!((status.unit(), status.mode().0), (Some(Unit::Cm), 1));
    host.ask(Request::Stream);
    for (number, scan) in scans.iter().enumerate() {
        let telegram = host.telegram(WAIT_TIMEOUT).expect("a scan");
        assert!(&telegram == scan, "not scan {number}; sent: {:?}", simulator.faults());
    }
    // The scanner still replies to a request. The counts below prove that it sent no more scans.
    host.ask(Request::Status);
    let (summaries, records) = simulator.end();
    assert_eq!(records.iter().filter(|record| is_data(record)).count(), 100);
    assert_eq!(summaries[0].sent, records.len() as u64);
}

#[test]
fn only_telegrams_marked_intact_are_received() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let faults = Faults { loss: 0.00135, burst: 1.89, ..Faults::default() };
    let simulator = Simulator::start(SimulateOptions { faults, speed: 2.0, ..options(port.clone()) });
    let mut host = Host::open(&port, 500_000);
    host.ask(Request::Stream);
    let received: Vec<[u8; 32]> =
        (0..60).map(|_| Record::hash(&host.telegram(WAIT_TIMEOUT).expect("a scan"))).collect();
    let (_, records) = simulator.end();
    let data: Vec<&Record> = records.iter().filter(|record| is_data(record)).collect();
    let last = data.iter().position(|record| record.sha256 == received[59]).expect("was sent");
    let intact: Vec<[u8; 32]> =
        data[..=last].iter().filter(|record| record.fault.is_none()).map(|record| record.sha256).collect();
    assert_eq!(received, intact);
    assert!(data[..=last].iter().filter(|record| record.fault == Some(Fault::Loss)).count() > 15);
}

#[test]
fn simulates_two_ports_and_refuses_invalid_options() {
    let folder = TestFolder::new();
    let ports = vec![folder.path("front"), folder.path("rear")];
    let truth = Some(folder.path("truth"));
    let simulator = Simulator::start(SimulateOptions { ports: ports.clone(), truth, ..options("".into()) });
    for port in &ports {
        let mut host = Host::open(port, 500_000);
        host.ask(Request::Stream);
        host.telegram(WAIT_TIMEOUT).expect("a scan");
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
        (SimulateOptions { address: 128, ..options(folder.path("x")) }, 78),
        (SimulateOptions { pollution: 101, ..options(folder.path("x")) }, 78),
        (
            SimulateOptions {
                family: LmsModel::Lms211,
                variant: Some(Variant::HALF),
                ..options(folder.path("x"))
            },
            78,
        ),
        (SimulateOptions { replay: Some(file), ..options(folder.path("x")) }, 66),
        (SimulateOptions { replay: Some("/no/file".into()), ..options(folder.path("x")) }, 66),
        (SimulateOptions { truth: Some("/no/file".into()), ..options(folder.path("x")) }, 73),
    ] {
        let failure = simulate(&options, &stop, |_| panic!("ready"), |_| {}).unwrap_err();
        assert_eq!(failure.kind.exit_code(), code, "{failure}");
        assert!(!failure.hint.is_empty(), "{failure}");
        assert!(fs::symlink_metadata(folder.path("x")).is_err());
    }
}

#[test]
fn unplugged_port_disappears_and_returns_by_name() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let faults: Faults = "unplug=0.3,unplug_at=1,unplug_every=1".parse().unwrap();
    let state = StartState::Operating(OperatingMode::All);
    let simulator = Simulator::start(SimulateOptions { faults, state, ..options(port.clone()) });
    let first = fs::read_link(&port).unwrap();
    for _ in 0..2 {
        // On a busy machine, the port may be unplugged before a scan is complete, so open it until a scan arrives.
        let mut plugged = None;
        wait_until("a scan", || {
            plugged = Host::try_open(&port, 500_000).ok();
            plugged.as_mut().is_some_and(|host| host.telegram(WAIT_TIMEOUT).is_some())
        });
        let host = plugged.expect("the port of the scan");
        // The host of a pty reads the end of file when the other side is closed.
        let mut buffer = [0; 4096];
        wait_until("it is unplugged", || rustix::io::read(&host.port, &mut buffer) == Ok(0));
        assert!(rustix::termios::tcgetattr(&host.port).is_err(), "the port is there");
        simulator.record_where(|record| record.fault == Some(Fault::Unplug));
        wait_until("it is back", || fs::symlink_metadata(&port).is_ok());
    }
    assert!(fs::read_link(&port).unwrap().starts_with("/dev/pts"), "{first:?}");
    simulator.end();
    assert!(fs::symlink_metadata(&port).is_err(), "the symlink is left");
}

fn wait_until(condition: &str, mut is_true: impl FnMut() -> bool) {
    let end = std::time::Instant::now() + WAIT_TIMEOUT;
    while !is_true() {
        assert!(std::time::Instant::now() < end, "not: {condition}");
        std::thread::sleep(Duration::from_millis(1));
    }
}
