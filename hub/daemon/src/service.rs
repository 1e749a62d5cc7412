//! Protocol of the service manager that started the hub, if any: sd_notify(3) of systemd. The hub reports that it is
//! ready and that its links work. It also passes its open ports to the service manager, so that bytes of a scanner wait
//! in the buffer of the line while a killed hub is replaced.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use rustix::io::{FdFlags, fcntl_setfd};
use scanhub_schema::Nanos;
use sd_notify::NotifyState;

/// The service manager. Without one, as by default, all functions have no effect.
#[derive(Default)]
pub struct Service {
    /// Ports that the previous hub passed to the service manager, each with the name of its link.
    kept_ports: Mutex<Vec<(String, OwnedFd)>>,
    /// Interval at which the service manager expects a report that the hub works; `None` if it expects no reports.
    watchdog: Option<Nanos>,
}

impl Service {
    /// Creates the service manager of this process from its environment. Must be called once, before anything else is
    /// opened.
    pub(crate) fn of_process() -> Service {
        let passed = sd_listen_fds::get().unwrap_or_else(|error| {
            tracing::warn!(%error, "ports that the service manager kept cannot be used");
            Vec::new()
        });
        let named = passed.into_iter().filter_map(|(name, line)| Some((name?, line.into_std())));
        let own = |(name, line): (String, OwnedFd)| {
            fcntl_setfd(&line, FdFlags::CLOEXEC).is_ok().then_some((name, line))
        };
        let watchdog = sd_notify::watchdog_enabled().map(|span| span.as_nanos() as Nanos);
        Service { kept_ports: Mutex::new(named.filter_map(own).collect()), watchdog }
    }

    /// Assigns each kept port to the link that has it now, according to `owner`. The service manager stops keeping a
    /// port that has no link. Must be called before a port is kept again, because releasing a name releases all ports
    /// that are kept under it.
    pub(crate) fn assign(&self, owner: impl Fn(&OwnedFd) -> Option<String>) {
        let mut kept_ports = self.kept_ports.lock().unwrap_or_else(PoisonError::into_inner);
        for (name, line) in std::mem::take(&mut *kept_ports) {
            let owner = owner(&line);
            if owner.as_ref() != Some(&name) {
                self.release(&name);
            }
            kept_ports.extend(owner.map(|owner| (owner, line)));
        }
    }

    /// Takes a port that was kept under `name`.
    pub(crate) fn take(&self, name: &str) -> Option<OwnedFd> {
        let mut kept_ports = self.kept_ports.lock().unwrap_or_else(PoisonError::into_inner);
        let at = kept_ports.iter().position(|(known, _)| known == name)?;
        Some(kept_ports.swap_remove(at).1)
    }

    /// Keeps `line` open under `name`, until the name is released, the line hangs up, or the service is stopped.
    pub(crate) fn keep(&self, name: &str, line: impl AsFd) {
        let messages = [NotifyState::FdStore, NotifyState::FdName(name)];
        log_failure(sd_notify::notify_with_fds(&messages, &[line.as_fd()]));
    }

    /// Closes the ports that are kept under `name`.
    pub(crate) fn release(&self, name: &str) {
        log_failure(sd_notify::notify(&[NotifyState::FdStoreRemove, NotifyState::FdName(name)]));
    }

    /// Reports that the hub reads its configuration again, as of `now`. [`notify_ready`](Self::notify_ready) must
    /// follow, even if the new configuration is refused.
    pub(crate) fn notify_reloading(&self, now: Nanos) {
        let micros = NotifyState::MonotonicUsec(i128::from(now / 1_000));
        log_failure(sd_notify::notify(&[NotifyState::Reloading, micros]));
    }

    /// Reports that the hub is ready with `sensors`, at its start or after a reload. If the new configuration was
    /// `refused`, the old one stays.
    pub(crate) fn notify_ready(&self, sensors: &[String], refused: Option<&str>) {
        let refused = refused.map(|why| format!("; configuration refused: {why}")).unwrap_or_default();
        let status = format!("sensors: {}{refused}", sensors.join(", "));
        log_failure(sd_notify::notify(&[NotifyState::Ready, NotifyState::Status(&status)]));
    }

