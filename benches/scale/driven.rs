//! A hub in made-up time: simulated telegrams of the room of Fig. 8 go through framer, session, decoding and all processors
//! into topics in shared memory, of which each has a consumer that takes all, or none. Nobody sleeps and nothing is waited for, so what
//! is left is what a telegram costs a processor. Refuses to know how many hubs there are.

use std::path::Path;
use std::time::Duration;

use config::{Config, Sources};
use lms::Nanos;
use lms::measured;
use lms::telegram::STX;
use lms::variant::{MIRROR_TURN, Mode, Unit, Variant};
use rustix::time::{ClockId, clock_gettime};
use schema::ipc::{self, Node, Payload, Subscriber};
use schema::{Background, Failure, Foreground, Kind, Marks, Scan, Status, Zones};
use sim::room::Room;

use crate::support::stage::{PATIENCE, Stage};
use crate::support::{Outcome, clock};
use crate::virtual_hub::{VirtualLink, virtual_hub};

/// Drives `sensors` whose scans have `beams` beams, until all have learned their background; says `ready`, and once there is a
/// file `begin` has at least `telegrams` more. Prints `cost NS PUBLISHED RECEIVED DESCRIPTORS`. All topics are followed if
/// `followed`, else none is.
pub(crate) fn drive(
    begin: &Path,
    beams: usize,
    sensors: usize,
    telegrams: usize,
    followed: bool,
) -> Outcome<()> {
    let variant = Variant::of_beams(beams).ok_or("no variant has so many beams")?;
    let stage = Stage::new()?;
    let config = config(sensors, variant)?;
    virtual_hub(&config, &stage.domain, |links| {
        let node = ipc::client_node(&stage.domain)?;
        let followed = config.links.iter().filter(|_| followed);
        let followers: Vec<Followers> =
            followed.map(|link| Followers::attach(&node, &link.name)).collect::<Result<_, _>>()?;
        let descriptors = std::fs::read_dir("/proc/self/fd")?.count();
        let mut stream = Stream::new(variant);
        let learning = (LEARNED_NS / stream.period) as usize / TOGETHER;
        let mut turn = |links: &mut [VirtualLink<'_>]| -> Outcome<Turn> {
            let before = processor_ns();
            let published = stream.turn(links);
            let busy_ns = processor_ns() - before;
            let received = followers.iter().map(Followers::take).sum::<Result<usize, _>>()?;
            Ok(Turn { busy_ns, published, received })
        };
        for _ in 0..learning {
            turn(links)?;
        }
        println!("ready");
        let give_up_at = clock::now() + PATIENCE.as_nanos() as u64;
        while !begin.exists() {
            if clock::now() > give_up_at {
                return Err("nobody says to begin".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let mut all = Turn::default();
        for _ in 0..telegrams.div_ceil(TOGETHER * sensors) {
            let Turn { busy_ns, published, received } = turn(links)?;
            all.busy_ns += busy_ns;
            all.published += published;
            all.received += received;
        }
        println!("cost {} {} {} {descriptors}", all.busy_ns, all.published, all.received);
        Ok(())
    })?
}

/// What some telegrams of each sensor took.
#[derive(Default)]
struct Turn {
    busy_ns: u64,
    published: usize,
    received: usize,
}

/// What the sensors send. All see the same, each at another moment.
struct Stream {
    telegrams: Vec<Vec<u8>>,
    period: Nanos,
    now: Nanos,
    number: usize,
}

impl Stream {
    fn new(variant: Variant) -> Stream {
        let room = Room::new(&"fig8".parse().expect("a world that the program brings along"), 1);
        let period = variant.turns() * MIRROR_TURN;
        let telegram = |number| {
            let words = room.scan(variant, Unit::Mm, MODE, number * period);
            measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
        };
        // One that ends with a start byte would wait for the next one.
        let telegrams = (1..=SEEN).map(telegram).filter(|bytes| bytes.last() != Some(&STX)).collect();
        Stream { telegrams, period, now: clock::now(), number: 0 }
    }

    /// The next telegrams of each sensor, as the hub reads them: the first bytes, most of it, the end. How many were published.
    fn turn(&mut self, links: &mut [VirtualLink<'_>]) -> usize {
        let mut published = 0;
        for _ in 0..TOGETHER {
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

/// A consumer of each topic of a sensor, awake.
struct Followers {
    telegram: Subscriber<[u8]>,
    scan: Subscriber<Scan>,
    marks: Subscriber<Marks>,
    zones: Subscriber<Zones>,
    foreground: Subscriber<Foreground>,
    background: Subscriber<Background>,
    status: Subscriber<Status>,
}

impl Followers {
    fn attach(node: &Node, sensor: &str) -> Result<Followers, Failure> {
        Ok(Followers {
            telegram: subscriber::<[u8]>(node, sensor)?,
            scan: subscriber::<Scan>(node, sensor)?,
            marks: subscriber::<Marks>(node, sensor)?,
            zones: subscriber::<Zones>(node, sensor)?,
            foreground: subscriber::<Foreground>(node, sensor)?,
            background: subscriber::<Background>(node, sensor)?,
            status: subscriber::<Status>(node, sensor)?,
        })
    }

    /// Takes all that waits; how many scans with all that belongs to them.
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
    P::subscriber(&service)
}

fn take<P: Payload + ?Sized>(subscriber: &Subscriber<P>) -> Outcome<usize> {
    let mut count = 0;
    while P::receive(subscriber).map_err(|error| format!("not received: {error:?}"))?.is_some() {
        count += 1;
    }
    Ok(count)
}

/// As the program configures itself, with every processor on.
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

/// What this thread has used.
fn processor_ns() -> u64 {
    let used = clock_gettime(ClockId::ThreadCPUTime);
    used.tv_sec as u64 * 1_000_000_000 + used.tv_nsec as u64
}

/// Until a background is known: ten seconds, and some more.
const LEARNED_NS: Nanos = 10_500_000_000;
/// 13 bits of range, 3 of intensity.
const MODE: Mode = Mode(1);
/// Different telegrams.
const SEEN: u64 = 512;
/// Telegrams of each sensor between two looks of the consumers. The shortest queue holds four: one that looked for a while as
/// if another one began inside comes with the next.
const TOGETHER: usize = 3;
