//! Measures which number of beams is best for each model of a rotating scanner. For several numbers of beams, this
//! example prints the share of points that the grid drops because their beam already has a point, and the share of
//! beams without a point. It also prints how long the grid takes to assign the points of a revolution to beams. The
//! tables are in docs/measured.md. To run the example: `cargo run --release -p scanhub-sim --example beams`.

use scanhub_drivers::line::{Action, Event, ScannerSession};
use scanhub_drivers::line::{Grid, NOT_MEASURED, Point};
use scanhub_drivers::{Settings, ld, rplidar};
use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::port::now_ns;

use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{RplidarSettings, RplidarSimulator};
use scanhub_sim::world::World;

fn room() -> Room {
    let world: World = "room".parse().expect("a built-in world");
    Room::new(&world, 1)
}

/// Returns the complete revolutions that `session` forms from the bytes that `device` sends in `seconds`, and the
/// number of beams that `session` uses by default.
fn revolutions<S>(mut session: S, mut device: impl Device, seconds: u64) -> (Vec<Vec<Point>>, usize)
where
    S: ScannerSession,
{
    let (mut now, mut revolutions): (Nanos, Vec<Vec<Point>>) = (0, Vec::new());
    while now < seconds * 1_000 * MILLIS {
        now += MILLIS;
        let mut bytes = Vec::new();
        while let Some(chunk) = device.poll_transmit(now) {
            bytes.extend(chunk.bytes);
        }
        let spare = session.read_buffer();
        let len = bytes.len().min(spare.len());
        spare[..len].copy_from_slice(&bytes[..len]);
        session.commit(now, len);
        if len == 0 {
            session.handle_timeout(now);
        }
        loop {
            match session.poll_action() {
                Action::Event(Event::Scan(revolution)) if !revolution.is_incomplete() => {
                    revolutions.push(revolution.points().to_vec())
                }
                Action::Transmit { bytes, .. } => {
                    let bytes = bytes.to_vec();
                    for byte in bytes {
                        now += line_time(1, device.rate());
                        while device.poll_transmit(now).is_some() {}
                        if session.rate() == device.rate() {
                            device.receive(byte, Arrival::at(now));
                        }
                    }
                    session.handle_transmitted(now);
                }
                Action::Event(_) | Action::SetRate(_) | Action::SetDtr(_) => {}
                Action::SleepUntil(_) | Action::Wait { .. } => break,
            }
        }
    }
    (revolutions, session.beams().expect("a beam count"))
}

/// A grid and the arrays that it fills.
struct GridSheet {
    grid: Grid,
    ranges: Vec<u16>,
    intensities: Vec<u8>,
    angles: Vec<f32>,
}

impl GridSheet {
    fn new(beams: usize) -> GridSheet {
        let grid = Grid::new(beams);
        GridSheet { grid, ranges: vec![0; beams], intensities: vec![0; beams], angles: vec![0.0; beams] }
    }

    /// Fills the grid with `points`. Returns the number of points whose beam already had a point, and the number of
    /// beams without a point.
    fn fill(&mut self, points: &[Point]) -> (u32, u32) {
        let collisions = self.grid.fill(points, &mut self.ranges, &mut self.intensities, &mut self.angles);
        let empty = self.ranges.iter().filter(|range| **range == NOT_MEASURED).count();
        (collisions, empty as u32)
    }
}

/// Prints the rows of one model, which measures `points_per_revolution` points in a revolution. Each row is for another
/// number of beams. The `percents` are these numbers of beams relative to the number of points.
fn rows(name: &str, points_per_revolution: usize, revolutions: &[Vec<Point>], percents: &[usize]) {
    let points: usize = revolutions.iter().map(Vec::len).sum();
    for percent in percents {
        let mut sheet = GridSheet::new(points_per_revolution * percent / 100);
        let (mut collisions, mut empty) = (0, 0);
        for revolution in revolutions {
            let placed = sheet.fill(revolution);
            (collisions, empty) = (collisions + placed.0, empty + placed.1);
        }
        let beams = sheet.grid.beams();
        let collisions = 100.0 * f64::from(collisions) / points as f64;
        let empty = 100.0 * f64::from(empty) / (beams * revolutions.len()) as f64;
        println!("| {name} | {beams} | {collisions:.1} % | {empty:.1} % |");
    }
}

fn main() {
    println!("| model | beams | of points dropped | of beams not measured |\n|---|---|---|---|");
    for model in [ld::Model::Ld19, ld::Model::Stl27l, ld::Model::Ld14p] {
        let session = ld::LdSession::new(Settings { model: Some(model.name()), ..Settings::default() }, 0);
        let head = LdSimulator::new(LdSettings::of(model), room());
        let a_turn = model.points_per_second() / model.revolutions_per_second();
        let percents = [67, 80, 90, 95, 99, 100, 101, 105, 110, 120, 133];
        rows(model.name(), a_turn as usize, &revolutions(session, head, 30).0, &percents);
    }
    for simulated in scanhub_sim::rplidar::Model::ALL {
        for mode in simulated.modes() {
            let settings = Settings {
                model: Some(simulated.name()),
                mode: rplidar::Mode::from_name(mode.name).map(rplidar::Mode::name),
                ..Settings::default()
            };
            let unit = RplidarSimulator::new(RplidarSettings::of(simulated), room());
            let (revolutions, beams) = revolutions(rplidar::RplidarSession::new(settings, 0), unit, 30);
            rows(
                &format!("{} {}", simulated.name(), mode.name),
                beams,
                &revolutions,
                &[80, 90, 100, 110, 120],
            );
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
    let mut sheet = GridSheet::new(2_160);
    for order in ["in their order", "in any order"] {
        let mut times: Vec<_> = (0..2_000)
            .map(|_| {
                let started = now_ns();
                std::hint::black_box(sheet.fill(std::hint::black_box(&points)));
                now_ns() - started
            })
            .collect();
        times.sort();
        println!("3240 points {order} on 2160 beams: {:.1} us", times[times.len() / 2] as f64 / 1e3);
        random.shuffle(&mut points);
    }
}
