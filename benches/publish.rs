//! CPU time that the hub's thread needs to publish a scan, from the loan to the wake-up of the subscribers. There are 0
//! to 200 subscribers that are awake, asleep on the doorbell, or asleep on the event. Publishing is measured as CPU
//! time of the publishing thread, which includes about 0.3 us for reading the clock. It excludes the CPU time of
//! subscribers. The bench also measures two costs of datagrams: packing and sealing, and reading and checking.
//!
//! Subscribers that are awake keep the memory in the cache. The other subscribers sleep for a millisecond between two
//! scans.

#![allow(missing_docs)] // The macros of criterion create public functions.

#[path = "support/mod.rs"]
mod support;

use std::hint::black_box;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::datagram::{Datagram, DatagramPayload, HEADER_LEN, Head, MTU_ETHERNET};
use scanhub_schema::{DoorbellWord, Foreground, Marks, Scan, Topic, Zones};
use scanhub_shm::{Doorbell, Node, Payload};
use support::environment::{BenchEnvironment, STEP_TIMEOUT};
use support::source::{self, SENSOR, ScanSource};
use support::{Outcome, clock};

/// The way in which subscribers wait for samples.
#[derive(Clone, Copy, PartialEq)]
enum WaitMethod {
    Awake,
    Doorbell,
    Event,
}

fn publish(c: &mut Criterion) {
    BenchEnvironment::remove_leftovers().expect("the temporary directory can be read");
    let mut group = c.benchmark_group("publish a scan");
    group.sample_size(10).warm_up_time(Duration::from_millis(500)).measurement_time(Duration::from_secs(2));
    for (name, rest) in [
        ("awake", WaitMethod::Awake),
        ("asleep at the bell", WaitMethod::Doorbell),
        ("asleep at the event", WaitMethod::Event),
    ] {
        for count in SUBSCRIBER_COUNTS.into_iter().filter(|count| *count > 0 || rest == WaitMethod::Awake) {
            let environment = BenchEnvironment::new().expect("a bench environment");
            let mut source = ScanSource::open(&environment.domain).expect("a publisher");
            let node = scanhub_shm::client_node(&environment.domain).expect("a node");
            let crowd = SubscriberThreads::default();
            thread::scope(|scope| {
                let _end = EndOnDrop(&crowd);
                if rest != WaitMethod::Awake {
                    for _ in 0..count {
                        scope.spawn(|| {
                            run_subscriber(&node, rest, &crowd).unwrap_or_else(|error| eprintln!("{error}"))
                        });
                    }
                    wait_until(|| crowd.ready.load(Ordering::Acquire) == count);
                }
                let awake: Vec<_> = (0..if rest == WaitMethod::Awake { count } else { 0 })
                    .map(|_| subscriber(&node).expect("a free slot"))
                    .collect();
                let mut sent = 0;
                group.bench_function(BenchmarkId::new(name, count), |b| {
                    b.iter_custom(|times| {
                        let mut busy = Duration::ZERO;
                        for _ in 0..times {
                            let before = cpu_time();
                            source.publish(0).expect("a published sample");
                            busy += cpu_time() - before;
                            sent += 1;
                            for subscriber in &awake {
                                assert!(matches!(Scan::receive(subscriber), Ok(Some(_))), "a scan for each");
                            }
                            if rest != WaitMethod::Awake {
                                wait_until(|| crowd.received.load(Ordering::Acquire) >= sent * count);
                                // Real scans follow each other with a pause, so wait until the last subscriber sleeps
                                // again.
                                thread::sleep(SCAN_INTERVAL);
                            }
                        }
                        busy
                    });
                });
            });
        }
    }
    group.finish();
}

/// State that the bench and the threads of the subscribers share.
#[derive(Default)]
struct SubscriberThreads {
    ready: AtomicU64,
    received: AtomicU64,
    should_end: AtomicBool,
}

/// Ends the subscribers when it is dropped, however the bench ends. The subscribers check its flag at least every
/// [`END_POLL_INTERVAL`].
struct EndOnDrop<'a>(&'a SubscriberThreads);

impl Drop for EndOnDrop<'_> {
    fn drop(&mut self) {
        self.0.should_end.store(true, Ordering::Release);
    }
}

