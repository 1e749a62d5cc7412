//! Costs and losses of the network. All programs run in separate network namespaces, for which the bench uses
//! `unshare`, `nsenter` and `ip`. The bench measures:
//!
//! - the age of a scan that a gateway sent, compared with the age of a datagram that a process sends when an eventfd is
//!   signaled
//! - the gateway's CPU time, compared with that of a thread that sends the same datagrams, and the maximum rate of the
//!   gateway
//! - the datagrams that arrive over a good cable, and over a cable that is unplugged for a while
//! - the behavior of a listener that receives a million damaged datagrams
//! - the lengths of the datagrams of scans
//!
//! The bench does not measure the effects of a real switch.
//!
//! After a network link was down, the kernel sends no datagram until its link watch has run, which takes up to a
//! second.

#[path = "../../tests/testkit/child.rs"]
mod child;
mod gateway;
#[path = "../../tests/testkit/machine.rs"]
#[allow(dead_code)] // Tests use more items.
mod machine;
#[path = "../support/mod.rs"]
mod support;
mod wire;

use std::process::{Command, ExitCode};
use std::thread;
use std::time::Duration;

use machine::Machine;
use scanhub_schema::datagram::{
    DatagramError, DatagramPayload, HEADER_LEN, Head, MTU_ETHERNET, MTU_SAFE, PORT,
};
use scanhub_schema::{ArrayFlags, Scan, ScanHead, Topic, Verdict, Zones};
use support::environment::{BenchEnvironment, SENSORS, STEP_TIMEOUT};
use support::figures::{self, Figure, Target};
use support::source;
use support::{Options, Outcome, clock};
use wire::{Program, has_topic, number, sum};

fn main() -> ExitCode {
    let is_sender = std::env::args().skip(1).eq(gateway::SENDER_PART);
    let outcome = match (wire::is_in_namespace(), is_sender) {
        (true, true) => gateway::run_sender().map(|()| ExitCode::SUCCESS),
        (true, false) => return support::main(measure),
        (false, _) => wire::rerun_in_namespace(),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("{error}");
        ExitCode::FAILURE
    })
}

fn measure(options: &Options) -> Outcome<()> {
    let print = |figures: Vec<Figure>| figures::print("lan", options.json, &figures);
    print(sizes());
    print(gateway::latency(options.pairs())?);
    print(gateway::cpu_time(options.pairs())?);
    print(damaged_datagrams(options.count(1_000_000) as u64)?);
    print(measure_healthy_link(options.seconds(60))?);
    print(measure_link_down()?);
    Ok(())
}

/// Sends all topics of two sensors over a cable between two machines.
fn measure_healthy_link(seconds: u64) -> Outcome<Vec<Figure>> {
    let environment = BenchEnvironment::new()?;
    let machine = Machine::new(2);
    let network = format!("--net={}", machine.network().display());
    let mut listen = Command::new("nsenter");
    listen.args([&network, wire::PROGRAM, "listen", "--stats", "--json"]);
    let listener = Program::start(listen, "ready")?;
    let _simulator = environment.simulate(&SENSORS, 500_000)?;
    let hub = environment.start_hub(&SENSORS)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let gateway = wire::gateway(&environment, &machine.test_interface(), &wire::all_topics())?;
    thread::sleep(Duration::from_secs(seconds));
    let sent = gateway.end()?;
    let output_lines = listener.end()?;
    let mut rates = Vec::new();
    for sensor in SENSORS {
        let lines: Vec<_> = sent.iter().filter(|(_, line)| has_topic(line, sensor, "scan")).collect();
        // The first statistics were printed before the sensors stream. The last statistics may cover only a fraction of
        // a second.
        let [(from_ns, first), .., (to_ns, last), _] = lines[..] else { return Err("too short".into()) };
        let count = number(last, "sent") - number(first, "sent");
        rates.push(count as f64 / ((to_ns - from_ns) as f64 / 1e9));
    }
    let count = |key: &str| sum(&output_lines, key);
    let figure = |name, hub, target| Figure { name, unit: "1", hub, baseline: Vec::new(), target };
    Ok(vec![
        Figure { unit: "Hz", ..figure("cable: scans of each sensor", rates, Target::None) },
        figure("cable: datagrams received", vec![count("received")], Target::None),
        figure("cable: lost", vec![count("lost")], Target::Max(0.0)),
        figure(
            "cable: duplicated or reordered",
            vec![count("duplicate") + count("reordered")],
            Target::Max(0.0),
        ),
    ])
}

