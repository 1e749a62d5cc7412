//! Scanners of all models and states are found, in time, and get no byte that they should not get.

use scanhub_drivers::ld;
use scanhub_drivers::line::Protocol as _;
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::search::{Found, PortKind, Search};
use scanhub_schema::{Family, MILLIS, Nanos};
use scanhub_sim::device::Device;
use scanhub_sim::rplidar::Model;

use super::bench::{self, Bench};

/// Creates a scanner with a seed.
type Create = Box<dyn Fn(u64) -> Box<dyn Device>>;

/// Returns all models and states: the name, the expected result, and a function that creates the scanner.
pub(super) fn scanners() -> Vec<(String, Found, Create)> {
    let mut all: Vec<(String, Found, Create)> = Vec::new();
    for baud in Baud::ALL {
        for streams in [false, true] {
            let found = Found { family: Family::Lms, model: None, rate: Some(baud.rate()) };
            let create = Box::new(move |seed| bench::lms(baud, streams, seed));
            all.push((format!("lms {} {streams}", baud.rate()), found, create));
        }
    }
    for model in ld::Model::ALL {
        let found = Found { family: Family::Ld, model: None, rate: Some(model.baud()) };
        all.push((model.name().into(), found, Box::new(move |seed| bench::ld(model, seed))));
    }
    for model in Model::ALL {
        for (state, streams, health) in [("idle", false, 0), ("streams", true, 0), ("error", false, 2)] {
            let found =
                Found { family: Family::Rplidar, model: Some(model.name()), rate: Some(model.baud()) };
            let create = Box::new(move |seed| bench::rplidar(model, streams, health, seed));
            all.push((format!("{} {state}", model.name()), found, create));
        }
    }
    all
}

/// Finds each scanner with 20 seeds, and returns the times.
fn find_all(faults: &str, port: PortKind) -> Vec<Nanos> {
    let mut times = Vec::new();
    for (name, expected, create) in scanners() {
        let expected = Found { rate: expected.rate.filter(|_| port == PortKind::Serial), ..expected };
        let mut of_model = Vec::new();
        for seed in 0..20 {
            let mut bench = Bench::with_faults(Some(create(seed)), port, None, faults, seed);
            let (found, time) = bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}, seed {seed}"));
            assert_eq!(found, expected, "{name}, seed {seed}");
            if expected.family == Family::Ld {
                assert_eq!(bench.written, [], "{name}, seed {seed}");
            }
            of_model.push(time);
        }
        of_model.sort_unstable();
        println!("{name:18} {:6} {:6} ms", of_model[10] / MILLIS, of_model[19] / MILLIS);
        times.extend(of_model);
    }
    times.sort_unstable();
    println!("median {} ms, worst {} ms", times[times.len() / 2] / MILLIS, times[times.len() - 1] / MILLIS);
    times
}

#[test]
fn finds_every_scanner_in_every_state() {
    let times = find_all("", PortKind::Serial);
    assert!(times[times.len() / 2] <= 2_000 * MILLIS && times[times.len() - 1] <= 6_000 * MILLIS);
}

#[test]
fn finds_every_scanner_on_a_bad_line() {
    let times = find_all("loss=0.002,flip=0.002,insert=0.002", PortKind::Serial);
    assert!(times[times.len() / 2] <= 2_000 * MILLIS && times[times.len() - 1] <= 6_000 * MILLIS);
}

#[test]
fn finds_every_scanner_behind_a_server() {
    let times = find_all("", PortKind::Server);
    assert!(times[times.len() - 1] <= 6_000 * MILLIS);
}

/// Times at which rounds begin, from the open: each one starts with a step at 230,400 baud.
fn rounds(bench: &Bench) -> Vec<Nanos> {
    let begins = bench.rates.iter().filter(|(_, rate)| *rate == 230_400).map(|(at, _)| at - bench.opened_at);
    [0].into_iter().chain(begins).collect()
}

#[test]
fn rounds_take_their_time_on_a_silent_line() {
    let mut bench = Bench::new(None, PortKind::Serial, None, 1);
    assert!(bench.find(12_000 * MILLIS).is_none());
    let begins = rounds(&bench);
    println!("silent: rounds begin at {:?} ms", begins.iter().map(|at| at / MILLIS).collect::<Vec<_>>());
    assert!(begins[1].abs_diff(1_200 * MILLIS) < 60 * MILLIS);
    // A patient round and a pause of 0.5 s, then a round and a pause of 1 s.
    assert!((begins[2] - begins[1]).abs_diff(3_060 * MILLIS) < 60 * MILLIS);
    assert!((begins[3] - begins[2]).abs_diff(2_200 * MILLIS) < 60 * MILLIS);
    let message = bench.host.trouble().unwrap().message("/dev/ttyUSB0");
    assert_eq!(message, "no scanner replies (looked for lms, ld, rplidar for 10 s): power, cable?");
}

