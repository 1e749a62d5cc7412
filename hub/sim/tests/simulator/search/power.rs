//! Scanners that get power after the port was opened are found soon after they can answer.

use scanhub_drivers::ld;
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::search::PortKind;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::machine::{self, LmsSimulator};
use scanhub_sim::operating::Source;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator};

use super::bench::{self, Bench};

const SECOND: Nanos = 1_000 * MILLIS;

/// Returns the worst time from when scanners that `create` creates can answer until they are found. They get power `after` this
/// time from the open, and then start for `boot`.
fn worst(name: &str, after: Nanos, boot: Nanos, create: impl Fn(u64) -> Box<dyn Device>) -> Nanos {
    let times = (0..10).map(|seed| {
        let after = after + seed * 317 * MILLIS;
        let mut bench = Bench::new(Some(create(seed)), PortKind::Serial, None, seed).powered_after(after);
        let (_, time) =
            bench.find(after + boot + 20 * SECOND).unwrap_or_else(|| panic!("{name}, seed {seed}"));
        time.saturating_sub(after + boot)
    });
    let worst = times.max().unwrap_or(Nanos::MAX);
    println!("{name:12} worst {} ms after it can answer", worst / MILLIS);
    worst
}

#[test]
fn finds_an_lms_that_starts_slowly() {
    for (boot, permanent_baud) in [2, 20, 60].into_iter().flat_map(|s| [(s, None), (s, Some(Baud::B38400))]) {
        let boot = boot * SECOND;
        let worst = worst(&format!("lms {}", boot / SECOND), 100 * MILLIS, boot, |seed| {
            let settings =
                machine::Settings { boot_ns: boot, permanent_baud, seed, ..machine::Settings::default() };
            Box::new(LmsSimulator::new(settings, Source::Room(bench::room(seed))))
        });
        assert!(worst <= 6 * SECOND);
    }
}

#[test]
fn finds_rotating_scanners_that_get_power_later() {
    let boot = 2 * SECOND;
    for model in ld::Model::ALL {
        let worst = worst(model.name(), 30 * SECOND, boot, |seed| {
            let settings = LdSettings { boot_ns: boot, seed, ..LdSettings::of(model) };
            Box::new(LdSimulator::new(settings, bench::room(seed)))
        });
        assert!(worst <= 6 * SECOND);
    }
    for model in Model::ALL {
        let worst = worst(model.name(), 30 * SECOND, boot, |seed| {
            let settings = RplidarSettings { boot_ns: boot, seed, ..RplidarSettings::of(model) };
            Box::new(RplidarSimulator::new(settings, bench::room(seed)))
        });
        assert!(worst <= 6 * SECOND);
    }
}
