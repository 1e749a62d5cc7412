//! Tests of rotating scanners on a real pty: a host receives the packets that the truth file lists.

use std::fs;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_drivers::ld;
use scanhub_drivers::ld::LdSession;
use scanhub_drivers::ld::packet::PACKET_LEN;
use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _, State};
use scanhub_drivers::{Settings, features, lms};
use scanhub_schema::{Failure, Family, Nanos};
use scanhub_sim::fault::{Fault, Faults};
use scanhub_sim::options::{Scanner, SimulateOptions};
use scanhub_sim::port::now_ns;
use scanhub_sim::rplidar::Model;
use scanhub_sim::simulate;
use scanhub_sim::simulate::Record;

use crate::WAIT_TIMEOUT;
use crate::bench::{Host, Simulator, TestFolder};

/// Reads bytes until at least `len` bytes have arrived.
fn read(host: &Host, len: usize) -> Vec<u8> {
    let (end, mut bytes) = (Instant::now() + WAIT_TIMEOUT, Vec::new());
    while bytes.len() < len {
        assert!(Instant::now() < end, "{} of {len} bytes", bytes.len());
        let timeout = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        poll(&mut [PollFd::new(&host.port, PollFlags::IN)], Some(&timeout)).expect("a poll");
        let mut buffer = [0; 256];
        let maximum = buffer.len().min(len - bytes.len());
        let count = rustix::io::read(&host.port, &mut buffer[..maximum]).unwrap_or(0);
        bytes.extend(&buffer[..count]);
    }
    bytes
}

fn send(host: &Host, request: &[u8]) {
    assert_eq!(rustix::io::write(&host.port, request), Ok(request.len()));
}

#[test]
fn received_packets_match_the_truth_file() {
    for (model, mode) in [(Model::A1, 1), (Model::S2, 1)] {
        let folder = TestFolder::new();
        let (port, truth) = (folder.path("front"), folder.path("truth.jsonl"));
        let simulator = Simulator::start(SimulateOptions {
            ports: vec![port.clone()],
            scanner: Some(Scanner::Rplidar { model, mode }),
            boot: Duration::from_millis(50),
            truth: Some(truth.clone()),
            lossless: true,
            ..SimulateOptions::default()
        });
        let host = Host::open(&port, model.baud());
        send(&host, &[0xA5, 0x50]);
        let info = read(&host, 27);
        assert_eq!(info[..8], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, model.id()]);
        send(&host, &[0xA5, 0x82, 5, 1, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 5 ^ 1]);
        let descriptor = read(&host, 7);
        let form = model.modes()[1].form;
        assert_eq!(descriptor, [0xA5, 0x5A, form.packet_len() as u8, 0, 0, 0x40, form.response_type()]);
        let packets = read(&host, 50 * form.packet_len());
        let (summaries, _) = simulator.end();
        assert_eq!(summaries[0].eeprom_writes, 0);
        let truth = fs::read_to_string(&truth).expect("the truth");
        let mut truth_lines = truth.lines();
        for packet in packets.chunks(form.packet_len()) {
            let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
            assert_eq!((packet[0], packet[1]), (0xA0 | sum & 15, 0x50 | sum >> 4));
            let sha256 = Record::hash(packet).map(|byte| format!("{byte:02x}")).concat();
            assert!(
                truth_lines.any(|line| line.contains(&sha256)),
                "the truth does not contain this packet, or has it before the last one"
            );
        }
    }
}

/// The scanner restarts after a dip of the voltage, and after a power cycle. The host opens the port after both
/// restarts, so it does not matter when the host runs.
#[test]
fn rplidar_restarts_after_brownout_and_power_cycle() {
    for model in [Model::A1, Model::S2] {
        let folder = TestFolder::new();
        let port = folder.path("front");
        let simulator = Simulator::start(SimulateOptions {
            ports: vec![port.clone()],
            scanner: Some(Scanner::Rplidar { model, mode: 1 }),
            faults: "brownout_at=0.5,power_at=3".parse().expect("faults"),
            boot: Duration::from_millis(50),
            ..SimulateOptions::default()
        });
        for _ in 0..2 {
            let boot_message = simulator.record();
            assert!(boot_message.is_reply && boot_message.length == 64, "{boot_message:?}");
        }
        let host = Host::open(&port, model.baud());
        send(&host, &[0xA5, 0x50]);
        assert_eq!(read(&host, 27)[..8], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, model.id()]);
        let (summaries, _) = simulator.end();
        assert_eq!((summaries[0].sent, summaries[0].eeprom_writes), (3, 0));
    }
}

