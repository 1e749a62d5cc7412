//! A remembered scanner is found nearly as soon as by a session of its family, and another one is still found.

use scanhub_drivers::line::{KnownRate, Session as _};
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_drivers::search::{Memory, PortKind};
use scanhub_drivers::{Settings, ld, lms, rplidar};
use scanhub_schema::{Family, MILLIS, Nanos};
use scanhub_sim::device::Device;
use scanhub_sim::rplidar::Model;

use super::bench::{self, Bench};
use super::finding::scanners;

/// Compares the search with a session of the family, and returns by how much the search is slower in the worst case.
fn slower(
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
fn finds_a_remembered_lms_soon() {
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
                let mut session = lms::Session::new(settings, now);
                session.hint_rate(KnownRate { baud: first.rate(), silent_switches: 0 });
                session
            };
            Bench::named(begin, device, seed)
        }
    };
    for baud in Baud::ALL {
        // After a restart of the hub, and after a power cycle of a scanner that starts at this rate.
        let restarted = slower(
            "lms streams",
            memory(500_000, baud),
            |seed| bench::lms(Baud::B500000, true, seed),
            named(baud),
        );
        let cycled = slower(
            &format!("lms {}", baud.rate()),
            memory(500_000, baud),
            |seed| bench::lms(baud, false, seed),
            named(baud),
        );
        assert!(restarted.max(cycled) <= 300 * MILLIS);
    }
}

#[test]
fn finds_a_remembered_rotating_scanner_soon() {
    for model in ld::Model::ALL {
        let rate = model.baud();
        let memory = Memory { family: Family::Ld, stream_rate: rate, reply_rate: rate };
        let slower = slower(
            model.name(),
            memory,
            |seed| bench::ld(model, seed),
            |device, seed| {
                let settings = Settings { model: Some(model.name()), ..Settings::default() };
                Bench::named(|now| ld::Session::new(settings, now), device, seed)
            },
        );
        assert!(slower <= 300 * MILLIS);
    }
    for (model, named) in Model::ALL.into_iter().zip(rplidar::Model::ALL) {
        let rate = named.baud();
        let memory = Memory { family: Family::Rplidar, stream_rate: rate, reply_rate: rate };
        for (state, streams, health) in [("idle", false, 0), ("streams", true, 0), ("error", false, 2)] {
            let name = format!("{} {state}", model.name());
            let slower = slower(
                &name,
                memory,
                |seed| bench::rplidar(model, streams, health, seed),
                |device, seed| {
                    let settings = Settings { model: Some(named.name()), ..Settings::default() };
                    Bench::named(|now| rplidar::Session::new(settings, now), device, seed)
                },
            );
            assert!(slower <= 300 * MILLIS);
        }
    }
}

#[test]
fn finds_another_scanner_than_the_remembered_one() {
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
