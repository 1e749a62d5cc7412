//! Accuracy of the lines that methods find in a scan, relative to the beams of the scan, and CPU time of these methods.
//! The bench compares both forms of the hub's method with simple methods that use the same number of vertices. The
//! rooms are drawn at random as in the experiment of PLE (Schaefer, Buescher, Luft, Burgard, IROS 2018). The logs come
//! from real sensors.
//!
//! J vertices make J - 1 lines. The figure of a method is the ratio of its error to that of iterative end-point fit on
//! the same scans, as in the publication of PLE. The target is the ratio that PLE reaches there. The lines have to
//! cover .97 of the beams of a room.
//!
//! The RMSE covers only the beams that meet a line, so compare it together with the share of these beams. The hub's
//! lines need not be connected. On logs, points that are more than 1 m apart are not connected by a line. If the hub
//! finds too many lines, the worst lines are dropped.

use std::f64::consts::{PI, TAU};
use std::ops::Range;
use std::time::Instant;

use fastrand::Rng;
use scanhub_preprocess::lines::{LineFinder, Settings, StopCriterion};
use scanhub_schema::{Lines, Pose, Scan};

use crate::figures::{self, Cell, Figure, Target};
use crate::recordings::{self, normal, scan};

const VERTEX_COUNTS: [usize; 5] = [10, 20, 30, 40, 50];
/// Ratios in the publication of PLE: those of PLE, and those of its optimized form.
const PLE_RATIOS: [[f64; 5]; 2] = [[0.68, 0.86, 0.85, 0.87, 0.85], [0.44, 0.65, 0.67, 0.71, 0.71]];
/// Maximum time in microseconds for a scan of 360 beams, for each form of the hub's method.
const MAX_TIME_US: [f64; 2] = [100.0, 1000.0];
const NAMES: [[&str; 5]; 2] = [
    ["10 vertices: RMSE", "20 vertices: RMSE", "30 vertices: RMSE", "40 vertices: RMSE", "50 vertices: RMSE"],
    [
        "10 vertices, refined: RMSE",
        "20 vertices, refined: RMSE",
        "30 vertices, refined: RMSE",
        "40 vertices, refined: RMSE",
        "50 vertices, refined: RMSE",
    ],
];

/// Measures the methods in rooms that are drawn at random, and on logs. If `is_quick` is true, uses only one set of
/// rooms and few scans of each log.
pub(crate) fn measure(is_quick: bool, is_json: bool) {
    let mut figures = Vec::new();
    let mut cells = Vec::new();
    let seeds = if is_quick { 1..2 } else { 1..5 };
    measure_rooms(seeds.clone(), &mut figures, &mut cells);
    compare_with_walls(seeds, &mut cells);
    measure_logs(if is_quick { 20 } else { 200 }, &mut cells);
    figures::print("perception, lines", is_json, &figures);
    figures::print_cells("perception, lines", is_json, &cells);
}

/// Returns the hub's line finder, whose lines are limited only by the number of vertices `count`. Points that are more
/// than `gap_m` apart are not connected.
fn hub_line_finder(count: usize, refine: bool, gap_m: f64) -> LineFinder {
    // Allow lines of two beams, as the other methods do, because all beams of a room count.
    let settings =
        Settings { max: count as u8 - 1, min_points: 2, refine, stop: StopCriterion::Number(gap_m) };
    LineFinder::new(Pose::default(), settings, 1081)
}

/// Returns the mean score of the lines that `finder` finds, and the time per scan in microseconds.
fn run(finder: &mut LineFinder, scans: &[Box<Scan>]) -> (Score, f64) {
    let mut lines = Lines::default();
    let mut scores = Vec::new();
    let mut taken_us = 0.0;
    for scan in scans {
        let begin = Instant::now();
        finder.update(scan, &mut lines);
        taken_us += 1e6 * begin.elapsed().as_secs_f64();
        scores.push(FoundLines::of(&lines).score(scan));
    }
    (mean(&scores), taken_us / scans.len().max(1) as f64)
}

