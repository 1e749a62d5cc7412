//! The network interface that datagrams leave by: which one is meant, and whether anything gets out there. The kernel
//! takes datagrams for an interface whose cable is out, and says nothing. Refuses to know what is sent.

use std::time::{Duration, Instant};

use schema::{Failure, Kind};

use crate::interface::{Changes, Interface, interfaces, named};

/// A network interface and its state.
pub(super) struct Uplink {
    name: String,
    changes: Changes,
    index: Option<u32>,
    is_up: bool,
    /// When the kernel is asked again that could not tell.
    again_at: Option<Instant>,
}

/// Between two questions to a kernel that cannot tell, because descriptors or memory are short.
const AGAIN: Duration = Duration::from_millis(500);

impl Uplink {
    /// The interface called `name`; without a name the only one that is up, not the loopback, and has multicast and an
    /// IPv4 address.
    ///
    /// [`Kind::Configuration`] with those that there are if it is not there, or not just one.
    pub(super) fn choose(name: Option<&str>) -> Result<Uplink, Failure> {
        // First the watch: what changes after the look is heard.
        let changes = Changes::watch()?;
        let found = match name {
            Some(name) => named(name)?,
            None => only(interfaces()?)?,
        };
        let mut uplink =
            Uplink { name: found.name.clone(), changes, index: None, is_up: false, again_at: None };
        uplink.learn(Some(&found));
        Ok(uplink)
    }

    /// Its name.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Its number; it has another one each time that it is made, and none while it is not there.
    pub(super) fn index(&self) -> Option<u32> {
        self.index
    }

    /// It is up, has a carrier and an IPv4 address.
    pub(super) fn is_up(&self) -> bool {
        self.is_up
    }

    /// Takes note of what changed since the last call; whether that was the number or the state of this interface. One
    /// system call as long as nothing did. If the kernel cannot tell what there is now, all stays as it is and it is asked
    /// again.
    pub(super) fn look(&mut self) -> bool {
        let is_again = self.again_at.is_some_and(|at| Instant::now() >= at);
        if !self.changes.take(|_| {}) && !is_again {
            return false;
        }
        let before = (self.index, self.is_up);
        let Ok(all) = interfaces() else {
            self.again_at = Some(Instant::now() + AGAIN);
            return false;
        };
        self.again_at = None;
        self.learn(all.iter().find(|one| one.name == self.name));
        before != (self.index, self.is_up)
    }

    fn learn(&mut self, found: Option<&Interface>) {
        self.index = found.map(|found| found.index);
        self.is_up = found.is_some_and(|found| found.up && found.running && found.address.is_some());
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
    fn what_gets_nothing_out_is_not_up() {
        let plugged = interface("eth0", Some(Ipv4Addr::LOCALHOST));
        let mut uplink = Uplink::choose(Some("lo")).unwrap();
        let mut is_up = |found: Option<&Interface>| {
            uplink.learn(found);
            uplink.is_up()
        };
        assert!(is_up(Some(&plugged)) && !is_up(None));
        assert!(!is_up(Some(&Interface { running: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { up: false, ..plugged.clone() })));
        assert!(!is_up(Some(&Interface { address: None, ..plugged })));
    }
}
