//! How many beams a grid for each model of LDROBOT should have: what share of its points find their bin taken, and what
//! share of the bins stays empty, against the number of bins; and how long a turn takes to be put there. The tables of
//! docs/scanners.md: `cargo run --release -p scanhub-sim --example beams`.

use ld::{Heard, Model, Session, Settings};
use line::grid::{Grid, Point};
use line::{MILLIS, Nanos, Output, Session as _};
use sim::device::Device as _;
use sim::ld::{Head, HeadSettings, Packets};
use sim::pty::now_ns;
use sim::room::Room;
use sim::world::World;

/// The whole turns of `seconds` of a `model` in a furnished room.
fn turns(model: Model, seconds: u64) -> Vec<Vec<Point>> {
    let world: World = "room".parse().expect("a built-in world");
    let room = Packets::Room(Box::new(Room::new(&world, 1)));
    let mut head = Head::new(HeadSettings::of(model), room);
    let mut session = Session::new(Settings { model: Some(model), ..Settings::default() }, 0);
    let (mut now, mut turns): (Nanos, Vec<Vec<Point>>) = (0, Vec::new());
    while now < seconds * 1_000 * MILLIS {
        now += MILLIS;
        let mut bytes = Vec::new();
        while let Some(chunk) = head.poll_transmit(now) {
            bytes.extend(chunk.bytes);
        }
        session.spare()[..bytes.len()].copy_from_slice(&bytes);
        session.commit(now, bytes.len());
        loop {
            match session.poll_output() {
                Output::Heard(Heard::Turn(turn)) if !turn.incomplete => turns.push(turn.points.to_vec()),
                Output::Heard(_) | Output::SetRate(_) | Output::Transmit { .. } => {}
                Output::Rest(_) | Output::Wait { .. } => break,
            }
        }
    }
    turns
}

/// A grid and the slices that it fills.
struct Sheet {
    grid: Grid,
    ranges: Vec<u16>,
    intensities: Vec<u8>,
    angles: Vec<f32>,
}

impl Sheet {
    fn new(beams: usize) -> Sheet {
        let grid = Grid::new(beams);
        Sheet { grid, ranges: vec![0; beams], intensities: vec![0; beams], angles: vec![0.0; beams] }
    }

    /// How many of `points` collapsed, and how many beams were not measured.
    fn fill(&mut self, points: &[Point]) -> (u32, u32) {
        let placed = self.grid.fill(points, &mut self.ranges, &mut self.intensities, &mut self.angles);
        (placed.collapsed, placed.not_measured)
    }
}

fn main() {
    println!("| model | beams | of points collapsed | of beams not measured |\n|---|---|---|---|");
    for model in [Model::Ld19, Model::Stl27l, Model::Ld14p] {
        let turns = turns(model, 30);
        let points: usize = turns.iter().map(Vec::len).sum();
        let a_turn = (model.points_per_second() / model.turns_per_second()) as usize;
        for percent in [67, 80, 90, 95, 99, 100, 101, 105, 110, 120, 133] {
            let mut sheet = Sheet::new(a_turn * percent / 100);
            let (mut collapsed, mut empty) = (0, 0);
            for turn in &turns {
                let placed = sheet.fill(turn);
                (collapsed, empty) = (collapsed + placed.0, empty + placed.1);
            }
            let beams = sheet.grid.beams();
            let collapsed = 100.0 * f64::from(collapsed) / points as f64;
            let empty = 100.0 * f64::from(empty) / (beams * turns.len()) as f64;
            println!("| {} | {beams} | {collapsed:.1} % | {empty:.1} % |", model.name());
        }
    }
    let mut random = fastrand::Rng::with_seed(1);
    let mut points: Vec<Point> = (0..3_240)
        .map(|i| Point {
            angle: -std::f32::consts::TAU * i as f32 / 3_240.0,
            range: random.u16(..),
            intensity: 9,
        })
        .collect();
    let mut sheet = Sheet::new(2_160);
    for order in ["in their order", "in any order"] {
        let mut times: Vec<_> = (0..2_000)
            .map(|_| {
                let begun = now_ns();
                std::hint::black_box(sheet.fill(std::hint::black_box(&points)));
                now_ns() - begun
            })
            .collect();
        times.sort();
        println!("3240 points {order} on 2160 beams: {:.1} us", times[times.len() / 2] as f64 / 1e3);
        random.shuffle(&mut points);
    }
}
