//! Monitors the network interface on which multicast datagrams are sent. The kernel accepts datagrams for an interface
//! without a carrier and drops them without an error, so the gateway has to check the interface itself.

use std::fmt::Display;
use std::io::{PipeReader, PipeWriter, pipe};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use scanhub_schema::{Failure, Kind};

use crate::interface::{Interface, InterfaceChanges, by_name, interfaces};

/// A network interface and its state. A separate thread monitors the interface, so that the sender reads the state
/// without a system call.
pub(super) struct InterfaceMonitor {
    name: String,
    state: State,
    /// Last state that the thread has read.
    latest: Arc<AtomicU64>,
    /// Closing this end of the pipe ends the thread.
    _end: PipeWriter,
}

/// State of an interface, as far as the sender needs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct State {
    /// The kernel's index; `None` if the interface does not exist.
    index: Option<u32>,
    is_up: bool,
}

/// Time after which a failed query of the kernel is repeated. A query fails while descriptors or memory are short.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);

impl InterfaceMonitor {
    /// Starts to monitor the interface called `name`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`], with a list of all interfaces, if the interface does not exist, and
    /// [`Kind::Failed`] if the interface cannot be monitored.
    pub(super) fn open(name: &str) -> Result<InterfaceMonitor, Failure> {
        let unwatched = |why: &dyn Display| {
            Failure::new(Kind::Failed, format!("cannot watch network interfaces: {why}"), "")
        };
        // Subscribe before reading the state, so that no change is missed in between.
        let changes = InterfaceChanges::subscribe()?;
        let found = by_name(name)?;
        let state = State::of(Some(&found));
        let latest = Arc::new(AtomicU64::new(state.to_word()));
        let (ending, end) = pipe().map_err(|error| unwatched(&error))?;
        let (name, thread_latest) = (found.name.clone(), latest.clone());
        thread::Builder::new()
            .name("interfaces".into())
            .spawn(move || monitor(&name, changes, &ending, &thread_latest))
            .map_err(|error| unwatched(&error))?;
        Ok(InterfaceMonitor { name: found.name, state, latest, _end: end })
    }

    /// Returns the interface's name.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Returns the kernel's index of the interface, or `None` while the interface does not exist. The index changes
    /// when the interface is created again.
    pub(super) fn index(&self) -> Option<u32> {
        self.state.index
    }

    /// Returns whether the interface is enabled and has a carrier and an IPv4 address.
    pub(super) fn is_up(&self) -> bool {
        self.state.is_up
    }

    /// Updates the state. Returns whether it has changed since the last call.
    pub(super) fn update(&mut self) -> bool {
        let state = State::from_word(self.latest.load(Ordering::Relaxed));
        std::mem::replace(&mut self.state, state) != state
    }
}

impl State {
    /// Returns the state of the interface `found`, or for `None` the state of a missing interface.
    fn of(found: Option<&Interface>) -> State {
        State {
            index: found.map(|found| found.index),
            is_up: found.is_some_and(|found| found.up && found.running && found.address.is_some()),
        }
    }

    /// Packs the state into one word, so that it can be stored atomically. Index 0 means that the interface does not
    /// exist, because the kernel gives no interface this index.
    fn to_word(self) -> u64 {
        u64::from(self.index.unwrap_or(0)) | u64::from(self.is_up) << 32
    }

    fn from_word(word: u64) -> State {
        State { index: Some(word as u32).filter(|index| *index != 0), is_up: word >> 32 != 0 }
    }
}

