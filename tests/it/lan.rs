//! Datagrams as other languages and tools read them, and what networks do to them.

mod c;
mod capture;
mod damaged;
mod keyed_vectors;
mod link_failures;
mod python;
mod readers;
#[path = "../../schema/tests/datagram/says.rs"]
mod says;
mod vectors;
mod wireshark;
