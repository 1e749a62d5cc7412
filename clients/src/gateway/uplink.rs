//! The network interface that datagrams leave by: which one is meant, and whether anything gets out there. The kernel
//! takes datagrams for an interface whose cable is out, and says nothing. Refuses to know what is sent.

use std::fmt::Display;
use std::io::{PipeReader, PipeWriter, pipe};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use schema::{Failure, Kind};

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
    /// The interface called `name`; without a name the only one that is up, not the loopback, and has multicast and an
    /// IPv4 address.
    ///
    /// [`Kind::Configuration`] with those that there are if it is not there, or not just one.
    pub(super) fn choose(name: Option<&str>) -> Result<Uplink, Failure> {
        let unwatched = |why: &dyn Display| {
            Failure::new(Kind::Failed, format!("cannot watch network interfaces: {why}"), "")
        };
        // First the watch: what changes after the look is heard.
        let changes = Changes::watch()?;
        let found = match name {
            Some(name) => named(name)?,
            None => only(interfaces()?)?,
        };
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

/// The one of `all` that can be meant; one without a carrier, as at the start of a robot, is one too.
fn only(mut all: Vec<Interface>) -> Result<Interface, Failure> {
    let is_candidate = |one: &Interface| one.up && one.multicast && !one.loopback && one.address.is_some();
    let candidates = all.iter().filter(|one| is_candidate(one)).count();
    match all.iter().position(is_candidate) {
        Some(at) if candidates == 1 => Ok(all.swap_remove(at)),
        _ => {
            let what = match candidates {
                0 => "no interface is up and has multicast and an IPv4 address",
                _ => "several interfaces have multicast",
            };
            let tell = |one: &Interface| match (one.up, one.address) {
                (false, _) => format!("{} (down)", one.name),
                (true, None) => format!("{} (no IPv4 address)", one.name),
                (true, Some(address)) => format!("{} ({address})", one.name),
            };
            let hint = all.iter().map(tell).collect::<Vec<_>>().join(", ");
            Err(Failure::new(Kind::Configuration, what, format!("name one by --interface: {hint}")))
        }
    }
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
    fn only_one_can_be_meant() {
        let some = Some(Ipv4Addr::LOCALHOST);
        let (lo, eth0, wlan0) = (interface("lo", some), interface("eth0", some), interface("wlan0", None));
        let unplugged = Interface { running: false, ..eth0.clone() };
        assert_eq!(only(vec![lo.clone(), wlan0.clone(), unplugged.clone()]), Ok(unplugged));
        let none = only(vec![lo.clone(), wlan0.clone()]).unwrap_err();
        assert!(none.kind == Kind::Configuration && none.hint.contains("wlan0 (no IPv4 address)"), "{none}");
        let two = only(vec![lo, eth0, Interface { address: some, ..wlan0 }]).unwrap_err();
        assert!(two.kind == Kind::Configuration && two.hint.contains("eth0 (127.0.0.1), wlan0"), "{two}");
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
