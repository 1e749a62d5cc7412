//! The angles of simulated mounts as topics, which a program of the encoder publishes for a real mount. Refuses to know what is
//! mounted.

use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;

use scanhub_client::{Publication, PublishSession, SensorPublisher, Wake};
use schema::limits::TopicLimits;
use schema::{Domain, Failure, Flags, Header, Kind, Maker, Tilt, publisher};
use sim::mount::Report;
use sim::options::SimulateOptions;

/// What publishes the angles of a mount, and wakes who follows them.
type Topic = (Publication<Tilt>, SensorPublisher);
/// A report of the encoder at the port with this number.
type Said = (usize, Report);

/// Publishes each report that comes under the name of its port, until nobody reports any more. `places` are those of the
/// domain.
///
/// [`Kind::Usage`] if a port has no mount, those of publishing.
pub(crate) fn publish(
    names: &[String],
    options: &SimulateOptions,
    places: &[Domain],
) -> Result<Sender<Said>, Failure> {
    for (number, name) in names.iter().enumerate() {
        let has_mount = options.world.mount(number % options.world.sensors()).is_some();
        if number >= options.ports.len() || !has_mount {
            let what = format!("--angles {name}: no sensor with a mount is at port number {}", number + 1);
            return Err(Failure::new(Kind::Usage, what, "--world tilt has one, see docs/worlds.md"));
        }
    }
    let (said, reports) = mpsc::channel();
    let (is_up, up) = mpsc::channel();
    let (names, places) = (names.to_vec(), places.to_vec());
    // What publishes stays in one thread.
    thread::spawn(move || match open(&names, &places) {
        Ok(topics) => {
            let _ = is_up.send(Ok(()));
            pass_on(&reports, topics);
        }
        Err(failure) => {
            let _ = is_up.send(Err(failure));
        }
    });
    match up.recv() {
        Ok(outcome) => outcome.map(|()| said),
        Err(_) => Err(Failure::new(Kind::Failed, "what publishes angles has ended", "")),
    }
}

fn open(names: &[String], places: &[Domain]) -> Result<Vec<Topic>, Failure> {
    let lives = |domain: &&Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    let Some(domain) = places.iter().find(lives).or(places.first()) else { return Ok(Vec::new()) };
    let open = |name: &String| {
        let sensor = PublishSession::beside(domain, name, Maker::Mount.topics(), TopicLimits::default())?;
        Ok((sensor.topic()?, sensor))
    };
    names.iter().map(open).collect()
}

fn pass_on(reports: &Receiver<Said>, mut topics: Vec<Topic>) {
    for (number, report) in reports {
        let Some((topic, sensor)) = topics.get_mut(number) else { continue };
        let header = Header { flags: Flags::SIMULATED, ..topic.header_at(report.stamp_ns) };
        let said = Tilt { angle_rad: report.angle_rad, rate_rad_s: report.rate_rad_s };
        // A sample without memory is a number that is missing, and who cannot be woken looks ten times a second.
        let _ = topic.send_with(&header, |sample| *sample = said);
        let _ = sensor.wake(Wake::Telegram);
    }
}
