//! A datagram that was accepted, as a sample: its header in the words of shared memory, and its line of output.

use std::io::{self, Write};

use scanhub_client::Heard;
use schema::datagram::{Datagram, Head, LanFlags, Packed, telegram};
use schema::{Background, Flags, Foreground, Header, Marks, Quality, Scan, Status, Topic, Zones};
use serde::{Serialize, Serializer};

use crate::output::{End, Output};
use crate::{json, text};

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

    /// A line of JSON; `sensor` is called so by [`Roll::name`](super::roll::Roll::name).
    pub(super) fn json(&self, sensor: &str, out: &mut Output<'_>) -> Result<(), End> {
        // The flags come behind all that there is of a sample here.
        let header = &Header { flags: 0, ..self.header() };
        let payload = self.datagram.payload;
        match self.topic {
            Topic::Telegram => {
                telegram(payload).map(|it| self.line(out, json::telegram(sensor, header, it.0)))
            }
            Topic::Scan => self.payload().map(|it: Scan| self.line(out, json::scan(sensor, header, &it))),
            Topic::Marks => self.payload().map(|it: Marks| self.line(out, json::marks(sensor, header, &it))),
            Topic::Zones => self.payload().map(|it| self.line(out, json::zones(sensor, &heard(it, header)))),
            Topic::Foreground => {
                self.payload().map(|it: Foreground| self.line(out, json::foreground(sensor, header, &it)))
            }
            Topic::Background => {
                self.payload().map(|it: Background| self.line(out, json::background(sensor, &it)))
            }
            Topic::Status => self.payload().map(|it: Status| self.line(out, json::status(sensor, &it))),
        }
        .unwrap_or(Ok(()))
    }

    /// A line for people; `hub` is what the gateway is called, `sensor` as above.
    pub(super) fn text(&self, hub: &str, sensor: &str, line: &mut Vec<u8>) -> io::Result<()> {
        write!(line, "{hub}.{sensor}/{} ", self.topic.name())?;
        let header = &self.header();
        match self.topic {
            Topic::Telegram => telegram(self.datagram.payload).map(|it| text::telegram(line, header, it.0)),
            Topic::Scan => self.payload().map(|it| text::scan(line, header, &it)),
            Topic::Marks => self.payload().map(|it| text::marks(line, header, &it)),
            Topic::Zones => self.payload().map(|it| text::zones(line, &heard(it, header))),
            Topic::Foreground => self.payload().map(|it| text::foreground(line, header, &it)),
            Topic::Background => self.payload().map(|it| text::background(line, &it)),
            Topic::Status => self.payload().map(|it| text::status(line, &it)),
        }
        .unwrap_or(Ok(()))?;
        if let Some(age_ms) = self.age_ms() {
            write!(line, ", {age_ms:.1} ms old")?;
        }
        if self.late { write!(line, ", late") } else { Ok(()) }
    }

    /// What every class has here, behind its own keys.
    fn line(&self, out: &mut Output<'_>, sample: impl Serialize) -> Result<(), End> {
        #[derive(Serialize)]
        struct Line<T: Serialize> {
            #[serde(flatten)]
            sample: T,
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
        let Head { hub, epoch, .. } = self.datagram.head;
        // Nobody has keys yet: what is flagged may be as false as what is not.
        let authenticated = false;
        let has_head = !matches!(self.topic, Topic::Background | Topic::Status);
        let flags = has_head.then(|| json::Words::of(&self.header()));
        out.json(&Line { sample, hub, epoch, authenticated, age_ms: self.age_ms(), late: self.late, flags })
    }

    fn age_ms(&self) -> Option<f64> {
        self.age_ns.map(|age_ns| (age_ns / 1000) as f64 / 1000.0)
    }
}

/// A hub's id, as in all output.
pub(super) fn id<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:016x}"))
}

fn heard(zones: Zones, header: &Header) -> Heard {
    Heard { zones, header: Some(*header), missed: 0, stale: false, said: zones }
}
