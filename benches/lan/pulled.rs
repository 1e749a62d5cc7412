//! The gateway's link is down for ten seconds: when it is heard there again, and whether anybody else notices.

use std::process::Command;
use std::thread;
use std::time::Duration;

use schema::datagram::PORT;

use crate::machine::Machine;
use crate::support::figures::{Figure, Target};
use crate::support::stage::{PATIENCE, SENSORS, Stage};
use crate::support::{Outcome, clock};
use crate::wire::{self, Program, sum};

const DOWN: Duration = Duration::from_secs(10);

/// From the plug until a scan, and what was lost elsewhere meanwhile.
pub(crate) fn figures() -> Outcome<Vec<Figure>> {
    let stage = Stage::new()?;
    let (pulled, other) = (Machine::new(3), Machine::new(4));
    let listener = |machine: &Machine, flag: &str| {
        let mut listen = Command::new("nsenter");
        listen.arg(format!("--net={}", machine.network().display()));
        listen.args([wire::PROGRAM, "listen", "--json", flag]);
        Program::start(listen, "ready")
    };
    let (there, elsewhere) = (listener(&pulled, "--topic=scan")?, listener(&other, "--stats")?);
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let copies = format!("--to={}:{PORT}", other.there());
    let gateway = wire::gateway(&stage, &pulled.end(), &[wire::all_topics(), vec![copies]].concat())?;
    there.await_after(0, "scan")?;
    pulled.run("ip link set eth0 down");
    thread::sleep(DOWN);
    pulled.run("ip link set eth0 up");
    let plugged_ns = clock::now();
    let heard_ns = there.await_after(plugged_ns, "scan")?;
    let sent = gateway.end()?;
    let heard = elsewhere.end()?;
    drop(there.end()?);
    let last = sent.iter().rev().take_while(|(_, line)| line["class"] != "lan_link");
    let missed =
        last.filter(|(_, line)| line["class"] == "lan").map(|(_, line)| wire::number(line, "missed"));
    let figure = |name, unit, value, target| Figure { name, unit, hub: vec![value], floor: vec![], target };
    let again_ms = (heard_ns - plugged_ns) as f64 / 1e6;
    Ok(vec![
        figure("down for 10 s: until heard again", "ms", again_ms, Target::Most(1000.0)),
        figure("the same: received elsewhere", "1", sum(&heard, "received"), Target::None),
        figure("the same: lost elsewhere", "1", sum(&heard, "lost"), Target::Most(0.0)),
        figure("the same: missed by the gateway", "1", missed.max().unwrap_or(0) as f64, Target::Most(0.0)),
    ])
}
