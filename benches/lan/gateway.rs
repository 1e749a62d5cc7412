//! Latency and CPU time of the gateway per datagram, and the maximum number of datagrams that the gateway can send per
//! second.

use std::io::Read;
use std::net::UdpSocket;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use rustix::event::{EventfdFlags, eventfd};
use rustix::process::{Signal, set_parent_process_death_signal};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Datagram, DatagramPayload, HEADER_LEN};

use crate::support::environment::{BenchEnvironment, GuardedProcess, SENSORS, STEP_TIMEOUT};
use crate::support::figures::{Figure, Target, percentile};
use crate::support::source::{self, SENSOR, ScanSource};
use crate::support::usage::ThreadUsage;
use crate::support::{Outcome, clock};
use crate::wire::{self, has_topic, number};

/// Number of samples in a run.
const SAMPLE_COUNT: usize = 800;
/// Number of samples at the start of a run whose ages do not count.
const SKIPPED_SAMPLES: usize = 80;
/// Period of the samples, in nanoseconds. Two sensors at 37.5 Hz send a sample every 13 ms. The period is shorter here,
/// so that the runs are short.
const PERIOD_NS: u64 = 7_000_000;
/// Position of the sequence number in the header of a datagram.
const NUMBER_FIELD: std::ops::Range<usize> = 20..24;
/// Arguments with which this program is the sender of a baseline run.
pub(crate) const SENDER_PART: [&str; 2] = ["part", "sender"];

/// Measures p50 and p99 of the time from shared memory to a receiving program on the loopback. The runs of the gateway
/// alternate with runs of a baseline. The baseline is a process that sends a datagram of the same length whenever an
/// eventfd is signaled.
pub(crate) fn latency(pairs: usize) -> Outcome<Vec<Figure>> {
    let (mut hub, mut baseline): (Vec<Run>, Vec<Run>) = Default::default();
    for pair in 0..pairs {
        if pair % 2 == 0 {
            hub.push(gateway_run()?);
            baseline.push(baseline_run()?);
        } else {
            baseline.push(baseline_run()?);
            hub.push(gateway_run()?);
        }
    }
    let figure = |name, part| {
        let at = |runs: &[Run]| runs.iter().filter_map(|(ages, _)| percentile(ages, part)).collect();
        Figure { name, unit: "us", hub: at(&hub), baseline: at(&baseline), target: Target::Ratio(1.5) }
    };
    let absent = |runs: &[Run]| runs.iter().map(|(_, absent)| *absent).collect();
    let (hub, baseline) = (absent(&hub), absent(&baseline));
    let absent = Figure { name: "latency: lost", unit: "1", hub, baseline, target: Target::None };
    Ok(vec![figure("latency: p50", 0.5), figure("latency: p99", 0.99), absent])
}

fn gateway_run() -> Outcome<Run> {
    let environment = BenchEnvironment::new()?;
    let mut source = ScanSource::open(&environment.domain)?;
    let gateway = wire::gateway(&environment, "lo", &[format!("--topic={SENSOR}/scan")])?;
    // Publish until the gateway has found the hub and its sensor.
    let attached = clock::now() + ATTACH_TIMEOUT_NS;
    while clock::now() < attached {
        clock::sleep_until(clock::now() + PERIOD_NS);
        source.publish(wall_ns())?;
    }
    let application = Application::start(|bytes| {
        let datagram = Datagram::read(bytes).ok()?;
        (datagram.head.topic == Topic::Scan.number()).then_some(datagram.head.stamp_ns)
    })?;
    paced(|| source.publish(wall_ns()))?;
    drop(gateway.end()?);
    application.end()
}

