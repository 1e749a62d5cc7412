//! Counts the edges in simulated scans at which beams report a range between two surfaces, because these beams hit both
//! surfaces. The table in docs/measured.md compares these counts with recordings. To run the example: `cargo run
//! --release -p scanhub-sim --example edges -- WORLD..` The world `board` is a board in front of a wall.
//!
//! At an edge, three consecutive beams are on one surface, and three later beams are on another surface. Between the
//! two groups are at most [`MAX_BETWEEN`] beams, each with a range between the surfaces. The example also simulates
//! every scan with beams without width. If such a beam reports the same range, the range is that of an oblique surface,
//! and the example does not count an edge.

use std::collections::BTreeMap;
use std::ops::Range;

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;

/// An edge in a scan.
struct Edge {
    /// Index of the first beam after the first surface.
    beam: usize,
    /// Index of the beam next to the edge, on the nearer surface.
    near: usize,
    /// Position of each range between the surfaces, from 0 at the nearer surface to 1 at the farther one.
    between: Vec<f64>,
}

/// Returns the edges in a scan. `ranges` has the range of each beam in millimeters, or `None` if the beam has a code.
fn edges(ranges: &[Option<f64>]) -> Vec<Edge> {
    let surface = |beams: Range<usize>| -> Option<()> {
        let ranges = ranges.get(beams)?.iter().copied().collect::<Option<Vec<f64>>>()?;
        ranges.windows(2).all(|pair| (pair[0] - pair[1]).abs() < MIN_MARGIN_MM).then_some(())
    };
    let edge = |beam: usize| -> Option<Edge> {
        surface(beam.checked_sub(MIN_SURFACE_BEAMS)?..beam)?;
        let one = ranges[beam - 1]?;
        (0..=MAX_BETWEEN).find_map(|count| {
            let other = ranges.get(beam + count).copied().flatten()?;
            let between = ranges[beam..beam + count].iter().copied().collect::<Option<Vec<f64>>>()?;
            let (near, far) = (one.min(other), one.max(other));
            let is_between = |range: &f64| near + MIN_MARGIN_MM < *range && *range < far - MIN_MARGIN_MM;
            surface(beam + count..beam + count + MIN_SURFACE_BEAMS)?;
            (DEPTHS_MM.contains(&(far - near)) && between.iter().all(is_between)).then(|| Edge {
                beam,
                near: if one < other { beam - 1 } else { beam + count },
                between: between.iter().map(|range| (range - near) / (far - near)).collect(),
            })
        })
    };
    (0..ranges.len()).filter_map(edge).collect()
}

/// Counts of edges.
#[derive(Default)]
struct Counts {
    all: u32,
    /// Edges with at least one range between the surfaces.
    one: u32,
    /// Edges with more than one range between the surfaces.
    several: u32,
}

impl Counts {
    fn add(&mut self, edge: &Edge) {
        self.all += 1;
        self.one += u32::from(!edge.between.is_empty());
        self.several += u32::from(edge.between.len() > 1);
    }

    fn row(&self) -> String {
        let percent = |count| 100.0 * f64::from(count) / f64::from(self.all.max(1));
        format!("{} | {:.1} % | {:.1} %", self.all, percent(self.one), percent(self.several))
    }
}

/// Returns, as text, how much a range between two surfaces changes from scan to scan. For each beam that has such a
/// range in at least a tenth of the scans, this function computes the standard deviation of [`Edge::between`]. It
/// returns the median of all beams.
fn median_deviation(edges_by_beam: &BTreeMap<(u64, usize, usize), Vec<f64>>) -> String {
    let often = edges_by_beam.values().filter(|shares| shares.len() >= SCAN_COUNT as usize / 10);
    let mut deviations: Vec<f64> = often
        .map(|shares| {
            let mean = shares.iter().sum::<f64>() / shares.len() as f64;
            (shares.iter().map(|share| (share - mean).powi(2)).sum::<f64>() / shares.len() as f64).sqrt()
        })
        .collect();
    deviations.sort_unstable_by(f64::total_cmp);
    deviations.get(deviations.len() / 2).map_or("no such edge".to_owned(), |median| format!("{median:.3}"))
}

