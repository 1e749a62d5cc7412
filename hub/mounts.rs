//! Publishers of the angles of simulated and recorded mounts. For a real mount, the program of its encoder publishes
//! them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Sender};
use std::thread::{self, JoinHandle};

use scanhub_client::{Publication, PublishSession, SensorPublisher, WakeEvent};
use scanhub_daemon::Player;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Flags, Header, Kind, PublisherKind, Tilt};
use scanhub_shm::Domain;
use scanhub_sim::mount::Report;
use scanhub_sim::options::SimulateOptions;

/// Publishers of all simulated mounts. Dropping this value removes the topics.
pub(crate) struct SimulatedMounts {
    /// Reports of the encoders, with the number of the port; `None` once no more follow.
    reports: Option<Sender<(usize, Report)>>,
    thread: Option<JoinHandle<()>>,
}

impl SimulatedMounts {
    /// Publishes the mount at port `i` as `names[i]` in `domain`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if a port has no mount, and the errors of [`PublishSession::open_named`].
    pub(crate) fn start(
        names: &[String],
        options: &SimulateOptions,
        domain: &Domain,
    ) -> Result<SimulatedMounts, Failure> {
        for (number, name) in names.iter().enumerate() {
            let has_mount = options.world.mount(number % options.world.sensors()).is_some();
            if number >= options.ports.len() || !has_mount {
                let what =
                    format!("--angles {name}: no sensor with a mount is at port number {}", number + 1);
                return Err(Failure::new(Kind::Usage, what, "--world tilt has one, see docs/worlds.md"));
            }
        }
        let (reports, receiver) = mpsc::channel::<(usize, Report)>();
        let (names, domain) = (names.to_vec(), domain.clone());
        let open = move || names.iter().map(|name| MountTopic::open(name, &domain)).collect();
        let thread = start_thread(open, move |mut topics: Vec<MountTopic>| {
            for (number, report) in receiver {
                let Some(topic) = topics.get_mut(number) else { continue };
                let tilt = Tilt { angle_rad: report.angle_rad, rate_rad_s: report.rate_rad_s };
                topic.publish(report.stamp_ns, tilt, |header| Header { flags: Flags::SIMULATED, ..header });
            }
        })?;
        Ok(SimulatedMounts { reports: Some(reports), thread: Some(thread) })
    }

    /// Publishes `report` of the encoder at port `number`, if the mount at this port has a name.
    pub(crate) fn report(&self, number: usize, report: Report) {
        if let Some(reports) = &self.reports {
            let _ = reports.send((number, report));
        }
    }
}

impl Drop for SimulatedMounts {
    fn drop(&mut self) {
        self.reports = None;
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Threads that publish the angles of recorded mounts while the hub plays the recording. Dropping this value ends the
/// threads.
pub(crate) struct RecordedMounts {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl RecordedMounts {
    /// Publishes the mounts of `player` in `domain`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`PublishSession::open_named`].
    pub(crate) fn start(player: &Arc<Player>, domain: &Domain) -> Result<RecordedMounts, Failure> {
        let mut mounts = RecordedMounts { stop: Arc::default(), threads: Vec::new() };
        for mount in player.mounts() {
            let (player, stop) = (player.clone(), mounts.stop.clone());
            let (name, mount, domain) = (mount.name().to_owned(), mount.clone(), domain.clone());
            let open = move || MountTopic::open(&name, &domain);
            mounts.threads.push(start_thread(open, move |mut topic| {
                mount.play(&player, &stop, |angle| {
                    let flags = Flags::REPLAYED | angle.header.flags & Flags::SIMULATED;
                    let wall_ns = angle.header.wall_ns;
                    topic.publish(angle.stamp_ns, angle.tilt, |header| Header { flags, wall_ns, ..header });
                });
            })?);
        }
        Ok(mounts)
    }
}

impl Drop for RecordedMounts {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Topic of a mount, with the means to wake its subscribers.
struct MountTopic {
    topic: Publication<Tilt>,
    sensor: SensorPublisher,
}

impl MountTopic {
    fn open(name: &str, domain: &Domain) -> Result<MountTopic, Failure> {
        let sensor =
            PublishSession::open_named(domain, name, PublisherKind::Mount.topics(), TopicLimits::default())?;
        Ok(MountTopic { topic: sensor.topic()?, sensor })
    }

    /// Publishes `tilt` as of `stamp_ns`, with the header that `change` returns.
    fn publish(&mut self, stamp_ns: u64, tilt: Tilt, change: impl FnOnce(Header) -> Header) {
        let header = change(self.topic.header_at(stamp_ns));
        // If memory runs out, the sample is not sent and its sequence number is skipped. A subscriber that is not woken
        // polls ten times a second.
        let _ = self.topic.send_with(&header, |sample| *sample = tilt);
        let _ = self.sensor.wake(WakeEvent::Telegram);
    }
}

/// Starts a thread that calls `open` and then `publish` with its result. Publishers must stay in the thread that opens
/// them.
///
/// # Errors
///
/// Returns the errors of `open`.
fn start_thread<T>(
    open: impl FnOnce() -> Result<T, Failure> + Send + 'static,
    publish: impl FnOnce(T) + Send + 'static,
) -> Result<JoinHandle<()>, Failure> {
    let (on_start, start) = mpsc::channel();
    let thread = thread::spawn(move || match open() {
        Ok(topics) => {
            let _ = on_start.send(Ok(()));
            publish(topics);
        }
        Err(failure) => {
            let _ = on_start.send(Err(failure));
        }
    });
    match start.recv() {
        Ok(outcome) => outcome.map(|()| thread),
        Err(_) => Err(Failure::new(Kind::Failed, "the thread that publishes angles has ended", "")),
    }
}
