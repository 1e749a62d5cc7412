//! Tests of datagrams: readers in other languages, tools that show datagrams, and gateways on networks with faults.

mod c;
mod capture;
mod damaged;
#[path = "../../schema/tests/datagram/describe.rs"]
mod describe;
mod keyed_vectors;
mod link_failures;
mod python;
mod readers;
mod vectors;
mod wireshark;
