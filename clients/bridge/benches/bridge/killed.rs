//! A router that is killed and started again and again: how soon scans come again, and whether both ends know what was lost.

use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::streams::{Session, Source};
use scanhub_client::{Flags, Topic};

use crate::account::compare;
use crate::stage::{SENSORS, Stage, free_port, listened};
use crate::{Row, row};

const TIMES: usize = 20;
/// So long it is away.
const AWAY: Duration = Duration::from_millis(700);

pub(crate) fn rows(stage: &Stage) -> Vec<Row> {
    let [robot, between, desk] = ["robot", "router", "desk"].map(|name| stage.machine(name));
    let at = free_port();
    let listen = format!("--listen=tcp/{at}");
    let mut router = between.bridge(&[&listen]);
    listened(at);
    let connect = format!("--connect=tcp/{at}");
    let here = desk.bridge(&[&connect, "--publish"]);
    here.tells(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let there = robot.bridge(&[&connect, "--topic=*/*"]);
    there.tells(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    let name =
        here.tells(|line| line["kind"] == "published")["sensor"].as_str().unwrap_or_default().to_owned();
    let mut local = robot.follow(SENSORS.map(|sensor| (sensor, Topic::Scan)));
    let mut remote = desk.follow([(&name, Topic::Scan)]);
    let (mut missed, mut heard, mut is_first) = (0, 0, true);
    let mut look = |local: &mut (Session, [Source; 2])| {
        for source in &mut local.1 {
            while let Some(sample) = source.receive(&mut local.0).expect("a sample") {
                // What waited here meanwhile does not count.
                missed += if is_first { 0 } else { sample.missed() };
                heard += 1;
            }
        }
        is_first = false;
    };
    look(&mut local);
    let mut back_ms = Vec::new();
    for _ in 0..TIMES {
        drop(router);
        let killed = Instant::now();
        while killed.elapsed() < AWAY {
            look(&mut local);
            newest(&mut remote);
            thread::sleep(Duration::from_millis(10));
        }
        router = between.bridge(&[&listen]);
        let back = Instant::now();
        while !newest(&mut remote) {
            assert!(back.elapsed() < Duration::from_secs(30), "nothing comes any more");
            look(&mut local);
            thread::sleep(Duration::from_millis(1));
        }
        back_ms.push(back.elapsed().as_secs_f64() * 1e3);
        let well = Instant::now();
        while well.elapsed() < Duration::from_secs(1) {
            look(&mut local);
            newest(&mut remote);
            thread::sleep(Duration::from_millis(10));
        }
    }
    look(&mut local);
    let sent = there.end();
    thread::sleep(Duration::from_secs(1));
    let account = compare(&sent, &here.end());
    back_ms.sort_by(f64::total_cmp);
    let longest = back_ms[TIMES - 1];
    vec![
        row(
            "router killed and started 20 times: from its start to the next scan, median and longest",
            format!("{:.0} ms, {longest:.0} ms", back_ms[TIMES / 2]),
            Some(("at most 1000 ms", longest <= 1000.0)),
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

/// Takes what came; whether there was a scan of another machine.
fn newest((memory, sources): &mut (Session, [Source; 1])) -> bool {
    let mut came = false;
    memory.look().expect("a domain");
    for source in sources {
        while let Some(sample) = source.receive(memory).expect("a sample") {
            came |= sample.header().is_some_and(|header| header.flags & Flags::REMOTE != 0);
        }
    }
    came
}
