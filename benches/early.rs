//! Gain and cost of early warnings from partial scans, for an LMS and for rotating scanners. Posts appear in the
//! smaller zone, one after the other, at positions all over the scan. The gain is the time from the warning until the
//! hub sends the zones of the same scan. On a line that loses bytes in bursts, the hub withdraws some warnings, and the
//! bench counts the withdrawn warnings. The cost is the additional CPU time of the hub if `early` has a subscriber, and
//! not only `zones`. The bench does not measure how much earlier a robot stops, because a robot's brakes are slower
//! than a scan.

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
use support::environment::{BenchEnvironment, Child, PROGRAM, STEP_TIMEOUT};
use support::figures::{self, Cell, Figure, Target};
use support::usage::ThreadUsage;
use support::{Options, Outcome, subscriber};

const SENSOR: &str = "front";

fn main() -> ExitCode {
    support::main(measure)
}

/// A scanner, with the names of its figures.
struct Scanner {
    name: &'static str,
    flags: &'static [&'static str],
    keys: &'static [&'static str],
    /// Directions of the posts around this scanner: the direction of the first post, and the angle that all posts
    /// together cover. Both are in radians, and directions are counterclockwise from the right.
    view: (f64, f64),
    /// Time for which each post exists, and time from the appearance of one post to that of the next, both in seconds.
    post_duration_s: f64,
    post_interval_s: f64,
    warning_figures: [&'static str; 4],
    load_figure: &'static str,
}

const SCANNERS: [Scanner; 3] = [
    Scanner {
        name: "LMS, 361 beams",
        flags: &["--baud", "500000"],
        keys: &[],
        view: (0.05 * PI, 0.9 * PI),
        post_duration_s: 0.14,
        post_interval_s: 0.3,
        warning_figures: [
            "LMS: warnings, clean line",
            "LMS: withdrawn, clean line",
            "LMS: warnings, burst line",
            "LMS: withdrawn, burst line",
        ],
        load_figure: "LMS: hub's CPU time, beside zones",
    },
    Scanner {
        name: "LD19",
        flags: &["--family", "ld", "--model", "ld19"],
        keys: &["family=ld", "model=ld19"],
        view: (0.0, TAU),
        post_duration_s: 0.25,
        post_interval_s: 0.5,
        warning_figures: [
            "LD19: warnings, clean line",
            "LD19: withdrawn, clean line",
            "LD19: warnings, burst line",
            "LD19: withdrawn, burst line",
        ],
        load_figure: "LD19: hub's CPU time, beside zones",
    },
    Scanner {
        name: "RPLIDAR S2",
        flags: &["--family", "rplidar", "--model", "s2"],
        keys: &["family=rplidar", "model=s2"],
        view: (0.0, TAU),
        post_duration_s: 0.25,
        post_interval_s: 0.5,
        warning_figures: [
            "S2: warnings, clean line",
            "S2: withdrawn, clean line",
            "S2: warnings, burst line",
            "S2: withdrawn, burst line",
        ],
        load_figure: "S2: hub's CPU time, beside zones",
    },
];

fn measure(options: &Options) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let span = Duration::from_secs(options.seconds(10));
    let (mut cells, mut figures) = (Vec::new(), Vec::new());
    for scanner in &SCANNERS {
        let results = scanner.measure(&environment, span, options.pairs())?;
        cells.extend(results.gains.into_iter().map(|(place, values)| Cell {
            table: "early: gain over zones by place".into(),
            row: format!("{} to {} % of the scan", 100 * place / SCAN_PARTS, 100 * (place + 1) / SCAN_PARTS),
            column: scanner.name.into(),
            unit: "ms",
            values,
        }));
        let none = Target::None;
        let targets = [none, Target::Max(0.0), none, none];
        let counts = scanner.warning_figures.into_iter().zip(results.counts).zip(targets);
        figures.extend(counts.map(|((name, hub), target)| Figure {
            name,
            unit: "1",
            hub,
            baseline: Vec::new(),
            target,
        }));
        let [hub, baseline] = results.cpu_percents;
        figures.push(Figure {
            name: scanner.load_figure,
            unit: "%",
            hub,
            baseline,
            target: Target::Ratio(1.5),
        });
    }
    figures::print_cells("early", options.json, &cells);
    figures::print("early", options.json, &figures);
    Ok(())
}

