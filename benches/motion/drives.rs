//! Drives of real robots whose place somebody knew: logs of the CARMEN toolkit, whose places were corrected by a map, and
//! model cars under a motion capture. Refuses to know who follows them.

use std::f64::consts::PI;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use preprocess::motion::{Rigid, Settings};
use schema::Scan;
use serde_json::Value;

use crate::rooms::scan;

/// Scans one after the other.
pub(crate) struct Drive {
    pub(crate) name: String,
    pub(crate) scans: Vec<Box<Scan>>,
    /// Where the robot was at each, if that is known.
    pub(crate) places: Vec<Option<Rigid>>,
    pub(crate) settings: Settings,
    /// A step that is off by more is wrong.
    pub(crate) wrong_mm: f64,
}

impl Drive {
    /// The numbers of scans of which the step to them is known, and that.
    pub(crate) fn steps(&self) -> impl Iterator<Item = (usize, Rigid)> + '_ {
        let step = |at: usize| Some((at, self.places[at - 1]?.inverse().then(&self.places[at]?)));
        (1..self.places.len()).filter_map(step)
    }
}

/// The drives in SCANHUB_DATA, else in `../shared/data`; none if that is not there.
pub(crate) fn all() -> Vec<Drive> {
    let data = folder();
    let mut drives = Vec::new();
    for name in ["aces", "freiburg-079", "intel", "orebro"] {
        drives.extend(carmen(name, &data.join(format!("carmen/{name}-corrected.log.gz"))));
    }
    for name in ["overtakes", "intersection"] {
        drives.extend(moving(name, &data.join(format!("moving/{name}.jsonl.gz"))));
    }
    drives
}

/// The drives of model cars, and where the other car was.
#[allow(dead_code)] // The bench of motion leaves the other one out.
pub(crate) fn with_another() -> Vec<(Drive, Vec<Option<Rigid>>)> {
    let of = |name| {
        let path = folder().join(format!("moving/{name}.jsonl.gz"));
        let others = lines(&path)
            .ok()?
            .filter_map(|line| Some(place(&serde_json::from_str::<Value>(&line).ok()?["other"])));
        Some((moving(name, &path)?, others.collect()))
    };
    ["overtakes", "intersection"].into_iter().filter_map(of).collect()
}

fn folder() -> PathBuf {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("SCANHUB_DATA").map_or(beside, PathBuf::from)
}

fn place(value: &Value) -> Option<Rigid> {
    let number = |at: usize| value.get(at)?.as_f64();
    Some(Rigid::new(number(0)?, number(1)?, number(2)?))
}

fn lines(path: &Path) -> io::Result<impl Iterator<Item = String>> {
    Ok(BufReader::new(MultiGzDecoder::new(File::open(path)?)).lines().map_while(Result::ok))
}

fn carmen(name: &str, path: &Path) -> Option<Drive> {
    let read = |line: String| {
        let mut words = line.strip_prefix("FLASER ")?.split_ascii_whitespace();
        let count: usize = words.next()?.parse().ok()?;
        let numbers: Vec<f64> = words.take(count + 3).map_while(|word| word.parse().ok()).collect();
        let (ranges, place) = numbers.split_at_checked(count)?;
        let &[x, y, yaw] = place else { return None };
        let step = PI / (count - count % 2) as f64;
        // Three logs say 81 m where nothing came back.
        let ranges: Vec<f64> =
            ranges.iter().map(|&range| if range < 50.0 { range } else { f64::INFINITY }).collect();
        Some((scan(-PI / 2.0, step, &ranges), Some(Rigid::new(x, y, yaw))))
    };
    let (scans, places): (Vec<_>, Vec<_>) = lines(path).ok()?.filter_map(read).unzip();
    // But for one, the logs have a scan each metre or each half turn.
    let settings = if name == "freiburg-079" {
        Settings::default()
    } else {
        Settings { max_step_m: 3.5, max_turn_deg: 80.0, ..Settings::default() }
    };
    Some(Drive { name: name.to_owned(), scans, places, settings, wrong_mm: 200.0 })
}

fn moving(name: &str, path: &Path) -> Option<Drive> {
    let read = |line: String| {
        let value: Value = serde_json::from_str(&line).ok()?;
        let (first, step) = (value["angle_min"].as_f64()?, value["step"].as_f64()?);
        let ranges: Vec<f64> =
            value["ranges"].as_array()?.iter().map(|range| range.as_f64().unwrap_or(f64::INFINITY)).collect();
        Some((scan(first, step, &ranges), place(&value["platform"])))
    };
    let (scans, places): (Vec<_>, Vec<_>) = lines(path).ok()?.filter_map(read).unzip();
    Some(Drive { name: name.to_owned(), scans, places, settings: Settings::default(), wrong_mm: 100.0 })
}
