//! Tests of subscribers in tokio: samples as a stream, canceled waits, and the example.

#[path = "../../examples/tokio.rs"]
#[allow(dead_code)] // A test runs its `main` in another process.
mod example;
mod fake;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use fake::{FakeHub, TestDomain, wait_until};
use futures::StreamExt;
use rustix::process::{Pid, Signal, kill_process};
use scanhub_client::{PollableSubscriber, Scan, Subscriber, ZonesSubscriber};
use scanhub_schema::Verdict;
use scanhub_shm::Domain;
use tokio::io::unix::AsyncFd;
use tokio::time::timeout;

/// Timeout that only a hang exceeds, even on a busy machine.
const WAIT_TIMEOUT: Duration = Duration::from_secs(60);

fn scans(test_domain: &TestDomain) -> PollableSubscriber<Scan> {
    Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open_pollable().unwrap()
}

/// Another thread sends scans. Waits are canceled before a scan is sent, while it is sent, and after it was sent.
#[test]
fn thousand_cancelled_waits_lose_no_sample() {
    let test_domain = TestDomain::new();
    let (is_done, received) = (AtomicBool::new(false), AtomicU64::new(0));
    let mut scans = scans(&test_domain);
    thread::scope(|scope| {
        let sender = scope.spawn(|| {
            let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
            wait_until("the subscriber", || hub.front_sensor().scan.subscribers() == 1);
            let started = Instant::now();
            while !is_done.load(Ordering::Relaxed) && started.elapsed() < WAIT_TIMEOUT {
                // The queue has room for 64 samples, so stay well below that.
                if hub.front_sensor().scan.topic_seq < received.load(Ordering::Relaxed) + 30 {
                    hub.front_sensor().publish_scan(&[1000]);
                }
                thread::sleep(Duration::from_micros(300));
            }
            let sent = hub.front_sensor().scan.topic_seq;
            wait_until("the last scan", || received.load(Ordering::Relaxed) == sent);
            sent
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let (mut cancelled, mut round, started) = (0, 0, Instant::now());
            while !sender.is_finished() && started.elapsed() < WAIT_TIMEOUT {
                is_done.store(cancelled >= 1000, Ordering::Relaxed);
                round += 1;
                match timeout(Duration::from_millis(round % 2), scans.next()).await {
                    Ok(scan) => {
                        let scan = scan.expect("no end").unwrap();
                        let number = received.load(Ordering::Relaxed);
                        assert_eq!((scan.header().topic_seq, scan.missed), (number, 0));
                        received.store(number + 1, Ordering::Relaxed);
                    }
                    Err(_) => cancelled += 1,
                }
            }
            assert!(cancelled >= 1000, "{cancelled}");
            let sent = sender.join().unwrap();
            assert!(sent >= 100, "{sent}");
        });
    });
}

#[tokio::test]
async fn stream_in_another_task_wakes_for_each_sample() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain);
    wait_until("the subscriber", || {
        scans.try_next().unwrap().is_none() && hub.front_sensor().scan.subscribers() == 1
    });
    let (give, mut take) = tokio::sync::mpsc::channel(1);
    let task = tokio::spawn(async move {
        while let Some(scan) = scans.next().await {
            // A sample moves between tasks, and is held during the next wait.
            if give.send(scan.unwrap()).await.is_err() {
                break;
            }
        }
    });
    for beams in 1..=20 {
        hub.front_sensor().publish_scan(&vec![1000; beams]);
        let scan = timeout(WAIT_TIMEOUT, take.recv()).await.expect("it wakes").expect("a scan");
        assert_eq!(scan.beams(), beams);
    }
    task.abort();
}

