//! Tests of `latency`: which ages are measured, when it exits with 5, and that all wait methods measure the same.

use std::time::Duration;

use clap::{Args, Command, FromArgMatches};
use scanhub_schema::{Failure, Kind, Verdict};
use scanhub_verbs::context::Context;
use scanhub_verbs::latency::LatencyArgs;

use crate::fake::{FakeHub, RunningVerb, TestDomain};
use crate::{context, domain_options};

/// Runs `latency` with these arguments and without real-time priority.
fn start(test_domain: &TestDomain, is_json: bool, arguments: &str) -> RunningVerb {
    let command = LatencyArgs::augment_args(Command::new("latency").no_binary_name(true));
    let words = arguments.split(' ').chain(["--no-realtime"]);
    let args = LatencyArgs::from_arg_matches(&command.get_matches_from(words)).expect("arguments");
    let domain = domain_options(test_domain);
    RunningVerb::start(move |out, notes, stop| {
        let context = context(domain, is_json, out, notes, stop);
        args.run(&mut Context { is_terminal: true, ..context })
    })
}

/// Runs `latency` while a fake hub publishes zones. The hub stamps the zones when it sends them. Returns the result,
/// the output and the notes.
fn run_with_three_zones(
    test_domain: &TestDomain,
    is_json: bool,
    arguments: &str,
) -> (Result<(), Failure>, String, String) {
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(test_domain, is_json, arguments);
    hub.front_sensor().zones.await_subscribers(1);
    // The verb has completed its subscription when it receives samples. There is no other sign, so repeat the samples.
    while !verb.finished() {
        hub.front_sensor().publish_zones(Verdict::Clear, 700);
        std::thread::sleep(Duration::from_millis(5));
    }
    verb.join()
}

/// Returns the last line of class `latency` about `topic`.
fn latency_line<'a>(out: &'a str, topic: &str) -> &'a str {
    let named = format!(r#""class":"latency","sensor":"front","topic":"{topic}""#);
    out.lines().rfind(|line| line.contains(&named)).unwrap_or_else(|| panic!("no {topic}: {out}"))
}

#[test]
fn each_wait_mode_reports_ages() {
    for name in ["doorbell", "event", "spin"] {
        let test_domain = TestDomain::new();
        let (end, out, _) =
            run_with_three_zones(&test_domain, true, &format!("front/zones -n 40 --wait {name}"));
        assert_eq!(end, Ok(()), "{name}: {out}");
        let begin =
            format!(r#"{{"class":"conditions","wait":"{name}","realtime":false,"memory_locked":false,"#);
        assert!(out.starts_with(&begin), "{out}");
        assert!(out.lines().next().is_some_and(|line| line.ends_with(r#","refused":[]}"#)), "{out}");
        let line = latency_line(&out, "zones");
        assert!(
            line.contains(r#""received":40,"#)
                && line.contains(r#""in_future":0,"flags":[],"age":{"count":"#)
        );
        assert!(
            line.ends_with(r#""line":null,"hub":null,"wake":null,"total":null,"network":null}"#),
            "{line}"
        );
        assert!(
            out.lines()
                .last()
                .is_some_and(|line| line.starts_with(r#"{"class":"summary","sensor":"front","#))
        );
    }
}

#[test]
fn exceeded_p99_limit_is_a_failed_check() {
    let test_domain = TestDomain::new();
    let with = |limit: &str| {
        run_with_three_zones(&test_domain, true, &format!("front/zones -n 20 --max-p99 {limit}"))
    };
    assert_eq!(with("60s").0, Ok(()));
    let (end, out, _) = with("0.001us");
    let failure = end.expect_err("no machine is that fast");
    assert_eq!(failure.kind, Kind::Check);
    assert!(failure.message.starts_with("front/zones: p99 of the age on arrival is "), "{failure}");
    assert!(failure.message.ends_with("more than 1ns"), "{failure}");
    assert!(latency_line(&out, "zones").contains(r#""received":20,"#), "the line is printed anyway");
}

#[test]
fn samples_from_before_the_start_have_no_age() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let verb = start(&test_domain, true, "front/scan front/scan -n 5 --max-p99 60s");
    hub.front_sensor().scan.await_subscribers(1);
    // The fake hub's stamps lie in the first seconds after the start of the machine.
    while !verb.finished() {
        hub.front_sensor().publish_scan(&[100]);
        std::thread::sleep(Duration::from_millis(5));
    }
    let (end, out, _) = verb.join();
    let failure = end.expect_err("no age is known");
    assert_eq!((failure.kind, failure.kind.exit_code()), (Kind::Check, 5));
    assert!(failure.message.contains("no sample with a known age arrived"), "{failure}");
    let line = latency_line(&out, "scan");
    assert!(line.contains(r#""received":5,"before":5,"in_future":0,"flags":[],"age":null,"#), "{line}");
    assert_eq!(out.matches(r#""class":"summary""#).count(), 1, "a topic that is named twice is one");
}

#[test]
fn prints_latency_as_text() {
    let test_domain = TestDomain::new();
    let (end, out, notes) = run_with_three_zones(&test_domain, false, "front/zones -n 20");
    assert_eq!(end, Ok(()));
    assert!(
        notes.starts_with("wait by doorbell, normal priority, memory not locked; the clock takes "),
        "{notes}"
    );
    assert!(out.starts_with("front/zones: 20 received, 0 missed in "), "{out}");
    assert!(out.contains("\nus   count  ") && out.contains("\nage "), "{out}");
    assert!(out.contains(" us ") && out.contains(" ##"), "no bars: {out}");
}

#[test]
fn prints_a_line_per_second_across_hub_restarts() {
    let test_domain = TestDomain::new();
    let verb = start(&test_domain, true, "front/zones");
    let tell = |boot, lines| {
        let mut hub = FakeHub::new(&test_domain.domain, &["front"], boot);
        hub.front_sensor().zones.await_subscribers(1);
        while verb.out.text().matches(r#""topic":"zones","received":"#).count() < lines {
            hub.front_sensor().publish_zones(Verdict::Clear, 700);
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    tell(1, 1);
    verb.out.await_lines(r#""kind":"hub_gone""#, 1);
    // Lines are also written while the second hub runs.
    let lines = verb.out.text().matches(r#""class":"latency""#).count();
    tell(2, lines + 1);
    verb.out.await_lines(r#""kind":"hub_back""#, 1);
    verb.stop();
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()), "{out}");
    assert!(latency_line(&out, "zones").contains(r#""age":{"count":"#), "{out}");
}

#[test]
fn latency_fails_at_once_without_a_hub() {
    let test_domain = TestDomain::new();
    let failure = start(&test_domain, true, "front/scan -n 1").join().0.expect_err("no hub");
    assert_eq!(failure.kind, Kind::NoHub);
    let failure = start(&test_domain, true, "front -n 1").join().0.expect_err("no topic");
    assert_eq!(failure.kind, Kind::Usage);
}
