//! `scanhub listen` and links that go away for a moment: what the switch behind them hears, which filters by group and
//! forgets who was there.

use std::collections::BTreeSet;
use std::os::fd::OwnedFd;

use crate::testkit::{INT, Machine, TestEnv, command_in, in_a_network, ip, skip, status, until};
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, eth, recv, socket_with};

/// What comes to the network of the test of IGMP, version 2.
struct Switch {
    socket: OwnedFd,
    /// A message's type and the last byte of its group; no report from before a leave.
    heard: BTreeSet<(u8, u8)>,
}

const REPORT: u8 = 0x16;
const LEAVE: u8 = 0x17;

impl Switch {
    fn new() -> Switch {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::PACKET, SocketType::DGRAM, flags, Some(eth::IP));
        Switch { socket: socket.expect("root of the network may"), heard: BTreeSet::new() }
    }

    /// Waits for such a message of each group that a listener joins.
    fn await_each(&mut self, what: &str, kind: u8) {
        let wanted: BTreeSet<_> = (80..84).map(|group| (kind, group)).collect();
        until(what, || {
            let mut bytes = [0; 2048];
            while let Ok((len, _)) = recv(&self.socket, &mut bytes[..], RecvFlags::DONTWAIT) {
                let Some((kind, group)) = message(&bytes[..len]) else { continue };
                if kind == LEAVE {
                    self.heard.remove(&(REPORT, group));
                }
                self.heard.insert((kind, group));
            }
            self.heard.is_superset(&wanted)
        });
    }
}

/// The message in an IP packet, if it is one of our groups.
fn message(packet: &[u8]) -> Option<(u8, u8)> {
    const IGMP: u8 = 2;
    let header = usize::from(packet.first()? & 15) * 4;
    let message = packet.get(header..).filter(|_| packet[9] == IGMP)?;
    match *message {
        [kind, _, _, _, 239, 255, 76, group, ..] => Some((kind, group)),
        _ => None,
    }
}

#[test]
fn a_link_that_is_away_for_a_moment_is_joined_again() {
    in_a_network("listen_links::a_link_that_is_away_for_a_moment_is_joined_again", || {
        let machine = Machine::new(1);
        if !speaks_version_2(&machine, "eth0") {
            return;
        }
        let mut switch = Switch::new();
        let env = TestEnv::on(&machine);
        for words in [&["--interface=eth0"][..], &[]] {
            let listener = env.start(&[&["listen", "--json"], words].concat()).ready();
            switch.await_each("the groups are joined", REPORT);
            for _ in 0..3 {
                switch.heard.clear();
                ip(&format!("link set {} down", machine.end()));
                ip(&format!("link set {} up", machine.end()));
                switch.await_each("the groups were left", LEAVE);
                switch.await_each("the groups are joined again", REPORT);
            }
            let outcome = listener.end(INT);
            assert_eq!((outcome.code, outcome.of_class("notice").len()), (Some(0), 0), "{outcome}");
            switch.await_each("the groups are left", LEAVE);
            switch.heard.clear();
        }
    });
}

#[test]
fn an_interface_that_is_made_anew_is_heard_as_often_as_that_happens() {
    in_a_network("listen_links::an_interface_that_is_made_anew_is_heard_as_often_as_that_happens", || {
        let machine = Machine::new(1);
        if !speaks_version_2(&machine, "default") {
            return;
        }
        let mut switch = Switch::new();
        let env = TestEnv::on(&machine);
        let listener = env.start(&["listen", "--json"]).ready();
        // A socket can join 20 groups, and there are four of them.
        for _ in 0..8 {
            switch.heard.clear();
            machine.make_cable_anew();
            switch.await_each("the groups are joined again", REPORT);
        }
        let outcome = listener.end(INT);
        assert_eq!((outcome.code, outcome.of_class("notice").len()), (Some(0), 0), "{outcome}");
    });
}

/// Lets whoever leaves a group on `interface` of `machine` say so, as it does in this version, so that joining again is not
/// the first time said twice; says so if it cannot.
fn speaks_version_2(machine: &Machine, interface: &str) -> bool {
    let mut version = command_in(&machine.network(), "sh");
    let path = format!("/proc/sys/net/ipv4/conf/{interface}/force_igmp_version");
    version.args(["-c", &format!("echo 2 > {path}")]);
    let is_done = status(version).is_ok_and(|status| status.success());
    if !is_done {
        skip("igmp", "its version cannot be chosen here");
    }
    is_done
}
