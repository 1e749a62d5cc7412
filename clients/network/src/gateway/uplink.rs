//! The network interface that datagrams to groups leave by, and whether anything gets out there. The kernel takes
//! datagrams for an interface whose cable is out, and says nothing. Refuses to know what is sent.

use std::fmt::Display;
use std::io::{PipeReader, PipeWriter, pipe};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use scanhub_schema::{Failure, Kind};

use crate::interface::{Changes, Interface, interfaces, named};

/// A network interface and its state, which a thread of its own watches: who sends has nothing to ask the kernel.
pub(super) struct Uplink {
    name: String,
    state: State,
    /// What the watch saw last.
    seen: Arc<AtomicU64>,
    /// Closed, it ends the watch.
    _end: PipeWriter,
}

/// What of an interface matters to who sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct State {
    index: Option<u32>,
    is_up: bool,
}

/// Between two questions to a kernel that cannot tell, because descriptors or memory are short.
const AGAIN: Duration = Duration::from_millis(500);

impl Uplink {
    /// The interface called `name`.
    ///
    /// [`Kind::Configuration`] with those that there are if it is not there, [`Kind::Failed`] if it cannot be watched.
    pub(super) fn open(name: &str) -> Result<Uplink, Failure> {
        let unwatched = |why: &dyn Display| {
            Failure::new(Kind::Failed, format!("cannot watch network interfaces: {why}"), "")
        };
        // First the watch: what changes after the look is heard.
        let changes = Changes::watch()?;
        let found = named(name)?;
        let state = State::of(Some(&found));
        let seen = Arc::new(AtomicU64::new(state.word()));
        let (ending, end) = pipe().map_err(|error| unwatched(&error))?;
        let (name, theirs) = (found.name.clone(), seen.clone());
        thread::Builder::new()
            .name("interfaces".into())
            .spawn(move || watch(&name, changes, &ending, &theirs))
            .map_err(|error| unwatched(&error))?;
        Ok(Uplink { name: found.name, state, seen, _end: end })
    }

    /// Its name.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Its number; it has another one each time that it is made, and none while it is not there.
    pub(super) fn index(&self) -> Option<u32> {
        self.state.index
    }

    /// It is up, has a carrier and an IPv4 address.
    pub(super) fn is_up(&self) -> bool {
        self.state.is_up
    }

    /// Takes note of what changed since the last call; whether that was the number or the state of this interface.
    pub(super) fn look(&mut self) -> bool {
        let state = State::in_word(self.seen.load(Ordering::Relaxed));
        std::mem::replace(&mut self.state, state) != state
    }
}

impl State {
    fn of(found: Option<&Interface>) -> State {
        State {
            index: found.map(|found| found.index),
            is_up: found.is_some_and(|found| found.up && found.running && found.address.is_some()),
        }
    }

    /// In one word, so that it is seen whole: no interface has number 0.
    fn word(self) -> u64 {
        u64::from(self.index.unwrap_or(0)) | u64::from(self.is_up) << 32
    }

    fn in_word(word: u64) -> State {
        State { index: Some(word as u32).filter(|index| *index != 0), is_up: word >> 32 != 0 }
    }
}

/// Keeps what is `seen` of the interface called `name` as it is, until `end` is closed. If the kernel cannot tell what
/// there is now, all stays as it was and it is asked again.
fn watch(name: &str, mut changes: Changes, end: &PipeReader, seen: &AtomicU64) {
    let mut again = None;
    loop {
        let mut fds = [PollFd::new(&changes, PollFlags::IN), PollFd::new(end, PollFlags::IN)];
        let polled = poll(&mut fds, again.as_ref());
        if !fds[1].revents().is_empty() {
            return;
        }
        if polled.is_err_and(|error| error != Errno::INTR) {
            thread::sleep(AGAIN);
        }
        changes.take(|_| {});
        match interfaces() {
            Ok(all) => {
                let state = State::of(all.iter().find(|one| one.name == name));
                seen.store(state.word(), Ordering::Relaxed);
                again = None;
            }
            Err(_) => {
                let nanos = i64::from(AGAIN.subsec_nanos());
                again = Some(Timespec { tv_sec: AGAIN.as_secs() as i64, tv_nsec: nanos });
            }
        }
    }
}

/// Nobody said where to send: what goes to groups is heard by everybody on the network, so that it goes to none that was
/// not named.
///
/// [`Kind::Failed`] instead if the system does not tell its interfaces.
pub(super) fn nowhere() -> Failure {
    match interfaces() {
        Ok(all) => choose_one(&all),
        Err(failure) => failure,
    }
}

fn choose_one(all: &[Interface]) -> Failure {
    let tell = |one: &Interface| match (one.up, one.multicast, one.address) {
        (false, ..) => format!("{} (down)", one.name),
        (_, false, _) => format!("{} (no multicast)", one.name),
        (.., None) => format!("{} (no IPv4 address)", one.name),
        (.., Some(address)) if one.loopback => format!("{} ({address}, this machine only)", one.name),
        (.., Some(address)) => format!("{} ({address})", one.name),
    };
    let list = all.iter().map(tell).collect::<Vec<_>>().join(", ");
    let hint = format!(
        "everybody on the interface can read what is sent there: name one with --interface, or as `interface` under \
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
    fn who_names_none_is_told_which_there_are() {
        let some = Some(Ipv4Addr::LOCALHOST);
        let (lo, eth0, wlan0) = (interface("lo", some), interface("eth0", some), interface("wlan0", None));
        let down = Interface { name: "eth1".into(), up: false, ..eth0.clone() };
        let failure = choose_one(&[lo, eth0, wlan0, down]);
        assert_eq!(failure.kind, Kind::Configuration);
        let list =
            "lo (127.0.0.1, this machine only), eth0 (127.0.0.1), wlan0 (no IPv4 address), eth1 (down)";
        assert!(failure.hint.contains(list), "{failure}");
    }

    #[test]
    fn a_state_is_one_word() {
        for state in [(None, false), (Some(1), false), (Some(u32::MAX), true)] {
            let state = State { index: state.0, is_up: state.1 };
            assert_eq!(State::in_word(state.word()), state);
        }
        let state = State { index: Some(1), is_up: true };
        let seen = Arc::new(AtomicU64::new(state.word()));
        let mut uplink = Uplink { name: "lo".into(), state, seen, _end: pipe().unwrap().1 };
        assert!(!uplink.look() && uplink.is_up());
        uplink.seen.store(0, Ordering::Relaxed);
        assert!(uplink.look() && !uplink.is_up() && uplink.index().is_none() && !uplink.look());
    }

    #[test]
    fn what_gets_nothing_out_is_not_up() {
        let plugged = interface("eth0", Some(Ipv4Addr::LOCALHOST));
        let is_up = |found: Option<&Interface>| State::of(found).is_up;
        assert!(is_up(Some(&plugged)) && !is_up(None));
        assert!(!is_up(Some(&Interface { running: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { up: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { address: None, ..plugged })));
    }
}
