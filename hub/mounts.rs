//! Publishes the angles of simulated mounts as topics, as the program of an encoder does for a real mount.

use std::sync::mpsc::{self, Receiver, Sender};
use std::thread::{self, JoinHandle};

use scanhub_client::{Publication, PublishSession, SensorPublisher, Wake};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Flags, Header, Kind, Maker, Tilt};
use scanhub_shm::Domain;
use scanhub_sim::mount::Report;
use scanhub_sim::options::SimulateOptions;

/// Publishing end of all mounts. Dropping it removes the topics.
pub(crate) struct Encoders {
    /// `None` once no more reports follow.
    reports: Option<Sender<NumberedReport>>,
    /// Owns the topics, because publishers stay in one thread.
    thread: Option<JoinHandle<()>>,
}

/// The topic of a mount, and its subscribers' wake-up.
type MountTopic = (Publication<Tilt>, SensorPublisher);
/// A report of the encoder at the port with this number.
type NumberedReport = (usize, Report);

impl Encoders {
    /// Publishes the mount at port `i` as `names[i]` in `domain`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if a port has no mount. Otherwise the errors of [`PublishSession::beside`].
    pub(crate) fn start(
        names: &[String],
        options: &SimulateOptions,
        domain: &Domain,
    ) -> Result<Encoders, Failure> {
        for (number, name) in names.iter().enumerate() {
            let has_mount = options.world.mount(number % options.world.sensors()).is_some();
            if number >= options.ports.len() || !has_mount {
                let what =
                    format!("--angles {name}: no sensor with a mount is at port number {}", number + 1);
                return Err(Failure::new(Kind::Usage, what, "--world tilt has one, see docs/worlds.md"));
            }
        }
        let (reports, receiver) = mpsc::channel();
        let (on_start, start) = mpsc::channel();
        let (names, domain) = (names.to_vec(), domain.clone());
        let thread = thread::spawn(move || match open(&names, &domain) {
            Ok(topics) => {
                let _ = on_start.send(Ok(()));
                publish(&receiver, topics);
            }
            Err(failure) => {
                let _ = on_start.send(Err(failure));
            }
        });
        let encoders = Encoders { reports: Some(reports), thread: Some(thread) };
        match start.recv() {
            Ok(outcome) => outcome.map(|()| encoders),
            Err(_) => Err(Failure::new(Kind::Failed, "the thread that publishes angles has ended", "")),
        }
    }

    /// Publishes `report` of the encoder at port `number`, if it has a name.
    pub(crate) fn report(&self, number: usize, report: Report) {
        if let Some(reports) = &self.reports {
            let _ = reports.send((number, report));
        }
    }
}

impl Drop for Encoders {
    fn drop(&mut self) {
        self.reports = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn open(names: &[String], domain: &Domain) -> Result<Vec<MountTopic>, Failure> {
    let open = |name: &String| {
        let sensor = PublishSession::beside(domain, name, Maker::Mount.topics(), TopicLimits::default())?;
        Ok((sensor.topic()?, sensor))
    };
    names.iter().map(open).collect()
}

/// Publishes all reports until their sender is dropped.
fn publish(reports: &Receiver<NumberedReport>, mut topics: Vec<MountTopic>) {
    for (number, report) in reports {
        let Some((topic, sensor)) = topics.get_mut(number) else { continue };
        let header = Header { flags: Flags::SIMULATED, ..topic.header_at(report.stamp_ns) };
        let tilt = Tilt { angle_rad: report.angle_rad, rate_rad_s: report.rate_rad_s };
        // Without memory, the sample's number is skipped. A subscriber that is not woken polls ten times a second.
        let _ = topic.send_with(&header, |sample| *sample = tilt);
        let _ = sensor.wake(Wake::Telegram);
    }
}
