//! A topic of a remote sensor as it goes on here. Its numbers are such that consumers see what the network lost: they go on
//! over lives of the gateway, and begin again with each life of the hub, as a hub's own do. Refuses to know what is in a
//! sample, and where it is published.

use scanhub_schema::Header;

use super::arrivals::Arrivals;
use crate::lan::incoming::Remote;

/// One topic of one remote sensor.
#[derive(Default)]
pub struct Stream {
    /// Life of the gateway, sensor's number there, and its own number, of the last one that came from the network. The first
    /// one has its number of the network here too, so that consumers that outlive a listener see what was lost meanwhile.
    last: Option<(u32, u8, u32)>,
    arrivals: Arrivals,
}

/// What a sample is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Placed {
    /// So many numbers of the topic are left out before it: consumers miss them.
    pub left_out: u64,
    /// Its header, with the time that is between two samples as they are sent, but without its number in the topic.
    pub header: Header,
}

impl Stream {
    /// Takes `remote`, which is not late, as the next sample of the topic, which process `pid` publishes. All numbers between
    /// the last one and it are left out, be they lost or not published; of a new life of the gateway all before it. Where the
    /// sensor has another number than before, those before it may have been another one's: none counts.
    pub fn place(&mut self, remote: &Remote<'_>, pid: u32) -> Placed {
        let head = &remote.datagram.head;
        let next = (head.epoch, head.sensor, head.sequence);
        let steps = self.last.and_then(|last| steps(last, next));
        let left_out = match (steps, self.last) {
            (Some(steps), _) => steps.wrapping_sub(1),
            (None, Some((epoch, ..))) if head.epoch == epoch => 0,
            (None, _) => head.sequence,
        };
        self.last = Some(next);
        let period_us = self.arrivals.period_us(remote.arrival_ns, steps.unwrap_or_default().into());
        Placed { left_out: left_out.into(), header: Header { period_us, ..remote.header(pid) } }
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