fn measure_rooms(seeds: Range<u64>, figures: &mut Vec<Figure>, cells: &mut Vec<Cell>) {
    let draws: Vec<Vec<Box<Scan>>> = seeds.map(|seed| scans(draw_rooms(seed, RAY_COUNT))).collect();
    for (form, refine) in [false, true].into_iter().enumerate() {
        let mut times = Vec::new();
        for (number, &count) in VERTEX_COUNTS.iter().enumerate() {
            let (mut ours, mut theirs, mut shares) = (Vec::new(), Vec::new(), Vec::new());
            for scans in &draws {
                let (score, time_us) = run(&mut hub_line_finder(count, refine, f64::INFINITY), scans);
                ours.push(score.rmse);
                shares.push(score.share);
                times.push(time_us);
                let scores: Vec<Score> =
                    scans.iter().map(|scan| end_points(scan, count).score(scan)).collect();
                theirs.push(mean(&scores).rmse);
            }
            let (name, target) = (NAMES[form][number], Target::Ratio(PLE_RATIOS[form][number]));
            figures.push(Figure { name, unit: "m", hub: ours, baseline: theirs, target });
            cells.push(Cell {
                table: "rooms: share of the beams".to_owned(),
                row: if refine { "refined".to_owned() } else { "plain".to_owned() },
                column: count.to_string(),
                unit: "1",
                values: shares,
            });
        }
        let longer = scans(draw_rooms(1, 1081));
        let of_longer =
            VERTEX_COUNTS.map(|count| run(&mut hub_line_finder(count, refine, f64::INFINITY), &longer).1);
        let name = if refine { "time of 1081 beams, refined" } else { "time of 1081 beams" };
        figures.push(Figure {
            name,
            unit: "us",
            hub: of_longer.to_vec(),
            baseline: Vec::new(),
            target: Target::None,
        });
        let name = if refine { "time, refined" } else { "time" };
        figures.push(Figure {
            name,
            unit: "us",
            hub: times,
            baseline: Vec::new(),
            target: Target::Max(MAX_TIME_US[form]),
        });
    }
}

/// Compares the lines of two methods with the true walls. One is the hub's method with settings that a user can
/// configure. The other is end-point fit with the true number of vertices.
fn compare_with_walls(seeds: Range<u64>, cells: &mut Vec<Cell>) {
    let draws: Vec<Vec<Room>> = seeds.map(|seed| draw_rooms(seed, RAY_COUNT)).collect();
    let mut lines = Lines::default();
    let mut put = |row: &str, find: &mut dyn FnMut(&Room) -> FoundLines| {
        let mut columns = [const { Vec::new() }; 4];
        for rooms in &draws {
            let (mut scores, mut of_truth, mut ratio) = (Vec::new(), Vec::new(), 0.0);
            for room in rooms {
                let found = find(room);
                scores.push(found.score(&room.scan));
                of_truth.push(found.compare(|beam| Some(room.walls_m[beam]), &room.scan));
                ratio += found.lines.len() as f64 / room.corners as f64 / rooms.len() as f64;
            }
            let (score, of_truth) = (mean(&scores), mean(&of_truth));
            let values = [of_truth.rmse, score.rmse, score.share, ratio];
            columns.iter_mut().zip(values).for_each(|(column, value)| column.push(value));
        }
        let names =
            ["true walls: RMSE", "beams: RMSE", "share of the beams on a line", "lines by number of walls"];
        for ((column, unit), values) in names.into_iter().zip(["m", "m", "1", "1"]).zip(columns) {
            cells.push(Cell {
                table: "rooms, as configured".to_owned(),
                row: row.to_owned(),
                column: column.to_owned(),
                unit,
                values,
            });
        }
    };
    for (row, refine) in [("default", false), ("refined", true)] {
        let settings = Settings { refine, ..Settings::default() };
        let mut finder = LineFinder::new(Pose::default(), settings, RAY_COUNT);
        put(row, &mut |room| {
            finder.update(&room.scan, &mut lines);
            FoundLines::of(&lines)
        });
    }
    put("end-point fit", &mut |room| end_points(&room.scan, room.corners + 1));
    // The true walls are given as one line for each beam.
    put("true walls", &mut |room| {
        let line = |(beam, range): (usize, &f64)| (beam, beam, *range, room.scan.angle(beam));
        FoundLines { lines: room.walls_m.iter().enumerate().map(line).collect() }
    });
}

