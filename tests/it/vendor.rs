//! Comparison of the simulated RPLIDARs with an independent implementation: the vendor's driver, in the Python package
//! `pyrplidarsdk`. The driver connects and reads the model, the health and the modes. The scans that it receives match
//! the simulated room.
//!
//! The scanner has its own virtual time, which advances only while the driver reads. On a busy machine, the scanner
//! measures later, and no bytes are lost.

use std::thread;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use scanhub_sim::Arrival;
use scanhub_sim::device::Device;
use scanhub_sim::port::Pty;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator};
use scanhub_sim::world::World;
use serde_json::Value;

use crate::testkit::{Program, python_for};

/// World with walls around a sensor that is off the center, and with a pillar. It has no symmetry. Lengths are in
/// millimeters.
const ROOM_WORLD: &str = "
[noise]
sigma_mm = 0
bias_mm = 0
tail = 0
errors = 0
weak = false
spot = false
dazzle = false
comb = false

[[thing]]
line = [[-1500, -1000], [2500, -1000], [2500, 3000], [-1500, 3000], [-1500, -1000]]

[[thing]]
box = [300, 300]
pose = [700, 800]
";

/// Returns the distance of a point from the nearest wall of [`ROOM_WORLD`], in meters.
fn distance_from_walls(x: f64, y: f64) -> f64 {
    let walls = [(x + 1.5).abs(), (x - 2.5).abs(), (y + 1.0).abs(), (y - 3.0).abs()];
    let (side, before) = ((x - 0.7).abs() - 0.15, (y - 0.8).abs() - 0.15);
    let pillar = match side.max(before) {
        inside if inside < 0.0 => -inside,
        _ => side.max(0.0).hypot(before.max(0.0)),
    };
    walls.into_iter().fold(pillar, f64::min)
}

/// Simulates `unit` at the scanner's end of `pty` until `driver` ends.
fn run_simulator(unit: &mut RplidarSimulator, pty: &Pty, driver: &Program) {
    let mut now = 0;
    let mut unread = Vec::new();
    while !driver.has_ended() {
        while unread.is_empty()
            && let Some(chunk) = unit.poll_transmit(now)
        {
            unread = chunk.bytes;
        }
        unread.drain(..pty.write(&unread).expect("an open pty"));
        let mut written = [0; 64];
        let written_len = pty.read(&mut written).expect("an open pty");
        let rates_match = pty.rate() == unit.rate();
        written[..written_len]
            .iter()
            .filter(|_| rates_match)
            .for_each(|byte| unit.receive(*byte, Arrival::at(now)));
        if written_len > 0 {
            continue;
        }
        match unit.poll_timeout().filter(|_| unread.is_empty()) {
            Some(due) => now = now.max(due),
            // If no process has the pty open, `poll` returns at once. Sleep instead.
            None if !pty.is_open() => thread::sleep(POLL_INTERVAL),
            None => {
                let expected = if unread.is_empty() { PollFlags::IN } else { PollFlags::IN | PollFlags::OUT };
                let mut line = [PollFd::from_borrowed_fd(pty.wait_fd(), expected)];
                // If a signal interrupts the wait, the wait is only shorter.
                let _ = poll(&mut line, Some(&Timespec::try_from(POLL_INTERVAL).expect("a valid time")));
            }
        }
    }
}

#[test]
fn vendor_driver_reads_the_room_in_all_packet_forms() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/it/vendor/scans.py");
    let world = World::of_toml("room.toml", ROOM_WORLD).expect("a world");
    let mut crashes = 0;
    for (model, id, mode, points) in [
        (Model::A1, 0x18, "Standard", 266),
        (Model::A2m8, 0x28, "Express", 394),
        (Model::A3, 0x31, "Boost", 1_587),
        (Model::S1, 0x61, "DenseBoost", 922),
        (Model::S3, 0x81, "UltraDense", 3_200),
    ] {
        let Some(mut command) = python_for("rplidar-driver", "pyrplidarsdk") else { return };
        let typical = model.modes().iter().position(|known| known.name == mode).expect("a mode");
        let settings = RplidarSettings { typical, ..RplidarSettings::of(model) };
        let mut unit = RplidarSimulator::new(settings, Room::new(&world, 0));
        let pty = Pty::open().expect("a pty");
        command
            .env("PYTHONFAULTHANDLER", "1")
            .arg(script)
            .arg(pty.name())
            .args([&model.baud().to_string(), "12"]);
        let driver = Program::start(command);
        run_simulator(&mut unit, &pty, &driver);
        let outcome = driver.wait();
        // `None` is a crash of the vendor's code, seen once on a busy machine. The scans that it has printed count.
        crashes += u32::from(outcome.exit_code.is_none());
        let is_ended = outcome.exit_code.is_none_or(|code| code == 0) && crashes < 2;
        assert!(is_ended && unit.eeprom_writes() == 0, "{}: {outcome}", model.name());
        let result = outcome.lines().pop().unwrap_or_else(|| panic!("{}: {outcome}", model.name()));
        assert_eq!(result["model"], id, "{}", model.name());
        let scans = result["scans"].as_array().expect("scans");
        assert_eq!(scans.len(), 12, "{}", model.name());
        let numbers = |value: &Value| -> Vec<f64> {
            value
                .as_array()
                .expect("numbers")
                .iter()
                .map(|number| number.as_f64().expect("a number"))
                .collect()
        };
        // Leave out the first scan, which may have begun in the middle of a revolution.
        for scan in &scans[1..] {
            let (angles, ranges) = (numbers(&scan[0]), numbers(&scan[1]));
            // Angles are clockwise from the direction ahead, which is the y axis.
            let at =
                |(angle, range): (&f64, &f64)| distance_from_walls(range * angle.sin(), range * angle.cos());
            let max_error_m = angles.iter().zip(&ranges).map(at).fold(0.0, f64::max);
            assert!(max_error_m < 0.005, "{}: a point is {max_error_m} m off", model.name());
            let count = ranges.len();
            assert!(count.abs_diff(points) * 50 <= points, "{}: {count} points a turn", model.name());
        }
    }
}

/// Interval at which the simulator checks whether the driver has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(10);
