//! A datagram that was accepted, as a sample: its header and payload in the words of shared memory. Refuses to know where it
//! goes.

use scanhub_schema::datagram::{Datagram, Head, LanFlags, Packed};
use scanhub_schema::{Flags, Header, Quality, Topic};

/// A sample of another machine.
pub struct Remote<'a> {
    /// Of which topic.
    pub topic: Topic,
    /// What came.
    pub datagram: Datagram<'a>,
    /// Life of its hub, 0 unknown.
    pub boot: u64,
    /// CLOCK_MONOTONIC of this machine when it came, in ns.
    pub arrival_ns: u64,
    /// How old it was then, if the clocks agree.
    pub age_ns: Option<u64>,
    /// It came after a newer one.
    pub late: bool,
    /// It has a MAC of the key that is given.
    pub authenticated: bool,
}

impl Remote<'_> {
    /// Returns the header that the sample has here, where process `pid` hands it on: stamps are those of its arrival, the
    /// sensor's is in `wall_ns`. It says no period, for a gateway may send every so many samples only.
    pub fn header(&self, pid: u32) -> Header {
        let head: &Head = &self.datagram.head;
        let quality = if head.flags & LanFlags::SUSPECT != 0 { Quality::Suspect } else { Quality::Clean };
        let same = LanFlags::SIMULATED | LanFlags::REPLAYED | LanFlags::STAMP_ESTIMATED;
        Header {
            seq: head.counter.into(),
            topic_seq: head.sequence.into(),
            stamp_first_ns: self.arrival_ns,
            stamp_last_ns: self.arrival_ns,
            wall_ns: head.stamp_ns,
            boot: self.boot,
            sensor: head.sensor,
            quality: quality as u8,
            flags: head.flags & same | Flags::REMOTE,
            family: head.family,
            hub_pid: pid,
            ..Header::default()
        }
    }

    /// Returns the payload, in full length. An account accepts none that cannot be had.
    pub fn payload<P: Packed + ?Sized>(&self) -> Option<Box<P>>
    where
        Box<P>: Default,
    {
        let mut payload = Box::default();
        P::unpack_into(&mut payload, self.datagram.payload).then_some(payload)
    }
}
