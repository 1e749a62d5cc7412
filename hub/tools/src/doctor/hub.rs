//! The links of a running hub, as the hub reports them. No other process can send a request to a scanner whose port the
//! hub holds.

use std::path::Path;
use std::time::Duration;

use scanhub_port::{Holder, PortSpec};
use scanhub_schema::{Failure, Kind, State, Status, is_remote};
use scanhub_shm::Payload;
use scanhub_shm::{Domain, Environment, RunningHub};

/// Running hub.
pub(crate) struct Hub {
    pub(crate) pid: u32,
    /// Command that shows a link of this hub, without the link's name.
    info: String,
    statuses: Vec<LinkStatus>,
}

impl Hub {
    /// Returns the hub in `domain`, if one runs.
    pub(crate) fn find(domain: &Domain) -> Option<Hub> {
        let pid = scanhub_shm::hub_pid(domain.root()).ok().flatten()?;
        Some(Hub { pid, info: "scanhub info".to_owned(), statuses: statuses(domain).unwrap_or_default() })
    }

    /// Returns the hub that uses the port `source`. For a tty, this is a hub among the `holders` of the port, in
    /// `locations` or in another domain of this machine. For a serial server, it is a hub in `locations` that is
    /// connected to the server.
    pub(crate) fn at(source: &PortSpec, holders: &[Holder], locations: &[Domain]) -> Option<Hub> {
        if let PortSpec::Tcp { .. } = source {
            let is_connected = |(_, status): (&str, &Status)| status.state() != Some(State::Absent);
            let uses_it = |hub: &Hub| hub.link(source).is_some_and(is_connected);
            return locations.iter().filter_map(Hub::find).find(uses_it);
        }
        let is_holder = |pid| holders.iter().any(|holder| holder.pid == pid);
        if holders.is_empty() {
            return None;
        }
        let runs_hub = |location: &&Domain| matches!(scanhub_shm::hub_pid(location.root()), Ok(Some(pid)) if is_holder(pid));
        if let Some(location) = locations.iter().find(runs_hub) {
            return Hub::find(location);
        }
        let running = RunningHub::all(Path::new("/")).into_iter().find(|hub| is_holder(hub.pid))?;
        let domain = Domain::at(running.domain.as_ref()?, running.base.as_ref()?).ok()?;
        let domain_name = locations.first().map_or(scanhub_shm::DEFAULT_DOMAIN, Domain::name);
        let info = running.command("info", domain_name, &Environment::of_process());
        Hub::find(&domain).filter(|hub| hub.pid == running.pid).map(|hub| Hub { info, ..hub })
    }

    /// Returns the port of a link, if `source` is the link's name and not the path of a file.
    pub(crate) fn port_of(&self, source: &PortSpec) -> Option<PortSpec> {
        self.source_of(self.link_named(source)?.1.as_ref()?)
    }

    /// Returns the port of the link with this `status`. A relative path is relative to the hub's working directory,
    /// which may differ from that of this process.
    fn source_of(&self, status: &Status) -> Option<PortSpec> {
        let source = PortSpec::parse(status.port()).ok()?;
        let PortSpec::Tty(path) = &source else { return Some(source) };
        let directory = || std::fs::read_link(format!("/proc/{}/cwd", self.pid)).ok();
        match directory().filter(|_| path.is_relative()) {
            Some(directory) => Some(PortSpec::Tty(directory.join(path))),
            None => Some(source),
        }
    }

    /// Returns the ports of all links that report theirs.
    pub(crate) fn ports(&self) -> Vec<PortSpec> {
        let statuses = self.statuses.iter().filter_map(|(_, status)| status.as_ref());
        statuses.filter_map(|status| self.source_of(status)).collect()
    }

    /// Returns whether `source` names a link whose port is unknown because its status did not arrive.
    pub(crate) fn is_mute_link(&self, source: &PortSpec) -> bool {
        self.link_named(source).is_some_and(|(_, status)| status.is_none())
    }

