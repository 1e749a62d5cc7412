//! Tests of the verb `simulate` with TCP servers. A host connects as to a serial server in raw mode, and receives the
//! bytes of every family as they were sent. Only one host can be connected at a time.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use scanhub_drivers::ld;
use scanhub_drivers::lms::command::Request;
use scanhub_schema::Kind;
use scanhub_sim::fault::Faults;
use scanhub_sim::options::{Scanner, SimulateOptions};
use scanhub_sim::rplidar::Model;
use scanhub_sim::simulate;
use scanhub_sim::simulate::Record;

use crate::WAIT_TIMEOUT;
use crate::bench::Simulator;

fn options(scanner: Option<Scanner>) -> SimulateOptions {
    SimulateOptions { ports: vec!["tcp:127.0.0.1:0".into()], scanner, ..SimulateOptions::default() }
}

/// Connects to the address that `simulator` reports.
fn connect(simulator: &Simulator) -> TcpStream {
    let port = simulator.ready[0].port.to_str().expect("a name");
    assert_eq!(simulator.ready[0].pty, None);
    let stream = TcpStream::connect(port.strip_prefix("tcp:").expect("a server")).expect("connected");
    stream.set_read_timeout(Some(WAIT_TIMEOUT)).expect("set");
    stream
}

fn read(stream: &mut TcpStream, len: usize) -> Vec<u8> {
    let mut bytes = vec![0; len];
    stream.read_exact(&mut bytes).expect("bytes");
    bytes
}

#[test]
fn every_family_sends_true_telegrams_over_tcp() {
    let rplidar = Scanner::Rplidar { model: Model::A1, mode: 1 };
    for (scanner, request) in [
        (None, Request::Stream.encode(0).bytes().to_vec()),
        (Some(Scanner::Ld(ld::Model::Ld19)), Vec::new()),
        (Some(rplidar), vec![0xA5, 0x82, 5, 1, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 5 ^ 1]),
    ] {
        // At four times the speed, even an LMS at 9,600 baud soon sends several scans.
        let simulator = Simulator::start(SimulateOptions { speed: 4.0, ..options(scanner) });
        let mut host = connect(&simulator);
        host.write_all(&request).expect("written");
        let bytes = read(&mut host, 2_500);
        let (summaries, records) = simulator.end();
        assert_eq!(summaries[0].eeprom_writes, 0);
        // Bytes that were sent before the server accepted the connection are lost.
        let intact = records.iter().filter(|record| record.fault.is_none());
        let found = intact.filter(|record| {
            bytes.windows(record.length).any(|window| Record::hash(window) == record.sha256)
        });
        assert!(found.count() >= 2, "{scanner:?}");
    }
}

#[test]
fn second_host_is_refused_until_the_first_leaves() {
    let simulator = Simulator::start(options(Some(Scanner::Rplidar { model: Model::A1, mode: 1 })));
    let ask = |host: &mut TcpStream| {
        host.write_all(&[0xA5, 0x52]).expect("written");
        assert_eq!(read(host, 10), [0xA5, 0x5A, 3, 0, 0, 0, 0x06, 0, 0, 0]);
    };
    let mut first = connect(&simulator);
    ask(&mut first);
    let mut second = connect(&simulator);
    assert_eq!(second.read(&mut [0; 1]).expect("turned away"), 0);
    ask(&mut first);
    drop(first);
    let end = Instant::now() + WAIT_TIMEOUT;
    let mut third = loop {
        let mut host = connect(&simulator);
        host.set_read_timeout(Some(Duration::from_millis(50))).expect("set");
        // The server closes new connections until it has detected that the first host has disconnected.
        let is_away = matches!(host.read(&mut [0; 1]), Ok(0));
        if !is_away {
            break host;
        }
        assert!(Instant::now() < end);
    };
    third.set_read_timeout(Some(WAIT_TIMEOUT)).expect("set");
    ask(&mut third);
    let taken = SimulateOptions { ports: vec![simulator.ready[0].port.clone()], ..options(None) };
    let refused = |options: SimulateOptions| {
        let (_write, stop) = std::os::unix::net::UnixStream::pair().expect("a pair");
        simulate(&options, &stop, |_| {}, |_| {}).expect_err("refused").kind
    };
    assert_eq!(refused(taken), Kind::PortBusy);
    let wrong = |port: &str| SimulateOptions { ports: vec![PathBuf::from(port)], ..options(None) };
    assert_eq!(refused(wrong("tcp:localhost")), Kind::Configuration);
}

#[test]
fn unplugged_server_returns_at_the_same_address() {
    let faults: Faults = "unplug=0.3,unplug_at=0.2".parse().expect("faults");
    let scanner = Some(Scanner::Ld(ld::Model::Ld19));
    let simulator = Simulator::start(SimulateOptions { faults, ..options(scanner) });
    let mut host = connect(&simulator);
    let mut rest = Vec::new();
    // The connection may end with a reset if bytes were in transit.
    let _ = host.read_to_end(&mut rest);
    let end = Instant::now() + WAIT_TIMEOUT;
    let address = simulator.ready[0].port.to_str().expect("a name").replace("tcp:", "");
    let mut again = loop {
        match TcpStream::connect(&address) {
            Ok(stream) => break stream,
            Err(_) => assert!(Instant::now() < end),
        }
    };
    again.set_read_timeout(Some(WAIT_TIMEOUT)).expect("set");
    read(&mut again, 470);
    drop(simulator.end());
}