/// Results of a scanner, one value per pair of runs.
#[derive(Default)]
struct WarningFigures {
    /// Medians of the gain in milliseconds, by the part of the scan in which the post is.
    gains: BTreeMap<usize, Vec<f64>>,
    /// Number of warnings and number of withdrawn warnings on a clean line, followed by the same two numbers on a line
    /// that loses bytes.
    counts: [Vec<f64>; 4],
    /// CPU time of the hub in percent, with a subscriber to `early` and without one.
    cpu_percents: [Vec<f64>; 2],
}

impl Scanner {
    fn measure(
        &self,
        environment: &BenchEnvironment,
        span: Duration,
        pairs: usize,
    ) -> Outcome<WarningFigures> {
        let world = environment.file("posts.toml");
        std::fs::write(&world, self.posts_world()?)?;
        let world = world.display().to_string();
        let flags = [self.flags, &["--world", &world]].concat();
        let lossy = [&flags[..], &["--fault", "loss=0.00135,burst=1.89"]].concat();
        let mut figures = WarningFigures::default();
        for pair in 0..pairs {
            let (clean, burst) = (self.run(environment, &flags, span)?, self.run(environment, &lossy, span)?);
            for (place, gain_ms) in clean.medians() {
                figures.gains.entry(place).or_default().push(gain_ms);
            }
            let counts = [clean.warnings, clean.withdrawn, burst.warnings, burst.withdrawn];
            figures.counts.iter_mut().zip(counts).for_each(|(of, count)| of.push(count as f64));
            let order = if pair % 2 == 0 { [true, false] } else { [false, true] };
            for is_early in order {
                let share = self.busy_share(environment, &flags, span, is_early)?;
                figures.cpu_percents[usize::from(!is_early)].push(share);
            }
        }
        Ok(figures)
    }

    fn start_hub(&self, environment: &BenchEnvironment) -> Outcome<Child> {
        let mut command = environment.hub_command(PROGRAM, &[SENSOR]);
        command.args(self.keys.iter().map(|key| format!("--set=link.{SENSOR}.{key}")));
        let hub = Child::spawn(command, std::process::Stdio::null())?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        Ok(hub)
    }

    fn run(&self, environment: &BenchEnvironment, flags: &[&str], span: Duration) -> Outcome<WarningRun> {
        let _simulator = environment.simulate_as(&[SENSOR], flags)?;
        let hub = self.start_hub(environment)?;
        let beams = subscriber::builder::<Scan>(environment.domain.name(), SENSOR)
            .timeout(Duration::from_secs(8))
            .open()?
            .next()?
            .map_or(0, |scan| scan.beams());
        let (early, zones) = thread::scope(|scope| {
            let early = scope
                .spawn(|| receive::<Early, _>(environment, span, |early| *early).map_err(|e| e.to_string()));
            let zones =
                scope.spawn(|| receive::<Zones, _>(environment, span, |_| ()).map_err(|e| e.to_string()));
            (early.join(), zones.join())
        });
        let over = "a thread ended";
        let (early, zones) = (early.map_err(|_| over)??, zones.map_err(|_| over)??);
        hub.guard.kill()?;
        Ok(WarningRun::from_samples(&early, &zones, beams.max(1)))
    }

    /// Returns the CPU time of the hub in percent of one processor, with a subscriber to `zones`. If `is_early`, there
    /// is also a subscriber to `early`.
    fn busy_share(
        &self,
        environment: &BenchEnvironment,
        flags: &[&str],
        span: Duration,
        is_early: bool,
    ) -> Outcome<f64> {
        let _simulator = environment.simulate_as(&[SENSOR], flags)?;
        let hub = self.start_hub(environment)?;
        let long = SETTLE_TIME + span + Duration::from_secs(1);
        let share = thread::scope(|scope| {
            scope.spawn(|| receive::<Zones, _>(environment, long, |_| ()).map_err(|error| error.to_string()));
            if is_early {
                scope.spawn(|| {
                    receive::<Early, _>(environment, long, |_| ()).map_err(|error| error.to_string())
                });
            }
            thread::sleep(SETTLE_TIME);
            let (before, since) = (ThreadUsage::of(hub.guard.pid(), |_| true)?, Instant::now());
            thread::sleep(span);
            let work = ThreadUsage::of(hub.guard.pid(), |_| true)?.since(before);
            Outcome::Ok(100.0 * work.busy_ns as f64 / since.elapsed().as_nanos() as f64)
        })?;
        hub.guard.kill()?;
        Ok(share)
    }