#[test]
fn wrong_rate_garbles_and_unsupported_options_fail() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let of = |model| SimulateOptions {
        ports: vec![port.clone()],
        scanner: Some(Scanner::Rplidar { model, mode: 0 }),
        state: scanhub_sim::options::parse_state("streaming").expect("a state"),
        ..SimulateOptions::default()
    };
    let simulator = Simulator::start(of(Model::C1));
    let host = Host::open(&port, 115_200);
    simulator.record_where(|record| record.fault == Some(Fault::Baud));
    host.set_rate(460_800);
    let intact = simulator.record_where(|record: &Record| record.fault.is_none());
    assert_eq!((intact.length, intact.is_reply), (5, false));
    drop((host, simulator.end()));
    let refused = |options: SimulateOptions| {
        let (_write, stop) = std::os::unix::net::UnixStream::pair().expect("a pair");
        simulate(&options, &stop, |_| {}, |_| {}).expect_err("refused")
    };
    let replay = refused(SimulateOptions { replay: Some("/no/file".into()), ..of(Model::A1) });
    assert!(replay.message.contains("a1 has no recording") && replay.kind.exit_code() == 78, "{replay}");
    let state = scanhub_sim::options::parse_state("means").expect("a state");
    assert!(refused(SimulateOptions { state, ..of(Model::A1) }).message.contains("no state"));
}

/// Runs `session` on the port of `host` until the session has delivered this number of `revolutions`. Returns the
/// packets that it received.
fn receive(session: &mut LdSession, host: &Host, revolutions: usize) -> Vec<[u8; PACKET_LEN]> {
    let (end, mut packets, mut delivered) = (Instant::now() + WAIT_TIMEOUT, Vec::new(), 0);
    while delivered < revolutions {
        assert!(Instant::now() < end, "{delivered} revolutions, {:?}", session.stats());
        let (until, flags) = loop {
            match session.poll_action() {
                Action::SetRate(rate) => host.set_rate(rate),
                Action::Event(Event::Telegram(received)) => {
                    packets.extend(received.bytes.as_chunks::<PACKET_LEN>().0)
                }
                Action::Event(Event::Scan(revolution)) => {
                    delivered += 1;
                    assert!(revolution.first < revolution.last && revolution.last < now_ns());
                }
                Action::SleepUntil(until) => break (until, PollFlags::empty()),
                Action::Wait { until, .. } => break (until, PollFlags::IN),
                output => panic!("{output:?}"),
            }
        };
        let left: Nanos = until.saturating_sub(now_ns()).min(100_000_000);
        let timeout = Timespec { tv_sec: 0, tv_nsec: left as _ };
        poll(&mut [PollFd::new(&host.port, flags)], Some(&timeout)).expect("a poll");
        let len = rustix::io::read(&host.port, session.read_buffer()).unwrap_or(0);
        session.commit(now_ns(), len);
        if len == 0 && now_ns() >= until {
            session.handle_timeout(now_ns());
        }
    }
    packets
}

#[test]
fn ld_packets_match_the_recorded_truth() {
    for model in [ld::Model::Ld19, ld::Model::Stl27l] {
        let folder = TestFolder::new();
        let port = folder.path("front");
        let simulator = Simulator::start(SimulateOptions {
            ports: vec![port.clone()],
            scanner: Some(Scanner::Ld(model)),
            lossless: true,
            ..SimulateOptions::default()
        });
        let settings = Settings::default();
        let host = Host::open(&port, features(Family::Ld).defaults.baud);
        let mut session = LdSession::new(settings, now_ns());
        let packets = receive(&mut session, &host, 20);
        assert_eq!((session.state(), session.model()), (State::Streaming, Some(model)));
        let (summaries, records) = simulator.end();
        assert_eq!(summaries[0].eeprom_writes, 0);
        let first = Record::hash(&packets[0]);
        let first = records.iter().position(|record| record.sha256 == first).expect("was sent");
        for (packet, record) in packets.iter().zip(&records[first..]) {
            assert_eq!(
                (Record::hash(packet), record.length, record.fault),
                (record.sha256, PACKET_LEN, None)
            );
            assert!(!record.is_reply);
        }
        assert_eq!(session.revolution_counts().incomplete, 0, "{:?}", session.revolution_counts());
    }
}

#[test]
fn ld_records_faults_and_refuses_foreign_options() {
    let folder = TestFolder::new();
    let port = folder.path("front");
    let scanner = Some(Scanner::Ld(ld::Model::Ld06));
    let of = || SimulateOptions { ports: vec![port.clone()], scanner, ..SimulateOptions::default() };
    let faults: Faults = "truncate=0.2,power_every=0.3".parse().expect("faults");
    let simulator = Simulator::start(SimulateOptions { faults, boot: Duration::from_millis(50), ..of() });
    let host = Host::open(&port, ld::Model::Ld06.baud());
    for fault in ["truncated", "power"] {
        simulator.record_where(|record| record.fault.is_some_and(|found| found.name() == fault));
    }
    drop((host, simulator.end()));
    let refused = |options: SimulateOptions| -> Failure {
        let (_write, stop) = std::os::unix::net::UnixStream::pair().expect("a pair");
        simulate(&options, &stop, |_| {}, |_| {}).expect_err("refused")
    };
    let unit = Some(lms::variant::Unit::Cm);
    let failure = refused(SimulateOptions { unit, ..of() });
    assert!(failure.message.contains("ld06 has no unit") && failure.kind.exit_code() == 78, "{failure}");
    let replay = Some("/no/file".into());
    assert_eq!(refused(SimulateOptions { replay, ..of() }).kind.exit_code(), 66);
}