fn measure_logs(max_scans: usize, cells: &mut Vec<Cell>) {
    let logs = recordings::logs();
    if logs.is_empty() {
        eprintln!("left out: SCANHUB_DATA names no folder with carmen/*.log.gz");
    }
    for (name, scans) in logs {
        let every = scans.len().div_ceil(max_scans).max(1);
        let scans: Vec<Box<Scan>> = scans.into_iter().map(|(scan, _)| scan).step_by(every).collect();
        type Baseline = fn(&Scan, usize) -> FoundLines;
        let baselines: [(&str, Baseline); 3] =
            [("end-point fit", end_points), ("split and merge", split_and_merge), ("RANSAC", ransac)];
        for count in VERTEX_COUNTS {
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
            for (row, baseline) in baselines {
                let scores: Vec<Score> = scans.iter().map(|scan| baseline(scan, count).score(scan)).collect();
                put(row, mean(&scores));
            }
            put("hub", run(&mut hub_line_finder(count, false, 1.0), &scans).0);
            put("hub, refined", run(&mut hub_line_finder(count, true, 1.0), &scans).0);
        }
    }
}

/// Lines that a method found in a scan, in the order of their beams.
struct FoundLines {
    /// Lines. Each entry has the first beam, the last beam, the distance from the sensor to the nearest point of the
    /// line, and the direction of this point.
    lines: Vec<(usize, usize, f64, f64)>,
}

/// Score of one scan.
#[derive(Clone, Copy, Debug)]
struct Score {
    /// Root mean square of the distances along the beams that meet a line, in meters.
    rmse: f64,
    /// Share of the beams that meet a line, of all beams with a range.
    share: f64,
}

impl FoundLines {
    /// Returns the lines that the hub found, for a sensor at the robot's center.
    fn of(lines: &Lines) -> FoundLines {
        let line = |line: &scanhub_schema::Line| {
            (usize::from(line.first), usize::from(line.last), f64::from(line.r_m), f64::from(line.alpha_rad))
        };
        FoundLines { lines: lines.lines().iter().map(line).collect() }
    }

    /// Compares the lines with the ranges of `scan`.
    fn score(&self, scan: &Scan) -> Score {
        self.compare(|beam| scan.distance_m(beam), scan)
    }

    /// Compares the lines with the ranges in meters that `range` returns for the beams of `scan`.
    fn compare(&self, range: impl Fn(usize) -> Option<f64>, scan: &Scan) -> Score {
        let (mut square, mut count) = (0.0, 0);
        let mut is_met = vec![false; scan.beams()];
        for &(first, last, r, alpha) in &self.lines {
            for (beam, is_met) in is_met.iter_mut().enumerate().take(last + 1).skip(first) {
                let Some(range) = range(beam).filter(|_| !*is_met) else { continue };
                let off = range - r / (scan.angle(beam) - alpha).cos();
                square += off * off;
                count += 1;
                *is_met = true;
            }
        }
        let readings = (0..scan.beams()).filter(|&beam| scan.distance_m(beam).is_some()).count();
        Score {
            rmse: (square / f64::from(count.max(1))).sqrt(),
            share: f64::from(count) / readings.max(1) as f64,
        }
    }
}

