//! Tests of a session on a port without a configured family: scans arrive soon, no byte is lost between the search and
//! the session, and the search restarts after the scanner was unplugged.

use scanhub_drivers::line::{self, Protocol, ScannerSession as _, SessionStats, State};
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::search::Memory;
use scanhub_drivers::{PortSession, Settings, ld};
use scanhub_schema::{Counter, Counters, Family, MICROS, MILLIS, Nanos, Status};
use scanhub_sim::device::Device;
use scanhub_sim::rplidar::Model;

use super::{Bench, Host, HostAction};

/// A host that runs a session without a configured family, and ends when it has received enough scans.
pub(crate) struct AutoHost {
    pub(crate) session: PortSession,
    scans: u64,
    /// Number of scans after which the host ends.
    wanted_scans: u64,
    bytes: u64,
}

impl Host for AutoHost {
    type Result = u64;

    fn protocol(&mut self) -> &mut impl Protocol {
        &mut self.session
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.bytes += len as u64;
        self.session.commit(now, len);
        self.check_counters();
    }

    fn poll(&mut self) -> HostAction<u64> {
        loop {
            if self.scans >= self.wanted_scans {
                return HostAction::Done(self.scans);
            }
            let (scans, expected) = (&mut self.scans, self.wanted_scans);
            let count = |event: line::Event<'_>| {
                *scans += match event {
                    line::Event::Telegram(received) => {
                        u64::from(received.contents.is_some_and(|whole| whole.scan.is_some()))
                    }
                    line::Event::Scan(_) => 1,
                };
                (*scans >= expected).then_some(*scans)
            };
            let event = HostAction::next_action(&mut self.session, count);
            if matches!(event, HostAction::Wait(_)) && self.session.advance() {
                self.check_counters();
                continue;
            }
            return event;
        }
    }
}

impl AutoHost {
    /// Checks that the counters, including the counters of the status, contain every byte that was read.
    fn check_counters(&self) {
        let stats = self.session.stats();
        let SessionStats { read, in_telegrams, acknowledge, discarded, buffered, .. } = stats;
        assert_eq!(read, self.bytes);
        assert_eq!(read, in_telegrams + acknowledge + discarded + buffered, "{stats:?}");
        let mut counters = Counters::default();
        self.session.add_counters(&mut counters);
        assert_eq!([counters[Counter::BytesRead], counters[Counter::BytesBuffered]], [read, buffered]);
        assert_eq!(counters[Counter::BytesDiscarded], discarded);
    }
}

fn host(memory: Option<Memory>, now: Nanos) -> AutoHost {
    let settings = Settings { max_beams: Some(3_240), ..Settings::default() };
    let session = PortSession::begin(None, &settings, memory, now);
    AutoHost { session, scans: 0, wanted_scans: 1, bytes: 0 }
}

fn open(device: Option<Box<dyn Device>>, memory: Option<Memory>, seed: u64) -> Bench<AutoHost> {
    Bench::with_search(|now| host(memory, now), device, memory, seed)
}

/// Runs until the next scan arrives. Returns the time until then.
fn next_scan(bench: &mut Bench<AutoHost>, context: &str) -> Nanos {
    let begin = bench.now;
    bench.host.wanted_scans = bench.host.scans + 1;
    bench.run(begin + 60_000 * MILLIS).unwrap_or_else(|| {
        let session = &bench.host.session;
        panic!("{context}: {:?}, {:?}, at {}", session.state(), session.problem(), session.rate())
    });
    bench.now - begin
}

/// Creates a scanner from a seed.
type CreateScanner = Box<dyn Fn(u64) -> Box<dyn Device>>;

