//! A link of 0.5 Mbit/s and 100 ms each way, with all topics of two sensors: how old scans are when they come, and whether
//! both ends know what did not.

use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::{Flags, Topic, clock};

use crate::account::compare;
use crate::relay::relay;
use crate::stage::{SENSORS, Stage, free_port, listened, percentile};
use crate::{Row, row};

const RUN: Duration = Duration::from_secs(40);
const BYTES_A_SECOND: f64 = 500_000.0 / 8.0;
const DELAY: Duration = Duration::from_millis(100);

pub(crate) fn rows(stage: &Stage) -> Vec<Row> {
    let [robot, desk] = ["robot", "desk"].map(|name| stage.machine(name));
    let at = free_port();
    let there = robot.bridge(&[&format!("--listen=tcp/{at}"), "--topic=*/*"]);
    listened(at);
    let here = desk.bridge(&[&format!("--connect=tcp/{}", relay(at, BYTES_A_SECOND, DELAY)), "--publish"]);
    here.tells(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    let published =
        SENSORS.map(|name| here.tells(|line| line["kind"] == "published" && is_called(line, name)));
    let names = published.map(|line| line["sensor"].as_str().unwrap_or_default().to_owned());
    let (mut local, mut beside) = robot.follow(SENSORS.map(|sensor| (sensor, Topic::Scan)));
    let (mut memory, mut sources) = desk.follow([(&names[0], Topic::Scan), (&names[1], Topic::Scan)]);
    thread::sleep(Duration::from_secs(3));
    let (mut ages, mut missed, mut heard) = (Vec::new(), 0, 0);
    let mut is_first = true;
    let begun = Instant::now();
    while begun.elapsed() < RUN {
        memory.look().expect("a domain");
        for source in &mut sources {
            while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                let header = sample.header().filter(|header| header.flags & Flags::REMOTE != 0);
                // What waited here meanwhile is older.
                if let Some(header) = header.filter(|_| !is_first) {
                    ages.push(clock::wall_ns().saturating_sub(header.wall_ns));
                }
            }
        }
        for source in &mut beside {
            while let Some(sample) = source.receive(&mut local).expect("a sample") {
                missed += if is_first { 0 } else { sample.missed() };
                heard += 1;
            }
        }
        is_first = false;
        memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
    }
    let sent = there.end();
    thread::sleep(Duration::from_secs(2));
    let account = compare(&sent, &here.end());
    let [p50, p99] = [0.5, 0.99].map(|share| percentile(&mut ages, share) / 1e3);
    vec![
        row(
            "0.5 Mbit/s, 100 ms each way, all topics of two sensors: age of a scan, median and p99",
            format!("{p50:.0} ms, {p99:.0} ms, {} scans", ages.len()),
            Some(("p99 at most 600 ms", p99 <= 600.0)),
        ),
        row(
            "samples sent, received, lost, replaced",
            format!("{}, {}, {}, {}", account.sent, account.received, account.lost, account.replaced),
            None,
        ),
        account.agreement(),
        row(
            "scans that a consumer beside the hub missed",
            format!("{missed} of {heard}"),
            Some(("0", missed == 0)),
        ),
    ]
}

fn is_called(line: &serde_json::Value, name: &str) -> bool {
    line["sensor"].as_str().is_some_and(|said| said.ends_with(&format!(".{name}")))
}
