//! Tests of the search. The search finds scanners of all models in all states in time, and sends no byte that an
//! unknown scanner should not receive. If the previous hub has saved the scanner, the search finds it nearly as soon as
//! a session of its family does. If a scanner is switched on late, the search finds it soon after it can reply. Bytes
//! that no scanner sent never end a search. No scanner accepts a request that was sent at another rate.

use scanhub_drivers::line::{Action, KnownRate, Protocol as _, ScannerSession as _};
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_drivers::search::{FoundScanner, Memory, PortKind, Search};
use scanhub_drivers::{Settings, ld, lms, rplidar};
use scanhub_schema::{Family, MILLIS, Nanos, line_time};
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::line_model::UartReceiver;
use scanhub_sim::machine::LmsSimulator;
use scanhub_sim::operating::ScanSource;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator};
use scanhub_sim::{Arrival, machine};

use super::Bench;

/// Creates a scanner with a seed.
type CreateScanner = Box<dyn Fn(u64) -> Box<dyn Device>>;

/// Returns scanners of all models in all states: the name, the expected result, and a function that creates the
/// scanner.
pub(super) fn scanners() -> Vec<(String, FoundScanner, CreateScanner)> {
    let mut all: Vec<(String, FoundScanner, CreateScanner)> = Vec::new();
    for baud in Baud::ALL {
        for streams in [false, true] {
            let found = FoundScanner { family: Family::Lms, model: None, rate: Some(baud.rate()) };
            let create = Box::new(move |seed| super::lms(baud, streams, seed));
            all.push((format!("lms {} {streams}", baud.rate()), found, create));
        }
    }
    for model in ld::Model::ALL {
        let found = FoundScanner { family: Family::Ld, model: None, rate: Some(model.baud()) };
        all.push((model.name().into(), found, Box::new(move |seed| super::ld(model, seed))));
    }
    for model in Model::ALL {
        for (state, streams, health) in [("idle", false, 0), ("streams", true, 0), ("error", false, 2)] {
            let found =
                FoundScanner { family: Family::Rplidar, model: Some(model.name()), rate: Some(model.baud()) };
            let create = Box::new(move |seed| super::rplidar(model, streams, health, seed));
            all.push((format!("{} {state}", model.name()), found, create));
        }
    }
    all
}

/// Finds each scanner with 20 seeds, and returns the times until it was found.
fn find_all(faults: &str, port: PortKind) -> Vec<Nanos> {
    let mut times = Vec::new();
    for (name, expected, create) in scanners() {
        let expected = FoundScanner { rate: expected.rate.filter(|_| port == PortKind::Serial), ..expected };
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

/// Returns the times from the open of the port to the start of each round of the search. A round starts with a step at
/// 230,400 baud.
fn round_starts(bench: &Bench) -> Vec<Nanos> {
    let begins = bench.rates.iter().filter(|(_, rate)| *rate == 230_400).map(|(at, _)| at - bench.opened_at);
    [0].into_iter().chain(begins).collect()
}

#[test]
fn search_rounds_have_pauses_on_a_silent_line() {
    let mut bench = Bench::new(None, PortKind::Serial, None, 1);
    assert!(bench.find(12_000 * MILLIS).is_none());
    let begins = round_starts(&bench);
    println!("silent: rounds begin at {:?} ms", begins.iter().map(|at| at / MILLIS).collect::<Vec<_>>());
    assert!(begins[1].abs_diff(1_200 * MILLIS) < 60 * MILLIS);
    // The second round is longer, and a pause of 0.5 s follows it. A pause of 1 s follows the third round.
    assert!((begins[2] - begins[1]).abs_diff(3_060 * MILLIS) < 60 * MILLIS);
    assert!((begins[3] - begins[2]).abs_diff(2_200 * MILLIS) < 60 * MILLIS);
    let message = bench.host.problem().unwrap().message("/dev/ttyUSB0");
    assert_eq!(message, "no scanner replies (looked for lms, ld, rplidar for 10 s): power, cable?");
}

#[test]
fn search_rounds_take_longer_on_a_noisy_line() {
    let mut bench = Bench::new(None, PortKind::Serial, None, 1).with_noise(MILLIS);
    assert!(bench.find(30_000 * MILLIS).is_none());
    let begins = round_starts(&bench);
    println!("noisy: rounds begin at {:?} ms", begins.iter().map(|at| at / MILLIS).collect::<Vec<_>>());
    assert!(begins[1].abs_diff(1_600 * MILLIS) < 100 * MILLIS);
    assert!((begins[2] - begins[1]).abs_diff(3_100 * MILLIS) < 150 * MILLIS);
    let message = bench.host.problem().unwrap().message("/dev/ttyUSB0");
    let end = " bytes/s arrive, but scanhub does not recognize the scanner: stop the hub, then: scanhub probe /dev/ttyUSB0";
    assert!(message.ends_with(end), "{message}");
}

#[test]
fn passes_all_reads_of_the_last_step_to_the_session() {
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
                    // The search passes only the reply to the session.
                    assert!(
                        reads[0].1.starts_with(&[0xA5, 0x5A, 0x14, 0, 0, 0, 0x04]),
                        "{name}: {reads:02X?}"
                    );
                    assert!(read.ends_with(&reads), "{name}");
                } else {
                    assert_eq!(reads, read, "{name}");
                }
                let (stats, captured) =
                    (bench.host.stats(), reads.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>());
                assert!(stats.discarded + captured == stats.read && captured > 0, "{name}");
            }
        }
    }
}

