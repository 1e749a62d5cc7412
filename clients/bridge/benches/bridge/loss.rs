//! All topics of two sensors over a router for minutes: what is lost, and how busy the bridges are.

use std::thread;
use std::time::{Duration, Instant};

use crate::account::compare;
use crate::stage::{Stage, free_port, listened};
use crate::{Row, row};

pub(crate) fn rows(stage: &Stage, minutes: f64) -> Vec<Row> {
    let [robot, between, desk] = ["robot", "router", "desk"].map(|name| stage.machine(name));
    let at = free_port();
    let _router = between.bridge(&[&format!("--listen=tcp/{at}")]);
    listened(at);
    let here = desk.bridge(&[&format!("--connect=tcp/{at}"), "--publish"]);
    here.tells(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let there = robot.bridge(&[&format!("--connect=tcp/{at}"), "--topic=*/*"]);
    there.tells(|line| line["class"] == "bridge_link" && line["state"] == "up");
    let _hub = robot.robot();
    here.tells(|line| line["kind"] == "published");
    thread::sleep(Duration::from_secs(3));
    let (begun, before) = (Instant::now(), [there.ticks(), here.ticks()]);
    thread::sleep(Duration::from_secs_f64(60.0 * minutes));
    let seconds = begun.elapsed().as_secs_f64();
    let busy = [there.ticks() - before[0], here.ticks() - before[1]].map(|ticks| ticks as f64 / seconds);
    let sent = there.end();
    thread::sleep(Duration::from_secs(1));
    let account = compare(&sent, &here.end());
    let all = account.sent + account.replaced + account.missed;
    vec![
        row(
            &format!(
                "all topics of two sensors over a router for {minutes} minutes: samples lost on the way"
            ),
            format!("{} of {}", account.lost, account.sent),
            Some(("0", account.lost == 0)),
        ),
        row(
            "of these, replaced by newer ones before they were sent, or missed in the hub",
            format!("{} of {all}", account.replaced + account.missed),
            None,
        ),
        account.agreement(),
        row("bytes a second", format!("{:.0}", account.bytes as f64 / seconds), None),
        row(
            "processor time of the bridge that sends",
            format!("{:.2} % of a core", busy[0]),
            Some(("at most 3 %", busy[0] <= 3.0)),
        ),
        row("of the one that publishes", format!("{:.2} % of a core", busy[1]), None),
    ]
}
