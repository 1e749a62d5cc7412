//! The links of a running hub, as it reports them. No other process can send a request to a scanner whose port the hub
//! holds.

use std::time::Duration;

use port::Source;
use schema::ipc::{self, Payload};
use schema::{Domain, Failure, Status, is_remote};

/// A running hub.
pub(crate) struct Hub {
    pub(crate) pid: u32,
    statuses: Vec<LinkStatus>,
}

impl Hub {
    /// Returns the hub in `domain`, if there is one.
    pub(crate) fn find(domain: &Domain) -> Option<Hub> {
        let pid = schema::holder(domain.root()).ok().flatten()?;
        Some(Hub { pid, statuses: statuses(domain).unwrap_or_default() })
    }

    /// Returns the port of a link, if `source` is the link's name and not the path of a file.
    pub(crate) fn port_of(&self, source: &Source) -> Option<Source> {
        Source::parse(self.named(source)?.1.as_ref()?.port()).ok()
    }

    /// Returns whether `source` names a link whose port is unknown because its status did not arrive.
    pub(crate) fn is_mute_link(&self, source: &Source) -> bool {
        self.named(source).is_some_and(|(_, status)| status.is_none())
    }

    /// Returns the links whose status did not arrive, although a running hub keeps it for late joiners.
    pub(crate) fn mute(&self) -> Vec<String> {
        self.statuses.iter().filter(|(_, status)| status.is_none()).map(|(name, _)| name.clone()).collect()
    }

    /// Returns name and status of the link whose port is configured as `port`.
    pub(crate) fn link(&self, port: &str) -> Option<(&str, &Status)> {
        let mut links =
            self.statuses.iter().filter_map(|(name, status)| Some((name.as_str(), status.as_ref()?)));
        links.find(|(_, status)| status.port() == port)
    }

    /// Returns the reason why a port that the hub has open belongs to none of its reported links.
    pub(crate) fn why_unknown(&self) -> &'static str {
        match self.statuses.iter().any(|(_, status)| status.is_none()) {
            true => "the hub has the port, and does not publish",
            false => "the hub has the port under another name: scanhub info",
        }
    }

    fn named(&self, source: &Source) -> Option<&LinkStatus> {
        let Source::Tty(path) = source else { return None };
        let name = path.to_str().filter(|_| !path.exists())?;
        self.statuses.iter().find(|(sensor, _)| sensor == name)
    }
}

/// Name of a link, and its last status if one arrived.
type LinkStatus = (String, Option<Status>);

/// Returns the last status of each link. A late joiner receives it within a tenth of a second.
fn statuses(domain: &Domain) -> Result<Vec<LinkStatus>, Failure> {
    let node = ipc::client_node(domain)?;
    let (mut found, mut subscribers) = (Vec::new(), Vec::new());
    // The ports of remote sensors are on other machines.
    for sensor in ipc::sensors(domain)?.into_iter().filter(|sensor| !is_remote(sensor)) {
        let Some(topic) = Status::open(&node, &sensor)? else { continue };
        subscribers.push(Status::subscriber(&topic)?);
        found.push((sensor, None));
    }
    for _ in 0..POLLS {
        for (subscriber, (_, status)) in subscribers.iter().zip(&mut found) {
            if let Ok(Some(sample)) = Status::receive(subscriber) {
                *status = Some(*Status::read(&sample));
            }
        }
        if found.iter().all(|(_, status)| status.is_some()) {
            break;
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    Ok(found)
}

/// Number of polls: a second and a half in total.
const POLLS: u32 = 75;
const POLL_INTERVAL: Duration = Duration::from_millis(20);
