//! The gateway's processor time for two sensors with all their topics, beside a thread that sends the same datagrams at
//! the same times; and how many it can send when there is always one more.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use schema::Topic;
use schema::datagram::{Datagram, HEAD, Packed};

use crate::source::{self, SENSOR, Source};
use crate::support::figures::{Figure, Target};
use crate::support::stage::{PATIENCE, SENSORS, Stage};
use crate::support::work::Work;
use crate::support::{Outcome, clock};
use crate::wire::{self, is_of, number};

const SPAN: Duration = Duration::from_secs(8);
/// The gateway looks for sensors so long after a hub came.
const SETTLING: Duration = Duration::from_secs(6);
const FLAT_OUT: Duration = Duration::from_secs(3);
/// Name of the thread that is the floor.
const BARE: &str = "bare";
/// What comes within so much is sent in one go.
const BURST_NS: u64 = 1_000_000;

/// A datagram, and when it came.
type Heard = (u64, Vec<u8>);

/// Processor time per datagram, and the most datagrams per second.
pub(crate) fn figures(pairs: usize) -> Outcome<Vec<Figure>> {
    let (mut hub, mut floor, mut share, mut rate) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    {
        let stage = Stage::new()?;
        let _simulator = stage.simulate(&SENSORS, 500_000)?;
        let running = stage.hub(&SENSORS)?;
        running.await_line("ready", PATIENCE)?;
        for _ in 0..pairs {
            let (busy_ns, heard) = of_gateway(&stage)?;
            hub.push(busy_ns / 1e3 / heard.len() as f64);
            share.push(busy_ns / SPAN.as_nanos() as f64 * 100.0);
            rate.push(heard.len() as f64 / SPAN.as_secs_f64());
            floor.push(of_bare(&heard)? / 1e3 / heard.len() as f64);
        }
    }
    let (mut most, mut bare) = (Vec::new(), Vec::new());
    for _ in 0..pairs {
        most.push(most_of_gateway()?);
        bare.push(most_of_bare()?);
    }
    let figure = |name, unit, hub, floor, target| Figure { name, unit, hub, floor, target };
    Ok(vec![
        figure("gateway: processor time, datagram", "us", hub, floor, Target::Ratio(2.0)),
        figure("gateway: of one core", "%", share, Vec::new(), Target::None),
        figure("gateway: datagrams a second", "1", rate, Vec::new(), Target::None),
        figure("gateway: at most a second", "1", most, bare, Target::None),
    ])
}

/// What the gateway uses, in ns, and what it sends.
fn of_gateway(stage: &Stage) -> Outcome<(f64, Vec<Heard>)> {
    let gateway = wire::gateway(stage, "lo", &wire::all_topics())?;
    thread::sleep(SETTLING);
    let (stop, ear) = (Arc::new(AtomicBool::new(false)), wire::ear()?);
    let flag = stop.clone();
    let before = Work::of(gateway.pid(), |_| true)?;
    let listening = thread::spawn(move || hear(&ear, &flag));
    thread::sleep(SPAN);
    let busy_ns = Work::of(gateway.pid(), |_| true)?.since(before).busy_ns;
    stop.store(true, Ordering::Relaxed);
    let heard = listening.join().map_err(|_| "a listener panicked")?;
    drop(gateway.end()?);
    Ok((busy_ns as f64, heard))
}

/// What a thread uses that sends the same, while somebody listens, too.
fn of_bare(heard: &[Heard]) -> Outcome<f64> {
    let (stop, ear, mouth) = (Arc::new(AtomicBool::new(false)), wire::ear()?, wire::mouth()?);
    let flag = stop.clone();
    let listening = thread::spawn(move || hear(&ear, &flag));
    let datagrams = heard.to_vec();
    let (before, at_end) = thread::Builder::new()
        .name(BARE.into())
        .spawn(move || -> Result<_, String> {
            let own = || Work::of(std::process::id(), |name| name == BARE).map_err(|error| error.to_string());
            let before = own()?;
            send_again(&mouth, &datagrams).map_err(|error| error.to_string())?;
            Ok((before, own()?))
        })?
        .join()
        .map_err(|_| "the sender panicked")??;
    stop.store(true, Ordering::Relaxed);
    listening.join().map_err(|_| "a listener panicked")?;
    Ok(at_end.since(before).busy_ns as f64)
}

fn send_again(mouth: &UdpSocket, datagrams: &[Heard]) -> std::io::Result<()> {
    let Some(first_ns) = datagrams.first().map(|(at_ns, _)| *at_ns) else { return Ok(()) };
    let (begin, mut burst_ns) = (clock::now(), first_ns);
    for (at_ns, datagram) in datagrams {
        if at_ns - burst_ns > BURST_NS {
            burst_ns = *at_ns;
            clock::rest(begin + burst_ns - first_ns);
        }
        let topic = Datagram::read(datagram).ok().and_then(|datagram| Topic::of_number(datagram.head.topic));
        mouth.send_to(datagram, wire::address(topic.unwrap_or(Topic::Status)))?;
    }
    Ok(())
}

fn hear(ear: &UdpSocket, stop: &AtomicBool) -> Vec<Heard> {
    let (mut heard, mut bytes) = (Vec::new(), [0; 2048]);
    while !stop.load(Ordering::Relaxed) {
        if let Ok(len) = ear.recv(&mut bytes) {
            heard.push((clock::now(), bytes[..len].to_vec()));
        }
    }
    heard
}

/// Scans that the gateway sends in a second if there are always more.
fn most_of_gateway() -> Outcome<f64> {
    let stage = Stage::new()?;
    let mut source = Source::open(&stage.domain)?;
    let gateway = wire::gateway(&stage, "lo", &[format!("--topic={SENSOR}/scan")])?;
    let begin = Instant::now();
    while begin.elapsed() < SETTLING + FLAT_OUT {
        source.publish(0)?;
    }
    let lines = gateway.end()?;
    let scans: Vec<_> = lines.iter().filter(|(_, line)| is_of(line, SENSOR, "scan")).collect();
    // Between two of its accounts in the middle.
    let [.., (from_ns, first), (to_ns, last), _] = scans[..] else { return Err("too few accounts".into()) };
    if number(last, "missed") == number(first, "missed") {
        eprintln!("the gateway could have sent more");
    }
    Ok((number(last, "sent") - number(first, "sent")) as f64 / ((to_ns - from_ns) as f64 / 1e9))
}

/// Datagrams of that length that a loop sends in a second.
fn most_of_bare() -> Outcome<f64> {
    let mouth = wire::mouth()?;
    let datagram = vec![0; HEAD + source::scan().pack(&mut [0; 2048]).unwrap_or_default()];
    let (begin, mut sent) = (Instant::now(), 0u64);
    while begin.elapsed() < FLAT_OUT {
        mouth.send_to(&datagram, wire::address(Topic::Scan))?;
        sent += 1;
    }
    Ok(sent as f64 / FLAT_OUT.as_secs_f64())
}
