//! Benchmark of scans in a ROS 2 graph. The bench measures the time from shared memory until a plain Zenoh subscriber
//! has decoded the scan. It compares this time with the time for the same bytes from a plain Zenoh publisher in the
//! same run. It also counts the scans that arrive, and measures the CPU time of the bridge.
//!
//! `cargo bench -p scanhub-bridge --bench ros2 [-- SECONDS]` (default 20), after `cargo build --release`.

mod environment;

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_client::streams::Sample;
use scanhub_client::{Topic, clock};
use scanhub_ros::{LASER_SCAN, read};
use zenoh::Wait;

use environment::{
    BenchEnvironment, SENSORS, SendTimes, free_port, percentile, session, wait_until_listening,
};

fn main() {
    let seconds = std::env::args().skip(1).find_map(|word| word.parse().ok()).unwrap_or(20);
    if let Some(environment) = BenchEnvironment::new("ros2") {
        measure(&environment, Duration::from_secs(seconds));
    }
}

fn measure(environment: &BenchEnvironment, run_for: Duration) {
    let (robot, between) = (environment.machine("robot"), environment.machine("router"));
    let at = free_port();
    // Both paths go through this router.
    let _router = between.start_bridge(&[&format!("--listen=tcp/{at}")]);
    wait_until_listening(at);
    let _hub = robot.robot();
    let bridge = robot.start_bridge(&[&format!("--connect=tcp/{at}"), "--ros2", "--domain-id=42"]);
    let (mut memory, mut sources) = robot.subscribe(SENSORS.map(|sensor| (sensor, Topic::Scan)));

    // Time on CLOCK_MONOTONIC at which a scan was in shared memory, by sensor and stamp of the message.
    let mut sent: HashMap<(bool, u64), u64> = HashMap::new();
    let (through, plain): (Arc<Mutex<Vec<_>>>, SendTimes) = Default::default();
    let (listener, speaker) = (session(at), session(at));
    let arrivals = through.clone();
    let _decoded = listener
        .declare_subscriber("42/*/scan/**")
        .callback(move |sample| {
            let scan = read(&LASER_SCAN, &sample.payload().to_bytes()).expect("a scan");
            let now_ns = clock::now_ns();
            let [sec, nanosec] = ["sec", "nanosec"]
                .map(|part| scan.number(&format!("header.stamp.{part}")).unwrap_or_default());
            let is_front = scan.text("header.frame_id") == Some("front");
            let stamp_ns = sec as u64 * 1_000_000_000 + nanosec as u64;
            arrivals.lock().expect("no panic").push(((is_front, stamp_ns), now_ns));
        })
        .wait()
        .expect("a subscriber");
    let ages = plain.clone();
    let _bare = listener
        .declare_subscriber("bare/scan")
        .callback(move |sample| {
            read(&LASER_SCAN, &sample.payload().to_bytes()).expect("a scan");
            let now_ns = clock::now_ns();
            let sent_ns = sample.attachment().map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default();
            let sent_ns = u64::from_le_bytes(sent_ns.try_into().expect("eight bytes"));
            ages.lock().expect("no panic").push(now_ns.saturating_sub(sent_ns));
        })
        .wait()
        .expect("a subscriber");
    let publisher = speaker.declare_publisher("bare/scan").express(true).wait().expect("a publisher");
    thread::sleep(Duration::from_secs(1));

    let (started, before) = (Instant::now(), bridge.cpu_ticks());
    let mut count = 0;
    let mut message = Vec::new();
    while started.elapsed() < run_for {
        memory.check_hub().expect("a domain");
        for source in &mut sources {
            while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                let Sample::Scan(scan) = &sample else { continue };
                let header = *scan.header();
                let is_front = header.sensor == 0;
                let stamp_ns = header.wall_ns.saturating_add_signed(scan.beam_ns(0));
                let sent_ns = header.stamp_last_ns + header.hub_time_ns().unwrap_or_default();
                sent.insert((is_front, stamp_ns), sent_ns);
                count += 1;
                message.clear();
                scanhub_ros::laser_scan(&mut message, "front", &header, scan);
                let now_ns = clock::now_ns().to_le_bytes();
                publisher.put(&message[..]).attachment(&now_ns[..]).wait().expect("to send");
            }
        }
        memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
    }
    let (elapsed, busy) = (started.elapsed(), bridge.cpu_ticks() - before);
    thread::sleep(Duration::from_millis(200));
    let mut through: Vec<_> = std::mem::take(&mut *through.lock().expect("no panic"))
        .into_iter()
        .filter_map(|(key, now_ns)| Some(now_ns.saturating_sub(sent.remove(&key)?)))
        .collect();
    let mut plain = std::mem::take(&mut *plain.lock().expect("no panic"));
    let [ours, theirs] =
        [&mut through, &mut plain].map(|ages| [0.5, 0.99].map(|share| percentile(ages, share)));
    println!("{count} scans of two sensors in {:.0} s", elapsed.as_secs_f64());
    println!("decoded {} ({:.2} %)", through.len(), 100.0 * through.len() as f64 / f64::from(count));
    println!("shared memory to decoded: p50 {:.0} us, p99 {:.0} us", ours[0], ours[1]);
    println!(
        "plain publisher to decoded: p50 {:.0} us, p99 {:.0} us; p50 {:.2} times",
        theirs[0],
        theirs[1],
        ours[0] / theirs[0]
    );
    println!("CPU time of the bridge: {:.2} % of a core", busy as f64 / elapsed.as_secs_f64());
}
