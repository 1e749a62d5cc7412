//! Costs of sensors for the hub. Sensors on lines send at their real rate. In virtual time, telegrams arrive as fast as
//! the hub can process them. The cost of beams is measured, too.

use std::path::Path;
use std::thread;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use scanhub_config::{Config, Sources};
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::telegram::STX;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::{Background, Failure, Foreground, Kind, Marks, Nanos, Scan, Status, Zones};
use scanhub_shm::{Node, Payload, Subscriber};
use scanhub_sim::room::Room;

use crate::growth::{ParameterRange, Quantity};
use crate::support::environment::{BenchEnvironment, Child, STEP_TIMEOUT};
use crate::support::figures::{self, Figure, Target, percentile};
use crate::support::truth::SensorTruth;
use crate::support::usage::{ResidentMemory, ThreadUsage, segments};
use crate::support::{Options, Outcome, clock};
use crate::virtual_hub::{VirtualLink, virtual_hub};

/// Numbers of sensors on lines for which the bench measures the cost.
const LINE_SENSOR_COUNTS: [usize; 5] = [1, 2, 4, 8, 16];
/// Number of scans at the start that do not count, for a sensor on a line.
const SKIPPED_SCANS: usize = 80;

/// Measures 1 to 16 sensors. Each sensor has its own simulator at the other end of a pty, and a subscriber to its
/// scans. The rate shows whether the simulators and the hub, which share the processors, can keep the rate of the
/// sensors.
pub(crate) fn measure_lines(options: &Options) -> Outcome<()> {
    let quantity = |name, unit, linear| Quantity { name, unit, linear };
    let quantities = vec![
        quantity("CPU time per telegram", "us", Some(0.0)),
        quantity("last byte read to subscriber, p50", "us", Some(0.0)),
        quantity("last byte read to subscriber, p99", "us", Some(0.0)),
        quantity("own memory of the hub", "kB", Some(1.0)),
        quantity("shared memory touched by it", "kB", Some(1.0)),
        quantity("shared memory of the domain", "kB", Some(1.0)),
        quantity("rate of the slowest sensor", "Hz", None),
    ];
    let mut sweep = ParameterRange::new("sensors on ptys", "sensors", quantities);
    for sensors in LINE_SENSOR_COUNTS {
        for _ in 0..options.pairs().min(3) {
            match run_on_lines(sensors, options.seconds(10)) {
                Ok(values) => sweep.add(sensors, &values),
                Err(error) => eprintln!("{sensors} sensors on ptys: {error}"),
            }
        }
    }
    sweep.print(options.json);
    Ok(())
}

