//! How much earlier does a warning from a partial scan arrive, and what does it cost? Posts appear in the smaller zone,
//! one after the other, at positions all over the scan. A warning is compared with the zones of the same scan by the
//! times at which the hub sent them, for an LMS and for rotating scanners. On a line that loses bytes in bursts, some
//! warnings are withdrawn, and counted. The CPU time of the hub with a subscriber to `early` is compared with that for
//! `zones` alone. The bench does not measure what a robot gains: its brakes are slower.

mod support;

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::fmt::Write as _;
use std::process::ExitCode;
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::{Early, Header, Zones};
use scanhub_schema::Scan;
use scanhub_shm::Payload;
use support::figures::{self, Cell, Figure, Target};
use support::stage::{Child, PATIENCE, PROGRAM, Stage};
use support::usage::Work;
use support::{Options, Outcome, consumer};

const SENSOR: &str = "front";

fn main() -> ExitCode {
    support::main(measure)
}

/// A scanner, and what its figures are called.
struct Scanner {
    name: &'static str,
    flags: &'static [&'static str],
    keys: &'static [&'static str],
    /// Where its posts stand, in radians from the right, counter-clockwise.
    view: (f64, f64),
    /// For how long each does, in seconds, and until the next one comes.
    stands_s: f64,
    each_s: f64,
    said: [&'static str; 4],
    load: &'static str,
}

const SCANNERS: [Scanner; 3] = [
    Scanner {
        name: "LMS, 361 beams",
        flags: &["--baud", "500000"],
        keys: &[],
        view: (0.05 * PI, 0.9 * PI),
        stands_s: 0.14,
        each_s: 0.3,
        said: [
            "LMS: warnings, clean line",
            "LMS: withdrawn, clean line",
            "LMS: warnings, burst line",
            "LMS: withdrawn, burst line",
        ],
        load: "LMS: hub's CPU time, beside zones",
    },
    Scanner {
        name: "LD19",
        flags: &["--family", "ld", "--model", "ld19"],
        keys: &["family=ld", "model=ld19"],
        view: (0.0, TAU),
        stands_s: 0.25,
        each_s: 0.5,
        said: [
            "LD19: warnings, clean line",
            "LD19: withdrawn, clean line",
            "LD19: warnings, burst line",
            "LD19: withdrawn, burst line",
        ],
        load: "LD19: hub's CPU time, beside zones",
    },
    Scanner {
        name: "RPLIDAR S2",
        flags: &["--family", "rplidar", "--model", "s2"],
        keys: &["family=rplidar", "model=s2"],
        view: (0.0, TAU),
        stands_s: 0.25,
        each_s: 0.5,
        said: [
            "S2: warnings, clean line",
            "S2: withdrawn, clean line",
            "S2: warnings, burst line",
            "S2: withdrawn, burst line",
        ],
        load: "S2: hub's CPU time, beside zones",
    },
];

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let span = Duration::from_secs(options.seconds(10));
    let (mut cells, mut figures) = (Vec::new(), Vec::new());
    for scanner in &SCANNERS {
        let told = scanner.measure(&stage, span, options.pairs())?;
        cells.extend(told.gains.into_iter().map(|(place, values)| Cell {
            table: "early: gain over zones by place".into(),
            row: format!("{} to {} % of the scan", 100 * place / PLACES, 100 * (place + 1) / PLACES),
            column: scanner.name.into(),
            unit: "ms",
            values,
        }));
        let none = Target::None;
        let targets = [none, Target::Most(0.0), none, none];
        let counts = scanner.said.into_iter().zip(told.counts).zip(targets);
        figures.extend(counts.map(|((name, hub), target)| Figure {
            name,
            unit: "1",
            hub,
            baseline: Vec::new(),
            target,
        }));
        let [hub, baseline] = told.shares;
        figures.push(Figure { name: scanner.load, unit: "%", hub, baseline, target: Target::Ratio(1.5) });
    }
    figures::print_cells("early", options.json, &cells);
    figures::print("early", options.json, &figures);
    Ok(())
}

