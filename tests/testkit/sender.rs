//! Gateway that a test controls. It sends numbered datagrams of one sensor on the loopback interface.

use std::net::{Ipv4Addr, UdpSocket};

use rustix::net::sockopt::set_ip_multicast_if;
use scanhub_schema::datagram::{
    Announce, Announced, DatagramPayload, GROUP_PREFIX, HEADER_LEN, Head, LanFlags, MAX_PART_LEN,
    MTU_ETHERNET, PORT, group,
};
use scanhub_schema::{Family, Status, Topic};
use serde_json::Value;

use super::{Program, wait_until};

/// Gateway with one sensor. A test can change each field of its headers.
pub(crate) struct TestGateway {
    socket: UdpSocket,
    pub(crate) hub: u64,
    pub(crate) epoch: u32,
    pub(crate) sensor: u8,
    /// Family of the scanner.
    pub(crate) family: Family,
    pub(crate) name: String,
    pub(crate) boot: u64,
    /// Sequence number of the next datagram of each topic, indexed by the number of the topic.
    pub(crate) next: [u32; 256],
    /// Counter of the current telegram.
    pub(crate) counter: u32,
    /// Stamp of the samples, in nanoseconds since 1970.
    pub(crate) stamp_ns: u64,
    /// Number of samples that [`prove_delivery`](TestGateway::prove_delivery) has sent. A listener counts these samples
    /// as `unnamed`.
    pub(crate) delivery_proofs: u32,
}

/// Number of a sensor that is never announced.
const UNANNOUNCED_SENSOR: u8 = 255;

impl TestGateway {
    /// Creates a gateway with the ID `hub`, in its run `epoch`, for the sensor with this number and name.
    pub(crate) fn new(hub: u64, epoch: u32, sensor: u8, name: &str) -> TestGateway {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a UDP port is free");
        set_ip_multicast_if(&socket, &Ipv4Addr::LOCALHOST).expect("the loopback has an address");
        let (boot, next, counter, stamp_ns) = (0xb007, [0; 256], 0, wall_ns());
        let (name, family) = (name.to_owned(), Family::Lms);
        TestGateway {
            socket,
            hub,
            epoch,
            sensor,
            family,
            name,
            boot,
            next,
            counter,
            stamp_ns,
            delivery_proofs: 0,
        }
    }

    /// Returns the next datagram of `topic`, without sending it.
    pub(crate) fn next_datagram(
        &mut self,
        topic: Topic,
        payload: &(impl DatagramPayload + ?Sized),
    ) -> Vec<u8> {
        let mut buffer = [0; MTU_ETHERNET];
        let len = payload.pack(&mut buffer[HEADER_LEN..]).expect("the payload fits into a datagram");
        self.seal(topic.number(), &mut buffer, len)
    }

    /// Returns the next datagram of topic `telegram`, without sending it.
    pub(crate) fn next_telegram(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut buffer = [0; MTU_ETHERNET];
        buffer[HEADER_LEN..HEADER_LEN + bytes.len()].copy_from_slice(bytes);
        self.seal(Topic::Telegram.number(), &mut buffer, bytes.len())
    }

    /// Sends the next sample of `topic`, in parts if it does not fit into one datagram.
    pub(crate) fn send(&mut self, topic: Topic, payload: &(impl DatagramPayload + ?Sized)) {
        let mut packed = vec![0; 100_000];
        let len = payload.pack(&mut packed).expect("the payload fits into a datagram");
        let parts = len.div_ceil(MAX_PART_LEN).max(1);
        let head = self.head(topic.number());
        for (part, payload) in packed[..len].chunks(MAX_PART_LEN).enumerate() {
            let mut buffer = [0; MTU_ETHERNET];
            buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
            let head = Head { part: part as u8, parts: parts as u8, ..head };
            self.send_bytes(
                topic,
                head.seal(&mut buffer, payload.len()).expect("the payload fits into a datagram"),
            );
        }
    }

    /// Sends these bytes to the group of `topic`.
    pub(crate) fn send_bytes(&self, topic: Topic, bytes: &[u8]) {
        self.send_to_group(group(topic), bytes);
    }