fn run_subscriber(node: &Node, wait_method: WaitMethod, threads: &SubscriberThreads) -> Outcome<()> {
    let subscriber = subscriber(node)?;
    let doorbell = Doorbell::open(node, SENSOR)?.ok_or("no doorbell")?;
    let listener = match wait_method {
        WaitMethod::Event => {
            Some(scanhub_shm::listener(node, &scanhub_shm::open_wake(node, SENSOR)?.ok_or("no event")?)?)
        }
        WaitMethod::Awake | WaitMethod::Doorbell => None,
    };
    threads.ready.fetch_add(1, Ordering::Release);
    while !threads.should_end.load(Ordering::Acquire) {
        let ring_count = doorbell.ring_count(DoorbellWord::First);
        if let Some(listener) = &listener {
            scanhub_shm::take_wakeups(&[listener])?;
        }
        while Scan::receive(&subscriber).map_err(|error| format!("{error:?}"))?.is_some() {
            threads.received.fetch_add(1, Ordering::Release);
        }
        match &listener {
            Some(listener) => scanhub_shm::sleep(&[listener], END_POLL_INTERVAL)?,
            None => scanhub_shm::wait_on_doorbells(
                &[(&doorbell, DoorbellWord::First, ring_count)],
                clock::now() + END_POLL_INTERVAL.as_nanos() as u64,
            )
            .map_err(|_| "no doorbells on this system")?,
        }
    }
    Ok(())
}

fn subscriber(node: &Node) -> Outcome<scanhub_shm::Subscriber<Scan>> {
    let service = Scan::open(node, SENSOR)?.ok_or("no topic")?;
    Ok(Scan::subscriber(node, &service)?)
}

fn wait_until(is_true: impl Fn() -> bool) {
    let give_up_at = Instant::now() + 6 * STEP_TIMEOUT;
    while !is_true() {
        assert!(Instant::now() < give_up_at, "the subscribers do not continue");
        thread::sleep(Duration::from_micros(100));
    }
}

fn cpu_time() -> Duration {
    let used = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(used.tv_sec as u64, used.tv_nsec as u32)
}

fn datagram(c: &mut Criterion) {
    let mut group = c.benchmark_group("datagram");
    payload(&mut group, Topic::Scan, &*source::scan());
    payload(&mut group, Topic::Zones, &Zones::unknown());
    payload(&mut group, Topic::Marks, &Marks::default());
    payload(&mut group, Topic::Foreground, &*Foreground::of(361));
    group.finish();
}

type Group<'a> = criterion::BenchmarkGroup<'a, criterion::measurement::WallTime>;

fn payload<P: DatagramPayload + ?Sized>(group: &mut Group<'_>, topic: Topic, sent: &P)
where
    Box<P>: Default,
{
    let head = Head { topic: topic.number(), revision: 1, ..Head::default() };
    let mut buffer = [0; MTU_ETHERNET];
    group.bench_function(format!("{}, pack and seal", topic.name()), |b| {
        b.iter(|| {
            let len = black_box(sent).pack(&mut buffer[HEADER_LEN..]).expect("a buffer that is large enough");
            black_box(head.seal(&mut buffer, len).expect("a buffer that is large enough"));
        });
    });
    let len = sent.pack(&mut buffer[HEADER_LEN..]).expect("a buffer that is large enough");
    let sealed = head.seal(&mut buffer, len).expect("a buffer that is large enough").to_vec();
    let mut received = Box::default();
    group.bench_function(format!("{}, read, check and unpack", topic.name()), |b| {
        b.iter(|| {
            let datagram = Datagram::read(black_box(&sealed)).expect("an intact datagram");
            assert!(P::unpack_into(&mut received, datagram.payload));
            black_box(&mut received);
        });
    });
}

const SUBSCRIBER_COUNTS: [u64; 6] = [0, 1, 4, 16, 64, 200];
/// Pause between two scans, in which all subscribers go to sleep. The time between two scans of a real sensor is 26
/// times as long as this pause.
const SCAN_INTERVAL: Duration = Duration::from_millis(1);
/// Interval at which subscribers check whether the bench has ended.
const END_POLL_INTERVAL: Duration = Duration::from_millis(500);

criterion_group!(benches, publish, datagram);
criterion_main!(benches);
