//! Whether the interface that the configuration names for groups can send what a gateway sends to them. Without a name
//! nothing is sent to groups, and a listener receives on every interface that has a link. Sends nothing.

use super::finding::Finding;
use super::system::System;

const NAME: &str = "multicast";

/// Judges the interface that the configuration names.
pub(crate) fn multicast(system: &System, interface: Option<&str>) -> Finding {
    match interface {
        Some(name) => named(system, name),
        None => Finding::skipped(NAME, "no gateway.interface is named, so nothing is sent to groups"),
    }
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
            format!("by {name}, as set in gateway.interface; its state is not shown here"),
        );
    };
    if flags & LOOPBACK != 0 {
        return Finding::ok(NAME, format!("by {name}, as set in gateway.interface: this machine only"));
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
    Finding::ok(NAME, format!("by {name}, as set in gateway.interface; it is up"))
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

    #[test]
    fn an_interface_that_is_named_is_there_up_and_plugged_in() {
        let head = "Inter-|   Receive\n face |bytes\n";
        let files = [("sys/class/net/lo/flags", "0x9\n"), ("proc/net/dev", &format!("{head}    lo: 1 2\n"))];
        let laid = Laid::out(7, &files);
        let of = |name: &str| multicast(&laid.system, Some(name));
        assert_eq!(multicast(&laid.system, None).state, State::Skipped);
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
