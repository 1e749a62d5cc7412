//! An independent judge of the simulated RPLIDARs: the vendor's own driver, as the Python package `pyrplidarsdk` has it. It
//! connects, finds model, health and modes, and its scans are the room that was simulated.

use std::process::Stdio;

use serde_json::Value;

use crate::testkit::{TERM, TestEnv, python_for};

/// Half a room's extent along x and y in metres, the sensor off its middle, and a pillar: nothing is alike to any side.
const ROOM: &str = "
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

/// Metres from a point to the nearest wall of [`ROOM`].
fn off(x: f64, y: f64) -> f64 {
    let walls = [(x + 1.5).abs(), (x - 2.5).abs(), (y + 1.0).abs(), (y - 3.0).abs()];
    let (beside, before) = ((x - 0.7).abs() - 0.15, (y - 0.8).abs() - 0.15);
    let pillar = match beside.max(before) {
        inside if inside < 0.0 => -inside,
        _ => beside.max(0.0).hypot(before.max(0.0)),
    };
    walls.into_iter().fold(pillar, f64::min)
}

#[test]
fn the_vendors_driver_sees_the_simulated_room_in_every_form_of_packet() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/it/vendor/scans.py");
    let env = TestEnv::new();
    let world = format!("--world={}", env.file("room.toml", ROOM));
    for (model, id, baud, mode, points) in [
        ("a1", 0x18, "115200", "Standard", 266),
        ("a2m8", 0x28, "115200", "Express", 394),
        ("a3", 0x31, "256000", "Boost", 1_587),
        ("s1", 0x61, "256000", "DenseBoost", 922),
        ("s3", 0x81, "1000000", "UltraDense", 3_200),
    ] {
        let Some(mut command) = python_for("rplidar-driver", "pyrplidarsdk") else { return };
        let flags =
            [world.clone(), "--family=rplidar".into(), format!("--model={model}"), format!("--mode={mode}")];
        let simulator = env.simulator(&["front"], &flags);
        command.args([script, &env.word("front"), baud, "12"]).stdin(Stdio::null());
        let outcome = command.output().expect("a Python");
        let said = String::from_utf8_lossy(&outcome.stdout);
        let said: Value =
            said.lines().last().and_then(|line| serde_json::from_str(line).ok()).unwrap_or_else(|| {
                panic!("{model}: {}", String::from_utf8_lossy(&outcome.stderr));
            });
        assert_eq!(said["model"], id, "{model}");
        let scans = said["scans"].as_array().expect("scans");
        assert_eq!(scans.len(), 12, "{model}");
        let numbers = |value: &Value| -> Vec<f64> {
            value.as_array().expect("numbers").iter().map(|number| number.as_f64().expect("one")).collect()
        };
        let (mut all, mut wrong, mut counts) = (0, 0, Vec::new());
        // The first one may have begun in the midst of a turn.
        for scan in &scans[1..] {
            let (angles, ranges) = (numbers(&scan[0]), numbers(&scan[1]));
            counts.push(ranges.len());
            all += ranges.len();
            // Clockwise from ahead, which is along y.
            let at = |(angle, range): (&f64, &f64)| off(range * angle.sin(), range * angle.cos());
            wrong += angles.iter().zip(&ranges).filter(|point| at(*point) > 0.005).count();
        }
        // A machine that kept it from reading for long costs it some; without a checksum it takes noise for points.
        assert!(wrong * 500 <= all, "{model}: {wrong} of {all} points are off");
        counts.sort_unstable();
        let usual = counts[counts.len() / 2];
        assert!(usual.abs_diff(points) * 50 <= points, "{model}: {usual} points a turn, {counts:?}");
        assert_eq!(simulator.end(TERM).code, Some(0));
        assert_eq!(env.simulated("front").1, 0);
    }
}