fn scanners() -> Vec<(&'static str, Family, CreateScanner)> {
    vec![
        ("lms idle at 9600", Family::Lms, Box::new(|seed| super::lms(Baud::B9600, false, seed))),
        ("lms idle at 38400", Family::Lms, Box::new(|seed| super::lms(Baud::B38400, false, seed))),
        ("lms streams at 500000", Family::Lms, Box::new(|seed| super::lms(Baud::B500000, true, seed))),
        ("lms streams at 38400", Family::Lms, Box::new(|seed| super::lms(Baud::B38400, true, seed))),
        ("ld19", Family::Ld, Box::new(|seed| super::ld(ld::Model::Ld19, seed))),
        ("stl27l", Family::Ld, Box::new(|seed| super::ld(ld::Model::Stl27l, seed))),
        ("a1 idle", Family::Rplidar, Box::new(|seed| super::rplidar(Model::A1, false, 0, seed))),
        ("s2 streams", Family::Rplidar, Box::new(|seed| super::rplidar(Model::S2, true, 0, seed))),
        ("c1 idle", Family::Rplidar, Box::new(|seed| super::rplidar(Model::C1, false, 0, seed))),
    ]
}

#[test]
fn finds_every_family_and_saves_the_scanner() {
    for (name, family, create) in scanners() {
        let (mut times, mut remembered) = (Vec::new(), Vec::new());
        for seed in 0..8 {
            let mut bench = open(Some(create(seed)), None, seed);
            assert_eq!((bench.host.session.family(), bench.host.session.state()), (None, State::Probing));
            times.push(next_scan(&mut bench, name) / MILLIS);
            let session = &bench.host.session;
            assert_eq!(session.family(), Some(family), "{name}");
            bench.run(bench.now + 100 * MILLIS);
            let memory = bench.host.session.memory().expect("it streams");
            assert_eq!(memory.family, family);
            assert_eq!(bench.device.as_ref().map_or(0, |device| device.eeprom_writes()), 0);
            let mut again = open(Some(create(seed)), Some(memory), seed);
            remembered.push(next_scan(&mut again, name) / MILLIS);
        }
        times.sort_unstable();
        remembered.sort_unstable();
        println!("{name:22} first scan {times:?} ms, remembered {remembered:?} ms");
        assert!(times[7] <= 9_000, "{name}: {times:?}");
    }
}

#[test]
fn telegrams_of_the_search_reach_the_session() {
    for seed in 0..20 {
        // The search recognizes both scanners by their streams, so it sends no byte before the session starts.
        for (name, device, most_lost) in [
            ("lms", super::lms(Baud::B500000, true, seed), 814),
            ("ld", super::ld(ld::Model::Ld19, seed), 2 * 47),
        ] {
            let mut bench = open(Some(device), None, seed);
            next_scan(&mut bench, name);
            let at_rate: u64 = bench.read.iter().map(|(_, bytes)| bytes.len() as u64).sum();
            let stats = bench.host.session.stats();
            // All bytes that were read at the last rate are in telegrams, except those of an incomplete first telegram.
            let lost = at_rate - stats.in_telegrams - stats.buffered;
            assert!(lost < most_lost, "{name}, seed {seed}: {lost} of {at_rate}");
            assert_eq!(bench.written.is_empty(), name == "ld", "{name}, seed {seed}");
        }
    }
}

#[test]
fn searches_again_10_s_after_the_scanner_disappears() {
    let mut bench = open(Some(super::ld(ld::Model::Ld19, 1)), None, 1);
    next_scan(&mut bench, "ld19");
    bench.device = None;
    let disconnected_at = bench.now;
    bench.host.wanted_scans = u64::MAX;
    bench.run(disconnected_at + 9_900 * MILLIS);
    assert_eq!(bench.host.session.family(), Some(Family::Ld), "its session handles silence");
    bench.run(disconnected_at + 10_200 * MILLIS);
    assert_eq!(bench.host.session.family(), None);
    assert!(bench.host.session.problem().is_some(), "the problem of the session is reported");
    let mut status = Status::default();
    status.set_sensor_type("LD19");
    bench.host.session.describe(&mut status);
    assert_eq!(status.sensor_type(), "");
    bench.device = Some(super::rplidar(Model::A1, false, 0, 1));
    next_scan(&mut bench, "a1");
    assert_eq!(bench.host.session.family(), Some(Family::Rplidar));
    assert_eq!(bench.host.session.memory().map(|memory| memory.family), Some(Family::Rplidar));
}

