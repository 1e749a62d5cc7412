//! The service manager that started the hub, if one did: told that the hub is up, and that its links work; given the
//! ports to keep, so that what a sensor sends while a killed hub is replaced waits in the line's buffer. Refuses to know
//! what a port is, and which service manager it is (systemd's protocol, sd_notify(3)).

use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use rustix::io::{FdFlags, fcntl_setfd};
use schema::Nanos;
use sd_notify::NotifyState;

/// The service manager; without one, as by default, nothing of this does anything.
#[derive(Default)]
pub struct Service {
    /// What the one before this hub gave it to keep, by name.
    kept: Mutex<Vec<(String, OwnedFd)>>,
    /// So often it wants to hear that the hub works.
    watchdog: Option<Nanos>,
}

impl Service {
    /// That of this process, as its environment tells. To be called once, before anything else is opened.
    pub(crate) fn of_process() -> Service {
        let passed = sd_listen_fds::get().unwrap_or_else(|error| {
            tracing::warn!(%error, "ports that the service manager kept cannot be taken over");
            Vec::new()
        });
        let named = passed.into_iter().filter_map(|(name, line)| Some((name?, line.into_std())));
        let own = |(name, line): (String, OwnedFd)| {
            fcntl_setfd(&line, FdFlags::CLOEXEC).is_ok().then_some((name, line))
        };
        let watchdog = sd_notify::watchdog_enabled().map(|span| span.as_nanos() as Nanos);
        Service { kept: Mutex::new(named.filter_map(own).collect()), watchdog }
    }

    /// Puts what was kept under the name of the link that it is of now, whoever had it before; what is of none is not kept
    /// any longer. To be called before anything is kept again: names are forgotten with all that is kept under them.
    pub(crate) fn assign(&self, owner: impl Fn(&OwnedFd) -> Option<String>) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        for (name, line) in std::mem::take(&mut *kept) {
            let owner = owner(&line);
            if owner.as_ref() != Some(&name) {
                self.forget(&name);
            }
            kept.extend(owner.map(|owner| (owner, line)));
        }
    }

    /// What was kept under `name`, once.
    pub(crate) fn take(&self, name: &str) -> Option<OwnedFd> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let at = kept.iter().position(|(known, _)| known == name)?;
        Some(kept.swap_remove(at).1)
    }

    /// Lets it keep `line` under `name` until it is forgotten, hangs up, or the service is stopped.
    pub(crate) fn keep(&self, name: &str, line: impl AsFd) {
        let said = [NotifyState::FdStore, NotifyState::FdName(name)];
        told(sd_notify::notify_with_fds(&said, &[line.as_fd()]));
    }

    /// Lets it close what it keeps under `name`.
    pub(crate) fn forget(&self, name: &str) {
        told(sd_notify::notify(&[NotifyState::FdStoreRemove, NotifyState::FdName(name)]));
    }

    /// The configuration is read again, as of `now`; [`ready`](Self::ready) follows in any case.
    pub(crate) fn reloading(&self, now: Nanos) {
        let micros = NotifyState::MonotonicUsec(i128::from(now / 1_000));
        told(sd_notify::notify(&[NotifyState::Reloading, micros]));
    }

    /// The hub is up with `sensors`, at its start or with a configuration that it read again; or that was `refused`, and it is
    /// as it was.
    pub(crate) fn ready(&self, sensors: &[String], refused: Option<&str>) {
        let refused = refused.map(|why| format!("; configuration refused: {why}")).unwrap_or_default();
        let status = format!("sensors: {}{refused}", sensors.join(", "));
        told(sd_notify::notify(&[NotifyState::Ready, NotifyState::Status(&status)]));
    }

    /// The hub ends because it was told to.
    pub(crate) fn stopping(&self) {
        told(sd_notify::notify(&[NotifyState::Stopping]));
    }
}

