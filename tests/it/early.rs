//! Topic `early`, from the line to a subscriber: a warning is sent before its telegram or revolution is complete. The
//! zones of the scan then confirm it, or the hub withdraws it. Warnings are computed only while the topic has a
//! subscriber.

use std::cell::RefCell;

use crate::testkit::{INT, Program, TERM, TestEnv, checked_topic_seqs, is_class, number};
use serde_json::Value;

/// World with a post in the smaller zone, to the right of the sensor and a little ahead of it. The post is in the first
/// third of each telegram and of each revolution.
pub(crate) const POST_WORLD: &str = "[noise]\nerrors = 0\n[[thing]]\nradius_mm = 60\npose = [460, 200]\n\
    [[thing]]\nline = [[-3000, -1000], [3000, -1000], [3000, 4000], [-3000, 4000], [-3000, -1000]]\n";

/// A scanner: flags of its simulator, keys of its link, and a number of beams slightly above a third of a scan.
struct Scanner {
    flags: &'static [&'static str],
    keys: &'static [&'static str],
    first_third: u64,
}

const LMS_SCANNER: Scanner = Scanner { flags: &["--baud=500000"], keys: &[], first_third: 250 };
const LD_SCANNER: Scanner =
    Scanner { flags: &["--family=ld", "--model=ld19"], keys: &["family=ld", "model=ld19"], first_third: 150 };
const RPLIDAR_SCANNER: Scanner = Scanner {
    flags: &["--family=rplidar", "--model=a1"],
    keys: &["family=rplidar", "model=a1"],
    first_third: 480,
};

impl Scanner {
    /// Starts a hub for this scanner, and a simulator in `world` on a line with `faults`.
    fn start(&self, env: &TestEnv, world: &str, faults: &[&str]) -> (Program, Program) {
        let world = format!("--world={}", env.file("post.toml", world));
        let flags = [&["--seed=28", &world], self.flags, faults].concat();
        let keys = self.keys.iter().map(|key| format!("--set=link.front.{key}"));
        let hub = env.hub(&[vec![env.link("front")], keys.collect()].concat());
        (hub, env.simulator(&["front"], &flags))
    }
}

/// Receives `front/early` and `front/zones` from a scanner on a line with `faults`. Stops when `is_enough` returns true
/// for the numbers of warnings by fate. Asserts that no warning is wrong.
fn check_warnings(
    env: &TestEnv,
    scanner: &Scanner,
    faults: &[&str],
    is_enough: impl Fn(&WarningFates) -> bool,
) {
    let (hub, simulator) = scanner.start(env, POST_WORLD, faults);
    let mut echo = env.echo(&["front/early", "front/zones"]);
    let lines = RefCell::new(Vec::new());
    echo.await_line("warnings with all expected fates", |line| {
        let mut lines = lines.borrow_mut();
        lines.push(line.clone());
        // Check only after every 16th line. Checking after each line would make this test read so slowly that the
        // client misses samples.
        lines.len().is_multiple_of(16) && is_enough(&count_fates(&lines, scanner.first_third))
    });
    let outcome = echo.end(INT);
    assert_eq!(number(&env.info("front")["counters"], "loan_failed"), 0);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
    // Assert that the client reported every gap. Samples in such a gap count as missed.
    checked_topic_seqs(&outcome, "early");
    checked_topic_seqs(&outcome, "zones");
    let counts = count_fates(&outcome.lines(), scanner.first_third);
    assert_eq!(counts.wrong, [""; 0], "{counts:?}");
}

/// Numbers of warnings by fate. Each warning is counted in one field. A warning in `confirmed_early` is also counted in
/// `confirmed`.
#[derive(Debug, Default)]
struct WarningFates {
    /// Warnings that the zones of the scan confirmed: their verdict is at least as bad as that of the warning.
    confirmed: usize,
    /// Confirmed warnings that were sent when at most a third of the scan had arrived.
    confirmed_early: usize,
    /// Warnings that the hub withdrew.
    withdrawn: usize,
    /// Warnings that a worse warning of the same scan replaced.
    worsened: usize,
    /// Warnings with an unknown fate. The client reported that it missed the sample that decides the fate, or that it
    /// received this sample too late. Or the test has not received the sample yet.
    unknown: usize,
    /// Descriptions of all other warnings. Each of them is an error.
    wrong: Vec<String>,
}

/// Sample of a topic, with the number of samples that the client missed just before it.
struct NumberedSample<'a> {
    line: &'a Value,
    missed: u64,
}

/// Returns the samples of `class` in `lines`. Lines with which the client reports a silence are not samples.
fn numbered_samples<'a>(lines: &'a [Value], class: &str) -> Vec<NumberedSample<'a>> {
    let samples: Vec<_> =
        lines.iter().filter(|line| line["class"] == class && line["topic_seq"].is_u64()).collect();
    let missed = |at: usize| {
        let before = at.checked_sub(1).map(|before| number(samples[before], "topic_seq"));
        before.map_or(0, |before| number(samples[at], "topic_seq").saturating_sub(before + 1))
    };
    samples.iter().enumerate().map(|(at, &line)| NumberedSample { line, missed: missed(at) }).collect()
}