/// Stores each new state of the interface called `name` in `latest`, until `end` is closed. While the kernel cannot
/// list interfaces, the stored state does not change, and the query is repeated.
fn monitor(name: &str, mut changes: InterfaceChanges, end: &PipeReader, latest: &AtomicU64) {
    let mut timeout = None;
    loop {
        let mut fds = [PollFd::new(&changes, PollFlags::IN), PollFd::new(end, PollFlags::IN)];
        let polled = poll(&mut fds, timeout.as_ref());
        if !fds[1].revents().is_empty() {
            return;
        }
        if polled.is_err_and(|error| error != Errno::INTR) {
            thread::sleep(RETRY_INTERVAL);
        }
        changes.read(|_| {});
        match interfaces() {
            Ok(all) => {
                let state = State::of(all.iter().find(|one| one.name == name));
                latest.store(state.to_word(), Ordering::Relaxed);
                timeout = None;
            }
            Err(_) => {
                let nanos = i64::from(RETRY_INTERVAL.subsec_nanos());
                timeout = Some(Timespec { tv_sec: RETRY_INTERVAL.as_secs() as i64, tv_nsec: nanos });
            }
        }
    }
}

/// Returns the error for a gateway for which the user named neither an interface nor a host. Its hint lists all
/// interfaces. The gateway never chooses an interface itself, because everyone on the network there can read what is
/// sent to groups. If the system cannot list interfaces, returns the error of that query.
pub(super) fn no_destination() -> Failure {
    match interfaces() {
        Ok(all) => must_choose(&all),
        Err(failure) => failure,
    }
}

fn must_choose(all: &[Interface]) -> Failure {
    let describe = |one: &Interface| match (one.up, one.multicast, one.address) {
        (false, ..) => format!("{} (down)", one.name),
        (_, false, _) => format!("{} (no multicast)", one.name),
        (.., None) => format!("{} (no IPv4 address)", one.name),
        (.., Some(address)) if one.loopback => format!("{} ({address}, this machine only)", one.name),
        (.., Some(address)) => format!("{} ({address})", one.name),
    };
    let list = all.iter().map(describe).collect::<Vec<_>>().join(", ");
    let hint = format!(
        "everyone on the interface can read what is sent there: name one with --interface, or as `interface` under \
         [gateway]; there are {list}; or name hosts with --to"
    );
    Failure::new(Kind::Configuration, "no interface is named for the groups, and no host", hint)
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn interface(name: &str, address: Option<Ipv4Addr>) -> Interface {
        let index = 1;
        let loopback = name == "lo";
        Interface { name: name.into(), index, up: true, running: true, multicast: true, loopback, address }
    }

    #[test]
    fn error_lists_all_interfaces() {
        let some = Some(Ipv4Addr::LOCALHOST);
        let (lo, eth0, wlan0) = (interface("lo", some), interface("eth0", some), interface("wlan0", None));
        let down = Interface { name: "eth1".into(), up: false, ..eth0.clone() };
        let failure = must_choose(&[lo, eth0, wlan0, down]);
        assert_eq!(failure.kind, Kind::Configuration);
        let list =
            "lo (127.0.0.1, this machine only), eth0 (127.0.0.1), wlan0 (no IPv4 address), eth1 (down)";
        assert!(failure.hint.contains(list), "{failure}");
    }

    #[test]
    fn state_round_trips_through_a_word() {
        for state in [(None, false), (Some(1), false), (Some(u32::MAX), true)] {
            let state = State { index: state.0, is_up: state.1 };
            assert_eq!(State::from_word(state.to_word()), state);
        }
        let state = State { index: Some(1), is_up: true };
        let latest = Arc::new(AtomicU64::new(state.to_word()));
        let mut monitor = InterfaceMonitor { name: "lo".into(), state, latest, _end: pipe().unwrap().1 };
        assert!(!monitor.update() && monitor.is_up());
        monitor.latest.store(0, Ordering::Relaxed);
        assert!(monitor.update() && !monitor.is_up() && monitor.index().is_none() && !monitor.update());
    }

    #[test]
    fn is_up_needs_carrier_and_address() {
        let plugged = interface("eth0", Some(Ipv4Addr::LOCALHOST));
        let is_up = |found: Option<&Interface>| State::of(found).is_up;
        assert!(is_up(Some(&plugged)) && !is_up(None));
        assert!(!is_up(Some(&Interface { running: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { up: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { address: None, ..plugged })));
    }
}
