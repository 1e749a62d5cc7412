//! Recorded drives of real robots whose positions are known. Some of them are logs of the CARMEN toolkit, with
//! positions that were corrected by a map. The others are drives of model cars, whose positions were measured by motion
//! capture. The recordings are not part of the project.

use std::f64::consts::{PI, TAU};
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use fastrand::Rng;
use flate2::read::MultiGzDecoder;
use scanhub_preprocess::motion::{Pose2, Settings};
use scanhub_schema::{Code, Scan, ScanHead};
use serde_json::Value;

/// Names of the drives of model cars.
const CARS: [&str; 2] = ["overtakes", "intersection"];

/// A scan, and the pose of the robot at the time of the scan, if the pose is known.
type PosedScan = (Box<Scan>, Option<Pose2>);

/// Consecutive scans of a robot.
pub(crate) struct Drive {
    pub(crate) name: String,
    pub(crate) scans: Vec<Box<Scan>>,
    /// Pose of the robot at each scan, or `None` if it is unknown.
    pub(crate) positions: Vec<Option<Pose2>>,
    pub(crate) settings: Settings,
    /// Minimum position error in millimeters at which a step is wrong.
    pub(crate) min_wrong_mm: f64,
}

impl Drive {
    /// Returns the index of each scan whose step from the previous scan is known, together with this step.
    pub(crate) fn steps(&self) -> impl Iterator<Item = (usize, Pose2)> + '_ {
        let step = |at: usize| Some((at, self.positions[at - 1]?.inverse().then(&self.positions[at]?)));
        (1..self.positions.len()).filter_map(step)
    }
}

/// Returns all drives. Without recordings, the list is empty.
pub(crate) fn drives() -> Vec<Drive> {
    let logs = logs().into_iter().map(|(name, scans)| {
        // All logs except one have one scan per meter or per half turn, so wider limits are needed.
        let settings = if name == "freiburg-079" {
            Settings::default()
        } else {
            Settings { max_step_m: 3.5, max_turn_deg: 80.0, ..Settings::default() }
        };
        let (scans, positions) = scans.into_iter().unzip();
        Drive { name, scans, positions, settings, min_wrong_mm: 200.0 }
    });
    let cars = CARS.iter().filter_map(|name| model_car(name));
    logs.chain(cars).collect()
}

/// Returns the drives of model cars, with the position of the other car at each scan.
pub(crate) fn drives_with_other_car() -> Vec<(Drive, Vec<Option<Pose2>>)> {
    let of = |name: &str| {
        let path = car_path(name);
        let others = lines(&path)
            .ok()?
            .filter_map(|line| Some(position(&serde_json::from_str::<Value>(&line).ok()?["other"])));
        Some((model_car(name)?, others.collect()))
    };
    CARS.into_iter().filter_map(of).collect()
}

/// Returns the folder with recordings: the value of the variable SCANHUB_DATA, or `../shared/data`.
fn folder() -> PathBuf {
    let default_folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("SCANHUB_DATA").map_or(default_folder, PathBuf::from)
}

fn car_path(name: &str) -> PathBuf {
    folder().join(format!("moving/{name}.jsonl.gz"))
}

fn position(value: &Value) -> Option<Pose2> {
    let number = |at: usize| value.get(at)?.as_f64();
    Some(Pose2::new(number(0)?, number(1)?, number(2)?))
}

fn lines(path: &Path) -> io::Result<impl Iterator<Item = String>> {
    Ok(BufReader::new(MultiGzDecoder::new(File::open(path)?)).lines().map_while(Result::ok))
}

/// Returns each scan of a CARMEN log with the robot's pose. The scans are lines `FLASER COUNT RANGE .. X Y YAW ..`,
/// with ranges in meters over 180 degrees.
fn carmen(path: &Path) -> Option<Vec<PosedScan>> {
    let read = |line: String| {
        let mut words = line.strip_prefix("FLASER ")?.split_ascii_whitespace();
        let count: usize = words.next()?.parse().ok().filter(|count| *count > 1)?;
        let numbers: Vec<f64> = words.take(count + 3).map_while(|word| word.parse().ok()).collect();
        let (ranges, position) = numbers.split_at_checked(count)?;
        let &[x, y, yaw] = position else { return None };
        // If the number of ranges is odd, the scan includes both ends of the half circle.
        let step = PI / (count - count % 2) as f64;
        // Three of the logs have the range 81 m for a beam without an echo.
        let ranges: Vec<f64> =
            ranges.iter().map(|&range| if range < 50.0 { range } else { f64::INFINITY }).collect();
        Some((scan(-PI / 2.0, step, &ranges), Some(Pose2::new(x, y, yaw))))
    };
    Some(lines(path).ok()?.filter_map(read).collect())
}

/// Returns the scans of all CARMEN logs, each log with its name. Without recordings, the list is empty.
pub(crate) fn logs() -> Vec<(String, Vec<PosedScan>)> {
    let entries = fs::read_dir(folder().join("carmen")).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    let log = |path: PathBuf| {
        let name = path.file_name()?.to_str()?.strip_suffix("-corrected.log.gz")?.to_owned();
        Some((name, carmen(&path)?))
    };
    paths.into_iter().filter_map(log).collect()
}

fn model_car(name: &str) -> Option<Drive> {
    let read = |line: String| {
        let value: Value = serde_json::from_str(&line).ok()?;
        let (first, step) = (value["angle_min"].as_f64()?, value["step"].as_f64()?);
        let ranges: Vec<f64> =
            value["ranges"].as_array()?.iter().map(|range| range.as_f64().unwrap_or(f64::INFINITY)).collect();
        Some((scan(first, step, &ranges), position(&value["platform"])))
    };
    let (scans, positions): (Vec<_>, Vec<_>) = lines(&car_path(name)).ok()?.filter_map(read).unzip();
    Some(Drive {
        name: name.to_owned(),
        scans,
        positions,
        settings: Settings::default(),
        min_wrong_mm: 100.0,
    })
}

/// Returns a scan with these ranges, which are in meters, in units of 1 mm. If a range is beyond the maximum of a scan,
/// the beam gets the code `no return`.
pub(crate) fn scan(first_angle: f64, step: f64, ranges: &[f64]) -> Box<Scan> {
    let head = ScanHead {
        first_angle,
        step,
        spacing: step as f32,
        unit_um: 1000,
        count: ranges.len() as u16,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        turns: 1,
        ..ScanHead::default()
    };
    let in_units = |&range: &f64| if range < 65.0 { (1000.0 * range).round() as u16 } else { head.no_return };
    Scan::of(head, &ranges.iter().map(in_units).collect::<Vec<_>>())
}

/// Returns a random number of the standard normal distribution, which it computes by the Box-Muller method.
pub(crate) fn normal(random: &mut Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}
