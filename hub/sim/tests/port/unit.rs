//! A scanner of Slamtec on a real pty: what a host reads of it is what the truth says.

use std::fs;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_sim::fault::Fault;
use scanhub_sim::options::{Scanner, SimulateOptions};
use scanhub_sim::rplidar::Model;
use scanhub_sim::simulate;
use scanhub_sim::simulate::Record;

use crate::PATIENCE;
use crate::host::Host;
use crate::simulator::{Folder, Simulator};

/// Reads until there are `len` bytes.
fn read(host: &Host, len: usize) -> Vec<u8> {
    let (end, mut bytes) = (Instant::now() + PATIENCE, Vec::new());
    while bytes.len() < len {
        assert!(Instant::now() < end, "{} of {len} bytes", bytes.len());
        let timeout = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        poll(&mut [PollFd::new(&host.port, PollFlags::IN)], Some(&timeout)).expect("a poll");
        let mut buffer = [0; 256];
        let most = buffer.len().min(len - bytes.len());
        let count = rustix::io::read(&host.port, &mut buffer[..most]).unwrap_or(0);
        bytes.extend(&buffer[..count]);
    }
    bytes
}

fn say(host: &Host, request: &[u8]) {
    assert_eq!(rustix::io::write(&host.port, request), Ok(request.len()));
}

#[test]
fn what_a_host_reads_is_what_the_truth_says() {
    for (model, mode) in [(Model::A1, 1), (Model::S2, 1)] {
        let folder = Folder::new();
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
        say(&host, &[0xA5, 0x50]);
        let info = read(&host, 27);
        assert_eq!(info[..8], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, model.id()]);
        say(&host, &[0xA5, 0x82, 5, 1, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 5 ^ 1]);
        let descriptor = read(&host, 7);
        let form = model.modes()[1].form;
        assert_eq!(descriptor, [0xA5, 0x5A, form.packet_len() as u8, 0, 0, 0x40, form.answer()]);
        let packets = read(&host, 50 * form.packet_len());
        let (summaries, _) = simulator.end();
        assert_eq!(summaries[0].eeprom_writes, 0);
        let truth = fs::read_to_string(&truth).expect("the truth");
        let mut told = truth.lines();
        for packet in packets.chunks(form.packet_len()) {
            let sum = packet[2..].iter().fold(0, |sum, byte| sum ^ byte);
            assert_eq!((packet[0], packet[1]), (0xA0 | sum & 15, 0x50 | sum >> 4));
            let sha256 = Record::hash(packet).map(|byte| format!("{byte:02x}")).concat();
            assert!(told.any(|line| line.contains(&sha256)), "the truth has not this packet, or earlier");
        }
    }
}

/// The host opens the port after both restarts, so it does not matter how late it is.
#[test]
fn it_restarts_after_a_dip_and_a_power_cycle() {
    for model in [Model::A1, Model::S2] {
        let folder = Folder::new();
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
        say(&host, &[0xA5, 0x50]);
        assert_eq!(read(&host, 27)[..8], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, model.id()]);
        let (summaries, _) = simulator.end();
        assert_eq!((summaries[0].sent, summaries[0].eeprom_writes), (3, 0));
    }
}

#[test]
fn a_host_at_another_rate_hears_noise_and_what_it_has_not_is_refused() {
    let folder = Folder::new();
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
