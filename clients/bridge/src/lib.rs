//! A bridge that sends the topics of a hub to other machines over Zenoh, and publishes the topics of other machines
//! here. In a LAN, `gateway` and `listen` do the same over UDP. `scanhub_network` decides which samples are sent and
//! accepted, and counts lost samples. Only module `session` uses Zenoh.
#![forbid(unsafe_code)]

mod check;
mod diagnosis;
mod queue;
mod receiving;
mod report;
mod ros2;
mod sending;
mod session;

use std::io::{self, stderr, stdout};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use scanhub_network::lan::outgoing::ANNOUNCEMENT_INTERVAL;
use scanhub_network::now;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::output::{ExitReason, LossyWriter, Output, verb_result};

pub use check::check;
use report::Report;
pub use ros2::Ros2Options;
use sending::{BridgeSender, DatagramSender};
use session::{CheckedConfig, Connection};

/// Options of a bridge.
#[derive(Clone, Debug)]
pub struct BridgeOptions {
    /// Routers to connect to, in Zenoh's notation: `tcp/HOST:PORT`, `tls/HOST:PORT`.
    pub connect: Vec<String>,
    /// Addresses to listen on as a router, in the same notation.
    pub listen: Vec<String>,
    /// Zenoh configuration file.
    pub config: Option<PathBuf>,
    /// Topics to send; `None` if the bridge sends nothing.
    pub send: Option<SendOptions>,
    /// Topics to receive and publish; `None` if the bridge receives nothing.
    pub publish: Option<PublishOptions>,
    /// Topics to publish in a ROS 2 graph; `None` if the bridge is not a ROS 2 node.
    pub ros2: Option<Ros2Options>,
    /// Whether output is JSON lines. The statistics are then written once a second.
    pub json: bool,
}