fn baseline_run() -> Outcome<Run> {
    let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
    let stamps: Arc<[AtomicU64]> = (0..SKIPPED_SAMPLES + SAMPLE_COUNT).map(|_| AtomicU64::new(0)).collect();
    let theirs = stamps.clone();
    let application = Application::start(move |bytes| {
        let number = u32::from_le_bytes(bytes.get(NUMBER_FIELD)?.try_into().ok()?);
        Some(theirs.get(number as usize)?.load(Ordering::Acquire))
    })?;
    let mut command = Command::new(std::env::current_exe()?);
    let mut sender = command.args(SENDER_PART).stdin(wake.try_clone()?).stdout(Stdio::piped()).spawn()?;
    let stdout = sender.stdout.take();
    let sender = GuardedProcess::new(sender);
    stdout.ok_or("no pipe")?.read_exact(&mut [0; 1])?;
    let mut next = stamps.iter();
    paced(|| {
        next.next().ok_or("more samples than stamps")?.store(wall_ns(), Ordering::Release);
        rustix::io::write(&wake, &1u64.to_ne_bytes())?;
        Ok(())
    })?;
    sender.wait()?;
    application.end()
}

/// Runs the process that sends the datagrams in a run of the baseline. Its stdin is an eventfd. Each time the eventfd
/// is signaled, the process sends a datagram with the next number.
pub(crate) fn run_sender() -> Outcome<()> {
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let socket = wire::sender()?;
    let mut datagram = vec![0; HEADER_LEN + source::scan().pack(&mut [0; 2048]).unwrap_or_default()];
    println!("ready");
    let mut numbers = 0..(SKIPPED_SAMPLES + SAMPLE_COUNT) as u32;
    while !numbers.is_empty() {
        let mut count = [0; 8];
        rustix::io::read(rustix::stdio::stdin(), &mut count)?;
        // If this process is late, the count is greater than one.
        for number in numbers.by_ref().take(u64::from_ne_bytes(count) as usize) {
            datagram[NUMBER_FIELD].copy_from_slice(&number.to_le_bytes());
            socket.send_to(&datagram, wire::address(Topic::Scan))?;
        }
    }
    Ok(())
}

/// Ages of the received datagrams in microseconds, sorted, and the number of datagrams that did not arrive.
type Run = (Vec<f64>, f64);

/// A thread that collects the ages of datagrams.
struct Application {
    /// Whether all datagrams have been sent.
    is_finished: Arc<AtomicBool>,
    thread: JoinHandle<Vec<u64>>,
}

impl Application {
    /// Starts the thread. `stamp` returns the time at which a datagram was created, in nanoseconds, or `None` for
    /// datagrams that do not count.
    fn start(stamp: impl Fn(&[u8]) -> Option<u64> + Send + 'static) -> Outcome<Application> {
        let (socket, is_finished) = (wire::receiver()?, Arc::new(AtomicBool::new(false)));
        let flag = is_finished.clone();
        let thread = thread::spawn(move || {
            let (mut ages, mut bytes) = (Vec::with_capacity(SKIPPED_SAMPLES + SAMPLE_COUNT), [0; 2048]);
            loop {
                match socket.recv(&mut bytes) {
                    Ok(len) => {
                        ages.extend(stamp(&bytes[..len]).map(|stamp_ns| wall_ns().saturating_sub(stamp_ns)));
                    }
                    Err(_) if flag.load(Ordering::Relaxed) => return ages,
                    Err(_) => {}
                }
            }
        });
        Ok(Application { is_finished, thread })
    }

    /// Ends the thread, and returns the results of the run. Datagrams may be missing, because a hub does not wait for a
    /// gateway that is not scheduled.
    fn end(self) -> Outcome<Run> {
        self.is_finished.store(true, Ordering::Relaxed);
        let ages = self.thread.join().map_err(|_| "the application panicked")?;
        let absent = (SKIPPED_SAMPLES + SAMPLE_COUNT).saturating_sub(ages.len()) as f64;
        let mut ages: Vec<_> = ages.iter().skip(SKIPPED_SAMPLES).map(|&age| age as f64 / 1e3).collect();
        ages.sort_by(f64::total_cmp);
        Ok((ages, absent))
    }
}

