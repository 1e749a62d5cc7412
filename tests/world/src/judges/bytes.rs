//! Bytes are conserved: what a status says was read is what the port handed out, and each byte of it is in a telegram, an
//! acknowledgement, discarded, or still in the buffer.

use scanhub_schema::{Counter, Nanos, Status, Topic};

use super::{Judge, Say};
use crate::event::Event;

/// Bytes that each port handed to the hub that lives.
pub(crate) struct Bytes(Vec<u64>);

impl Bytes {
    pub(crate) fn new(sensors: usize) -> Bytes {
        Bytes(vec![0; sensors])
    }
}

impl Judge for Bytes {
    fn name(&self) -> &'static str {
        "bytes"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match event {
            Event::HubBegins { .. } => self.0.fill(0),
            Event::Read { sensor, len, .. } => self.0[*sensor] += *len as u64,
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = |counter| status.counters[counter];
                let read = of(Counter::BytesRead);
                let parts = [
                    Counter::BytesInTelegrams,
                    Counter::BytesAcknowledge,
                    Counter::BytesDiscarded,
                    Counter::BytesBuffered,
                ];
                let known: u64 = parts.into_iter().map(of).sum();
                let handed = self.0[*sensor];
                if (read, known) != (handed, handed) {
                    say.broken(format!("sensor {sensor}: {handed} handed out, {read} read, {known} known"));
                }
            }
            _ => {}
        }
    }
}
