//! Tests of a hub that is stopped for a while, as on a suspended machine: after it continues, it publishes the
//! telegrams that the line's buffer could hold, and counts the others as lost. A stopped listener does not report
//! datagrams that arrived meanwhile as new.

use crate::testkit::{
    INT, TERM, TestEnv, TestGateway, bytes_of, hash, in_a_network, is_class, number, wait_until,
};
use rustix::process::Signal;
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::Value;

#[test]
fn resumed_hub_delivers_backlog_with_right_stamps() {
    let env = TestEnv::new();
    let simulator = env.simulator_on_real_lines(&["front"], &["--seed=31", "--baud=500000"]);
    let hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.echo(&["front/telegram", "front/scan", "front/zones", "front/status"]);
    subscriber.await_lines(20, "a telegram", is_class("telegram"));
    let stopped = now_ns();
    hub.signal(Signal::STOP);
    let lost = |env: &TestEnv| env.truth("front").iter().filter(|sent| sent.fault.is_some()).count();
    let before = lost(&env);
    // When 50 telegrams are lost, the line's buffer is full, and more than a second has passed.
    wait_until("telegrams are lost", || lost(&env) > before + 50);
    let continued = now_ns();
    hub.signal(Signal::CONT);
    subscriber.await_lines(60, "a telegram", is_class("telegram"));
    let info = env.await_info("front", |info| number(&info["counters"], "bytes_discarded") > 0);
    assert_eq!((&info["state"], number(&info["counters"], "resyncs")), (&"streaming".into(), 0), "{info}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(INT).exit_code, Some(0));

    let outcome = subscriber.end(INT);
    let lines = outcome.of_class("telegram");
    let got: Vec<String> = lines.iter().map(|line| hash(&bytes_of(line))).collect();
    let truth = env.truth("front");
    let at =
        |hash: &String| truth.iter().position(|sent| sent.hash == *hash).expect("a telegram that was sent");
    let places: Vec<usize> = got.iter().map(at).collect();
    let (Some(&first), Some(&last)) = (places.first(), places.last()) else { panic!("no telegram arrived") };
    assert!(places.is_sorted(), "out of order");
    assert!(places.iter().all(|&place| truth[place].fault.is_none()), "a telegram was not sent intact");
    // The hub publishes the buffered telegrams in a burst that may be too fast for a subscriber. The subscriber then
    // reports how many samples it missed.
    let notices = outcome.of_class("notice");
    let of_telegrams = notices.iter().filter(|line| line["kind"] == "missed" && line["topic"] == "telegram");
    let missed: u64 = of_telegrams.map(|line| number(line, "missed")).sum();
    let intact = truth[first..=last].iter().filter(|sent| sent.fault.is_none()).count();
    assert_eq!(got.len() as u64 + missed, intact as u64, "telegrams are missing");

    let stamps: Vec<u64> = lines.iter().map(|line| number(line, "stamp_ns")).collect();
    assert!(stamps.is_sorted(), "stamps run backwards: {stamps:?}");
    // A telegram that waited has a stamp that is not too new, or a stamp that is marked as estimated. The hub estimates
    // the stamp if the line seems to be silent before the hub has read the whole backlog. This happens if the kernel's
    // own threads have to wait for a processor.
    let is_estimate = |line: &Value| line["flags"].to_string().contains("stamp_estimated");
    let sample = |n: usize| (truth[places[n]].sent_ns, stamps[n], is_estimate(&lines[n]));
    let all: Vec<(u64, u64, bool)> = (0..places.len()).map(sample).collect();
    let waited: Vec<_> = all.iter().filter(|(sent, ..)| (stopped..continued).contains(sent)).collect();
    let are_right = waited.iter().all(|(sent, stamp, is_estimate)| stamp < sent || *is_estimate);
    assert!(waited.len() > 10 && are_right, "{waited:?}");
    // The hub reads the first of these telegrams at once. The stamp of this telegram continues the period of the
    // earlier scans. It is therefore wrong only if the host was already late before the hub was stopped.
    let was_late = all.iter().any(|(sent, stamp, _)| *sent < stopped && stamp >= sent);
    assert!(was_late || waited.first().is_some_and(|(sent, stamp, _)| stamp < sent), "{all:?}");

    // Each scan has a verdict. Additional samples of `zones` report a silence. Between the scans that were buffered,
    // the hub must not report a silence.
    let scans = outcome.of_class("scan");
    let ahead = outcome.of_class("zones").into_iter().filter_map(|line| {
        let scan = scans.iter().find(|scan| scan["seq"] == line["seq"])?;
        let is_verdict = line["verdict"] != "unknown";
        is_verdict.then(|| number(&line, "topic_seq") - number(scan, "topic_seq"))
    });
    let ahead: Vec<u64> = ahead.collect();
    let (Some(first), Some(last)) = (ahead.first(), ahead.last()) else { panic!("no verdict arrived") };
    assert!(last - first < waited.len() as u64 / 2, "{ahead:?} with {} that waited", waited.len());
}

/// Returns the time of CLOCK_MONOTONIC in nanoseconds, which is the clock of stamps and of the simulator's log.
fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[test]
fn datagram_for_a_stopped_listener_keeps_arrival_time() {
    in_a_network("suspended::datagram_for_a_stopped_listener_keeps_arrival_time", || {
        let env = TestEnv::new();
        let mut listener = env.start(&["listen", "--json"]).ready();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 2, "front");
        // Sends a sample to a listener that is stopped for a while. Returns the line that the listener prints, and the
        // range of stamps that are right.
        let mut stop = || {
            listener.signal(Signal::STOP);
            // Wait, because a listener that still runs would receive the datagram at once.
            wait_until("the listener is stopped", || listener.is_stopped());
            let before = now_ns();
            sender.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
            let after = now_ns();
            wait_until("enough time to make a later stamp wrong", || now_ns() > after + 200_000_000);
            listener.signal(Signal::CONT);
            let line = listener.await_line("zones", is_class("zones"));
            // The kernel stamps datagrams with another clock, so allow for a small difference between the clocks.
            (line, before - 1_000_000..after + 100_000_000)
        };
        // After the first socket of the machine has requested stamps, it takes some time until the kernel stamps
        // datagrams.
        wait_until("a stamp of the kernel", || {
            let (line, possible) = stop();
            possible.contains(&number(&line, "stamp_ns"))
        });
        let (line, possible) = stop();
        assert!(possible.contains(&number(&line, "stamp_ns")), "{line} is not of {possible:?}");
        assert_eq!(listener.end(INT).exit_code, Some(0));
    });
}
