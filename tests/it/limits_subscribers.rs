//! Many subscribers, slow subscribers and killed subscribers: no other subscriber misses samples because of them. Each
//! subscriber can determine exactly which samples it missed. After the subscribers have ended, the hub uses as many
//! resources as before.

use std::fs;
use std::thread;
use std::time::Duration;

use crate::testkit;
use crate::testkit::{
    INT, KILL, Program, TERM, TestEnv, TestGateway, contiguous_numbers, in_a_network, in_own_process,
    is_class, number, wait_until,
};
use rustix::process::Signal;
use scanhub_client::Subscriber;
use scanhub_schema::{Scan, Topic, Zones, limits};
use scanhub_shm::Domain;
use scanhub_shm::Payload;
use serde_json::Value;

/// Variables with the name and the location of the domain, for a child process that is killed while it holds samples.
const HOLD_VARIABLES: [&str; 2] = ["SCANHUB_TEST_DOMAIN", "SCANHUB_TEST_BASE"];

/// Starts a hub with a recording of many minutes that has a scan every `period_ms`. Choose a period so long that a
/// subscriber does not miss scans just because the machine is busy.
fn streaming(env: &TestEnv, period_ms: u32, flags: &[&str]) -> Program {
    let line = |scan: u32| {
        let (ranges, at) = (vec!["1.5"; 181].join(" "), f64::from(scan * period_ms) / 1000.0);
        format!("FLASER 181 {ranges} 0 0 0 0 0 0 {at} host {at}\n")
    };
    let file = env.file("log", (1..3000).map(line).collect::<String>());
    env.hub(&[&["--link", &format!("front=file:{file}")], flags].concat())
}

fn subscribe(domain: &Domain) -> Subscriber<Scan> {
    Subscriber::builder("front").in_domain(domain).timeout(Duration::from_secs(20)).open().expect("a name")
}

/// Attaches `count` subscribers, and receives until each of them has received `sample_count` scans. Returns the total
/// number of scans that the subscribers missed.
fn count_missed(domain: &Domain, count: usize, sample_count: usize) -> u64 {
    let mut subscribers: Vec<_> = (0..count).map(|_| (subscribe(domain), 0, 0)).collect();
    while subscribers.iter().any(|(_, received, _)| *received < sample_count) {
        for (subscriber, received, missed) in &mut subscribers {
            while let Some(scan) = subscriber.try_next().expect("samples can be received") {
                assert!(!scan.restarted);
                (*received, *missed) = (*received + 1, *missed + scan.missed);
            }
        }
        // A new scan reaches all subscribers at the same time, so it is enough to wait for the first subscriber.
        let (subscriber, received, missed) = &mut subscribers[0];
        let scan = subscriber.next().expect("samples can be received").expect("a scan arrives");
        (*received, *missed) = (*received + 1, *missed + scan.missed);
    }
    subscribers.iter().map(|(.., missed)| missed).sum()
}

#[test]
fn forty_subscribers_miss_no_sample() {
    in_own_process("limits_subscribers::forty_subscribers_miss_no_sample", || {
        let env = TestEnv::new();
        let hub = streaming(&env, 100, &["--set=limits.subscribers=41"]);
        let mut echo = env.echo(&["front/scan"]);
        let domain = env.domain();
        let threads: Vec<_> = (0..4)
            .map(|_| {
                let domain = domain.clone();
                thread::spawn(move || count_missed(&domain, 10, 40))
            })
            .collect();
        let missed: Vec<_> = threads.into_iter().map(|thread| thread.join().expect("no panic")).collect();
        assert_eq!(missed, [0; 4]);
        echo.await_lines(10, "a scan", is_class("scan"));
        let outcome = echo.end(INT);
        contiguous_numbers(&outcome.of_class("scan"), "topic_seq");
        assert_eq!(env.info("front")["counters"]["loan_failed"], 0);
        assert_eq!(hub.end(TERM).exit_code, Some(0));
    });
}

#[test]
fn reports_configured_limit_to_surplus_subscriber() {
    in_own_process("limits_subscribers::reports_configured_limit_to_surplus_subscriber", || {
        let env = TestEnv::new();
        let hub = env.hub(&[env.link("front"), "--set=limits.subscribers=3".to_owned()]);
        let node = scanhub_shm::client_node(&env.domain()).expect("the process can join the domain");
        let topic = Scan::open(&node, "front").expect("the topic can be opened").expect("the topic exists");
        let subscribers: Vec<_> =
            (0..3).map(|_| Scan::subscriber(&node, &topic).expect("the topic has a free slot")).collect();
        assert_eq!(env.subscribers("front/scan"), 3);
        let outcome = env.run(&["echo", "front/scan", "--json"]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(75), &"short".into()), "{outcome}");
        assert_eq!(error["message"], "scanhub/v2/front/scan has 3 subscribers, which is the maximum");
        assert!(error["hint"].to_string().contains("limits.subscribers, up to 250"), "{error}");
        // The limit applies to each topic, so subscribers of other topics are not affected.
        assert_eq!(env.info("front")["state"], "absent");
        drop(subscribers);
        let late = env.echo(&["front/scan"]);
        assert_eq!(late.end(INT).exit_code, Some(0));
        assert_eq!(hub.end(TERM).exit_code, Some(0));
    });
}

