//! A sample of another machine as a line of output, for programs and for people. Refuses to know where it came from.

use std::io::{self, Write};

use crate::lan::incoming::Remote;
use scanhub_schema::datagram::Head;
use scanhub_schema::{Header, Topic};
use serde::{Serialize, Serializer};

use scanhub_verbs::json;
use scanhub_verbs::output::{End, Output};
use scanhub_verbs::show::{Keys, Show};

/// A line of JSON; `sensor` is called so by [`PeerTable::name`](crate::lan::incoming::PeerTable::name).
pub(super) fn json(remote: &Remote<'_>, sensor: &str, out: &mut Output<'_>) -> Result<(), End> {
    // The flags come behind all that there is of a sample here.
    let header = Header { flags: 0, ..remote.header(std::process::id()) };
    show(remote, Line { remote, sensor, header: &header, out })
}

/// A line for people; `hub` is what the gateway is called, `sensor` as above.
pub(super) fn text(remote: &Remote<'_>, hub: &str, sensor: &str, line: &mut Vec<u8>) -> io::Result<()> {
    write!(line, "{hub}.{sensor}/{} ", remote.topic.name())?;
    show(remote, ForPeople { header: &remote.header(std::process::id()), line })?;
    if let Some(age_ms) = age_ms(remote) {
        write!(line, ", {age_ms:.1} ms old")?;
    }
    if remote.late { write!(line, ", late") } else { Ok(()) }
}

fn age_ms(remote: &Remote<'_>) -> Option<f64> {
    remote.age_ns.map(|age_ns| (age_ns / 1000) as f64 / 1000.0)
}

/// Declares how a payload of any topic is had, from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Has the payload shown by `how`; nothing becomes of one that cannot be had.
        fn show<E>(remote: &Remote<'_>, how: impl Way<E>) -> Result<(), E> {
            match remote.topic {
                $(Topic::$topic => remote
                    .payload::<scanhub_schema::payload_type!($payload)>()
                    .map_or(Ok(()), |payload| how.show(&*payload)),)*
            }
        }
    };
}

scanhub_schema::for_each_topic!(payloads);

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
        let Remote { topic, datagram, late, authenticated, .. } = self.remote;
        let Head { hub, epoch, .. } = datagram.head;
        let has_head = !matches!(topic, Topic::Background | Topic::Status);
        let flags = has_head.then(|| json::Words::of(&self.remote.header(std::process::id())));
        let age_ms = age_ms(self.remote);
        self.out.json(&WithOrigin {
            keys,
            hub,
            epoch,
            authenticated: *authenticated,
            age_ms,
            late: *late,
            flags,
        })
    }
}

/// A hub's id, as in all output.
pub(super) fn id<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:016x}"))
}
