//! Publishes the angles of recorded mounts while the hub plays the recording, as the program of an encoder does for a real
//! mount.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread::{self, JoinHandle};

use scanhub_client::{PublishSession, Wake};
use scanhub_daemon::{Player, RecordedAngle, RecordedMount};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Flags, Header, Kind, Maker, Tilt};
use scanhub_shm::Domain;

/// A thread for each mount of a recording. Dropping it ends the threads, and removes the topics.
pub(crate) struct Mounts {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Mounts {
    /// Publishes all mounts of the recording that `player` plays in `domain`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`PublishSession::beside`].
    pub(crate) fn start(player: &Arc<Player>, domain: &Domain) -> Result<Mounts, Failure> {
        let mut mounts = Mounts { stop: Arc::default(), threads: Vec::new() };
        for mount in player.mounts() {
            let (on_start, start) = mpsc::channel();
            let (mount, player, domain) = (mount.clone(), player.clone(), domain.clone());
            let stop = mounts.stop.clone();
            mounts.threads.push(thread::spawn(move || {
                if let Err(failure) = publish(&mount, &player, &domain, &stop, || drop(on_start.send(Ok(()))))
                {
                    let _ = on_start.send(Err(failure));
                }
            }));
            match start.recv() {
                Ok(outcome) => outcome?,
                Err(_) => {
                    return Err(Failure::new(Kind::Failed, "the thread that publishes angles has ended", ""));
                }
            }
        }
        Ok(mounts)
    }
}

impl Drop for Mounts {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Publishes `mount` until `stop` is set. Calls `on_start` when its topic exists.
fn publish(
    mount: &RecordedMount,
    player: &Player,
    domain: &Domain,
    stop: &AtomicBool,
    on_start: impl FnOnce(),
) -> Result<(), Failure> {
    let sensor = PublishSession::beside(domain, mount.name(), Maker::Mount.topics(), TopicLimits::default())?;
    let mut topic = sensor.topic::<Tilt>()?;
    on_start();
    mount.play(player, stop, |RecordedAngle { stamp_ns, header: recorded, tilt }| {
        let flags = Flags::REPLAYED | recorded.flags & Flags::SIMULATED;
        let header = Header { flags, wall_ns: recorded.wall_ns, ..topic.header_at(stamp_ns) };
        // Without memory, the number of the sample is skipped. A subscriber that is not woken polls ten times a second.
        let _ = topic.send_with(&header, |sample| *sample = tilt);
        let _ = sensor.wake(Wake::Telegram);
    });
    Ok(())
}
