//! `scanhub listen` on network links that fail for a short time. When a link fails, a switch that filters by multicast
//! group deletes the memberships of that link. The listener must then join its groups again.

use std::collections::BTreeSet;
use std::os::fd::OwnedFd;

use crate::testkit::{INT, Machine, TestEnv, command_in, in_a_network, ip, skip, status, wait_until};
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, eth, recv, socket_with};

/// Socket in place of a switch. It receives the IGMP messages (version 2) that a switch would receive.
struct FakeSwitch {
    socket: OwnedFd,
    /// Messages received so far. Each entry has the type of a message and the last byte of its group's address. A leave
    /// message removes the earlier reports of its group.
    memberships: BTreeSet<(u8, u8)>,
}

const IGMP_REPORT: u8 = 0x16;
const IGMP_LEAVE: u8 = 0x17;

impl FakeSwitch {
    fn new() -> FakeSwitch {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::PACKET, SocketType::DGRAM, flags, Some(eth::IP));
        FakeSwitch { socket: socket.expect("root can open a packet socket"), memberships: BTreeSet::new() }
    }

    /// Waits for a message of type `kind` for each group that a listener joins.
    fn wait_for_each_group(&mut self, description: &str, kind: u8) {
        let expected: BTreeSet<_> = (80..84).map(|group| (kind, group)).collect();
        wait_until(description, || {
            let mut bytes = [0; 2048];
            while let Ok((len, _)) = recv(&self.socket, &mut bytes[..], RecvFlags::DONTWAIT) {
                let Some((kind, group)) = message(&bytes[..len]) else { continue };
                if kind == IGMP_LEAVE {
                    self.memberships.remove(&(IGMP_REPORT, group));
                }
                self.memberships.insert((kind, group));
            }
            self.memberships.is_superset(&expected)
        });
    }
}

/// Returns the type and the last byte of the group's address of the IGMP message in an IP packet. Returns `None` for
/// other packets and for groups that do not belong to scanhub.
fn message(packet: &[u8]) -> Option<(u8, u8)> {
    const IGMP_PROTOCOL: u8 = 2;
    let header = usize::from(packet.first()? & 15) * 4;
    let message = packet.get(header..).filter(|_| packet[9] == IGMP_PROTOCOL)?;
    match *message {
        [kind, _, _, _, 239, 255, 76, group, ..] => Some((kind, group)),
        _ => None,
    }
}

#[test]
fn rejoins_groups_after_a_short_link_failure() {
    in_a_network("listen_links::rejoins_groups_after_a_short_link_failure", || {
        let machine = Machine::new(1);
        if !force_igmp_version_2(&machine, "eth0") {
            return;
        }
        let mut switch = FakeSwitch::new();
        let env = TestEnv::on(&machine);
        for words in [&["--interface=eth0"][..], &[]] {
            let listener = env.start(&[&["listen", "--json"], words].concat()).ready();
            switch.wait_for_each_group("the groups are joined", IGMP_REPORT);
            for _ in 0..3 {
                switch.memberships.clear();
                ip(&format!("link set {} down", machine.test_interface()));
                ip(&format!("link set {} up", machine.test_interface()));
                switch.wait_for_each_group("the groups were left", IGMP_LEAVE);
                switch.wait_for_each_group("the groups are joined again", IGMP_REPORT);
            }
            let outcome = listener.end(INT);
            assert_eq!((outcome.exit_code, outcome.of_class("notice").len()), (Some(0), 0), "{outcome}");
            switch.wait_for_each_group("the groups are left", IGMP_LEAVE);
            switch.memberships.clear();
        }
    });
}

#[test]
fn rejoins_groups_each_time_an_interface_is_recreated() {
    in_a_network("listen_links::rejoins_groups_each_time_an_interface_is_recreated", || {
        let machine = Machine::new(1);
        if !force_igmp_version_2(&machine, "default") {
            return;
        }
        let mut switch = FakeSwitch::new();
        let env = TestEnv::on(&machine);
        let listener = env.start(&["listen", "--json"]).ready();
        // A socket can join 20 groups, and the listener needs four. A new cable must therefore not use up more of these
        // 20 memberships.
        for _ in 0..8 {
            switch.memberships.clear();
            machine.replace_cable();
            switch.wait_for_each_group("the groups are joined again", IGMP_REPORT);
        }
        let outcome = listener.end(INT);
        assert_eq!((outcome.exit_code, outcome.of_class("notice").len()), (Some(0), 0), "{outcome}");
    });
}

/// Makes the kernel use IGMP version 2 on `interface` of `machine`. In this version, the kernel sends a leave message
/// for a group. A report after a leave message shows that the listener has joined again, and is not just the repetition
/// of the first report. Skips the test and returns false if the version cannot be selected.
fn force_igmp_version_2(machine: &Machine, interface: &str) -> bool {
    let mut version = command_in(&machine.network(), "sh");
    let path = format!("/proc/sys/net/ipv4/conf/{interface}/force_igmp_version");
    version.args(["-c", &format!("echo 2 > {path}")]);
    let is_done = status(version).is_ok_and(|status| status.success());
    if !is_done {
        skip("igmp", "its version cannot be selected");
    }
    is_done
}