/// Tells the service manager that the hub works as long as all its links do: each of them finished something since that
/// was last told. A timer would tell only that there is time.
pub(crate) struct Watchdog<'a> {
    worked: &'a [AtomicBool],
    every: Nanos,
    next: Nanos,
}

impl<'a> Watchdog<'a> {
    /// One over the links that set `worked`; nothing if the service manager does not want to know.
    pub(crate) fn new(service: &Service, worked: &'a [AtomicBool], now: Nanos) -> Option<Watchdog<'a>> {
        let every = service.watchdog? / TOLD_EARLIER;
        Some(Watchdog { worked, every, next: now + every })
    }

    /// Tells it, if it is time and all worked. To be called more often than the service manager wants to hear.
    pub(crate) fn look(&mut self, now: Nanos) {
        if self.is_due(now) {
            told(sd_notify::notify(&[NotifyState::Watchdog]));
        }
    }

    fn is_due(&mut self, now: Nanos) -> bool {
        let is_due = now >= self.next && self.worked.iter().all(|worked| worked.load(Ordering::Relaxed));
        if is_due {
            self.worked.iter().for_each(|worked| worked.store(false, Ordering::Relaxed));
            self.next = now + self.every;
        }
        is_due
    }
}

/// That it cannot be told is no reason to stop: it will see for itself.
fn told(outcome: std::io::Result<()>) {
    if let Err(error) = outcome {
        tracing::debug!(%error, "the service manager cannot be notified");
    }
}

/// It hears so many times as often as it wants to: a link that waits for its next second is not late.
const TOLD_EARLIER: Nanos = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_when_all_links_worked_the_watchdog_is_fed() {
        let service = Service { kept: Mutex::default(), watchdog: Some(40) };
        let worked = [AtomicBool::new(true), AtomicBool::new(false)];
        let mut watchdog = Watchdog::new(&service, &worked, 100).expect("one is wanted");
        assert!(!watchdog.is_due(110), "one link did nothing");
        worked[1].store(true, Ordering::Relaxed);
        assert!(!watchdog.is_due(109), "not yet");
        assert!(watchdog.is_due(111));
        assert!(!watchdog.is_due(200), "nothing was done since");
        worked.iter().for_each(|worked| worked.store(true, Ordering::Relaxed));
        assert!(watchdog.is_due(200));
        let none = Service { kept: Mutex::default(), watchdog: None };
        assert!(Watchdog::new(&none, &worked, 0).is_none());
    }

    #[test]
    fn what_was_kept_is_taken_once() {
        let line = || OwnedFd::from(std::fs::File::open("/dev/null").unwrap());
        let kept = vec![("front".to_owned(), line()), ("rear".to_owned(), line())];
        let service = Service { kept: Mutex::new(kept), watchdog: None };
        assert!(service.take("rear").is_some() && service.take("rear").is_none());
        assert!(service.take("side").is_none() && service.take("front").is_some());
    }

    #[test]
    fn what_was_kept_is_of_whose_port_it_is_now() {
        let line = |path| OwnedFd::from(std::fs::File::open(path).unwrap());
        let kept = [("front", "/dev/null"), ("rear", "/dev/zero"), ("side", "/dev/full")];
        let kept = kept.map(|(name, path)| (name.to_owned(), line(path)));
        let service = Service { kept: Mutex::new(kept.into()), watchdog: None };
        let device = |line: &OwnedFd| rustix::fs::fstat(line).unwrap().st_rdev;
        let [null, zero] = ["/dev/null", "/dev/zero"].map(|path| device(&line(path)));
        // Two links have each other's port, the third one's is nobody's.
        service.assign(|line| match device(line) {
            it if it == null => Some("rear".to_owned()),
            it if it == zero => Some("front".to_owned()),
            _ => None,
        });
        let taken = ["front", "rear", "side"].map(|name| service.take(name).map(|line| device(&line)));
        assert_eq!(taken, [Some(zero), Some(null), None]);
    }
}
