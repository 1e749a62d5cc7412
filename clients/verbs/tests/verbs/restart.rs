//! A hub that is killed and comes back, as those see it who follow it.

use std::process::{Command, Stdio};
use std::time::Duration;

use crate::child::{Child, spawn};
use crate::echo::{Format, start};
use crate::fake::{FakeHub, Place, until};
use scanhub_client::Subscriber;
use scanhub_schema::Scan;
use scanhub_shm::{Domain, holder};
use scanhub_verbs::Bounds;

/// One turn of an LMS's mirror (75 Hz); it measures the half degrees one turn later.
const TURN_NS: u64 = 13_320_000;

/// The hub of these tests when it has to be a process of its own: run by them, ignored otherwise.
#[test]
#[ignore = "a helper process of the tests here"]
fn hub_process() {
    let (Ok(name), Ok(base)) = (std::env::var("FAKE_DOMAIN"), std::env::var("FAKE_BASE")) else { return };
    let boot = std::env::var("FAKE_BOOT").unwrap().parse().unwrap();
    let mut hub = FakeHub::new(&Domain::at(&name, base.as_ref()).unwrap(), &["front"], boot);
    loop {
        hub.front().scan(&[1000]);
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A process that goes with the test.
struct Hub(Child);

impl Hub {
    fn start(place: &Place, boot: u64) -> Hub {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "restart::hub_process", "--ignored", "--nocapture"]);
        command.env("FAKE_DOMAIN", place.domain.name()).env("FAKE_BASE", &place.base);
        command.env("FAKE_BOOT", boot.to_string()).stdin(Stdio::null()).stdout(Stdio::null());
        Hub(spawn(command).unwrap())
    }

    fn kill(mut self, place: &Place) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
        assert_eq!(holder(place.domain.root()), Ok(None));
    }
}

#[test]
fn echo_goes_on_after_a_killed_hub() {
    let place = Place::new();
    let hub = Hub::start(&place, 1);
    let verb = start(&place, &["front/scan"], Format::Json, Bounds::default());
    verb.out.await_lines(r#""boot":"0000000000000001""#, 10);
    hub.kill(&place);
    verb.out.await_lines("hub_gone", 1);
    let hub = Hub::start(&place, 2);
    verb.out.await_lines("hub_back", 1);
    verb.out.await_lines(r#""boot":"0000000000000002""#, 10);
    verb.stop();
    let (end, out, _) = verb.join();
    assert_eq!(end, Ok(()));
    assert_eq!((out.matches("hub_gone").count(), out.matches("hub_back").count()), (1, 1));
    // The consumer was there all the time: it got the new hub's samples from the first on.
    let first = out.lines().find(|line| line.contains(r#""boot":"0000000000000002""#)).unwrap();
    assert!(first.contains(r#""topic_seq":0,"#), "{first}");
    assert!(out.lines().last().unwrap().contains(r#""missed":0"#), "{out}");
    hub.kill(&place);
}

#[test]
fn a_subscription_says_that_the_hub_was_restarted() {
    let place = Place::new();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&place.domain).open().unwrap();
    assert!(!scans.hub_is_running() && scans.try_next().unwrap().is_none());
    let hub = Hub::start(&place, 1);
    for _ in 0..5 {
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        assert_eq!((scan.ranges(), scan.header().boot, scan.restarted), (&[1000][..], 1, false));
    }
    hub.kill(&place);
    let _hub = Hub::start(&place, 2);
    let mut restarts = 0;
    for _ in 0..20 {
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        restarts += u32::from(scan.restarted);
        assert_eq!(scan.missed, 0);
    }
    assert_eq!(restarts, 1);
}

#[test]
fn a_subscription_times_out_and_goes_on() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    let timeout = Duration::from_millis(20);
    let mut scans =
        Subscriber::<Scan>::builder("front").in_domain(&place.domain).timeout(timeout).open().unwrap();
    until("nothing", || scans.next().unwrap().is_none() && scans.hub_is_running());
    hub.front().scan.await_subscribers(1);
    hub.front().scan(&[7; 361]);
    let scan = scans.next().unwrap().expect("one was sent");
    assert_eq!((scan.beams(), scan.missed, scan.restarted), (361, 0, false));
    assert_eq!(scan.beam_time_ns(360), scan.header().stamp_first_ns - TURN_NS);
}

#[test]
fn a_subscription_goes_on_after_a_hub_that_ended_well() {
    let place = Place::new();
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&place.domain).open().unwrap();
    for boot in 1..4 {
        let mut hub = FakeHub::new(&place.domain, &["front"], boot);
        until("the consumer", || {
            assert!(scans.try_next().unwrap().is_none());
            hub.front().scan.subscribers() == 1
        });
        hub.front().scan(&[5]);
        let scan = scans.next().unwrap().expect("without a timeout it waits");
        assert_eq!((scan.header().boot, scan.missed, scan.restarted), (boot, 0, boot > 1));
    }
}

#[test]
fn a_client_that_comes_between_two_hubs() {
    let place = Place::new();
    let hub = Hub::start(&place, 1);
    until("a hub", || matches!(holder(place.domain.root()), Ok(Some(1..))));
    until("its topics", || scanhub_shm::sensors(&place.domain).is_ok_and(|sensors| !sensors.is_empty()));
    hub.kill(&place);
    let timeout = Duration::from_millis(50);
    let mut scans =
        Subscriber::<Scan>::builder("front").in_domain(&place.domain).timeout(timeout).open().unwrap();
    assert!(scans.next().unwrap().is_none() && !scans.hub_is_running());
    let hub = Hub::start(&place, 2);
    // It looks for a hub all the time, so it may come while the hub starts.
    let mut is_heard = false;
    let mut hear = || {
        is_heard |= scans.next().unwrap().is_some_and(|scan| scan.header().boot == 2 && !scan.restarted);
        is_heard
    };
    let pid = hub.0.id();
    until("the second hub", || hear() || holder(place.domain.root()) == Ok(Some(pid)));
    until("a scan of the second hub", hear);
}

#[test]
fn the_numbers_of_a_network_go_on_over_lives_of_a_hub() {
    let place = Place::new();
    let mut hub = FakeHub::new(&place.domain, &["front"], 1);
    let mut scans = Subscriber::<Scan>::builder("front").in_domain(&place.domain).open().unwrap();
    assert!(scans.try_next().unwrap().is_none());
    hub.front().flags = scanhub_schema::Flags::REMOTE;
    let mut missed = |hub: &mut FakeHub, boot: u64, topic_seq: u64| {
        (hub.front().boot, hub.front().scan.topic_seq) = (boot, topic_seq);
        hub.front().scan(&[1000; 181]);
        let scan = scans.next().unwrap().expect("without a timeout");
        (scan.missed, scan.restarted)
    };
    assert_eq!(missed(&mut hub, 11, 40), (0, false), "the first one");
    assert_eq!(missed(&mut hub, 11, 44), (3, false));
    assert_eq!(missed(&mut hub, 12, 45), (0, true));
    assert_eq!(missed(&mut hub, 12, 47), (1, false));
}
