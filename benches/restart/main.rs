//! What does a crash of the hub cost its consumers? The hub is killed with SIGKILL and started again, twenty times in
//! all, with nobody who keeps its lines, while a process per sensor follows its telegrams: how long until the services are up and until each consumer
//! has a telegram in its hands, beside a bare reader that opens the same streaming ptys and wakes a process. Counts
//! what was torn (CRC), what was missed within a life, and writes to the sensors' EEPROM. Then the same under a service
//! manager that keeps the line of one sensor: how long the silence is, and what is lost (kept.rs). It does not tell how long a
//! service manager takes to notice.

mod kept;
#[path = "../../tests/testkit/supervisor.rs"]
mod supervisor;
#[path = "../support/mod.rs"]
mod support;

use std::process::ExitCode;
use std::thread;
use std::time::Duration;

use support::Outcome;
use support::child::Child;
use support::figures::{self, Figure, Target};
use support::options::Options;
use support::stage::{PATIENCE, SENSORS, Stage};
use support::truth::Truth;

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let simulator = stage.simulate(&SENSORS, 500_000)?;
    let follow = |sensor: &&str| stage.consumer("telegram", sensor, &["0"]);
    let consumers: Vec<Child> = SENSORS.iter().map(follow).collect::<Outcome<_>>()?;
    let mut lives =
        Lives { stage: &stage, consumers: &consumers, hub: None, torn: 0, missed: 0, received: 0 };
    lives.restart()?;
    let (mut hub, mut floor) = (Vec::new(), Vec::new());
    // Kills in a row, then as many starts of the floor, on the same streams.
    let each = options.count(20).div_ceil(options.pairs());
    for _ in 0..options.pairs() {
        for _ in 0..each {
            thread::sleep(life(hub.len()));
            hub.push(lives.restart()?);
        }
        lives.kill()?;
        for _ in 0..each {
            thread::sleep(life(floor.len()));
            floor.push(start_floor(&stage)?);
        }
        lives.restart()?;
    }
    lives.kill()?;
    let (torn, missed, received) = (lives.torn as f64, lives.missed as f64, lives.received as f64);
    drop(consumers);
    drop(simulator);
    let writes: Outcome<Vec<_>> = SENSORS
        .iter()
        .map(|sensor| Ok(Truth::read(&stage.truth(), sensor)?.eeprom_writes.ok_or("no summary")?))
        .collect();
    let writes = writes?.iter().sum::<u64>() as f64;
    let figure = |name, of: fn(&Start) -> f64, target| {
        let floor = floor.iter().map(of).collect();
        Figure { name, unit: "ms", hub: hub.iter().map(of).collect(), floor, target }
    };
    let count = |name, value, target| Figure { name, unit: "1", hub: vec![value], floor: Vec::new(), target };
    let mut figures = vec![
        figure("exec to services up", |start| start.up_ms, Target::Most(50.0)),
        figure("exec to first telegram, sooner", |start| start.first_ms[0], Target::Most(500.0)),
        figure("exec to first telegram, later", |start| start.first_ms[1], Target::Most(500.0)),
        count("telegrams received", received, Target::None),
        count("of them torn", torn, Target::Most(0.0)),
        count("missed within a life", missed, Target::Most(0.0)),
        count("EEPROM writes", writes, Target::Most(0.0)),
    ];
    drop(stage);
    figures.extend(kept::figures(options.count(20))?);
    figures::print("restart", options.json, &figures);
    Ok(())
}

/// One start: milliseconds from exec.
struct Start {
    up_ms: f64,
    /// Of the consumer that was served first, and of the other one.
    first_ms: [f64; 2],
}

impl Start {
    fn new(started_ns: u64, up_ns: u64, mut first_ns: [u64; 2]) -> Start {
        first_ns.sort_unstable();
        let since = |at: u64| (at - started_ns) as f64 / 1e6;
        Start { up_ms: since(up_ns), first_ms: first_ns.map(since) }
    }
}

/// The lives of the hub, and the consumers that outlive them.
struct Lives<'a> {
    stage: &'a Stage,
    consumers: &'a [Child],
    hub: Option<Child>,
    torn: u64,
    missed: u64,
    received: u64,
}

impl Lives<'_> {
    fn kill(&mut self) -> Outcome<()> {
        if let Some(hub) = self.hub.take() {
            hub.guard.kill()?;
        }
        for consumer in self.consumers {
            for line in consumer.lines_so_far() {
                self.account(&line.words());
            }
        }
        Ok(())
    }

    /// Kills the hub, if there is one, and starts the next; over when each consumer has a telegram of it.
    fn restart(&mut self) -> Outcome<Start> {
        self.kill()?;
        let hub = self.stage.hub(&SENSORS)?;
        let up_ns = hub.await_line("ready", PATIENCE)?.at_ns;
        let mut first_ns = [0; 2];
        for (first_ns, consumer) in first_ns.iter_mut().zip(self.consumers) {
            // What the last hub sent just before its end may still be on its way out of the pipe.
            while *first_ns < hub.started_ns {
                let line = consumer.await_line("telegram", PATIENCE)?;
                self.account(&line.words());
                *first_ns = line.number(2)?;
            }
        }
        let start = Start::new(hub.started_ns, up_ns, first_ns);
        self.hub = Some(hub);
        Ok(start)
    }

    fn account(&mut self, words: &[&str]) {
        if let ["telegram", _, _, _, missed, intact, ..] = words {
            self.received += 1;
            self.missed += missed.parse().unwrap_or(1);
            self.torn += u64::from(*intact != "true");
        }
    }
}

fn start_floor(stage: &Stage) -> Outcome<Start> {
    let floor = stage.bare(&SENSORS, 0)?;
    let up_ns = floor.await_line("ready", PATIENCE)?.at_ns;
    let mut first_ns = [0; 2];
    while first_ns.contains(&0) {
        let line = floor.await_line("woken", PATIENCE)?;
        let first_ns = &mut first_ns[line.number(1)? as usize];
        if *first_ns == 0 {
            *first_ns = line.number(2)?;
        }
    }
    let start = Start::new(floor.started_ns, up_ns, first_ns);
    floor.guard.kill()?;
    Ok(start)
}

/// How long life number `n` is: another phase of the stream each time.
fn life(n: usize) -> Duration {
    Duration::from_millis(700 + 11 * (n as u64 % 20))
}