    /// Sends an announcement of `topics` with their next sequence numbers.
    pub(crate) fn announce(&mut self, topics: &[Topic]) {
        let datagram = self.announcement(topics);
        self.send_to_group(Announce::GROUP, &datagram);
    }

    /// Returns an announcement of `topics` with their next sequence numbers, stamped with the current time.
    pub(crate) fn announcement(&mut self, topics: &[Topic]) -> Vec<u8> {
        let mut announce = Announce::new(self.boot, &self.name, "LMS200;301063;V02.30");
        for &topic in topics {
            let next = self.next[usize::from(topic.number())];
            announce.add(Announced { topic: topic.number(), group: group(topic), port: PORT, next });
        }
        let mut buffer = [0; MTU_ETHERNET];
        let len = announce.pack(&mut buffer[HEADER_LEN..]).expect("the payload fits into a datagram");
        let stamp_ns = std::mem::replace(&mut self.stamp_ns, wall_ns());
        let datagram = self.seal(Announce::NUMBER, &mut buffer, len);
        self.stamp_ns = stamp_ns;
        datagram
    }

    /// Sends a sample of topic `status` for another sensor, which the gateway never announces. A listener that receives
    /// these samples for a second concludes that the network works and that the sensor under test is silent.
    pub(crate) fn prove_delivery(&mut self) {
        let status = usize::from(Topic::Status.number());
        let sensor = std::mem::replace(&mut self.sensor, UNANNOUNCED_SENSOR);
        let next = std::mem::replace(&mut self.next[status], self.delivery_proofs);
        self.send(Topic::Status, &Status::default());
        self.delivery_proofs = std::mem::replace(&mut self.next[status], next);
        self.sensor = sensor;
    }

    /// Announces `topics` until `listener` publishes the sensor, and returns the line in which the listener reports
    /// this. The listener must run without a key.
    pub(crate) fn wait_until_published(&mut self, listener: &mut Program, topics: &[Topic]) -> Value {
        let (hub, name) = (format!("{:016x}", self.hub), format!(".{}", self.name));
        let is_it = |line: &Value| {
            let is_named = line["sensor"].as_str().is_some_and(|sensor| sensor.ends_with(&name));
            line["kind"] == "published" && line["hub"] == hub.as_str() && is_named
        };
        let mut notice = Value::Null;
        wait_until("the sensor is published", || {
            self.announce(topics);
            self.prove_delivery();
            listener.printed(is_it).map(|line| notice = line).is_some()
        });
        notice
    }

    /// Sends a datagram with an empty payload for the topic with this number.
    pub(crate) fn send_empty(&mut self, number: u8) {
        let datagram = self.seal(number, &mut [0; HEADER_LEN], 0);
        self.send_to_group(Announce::GROUP, &datagram);
    }

    /// Sends these bytes to the group whose address ends in `group`.
    pub(crate) fn send_to_group(&self, group: u8, bytes: &[u8]) {
        let [a, b, c] = GROUP_PREFIX;
        let sent = self.socket.send_to(bytes, (Ipv4Addr::new(a, b, c, group), PORT));
        assert_eq!(sent.expect("the datagram can be sent on the loopback"), bytes.len());
    }

    fn seal(&mut self, topic: u8, buffer: &mut [u8], len: usize) -> Vec<u8> {
        self.head(topic).seal(buffer, len).expect("the payload fits into a datagram").to_vec()
    }

    /// Returns the header of the next sample of the topic with this number, and increases the topic's sequence number.
    fn head(&mut self, topic: u8) -> Head {
        let next = &mut self.next[usize::from(topic)];
        let head = Head {
            part: 0,
            parts: 1,
            family: self.family as u8,
            topic,
            flags: LanFlags::SIMULATED,
            hub: self.hub,
            epoch: self.epoch,
            sequence: *next,
            stamp_ns: self.stamp_ns,
            sensor: self.sensor,
            revision: 1,
            counter: self.counter,
        };
        *next = next.wrapping_add(1);
        head
    }
}

/// Returns the wall clock in nanoseconds since 1970.
pub(crate) fn wall_ns() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.expect("the clock is later than 1970").as_nanos() as u64
}