    /// Returns the links whose status did not arrive, although a running hub keeps it for late joiners.
    pub(crate) fn mute(&self) -> Vec<String> {
        self.statuses.iter().filter(|(_, status)| status.is_none()).map(|(name, _)| name.clone()).collect()
    }

    /// Returns name and status of the link with this port, even if the hub's configuration has another name for the
    /// port.
    pub(crate) fn link(&self, port: &PortSpec) -> Option<(&str, &Status)> {
        let links =
            || self.statuses.iter().filter_map(|(name, status)| Some((name.as_str(), status.as_ref()?)));
        let is_named = |(_, status): &(&str, &Status)| self.source_of(status).as_ref() == Some(port);
        let is_same = |(_, status): &(&str, &Status)| {
            self.source_of(status).is_some_and(|source| source.is_same_port(port))
        };
        links().find(is_named).or_else(|| links().find(is_same))
    }

    /// Returns the reason why a port that the hub has open belongs to none of its reported links.
    pub(crate) fn unknown_reason(&self) -> &'static str {
        match self.statuses.iter().any(|(_, status)| status.is_none()) {
            true => "the hub has the port, and does not publish",
            false => "the hub has the port under another name: scanhub info",
        }
    }

    /// Returns the commands that a user can run next if link `name` of this hub has a problem. `holders` have the port
    /// of the link open.
    pub(crate) fn remedy(&self, name: &str, status: &Status, holders: &[Holder]) -> String {
        let info = format!("{} {name}", self.info);
        match status.state() {
            // The error of the link has the remedy for the port, or for the scanner that streams.
            Some(State::Absent | State::Streaming | State::Paused) => info,
            _ if status.is_replayed() => info,
            _ => {
                let port =
                    self.source_of(status).map_or_else(|| status.port().to_owned(), |source| source.name());
                let (stop, port) = (self.stop(holders), scanhub_shm::shell_word(&port));
                format!("{info}; or stop the hub ({stop}), then search the port: scanhub probe {port}")
            }
        }
    }

    /// Returns the failure for a program that needs the port `source` of this hub, which has `holders`.
    pub(crate) fn refuse(&self, source: &PortSpec, holders: &[Holder]) -> Failure {
        let (name, pid, stop) = (source.name(), self.pid, self.stop(holders));
        let mut message = format!("{name}: in use by the hub, process {pid}");
        let mut remedies = Vec::new();
        if let Some(other) = other_reader(holders, pid) {
            message += &format!(", and read by {other}");
            remedies.push(format!("end {other}: the hub loses every byte that it reads"));
        }
        match self.link(source) {
            Some((link, status)) => {
                let state = status.state().map_or("unknown", State::name);
                message += &format!("; its link {link} is {state}");
                if !status.last_error().is_empty() {
                    message += &format!(": {}", status.last_error());
                }
                remedies.push(format!("{} {link}", self.info));
            }
            None => remedies.push(self.info.clone()),
        }
        remedies.push(format!("before another program may use the port, stop the hub: {stop}"));
        Failure::new(Kind::PortBusy, message, remedies.join("; "))
    }

    /// Returns the command that stops the hub. If the service manager is among the `holders` of its port, the hub is a
    /// service.
    fn stop(&self, holders: &[Holder]) -> String {
        if holders.iter().any(|holder| holder.pid == SERVICE_MANAGER) {
            "sudo systemctl stop scanhub".to_owned()
        } else {
            format!("kill {}", self.pid)
        }
    }

    /// Creates a hub without links.
    #[cfg(test)]
    pub(crate) fn without_links(pid: u32) -> Hub {
        Hub { pid, info: "scanhub info".to_owned(), statuses: Vec::new() }
    }

    fn link_named(&self, source: &PortSpec) -> Option<&LinkStatus> {
        let PortSpec::Tty(path) = source else { return None };
        let name = path.to_str().filter(|_| !path.exists())?;
        self.statuses.iter().find(|(sensor, _)| sensor == name)
    }
}

