//! Simulation of the paper's unit between two sensors and a network. The simulation sends only datagrams: plain
//! telegrams to a multicast group on the loopback, with one port per sensor, at the rate of the sensors.

use std::net::{Ipv4Addr, UdpSocket};

use rustix::net::sockopt::{
    set_ip_add_membership, set_ip_multicast_if, set_ip_multicast_ttl, set_socket_reuseaddr,
};
use rustix::net::{AddressFamily, SocketAddrV4, SocketFlags, SocketType, bind, socket_with};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Unit, Variant};
use scanhub_sim::room::Room;

use crate::subscriber::MODE;
use crate::support::{Outcome, clock};

/// Prints `ready`, and then sends forever. The telegrams of the first sensor go to `port`, and those of the second
/// sensor to the next port.
pub(crate) fn send(port: u16) -> Outcome<()> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    set_ip_multicast_if(&socket, &Ipv4Addr::LOCALHOST)?;
    // With this time to live, datagrams do not leave the machine.
    set_ip_multicast_ttl(&socket, 0)?;
    let rooms = [0, 1].map(telegrams);
    println!("ready");
    let begin = clock::now();
    for number in 0.. {
        for (sensor, telegrams) in rooms.iter().enumerate() {
            // Real sensors are not synchronized. In this simulation, the scans of the two sensors are half a period
            // apart.
            clock::sleep_until(begin + number * SCAN_PERIOD_NS + sensor as u64 * SCAN_PERIOD_NS / 2);
            let telegram = &telegrams[number as usize % telegrams.len()];
            socket.send_to(telegram, (GROUP, port + sensor as u16))?;
        }
    }
    Ok(())
}

/// Returns a socket that receives the datagrams of the group for `port`. Several sockets can receive the same
/// datagrams.
pub(crate) fn receiver(port: u16) -> Outcome<UdpSocket> {
    let socket = socket_with(AddressFamily::INET, SocketType::DGRAM, SocketFlags::CLOEXEC, None)?;
    set_socket_reuseaddr(&socket, true)?;
    bind(&socket, &SocketAddrV4::new(GROUP, port))?;
    set_ip_add_membership(&socket, &GROUP, &Ipv4Addr::LOCALHOST)?;
    Ok(socket.into())
}

/// Returns the first of two ports that only this bench uses.
pub(crate) fn port() -> u16 {
    20_000 + (std::process::id() % 5_000) as u16 * 2
}

/// Returns the telegrams that a sensor sends in ten seconds.
fn telegrams(sensor: u64) -> Vec<Vec<u8>> {
    let room = Room::of_port(&"room".parse().expect("a built-in world"), 1, sensor);
    let telegram = |number: u64| {
        let words = room.scan(Variant::HALF, Unit::Mm, MODE, number * SCAN_PERIOD_NS);
        lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
    };
    (1..=375).map(telegram).collect()
}

/// A group whose datagrams never leave this machine, because of its scope and the time to live.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 76, 90);
/// Time from one scan of 361 beams to the next, in ns.
const SCAN_PERIOD_NS: u64 = 2 * MIRROR_PERIOD;
