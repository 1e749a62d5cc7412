//! How long a scan takes from shared memory over a router to a plain client, beside the same bytes of a plain publisher over
//! the same router in the same run.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::{Topic, clock};
use schema::datagram::{Datagram, HEAD, Head};
use zenoh::Wait;

use crate::stage::{SENSORS, Stage, Times, free_port, listened, percentile, session};
use crate::{Row, row};

/// Runs, and how long each is.
const RUNS: usize = 5;
const RUN: Duration = Duration::from_secs(10);

pub(crate) fn rows(stage: &Stage) -> Vec<Row> {
    let (robot, between) = (stage.machine("robot"), stage.machine("router"));
    let at = free_port();
    let _router = between.bridge(&[&format!("--listen=tcp/{at}")]);
    listened(at);
    let _hub = robot.robot();
    let _bridge = robot.bridge(&[&format!("--connect=tcp/{at}")]);
    let (mut memory, mut sources) = robot.follow(SENSORS.map(|sensor| (sensor, Topic::Scan)));

    // By sensor and the number of the telegram: when a scan was in shared memory, on CLOCK_MONOTONIC.
    let mut sent: HashMap<(u8, u32), u64> = HashMap::new();
    let (through, plain): (Arc<Mutex<Vec<_>>>, Times) = Default::default();
    let (listener, speaker) = (session(at), session(at));
    let arrivals = through.clone();
    let _ours = listener
        .declare_subscriber("scanhub/*/*/scan")
        .callback(move |sample| {
            let now_ns = clock::now_ns();
            let bytes = sample.payload().to_bytes();
            let head = Datagram::read(&bytes).expect("a datagram").head;
            arrivals.lock().expect("no panic").push(((head.sensor, head.counter), now_ns));
        })
        .wait()
        .expect("a subscriber");
    let ages = plain.clone();
    let _bare = listener
        .declare_subscriber("bare/scan")
        .callback(move |sample| {
            let now_ns = clock::now_ns();
            let bytes = sample.payload().to_bytes();
            let sent_ns = Datagram::read(&bytes).expect("a datagram").head.stamp_ns;
            ages.lock().expect("no panic").push(now_ns.saturating_sub(sent_ns));
        })
        .wait()
        .expect("a subscriber");
    let publisher = speaker.declare_publisher("bare/scan").express(true).wait().expect("a publisher");
    thread::sleep(Duration::from_secs(1));

    let mut pairs = Vec::new();
    let mut buffer = vec![0; HEAD + usize::from(u16::MAX)];
    for _ in 0..RUNS {
        let begun = Instant::now();
        while begun.elapsed() < RUN {
            memory.look().expect("a domain");
            for source in &mut sources {
                while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                    let Some(header) = sample.header().copied() else { continue };
                    let sent_ns = header.stamp_last_ns + header.hub_time_ns().unwrap_or_default();
                    sent.insert((header.sensor, header.seq as u32), sent_ns);
                    let len = sample.pack(&mut buffer[HEAD..]).expect("it fits");
                    let head = Head { topic: Topic::Scan.number(), revision: 1, ..Head::default() };
                    let head = Head { stamp_ns: clock::now_ns(), ..head };
                    let bytes = head.seal(&mut buffer, len).expect("it fits");
                    publisher.put(bytes).wait().expect("to send");
                }
            }
            memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
        }
        thread::sleep(Duration::from_millis(200));
        let ours = std::mem::take(&mut *through.lock().expect("no panic")).into_iter();
        let ours = ours.filter_map(|(key, now_ns): (_, u64)| Some(now_ns.saturating_sub(sent.remove(&key)?)));
        let both = [ours.collect(), std::mem::take(&mut *plain.lock().expect("no panic"))];
        pairs.push(both.map(|mut times: Vec<u64>| [0.5, 0.99].map(|share| percentile(&mut times, share))));
    }
    pairs.sort_by(|a, b| (a[0][0] / a[1][0]).total_cmp(&(b[0][0] / b[1][0])));
    let [ours, theirs] = pairs[RUNS / 2];
    let ratio = |pair: &[[f64; 2]; 2]| pair[0][0] / pair[1][0];
    let times = ratio(&pairs[RUNS / 2]);
    let spread = format!("{:.2} to {:.2}", ratio(&pairs[0]), ratio(&pairs[RUNS - 1]));
    let value = |[p50, p99]: [f64; 2]| format!("p50 {p50:.0} us, p99 {p99:.0} us");
    vec![
        row("shared memory over a router to a plain client", value(ours), None),
        row("plain publisher over the same router to the same client", value(theirs), None),
        row(
            "p50 beside p50, median of five runs",
            format!("{times:.2} times, {spread}"),
            Some(("at most 2", times <= 2.0)),
        ),
    ]
}