/// Measures this number of sensors on lines. Returns one value for each quantity of the table.
fn run_on_lines(sensors: usize, seconds: u64) -> Outcome<[f64; 7]> {
    let environment = BenchEnvironment::new()?;
    let names: Vec<String> = (0..sensors).map(|number| format!("s{number}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let _simulators: Vec<Child> = names
        .iter()
        .map(|name| environment.simulate_one(name, &["--baud", "500000"]))
        .collect::<Outcome<_>>()?;
    let hub = environment.start_hub(&names)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let count = SKIPPED_SCANS + (seconds as f64 * SCAN_RATE_HZ) as usize;
    let start =
        |name: &&str| environment.start_part(&["ages", environment.domain.name(), name, &count.to_string()]);
    let subscribers: Vec<Child> = names.iter().map(start).collect::<Outcome<_>>()?;
    let patience = STEP_TIMEOUT + Duration::from_secs(4 * seconds);
    // Wait until all sensors stream, and until the hub has estimated the timing of each line.
    for subscriber in &subscribers {
        subscriber.wait_for_line("attaching", STEP_TIMEOUT)?;
    }
    thread::sleep(Duration::from_millis((SKIPPED_SCANS as f64 / SCAN_RATE_HZ * 1e3) as u64));
    let look =
        || -> Outcome<(u64, ThreadUsage)> { Ok((clock::now(), ThreadUsage::of(hub.guard.pid(), |_| true)?)) };
    let before = look()?;
    thread::sleep(Duration::from_secs(seconds));
    let after = look()?;
    let memory = ResidentMemory::of(hub.guard.pid())?;
    let shared: f64 = segments(&environment.domain)?.values().map(|(_, bytes)| bytes).sum();
    let mut ages = Vec::new();
    for subscriber in &subscribers {
        let lines = subscriber.lines_until("end", patience)?;
        for line in lines.iter().filter(|line| line.text.starts_with("aged")).skip(SKIPPED_SCANS) {
            ages.push(line.number(2)? as f64 / 1e3);
        }
    }
    ages.sort_by(f64::total_cmp);
    let mut counts = Vec::new();
    for name in &names {
        counts.push(SensorTruth::read(&environment.own_truth(name), name)?.count(before.0, after.0));
    }
    let slowest = *counts.iter().min().ok_or("no sensor")? as f64 / ((after.0 - before.0) as f64 / 1e9);
    let telegrams = counts.iter().sum::<usize>() as f64;
    let at = |part| percentile(&ages, part).ok_or("no scan arrived");
    Ok([
        after.1.since(before.1).busy_ns as f64 / 1e3 / telegrams,
        at(0.5)?,
        at(0.99)?,
        memory.heap_and_stacks / 1024.0,
        memory.shared / 1024.0,
        shared / 1024.0,
        slowest,
    ])
}

/// Measures 1 to 1,000 sensors in virtual time. The result shows how many sensors one core could serve if it cost
/// nothing to receive bytes. Many sensors are distributed over several hubs, because a hub has at most 256 links, and a
/// process does not have enough descriptors for more sensors.
pub(crate) fn measure_virtual_time(options: &Options) -> Outcome<()> {
    let quantity = |name, unit, linear| Quantity { name, unit, linear };
    let quantities = vec![
        quantity("CPU time per telegram, all topics subscribed", "us", Some(0.0)),
        quantity("no subscriber", "us", Some(0.0)),
        quantity("sensors per core, all topics subscribed", "1", None),
        quantity("no subscriber", "1", None),
        quantity("telegrams not received", "1", None),
        quantity("descriptors per sensor and its subscribers", "1", None),
    ];
    let mut sweep = ParameterRange::new("sensors in virtual time", "sensors", quantities);
    let mut of_most = Vec::new();
    let telegrams = options.count(20_000);
    // Leave out numbers of sensors for which each sensor would have fewer than four telegrams.
    for sensors in VIRTUAL_SENSOR_COUNTS.into_iter().filter(|sensors| sensors * 4 <= telegrams) {
        // Measure many sensors only once. It takes longer to set them up than to measure them, and one run already has
        // many values.
        for _ in 0..if sensors > SENSORS_PER_HUB { 1 } else { runs(options) } {
            let both = run_in_virtual_time(sensors, Variant::HALF, telegrams, true).and_then(|followed| {
                Ok((followed, run_in_virtual_time(sensors, Variant::HALF, telegrams, false)?))
            });
            let (followed, alone) = match both {
                Ok(both) => both,
                // This machine does not have enough memory for this number of sensors.
                Err(error) => {
                    eprintln!("{sensors} sensors in virtual time: {error}");
                    continue;
                }
            };
            let per_core = |us: f64| 1e6 / (us * SCAN_RATE_HZ);
            let descriptors = followed.descriptors / sensors as f64;
            let lost = followed.lost;
            sweep.add(
                sensors,
                &[followed.us, alone.us, per_core(followed.us), per_core(alone.us), lost, descriptors],
            );
            of_most.extend((sensors == MAX_SENSORS).then_some(followed.us));
        }
    }
    sweep.print(options.json);
    if !of_most.is_empty() {
        let figure = Figure {
            name: "per telegram of 1000 sensors",
            unit: "us",
            hub: of_most,
            baseline: Vec::new(),
            // Maximum CPU time per telegram with which one core can serve this number of sensors at their full rate.
            target: Target::Max((1e7 / (MAX_SENSORS as f64 * SCAN_RATE_HZ)).floor() / 10.0),
        };
        figures::print("subscribers", options.json, &[figure]);
    }
    Ok(())
}

/// Measures all variants of the LMS (numbers of beams), with 16 sensors.
pub(crate) fn measure_variants(options: &Options) -> Outcome<()> {
    let quantities = vec![Quantity { name: "CPU time per telegram", unit: "us", linear: Some(1.0) }];
    let mut sweep = ParameterRange::new("beams in virtual time, 16 sensors", "beams", quantities);
    let mut variants = Variant::ALL;
    variants.sort_by_key(|variant| variant.beams());
    for variant in variants {
        for _ in 0..runs(options) {
            sweep.add(variant.beams(), &[run_in_virtual_time(16, variant, options.count(20_000), true)?.us]);
        }
    }
    sweep.print(options.json);
    Ok(())
}

struct TelegramCost {
    /// CPU time per telegram, in us.
    us: f64,
    lost: f64,
    descriptors: f64,
}

/// Runs `sensors` sensors, distributed over several hubs. All hubs start to measure at the same time.
fn run_in_virtual_time(
    sensors: usize,
    variant: Variant,
    telegrams: usize,
    has_subscribers: bool,
) -> Outcome<TelegramCost> {
    let environment = BenchEnvironment::new()?;
    let begin = environment.file("begin");
    let name = begin.display().to_string();
    let hubs = sensors.div_ceil(SENSORS_PER_HUB);
    let beams = variant.beams().to_string();
    let mut parts = Vec::new();
    for number in 0..hubs {
        let share = (sensors * (number + 1) / hubs - sensors * number / hubs).to_string();
        let telegrams = telegrams.div_ceil(hubs).to_string();
        parts.push(environment.start_part(&[
            "driven",
            &name,
            &beams,
            &share,
            &telegrams,
            &has_subscribers.to_string(),
        ])?);
    }
    // To learn the background, a hub needs far less than a millisecond per telegram.
    let patience = STEP_TIMEOUT + Duration::from_millis(sensors as u64 * 760);
    parts.iter().try_for_each(|part: &Child| part.wait_for_line("ready", patience).map(drop))?;
    std::fs::write(&begin, "")?;
    let (mut ns, mut published, mut received, mut descriptors) = (0.0, 0.0, 0.0, 0.0);
    for part in &parts {
        let cost = part.wait_for_line("cost", patience)?;
        ns += cost.number(1)? as f64;
        published += cost.number(2)? as f64;
        received += cost.number(3)? as f64;
        descriptors += cost.number(4)? as f64;
    }
    parts.into_iter().try_for_each(|part| part.guard.wait())?;
    Ok(TelegramCost { us: ns / published / 1e3, lost: published - received, descriptors })
}

fn runs(options: &Options) -> usize {
    options.pairs().min(3)
}

const VIRTUAL_SENSOR_COUNTS: [usize; 6] = [1, 4, 16, 64, 250, MAX_SENSORS];
const MAX_SENSORS: usize = 1000;
/// Maximum number of sensors in one hub. It is limited by the descriptors of a process, because the hub and its
/// subscribers run in one process.
const SENSORS_PER_HUB: usize = 125;
/// Scans per second of a sensor with 361 beams.
const SCAN_RATE_HZ: f64 = 37.5;

/// Drives a hub in virtual time: telegrams of the simulated room of Fig. 8 pass framer, session, decoding and all
/// processors into topics in shared memory. No thread sleeps or waits, so only the CPU time per telegram is measured.
/// If `has_subscribers` is true, each topic has a subscriber that takes all samples. Otherwise, topics have no
/// subscribers.
///
/// Runs `sensors` sensors with `beams` beams until the background of each sensor is learned, and then prints `ready`.
/// When the file `begin` exists, processes at least `telegrams` more telegrams. Prints `cost NS PUBLISHED RECEIVED
/// DESCRIPTORS`.
pub(crate) fn drive(
    begin: &Path,
    beams: usize,
    sensors: usize,
    telegrams: usize,
    has_subscribers: bool,
) -> Outcome<()> {
    let variant = Variant::of_beams(beams).ok_or("no variant has this number of beams")?;
    let environment = BenchEnvironment::new()?;
    let config = config(sensors, variant)?;
    virtual_hub(&config, &environment.domain, |links| {
        let node = scanhub_shm::client_node(&environment.domain)?;
        let followed = config.links.iter().filter(|_| has_subscribers);
        let subscribers: Vec<Subscribers> =
            followed.map(|link| Subscribers::attach(&node, &link.name)).collect::<Result<_, _>>()?;
        let descriptors = std::fs::read_dir("/proc/self/fd")?.count();
        let mut stream = SensorStreams::new(variant);
        let learning = (LEARNING_TIME_NS / stream.period) as usize / TELEGRAMS_PER_TAKE;
        let mut pass_telegrams = |links: &mut [VirtualLink<'_>]| -> Outcome<TotalCost> {
            let before = cpu_ns();
            let published = stream.pass_next(links);
            let cpu_time_ns = cpu_ns() - before;
            let received = subscribers.iter().map(Subscribers::take).sum::<Result<usize, _>>()?;
            Ok(TotalCost { cpu_time_ns, published, received })
        };
        for _ in 0..learning {
            pass_telegrams(links)?;
        }
        println!("ready");
        let deadline = clock::now() + STEP_TIMEOUT.as_nanos() as u64;
        while !begin.exists() {
            if clock::now() > deadline {
                return Err("the start file did not appear".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let mut all = TotalCost::default();
        for _ in 0..telegrams.div_ceil(TELEGRAMS_PER_TAKE * sensors) {
            let TotalCost { cpu_time_ns, published, received } = pass_telegrams(links)?;
            all.cpu_time_ns += cpu_time_ns;
            all.published += published;
            all.received += received;
        }
        println!("cost {} {} {} {descriptors}", all.cpu_time_ns, all.published, all.received);
        Ok(())
    })?
}

/// Total cost of a few telegrams of each sensor.
#[derive(Default)]
struct TotalCost {
    cpu_time_ns: u64,
    published: usize,
    received: usize,
}

/// Telegrams of the sensors. All sensors are in the same simulated room, but each sensor is at a different time of the
/// simulation.
struct SensorStreams {
    telegrams: Vec<Vec<u8>>,
    period: Nanos,
    now: Nanos,
    number: usize,
}

impl SensorStreams {
    fn new(variant: Variant) -> SensorStreams {
        let room = Room::new(&"fig8".parse().expect("a built-in world"), 1);
        let period = variant.revolutions() * MIRROR_PERIOD;
        let telegram = |number| {
            let words = room.scan(variant, Unit::Mm, MODE, number * period);
            measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
        };
        // Leave out telegrams that end with a start byte, because the framer would hold each of them until the next
        // telegram arrives.
        let telegrams =
            (1..=TELEGRAM_COUNT).map(telegram).filter(|bytes| bytes.last() != Some(&STX)).collect();
        SensorStreams { telegrams, period, now: clock::now(), number: 0 }
    }

    /// Passes the next telegrams of each sensor to the hub in three reads, as the hub reads them: the first bytes, most
    /// of the telegram, and the end. Returns the number of published scans.
    fn pass_next(&mut self, links: &mut [VirtualLink<'_>]) -> usize {
        let mut published = 0;
        for _ in 0..TELEGRAMS_PER_TAKE {
            for piece in 0..3 {
                for (sensor, link) in links.iter_mut().enumerate() {
                    let telegram = &self.telegrams[(self.number + 37 * sensor) % self.telegrams.len()];
                    let cuts = [0, 16, telegram.len() - 156, telegram.len()];
                    published += link.read(self.now, &telegram[cuts[piece]..cuts[piece + 1]]);
                }
                self.now += self.period / 3;
            }
            self.number += 1;
        }
        published
    }
}

/// A subscriber to each topic of a sensor, which never sleeps.
struct Subscribers {
    telegram: Subscriber<[u8]>,
    scan: Subscriber<Scan>,
    marks: Subscriber<Marks>,
    zones: Subscriber<Zones>,
    foreground: Subscriber<Foreground>,
    background: Subscriber<Background>,
    status: Subscriber<Status>,
}

impl Subscribers {
    fn attach(node: &Node, sensor: &str) -> Result<Subscribers, Failure> {
        Ok(Subscribers {
            telegram: subscriber::<[u8]>(node, sensor)?,
            scan: subscriber::<Scan>(node, sensor)?,
            marks: subscriber::<Marks>(node, sensor)?,
            zones: subscriber::<Zones>(node, sensor)?,
            foreground: subscriber::<Foreground>(node, sensor)?,
            background: subscriber::<Background>(node, sensor)?,
            status: subscriber::<Status>(node, sensor)?,
        })
    }

    /// Takes all samples, and returns the number of scans for which the samples of all other topics have arrived.
    fn take(&self) -> Outcome<usize> {
        let counts = [
            take::<Scan>(&self.scan)?,
            take::<[u8]>(&self.telegram)?,
            take::<Marks>(&self.marks)?,
            take::<Zones>(&self.zones)?,
            take::<Foreground>(&self.foreground)?,
        ];
        take::<Background>(&self.background)?;
        take::<Status>(&self.status)?;
        Ok(counts.into_iter().min().unwrap_or_default())
    }
}

fn subscriber<P: Payload + ?Sized>(node: &Node, sensor: &str) -> Result<Subscriber<P>, Failure> {
    let service = P::open(node, sensor)?;
    let service =
        service.ok_or_else(|| Failure::new(Kind::NoTopic, format!("{sensor} has no topics"), ""))?;
    P::subscriber(node, &service)
}

fn take<P: Payload + ?Sized>(subscriber: &Subscriber<P>) -> Outcome<usize> {
    let mut count = 0;
    while P::receive(subscriber).map_err(|error| format!("not received: {error:?}"))?.is_some() {
        count += 1;
    }
    Ok(count)
}

/// Returns the default configuration with all processors.
fn config(sensors: usize, variant: Variant) -> Result<Config, Failure> {
    let names = (0..sensors).map(|number| format!("s{number}"));
    let set = names.clone().flat_map(|name| {
        let keys = [
            format!("mode={}", MODE.0),
            format!("angle={}", variant.angle_deg),
            format!("resolution={}", f64::from(variant.resolution_cdeg) / 100.0),
        ];
        keys.map(|key| format!("link.{name}.{key}"))
    });
    let links = names.clone().map(|name| format!("{name}=file:nothing")).collect();
    Config::load(&Sources { links, set: set.collect(), ..Sources::default() })
}

/// Returns the CPU time of this thread.
fn cpu_ns() -> u64 {
    let used = clock_gettime(ClockId::ThreadCPUTime);
    used.tv_sec as u64 * 1_000_000_000 + used.tv_nsec as u64
}

/// Time until the background is learned, which is ten seconds, plus a margin.
const LEARNING_TIME_NS: Nanos = 10_500_000_000;
/// Measuring mode with 13 bits of range and 3 bits of intensity.
const MODE: Mode = Mode(1);
/// Number of different telegrams that a sensor sends. They repeat after that.
const TELEGRAM_COUNT: u64 = 512;
/// Number of telegrams of each sensor after which the subscribers take the samples. It is below the length of the
/// shortest queue, which holds four samples, because the hub may publish a sample later than its telegram.
const TELEGRAMS_PER_TAKE: usize = 3;