    /// Returns a world with a room in which one post at a time appears, 0.55 m from the sensor. Each post exists for a
    /// few scans.
    fn posts_world(&self) -> Outcome<String> {
        let mut world = String::from("[noise]\nerrors = 0\nweak = false\n");
        world += "[[thing]]\nline = [[-4000, -3000], [4000, -3000], [4000, 4000], [-4000, 4000], [-4000, -3000]]\n";
        for n in 0..POST_COUNT {
            let angle = self.view.0 + self.view.1 * ((n * 37) % POST_COUNT) as f64 / POST_COUNT as f64;
            let (x, y) = (550.0 * angle.cos(), 550.0 * angle.sin());
            let from_s = 1.0 + self.post_interval_s * n as f64;
            writeln!(world, "[[thing]]\nradius_mm = 40\npose = [{x:.0}, {y:.0}]")?;
            writeln!(world, "from_s = {from_s:.2}\nuntil_s = {:.2}", from_s + self.post_duration_s)?;
        }
        Ok(world)
    }
}

/// Warnings of a run.
struct WarningRun {
    warnings: usize,
    withdrawn: usize,
    /// Times in milliseconds from the first warning of a scan to the zones of the same scan, by the sixth of the scan
    /// in which the warning was sent.
    gains_ms: BTreeMap<usize, Vec<f64>>,
}

impl WarningRun {
    /// Evaluates the samples of `early` and `zones`, for scans with this number of `beams`.
    fn from_samples(early: &[(Header, Early)], zones: &[(Header, ())], beams: usize) -> WarningRun {
        let sent: BTreeMap<u64, u64> =
            zones.iter().rev().map(|(header, ())| (header.seq, sent_ns(header))).collect();
        let mut run = WarningRun { warnings: 0, withdrawn: 0, gains_ms: BTreeMap::new() };
        for (header, early) in early {
            if early.is_withdrawn() {
                run.withdrawn += 1;
                continue;
            }
            run.warnings += 1;
            // A warning during a revolution has the `seq` of a packet, so the next zones are those of the same scan.
            if let Some((_, zones_ns)) = sent.range(header.seq..).next() {
                let gain_ms = (*zones_ns as f64 - sent_ns(header) as f64) / 1e6;
                let place = usize::from(early.beam) * SCAN_PARTS / beams;
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

/// Receives a topic for `span` from its first sample on. Returns the header of each sample together with the result of
/// `take` for the sample.
fn receive<P: Payload, T>(
    environment: &BenchEnvironment,
    span: Duration,
    take: impl Fn(&P) -> T,
) -> Outcome<Vec<(Header, T)>> {
    let mut topic =
        subscriber::builder::<P>(environment.domain.name(), SENSOR).timeout(Duration::from_secs(8)).open()?;
    let mut received = Vec::new();
    let mut end = None;
    while let Some(sample) = topic.next()? {
        received.push((*sample.header(), take(&sample)));
        if Instant::now() >= *end.get_or_insert_with(|| Instant::now() + span) {
            break;
        }
    }
    Ok(received)
}

/// Returns the time at which the hub sent a sample, in nanoseconds of the clock of stamps.
fn sent_ns(header: &Header) -> u64 {
    header.stamp_last_ns + header.hub_time_ns().unwrap_or(0)
}

const POST_COUNT: usize = 200;
/// Number of parts into which a scan is divided.
const SCAN_PARTS: usize = 6;
/// Time after which the sensor streams and the hub has estimated the timing of the line.
const SETTLE_TIME: Duration = Duration::from_secs(4);
