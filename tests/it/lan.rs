//! Datagrams as other languages and tools read them, and what networks do to them.

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