/// Returns the mean of `scores`.
fn mean(scores: &[Score]) -> Score {
    let mean = |of: fn(&Score) -> f64| scores.iter().map(of).sum::<f64>() / scores.len().max(1) as f64;
    Score { rmse: mean(|score| score.rmse), share: mean(|score| score.share) }
}

/// A beam with a range, and the position at which the beam ends.
#[derive(Clone, Copy)]
struct Point {
    beam: usize,
    x: f64,
    y: f64,
}

fn points(scan: &Scan) -> Vec<Point> {
    let point = |beam| {
        let (range, angle) = (scan.distance_m(beam)?, scan.angle(beam));
        Some(Point { beam, x: range * angle.cos(), y: range * angle.sin() })
    };
    (0..scan.beams()).filter_map(point).collect()
}

/// Returns the distance and the direction of the point of a line that is nearest to the sensor. The line has the normal
/// `normal` and goes through (x, y).
fn normal_form(normal: (f64, f64), x: f64, y: f64) -> (f64, f64) {
    let r = normal.0 * x + normal.1 * y;
    let turned = if r < 0.0 { -1.0 } else { 1.0 };
    (turned * r, (turned * normal.1).atan2(turned * normal.0))
}

fn line_through(a: Point, b: Point) -> (f64, f64) {
    let length = (b.x - a.x).hypot(b.y - a.y).max(1e-12);
    normal_form(((b.y - a.y) / length, (a.x - b.x) / length), a.x, a.y)
}

/// Returns the distance and the index of the point that is farthest from the straight line through two points.
fn farthest(points: &[Point], first: usize, last: usize) -> (f64, usize) {
    let (a, b) = (points[first], points[last]);
    let length = (b.x - a.x).hypot(b.y - a.y);
    let distance = |p: Point| {
        if length < 1e-9 {
            return (p.x - a.x).hypot(p.y - a.y);
        }
        ((p.x - a.x) * (b.y - a.y) - (p.y - a.y) * (b.x - a.x)).abs() / length
    };
    (first + 1..last)
        .map(|i| (distance(points[i]), i))
        .fold((0.0, first), |best, one| if one.0 > best.0 { one } else { best })
}

/// Returns the indices of the vertices of the polyline. The first two vertices are the ends of the points. Each further
/// vertex is the point that is farthest from the polyline so far.
fn vertices(points: &[Point], count: usize) -> Vec<usize> {
    let mut vertices = vec![0, points.len() - 1];
    let mut splits = vec![farthest(points, 0, points.len() - 1)];
    while vertices.len() < count.min(points.len()) {
        let best = (0..splits.len()).max_by(|&a, &b| splits[a].0.total_cmp(&splits[b].0)).unwrap_or(0);
        let (distance, at) = splits[best];
        if distance == 0.0 {
            break;
        }
        vertices.insert(best + 1, at);
        splits[best] = farthest(points, vertices[best], at);
        splits.insert(best + 1, farthest(points, at, vertices[best + 2]));
    }
    vertices
}

/// Returns the line, with the first beam and the last beam that meet it between the projections of its outermost
/// points.
fn beams_on_line(points: &[Point], (r, alpha): (f64, f64)) -> Option<(usize, usize, f64, f64)> {
    let (first, last) = (points.first()?, points.last()?);
    let (sin, cos) = alpha.sin_cos();
    // Returns the angle in radians by which point `p` appears to the left of the projection of point `end` on the line.
    let left_of = |p: &Point, end: &Point| {
        let off = end.x * cos + end.y * sin - r;
        let (x, y) = (end.x - off * cos, end.y - off * sin);
        (x * p.y - y * p.x).atan2(x * p.x + y * p.y)
    };
    let mut inside = points.iter().filter(|p| left_of(p, first) >= -1e-3 && left_of(p, last) <= 1e-3);
    let begin = inside.next()?;
    let end = inside.next_back().unwrap_or(begin);
    Some((begin.beam, end.beam, r, alpha))
}

