//! The topic `early`, from a line to a consumer: a warning comes before its telegram is complete, or the turn of a head, and
//! either the zones of its scan confirm it or it is taken back; it is there only while somebody follows it.

use std::collections::BTreeMap;

use crate::testkit::{INT, Outcome, Program, TERM, TestEnv, is_class, number};
use serde_json::Value;

/// A post in the smaller circle, to the right and a little ahead: in the first third of each telegram, and of each turn.
pub(crate) const POST: &str = "[noise]\nerrors = 0\n[[thing]]\nradius_mm = 60\npose = [460, 200]\n\
    [[thing]]\nline = [[-3000, -1000], [3000, -1000], [3000, 4000], [-3000, 4000], [-3000, -1000]]\n";

/// A scanner: the simulator's flags, and its link's keys.
struct Scanner {
    flags: &'static [&'static str],
    keys: &'static [&'static str],
}

const LMS: Scanner = Scanner { flags: &["--baud=500000"], keys: &[] };
const LD: Scanner = Scanner { flags: &["--family=ld", "--model=ld19"], keys: &["family=ld", "model=ld19"] };
const RPLIDAR: Scanner =
    Scanner { flags: &["--family=rplidar", "--model=a1"], keys: &["family=rplidar", "model=a1"] };

impl Scanner {
    /// A hub of it, and its simulator in `world` on a line with `faults`.
    fn start(&self, env: &TestEnv, world: &str, faults: &[&str]) -> (Program, Program) {
        let world = format!("--world={}", env.file("post.toml", world));
        let flags = [&["--seed=28", &world], self.flags, faults].concat();
        let keys = self.keys.iter().map(|key| format!("--set=link.front.{key}"));
        let hub = env.hub(&[vec![env.link("front")], keys.collect()].concat());
        (hub, env.simulator(&["front"], &flags))
    }
}

/// What `front/early` and `front/zones` say of a line with `faults`, until so many `lines` like `wanted` were heard.
fn heard(
    env: &TestEnv,
    scanner: &Scanner,
    faults: &[&str],
    lines: usize,
    wanted: impl Fn(&Value) -> bool,
) -> Outcome {
    let (hub, simulator) = scanner.start(env, POST, faults);
    let mut echo = env.echo(&["front/early", "front/zones"]);
    echo.await_lines(lines, "warnings", wanted);
    // The zones of the last one.
    echo.await_lines(3, "zones", is_class("zones"));
    let outcome = echo.end(INT);
    assert_eq!(number(&env.info("front")["counters"], "loan_failed"), 0);
    assert_eq!((hub.end(TERM).code, simulator.end(TERM).code), (Some(0), Some(0)));
    outcome
}

/// Checks that each warning of `outcome` was confirmed or withdrawn; how many were.
fn judge(outcome: &Outcome) -> (usize, usize) {
    let mut zones: BTreeMap<u64, Value> = BTreeMap::new();
    // A silence has the number of the scan before it, or none; what came too late is not said.
    let heard = |line: &Value| line["seq"].is_u64() && line["stale"] != true;
    for line in outcome.of_class("zones").into_iter().filter(heard) {
        zones.entry(number(&line, "seq")).or_insert(line);
    }
    let (&first, &last) = (zones.keys().next().expect("zones"), zones.keys().last().expect("zones"));
    let mut open: BTreeMap<u64, Value> = BTreeMap::new();
    let (mut confirmed, mut withdrawn) = (0, 0);
    let missed = outcome.of_class("notice").iter().any(|line| line["kind"] == "missed");
    // Zones that a busy machine handed over too late.
    let lines = outcome.of_class("zones");
    let late = lines.iter().filter(|line| line["stale"] == true).filter_map(|line| line["seq"].as_u64());
    let late: Vec<u64> = late.collect();
    for line in outcome.of_class("early") {
        let seq = number(&line, "seq");
        assert!(line["verdict"] == "stop" || line["verdict"] == "slow", "{line}");
        assert!(number(&line, "bytes_seen") < 732 && number(&line, "beams_seen") > 0, "{line}");
        if line["withdrawn"] == true {
            assert!(open.remove(&seq).is_some(), "nothing to take back: {line}");
            withdrawn += 1;
        } else {
            open.insert(seq, line);
        }
    }
    for (&seq, line) in open.range(first..=last) {
        // Of a turn only the packets are numbered before it is over.
        let of_scan = zones.range(seq..).next().map(|(_, of_scan)| of_scan).expect("zones");
        let is_telegram = number(line, "bytes_seen") > 0;
        let of_seq = number(of_scan, "seq");
        if missed && of_seq != seq || late.iter().any(|late| (seq..of_seq).contains(late)) {
            continue;
        }
        assert!(of_seq == seq || !is_telegram, "no zones: {line}");
        let holds = of_scan["verdict"] == "stop" || of_scan["verdict"] == line["verdict"];
        // A revolution with gaps may be worse than it looks. A scan that waited for a busy hub says nothing about the
        // present.
        let waited = of_scan["flags"].to_string().contains("stamp_estimated");
        let is_unsure =
            of_scan["verdict"] == "unknown" && (waited || line["verdict"] == "slow" && !is_telegram);
        assert!(holds || is_unsure, "{line} {of_scan}");
        confirmed += 1;
    }
    (confirmed, withdrawn)
}

