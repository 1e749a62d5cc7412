//! What does the network add? Age of a scan at an application behind a gateway, beside a datagram behind an eventfd; the
//! gateway's processor time, beside a thread that sends the same datagrams; how many it can send; what a healthy cable
//! carries to a listener, and one that is pulled for a while; what a million damaged datagrams do to one; and how long scans are. All of it in network
//! namespaces of its own. It does not tell what a real switch does.

#[path = "../../tests/testkit/child.rs"]
mod child;
mod damage;
mod hop;
mod load;
#[path = "../../tests/testkit/machine.rs"]
#[allow(dead_code)] // Tests use more of it.
mod machine;
mod pulled;
mod sizes;
mod source;
#[path = "../support/mod.rs"]
mod support;
mod wire;

use std::process::{Command, ExitCode};
use std::thread;
use std::time::Duration;

use machine::Machine;
use support::Outcome;
use support::figures::{self, Figure, Target};
use support::options::Options;
use support::stage::{PATIENCE, SENSORS, Stage};
use wire::{Program, is_of, number, sum};

fn main() -> ExitCode {
    let is_sender = std::env::args().skip(1).eq(hop::PART);
    let outcome = match (wire::inside(), is_sender) {
        (true, true) => hop::sender().map(|()| ExitCode::SUCCESS),
        (true, false) => return support::main(measure),
        (false, _) => wire::enter(),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("{error}");
        ExitCode::FAILURE
    })
}

fn measure(options: &Options) -> Outcome<()> {
    let tell = |figures: Vec<Figure>| figures::print("lan", options.json, &figures);
    tell(sizes::figures());
    tell(hop::figures(options.pairs())?);
    tell(load::figures(options.pairs())?);
    tell(damage::figures(options.count(1_000_000) as u64)?);
    tell(healthy(options.seconds(60))?);
    tell(pulled::figures()?);
    Ok(())
}

/// Two sensors, all topics, a cable between two machines.
fn healthy(seconds: u64) -> Outcome<Vec<Figure>> {
    let stage = Stage::new()?;
    let machine = Machine::new(2);
    let network = format!("--net={}", machine.network().display());
    let mut listen = Command::new("nsenter");
    listen.args([&network, wire::PROGRAM, "listen", "--stats", "--json"]);
    let listener = Program::start(listen, "ready")?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let gateway = wire::gateway(&stage, &machine.end(), &wire::all_topics())?;
    thread::sleep(Duration::from_secs(seconds));
    let sent = gateway.end()?;
    let heard = listener.end()?;
    let mut rates = Vec::new();
    for sensor in SENSORS {
        let lines: Vec<_> = sent.iter().filter(|(_, line)| is_of(line, sensor, "scan")).collect();
        // The first accounts are of sensors that are not streaming yet, the last may be of a fraction of a second.
        let [(from_ns, first), .., (to_ns, last), _] = lines[..] else { return Err("too short".into()) };
        let count = number(last, "sent") - number(first, "sent");
        rates.push(count as f64 / ((to_ns - from_ns) as f64 / 1e9));
    }
    let count = |key: &str| sum(&heard, key);
    let figure = |name, hub, target| Figure { name, unit: "1", hub, floor: Vec::new(), target };
    Ok(vec![
        Figure { unit: "Hz", ..figure("cable: scans of each sensor", rates, Target::None) },
        figure("cable: datagrams received", vec![count("received")], Target::None),
        figure("cable: lost", vec![count("lost")], Target::Most(0.0)),
        figure("cable: doubled or moved", vec![count("duplicate") + count("reordered")], Target::Most(0.0)),
    ])
}