/// Topics that a bridge sends.
#[derive(Clone, Debug)]
pub struct SendOptions {
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`. With the suffix `:every=N`, only the samples of every Nth telegram are
    /// sent. If the list is empty, the bridge sends the default topics of all sensors, as `scanhub gateway` does.
    pub topics: Vec<String>,
    /// Possible locations of the hub's domain.
    pub locations: Vec<Domain>,
}

/// Topics that a bridge receives and publishes.
#[derive(Clone, Debug)]
pub struct PublishOptions {
    /// Domain in which remote topics are published.
    pub domain: Domain,
    /// Topics to receive, of all sensors.
    pub topics: Vec<Topic>,
    /// `NAME=HUB`: name of a hub. The name replaces the 16 hex digits of the hub.
    pub names: Vec<String>,
    /// Hubs from which topics are received, by 16 hex digits or by a name in `names`. If the list is empty, topics of
    /// all hubs are received.
    pub hubs: Vec<String>,
    /// Limits of the published topics, such as the number of subscribers.
    pub limits: TopicLimits,
    /// Maximum shared memory of all published topics together, in bytes.
    pub memory: u64,
}

/// Runs a bridge until `stop` is set, even while the hub or the network is unavailable. Writes the statistics to stdout
/// at the end and whenever `report_requested` is set. Other messages go to stderr, or to stdout if they are JSON.
///
/// # Errors
///
/// - [`Kind::Configuration`] if neither a router nor an address to listen on is given, or if Zenoh rejects the
///   configuration.
/// - [`Kind::Input`] if the configuration file cannot be read.
/// - [`Kind::Usage`] if a topic does not exist.
/// - [`Kind::DomainHeld`] if another listener publishes in the domain.
/// - [`Kind::NoTopic`] if the first hub has no such sensor.
pub fn bridge(
    options: &BridgeOptions,
    report_requested: &AtomicBool,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let config = CheckedConfig::read(options, now_s())?;
    let mut out = stdout();
    let mut notes = stderr();
    let (mut out, mut notes) = (LossyWriter::new(&mut out, stop), LossyWriter::new(&mut notes, stop));
    let mut report = Report::new(options.json, Output::new(&mut out), Output::new(&mut notes));
    let sending = options.send.as_ref().map(BridgeSender::open).transpose()?;
    let connection = Arc::new(Connection::open(config)?);
    verb_result(run(options, &connection, sending, &mut report, report_requested, stop))
}

/// Interval between announcements, and between reports of the statistics.
const TICK_INTERVAL: Duration = ANNOUNCEMENT_INTERVAL;
/// Time without a router after which the bridge reports that it waits for one.
const REPORT_WAITING_AFTER: Duration = Duration::from_secs(1);
/// Maximum wait for samples of the hub.
const MAX_WAIT: Duration = Duration::from_millis(50);

fn run(
    options: &BridgeOptions,
    connection: &Arc<Connection>,
    mut sending: Option<BridgeSender>,
    report: &mut Report<'_>,
    report_requested: &AtomicBool,
    stop: &AtomicBool,
) -> Result<(), ExitReason> {
    let [report_receiving, report_ros2, is_over] = [(); 3].map(|()| Arc::new(AtomicBool::new(false)));
    let json = options.json;
    let receiving = options.publish.clone().map(|publish| {
        let (connection, report_requested, is_over) =
            (connection.clone(), report_receiving.clone(), is_over.clone());
        spawn("receiving", move || receiving::run(&publish, json, &connection, &report_requested, &is_over))
    });
    let datagrams = sending.as_ref().map(|sending| {
        let (queue, connection, is_over) = (sending.queue().clone(), connection.clone(), is_over.clone());
        spawn("sending", move || {
            queue::send(&queue, &connection, &is_over, |session| DatagramSender::open(session, &queue))
        })
    });
    let ros2 = options.ros2.clone().map(|ros2| {
        let (connection, report_requested, is_over) =
            (connection.clone(), report_ros2.clone(), is_over.clone());
        spawn("ros2", move || ros2::run(&ros2, json, &connection, &report_requested, &is_over))
    });
    let threads =
        (|| Ok::<_, Failure>((receiving.transpose()?, datagrams.transpose()?, ros2.transpose()?)))();
    let end = match &threads {
        Ok((receiving, _, ros2)) => {
            let has_ended = || [receiving, ros2].into_iter().flatten().any(|thread| thread.is_finished());
            let is_done = || stop.load(Ordering::Relaxed) || has_ended();
            run_main_thread(
                options,
                connection,
                &mut sending,
                report,
                report_requested,
                [&report_receiving, &report_ros2],
                &is_done,
            )
        }
        Err(failure) => Err(failure.clone().into()),
    };
    is_over.store(true, Ordering::Relaxed);
    let (receiving, datagrams, ros2) = threads?;
    let join = |thread: JoinHandle<Result<(), ExitReason>>| {
        thread.join().unwrap_or_else(|_| Err(thread_panicked().into()))
    };
    let sent = match (datagrams, &sending) {
        (Some(thread), Some(sending)) => queue::join(thread, sending.queue()),
        _ => Ok(()),
    };
    let received = receiving.map_or(Ok(()), join);
    let graph = ros2.map_or(Ok(()), join);
    connection.close();
    report_counts(options, connection, sending.as_ref(), report)?;
    received.and(graph).and(end).and(Ok(sent?))
}

fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, Failure> {
    thread::Builder::new().name(name.into()).spawn(work).map_err(|error| no_thread(&error))
}

/// Reports the statistics of sent samples, and the number of refused connections. If the bridge publishes, the receiver
/// reports the refused connections once the session is open.
fn report_counts(
    options: &BridgeOptions,
    connection: &Connection,
    sending: Option<&BridgeSender>,
    report: &mut Report<'_>,
) -> Result<(), ExitReason> {
    if let Some(sending) = sending {
        report.write_counters(sending)?;
    }
    match options.publish {
        Some(_) if connection.is_open() => Ok(()),
        _ if !connection.is_open() && connection.refused() == 0 => Ok(()),
        _ => report.refused(connection.refused()),
    }
}

/// Runs the main thread until `is_done` returns true: forwards samples of the hub, and reports connections and
/// statistics.
fn run_main_thread(
    options: &BridgeOptions,
    connection: &Connection,
    sending: &mut Option<BridgeSender>,
    report: &mut Report<'_>,
    report_requested: &AtomicBool,
    report_others: [&Arc<AtomicBool>; 2],
    is_done: &impl Fn() -> bool,
) -> Result<(), ExitReason> {
    let mut tick_at = Instant::now();
    let (mut wait_until, mut is_ready) = (Some(tick_at + REPORT_WAITING_AFTER), false);
    while !is_done() {
        let more = match sending {
            Some(sending) => sending.forward(report)?,
            None => false,
        };
        if !is_ready && connection.is_open() {
            is_ready = true;
            report.begin(options, sending.as_ref())?;
            connection.begin();
        }
        connection.events(|event| report.link(&event))?;
        let mut is_late = || wait_until.take_if(|until| Instant::now() >= *until).is_some();
        if !is_ready && !connection.listens() && is_late() {
            report.waiting(options)?;
        }
        if let Some(failure) = connection.failure() {
            return Err(failure.into());
        }
        let now = Instant::now();
        let is_due = now >= tick_at;
        if is_due {
            tick_at = now + TICK_INTERVAL;
            if let Some(sending) = sending {
                sending.announce();
            }
        }
        if report_requested.swap(false, Ordering::Relaxed) || is_due && report.is_periodic() {
            report_others.into_iter().for_each(|flag| flag.store(true, Ordering::Relaxed));
            report_counts(options, connection, sending.as_ref(), report)?;
        }
        if !more {
            let left = tick_at.saturating_duration_since(now).min(MAX_WAIT);
            match sending {
                Some(sending) => sending.wait(left)?,
                None => thread::sleep(left),
            }
        }
    }
    Ok(())
}

/// Returns the time in seconds since 1970.
fn now_s() -> i64 {
    (now().wall_ns / 1_000_000_000) as i64
}

fn no_thread(error: &io::Error) -> Failure {
    Failure::new(Kind::ResourceExhausted, format!("cannot start a thread: {error}"), "")
}

fn thread_panicked() -> Failure {
    Failure::new(Kind::Failed, "a thread of the bridge panicked", "")
}