/// Iterative end-point fit. The lines are the pieces of a polyline whose vertices are some of the points.
fn end_points(scan: &Scan, count: usize) -> FoundLines {
    let points = points(scan);
    let mut lines = Vec::new();
    if points.len() > 1 {
        for pair in vertices(&points, count).windows(2) {
            let (a, b) = (points[pair[0]], points[pair[1]]);
            let (r, alpha) = line_through(a, b);
            lines.push((a.beam, b.beam, r, alpha));
        }
    }
    FoundLines { lines }
}

/// Returns the line that has the smallest sum of squared orthogonal distances to the points, and this sum.
fn regression(points: &[Point]) -> ((f64, f64), f64) {
    let n = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p.x / n, y + p.y / n));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        xx += (p.x - x) * (p.x - x);
        xy += (p.x - x) * (p.y - y);
        yy += (p.y - y) * (p.y - y);
    }
    let along = 0.5 * (2.0 * xy).atan2(xx - yy);
    let normal = (-along.sin(), along.cos());
    let error = normal.0 * normal.0 * xx + 2.0 * normal.0 * normal.1 * xy + normal.1 * normal.1 * yy;
    (normal_form(normal, x, y), error.max(0.0))
}

/// Split and merge. This method cuts the points into twice as many pieces as end-point fit does. Then it repeatedly
/// merges two neighboring pieces, until few enough pieces remain. It always chooses the pieces whose common line is
/// nearest to their points.
fn split_and_merge(scan: &Scan, count: usize) -> FoundLines {
    let points = points(scan);
    if points.len() < 2 {
        return FoundLines { lines: Vec::new() };
    }
    let cuts = vertices(&points, 2 * count);
    let mut pieces: Vec<(usize, usize)> = cuts.windows(2).map(|pair| (pair[0], pair[1])).collect();
    for piece in pieces.iter_mut().skip(1) {
        piece.0 += 1;
    }
    pieces.retain(|piece| piece.0 <= piece.1);
    let error = |first: usize, last: usize| regression(&points[first..=last]).1;
    while pieces.len() > count - 1 {
        let price = |i: usize| {
            let (one, two) = (pieces[i], pieces[i + 1]);
            error(one.0, two.1) - error(one.0, one.1) - error(two.0, two.1)
        };
        let prices: Vec<f64> = (0..pieces.len() - 1).map(price).collect();
        let cheapest = (0..prices.len()).min_by(|&a, &b| prices[a].total_cmp(&prices[b])).unwrap_or(0);
        pieces[cheapest].1 = pieces.remove(cheapest + 1).1;
    }
    let line = |&(first, last): &(usize, usize)| {
        let (one, points) = (points[first], &points[first..=last]);
        // For a single point, use a line at right angles to the beam.
        let alone = (one.x.hypot(one.y), one.y.atan2(one.x));
        beams_on_line(points, if points.len() > 1 { regression(points).0 } else { alone })
    };
    FoundLines { lines: pieces.iter().filter_map(line).collect() }
}

/// Number of lines that RANSAC tries before it takes the best of them.
const RANSAC_TRIES: usize = 200;
/// Maximum distance between a line of RANSAC and a point that belongs to it, in meters.
const RANSAC_DISTANCE_M: f64 = 0.05;

/// RANSAC. This method draws random lines through two points, and takes the line with the longest run of near points.
/// It removes these points, and repeats this for the other points.
fn ransac(scan: &Scan, count: usize) -> FoundLines {
    let mut random = Rng::with_seed(1);
    let mut left = points(scan);
    let mut lines = Vec::new();
    while lines.len() + 1 < count && left.len() > 2 {
        let mut best = 0..0;
        for _ in 0..RANSAC_TRIES {
            let first = random.usize(..left.len());
            let second = random.usize(first.saturating_sub(10)..(first + 11).min(left.len()));
            if first != second {
                let row = near_run(&left, first, line_through(left[first], left[second]));
                best = if row.len() > best.len() { row } else { best };
            }
        }
        if best.len() < 2 {
            break;
        }
        lines.extend(beams_on_line(&left[best.clone()], regression(&left[best.clone()]).0));
        left.drain(best);
    }
    // If two lines cover the same beam, the beam belongs to the first line, which has more points.
    FoundLines { lines }
}