#[test]
fn scans_arrive_at_a_port_that_rejects_rates() {
    for (name, family, create) in scanners() {
        for impossible in [[230_400, 19_200], [921_600, 460_800], [500_000, 256_000], [1_000_000, 38_400]] {
            let device = create(1);
            if impossible.contains(&device.rate()) {
                continue;
            }
            let mut bench = open(Some(device), None, 1);
            bench.unsupported_rates = impossible.to_vec();
            if impossible.contains(&230_400) {
                bench.host.session.reject_rate(bench.now);
            }
            next_scan(&mut bench, name);
            let session = &bench.host.session;
            assert_eq!(session.family(), Some(family), "{name}");
            if family == Family::Lms && impossible.contains(&500_000) {
                // The session did not switch the scanner to 500,000 baud, because the port does not support this rate.
                assert_eq!(session.rate(), 38_400, "{name}");
                let problem = session.problem().map(|problem| problem.to_string()).unwrap_or_default();
                assert!(problem.starts_with("the port does not support 500000 baud"), "{name}: {problem}");
            }
        }
    }
}

#[test]
fn restored_beams_stay_unless_the_rate_differs() {
    for (scanner, restored, expected) in [
        (ld::Model::Ld19, ld::Model::Ld14p, 666),
        (ld::Model::Ld14p, ld::Model::Ld19, 450),
        (ld::Model::Stl27l, ld::Model::Ld19, 2_160),
        (ld::Model::Ld19, ld::Model::Stl27l, 450),
    ] {
        let memory = Memory { family: Family::Ld, stream_rate: restored.baud(), reply_rate: restored.baud() };
        let begin = |now| {
            let mut host = host(Some(memory), now);
            let features = scanhub_drivers::features(Family::Ld);
            let model = features.models.iter().find(|model| model.name == restored.name());
            host.session.restore_beams(*model.expect("a model"), restored.beams());
            host
        };
        let mut bench = Bench::with_search(begin, Some(super::ld(scanner, 1)), Some(memory), 1);
        next_scan(&mut bench, scanner.name());
        assert_eq!(bench.host.session.beams(), Some(expected), "{scanner:?} after {restored:?}");
    }
}

#[test]
fn paused_search_sends_nothing() {
    let mut bench = open(Some(super::lms(Baud::B9600, false, 3)), None, 3);
    bench.host.session.control(line::Control::Pause, bench.now);
    bench.run(bench.now + 5_000 * MILLIS);
    assert_eq!((bench.host.session.state(), bench.written.len()), (State::Paused, 0));
    bench.host.session.control(line::Control::Resume, bench.now);
    next_scan(&mut bench, "after the pause");
}

#[test]
fn silent_line_is_reported_with_families_and_time() {
    let mut bench = open(None, None, 4);
    bench.run(bench.now + 13_000 * MILLIS);
    let problem = bench.host.session.problem().map(|problem| problem.to_string());
    let expected = "no scanner replies (looked for lms, ld, rplidar for 10 s): power, cable?";
    assert_eq!(problem.as_deref(), Some(expected));
}

#[test]
fn unrecognized_bytes_are_reported() {
    let mut bench = open(None, None, 5).with_noise(200 * MICROS);
    bench.run(bench.now + 13_000 * MILLIS);
    let problem = bench.host.session.problem().map(|problem| problem.to_string()).unwrap_or_default();
    assert!(problem.ends_with(" bytes/s arrive, but scanhub does not recognize the scanner"), "{problem}");
    assert_eq!(bench.host.session.family(), None);
}
