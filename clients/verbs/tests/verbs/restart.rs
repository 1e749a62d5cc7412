//! Tests of a hub that is killed and restarted, as seen by its subscribers.

use std::process::{Command, Stdio};
use std::time::Duration;

use crate::child::{Child, spawn};
use crate::echo::{Format, start};
use crate::fake::{FakeHub, TestDomain, wait_until};
use scanhub_client::Subscriber;
use scanhub_schema::Scan;
use scanhub_shm::{Domain, hub_pid};
use scanhub_verbs::RunLimits;

/// Duration of one mirror revolution of an LMS (75 Hz), in ns. The LMS measures the half degrees one revolution later.
const REVOLUTION_NS: u64 = 13_320_000;

/// The hub of these tests, as a separate process. The other tests start it. Otherwise, it is ignored.
#[test]
#[ignore = "a helper process of the tests here"]
fn hub_process() {
    let (Ok(name), Ok(base)) = (std::env::var("FAKE_DOMAIN"), std::env::var("FAKE_BASE")) else { return };
    let boot = std::env::var("FAKE_BOOT").unwrap().parse().unwrap();
    let mut hub = FakeHub::new(&Domain::at(&name, base.as_ref()).unwrap(), &["front"], boot);
    loop {
        hub.front_sensor().publish_scan(&[1000]);
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A hub process that ends with the test.
struct HubProcess(Child);

impl HubProcess {
    fn start(test_domain: &TestDomain, boot: u64) -> HubProcess {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "restart::hub_process", "--ignored", "--nocapture"]);
        command.env("FAKE_DOMAIN", test_domain.domain.name()).env("FAKE_BASE", &test_domain.base);
        command.env("FAKE_BOOT", boot.to_string()).stdin(Stdio::null()).stdout(Stdio::null());
        HubProcess(spawn(command).unwrap())
    }

    fn kill(mut self, test_domain: &TestDomain) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
        assert_eq!(hub_pid(test_domain.domain.root()), Ok(None));
    }
}

#[test]
fn echo_continues_after_a_killed_hub() {
    let test_domain = TestDomain::new();
    let hub = HubProcess::start(&test_domain, 1);
    let verb = start(&test_domain, &["front/scan"], Format::Json, RunLimits::default());
    verb.out.await_lines(r#""boot":"0000000000000001""#, 10);
    hub.kill(&test_domain);
    verb.out.await_lines("hub_gone", 1);
    let hub = HubProcess::start(&test_domain, 2);
    verb.out.await_lines("hub_back", 1);
    verb.out.await_lines(r#""boot":"0000000000000002""#, 10);
    verb.stop();
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    assert_eq!((out.matches("hub_gone").count(), out.matches("hub_back").count()), (1, 1));
    // The subscriber existed before the new hub, so it receives the new hub's samples from the first one on.
    let first = out.lines().find(|line| line.contains(r#""boot":"0000000000000002""#)).unwrap();
    assert!(first.contains(r#""topic_seq":0,"#), "{first}");
    assert!(out.lines().last().unwrap().contains(r#""missed":0"#), "{out}");
    hub.kill(&test_domain);
}

#[test]
fn subscription_reports_a_hub_restart_once() {
    let test_domain = TestDomain::new();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open().unwrap();
    assert!(!scans.hub_is_running() && scans.try_next().unwrap().is_none());
    let hub = HubProcess::start(&test_domain, 1);
    for _ in 0..5 {
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        assert_eq!((scan.ranges(), scan.header().boot, scan.restarted), (&[1000][..], 1, false));
    }
    hub.kill(&test_domain);
    let _hub = HubProcess::start(&test_domain, 2);
    let mut restarts = 0;
    for _ in 0..20 {
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        restarts += u32::from(scan.restarted);
        assert_eq!(scan.missed, 0);
    }
    assert_eq!(restarts, 1);
}

#[test]
fn subscriber_times_out_and_continues() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let timeout = Duration::from_millis(20);
    let mut scans =
        Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).timeout(timeout).open().unwrap();
    wait_until("nothing", || scans.next().unwrap().is_none() && scans.hub_is_running());
    hub.front_sensor().scan.await_subscribers(1);
    hub.front_sensor().publish_scan(&[7; 361]);
    let scan = scans.next().unwrap().expect("one was sent");
    assert_eq!((scan.beams(), scan.missed, scan.restarted), (361, 0, false));
    assert_eq!(scan.beam_time_ns(360), scan.header().stamp_first_ns - REVOLUTION_NS);
}

#[test]
fn subscriber_continues_after_a_clean_hub_exit() {
    let test_domain = TestDomain::new();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open().unwrap();
    for boot in 1..4 {
        let mut hub = FakeHub::new(&test_domain.domain, &["front"], boot);
        wait_until("the subscriber", || {
            assert!(scans.try_next().unwrap().is_none());
            hub.front_sensor().scan.subscribers() == 1
        });
        hub.front_sensor().publish_scan(&[5]);
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        assert_eq!((scan.header().boot, scan.missed, scan.restarted), (boot, 0, boot > 1));
    }
}

#[test]
fn client_started_between_two_hubs_receives_scans() {
    let test_domain = TestDomain::new();
    let hub = HubProcess::start(&test_domain, 1);
    wait_until("a hub", || matches!(hub_pid(test_domain.domain.root()), Ok(Some(1..))));
    wait_until("its topics", || {
        scanhub_shm::sensors(&test_domain.domain).is_ok_and(|sensors| !sensors.is_empty())
    });
    hub.kill(&test_domain);
    let timeout = Duration::from_millis(50);
    let mut scans =
        Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).timeout(timeout).open().unwrap();
    assert!(scans.next().unwrap().is_none() && !scans.hub_is_running());
    let hub = HubProcess::start(&test_domain, 2);
    // The subscriber polls for a hub continuously, so it may receive a scan while the hub still starts.
    let mut is_received = false;
    let mut receive = || {
        is_received |= scans.next().unwrap().is_some_and(|scan| scan.header().boot == 2 && !scan.restarted);
        is_received
    };
    let pid = hub.0.id();
    wait_until("the second hub", || receive() || hub_pid(test_domain.domain.root()) == Ok(Some(pid)));
    wait_until("a scan of the second hub", receive);
}

#[test]
fn remote_sequence_numbers_continue_across_hub_runs() {
    let test_domain = TestDomain::new();
    let mut hub = FakeHub::new(&test_domain.domain, &["front"], 1);
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&test_domain.domain).open().unwrap();
    assert!(scans.try_next().unwrap().is_none());
    hub.front_sensor().flags = scanhub_schema::Flags::REMOTE;
    let mut missed = |hub: &mut FakeHub, boot: u64, topic_seq: u64| {
        (hub.front_sensor().boot, hub.front_sensor().scan.topic_seq) = (boot, topic_seq);
        hub.front_sensor().publish_scan(&[1000; 181]);
        let scan = scans.next().unwrap().expect("without a timeout");
        (scan.missed, scan.restarted)
    };
    assert_eq!(missed(&mut hub, 11, 40), (0, false), "the first one");
    assert_eq!(missed(&mut hub, 11, 44), (3, false));
    assert_eq!(missed(&mut hub, 12, 45), (0, true));
    assert_eq!(missed(&mut hub, 12, 47), (1, false));
}