#[test]
fn refusal_on_a_remote_topic_names_the_listener_flag() {
    in_a_network("limits_subscribers::refusal_on_a_remote_topic_names_the_listener_flag", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 3, "front");
        let flags = ["listen", "--json", "--publish", "--subscribers=2", "--name=robot1=5f3a12bc00d1e2f3"];
        let mut program = env.start(&flags).ready();
        sender.wait_until_published(&mut program, &[Topic::Zones, Topic::Status]);
        let node = scanhub_shm::client_node(&env.domain()).expect("the process can join the domain");
        let topic =
            Zones::open(&node, "robot1.front").expect("the topic can be opened").expect("the topic exists");
        let subscribers =
            [(); 2].map(|()| Zones::subscriber(&node, &topic).expect("the topic has a free slot"));
        let outcome = env.run(&["echo", "robot1.front/zones", "--json"]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(75), &"short".into()), "{outcome}");
        assert!(error["message"].as_str().is_some_and(|text| text.contains("has 2 subscribers")), "{error}");
        assert!(error["hint"].as_str().is_some_and(|text| text.contains("larger --subscribers")), "{error}");
        drop((subscribers, topic, node));
        assert_eq!(program.end(TERM).exit_code, Some(0));
    });
}

#[test]
fn only_a_stopped_subscriber_misses_samples() {
    let env = TestEnv::new();
    let hub = streaming(&env, 50, &[]);
    let (mut stopped, mut other) = (env.echo(&["front/scan"]), env.echo(&["front/scan"]));
    stopped.await_lines(10, "a scan", is_class("scan"));
    stopped.signal(Signal::STOP);
    let first = number(&other.await_line("a scan", is_class("scan")), "topic_seq");
    other.await_line("many scans", |line| line["class"] == "scan" && number(line, "topic_seq") > first + 100);
    stopped.signal(Signal::CONT);
    stopped.await_line("report of missed scans", |line| line["kind"] == "missed");
    stopped.await_lines(20, "a scan", is_class("scan"));
    let (stopped, other) = (stopped.end(INT), other.end(INT));
    let (scans, notices) = (stopped.of_class("scan"), stopped.of_class("notice"));
    let summary = &stopped.of_class("summary")[0];
    let at = |scan: &Value| number(scan, "topic_seq");
    let published = at(&scans[scans.len() - 1]) - at(&scans[0]) + 1;
    let reported: u64 = notices.iter().map(|notice| number(notice, "missed")).sum();
    assert_eq!((number(summary, "received"), number(summary, "missed")), (scans.len() as u64, reported));
    assert_eq!(scans.len() as u64 + reported, published);
    contiguous_numbers(&other.of_class("scan"), "topic_seq");
    assert_eq!(other.of_class("summary")[0]["missed"], 0);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn killed_subscribers_leave_no_samples() {
    if let [Ok(domain), Ok(base)] = HOLD_VARIABLES.map(std::env::var) {
        return hold_samples(&Domain::at(&domain, base.as_ref()).expect("the domain is valid"));
    }
    let env = TestEnv::new();
    let hub = streaming(&env, 50, &[]);
    let mut echo = env.echo(&["front/scan"]);
    let descriptors = || fs::read_dir(format!("/proc/{}/fd", hub.pid())).expect("the hub runs").count();
    let hub_domain = env.domain();
    let segments = || testkit::shared_memory(&hub_domain.prefix()).len();
    let (open_before, segments_before) = (descriptors(), segments());
    // The killed subscribers hold more samples in total than the hub has. If the hub did not get these samples back, it
    // would have none left.
    const {
        assert!(
            KILL_COUNT * SUBSCRIBERS_PER_PROCESS * limits::MAX_BORROWED_SAMPLES
                > limits::sample_count(Topic::Scan, 32)
        )
    };
    for _ in 0..KILL_COUNT {
        let mut holder = std::process::Command::new(testkit::own_program());
        holder.args(testkit::single_test_args("limits_subscribers::killed_subscribers_leave_no_samples"));
        holder
            .env(HOLD_VARIABLES[0], hub_domain.name())
            .env(HOLD_VARIABLES[1], hub_domain.root().parent().expect("the domain has a parent directory"));
        let mut holder = Program::start(holder);
        holder.wait_for_text("holding");
        assert_eq!(holder.end(KILL).exit_code, None);
    }
    // The numbers may also become smaller than before. The earlier numbers may include resources of the client that
    // counted the subscribers, which may not have exited completely.
    wait_until("the hub has as many descriptors and segments as before", || {
        descriptors() <= open_before && segments() <= segments_before
    });
    echo.await_lines(40, "a scan", is_class("scan"));
    assert_eq!(env.info("front")["counters"]["loan_failed"], 0);
    let outcome = echo.end(INT);
    contiguous_numbers(&outcome.of_class("scan"), "topic_seq");
    assert_eq!(outcome.of_class("summary")[0]["missed"], 0);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
}

/// Borrows as many samples as the subscribers of this process may, prints the number of samples, and waits to be
/// killed.
fn hold_samples(domain: &Domain) {
    let node = scanhub_shm::client_node(domain).expect("the process can join the domain");
    let topic = Scan::open(&node, "front").expect("the topic can be opened").expect("the topic exists");
    let mut subscribers = Vec::new();
    // Subscribers of an earlier process that was killed keep their slots until the hub cleans up.
    wait_until("all slots are free", || {
        subscribers.extend(Scan::subscriber(&node, &topic));
        subscribers.len() == SUBSCRIBERS_PER_PROCESS
    });
    let mut held = Vec::new();
    for subscriber in &subscribers {
        for _ in 0..limits::MAX_BORROWED_SAMPLES {
            wait_until("a scan arrives", || {
                Scan::receive(subscriber)
                    .expect("samples can be received")
                    .map(|scan| held.push(scan))
                    .is_some()
            });
        }
    }
    println!("\nholding {}", held.len());
    loop {
        thread::park();
    }
}

const KILL_COUNT: usize = 20;
/// Number of subscribers in each process that is killed.
const SUBSCRIBERS_PER_PROCESS: usize = 12;
