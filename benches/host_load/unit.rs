//! The unit between two sensors and a network that others have, as far as its datagrams go: bare telegrams to a
//! multicast group on the loopback, a port for each sensor, each at the pace of a sensor. And the ear of who listens.

use std::net::{Ipv4Addr, UdpSocket};

use lms::variant::{MIRROR_TURN, Unit, Variant};
use rustix::net::sockopt::{
    set_ip_add_membership, set_ip_multicast_if, set_ip_multicast_ttl, set_socket_reuseaddr,
};
use rustix::net::{AddressFamily, SocketAddrV4, SocketFlags, SocketType, bind, socket_with};
use sim::room::Room;

use crate::support::{Outcome, clock};
use crate::work::MODE;

/// Sends for ever, to `port` for the first sensor and the next one for the second; prints `ready` first.
pub(crate) fn send(port: u16) -> Outcome<()> {
    let mouth = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    set_ip_multicast_if(&mouth, &Ipv4Addr::LOCALHOST)?;
    // Not even by a route that somebody made.
    set_ip_multicast_ttl(&mouth, 0)?;
    let rooms = [0, 1].map(telegrams);
    println!("ready");
    let begin = clock::now();
    for number in 0.. {
        for (sensor, telegrams) in rooms.iter().enumerate() {
            // Sensors turn as they like; here half a scan apart.
            clock::rest(begin + number * PERIOD + sensor as u64 * PERIOD / 2);
            let telegram = &telegrams[number as usize % telegrams.len()];
            mouth.send_to(telegram, (GROUP, port + sensor as u16))?;
        }
    }
    Ok(())
}

/// Hears what is sent to `port` of the group, as any number of others do.
pub(crate) fn ear(port: u16) -> Outcome<UdpSocket> {
    let socket = socket_with(AddressFamily::INET, SocketType::DGRAM, SocketFlags::CLOEXEC, None)?;
    set_socket_reuseaddr(&socket, true)?;
    bind(&socket, &SocketAddrV4::new(GROUP, port))?;
    set_ip_add_membership(&socket, &GROUP, &Ipv4Addr::LOCALHOST)?;
    Ok(socket.into())
}

/// The first of two ports that this bench has for itself.
pub(crate) fn port() -> u16 {
    20_000 + (std::process::id() % 5_000) as u16 * 2
}

/// What a sensor sees in ten seconds.
fn telegrams(sensor: u64) -> Vec<Vec<u8>> {
    let room = Room::of_port(&"room".parse().expect("a world that the program brings along"), 1, sensor);
    let telegram = |number: u64| {
        let words = room.scan(Variant::HALF, Unit::Mm, MODE, number * PERIOD);
        lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
    };
    (1..=375).map(telegram).collect()
}

/// Of this machine only, by its scope and by the time to live.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 76, 90);
/// From scan to scan of 180 degrees in halves, in ns.
const PERIOD: u64 = 2 * MIRROR_TURN;