#[tokio::test]
async fn receives_while_an_async_fd_borrows_the_subscriber() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let scans = scans(&test_domain);
    wait_until("the subscriber", || {
        scans.try_next().unwrap().is_none() && hub.front_sensor().scan.subscribers() == 1
    });
    #[allow(deprecated)] // Its replacement is unsafe. The descriptor outlives the registration.
    let descriptor = AsyncFd::new(&scans).unwrap();
    for beams in 1..=5 {
        hub.front_sensor().publish_scan(&vec![1000; beams]);
        let scan = loop {
            let mut ready =
                timeout(WAIT_TIMEOUT, descriptor.readable()).await.expect("it is readable").unwrap();
            if let Some(scan) = scans.try_next().unwrap() {
                break scan;
            }
            ready.clear_ready();
        };
        assert_eq!(scan.beams(), beams);
    }
}

#[tokio::test]
async fn zones_stream_reports_silences() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut zones = ZonesSubscriber::builder("front").in_domain(&test_domain.domain).open_pollable().unwrap();
    wait_until("the subscriber", || {
        let _ = zones.try_next().unwrap();
        hub.front_sensor().zones.subscribers() == 1
    });
    // The verdict is valid for more than a second, so that a busy machine reads it before its end.
    hub.front_sensor().period_us = 500_000;
    hub.front_sensor().publish_zones(Verdict::Clear, 900);
    let mut verdicts = Vec::new();
    while verdicts != [Verdict::Clear, Verdict::Unknown] {
        let sample = timeout(WAIT_TIMEOUT, zones.next()).await.expect("news").expect("no end").unwrap();
        verdicts.extend((!sample.stale || verdicts == [Verdict::Clear]).then(|| sample.zones.verdict()));
    }
}

#[test]
fn stream_moves_to_another_runtime() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = scans(&test_domain);
    wait_until("the subscriber", || {
        scans.try_next().unwrap().is_none() && hub.front_sensor().scan.subscribers() == 1
    });
    for beams in 1..=3 {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let scan = runtime.block_on(async {
            assert!(timeout(Duration::from_millis(1), scans.next()).await.is_err(), "nothing was sent");
            hub.front_sensor().publish_scan(&vec![1000; beams]);
            timeout(WAIT_TIMEOUT, scans.next()).await.expect("it wakes")
        });
        assert_eq!(scan.expect("no end").unwrap().beams(), beams);
    }
}

#[test]
fn stream_without_a_tokio_runtime_is_an_error() {
    let test_domain = TestDomain::new();
    let mut scans = scans(&test_domain);
    let waker = std::task::Waker::noop();
    let polled = scans.poll_next_unpin(&mut std::task::Context::from_waker(waker));
    let std::task::Poll::Ready(Some(Err(error))) = polled else { panic!("it waits for nothing") };
    assert!(error.message().contains("tokio"), "{error}");
}

/// Variable that is set in the process that runs the example.
const EXAMPLE_VARIABLE: &str = "SCANHUB_TEST_EXAMPLE";

#[test]
fn example_runs_until_ctrl_c() {
    if std::env::var_os(EXAMPLE_VARIABLE).is_some() {
        return example::main().unwrap();
    }
    let test_domain = TestDomain::new();
    let base = test_domain.base.join("scanhub");
    std::fs::create_dir(&base).unwrap();
    let domain = Domain::at(test_domain.domain.name(), &base).unwrap();
    let mut hub = FakeHub::new(&domain, &["front", "rear"], 1);
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "example_runs_until_ctrl_c", "--nocapture"])
        .envs([(EXAMPLE_VARIABLE, Path::new("1")), ("SCANHUB_DOMAIN", Path::new(domain.name()))])
        .envs([("XDG_RUNTIME_DIR", &test_domain.base)])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    wait_until("both sensors", || hub.sensors.iter().all(|sensor| sensor.scan.subscribers() == 1));
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
    hub.sensors[0].publish_scan(&[1000; 5]);
    hub.sensors[1].publish_scan(&[1000; 7]);
    let mut expected = vec!["front: 5 beams", "rear: 7 beams", "front: silent; there is a hub: true"];
    while !expected.is_empty() {
        let line = lines.next().expect("the example ended");
        expected.retain(|expected| !line.ends_with(expected));
    }
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    assert!(lines.any(|line| line == "end"));
    assert!(child.wait().unwrap().success());
}