fn paced(mut signal: impl FnMut() -> Outcome<()>) -> Outcome<()> {
    let begin = clock::now();
    (0..(SKIPPED_SAMPLES + SAMPLE_COUNT) as u64).try_for_each(|n| {
        clock::sleep_until(begin + n * PERIOD_NS);
        signal()
    })
}

fn wall_ns() -> u64 {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    now.unwrap_or(Duration::ZERO).as_nanos() as u64
}

/// Time after which the gateway has certainly found a hub that has just started, in nanoseconds.
const ATTACH_TIMEOUT_NS: u64 = 6_000_000_000;

const MEASURE_TIME: Duration = Duration::from_secs(8);
/// Duration equal to [`ATTACH_TIMEOUT_NS`].
const ATTACH_TIMEOUT: Duration = Duration::from_secs(6);
const UNPACED_TIME: Duration = Duration::from_secs(3);
/// Name of the thread that runs the baseline of the CPU time.
const BASELINE_THREAD: &str = "bare";
/// Maximum time between two datagrams that the baseline sends without a pause, in nanoseconds.
const BURST_NS: u64 = 1_000_000;

/// Time at which a datagram arrived, and the datagram.
type ReceivedDatagram = (u64, Vec<u8>);

/// Measures the gateway's CPU time per datagram for two sensors with all their topics. The baseline is a thread that
/// sends the same datagrams at the same times. Also measures the maximum number of datagrams per second.
pub(crate) fn cpu_time(pairs: usize) -> Outcome<Vec<Figure>> {
    let (mut hub, mut baseline, mut share, mut rate) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    {
        let environment = BenchEnvironment::new()?;
        let _simulator = environment.simulate(&SENSORS, 500_000)?;
        let running = environment.start_hub(&SENSORS)?;
        running.wait_for_line("ready", STEP_TIMEOUT)?;
        for _ in 0..pairs {
            let (busy_ns, received) = gateway_cpu_time(&environment)?;
            hub.push(busy_ns / 1e3 / received.len() as f64);
            share.push(busy_ns / MEASURE_TIME.as_nanos() as f64 * 100.0);
            rate.push(received.len() as f64 / MEASURE_TIME.as_secs_f64());
            baseline.push(baseline_cpu_time(&received)? / 1e3 / received.len() as f64);
        }
    }
    let (mut maximum, mut bare) = (Vec::new(), Vec::new());
    for _ in 0..pairs {
        maximum.push(max_rate_of_gateway()?);
        bare.push(max_rate_of_baseline()?);
    }
    let figure = |name, unit, hub, baseline, target| Figure { name, unit, hub, baseline, target };
    Ok(vec![
        figure("gateway: CPU time, datagram", "us", hub, baseline, Target::Ratio(2.0)),
        figure("gateway: share of one core", "%", share, Vec::new(), Target::None),
        figure("gateway: datagrams a second", "1", rate, Vec::new(), Target::None),
        figure("gateway: maximum of scans a second", "1", maximum, bare, Target::None),
    ])
}

/// Returns the gateway's CPU time in nanoseconds, and the datagrams that the gateway sent in this time.
fn gateway_cpu_time(environment: &BenchEnvironment) -> Outcome<(f64, Vec<ReceivedDatagram>)> {
    let gateway = wire::gateway(environment, "lo", &wire::all_topics())?;
    thread::sleep(ATTACH_TIMEOUT);
    let (stop, socket) = (Arc::new(AtomicBool::new(false)), wire::receiver()?);
    let flag = stop.clone();
    let before = ThreadUsage::of(gateway.pid(), |_| true)?;
    let listening = thread::spawn(move || receive(&socket, &flag));
    thread::sleep(MEASURE_TIME);
    let busy_ns = ThreadUsage::of(gateway.pid(), |_| true)?.since(before).busy_ns;
    stop.store(true, Ordering::Relaxed);
    let received = listening.join().map_err(|_| "a listener panicked")?;
    drop(gateway.end()?);
    Ok((busy_ns as f64, received))
}