/// Counts of edges in the scans of a world.
#[derive(Default)]
struct EdgeCounts {
    all: Counts,
    /// Edges whose nearer side is a leg of a person.
    legs: Counts,
    /// For each seed, sensor and beam: the values of [`Edge::between`] at edges with exactly one such value. Edges of
    /// legs are excluded, because people move.
    edges_by_beam: BTreeMap<(u64, usize, usize), Vec<f64>>,
}

impl EdgeCounts {
    fn measure(world: &scanhub_sim::world::World) -> EdgeCounts {
        let mut found = EdgeCounts::default();
        let layers = NoiseModel { spot: false, ..world.noise().unwrap_or_default() };
        let without_width = world.clone().with_noise(layers);
        for seed in 1..=SEED_COUNT {
            for sensor in 0..world.sensors() {
                let [wide, narrow] =
                    [world, &without_width].map(|world| Room::of_port(world, seed, sensor as u64));
                for scan in 1..=SCAN_COUNT {
                    let end_ns = SCAN_SPACING * scan * SCAN_PERIOD_NS;
                    let look = wide.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), end_ns);
                    let ranges = ranges_mm(&look.words);
                    let exact = ranges_mm(&narrow.scan(Variant::HALF, Unit::Mm, Mode(1), end_ns));
                    let is_off = |beam: usize| {
                        let pair = ranges[beam].zip(exact[beam]);
                        pair.is_none_or(|(range, exact)| (range - exact).abs() > MIN_MARGIN_MM)
                    };
                    let is_mixed = |edge: &Edge| (edge.beam..edge.beam + edge.between.len()).all(is_off);
                    for edge in edges(&ranges).into_iter().filter(is_mixed) {
                        found.all.add(&edge);
                        if look.truth[edge.near] == BeamTarget::Person {
                            found.legs.add(&edge);
                        } else if let [share] = edge.between[..] {
                            found.edges_by_beam.entry((seed, sensor, edge.beam)).or_default().push(share);
                        }
                    }
                }
            }
        }
        found
    }
}

fn main() {
    let names: Vec<String> = std::env::args().skip(1).collect();
    let names = if names.is_empty() { DEFAULT_WORLDS.map(str::to_owned).to_vec() } else { names };
    println!(
        "| world | edges | with a value between | with several | of legs | with one | with several | spread |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for name in names {
        let world: Result<scanhub_sim::world::World, _> = match &*name {
            "board" => scanhub_sim::world::World::of_toml(&name, BOARD_WORLD),
            _ => name.parse(),
        };
        let world = world.unwrap_or_else(|failure| panic!("{failure}"));
        let found = EdgeCounts::measure(&world);
        let (all, legs, spread) = (found.all.row(), found.legs.row(), median_deviation(&found.edges_by_beam));
        println!("| {name} | {all} | {legs} | {spread} |");
    }
}

/// Converts value words of mode 1 to ranges in millimeters. A code becomes `None`.
fn ranges_mm(words: &[u16]) -> Vec<Option<f64>> {
    words.iter().map(|word| Some(word & 8191).filter(|range| *range < 8183).map(f64::from)).collect()
}

const DEFAULT_WORLDS: [&str; 5] = ["board", "room", "crowd", "house", "demo"];
/// A board in front of a wall.
const BOARD_WORLD: &str = "
[[thing]]
line = [[-6000, 3500], [6000, 3500]]
[[thing]]
line = [[-300, 0], [300, 0]]
pose = [0, 2800]
jitter_mm = 200
";
const DEPTHS_MM: std::ops::RangeInclusive<f64> = 300.0..=1_500.0;
/// Number of consecutive beams that form a surface.
const MIN_SURFACE_BEAMS: usize = 3;
/// Minimum difference of two ranges that do not belong to one surface. The ranges of neighboring beams on a surface
/// differ by less, and a range between two surfaces differs from both surfaces by more.
const MIN_MARGIN_MM: f64 = 60.0;
/// Maximum number of beams between the two surfaces of an edge.
const MAX_BETWEEN: usize = 3;
/// Number of seeds with which each world is simulated.
const SEED_COUNT: u64 = 20;
/// Number of scans that are evaluated for each seed and sensor. They are spread over 53 s.
const SCAN_COUNT: u64 = 200;
/// Distance between two evaluated scans, in scans.
const SCAN_SPACING: u64 = 10;
/// Period of the scans.
const SCAN_PERIOD_NS: u64 = 26_640_000;