#[test]
fn rounds_take_their_time_on_a_noisy_line() {
    let mut bench = Bench::new(None, PortKind::Serial, None, 1).with_noise(MILLIS);
    assert!(bench.find(30_000 * MILLIS).is_none());
    let begins = rounds(&bench);
    println!("noisy: rounds begin at {:?} ms", begins.iter().map(|at| at / MILLIS).collect::<Vec<_>>());
    assert!(begins[1].abs_diff(1_600 * MILLIS) < 100 * MILLIS);
    assert!((begins[2] - begins[1]).abs_diff(3_100 * MILLIS) < 150 * MILLIS);
    let message = bench.host.trouble().unwrap().message("/dev/ttyUSB0");
    let end = " bytes/s arrive, but scanhub does not recognize the scanner: stop the hub, then: scanhub probe /dev/ttyUSB0";
    assert!(message.ends_with(end), "{message}");
}

#[test]
fn hands_over_every_read_of_the_last_step() {
    for port in [PortKind::Serial, PortKind::Server] {
        for (name, _, create) in scanners() {
            for seed in 0..5 {
                let mut bench = Bench::new(Some(create(seed)), port, None, seed);
                let (found, _) = bench.find(20_000 * MILLIS).expect("found");
                let reads: Vec<(Nanos, Vec<u8>)> =
                    bench.host.reads().map(|(at, bytes)| (at, bytes.to_vec())).collect();
                let read: Vec<_> =
                    bench.read.iter().filter(|(_, bytes)| !bytes.is_empty()).cloned().collect();
                if found.family == Family::Rplidar {
                    // Only the reply is handed over.
                    assert!(
                        reads[0].1.starts_with(&[0xA5, 0x5A, 0x14, 0, 0, 0, 0x04]),
                        "{name}: {reads:02X?}"
                    );
                    assert!(read.ends_with(&reads), "{name}");
                } else {
                    assert_eq!(reads, read, "{name}");
                }
                let (account, captured) =
                    (bench.host.account(), reads.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>());
                assert!(account.discarded + captured == account.read && captured > 0, "{name}");
            }
        }
    }
}

#[test]
fn leaves_out_rates_that_the_port_cannot_have() {
    for (name, expected, create) in scanners() {
        let rate = expected.rate.expect("a serial line");
        let impossible = [230_400, 500_000, 921_600, 1_000_000, 9_600];
        let impossible = impossible.into_iter().filter(|&other| other != rate).collect();
        let mut bench = Bench::new(Some(create(1)), PortKind::Serial, None, 1);
        bench.impossible = impossible;
        if rate != 230_400 {
            bench.host.reject_rate(bench.now);
        }
        let (found, time) = bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}"));
        assert!(found == expected && time < 6_000 * MILLIS, "{name}: {found:?}");
    }
}

#[test]
fn a_restricted_search_sends_only_requests_of_its_family() {
    let open = |family, device, seed| {
        let search = |now| Search::new(PortKind::Serial, None, now).at_another_rate().only(family);
        Bench::auto(search, device, None, seed)
    };
    for (family, first, rates) in [
        (Family::Ld, 230_400, &[][..]),
        (Family::Lms, 500_000, &[9_600, 19_200, 38_400, 500_000]),
        (Family::Rplidar, 115_200, &[115_200, 256_000, 460_800, 1_000_000]),
    ] {
        let mut bench = open(family, None, 1);
        assert_eq!(bench.find(10_000 * MILLIS), None);
        assert_eq!(bench.rates[0].1, first, "the port is open at another rate");
        let mut sent_at: Vec<u32> = bench.written.iter().map(|(_, rate, _)| *rate).collect();
        sent_at.sort_unstable();
        sent_at.dedup();
        assert_eq!(sent_at, rates, "{family:?}");
    }
    for (name, expected, create) in scanners() {
        let mut bench = open(expected.family, Some(create(2)), 2);
        let (found, _) = bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}"));
        assert_eq!(found, expected, "{name}");
    }
}
