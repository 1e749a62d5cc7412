//! Scans of real sensors, from logs of the CARMEN toolkit: lines `FLASER COUNT RANGE ..`, ranges in metres, half a turn.
//! Refuses to know who looks for lines in them.

use std::f64::consts::PI;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use schema::Scan;

use crate::rooms::scan;

/// Beyond is no return.
const GREATEST_M: f64 = 50.0;

/// The logs in the folder `carmen` of SCANHUB_DATA, else of `../shared/data`; none if it is not there.
pub(crate) fn files() -> Vec<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("SCANHUB_DATA").map_or(beside, PathBuf::from);
    let entries = fs::read_dir(data.join("carmen")).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = entries
        .map(|entry| entry.path())
        .filter(|path| path.to_string_lossy().ends_with(".log.gz"))
        .collect();
    files.sort();
    files
}

/// At most `count` scans of a log, evenly spread over it.
pub(crate) fn scans(path: &Path, count: usize) -> io::Result<Vec<Box<Scan>>> {
    let text = BufReader::new(MultiGzDecoder::new(File::open(path)?));
    let mut scans = Vec::new();
    for line in text.lines() {
        scans.extend(read(&line?));
    }
    let every = scans.len().div_ceil(count).max(1);
    Ok(scans.into_iter().step_by(every).collect())
}

fn read(line: &str) -> Option<Box<Scan>> {
    let mut words = line.strip_prefix("FLASER ")?.split_ascii_whitespace();
    let count: usize = words.next()?.parse().ok()?;
    let ranges: Vec<f64> = words.take(count).map_while(|word| word.parse().ok()).collect();
    if count < 2 || ranges.len() < count {
        return None;
    }
    // With an odd number both ends of the half turn are among them.
    let step = PI / (count - count % 2) as f64;
    let far = |&range: &f64| if range < GREATEST_M { range } else { f64::INFINITY };
    Some(scan(-PI / 2.0, step, &ranges.iter().map(far).collect::<Vec<_>>()))
}