/// Numbers of beams, each with two names of figures: without intensities and with them. The beams cover 100 degrees in
/// steps of 1, 0.5 and 0.25 degrees, and 180 degrees in steps of 1 and 0.5 degrees.
const VARIANTS: [(usize, &str, &str); 5] = [
    (101, "size: 100/1", "size: 100/1, intensities"),
    (201, "size: 100/0.5", "size: 100/0.5, intensities"),
    (401, "size: 100/0.25", "size: 100/0.25, intensities"),
    (181, "size: 180/1", "size: 180/1, intensities"),
    (361, "size: 180/0.5", "size: 180/0.5, intensities"),
];

/// Returns the lengths of a scan's datagram for each variant of the LMS, without the headers of IP and UDP.
fn sizes() -> Vec<Figure> {
    let variant = |(count, plain, full)| [size(plain, count, 0), size(full, count, ArrayFlags::UPPER)];
    VARIANTS.into_iter().flat_map(variant).collect()
}

fn size(name: &'static str, count: usize, contents: u8) -> Figure {
    let scan = Scan::of(ScanHead { contents, ..ScanHead::default() }, &vec![0; count]);
    let len = scan.pack(&mut [0; MTU_ETHERNET]).map(|packed| HEADER_LEN + packed);
    let hub = len.map(|len| len as f64).into_iter().collect();
    Figure { name, unit: "B", hub, baseline: Vec::new(), target: Target::Max(MTU_SAFE as f64) }
}

/// Number of damaged datagrams between two intact ones. A listener's receive buffer certainly has room for so many
/// datagrams.
const DAMAGED_PER_INTACT: u64 = 50;

/// Sends `count` damaged and random datagrams to a listener. Measures which datagrams the listener accepts and reports,
/// and whether its memory grows.
fn damaged_datagrams(count: u64) -> Outcome<Vec<Figure>> {
    let mut command = Command::new(wire::PROGRAM);
    command.args(["listen", "--json", "--interface=lo", "--topic=zones"]);
    let listener = Program::start(command, "ready")?;
    let (socket, to) = (wire::sender()?, wire::address(Topic::Zones));
    let mut random = fastrand::Rng::with_seed(6);
    let mut buffer = [0; MTU_ETHERNET];
    let scan = sealed_datagram(&mut buffer, Topic::Scan, 0, &*source::scan())?;
    let whole = [scan, sealed_datagram(&mut buffer, Topic::Zones, 0, &Zones::unknown())?];
    let (mut sequence, mut begin_kb) = (0, 0);
    for n in 1..=count {
        socket.send_to(&damaged_datagram(&mut random, &whole), to)?;
        if n % DAMAGED_PER_INTACT == 0 {
            let zones = Zones { verdict: Verdict::Stop as u8, ..Zones::unknown() };
            socket.send_to(&sealed_datagram(&mut buffer, Topic::Zones, sequence, &zones)?, to)?;
            sequence += 1;
            listener.wait_for_class("zones")?;
        }
        if n == count / 10 {
            begin_kb = resident_kb(&listener)?;
        }
    }
    let grown_kb = resident_kb(&listener)?.saturating_sub(begin_kb);
    let lines = listener.end()?;
    let of_class = |class| lines.iter().map(|(_, line)| line).filter(move |line| line["class"] == class);
    let refused = of_class("lan_refused").next().ok_or("no statistics")?;
    let counts = DatagramError::ALL.map(|reason| (reason.name(), number(refused, reason.name())));
    let counted: u64 = counts.iter().map(|(_, count)| count).sum();
    for (name, count) in counts.iter().filter(|(_, count)| *count > 0) {
        eprintln!("refused as {name}: {count}");
    }
    let received: u64 = of_class("lan").map(|line| number(line, "received")).sum();
    let figure = |name, hub, target| Figure { name, unit: "1", hub: vec![hub], baseline: Vec::new(), target };
    let at_most = |name, hub: u64| figure(name, hub as f64, Target::Max(0.0));
    Ok(vec![
        figure("damaged: sent", count as f64, Target::None),
        at_most("damaged: refused without reason", count - counted.min(count)),
        at_most("damaged: accepted and not sent", received.saturating_sub(u64::from(sequence))),
        at_most("intact: sent and not accepted", u64::from(sequence).saturating_sub(received)),
        Figure { unit: "kB", ..figure("damaged: memory grown", grown_kb as f64, Target::Max(512.0)) },
    ])
}