/// A warning of `outcome` came when at most this number of beams had arrived. On a busy machine the others may come later.
fn come_early(outcome: &Outcome, beams: u64) {
    let early = outcome.of_class("early");
    assert!(early.iter().any(|line| number(line, "beams_seen") <= beams), "{outcome}");
}

#[test]
fn warnings_come_before_the_telegram_ends_and_its_zones_confirm_them() {
    let env = TestEnv::new();
    let outcome = heard(&env, &LMS, &[], 20, is_class("early"));
    let (confirmed, withdrawn) = judge(&outcome);
    assert!(confirmed >= 10 && withdrawn == 0, "{confirmed} and {withdrawn}");
    // The post is in the first third, and the telegram is read in three.
    come_early(&outcome, 250);
}

#[test]
fn warnings_come_before_a_turn_ends_and_its_zones_confirm_them() {
    for (scanner, third) in [(&LD, 150), (&RPLIDAR, 480)] {
        let env = TestEnv::new();
        let outcome = heard(&env, scanner, &[], 12, is_class("early"));
        let (confirmed, withdrawn) = judge(&outcome);
        assert!(confirmed >= 5 && withdrawn == 0, "{confirmed} and {withdrawn}");
        come_early(&outcome, third);
    }
}

#[test]
fn a_warning_of_a_telegram_that_is_damaged_is_taken_back() {
    let env = TestEnv::new();
    let outcome = heard(&env, &LMS, &["--fault=truncate=0.3"], 5, |line| line["withdrawn"] == true);
    let (confirmed, withdrawn) = judge(&outcome);
    assert!(confirmed > 0 && withdrawn >= 5, "{confirmed} and {withdrawn}");
}

/// Most of some turns is lost: they are counted, and make no scan.
const HOLES: &str = "--fault=silence=0.07,silence_at=3,silence_every=0.3";

#[test]
fn a_warning_of_a_turn_that_makes_no_scan_is_taken_back() {
    for scanner in [&LD, &RPLIDAR] {
        let env = TestEnv::new();
        let outcome = heard(&env, scanner, &[HOLES], 5, |line| line["withdrawn"] == true);
        let (confirmed, withdrawn) = judge(&outcome);
        assert!(confirmed > 0 && withdrawn >= 5, "{confirmed} and {withdrawn}");
    }
}

#[test]
fn nothing_is_judged_while_nobody_follows() {
    for scanner in [&LD, &RPLIDAR] {
        let env = TestEnv::new();
        let (_hub, _simulator) = scanner.start(&env, POST, &[]);
        let mut zones = env.echo(&["front/zones"]);
        zones.await_lines(10, "a post", |line| line["verdict"] == "stop");
        let first = env.echo(&["front/early"]).await_line("a warning", is_class("early"));
        // What is not sent has a number too, if it was made.
        assert_eq!(number(&first, "topic_seq"), 0, "{first}");
    }
}

/// The same post, there for a moment each half second.
fn blinking() -> String {
    let wall = POST.split_once("[[thing]]").and_then(|(_, post)| post.split_once("[[thing]]"));
    let (_, wall) = wall.expect("two things");
    let times = (0..80).map(|n| 3.0 + 0.47 * f64::from(n));
    let posts = times.map(|from_s| {
        let until_s = from_s + 0.11;
        format!(
            "[[thing]]\nradius_mm = 60\npose = [460, 200]\nfrom_s = {from_s:.2}\nuntil_s = {until_s:.2}\n"
        )
    });
    format!("[noise]\nerrors = 0\n[[thing]]{wall}{}", posts.collect::<String>())
}

#[test]
fn lights_follow_warnings_and_what_takes_them_back() {
    let env = TestEnv::new();
    let (_hub, _simulator) = LD.start(&env, &blinking(), &[HOLES]);
    let leds = env.start(&["leds", "robot", "--early", "--hold=0s", "--json"]);
    let mut echo = env.echo(&["front/early"]);
    echo.await_lines(8, "what is taken back", |line| line["withdrawn"] == true);
    let (leds, early) = (leds.end(INT).of_class("leds"), echo.end(INT).of_class("early"));
    let is_stop = |line: &Value| line["verdict"] == "stop";
    let pairs = early.windows(2).filter(|pair| pair[1]["withdrawn"] == true && is_stop(&pair[0]));
    let shown = pairs.filter(|pair| {
        let [said, withdrawn] = [0, 1].map(|which| number(&pair[which], "wall_ns"));
        let between = |line: &&Value| is_stop(line) && (said..withdrawn).contains(&number(line, "wall_ns"));
        let on = leds.iter().position(|line| between(&line));
        on.and_then(|on| leds.get(on + 1))
            .is_some_and(|off| !is_stop(off) && number(off, "wall_ns") > withdrawn)
    });
    assert!(shown.count() > 0, "{leds:#?} {early:#?}");
}
