//! A scanner of LDROBOT on a real pty: a session that reads as the hub does hears what the truth says.

use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_drivers::ld::packet::LEN;
use scanhub_drivers::ld::{Model, Session};
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::{Settings, features};
use scanhub_schema::{Failure, Family, Nanos};
use scanhub_sim::fault::Faults;
use scanhub_sim::options::{Scanner, SimulateOptions};
use scanhub_sim::port::now_ns;
use scanhub_sim::simulate;
use scanhub_sim::simulate::Record;

use crate::PATIENCE;
use crate::host::Host;
use crate::simulator::{Folder, Simulator};

/// Drives `session` on the port of `host` until it has told `turns`; the packets that came.
fn hear(session: &mut Session, host: &Host, turns: usize) -> Vec<[u8; LEN]> {
    let (end, mut packets, mut told) = (Instant::now() + PATIENCE, Vec::new(), 0);
    while told < turns {
        assert!(Instant::now() < end, "{told} turns, {:?}", session.account());
        let (until, flags) = loop {
            match session.poll_output() {
                Output::SetRate(rate) => host.set_rate(rate),
                Output::Event(Event::Telegram(received)) => {
                    packets.extend(received.bytes.as_chunks::<LEN>().0)
                }
                Output::Event(Event::Scan(turn)) => {
                    told += 1;
                    assert!(turn.first < turn.last && turn.last < now_ns());
                }
                Output::Rest(until) => break (until, PollFlags::empty()),
                Output::Wait { until, .. } => break (until, PollFlags::IN),
                output => panic!("{output:?}"),
            }
        };
        let left: Nanos = until.saturating_sub(now_ns()).min(100_000_000);
        let timeout = Timespec { tv_sec: 0, tv_nsec: left as _ };
        poll(&mut [PollFd::new(&host.port, flags)], Some(&timeout)).expect("a poll");
        let len = rustix::io::read(&host.port, session.spare()).unwrap_or(0);
        session.commit(now_ns(), len);
        if len == 0 && now_ns() >= until {
            session.handle_timeout(now_ns());
        }
    }
    packets
}

#[test]
fn every_model_is_heard_bit_for_bit_as_the_truth_says() {
    for model in [Model::Ld19, Model::Stl27l] {
        let folder = Folder::new();
        let port = folder.path("front");
        let simulator = Simulator::start(SimulateOptions {
            ports: vec![port.clone()],
            scanner: Some(Scanner::Ld(model)),
            lossless: true,
            ..SimulateOptions::default()
        });
        let settings = Settings::default();
        let host = Host::open(&port, features(Family::Ld).auto.baud);
        let mut session = Session::new(settings, now_ns());
        let packets = hear(&mut session, &host, 20);
        assert_eq!((session.state(), session.model()), (State::Streaming, Some(model)));
        let (summaries, records) = simulator.end();
        assert_eq!(summaries[0].eeprom_writes, 0);
        let first = Record::hash(&packets[0]);
        let first = records.iter().position(|record| record.sha256 == first).expect("was sent");
        for (packet, record) in packets.iter().zip(&records[first..]) {
            assert_eq!((Record::hash(packet), record.length, record.fault), (record.sha256, LEN, None));
            assert!(!record.is_reply);
        }
        assert_eq!(session.turn_counts().incomplete, 0, "{:?}", session.turn_counts());
    }
}

#[test]
fn faults_are_told_and_what_an_ld_has_not_is_refused() {
    let folder = Folder::new();
    let port = folder.path("front");
    let scanner = Some(Scanner::Ld(Model::Ld06));
    let of = || SimulateOptions { ports: vec![port.clone()], scanner, ..SimulateOptions::default() };
    let faults: Faults = "truncate=0.2,power_every=0.3".parse().expect("faults");
    let simulator = Simulator::start(SimulateOptions { faults, boot: Duration::from_millis(50), ..of() });
    let host = Host::open(&port, Model::Ld06.baud());
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