fn sealed_datagram(
    buffer: &mut [u8],
    topic: Topic,
    sequence: u32,
    payload: &(impl DatagramPayload + ?Sized),
) -> Outcome<Vec<u8>> {
    let len = payload.pack(&mut buffer[HEADER_LEN..]).ok_or("it does not fit")?;
    let head = Head { topic: topic.number(), hub: 1, epoch: 1, sequence, revision: 1, ..Head::default() };
    Ok(head.seal(buffer, len).ok_or("it does not fit")?.to_vec())
}

/// Returns random bytes, or a damaged copy of one of `intact`. Some bits of the copy are flipped, or its end is
/// removed, extended or replaced.
fn damaged_datagram(random: &mut fastrand::Rng, intact: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = intact[random.usize(..intact.len())].clone();
    match random.u8(..5) {
        0 => (0..random.usize(1..4)).for_each(|_| {
            let bit = random.usize(..8 * bytes.len());
            bytes[bit / 8] ^= 1 << (bit % 8);
        }),
        1 => bytes.truncate(random.usize(..bytes.len())),
        2 => bytes.extend((0..random.usize(1..40)).map(|_| random.u8(..))),
        3 => {
            let begin = random.usize(..bytes.len());
            bytes[begin..].iter_mut().for_each(|byte| *byte = random.u8(..));
            bytes[begin] ^= 1;
        }
        _ => bytes = (0..random.usize(..MTU_ETHERNET)).map(|_| random.u8(..)).collect(),
    }
    // If the flipped bits have canceled each other, damage the datagram again.
    if intact.contains(&bytes) {
        bytes[0] ^= 0x80;
    }
    bytes
}

fn resident_kb(program: &Program) -> Outcome<u64> {
    let text = std::fs::read_to_string(format!("/proc/{}/status", program.pid()))?;
    let line = text.lines().find(|line| line.starts_with("VmRSS")).ok_or("no memory")?;
    Ok(line.split_whitespace().nth(1).ok_or("no number")?.parse()?)
}

/// Time for which the link of the gateway's machine is down.
const DOWN_TIME: Duration = Duration::from_secs(10);

/// Takes the link of the gateway's machine down for a while. Measures the time until the datagrams of the gateway
/// arrive again, and whether a listener on another machine detects the silence.
fn measure_link_down() -> Outcome<Vec<Figure>> {
    let environment = BenchEnvironment::new()?;
    let (pulled, other) = (Machine::new(3), Machine::new(4));
    let listener = |machine: &Machine, flag: &str| {
        let mut listen = Command::new("nsenter");
        listen.arg(format!("--net={}", machine.network().display()));
        listen.args([wire::PROGRAM, "listen", "--json", flag]);
        Program::start(listen, "ready")
    };
    let (there, elsewhere) = (listener(&pulled, "--topic=scan")?, listener(&other, "--stats")?);
    let _simulator = environment.simulate(&SENSORS, 500_000)?;
    let hub = environment.start_hub(&SENSORS)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let copies = format!("--to={}:{PORT}", other.test_address());
    let gateway =
        wire::gateway(&environment, &pulled.test_interface(), &[wire::all_topics(), vec![copies]].concat())?;
    there.wait_for_class_after(0, "scan")?;
    pulled.run_command("ip link set eth0 down");
    thread::sleep(DOWN_TIME);
    pulled.run_command("ip link set eth0 up");
    let plugged_ns = clock::now();
    let received_ns = there.wait_for_class_after(plugged_ns, "scan")?;
    let sent = gateway.end()?;
    let output_lines = elsewhere.end()?;
    drop(there.end()?);
    let last = sent.iter().rev().take_while(|(_, line)| line["class"] != "lan_link");
    let missed =
        last.filter(|(_, line)| line["class"] == "lan").map(|(_, line)| wire::number(line, "missed"));
    let figure =
        |name, unit, value, target| Figure { name, unit, hub: vec![value], baseline: vec![], target };
    let again_ms = (received_ns - plugged_ns) as f64 / 1e6;
    Ok(vec![
        figure("down for 10 s: until received again", "ms", again_ms, Target::Max(1000.0)),
        figure("the same: received by another machine", "1", sum(&output_lines, "received"), Target::None),
        figure("the same: lost by another machine", "1", sum(&output_lines, "lost"), Target::Max(0.0)),
        figure("the same: missed by the gateway", "1", missed.max().unwrap_or(0) as f64, Target::Max(0.0)),
    ])
}
