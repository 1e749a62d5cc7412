//! What the way through a graph of ROS 2 costs: how long a scan takes from shared memory until a plain Zenoh subscriber has
//! decoded it, beside the same bytes from a plain Zenoh publisher in the same run; how many come; how busy the bridge is.
//!
//! `cargo bench -p scanhub-bridge --bench ros2 [-- SECONDS]` (default 20), with `cargo build --release` before it.

use std::collections::HashMap;
use std::fs::{self, DirBuilder};
use std::net::TcpListener;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use ros::{LASER_SCAN, read};
use scanhub_client::streams::{Sample, Session, Source};
use scanhub_client::{Domain, Topic, clock};
use zenoh::{Config, Wait};

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A program in the domain of the bench.
fn start(program: &Path, root: &Path, arguments: &[&str]) -> Running {
    let mut command = Command::new(program);
    command.args(arguments).args(["--domain", "bench", "--root"]).arg(root).env("STATE_DIRECTORY", root);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    Running(command.spawn().unwrap_or_else(|error| panic!("{}: {error}", program.display())))
}

/// Processor time of a process so far, in clock ticks of a hundredth of a second.
fn ticks(process: u32) -> u64 {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    let after_name = stat.rsplit(") ").next().unwrap_or_default();
    after_name.split(' ').skip(11).take(2).filter_map(|number| number.parse::<u64>().ok()).sum()
}

fn session(port: u16) -> zenoh::Session {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"tcp/127.0.0.1:{port}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("a key of Zenoh");
    }
    zenoh::open(config).wait().expect("a session")
}

fn percentile(values: &mut [u64], share: f64) -> f64 {
    values.sort_unstable();
    let place = ((values.len() as f64 - 1.0) * share).max(0.0) as usize;
    values.get(place).map_or(f64::NAN, |&ns| ns as f64 / 1e3)
}

/// Ages of what arrived, in ns.
type Ages = Arc<Mutex<Vec<u64>>>;

fn main() {
    let seconds = std::env::args().skip(1).find_map(|word| word.parse().ok()).unwrap_or(20);
    let bridge = Path::new(env!("CARGO_BIN_EXE_scanhub-bridge"));
    let scanhub = bridge.with_file_name("scanhub");
    if !scanhub.is_file() {
        return eprintln!("{} is not there: cargo build --release", scanhub.display());
    }
    let place = std::env::temp_dir().join(format!("scanhub-bench-ros2-{}", std::process::id()));
    DirBuilder::new().mode(0o700).create(&place).expect("a new directory");
    measure(&place, &scanhub, bridge, Duration::from_secs(seconds));
    let _ = fs::remove_dir_all(&place);
}

fn measure(place: &Path, scanhub: &Path, bridge: &Path, run_for: Duration) {
    let root: PathBuf = place.join("root");
    DirBuilder::new().mode(0o700).create(&root).expect("a new directory");
    let [front, rear] = ["front", "rear"].map(|name| place.join(name).display().to_string());
    let port = TcpListener::bind("127.0.0.1:0").and_then(|it| it.local_addr()).expect("a port").port();
    let _simulator = start(scanhub, &root, &["simulate", "--port", &front, "--port", &rear, "--baud=500000"]);
    let [front, rear] = [format!("front={front}"), format!("rear={rear}")];
    let _hub = start(scanhub, &root, &["run", "--link", &front, "--link", &rear]);
    let bridge =
        start(bridge, &root, &[&format!("--listen=tcp/127.0.0.1:{port}"), "--ros2", "--domain-id=42"]);

    let places = vec![Domain::at("bench", &root).expect("a name")];
    let mut memory = Session::new(places);
    let mut sources = [Source::new("front", Topic::Scan), Source::new("rear", Topic::Scan)];
    let begun = Instant::now();
    while !sources.iter().all(|source| source.subscribed()) {
        assert!(begun.elapsed() < Duration::from_secs(30), "no scans");
        memory.look().expect("a domain");
        sources.iter_mut().for_each(|source| drop(source.receive(&mut memory)));
        memory.wait_for(Some(Duration::from_millis(20))).expect("to wait");
    }

    // By the stamp of a message: when its scan was in shared memory, on CLOCK_MONOTONIC.
    let sent: Arc<Mutex<HashMap<(bool, u64), u64>>> = Arc::default();
    let (through, plain): (Ages, Ages) = Default::default();
    let (listener, speaker) = (session(port), session(port));
    let (known, ages) = (sent.clone(), through.clone());
    let _decoded = listener
        .declare_subscriber("42/*/scan/**")
        .callback(move |sample| {
            let scan = read(&LASER_SCAN, &sample.payload().to_bytes()).expect("a scan");
            let now_ns = clock::now_ns();
            let [sec, nanosec] = ["sec", "nanosec"]
                .map(|part| scan.number(&format!("header.stamp.{part}")).unwrap_or_default());
            let is_front = scan.text("header.frame_id") == Some("front");
            let stamp_ns = sec as u64 * 1_000_000_000 + nanosec as u64;
            // The thread that looks at shared memory may be the later one.
            let found = (0..50).find_map(|_| {
                let found = known.lock().expect("no panic").remove(&(is_front, stamp_ns));
                found.or_else(|| {
                    thread::sleep(Duration::from_micros(100));
                    None
                })
            });
            if let Some(sent_ns) = found {
                ages.lock().expect("no panic").push(now_ns.saturating_sub(sent_ns));
            }
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

    let (begun, before) = (Instant::now(), ticks(bridge.0.id()));
    let mut count = 0;
    let mut message = Vec::new();
    while begun.elapsed() < run_for {
        memory.look().expect("a domain");
        for source in &mut sources {
            while let Some(sample) = source.receive(&mut memory).expect("a sample") {
                let Sample::Scan(scan) = &sample else { continue };
                let header = *scan.header();
                let is_front = header.sensor == 0;
                let stamp_ns = header.wall_ns.saturating_add_signed(scan.beam_ns(0));
                let sent_ns = header.stamp_last_ns + header.hub_time_ns().unwrap_or_default();
                sent.lock().expect("no panic").insert((is_front, stamp_ns), sent_ns);
                count += 1;
                message.clear();
                ros::laser_scan(&mut message, "front", &header, scan);
                let now_ns = clock::now_ns().to_le_bytes();
                publisher.put(&message[..]).attachment(&now_ns[..]).wait().expect("to send");
            }
        }
        memory.wait_for(Some(Duration::from_millis(5))).expect("to wait");
    }
    let (elapsed, busy) = (begun.elapsed(), ticks(bridge.0.id()) - before);
    thread::sleep(Duration::from_millis(200));
    let [mut through, mut plain] = [through, plain].map(|ages| ages.lock().expect("no panic").clone());
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
    println!("processor time of the bridge: {:.2} % of a core", busy as f64 / elapsed.as_secs_f64());
}