/// Returns the indexes of the points around the point `at` that are near the line. The beams of these points follow
/// each other without a gap.
fn near_run(points: &[Point], at: usize, (r, alpha): (f64, f64)) -> std::ops::Range<usize> {
    let near = |p: &Point| (p.x * alpha.cos() + p.y * alpha.sin() - r).abs() < RANSAC_DISTANCE_M;
    let (mut first, mut end) = (at, at + 1);
    while first > 0 && near(&points[first - 1]) && points[first].beam - points[first - 1].beam <= 2 {
        first -= 1;
    }
    while end < points.len() && near(&points[end]) && points[end].beam - points[end - 1].beam <= 2 {
        end += 1;
    }
    first..end
}

/// Number of scans in a set, each of another room.
const SCANS_PER_SET: usize = 260;
/// Number of rays of a scan in PLE's experiment.
const RAY_COUNT: usize = 360;
const CORNER_COUNTS: [usize; 7] = [3, 4, 5, 6, 12, 36, 180];
/// Standard deviations of a ray's noise: for the angle in degrees, and for the range in meters.
const RAY_NOISE: (f64, f64) = (0.2, 0.03);

/// Returns the rooms of `seed` with scans of `rays` rays over 360 degrees. The scans include both ends of the circle,
/// so the first and the last ray have the same direction.
fn draw_rooms(seed: u64, rays: usize) -> Vec<Room> {
    let mut random = Rng::with_seed(seed);
    (0..SCANS_PER_SET).map(|_| room(&mut random, rays)).collect()
}

fn scans(rooms: Vec<Room>) -> Vec<Box<Scan>> {
    rooms.into_iter().map(|room| room.scan).collect()
}

/// A scan of a room, and the true walls.
struct Room {
    scan: Box<Scan>,
    /// Distance in meters from the sensor to the wall, in the direction of each beam.
    walls_m: Vec<f64>,
    /// Number of corners, which is also the number of walls.
    corners: usize,
}

fn room(random: &mut Rng, rays: usize) -> Room {
    let corners = CORNER_COUNTS[random.usize(..CORNER_COUNTS.len())];
    let (turned, scale) = (random.f64(), 5.0 + 5.0 * random.f64());
    let mean = (corners * corners) as f64 / 5.0;
    let distances: Vec<f64> =
        (0..corners).map(|_| scale * (poisson(random, mean) + 1.0) / (mean + 1.0)).collect();
    let (each, step) = (TAU / corners as f64, TAU / (rays - 1) as f64);
    let wall = |angle: f64| {
        let from_first = (angle - turned).rem_euclid(TAU);
        let corner = ((from_first / each) as usize).min(corners - 1);
        let (one, two) = (distances[corner], distances[(corner + 1) % corners]);
        let inside = from_first - corner as f64 * each;
        // The distance to the wall between two corners follows from the law of sines.
        one * two * each.sin() / (one * inside.sin() + two * (each - inside).sin())
    };
    let angles = (0..rays).map(|ray| ray as f64 * step - PI);
    let walls_m = angles.clone().map(wall).collect();
    let ranges: Vec<f64> = angles
        .map(|angle| wall(angle + RAY_NOISE.0.to_radians() * normal(random)) + RAY_NOISE.1 * normal(random))
        .collect();
    Room { scan: scan(-PI, step, &ranges), walls_m, corners }
}

/// Returns a Poisson-distributed number with this `mean`.
fn poisson(random: &mut Rng, mean: f64) -> f64 {
    let (mut time, mut count) = (0.0, 0.0);
    loop {
        time -= (1.0 - random.f64()).ln();
        if time > mean {
            return count;
        }
        count += 1.0;
    }
}