/// Determines the fate of each warning in `lines` by its sequence number. The next sample of topic `early` withdraws or
/// replaces the warning, or the zones of the same scan confirm it. The order in which lines of different topics were
/// printed does not matter. `third` is the number of beams in the first third of a scan.
fn count_fates(lines: &[Value], third: u64) -> WarningFates {
    let (warnings, zones) = (numbered_samples(lines, "early"), numbered_samples(lines, "zones"));
    let mut counts = WarningFates::default();
    let is_withdrawn = |line: &Value| line["withdrawn"] == true;
    for (at, NumberedSample { line, missed }) in warnings.iter().enumerate() {
        let (seq, next) = (number(line, "seq"), warnings.get(at + 1));
        let is_of_same = |other: &Value| number(other, "seq") == seq;
        let is_sound = (line["verdict"] == "stop" || line["verdict"] == "slow")
            && number(line, "bytes_seen") < 732
            && number(line, "beams_seen") > 0;
        if !is_sound {
            counts.wrong.push(format!("not a warning: {line}"));
        }
        if is_withdrawn(line) {
            let stood = at.checked_sub(1).map(|before| warnings[before].line);
            let is_its = stood.is_some_and(|stood| !is_withdrawn(stood) && is_of_same(stood));
            // A sample without a preceding warning is wrong, except for the first one that the client receives. The
            // first sample may withdraw a warning that the hub sent before the client attached.
            if !is_its && *missed == 0 && at > 0 {
                counts.wrong.push(format!("nothing to withdraw: {line}"));
            }
            continue;
        }
        match next {
            Some(next) if is_of_same(next.line) => {
                let is_worse = line["verdict"] == "slow" && next.line["verdict"] == "stop";
                if is_withdrawn(next.line) {
                    counts.withdrawn += 1;
                } else if is_worse || next.missed > 0 {
                    counts.worsened += 1;
                } else {
                    counts.wrong.push(format!("no worse than {line}: {}", next.line));
                }
                continue;
            }
            Some(next) if next.missed > 0 => {
                // The sample that withdraws or replaces the warning may be among the missed ones.
                counts.unknown += 1;
                continue;
            }
            _ => {}
        }
        // A warning for a revolution has the `seq` of a packet that arrives before the revolution is complete. The
        // zones of the scan therefore have a greater `seq`.
        let is_telegram = number(line, "bytes_seen") > 0;
        let of_scan = zones.iter().position(|zones| number(zones.line, "seq") >= seq);
        let Some(NumberedSample { line: of_scan, missed }) = of_scan.map(|at| &zones[at]) else {
            counts.unknown += 1;
            continue;
        };
        let is_first = of_scan["topic_seq"] == zones[0].line["topic_seq"];
        if is_telegram && number(of_scan, "seq") == seq {
        } else if *missed > 0 || is_first {
            counts.unknown += 1;
            continue;
        } else if is_telegram {
            counts.wrong.push(format!("no zones and not withdrawn: {line}, then {of_scan}"));
            continue;
        }
        if of_scan["stale"] == true {
            counts.unknown += 1;
            continue;
        }
        let holds = of_scan["verdict"] == "stop" || of_scan["verdict"] == line["verdict"];
        // The zones of a revolution with gaps may be worse than the warning. A scan that waited for a busy hub has the
        // verdict `unknown`, because it is too old for another verdict.
        let waited = of_scan["flags"].to_string().contains("stamp_estimated");
        let is_unsure =
            of_scan["verdict"] == "unknown" && (waited || line["verdict"] == "slow" && !is_telegram);
        if !holds && !is_unsure {
            counts.wrong.push(format!("{line} does not hold: {of_scan}"));
        }
        counts.confirmed += 1;
        counts.confirmed_early += usize::from(number(line, "beams_seen") <= third);
    }
    counts
}

#[test]
fn zones_confirm_warnings_of_incomplete_telegrams() {
    let env = TestEnv::new();
    // The hub reads a telegram in three parts, and the post is in the first one. Not every warning is early, because a
    // busy hub sometimes reads later.
    check_warnings(&env, &LMS_SCANNER, &[], |counts| counts.confirmed >= 20 && counts.confirmed_early >= 10);
}

#[test]
fn zones_confirm_warnings_of_incomplete_revolutions() {
    for scanner in [&LD_SCANNER, &RPLIDAR_SCANNER] {
        let env = TestEnv::new();
        check_warnings(&env, scanner, &[], |counts| counts.confirmed >= 12 && counts.confirmed_early >= 7);
    }
}

#[test]
fn warning_of_a_damaged_telegram_is_withdrawn() {
    let env = TestEnv::new();
    check_warnings(&env, &LMS_SCANNER, &["--fault=truncate=0.3"], |counts| {
        counts.confirmed >= 5 && counts.withdrawn >= 5
    });
}

/// Flag for a line that loses most of some revolutions. The hub counts these revolutions as lost and publishes no scan
/// for them.
const GAPS: &str = "--fault=silence=0.07,silence_at=3,silence_every=0.3";

#[test]
fn warning_of_a_revolution_without_scan_is_withdrawn() {
    for scanner in [&LD_SCANNER, &RPLIDAR_SCANNER] {
        let env = TestEnv::new();
        check_warnings(&env, scanner, &[GAPS], |counts| counts.confirmed >= 5 && counts.withdrawn >= 5);
    }
}

#[test]
fn warnings_are_computed_only_for_subscribers() {
    for scanner in [&LD_SCANNER, &RPLIDAR_SCANNER] {
        let env = TestEnv::new();
        let (_hub, _simulator) = scanner.start(&env, POST_WORLD, &[]);
        let mut zones = env.echo(&["front/zones"]);
        zones.await_lines(10, "a post", |line| line["verdict"] == "stop");
        let first = env.echo(&["front/early"]).await_line("a warning", is_class("early"));
        // The hub numbers every warning that it computes. The number 0 of the first warning shows that the hub computed
        // none before the topic had a subscriber.
        assert_eq!(number(&first, "topic_seq"), 0, "{first}");
    }
}
