//! Fake hub: it holds the lock of a domain, and publishes the samples that a test sends. Each test has its own domain,
//! which is removed at the end of the test.
#![allow(dead_code)] // Every test file takes what it needs.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{
    Background, Failure, Foreground, Header, Marks, Scan, ScanHead, State, Status, Verdict, WakeEvent, Zones,
};
use scanhub_shm::{
    CallbackProgression, Node, Payload, PortFactory, Publisher, TopicService, UpdateConnections, WakeSender,
};
use scanhub_shm::{Domain, HubLock};
use tempfile::TempDir;

/// Domain that is removed at the end of the test.
pub(crate) struct TestDomain {
    pub(crate) base: PathBuf,
    _directory: TempDir,
    pub(crate) domain: Domain,
}

impl TestDomain {
    pub(crate) fn new() -> TestDomain {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("c{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        // The path in TMPDIR may be too long for the root of a domain.
        let directory = tempfile::Builder::new().prefix("sh").tempdir_in("/tmp").unwrap();
        let base = directory.path().to_owned();
        TestDomain { domain: Domain::at(&name, &base).unwrap(), base, _directory: directory }
    }

    pub(crate) fn locations(&self) -> Vec<Domain> {
        vec![self.domain.clone()]
    }
}

impl Drop for TestDomain {
    fn drop(&mut self) {
        // The node management of a domain outlives its nodes.
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.domain.prefix()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// Publisher of a topic, with its sequence numbers.
pub(crate) struct TopicPort<P: Payload + ?Sized> {
    pub(crate) service: TopicService<P>,
    pub(crate) publisher: Publisher<P>,
    pub(crate) topic_seq: u64,
}

impl<P: Payload + ?Sized> TopicPort<P> {
    fn new(node: &Node, sensor: &str) -> TopicPort<P> {
        let limits = TopicLimits::default();
        let service = P::create(node, sensor, &limits).unwrap();
        TopicPort { publisher: P::publisher(&service, &limits).unwrap(), service, topic_seq: 0 }
    }

    /// Waits until the next sample reaches `count` subscribers.
    pub(crate) fn await_subscribers(&self, count: usize) {
        wait_until("subscribers", || self.subscribers() == count);
    }

    /// Returns the number of subscribers that the next sample reaches. The number that the service itself returns is
    /// not used. It includes a subscriber that is about to enter the list, and a publisher does not see that subscriber
    /// yet.
    pub(crate) fn subscribers(&self) -> usize {
        let mut count = 0;
        self.service.dynamic_config().list_subscribers(|_| {
            count += 1;
            CallbackProgression::Continue
        });
        count
    }
}

/// Sensor of a fake hub.
pub(crate) struct FakeSensor {
    pub(crate) telegram: TopicPort<[u8]>,
    pub(crate) scan: TopicPort<Scan>,
    pub(crate) marks: TopicPort<Marks>,
    pub(crate) zones: TopicPort<Zones>,
    pub(crate) foreground: TopicPort<Foreground>,
    pub(crate) background: TopicPort<Background>,
    pub(crate) status: TopicPort<Status>,
    pub(crate) waker: WakeSender,
    pub(crate) boot: u64,
    /// Flags of the headers.
    pub(crate) flags: u8,
    pub(crate) seq: u64,
    /// Stamp of the sensor's first telegram, in ns of CLOCK_MONOTONIC. By default, it is long before any subscriber
    /// attaches.
    pub(crate) start_ns: u64,
    /// Period of the scans in us.
    pub(crate) period_us: u32,
}

impl FakeSensor {
    fn header(&mut self, topic_seq: u64) -> Header {
        Header {
            seq: self.seq,
            topic_seq,
            stamp_first_ns: self.start_ns + self.seq,
            stamp_last_ns: self.start_ns + 10_000_000 + self.seq,
            wall_ns: 1_700_000_000_000_000_000 + self.seq,
            boot: self.boot,
            period_us: self.period_us,
            hub_pid: std::process::id(),
            flags: self.flags,
            ..Header::default()
        }
    }

    /// Publishes a scan of these ranges and wakes the subscribers.
    pub(crate) fn publish_scan(&mut self, ranges: &[u16]) {
        let header = self.header(self.scan.topic_seq);
        let head = ScanHead::lms(ranges.len(), -90_000, 500, 10, 13);
        let len = Scan::len(ranges.len(), head.contents);
        let mut sample = Scan::loan(&self.scan.publisher, len).unwrap();
        *sample.user_header_mut() = header;
        Scan::write(&mut sample).begin(head).ranges.copy_from_slice(ranges);
        sample.send().unwrap();
        self.scan.topic_seq += 1;
        self.seq += 1;
        self.waker.wake(WakeEvent::Telegram).unwrap();
    }

    /// Publishes a scan of these ranges with an empty foreground, and wakes the subscribers. The stamp of the wall
    /// clock is `seq` ns after that of the hub's first sample.
    pub(crate) fn publish_scan_with_foreground(&mut self, seq: u64, ranges: &[u16]) {
        self.publish_foreground(seq, ranges.len());
        self.publish_scan(ranges);
    }

    /// Publishes the empty foreground of a scan of `beams`, and wakes no subscriber. The next scan belongs to the same
    /// telegram.
    pub(crate) fn publish_foreground(&mut self, seq: u64, beams: usize) {
        self.seq = seq;
        let header = self.header(self.foreground.topic_seq);
        let mut sample = Foreground::loan(&self.foreground.publisher, Foreground::len(beams)).unwrap();
        *sample.user_header_mut() = header;
        Foreground::write(&mut sample).copy_from(Foreground::of(beams).bytes());
        sample.send().unwrap();
        self.foreground.topic_seq += 1;
    }

    /// Wakes the subscribers.
    pub(crate) fn wake(&self) {
        self.waker.wake(WakeEvent::Telegram).unwrap();
    }

    /// Publishes zones of `verdict` with something at `nearest_mm`, measured just now, and wakes the subscribers.
    pub(crate) fn publish_zones(&mut self, verdict: Verdict, nearest_mm: u32) {
        let now = clock_gettime(ClockId::Monotonic);
        let now_ns = now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64;
        self.publish_zones_at(verdict, nearest_mm, now_ns);
    }

    /// Publishes zones as [`publish_zones`](Self::publish_zones) does, measured at `stamp_ns`.
    pub(crate) fn publish_zones_at(&mut self, verdict: Verdict, nearest_mm: u32, stamp_ns: u64) {
        let header = self.header(self.zones.topic_seq);
        let mut sample = self.zones.publisher.loan().unwrap();
        *sample.user_header_mut() = Header { stamp_first_ns: stamp_ns, stamp_last_ns: stamp_ns, ..header };
        *sample.payload_mut() =
            Zones { verdict: verdict as u8, nearest_beam: 180, nearest_mm, ..Zones::unknown() };
        sample.send().unwrap();
        self.zones.topic_seq += 1;
        self.seq += 1;
        self.waker.wake(WakeEvent::Telegram).unwrap();
    }

    /// Publishes a telegram and wakes the subscribers.
    pub(crate) fn publish_telegram(&mut self, bytes: &[u8]) {
        let header = self.header(self.telegram.topic_seq);
        let mut sample = self.telegram.publisher.loan_slice_uninit(bytes.len()).unwrap();
        *sample.user_header_mut() = header;
        sample.write_from_slice(bytes).send().unwrap();
        self.telegram.topic_seq += 1;
        self.seq += 1;
        self.waker.wake(WakeEvent::Telegram).unwrap();
    }

    /// Publishes a status and wakes the subscribers.
    pub(crate) fn publish_status(&mut self, change: impl FnOnce(&mut Status)) {
        let header = self.header(self.status.topic_seq);
        let mut sample = self.status.publisher.loan().unwrap();
        *sample.user_header_mut() = header;
        let status = sample.payload_mut();
        status.state = State::Streaming as u8;
        change(status);
        sample.send().unwrap();
        self.status.topic_seq += 1;
        self.waker.wake(WakeEvent::Status).unwrap();
    }
}

/// Fake hub.
pub(crate) struct FakeHub {
    pub(crate) sensors: Vec<FakeSensor>,
    _node: Node,
    _lock: HubLock,
}

impl FakeHub {
    pub(crate) fn new(domain: &Domain, sensors: &[&str], boot: u64) -> FakeHub {
        let lock = HubLock::acquire(domain.root()).unwrap();
        let node = scanhub_shm::hub_node(domain).unwrap();
        let sensor = |name: &&str| FakeSensor {
            telegram: TopicPort::new(&node, name),
            scan: TopicPort::new(&node, name),
            marks: TopicPort::new(&node, name),
            zones: TopicPort::new(&node, name),
            foreground: TopicPort::new(&node, name),
            background: TopicPort::new(&node, name),
            status: TopicPort::new(&node, name),
            waker: WakeSender::new(&node, name).unwrap(),
            boot,
            flags: 0,
            seq: 0,
            start_ns: 1_000_000_000,
            period_us: 26_640,
        };
        let sensors = sensors.iter().map(sensor).collect();
        lock.report_ready().unwrap();
        FakeHub { sensors, _node: node, _lock: lock }
    }

    pub(crate) fn front_sensor(&mut self) -> &mut FakeSensor {
        &mut self.sensors[0]
    }

    /// Sends the last status to late joiners until `is_done` returns true.
    pub(crate) fn serve_history(&self, is_done: impl Fn() -> bool) {
        wait_until("history taken", || {
            for sensor in &self.sensors {
                sensor.status.publisher.update_connections().unwrap();
            }
            is_done()
        });
    }
}

/// Verb that runs in its own thread, and its output so far.
pub(crate) struct RunningVerb {
    pub(crate) out: OutputFile,
    pub(crate) notes: OutputFile,
    pub(crate) stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<(), Failure>>,
}

impl RunningVerb {
    /// Starts `verb` with its standard output, its standard error and the flag that ends it.
    pub(crate) fn start(
        verb: impl FnOnce(File, File, Arc<AtomicBool>) -> Result<(), Failure> + Send + 'static,
    ) -> RunningVerb {
        let (out, notes, stop) = (OutputFile::new(), OutputFile::new(), Arc::new(AtomicBool::new(false)));
        let (to, notes_file, flag) = (out.file(), notes.file(), stop.clone());
        let thread = std::thread::spawn(move || verb(to, notes_file, flag));
        RunningVerb { out, notes, stop, thread }
    }

    pub(crate) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    pub(crate) fn finished(&self) -> bool {
        self.thread.is_finished()
    }

    /// Waits for the end of the verb. Returns its result, its standard output and its standard error.
    pub(crate) fn join(self) -> (Result<(), Failure>, String, String) {
        wait_until("the verb's end", || self.thread.is_finished());
        (self.thread.join().unwrap(), self.out.text(), self.notes.text())
    }
}

/// File without a name that a verb writes to. A test reads it at the same time.
pub(crate) struct OutputFile(File);

impl OutputFile {
    pub(crate) fn new() -> OutputFile {
        OutputFile(tempfile::tempfile().unwrap())
    }

    /// Returns the file for the verb, which writes at the end of the file.
    pub(crate) fn file(&self) -> File {
        self.0.try_clone().unwrap()
    }

    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.0.metadata().unwrap().len() as usize];
        self.0.read_exact_at(&mut bytes, 0).unwrap();
        bytes
    }

    pub(crate) fn text(&self) -> String {
        String::from_utf8(self.bytes()).unwrap()
    }

    /// Waits until `count` lines contain `text`.
    pub(crate) fn await_lines(&self, text: &str, count: usize) {
        wait_until(text, || self.text().lines().filter(|line| line.contains(text)).count() >= count);
    }
}

/// Waits until `is_done` returns true. Only a hang exceeds the limit of 180 s.
pub(crate) fn wait_until(description: &str, mut is_done: impl FnMut() -> bool) {
    let give_up_at = Instant::now() + Duration::from_secs(180);
    while !is_done() {
        assert!(Instant::now() < give_up_at, "timed out waiting for {description}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
