//! What a running hub reports about its links: nobody else can ask a sensor at a port that the hub holds.

use std::time::Duration;

use port::Source;
use schema::ipc::{self, Payload};
use schema::{Domain, Failure, Status, is_remote};

/// A running hub.
pub(crate) struct Hub {
    pub(crate) pid: u32,
    statuses: Vec<Told>,
}

impl Hub {
    /// The hub in `domain`, if there is one.
    pub(crate) fn find(domain: &Domain) -> Option<Hub> {
        let pid = schema::holder(domain.root()).ok().flatten()?;
        Some(Hub { pid, statuses: statuses(domain).unwrap_or_default() })
    }

    /// The port of the link that `source` names instead of a port: no such file is here.
    pub(crate) fn port_of(&self, source: &Source) -> Option<Source> {
        Source::parse(self.named(source)?.1.as_ref()?.port()).ok()
    }

    /// Whether `source` names a link whose port is not known, for its status did not come.
    pub(crate) fn is_mute_link(&self, source: &Source) -> bool {
        self.named(source).is_some_and(|(_, status)| status.is_none())
    }

    /// The links whose status did not come, although a hub that runs gives it to each newcomer.
    pub(crate) fn mute(&self) -> Vec<String> {
        self.statuses.iter().filter(|(_, status)| status.is_none()).map(|(name, _)| name.clone()).collect()
    }

    /// Name and status of the link whose port is configured as `port`.
    pub(crate) fn link(&self, port: &str) -> Option<(&str, &Status)> {
        let mut told =
            self.statuses.iter().filter_map(|(name, status)| Some((name.as_str(), status.as_ref()?)));
        told.find(|(_, status)| status.port() == port)
    }

    /// Why a port that the hub has open belongs to none of the links that it tells of.
    pub(crate) fn why_unknown(&self) -> &'static str {
        match self.statuses.iter().any(|(_, status)| status.is_none()) {
            true => "the hub has the port, and does not publish",
            false => "the hub has the port under another name: scanhub info",
        }
    }

    fn named(&self, source: &Source) -> Option<&Told> {
        let Source::Tty(path) = source else { return None };
        let name = path.to_str().filter(|_| !path.exists())?;
        self.statuses.iter().find(|(sensor, _)| sensor == name)
    }
}

/// A link, and its last status unless none came.
type Told = (String, Option<Status>);

/// The last status of each link: a newcomer gets it within a tenth of a second.
fn statuses(domain: &Domain) -> Result<Vec<Told>, Failure> {
    let node = ipc::client_node(domain)?;
    let (mut found, mut subscribers) = (Vec::new(), Vec::new());
    // The ports of others are on other machines.
    for sensor in ipc::sensors(domain)?.into_iter().filter(|sensor| !is_remote(sensor)) {
        let Some(topic) = Status::open(&node, &sensor)? else { continue };
        subscribers.push(Status::subscriber(&topic)?);
        found.push((sensor, None));
    }
    for _ in 0..LOOKS {
        for (subscriber, (_, status)) in subscribers.iter().zip(&mut found) {
            if let Ok(Some(sample)) = Status::receive(subscriber) {
                *status = Some(*Status::read(&sample));
            }
        }
        if found.iter().all(|(_, status)| status.is_some()) {
            break;
        }
        std::thread::sleep(BETWEEN_LOOKS);
    }
    Ok(found)
}

/// A second and a half in all.
const LOOKS: u32 = 75;
const BETWEEN_LOOKS: Duration = Duration::from_millis(20);
