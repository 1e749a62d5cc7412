//! The payload of a sample as it goes over a network. Refuses to know what becomes of it.

use scanhub_lan::outgoing::PayloadRef;
use scanhub_schema::datagram::{HEAD, PARTS};

use super::Terms;
use crate::topics::Sample;

/// Declares from the table of topics how the bytes of a sample are read.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Hands what `sample` says to `to`.
        pub(super) fn lend<R>(sample: &Sample, to: impl FnOnce(PayloadRef<'_>) -> R) -> R {
            match sample.topic {
                $(scanhub_schema::Topic::$topic => to(PayloadRef::$topic(payloads!($payload sample))),)*
            }
        }
    };
    ([u8] $sample:ident) => {
        &$sample.bytes
    };
    (Scan $sample:ident) => {
        &scanhub_schema::Scan::of_bytes(&$sample.bytes)
    };
    (Foreground $sample:ident) => {
        &scanhub_schema::Foreground::of_bytes(&$sample.bytes)
    };
    (Background $sample:ident) => {
        &scanhub_schema::Background::of_bytes(&$sample.bytes)
    };
    (Cloud $sample:ident) => {
        &scanhub_schema::Cloud::of_bytes(&$sample.bytes)
    };
    ($payload:ident $sample:ident) => {
        &bytemuck::pod_read_unaligned::<scanhub_schema::$payload>(&$sample.bytes)
    };
}

scanhub_schema::for_each_topic!(payloads);

/// Room for a payload as in datagrams: of some payloads it says how much goes into it.
pub(crate) struct Packet {
    room: Vec<u8>,
}

impl Packet {
    pub(crate) fn new(terms: &Terms) -> Packet {
        // A bridge sends samples whole.
        let room = if terms.are_bridges { u16::MAX.into() } else { PARTS * (terms.longest - HEAD) };
        Packet { room: vec![0; room] }
    }

    /// What `sample` is in datagrams; nothing if it does not fit.
    pub(crate) fn of(&mut self, sample: &Sample) -> Option<&[u8]> {
        let len = lend(sample, |payload| payload.pack(&mut self.room))?;
        self.room.get(..len)
    }
}