/// What was measured of a scanner, one value per pair of runs.
#[derive(Default)]
struct Told {
    /// Medians in ms, by places in the scan.
    gains: BTreeMap<usize, Vec<f64>>,
    /// Warnings, and those withdrawn, on a clean line and on one that loses bytes.
    counts: [Vec<f64>; 4],
    /// The hub's CPU time in percent, with a follower of `early` and without.
    shares: [Vec<f64>; 2],
}

impl Scanner {
    fn measure(&self, stage: &Stage, span: Duration, pairs: usize) -> Outcome<Told> {
        let world = stage.file("posts.toml");
        std::fs::write(&world, self.posts()?)?;
        let world = world.display().to_string();
        let flags = [self.flags, &["--world", &world]].concat();
        let lossy = [&flags[..], &["--fault", "loss=0.00135,burst=1.89"]].concat();
        let mut told = Told::default();
        for pair in 0..pairs {
            let (clean, burst) = (self.run(stage, &flags, span)?, self.run(stage, &lossy, span)?);
            for (place, gain_ms) in clean.medians() {
                told.gains.entry(place).or_default().push(gain_ms);
            }
            let counts = [clean.said, clean.withdrawn, burst.said, burst.withdrawn];
            told.counts.iter_mut().zip(counts).for_each(|(of, count)| of.push(count as f64));
            let order = if pair % 2 == 0 { [true, false] } else { [false, true] };
            for is_early in order {
                let share = self.busy_share(stage, &flags, span, is_early)?;
                told.shares[usize::from(!is_early)].push(share);
            }
        }
        Ok(told)
    }

    fn hub(&self, stage: &Stage) -> Outcome<Child> {
        let mut command = stage.hub_command(PROGRAM, &[SENSOR]);
        command.args(self.keys.iter().map(|key| format!("--set=link.{SENSOR}.{key}")));
        let hub = Child::of(command, std::process::Stdio::null())?;
        hub.await_line("ready", PATIENCE)?;
        Ok(hub)
    }

    fn run(&self, stage: &Stage, flags: &[&str], span: Duration) -> Outcome<Run> {
        let _simulator = stage.simulate_as(&[SENSOR], flags)?;
        let hub = self.hub(stage)?;
        let beams = consumer::builder::<Scan>(stage.domain.name(), SENSOR)
            .timeout(Duration::from_secs(8))
            .open()?
            .next()?
            .map_or(0, |scan| scan.beams());
        let (early, zones) = thread::scope(|scope| {
            let early =
                scope.spawn(|| heard::<Early, _>(stage, span, |early| *early).map_err(|e| e.to_string()));
            let zones = scope.spawn(|| heard::<Zones, _>(stage, span, |_| ()).map_err(|e| e.to_string()));
            (early.join(), zones.join())
        });
        let over = "a thread ended";
        let (early, zones) = (early.map_err(|_| over)??, zones.map_err(|_| over)??);
        hub.guard.kill()?;
        Ok(Run::of(&early, &zones, beams.max(1)))
    }

    /// The hub's share of a processor in percent, with a follower of `zones`, and of `early` too if `is_early`.
    fn busy_share(&self, stage: &Stage, flags: &[&str], span: Duration, is_early: bool) -> Outcome<f64> {
        let _simulator = stage.simulate_as(&[SENSOR], flags)?;
        let hub = self.hub(stage)?;
        let long = SETTLING + span + Duration::from_secs(1);
        let share = thread::scope(|scope| {
            scope.spawn(|| heard::<Zones, _>(stage, long, |_| ()).map_err(|error| error.to_string()));
            if is_early {
                scope.spawn(|| heard::<Early, _>(stage, long, |_| ()).map_err(|error| error.to_string()));
            }
            thread::sleep(SETTLING);
            let (before, since) = (Work::of(hub.guard.pid(), |_| true)?, Instant::now());
            thread::sleep(span);
            let work = Work::of(hub.guard.pid(), |_| true)?.since(before);
            Outcome::Ok(100.0 * work.busy_ns as f64 / since.elapsed().as_nanos() as f64)
        })?;
        hub.guard.kill()?;
        Ok(share)
    }