#[test]
fn skips_rates_that_the_port_rejects() {
    for (name, expected, create) in scanners() {
        let rate = expected.rate.expect("a serial line");
        let impossible = [230_400, 500_000, 921_600, 1_000_000, 9_600];
        let impossible = impossible.into_iter().filter(|&other| other != rate).collect();
        let mut bench = Bench::new(Some(create(1)), PortKind::Serial, None, 1);
        bench.unsupported_rates = impossible;
        if rate != 230_400 {
            bench.host.reject_rate(bench.now);
        }
        let (found, time) = bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}"));
        assert!(found == expected && time < 6_000 * MILLIS, "{name}: {found:?}");
    }
}

#[test]
fn restricted_search_sends_only_its_familys_requests() {
    let open = |family, device, seed| {
        let search = |now| Search::new(PortKind::Serial, None, now).with_rate_change().restricted_to(family);
        Bench::with_search(search, device, None, seed)
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

/// Compares the search with a session of the scanner's family. Returns the maximum time by which the search finds the
/// scanner later.
fn max_extra_time(
    name: &str,
    memory: Memory,
    create: impl Fn(u64) -> Box<dyn Device>,
    named: impl Fn(Box<dyn Device>, u64) -> Nanos,
) -> Nanos {
    let mut worst = (0, 0, 0);
    for seed in 0..20 {
        let mut bench = Bench::new(Some(create(seed)), PortKind::Serial, Some(memory), seed);
        let (found, time) = bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}, seed {seed}"));
        assert_eq!(found.family, memory.family);
        let of_named = named(create(seed), seed);
        worst = worst.max((time.saturating_sub(of_named), time, of_named));
    }
    let (slower, time, of_named) = worst;
    println!("{name:18} {:4} ms, named {:4} ms", time / MILLIS, of_named / MILLIS);
    slower
}

#[test]
fn finds_a_saved_lms_soon() {
    let memory =
        |stream, reply: Baud| Memory { family: Family::Lms, stream_rate: stream, reply_rate: reply.rate() };
    let named = |first: Baud| {
        move |device, seed| {
            let settings = lms::Settings {
                variant: Variant::HALF,
                baud: Baud::B500000,
                listen_only: false,
                fixed_rate: false,
                keep_baud: false,
                mode: None,
            };
            let begin = |now| {
                let mut session = lms::LmsSession::new(settings, now);
                session.hint_rate(KnownRate { baud: first.rate(), silent_switches: 0 });
                session
            };
            Bench::find_named(begin, device, seed)
        }
    };
    for baud in Baud::ALL {
        // `baud` is the rate at which the scanner starts after a power cycle. The first test is a restart of the hub,
        // and the second test is a power cycle.
        let restarted = max_extra_time(
            "lms streams",
            memory(500_000, baud),
            |seed| super::lms(Baud::B500000, true, seed),
            named(baud),
        );
        let cycled = max_extra_time(
            &format!("lms {}", baud.rate()),
            memory(500_000, baud),
            |seed| super::lms(baud, false, seed),
            named(baud),
        );
        assert!(restarted.max(cycled) <= 300 * MILLIS);
    }
}

#[test]
fn finds_a_saved_rotating_scanner_soon() {
    for model in ld::Model::ALL {
        let rate = model.baud();
        let memory = Memory { family: Family::Ld, stream_rate: rate, reply_rate: rate };
        let slower = max_extra_time(
            model.name(),
            memory,
            |seed| super::ld(model, seed),
            |device, seed| {
                let settings = Settings { model: Some(model.name()), ..Settings::default() };
                Bench::find_named(|now| ld::LdSession::new(settings, now), device, seed)
            },
        );
        assert!(slower <= 300 * MILLIS);
    }
    for (model, named) in Model::ALL.into_iter().zip(rplidar::Model::ALL) {
        let rate = named.baud();
        let memory = Memory { family: Family::Rplidar, stream_rate: rate, reply_rate: rate };
        for (state, streams, health) in [("idle", false, 0), ("streams", true, 0), ("error", false, 2)] {
            let name = format!("{} {state}", model.name());
            let slower = max_extra_time(
                &name,
                memory,
                |seed| super::rplidar(model, streams, health, seed),
                |device, seed| {
                    let settings = Settings { model: Some(named.name()), ..Settings::default() };
                    Bench::find_named(|now| rplidar::RplidarSession::new(settings, now), device, seed)
                },
            );
            assert!(slower <= 300 * MILLIS);
        }
    }
}

#[test]
fn finds_a_replaced_scanner_despite_saved_state() {
    let mut worst = 0;
    for (family, stream_rate, reply_rate) in [
        (Family::Lms, 500_000, 9_600),
        (Family::Ld, 921_600, 921_600),
        (Family::Rplidar, 115_200, 115_200),
        (Family::Rplidar, 1_000_000, 1_000_000),
    ] {
        let memory = Memory { family, stream_rate, reply_rate };
        for (name, expected, create) in scanners() {
            for seed in 0..3 {
                let mut bench = Bench::new(Some(create(seed)), PortKind::Serial, Some(memory), seed);
                let (found, time) =
                    bench.find(20_000 * MILLIS).unwrap_or_else(|| panic!("{name}, {memory:?}"));
                assert_eq!(found, expected, "{name}, {memory:?}");
                assert!(found.family != Family::Ld || bench.written.is_empty(), "{name}, {memory:?}");
                worst = worst.max(time);
            }
        }
    }
    println!("worst {} ms", worst / MILLIS);
    assert!(worst <= 6_000 * MILLIS);
}

const ONE_SECOND: Nanos = 1_000 * MILLIS;

/// Returns the longest time from when a scanner can reply until the search finds the scanner. `create` creates
/// scanners with several seeds. Each scanner is switched on `after` the port was opened, or a little later, and then
/// boots for `boot`.
fn worst_find_time(name: &str, after: Nanos, boot: Nanos, create: impl Fn(u64) -> Box<dyn Device>) -> Nanos {
    let times = (0..10).map(|seed| {
        let after = after + seed * 317 * MILLIS;
        let mut bench = Bench::new(Some(create(seed)), PortKind::Serial, None, seed).powered_after(after);
        let (_, time) =
            bench.find(after + boot + 20 * ONE_SECOND).unwrap_or_else(|| panic!("{name}, seed {seed}"));
        time.saturating_sub(after + boot)
    });
    let worst = times.max().unwrap_or(Nanos::MAX);
    println!("{name:12} worst {} ms after it can reply", worst / MILLIS);
    worst
}

#[test]
fn finds_an_lms_that_starts_slowly() {
    for (boot, permanent_baud) in [2, 20, 60].into_iter().flat_map(|s| [(s, None), (s, Some(Baud::B38400))]) {
        let boot = boot * ONE_SECOND;
        let worst = worst_find_time(&format!("lms {}", boot / ONE_SECOND), 100 * MILLIS, boot, |seed| {
            let settings =
                machine::Settings { boot_ns: boot, permanent_baud, seed, ..machine::Settings::default() };
            Box::new(LmsSimulator::new(settings, ScanSource::Room(super::room(seed))))
        });
        assert!(worst <= 6 * ONE_SECOND);
    }
}

#[test]
fn finds_rotating_scanners_that_get_power_later() {
    let boot = 2 * ONE_SECOND;
    for model in ld::Model::ALL {
        let worst = worst_find_time(model.name(), 30 * ONE_SECOND, boot, |seed| {
            let settings = LdSettings { boot_ns: boot, seed, ..LdSettings::of(model) };
            Box::new(LdSimulator::new(settings, super::room(seed)))
        });
        assert!(worst <= 6 * ONE_SECOND);
    }
    for model in Model::ALL {
        let worst = worst_find_time(model.name(), 30 * ONE_SECOND, boot, |seed| {
            let settings = RplidarSettings { boot_ns: boot, seed, ..RplidarSettings::of(model) };
            Box::new(RplidarSimulator::new(settings, super::room(seed)))
        });
        assert!(worst <= 6 * ONE_SECOND);
    }
}

/// Passes `bytes` to a search on `port`, in reads of at most `max_read` bytes, until `seconds` have passed.
fn feed_search(
    port: PortKind,
    seed: u64,
    max_read: usize,
    seconds: u64,
    mut bytes: impl FnMut(&mut fastrand::Rng) -> u8,
) -> usize {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut search = Search::new(port, None, 0);
    let (mut now, mut count): (Nanos, usize) = (0, 0);
    while now < seconds * 1_000 * MILLIS {
        let until = loop {
            match search.poll_action() {
                Action::SetRate(_) => {}
                Action::Transmit { not_before, .. } => {
                    now = now.max(not_before);
                    search.handle_transmitted(now);
                }
                Action::Wait { until } => break until,
                output => panic!("{output:?}"),
            }
        };
        assert_eq!(search.found(), None, "in garbage, seed {seed}");
        now = (now + random.u64(..5 * MILLIS)).min(until);
        let len = random.usize(..=max_read).min(search.read_buffer().len());
        search.read_buffer()[..len].fill_with(|| bytes(&mut random));
        search.commit(now, len);
        count += len;
        if len == 0 && now >= until {
            search.handle_timeout(now);
        }
    }
    count
}

#[test]
fn garbage_is_not_a_scanner() {
    let mut count = 0;
    for port in [PortKind::Serial, PortKind::Server, PortKind::Recording] {
        for seed in 0..6 {
            count += feed_search(port, seed, 200, 20, |random| random.u8(..));
            // Send only bytes with which telegrams and packets of the families start.
            let heads = [0x02, 0x80, 0x81, 0xB0, 0xBA, 0x06, 0x54, 0x2C, 0xA5, 0x5A, 0x14, 0x04, 0x00, 0xFF];
            count += feed_search(port, seed, 200, 20, |random| heads[random.usize(..heads.len())]);
            count += feed_search(
                port,
                seed,
                200,
                20,
                |random| if random.u8(..4) > 0 { 0x00 } else { random.u8(..) },
            );
            for byte in [0x00, 0xFF, 0x02, 0x54, 0xA5] {
                count += feed_search(port, seed, 200, 2, |_| byte);
            }
        }
    }
    println!("{count} bytes");
}

const LMS: [&[u8]; 2] = [&[0x02, 0, 1, 0, 0x3A, 0x1E, 0x12], &[0x02, 0, 1, 0, 0x31, 0x15, 0x12]];
const RPLIDAR: [&[u8]; 3] = [&[0xA5, 0x25], &[0xA5, 0x50], &[0xA5, 0x25, 0xA5, 0x50]];

/// Returns each request of the search with its rate in bits per second and the gap between two bytes in nanoseconds.
fn requests() -> Vec<(&'static [u8], u32, Nanos)> {
    let lms = Baud::ALL.into_iter().flat_map(|baud| LMS.map(|request| (request, baud.rate(), 120_000)));
    let rates = [115_200, 256_000, 460_800, 1_000_000];
    let rplidar = rates.into_iter().flat_map(|rate| RPLIDAR.map(|request| (request, rate, 0)));
    lms.chain(rplidar).collect()
}

/// Returns all scanners with their names, each once idle and once streaming. The flag is set for an LMS.
fn receivers() -> Vec<(String, bool, Box<dyn Device>)> {
    let mut all: Vec<(String, bool, Box<dyn Device>)> = Vec::new();
    for streams in [false, true] {
        for baud in Baud::ALL {
            all.push((format!("lms {} {streams}", baud.rate()), true, super::lms(baud, streams, 1)));
        }
        for model in Model::ALL {
            all.push((format!("{} {streams}", model.name()), false, super::rplidar(model, streams, 0, 1)));
        }
    }
    for model in ld::Model::ALL {
        all.push((model.name().into(), false, super::ld(model, 1)));
    }
    all
}

/// Returns the bytes that a scanner at `rate` receives if the host sends `request` at the rate `sent_at`. The actual
/// rate of the host differs from `sent_at` by `drift` percent. The line is idle for `gap` between the bytes.
fn received_bytes(request: &[u8], sent_at: u32, rate: u32, gap: Nanos, drift: f64) -> Vec<u8> {
    let rate_of_host = (f64::from(sent_at) * (1.0 + drift / 100.0)) as u32;
    let mut receiver = UartReceiver::new(rate_of_host, rate);
    let mut bytes = Vec::new();
    for &byte in request {
        bytes.extend(receiver.receive(&[byte], gap > line_time(1, rate)));
    }
    bytes.extend(receiver.receive(&[], true));
    bytes
}

/// Returns the number of telegrams that `device` sends from `now` until `end` and that are not part of a stream, plus
/// the number of aborted telegrams.
fn count_reactions(device: &mut dyn Device, now: &mut Nanos, end: Nanos) -> usize {
    use scanhub_sim::device::ChunkKind;
    let mut count = 0;
    loop {
        while let Some(chunk) = device.poll_transmit(*now) {
            count += match chunk.part {
                ChunkKind::Acknowledge => 1,
                ChunkKind::End(sent) => usize::from(sent.is_reply || sent.aborted),
                ChunkKind::Telegram => 0,
            };
        }
        match device.poll_timeout().filter(|&at| at <= end) {
            Some(at) => *now = at.max(*now),
            None => break,
        }
    }
    *now = end;
    count
}

/// Sends the requests of the search to an RPLIDAR at the rate of its line, and returns whether the RPLIDAR replies.
fn is_answered(device: &mut dyn Device, now: &mut Nanos) -> bool {
    for byte in [0xA5, 0x25, 0xA5, 0x50] {
        *now += line_time(1, device.rate());
        device.receive(byte, Arrival::at(*now));
    }
    let end = *now + 50 * MILLIS;
    count_reactions(device, now, end) == 1
}

#[test]
fn no_request_is_accepted_at_another_rate() {
    let mut checked = 0;
    for (name, is_lms, mut device) in receivers() {
        let mut now = 3_000 * MILLIS;
        while device.poll_transmit(now).is_some() {}
        let streams = device.streams();
        for (request, rate, gap) in requests() {
            let is_same_family = is_lms == (request[0] == 0x02);
            for drift in [-2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0] {
                let own = device.rate();
                if is_same_family && rate == own {
                    continue;
                }
                for byte in received_bytes(request, rate, own, gap, drift) {
                    now += line_time(1, own);
                    count_reactions(&mut *device, &mut now.clone(), now);
                    device.receive(byte, Arrival::at(now));
                }
                let end = now + 300 * MILLIS;
                let reactions = count_reactions(&mut *device, &mut now, end);
                assert_eq!(reactions, 0, "{name}: {request:02X?} at {rate}, {drift} %");
                assert_eq!((device.streams(), device.eeprom_writes()), (streams, 0), "{name}");
                if name.ends_with("false") && !is_lms {
                    assert!(
                        is_answered(&mut *device, &mut now),
                        "{name}: {request:02X?} at {rate}, {drift} %"
                    );
                }
                checked += 1;
            }
        }
    }
    println!("{checked} requests at a wrong rate");
}

#[test]
fn stop_for_an_lms_would_disturb_an_rplidar() {
    // The search never sends this request to an unknown scanner, because an RPLIDAR can take the received bytes for the
    // start of a long request.
    let stop = [0x02, 0x00, 0x02, 0x00, 0x20, 0x25, 0x35, 0x08];
    let is_disturbed = |tenths: i32| {
        let mut device = super::rplidar(Model::C1, false, 0, 1);
        let mut now = 3_000 * MILLIS;
        for byte in received_bytes(&stop, 500_000, device.rate(), 120_000, f64::from(tenths) / 10.0) {
            device.receive(byte, Arrival::at(now));
        }
        !is_answered(&mut *device, &mut now)
    };
    assert!((-20..=20).any(is_disturbed));
}
