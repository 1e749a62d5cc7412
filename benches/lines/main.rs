//! How near are the lines of a scan to its beams, and how long does it take to find them? The hub's, in both forms, beside
//! plain methods at equal numbers of vertices, on rooms drawn as PLE's experiment draws them and on logs of real sensors:
//! `cargo bench --bench lines`, `-- --json` for a line each, `-- --quick` for one draw and few scans of each log.
//!
//! Of J vertices there are J - 1 lines. The ratio is to iterative end-point fit on the same scans, the common ground with
//! PLE's published figures, and the target is PLE's own ratio. What is found has to cover .97 of the beams of a room.

#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches of time use more of it.
mod figures;
mod logs;
#[path = "../support/quick.rs"]
mod quick;
mod rivals;
mod rooms;
mod score;

use std::process::ExitCode;
use std::time::Instant;

use preprocess::lines::{LineFinder, Settings, Stop};
use schema::{Lines, Pose, Scan};

use figures::{Cell, Figure, Target};
use score::{Found, Score, mean};

const VERTICES: [usize; 5] = [10, 20, 30, 40, 50];
/// PLE's ratios, and those of its optimised form.
const PLE: [[f64; 5]; 2] = [[0.68, 0.86, 0.85, 0.87, 0.85], [0.44, 0.65, 0.67, 0.71, 0.71]];
/// At most so many microseconds a scan of 360 beams.
const TIME_US: [f64; 2] = [100.0, 1000.0];
const NAMES: [[&str; 5]; 2] = [
    ["10 vertices: RMSE", "20 vertices: RMSE", "30 vertices: RMSE", "40 vertices: RMSE", "50 vertices: RMSE"],
    [
        "10 vertices, polished: RMSE",
        "20 vertices, polished: RMSE",
        "30 vertices, polished: RMSE",
        "40 vertices, polished: RMSE",
        "50 vertices, polished: RMSE",
    ],
];

fn main() -> ExitCode {
    let [is_json, is_quick] = match quick::asked() {
        Ok(asked) => asked,
        Err(code) => return code,
    };
    let mut figures = Vec::new();
    let mut cells = Vec::new();
    of_rooms(if is_quick { 1..2 } else { 1..5 }, &mut figures, &mut cells);
    of_logs(if is_quick { 20 } else { 200 }, &mut cells);
    figures::print("lines", is_json, &figures);
    figures::print_cells("lines", is_json, &cells);
    ExitCode::SUCCESS
}

/// The hub's, by the number of vertices alone; points farther apart than `gap_m` are not joined.
fn hub(count: usize, polish: bool, gap_m: f64) -> LineFinder {
    // Two beams, as for the others: all beams of a room count.
    let settings = Settings { max: count as u8 - 1, min_points: 2, polish, stop: Stop::Number(gap_m) };
    LineFinder::new(Pose::default(), settings, 1081)
}

/// What each scan scores, and microseconds a scan.
fn run(finder: &mut LineFinder, scans: &[Box<Scan>]) -> (Score, f64) {
    let mut lines = Lines::default();
    let mut scores = Vec::new();
    let mut taken_us = 0.0;
    for scan in scans {
        let begin = Instant::now();
        finder.update(scan, &mut lines);
        taken_us += 1e6 * begin.elapsed().as_secs_f64();
        scores.push(Found::of(&lines).score(scan));
    }
    (mean(&scores), taken_us / scans.len().max(1) as f64)
}

fn of_rooms(seeds: std::ops::Range<u64>, figures: &mut Vec<Figure>, cells: &mut Vec<Cell>) {
    let draws: Vec<Vec<Box<Scan>>> = seeds.map(|seed| rooms::draw(seed, rooms::RAYS)).collect();
    for (form, polish) in [false, true].into_iter().enumerate() {
        let mut times = Vec::new();
        for (number, &count) in VERTICES.iter().enumerate() {
            let (mut ours, mut theirs, mut shares) = (Vec::new(), Vec::new(), Vec::new());
            for scans in &draws {
                let (score, time_us) = run(&mut hub(count, polish, f64::INFINITY), scans);
                ours.push(score.rmse);
                shares.push(score.share);
                times.push(time_us);
                let scores: Vec<Score> =
                    scans.iter().map(|scan| rivals::end_points(scan, count).score(scan)).collect();
                theirs.push(mean(&scores).rmse);
            }
            let (name, target) = (NAMES[form][number], Target::Ratio(PLE[form][number]));
            figures.push(Figure { name, unit: "m", hub: ours, floor: theirs, target });
            cells.push(Cell {
                table: "rooms: share of the beams".to_owned(),
                row: if polish { "polished".to_owned() } else { "plain".to_owned() },
                column: count.to_string(),
                unit: "1",
                values: shares,
            });
        }
        let longer = rooms::draw(1, 1081);
        let of_longer = VERTICES.map(|count| run(&mut hub(count, polish, f64::INFINITY), &longer).1);
        let name = if polish { "time of 1081 beams, polished" } else { "time of 1081 beams" };
        figures.push(Figure {
            name,
            unit: "us",
            hub: of_longer.to_vec(),
            floor: Vec::new(),
            target: Target::None,
        });
        let name = if polish { "time, polished" } else { "time" };
        figures.push(Figure {
            name,
            unit: "us",
            hub: times,
            floor: Vec::new(),
            target: Target::Most(TIME_US[form]),
        });
    }
}

fn of_logs(most: usize, cells: &mut Vec<Cell>) {
    let files = logs::files();
    if files.is_empty() {
        eprintln!("no logs: SCANHUB_DATA names no folder with carmen/*.log.gz; left out");
    }
    for file in files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let name = name.trim_end_matches("-corrected.log.gz");
        let scans = match logs::scans(&file, most) {
            Ok(scans) => scans,
            Err(error) => {
                eprintln!("{}: {error}; left out", file.display());
                continue;
            }
        };
        type Rival = fn(&Scan, usize) -> Found;
        let rivals: [(&str, Rival); 3] = [
            ("end-point fit", rivals::end_points),
            ("split and merge", rivals::split_and_merge),
            ("RANSAC", rivals::ransac),
        ];
        for count in VERTICES {
            let mut put = |row: &str, score: Score| {
                for (what, unit, value) in [("RMSE", "m", score.rmse), ("share", "1", score.share)] {
                    cells.push(Cell {
                        table: format!("{name}: {what}"),
                        row: row.to_owned(),
                        column: count.to_string(),
                        unit,
                        values: vec![value],
                    });
                }
            };
            for (row, rival) in rivals {
                let scores: Vec<Score> = scans.iter().map(|scan| rival(scan, count).score(scan)).collect();
                put(row, mean(&scores));
            }
            put("hub", run(&mut hub(count, false, 1.0), &scans).0);
            put("hub, polished", run(&mut hub(count, true, 1.0), &scans).0);
        }
    }
}