    /// Reports that the hub ends as requested.
    pub(crate) fn notify_stopping(&self) {
        log_failure(sd_notify::notify(&[NotifyState::Stopping]));
    }
}

/// Watchdog that reports to the service manager that the hub works, if every link has finished something since the last
/// report. A timer alone would not prove that the links work.
pub(crate) struct Watchdog<'a> {
    activity: &'a [AtomicBool],
    interval: Nanos,
    next: Nanos,
}

impl<'a> Watchdog<'a> {
    /// Creates the watchdog of the links that set their flags in `activity`; `None` if the service manager expects no
    /// reports.
    pub(crate) fn new(service: &Service, activity: &'a [AtomicBool], now: Nanos) -> Option<Watchdog<'a>> {
        let interval = service.watchdog? / REPORTS_PER_INTERVAL;
        Some(Watchdog { activity, interval, next: now + interval })
    }

    /// Sends a report if one is due and all links have worked. Must be called more often than the service manager
    /// expects reports.
    pub(crate) fn notify_due(&mut self, now: Nanos) {
        if self.is_due(now) {
            log_failure(sd_notify::notify(&[NotifyState::Watchdog]));
        }
    }

    fn is_due(&mut self, now: Nanos) -> bool {
        let is_due = now >= self.next && self.activity.iter().all(|worked| worked.load(Ordering::Relaxed));
        if is_due {
            self.activity.iter().for_each(|worked| worked.store(false, Ordering::Relaxed));
            self.next = now + self.interval;
        }
        is_due
    }
}

/// Logs a failed report. The hub continues, because the service manager handles missing reports itself.
fn log_failure(outcome: std::io::Result<()>) {
    if let Err(error) = outcome {
        tracing::debug!(%error, "the service manager cannot be notified");
    }
}

/// Number of reports that the hub may send in the time in which the service manager expects one. The margin is for
/// links that wake up only once a second.
const REPORTS_PER_INTERVAL: Nanos = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn watchdog_reports_only_if_all_links_worked() {
        let service = Service { kept_ports: Mutex::default(), watchdog: Some(40) };
        let worked = [AtomicBool::new(true), AtomicBool::new(false)];
        let mut watchdog = Watchdog::new(&service, &worked, 100).expect("one is wanted");
        assert!(!watchdog.is_due(110), "one link did nothing");
        worked[1].store(true, Ordering::Relaxed);
        assert!(!watchdog.is_due(109), "not yet");
        assert!(watchdog.is_due(111));
        assert!(!watchdog.is_due(200), "nothing was done since");
        worked.iter().for_each(|worked| worked.store(true, Ordering::Relaxed));
        assert!(watchdog.is_due(200));
        let none = Service { kept_ports: Mutex::default(), watchdog: None };
        assert!(Watchdog::new(&none, &worked, 0).is_none());
    }

    #[test]
    fn stored_port_is_taken_once() {
        let line = || OwnedFd::from(std::fs::File::open("/dev/null").unwrap());
        let kept = vec![("front".to_owned(), line()), ("rear".to_owned(), line())];
        let service = Service { kept_ports: Mutex::new(kept), watchdog: None };
        assert!(service.take("rear").is_some() && service.take("rear").is_none());
        assert!(service.take("side").is_none() && service.take("front").is_some());
    }

    #[test]
    fn stored_port_is_assigned_to_its_current_link() {
        let line = |path| OwnedFd::from(std::fs::File::open(path).unwrap());
        let kept = [("front", "/dev/null"), ("rear", "/dev/zero"), ("side", "/dev/full")];
        let kept = kept.map(|(name, path)| (name.to_owned(), line(path)));
        let service = Service { kept_ports: Mutex::new(kept.into()), watchdog: None };
        let device = |line: &OwnedFd| rustix::fs::fstat(line).unwrap().st_rdev;
        let [null, zero] = ["/dev/null", "/dev/zero"].map(|path| device(&line(path)));
        // Two links have swapped their ports, and the third port has no link.
        service.assign(|line| match device(line) {
            it if it == null => Some("rear".to_owned()),
            it if it == zero => Some("front".to_owned()),
            _ => None,
        });
        let taken = ["front", "rear", "side"].map(|name| service.take(name).map(|line| device(&line)));
        assert_eq!(taken, [Some(zero), Some(null), None]);
    }
}
