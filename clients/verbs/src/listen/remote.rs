//! A datagram that was accepted, as a sample: its header in the words of shared memory, and its line of output.

use std::io::{self, Write};

use schema::datagram::{Datagram, Head, LanFlags, Packed, telegram};
use schema::{Flags, Header, Pace, Quality, Topic};
use serde::{Serialize, Serializer};

use crate::json;
use crate::output::{End, Output};
use crate::show::{Keys, Show};

/// A sample of another machine.
pub(super) struct Remote<'a> {
    /// Of which topic.
    pub(super) topic: Topic,
    /// What came.
    pub(super) datagram: Datagram<'a>,
    /// Life of its hub, 0 unknown.
    pub(super) boot: u64,
    /// CLOCK_MONOTONIC of this machine when it came, in ns.
    pub(super) arrival_ns: u64,
    /// How old it was then, if the clocks agree.
    pub(super) age_ns: Option<u64>,
    /// It came after a newer one.
    pub(super) late: bool,
}

impl Remote<'_> {
    /// The header that the sample has here: stamps are those of its arrival, the sensor's is in `wall_ns`. It says no
    /// period, for a gateway may send every so many samples only.
    pub(super) fn header(&self) -> Header {
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
            flags: u16::from(head.flags & same) | Flags::REMOTE,
            hub_pid: std::process::id(),
            ..Header::default()
        }
    }

    /// The payload, in full length. An account accepts none that cannot be had.
    pub(super) fn payload<P: Packed + Default>(&self) -> Option<P> {
        let mut payload = P::default();
        payload.unpack(self.datagram.payload).then_some(payload)
    }

    /// A line of JSON; `sensor` is called so by [`PeerTable::name`](super::peer_table::PeerTable::name).
    pub(super) fn json(&self, sensor: &str, out: &mut Output<'_>) -> Result<(), End> {
        // The flags come behind all that there is of a sample here.
        let header = Header { flags: 0, ..self.header() };
        self.show(Line { remote: self, sensor, header: &header, out })
    }

    /// A line for people; `hub` is what the gateway is called, `sensor` as above.
    pub(super) fn text(&self, hub: &str, sensor: &str, line: &mut Vec<u8>) -> io::Result<()> {
        write!(line, "{hub}.{sensor}/{} ", self.topic.name())?;
        self.show(ForPeople { header: &self.header(), line })?;
        if let Some(age_ms) = self.age_ms() {
            write!(line, ", {age_ms:.1} ms old")?;
        }
        if self.late { write!(line, ", late") } else { Ok(()) }
    }

    fn age_ms(&self) -> Option<f64> {
        self.age_ns.map(|age_ns| (age_ns / 1000) as f64 / 1000.0)
    }
}

/// Declares how a payload of any topic is had, from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $about:literal;)*) => {
        impl Remote<'_> {
            /// Has the payload shown by `how`; nothing becomes of one that cannot be had.
            fn show<E>(&self, how: impl Way<E>) -> Result<(), E> {
                match self.topic {
                    $(Topic::$topic => payloads!($payload, self, how),)*
                }
            }
        }
    };
    ([u8], $remote:ident, $how:ident) => {
        telegram($remote.datagram.payload).map_or(Ok(()), |telegram| $how.show(telegram.0))
    };
    ($payload:ident, $remote:ident, $how:ident) => {
        $remote.payload::<schema::$payload>().map_or(Ok(()), |payload| $how.show(&payload))
    };
}

schema::for_each_topic!(payloads);

/// What becomes of a payload.
trait Way<E> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> Result<(), E>;
}

struct ForPeople<'a> {
    header: &'a Header,
    line: &'a mut Vec<u8>,
}

impl Way<io::Error> for ForPeople<'_> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> io::Result<()> {
        payload.text(self.header, self.line)
    }
}

struct Line<'a, 'out> {
    remote: &'a Remote<'a>,
    sensor: &'a str,
    header: &'a Header,
    out: &'a mut Output<'out>,
}

impl Way<End> for Line<'_, '_> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> Result<(), End> {
        let (sensor, header) = (self.sensor, self.header);
        payload.json(sensor, header, self)
    }
}

impl Keys for Line<'_, '_> {
    /// With what every class has here, behind its own keys.
    fn take(self, keys: impl Serialize) -> Result<(), End> {
        #[derive(Serialize)]
        struct WithOrigin<T: Serialize> {
            #[serde(flatten)]
            keys: T,
            #[serde(serialize_with = "id")]
            hub: u64,
            epoch: u32,
            authenticated: bool,
            age_ms: Option<f64>,
            #[serde(skip_serializing_if = "std::ops::Not::not")]
            late: bool,
            #[serde(flatten)]
            flags: Option<json::Words>,
        }
        let Remote { topic, datagram, late, .. } = self.remote;
        let Head { hub, epoch, .. } = datagram.head;
        // Nobody has keys yet: what is flagged may be as false as what is not.
        let authenticated = false;
        let has_head = topic.row().pace == Pace::Scan;
        let flags = has_head.then(|| json::Words::of(&self.remote.header()));
        let age_ms = self.remote.age_ms();
        self.out.json(&WithOrigin { keys, hub, epoch, authenticated, age_ms, late: *late, flags })
    }
}

/// A hub's id, as in all output.
pub(super) fn id<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:016x}"))
}