/// Returns the process among the `holders` of a port that takes bytes away from `hub`. The service manager only keeps
/// the port for the next hub.
pub(crate) fn other_reader(holders: &[Holder], hub: u32) -> Option<&Holder> {
    holders.iter().find(|holder| holder.pid != hub && holder.pid != SERVICE_MANAGER)
}

/// Name of a link, and its last status if one arrived.
type LinkStatus = (String, Option<Status>);

/// Returns the last status of each link. A late joiner receives it within a tenth of a second.
fn statuses(domain: &Domain) -> Result<Vec<LinkStatus>, Failure> {
    let node = scanhub_shm::client_node(domain)?;
    let (mut found, mut subscribers) = (Vec::new(), Vec::new());
    // The ports of remote sensors are on other machines.
    for sensor in scanhub_shm::sensors(domain)?.into_iter().filter(|sensor| !is_remote(sensor)) {
        let Some(topic) = Status::open(&node, &sensor)? else { continue };
        subscribers.push(Status::subscriber(&node, &topic)?);
        found.push((sensor, None));
    }
    for _ in 0..MAX_POLLS {
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

/// Process ID of the service manager, which holds ports only for a service.
const SERVICE_MANAGER: u32 = 1;
/// Number of polls for the last statuses, one every 20 ms, so 1.5 s in total.
const MAX_POLLS: u32 = 75;
const POLL_INTERVAL: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;

    fn hub(state: State, port: &str, error: &str) -> Hub {
        let mut status = Status { state: state as u8, ..Status::default() };
        status.set_port(port);
        status.set_last_error(error);
        Hub { statuses: vec![("front".to_owned(), Some(status))], ..Hub::without_links(7) }
    }

    fn holder(pid: u32, program: &str) -> Holder {
        Holder { pid, program: program.to_owned() }
    }

    #[test]
    fn port_held_by_the_hub_is_refused_with_link_state() {
        let error = "1,200 bytes/s arrive, but no LMS replies; is it another scanner?";
        let hub = hub(State::Probing, "/dev/x", error);
        let source = PortSpec::Tty("/dev/x".into());
        let refused = hub.refuse(&source, &[holder(7, "scanhub")]);
        assert_eq!(refused.kind, Kind::PortBusy);
        let message = format!("/dev/x: in use by the hub, process 7; its link front is probing: {error}");
        assert_eq!(refused.message, message);
        let stop = "before another program may use the port, stop the hub: kill 7";
        assert_eq!(refused.hint, format!("scanhub info front; {stop}"));
        let read = hub.refuse(&source, &[holder(7, "scanhub"), holder(9, "cat")]);
        assert!(read.message.contains(", and read by process 9 (cat); its link"), "{read}");
        assert!(read.hint.starts_with("end process 9 (cat): the hub loses"), "{read}");
        // The service manager keeps the port for the next hub.
        let service = hub.refuse(&source, &[holder(1, "systemd"), holder(7, "scanhub")]);
        assert!(
            service.hint.ends_with("sudo systemctl stop scanhub") && !service.message.contains("read by")
        );
    }

    #[test]
    fn link_is_found_by_any_name_of_its_port() {
        let directory = tempfile::tempdir().expect("a directory");
        let name = directory.path().join("lidar");
        std::os::unix::fs::symlink("/dev/null", &name).expect("a link");
        let hub = hub(State::Streaming, &name.display().to_string(), "");
        for port in [name.as_path(), Path::new("/dev/null")] {
            assert_eq!(
                hub.link(&PortSpec::Tty(port.to_owned())).map(|(name, _)| name),
                Some("front"),
                "{port:?}"
            );
        }
        assert!(hub.link(&PortSpec::Tty("/dev/zero".into())).is_none());
        assert_eq!(hub.ports(), [PortSpec::Tty(name)]);
    }
}
