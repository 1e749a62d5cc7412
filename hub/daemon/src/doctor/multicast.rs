//! Whether what a gateway sends to groups, and what a listener hears, gets out of this machine, and by which interface.
//! Sends nothing: the kernel tells the route of a socket that is connected.

use std::net::{IpAddr, Ipv4Addr, UdpSocket};

use schema::datagram::{Announce, GROUPS, PORT};

use super::finding::Finding;
use super::system::System;

const NAME: &str = "multicast";

/// Judges the interface that the configuration names, else the route to the groups.
pub(crate) fn multicast(system: &System, interface: Option<&str>) -> Finding {
    match interface {
        Some(name) => named(system, name),
        None => judge(route(), &system.text("proc/net/route").unwrap_or_default()),
    }
}

/// The group that all others stand for.
fn group() -> Ipv4Addr {
    Ipv4Addr::from([GROUPS[0], GROUPS[1], GROUPS[2], Announce::GROUP])
}

/// The address that datagrams to the group would come from, or why there is none.
fn route() -> Result<Ipv4Addr, String> {
    let connected = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).and_then(|socket| {
        socket.connect((group(), PORT))?;
        socket.local_addr()
    });
    match connected.map(|address| address.ip()) {
        Ok(IpAddr::V4(address)) => Ok(address),
        Ok(IpAddr::V6(address)) => Err(format!("it would come from {address}")),
        Err(error) => Err(error.to_string()),
    }
}

fn judge(route: Result<Ipv4Addr, String>, table: &str) -> Finding {
    let group = group();
    let remedy = "plug the network in; without a default route: sudo ip route add 239.255.76.0/24 dev eth0; needed by \
                  `gateway` and `listen` alone, which on one machine take --interface lo";
    match route {
        Err(why) => Finding::warning(NAME, format!("no route to {group}: {why}"), remedy),
        // Out of the loopback the group is reached from no address at all.
        Ok(address) if address.is_loopback() || interface_to(group, table) == Some("lo") => {
            Finding::warning(NAME, format!("the route to {group} leads back to this machine, by lo"), remedy)
        }
        Ok(address) => {
            let by = interface_to(group, table).map_or(String::new(), |name| format!(", by {name}"));
            Finding::ok(NAME, format!("{group} is reached from {address}{by}"))
        }
    }
}

/// The interface of the longest route to `group` in the kernel's table of them: name, destination, .., mask at the
/// eighth place, both as they lie in memory.
fn interface_to(group: Ipv4Addr, table: &str) -> Option<&str> {
    let bits = u32::from_ne_bytes(group.octets());
    let routes = table.lines().skip(1).filter_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let number = |at: usize| u32::from_str_radix(words.get(at)?, 16).ok();
        let (destination, mask) = (number(1)?, number(7)?);
        (bits & mask == destination).then_some((mask.count_ones(), *words.first()?))
    });
    routes.max_by_key(|(length, _)| *length).map(|(_, name)| name)
}

/// An interface of the configuration.
fn named(system: &System, name: &str) -> Finding {
    // Of the network of this process; what /sys has may be of another one's.
    let list = system.text("proc/net/dev").unwrap_or_default();
    let names: Vec<&str> = list.lines().filter_map(|line| Some(line.split_once(':')?.0.trim())).collect();
    if !names.contains(&name) {
        return Finding::failed(
            NAME,
            format!("gateway.interface: there is no network interface {name:?}"),
            format!("correct it, there are {}; or plug it in", names.join(", ")),
        );
    }
    let directory = system.path("sys/class/net").join(name);
    let number = |file: &str| {
        let text = std::fs::read_to_string(directory.join(file)).ok()?;
        u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()
    };
    let Some(flags) = number("flags") else {
        return Finding::ok(
            NAME,
            format!("by {name}, as gateway.interface says; its state is not shown here"),
        );
    };
    if flags & LOOPBACK != 0 {
        return Finding::ok(NAME, format!("by {name}, as gateway.interface says: for this machine alone"));
    }
    if flags & MULTICAST == 0 {
        let text = format!("gateway.interface: {name} carries no multicast");
        return Finding::failed(NAME, text, "name another one, or hosts under gateway.to");
    }
    if flags & UP == 0 {
        return Finding::warning(NAME, format!("{name} is down"), format!("sudo ip link set {name} up"));
    }
    if number("carrier") != Some(1) {
        return Finding::warning(NAME, format!("{name} is up and has no link"), "plug its cable in");
    }
    Finding::ok(NAME, format!("by {name}, as gateway.interface says; it is up"))
}

/// Flags of an interface (linux/if.h).
const UP: u32 = 0x1;
const LOOPBACK: u32 = 0x8;
const MULTICAST: u32 = 0x1000;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::super::system::tests::Laid;
    use super::*;

    const TABLE: &str = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n\
                         eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0\n\
                         wlan0\t000000EF\t00000000\t0001\t0\t0\t0\t000000FF\t0\t0\t0\n\
                         eth1\t000200C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0\n";

    #[test]
    fn the_longest_route_counts() {
        if cfg!(target_endian = "big") {
            return;
        }
        assert_eq!(interface_to(group(), TABLE), Some("wlan0"));
        assert_eq!(interface_to(Ipv4Addr::new(10, 0, 0, 1), TABLE), Some("eth0"));
        assert_eq!(interface_to(group(), ""), None);
    }

    #[test]
    fn a_way_out_is_one_to_other_machines() {
        let of = |route: Result<Ipv4Addr, &str>| judge(route.map_err(str::to_owned), TABLE);
        assert_eq!(of(Ok(Ipv4Addr::new(192, 0, 2, 2))).state, State::Ok);
        let none = of(Err("Network is unreachable"));
        assert!(none.state == State::Warning && none.finding.contains("unreachable"), "{none}");
        let back = of(Ok(Ipv4Addr::LOCALHOST));
        assert!(back.state == State::Warning && back.finding.contains("by lo"), "{back}");
        if cfg!(target_endian = "little") {
            let table = TABLE.replace("wlan0", "lo");
            assert_eq!(judge(Ok(Ipv4Addr::UNSPECIFIED), &table).state, State::Warning);
        }
    }

    #[test]
    fn an_interface_that_is_named_is_there_up_and_plugged_in() {
        let head = "Inter-|   Receive\n face |bytes\n";
        let files = [("sys/class/net/lo/flags", "0x9\n"), ("proc/net/dev", &format!("{head}    lo: 1 2\n"))];
        let laid = Laid::out("multicast", 7, &files);
        let of = |name: &str| multicast(&laid.system, Some(name));
        assert_eq!(of("lo").state, State::Ok);
        let missing = of("eth0");
        assert!(missing.state == State::Failed && missing.remedy.contains("there are lo"), "{missing}");
        laid.put("proc/net/dev", &format!("{head}    lo: 1 2\n  eth0: 3 4\n"));
        assert_eq!(of("eth0").state, State::Ok, "nothing is known of it");
        for (flags, carrier, state) in [
            ("0x1", "1", State::Failed),
            ("0x1002", "0", State::Warning),
            ("0x1003", "0", State::Warning),
            ("0x1003", "1", State::Ok),
        ] {
            laid.put("sys/class/net/eth0/flags", flags);
            laid.put("sys/class/net/eth0/carrier", carrier);
            assert_eq!(of("eth0").state, state, "{flags} {carrier}");
        }
    }
}
