//! The publishing end of one topic of a remote sensor. Numbers its samples so that consumers see what the network lost: they
//! go on over lives of the gateway, and begin again with each life of the hub, as a hub's own do. Refuses to know what is
//! in a sample.

use schema::datagram::{Head, Packed, telegram};
use schema::ipc::{Node, Payload, Publisher, TopicService, UpdateConnections, ZeroCopySend};
use schema::{Failure, Header};

use super::super::remote::Remote;
use super::arrivals::Arrivals;

/// One topic.
pub(super) struct Outlet<P: Payload + ?Sized> {
    publisher: Publisher<P>,
    /// The number of the next sample if none is left out before it. The first one has that of the network, so that
    /// consumers that outlive a listener see what was lost meanwhile.
    next: Option<u64>,
    /// Life of the gateway, sensor's number there, and its own number, of the last one that came from the network.
    last: (u32, u8, u32),
    arrivals: Arrivals,
    /// Samples for which there was no memory.
    pub(super) failed: u64,
    _service: TopicService<P>,
}

impl<P: Payload + ?Sized> Outlet<P> {
    /// The topic of `sensor`.
    pub(super) fn new(node: &Node, sensor: &str) -> Result<Self, Failure> {
        let service = P::create(node, sensor)?;
        Ok(Outlet {
            publisher: P::publisher(&service)?,
            next: None,
            last: (0, 0, 0),
            arrivals: Arrivals::default(),
            failed: 0,
            _service: service,
        })
    }

    /// The header of `remote` here, with its number, and the time that is between two as they are sent.
    pub(super) fn header(&mut self, remote: &Remote<'_>) -> Header {
        let head = &remote.datagram.head;
        let steps = self.steps(head).unwrap_or_default();
        let topic_seq = self.number(head);
        let period_us = self.arrivals.period_us(remote.arrival_ns, steps.into());
        Header { topic_seq, period_us, ..remote.header() }
    }

    /// The number of a sample that did not come from the network.
    pub(super) fn own_number(&mut self) -> u64 {
        let number = self.next.unwrap_or_default();
        self.next = Some(number + 1);
        number
    }

    /// Connects who came since, and gives them what the topic keeps for late joiners.
    pub(super) fn connect(&self) {
        // One that cannot be connected now is tried again.
        let _ = self.publisher.update_connections();
    }

    /// The number of the sample with `head`. All numbers between the last one and it are left out, be they lost or not
    /// published; of a new life of the gateway all before it. Where the sensor has another number than before, those
    /// before it may have been another one's: none counts.
    fn number(&mut self, head: &Head) -> u64 {
        let left_out = match self.steps(head) {
            Some(steps) => steps.wrapping_sub(1),
            None if head.epoch == self.last.0 => 0,
            None => head.sequence,
        };
        let number = self.next.map_or(head.sequence.into(), |next| next + u64::from(left_out));
        self.last = (head.epoch, head.sensor, head.sequence);
        self.next = Some(number + 1);
        number
    }

    /// How many numbers the sample with `head` is behind the last one, if both are of one count.
    fn steps(&self, head: &Head) -> Option<u32> {
        steps(self.last, (head.epoch, head.sensor, head.sequence))
    }
}

impl Outlet<[u8]> {
    /// Publishes the telegram in `remote`.
    pub(super) fn send_telegram(&mut self, remote: &Remote<'_>) {
        let header = self.header(remote);
        let Some(telegram) = telegram(remote.datagram.payload) else { return };
        let Ok(loan) = self.publisher.loan_slice_uninit(telegram.0.len()) else {
            self.failed += 1;
            return;
        };
        let mut sample = loan.write_from_slice(telegram.0);
        *sample.user_header_mut() = header;
        self.failed += u64::from(sample.send().is_err());
    }
}

impl<P: Payload + ZeroCopySend + Default> Outlet<P> {
    /// Publishes a sample with `header` that `fill` writes in place.
    pub(super) fn send(&mut self, header: &Header, fill: impl FnOnce(&mut P)) {
        let Ok(mut sample) = self.publisher.loan() else {
            self.failed += 1;
            return;
        };
        *sample.user_header_mut() = *header;
        fill(sample.payload_mut());
        self.failed += u64::from(sample.send().is_err());
    }
}

impl<P: Payload + ZeroCopySend + Default + Packed> Outlet<P> {
    /// Publishes what `remote` says.
    pub(super) fn unpack(&mut self, remote: &Remote<'_>) {
        let header = self.header(remote);
        self.send(&header, |sample| {
            let _ = sample.unpack(remote.datagram.payload);
        });
    }
}

/// How many numbers `next` is behind `last`, each with its epoch and the sensor's number, if both are of one count. What comes
/// late is not published: a lower number is of another sender's count, who came in the place of a silent one.
fn steps(last: (u32, u8, u32), next: (u32, u8, u32)) -> Option<u32> {
    let steps = next.2.wrapping_sub(last.2);
    ((next.0, next.1) == (last.0, last.1) && steps <= u32::MAX / 2).then_some(steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_begin_anew_are_of_another_count() {
        assert_eq!(steps((1, 0, 100), (1, 0, 103)), Some(3));
        assert_eq!(steps((1, 0, u32::MAX), (1, 0, 1)), Some(2));
        assert_eq!(steps((1, 0, 100), (1, 0, 20)), None);
        assert_eq!(steps((1, 0, 100), (2, 0, 103)), None);
        assert_eq!(steps((1, 0, 100), (1, 1, 103)), None);
    }
}