    /// A room, and in it one post at a time, 0.55 m from the sensor, for a few scans each.
    fn posts(&self) -> Outcome<String> {
        let mut world = String::from("[noise]\nerrors = 0\nweak = false\n");
        world += "[[thing]]\nline = [[-4000, -3000], [4000, -3000], [4000, 4000], [-4000, 4000], [-4000, -3000]]\n";
        for n in 0..POSTS {
            let angle = self.view.0 + self.view.1 * ((n * 37) % POSTS) as f64 / POSTS as f64;
            let (x, y) = (550.0 * angle.cos(), 550.0 * angle.sin());
            let from_s = 1.0 + self.each_s * n as f64;
            writeln!(world, "[[thing]]\nradius_mm = 40\npose = [{x:.0}, {y:.0}]")?;
            writeln!(world, "from_s = {from_s:.2}\nuntil_s = {:.2}", from_s + self.stands_s)?;
        }
        Ok(world)
    }
}

/// What was said in a run.
struct Run {
    said: usize,
    withdrawn: usize,
    /// By how many ms the first warning of a scan came before its zones, by sixths of the scan.
    gains_ms: BTreeMap<usize, Vec<f64>>,
}

impl Run {
    /// What the samples of both topics tell of scans of so many beams.
    fn of(early: &[(Header, Early)], zones: &[(Header, ())], beams: usize) -> Run {
        let sent: BTreeMap<u64, u64> =
            zones.iter().rev().map(|(header, ())| (header.seq, sent_ns(header))).collect();
        let mut run = Run { said: 0, withdrawn: 0, gains_ms: BTreeMap::new() };
        for (header, early) in early {
            if early.is_withdrawn() {
                run.withdrawn += 1;
                continue;
            }
            run.said += 1;
            // Of a turn only the packets are numbered before it is over.
            if let Some((_, zones_ns)) = sent.range(header.seq..).next() {
                let gain_ms = (*zones_ns as f64 - sent_ns(header) as f64) / 1e6;
                let place = usize::from(early.beam) * PLACES / beams;
                run.gains_ms.entry(place).or_default().push(gain_ms);
            }
        }
        run
    }

    fn medians(&self) -> impl Iterator<Item = (usize, f64)> {
        self.gains_ms.iter().filter_map(|(&place, gains)| {
            let mut sorted = gains.clone();
            sorted.sort_by(f64::total_cmp);
            Some((place, figures::percentile(&sorted, 0.5)?))
        })
    }
}

/// Headers of a topic for `span` from its first sample on, and what `take` takes of each.
fn heard<P: Payload, T>(stage: &Stage, span: Duration, take: impl Fn(&P) -> T) -> Outcome<Vec<(Header, T)>> {
    let mut topic =
        consumer::builder::<P>(stage.domain.name(), SENSOR).timeout(Duration::from_secs(8)).open()?;
    let mut heard = Vec::new();
    let mut end = None;
    while let Some(sample) = topic.next()? {
        heard.push((*sample.header(), take(&sample)));
        if Instant::now() >= *end.get_or_insert_with(|| Instant::now() + span) {
            break;
        }
    }
    Ok(heard)
}

/// When the hub sent a sample, on the clock of stamps.
fn sent_ns(header: &Header) -> u64 {
    header.stamp_last_ns + header.hub_time_ns().unwrap_or(0)
}

const POSTS: usize = 200;
/// The parts by which places in a scan are told.
const PLACES: usize = 6;
/// Until the sensor streams and the rhythm is learned.
const SETTLING: Duration = Duration::from_secs(4);
