//! What a running hub says of its links: a port that it holds cannot be asked by anybody else.

use std::time::Duration;

use schema::ipc::{self, Payload};
use schema::{Domain, Failure, Status, is_remote};

use crate::config::Source;

/// A running hub.
pub(crate) struct Hub {
    pub(crate) pid: u32,
    /// The last status of each link, as far as it came.
    statuses: Vec<(String, Status)>,
}

impl Hub {
    /// The hub in `domain`, if there is one.
    pub(crate) fn find(domain: &Domain) -> Option<Hub> {
        let pid = schema::holder(domain.root()).ok().flatten()?;
        Some(Hub { pid, statuses: statuses(domain).unwrap_or_default() })
    }

    /// The port of the link that `source` names instead of a port: no such file is here.
    pub(crate) fn port_of(&self, source: &Source) -> Option<Source> {
        let Source::Tty(path) = source else { return None };
        let name = path.to_str().filter(|_| !path.exists())?;
        let (_, status) = self.statuses.iter().find(|(sensor, _)| sensor == name)?;
        Source::parse(status.port()).ok()
    }

    /// Name and status of the link whose port is configured as `port`.
    pub(crate) fn link(&self, port: &str) -> Option<(&str, &Status)> {
        let found = self.statuses.iter().find(|(_, status)| status.port() == port);
        found.map(|(name, status)| (name.as_str(), status))
    }
}

/// The last status of each link: a newcomer gets it within a tenth of a second.
fn statuses(domain: &Domain) -> Result<Vec<(String, Status)>, Failure> {
    let node = ipc::client_node(domain)?;
    let mut found = Vec::new();
    // The ports of others are on other machines.
    for sensor in ipc::sensors(domain)?.into_iter().filter(|sensor| !is_remote(sensor)) {
        let Some(topic) = Status::open(&node, &sensor)? else { continue };
        let subscriber = Status::subscriber(&topic)?;
        for _ in 0..LOOKS {
            if let Ok(Some(sample)) = Status::receive(&subscriber) {
                found.push((sensor, *Status::read(&sample)));
                break;
            }
            std::thread::sleep(BETWEEN_LOOKS);
        }
    }
    Ok(found)
}

/// A second and a half in all.
const LOOKS: u32 = 75;
const BETWEEN_LOOKS: Duration = Duration::from_millis(20);
