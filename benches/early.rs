//! How much earlier does a warning come by the part of a telegram that is there, and what does it cost? Posts stand in the
//! smaller circle, one after the other at places all over the scan; a warning and the zones of the same scan are compared by
//! when the hub sent them. On a line that loses bytes in bursts, warnings are withdrawn, and counted. The hub's processor time
//! with a follower of `early` beside one of `zones` alone. It does not tell what a robot gains: its brakes are slower.

mod support;

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::process::ExitCode;
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::{Early, Header, Zones};
use schema::ipc::Payload;
use support::figures::{self, Cell, Figure, Target};
use support::options::Options;
use support::stage::{PATIENCE, Stage};
use support::work::Work;
use support::{Outcome, consumer};

const SENSOR: &str = "front";

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let span = Duration::from_secs(options.seconds(20));
    let world = stage.file("posts.toml");
    std::fs::write(&world, posts()?)?;
    let world = world.display().to_string();
    let mut gains: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    let (mut clean, mut burst) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
    let (mut with, mut without) = (Vec::new(), Vec::new());
    for pair in 0..options.pairs() {
        let flags = ["--baud", "500000", "--world", &world];
        let run = run(&stage, &flags, span)?;
        for (place, gain_ms) in run.medians() {
            gains.entry(place).or_default().push(gain_ms);
        }
        let count = |into: &mut [Vec<f64>; 2], run: &Run| {
            into[0].push(run.said as f64);
            into[1].push(run.withdrawn as f64);
        };
        count(&mut clean, &run);
        let lossy = [&flags[..], &["--fault", "loss=0.00135,burst=1.89"]].concat();
        count(&mut burst, &self::run(&stage, &lossy, span)?);
        let order = if pair % 2 == 0 { [true, false] } else { [false, true] };
        for is_early in order {
            let into = if is_early { &mut with } else { &mut without };
            into.push(busy_share(&stage, &flags, span, is_early)?);
        }
    }
    let cell = |row: String, values| Cell {
        table: "early: gain over zones by place".into(),
        row,
        column: "median".into(),
        unit: "ms",
        values,
    };
    let places = gains.into_iter().map(|(place, values)| {
        cell(format!("{} to {} % of the scan", 100 * place / PLACES, 100 * (place + 1) / PLACES), values)
    });
    figures::print_cells("early", options.json, &places.collect::<Vec<_>>());
    let figure = |name, unit, hub, floor, target| Figure { name, unit, hub, floor, target };
    let ([said, withdrawn], [burst_said, burst_withdrawn]) = (clean, burst);
    let figures = [
        figure("warnings, clean line", "1", said, Vec::new(), Target::None),
        figure("withdrawn, clean line", "1", withdrawn, Vec::new(), Target::Most(0.0)),
        figure("warnings, burst line", "1", burst_said, Vec::new(), Target::None),
        figure("withdrawn, burst line", "1", burst_withdrawn, Vec::new(), Target::None),
        figure("hub's processor time, beside zones", "%", with, without, Target::Ratio(1.5)),
    ];
    figures::print("early", options.json, &figures);
    Ok(())
}

/// What was said in a run.
struct Run {
    said: usize,
    withdrawn: usize,
    /// By how many ms the first warning of a scan came before its zones, by sixths of the scan.
    gains_ms: BTreeMap<usize, Vec<f64>>,
}

impl Run {
    fn medians(&self) -> impl Iterator<Item = (usize, f64)> {
        self.gains_ms.iter().filter_map(|(&place, gains)| {
            let mut sorted = gains.clone();
            sorted.sort_by(f64::total_cmp);
            Some((place, figures::percentile(&sorted, 0.5)?))
        })
    }
}

fn run(stage: &Stage, flags: &[&str], span: Duration) -> Outcome<Run> {
    let _simulator = stage.simulate_as(&[SENSOR], flags)?;
    let hub = stage.hub(&[SENSOR])?;
    hub.await_line("ready", PATIENCE)?;
    let (early, zones) = thread::scope(|scope| {
        let early = scope.spawn(|| heard::<Early, _>(stage, span, |early| *early).map_err(|e| e.to_string()));
        let zones = scope.spawn(|| heard::<Zones, _>(stage, span, |_| ()).map_err(|e| e.to_string()));
        (early.join(), zones.join())
    });
    let over = "a thread ended";
    let (early, zones) = (early.map_err(|_| over)??, zones.map_err(|_| over)??);
    hub.guard.kill()?;
    let sent: BTreeMap<u64, u64> =
        zones.iter().rev().map(|(header, ())| (header.seq, sent_ns(header))).collect();
    let mut run = Run { said: 0, withdrawn: 0, gains_ms: BTreeMap::new() };
    for (header, early) in &early {
        if early.is_withdrawn() {
            run.withdrawn += 1;
            continue;
        }
        run.said += 1;
        if let Some(zones_ns) = sent.get(&header.seq) {
            let gain_ms = (*zones_ns as f64 - sent_ns(header) as f64) / 1e6;
            let place = usize::from(early.beam) * PLACES / BEAMS;
            run.gains_ms.entry(place).or_default().push(gain_ms);
        }
    }
    Ok(run)
}

/// Headers of a topic for `span` from its first sample on, and what `take` takes of each.
fn heard<P: Payload, T>(stage: &Stage, span: Duration, take: impl Fn(&P) -> T) -> Outcome<Vec<(Header, T)>> {
    let mut topic = consumer::subscribe::<P>(stage.domain.name(), SENSOR)?.timeout(Duration::from_secs(8));
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

/// The hub's share of a processor in percent, with a follower of `zones`, and of `early` too if `is_early`.
fn busy_share(stage: &Stage, flags: &[&str], span: Duration, is_early: bool) -> Outcome<f64> {
    let _simulator = stage.simulate_as(&[SENSOR], flags)?;
    let hub = stage.hub(&[SENSOR])?;
    hub.await_line("ready", PATIENCE)?;
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

/// A room, and in it one post at a time, 0.55 m from the sensor, for five scans each.
fn posts() -> Outcome<String> {
    let mut world = String::from("[noise]\nerrors = 0\nweak = false\n");
    world +=
        "[[thing]]\nline = [[-4000, -3000], [4000, -3000], [4000, 4000], [-4000, 4000], [-4000, -3000]]\n";
    for n in 0..POSTS {
        let angle = PI * (0.05 + 0.9 * ((n * 37) % POSTS) as f64 / POSTS as f64);
        let (x, y) = (550.0 * angle.cos(), 550.0 * angle.sin());
        let from_s = 1.0 + 0.3 * n as f64;
        writeln!(world, "[[thing]]\nradius_mm = 40\npose = [{x:.0}, {y:.0}]")?;
        writeln!(world, "from_s = {from_s:.2}\nuntil_s = {:.2}", from_s + 0.14)?;
    }
    Ok(world)
}

const POSTS: usize = 200;
/// The scan's beams, of 180 degrees in halves, and the parts by which places are told.
const BEAMS: usize = 361;
const PLACES: usize = 6;
/// Until the sensor streams and the rhythm is learned.
const SETTLING: Duration = Duration::from_secs(4);