/// Returns the CPU time of a thread that sends the datagrams in `received` again, while another thread receives them.
fn baseline_cpu_time(received: &[ReceivedDatagram]) -> Outcome<f64> {
    let (stop, socket, to_groups) = (Arc::new(AtomicBool::new(false)), wire::receiver()?, wire::sender()?);
    let flag = stop.clone();
    let listening = thread::spawn(move || receive(&socket, &flag));
    let datagrams = received.to_vec();
    let (before, at_end) = thread::Builder::new()
        .name(BASELINE_THREAD.into())
        .spawn(move || -> Result<_, String> {
            let own = || {
                ThreadUsage::of(std::process::id(), |name| name == BASELINE_THREAD)
                    .map_err(|error| error.to_string())
            };
            let before = own()?;
            send_repeatedly(&to_groups, &datagrams).map_err(|error| error.to_string())?;
            Ok((before, own()?))
        })?
        .join()
        .map_err(|_| "the sender panicked")??;
    stop.store(true, Ordering::Relaxed);
    listening.join().map_err(|_| "a listener panicked")?;
    Ok(at_end.since(before).busy_ns as f64)
}

fn send_repeatedly(to_groups: &UdpSocket, datagrams: &[ReceivedDatagram]) -> std::io::Result<()> {
    let Some(first_ns) = datagrams.first().map(|(at_ns, _)| *at_ns) else { return Ok(()) };
    let (begin, mut burst_ns) = (clock::now(), first_ns);
    for (at_ns, datagram) in datagrams {
        if at_ns - burst_ns > BURST_NS {
            burst_ns = *at_ns;
            clock::sleep_until(begin + burst_ns - first_ns);
        }
        let topic = Datagram::read(datagram).ok().and_then(|datagram| Topic::of_number(datagram.head.topic));
        to_groups.send_to(datagram, wire::address(topic.unwrap_or(Topic::Status)))?;
    }
    Ok(())
}

fn receive(socket: &UdpSocket, stop: &AtomicBool) -> Vec<ReceivedDatagram> {
    let (mut received, mut bytes) = (Vec::new(), [0; 2048]);
    while !stop.load(Ordering::Relaxed) {
        if let Ok(len) = socket.recv(&mut bytes) {
            received.push((clock::now(), bytes[..len].to_vec()));
        }
    }
    received
}

/// Returns the number of scans per second that the gateway sends if another scan is always available.
fn max_rate_of_gateway() -> Outcome<f64> {
    let environment = BenchEnvironment::new()?;
    let mut source = ScanSource::open(&environment.domain)?;
    let gateway = wire::gateway(&environment, "lo", &[format!("--topic={SENSOR}/scan")])?;
    let begin = Instant::now();
    while begin.elapsed() < ATTACH_TIMEOUT + UNPACED_TIME {
        source.publish(0)?;
    }
    let lines = gateway.end()?;
    let scans: Vec<_> = lines.iter().filter(|(_, line)| has_topic(line, SENSOR, "scan")).collect();
    // Take two lines of statistics from the middle of the run.
    let [.., (from_ns, first), (to_ns, last), _] = scans[..] else { return Err("too few statistics".into()) };
    if number(last, "missed") == number(first, "missed") {
        eprintln!("the gateway could have sent more");
    }
    Ok((number(last, "sent") - number(first, "sent")) as f64 / ((to_ns - from_ns) as f64 / 1e9))
}

/// Returns the number of datagrams per second that a simple loop sends. The datagrams are as long as those of the
/// gateway.
fn max_rate_of_baseline() -> Outcome<f64> {
    let to_groups = wire::sender()?;
    let datagram = vec![0; HEADER_LEN + source::scan().pack(&mut [0; 2048]).unwrap_or_default()];
    let (begin, mut sent) = (Instant::now(), 0u64);
    while begin.elapsed() < UNPACED_TIME {
        to_groups.send_to(&datagram, wire::address(Topic::Scan))?;
        sent += 1;
    }
    Ok(sent as f64 / UNPACED_TIME.as_secs_f64())
}
