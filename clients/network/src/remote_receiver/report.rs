//! Output of a receiver: its samples as lines, notices about problems, and the counters of everything that arrived or
//! was lost.

use std::io::{self, Write};
use std::path::Path;

use scanhub_schema::datagram::{Announce, DatagramError, Head, PORT};
use scanhub_schema::{Header, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::json;
use scanhub_verbs::output::{ExitReason, Output, table};
use scanhub_verbs::show::{Keys, Show};
use serde::Serialize;
use serde::ser::{SerializeMap, Serializer};

use super::names::Names;
use super::publish::Publication;
use crate::lan::incoming::ReceivedSample;
use crate::lan::{EvictedTotals, GatewayTable, StreamCounters};

/// Names of the classes of JSON lines with counters. They depend on the network.
#[derive(Clone, Copy, Debug)]
pub struct ClassNames {
    counters: &'static str,
    refused: &'static str,
    evicted: &'static str,
    published: &'static str,
    no_room: &'static str,
    /// Whether the counters include samples that senders replaced by newer ones.
    has_replaced: bool,
}

impl ClassNames {
    /// Classes of `listen`.
    pub const LAN: ClassNames = ClassNames {
        counters: "lan",
        refused: "lan_refused",
        evicted: "lan_evicted",
        published: "lan_published",
        no_room: "lan_no_room",
        has_replaced: false,
    };
    /// Classes of the bridge.
    pub const BRIDGE: ClassNames = ClassNames {
        counters: "bridge",
        refused: "bridge_refused",
        evicted: "bridge_evicted",
        published: "bridge_published",
        no_room: "bridge_no_room",
        has_replaced: true,
    };
}

/// Output of a receiver.
pub(crate) struct Report<'a> {
    json: bool,
    classes: ClassNames,
    out: Output<'a>,
    notes: Output<'a>,
    /// Names of gateways in text.
    pub(super) names: Names,
    /// Name of the key that datagrams are authenticated with.
    key: Option<String>,
    /// Number of lines of counters that were drawn on the terminal.
    drawn: usize,
}

impl<'a> Report<'a> {
    pub(super) fn new(
        json: bool,
        classes: ClassNames,
        out: Output<'a>,
        notes: Output<'a>,
        names: Names,
        key: Option<String>,
    ) -> Report<'a> {
        Report { json, classes, out, notes, names, key, drawn: 0 }
    }

    /// Reports that the groups are joined on `interfaces`, and in which `domain` samples are published.
    pub(crate) fn ready(&mut self, interfaces: &[&str], domain: Option<&Domain>) -> Result<(), ExitReason> {
        let key = self.key.as_deref();
        if self.json {
            return self.out.json(&ReadyJson::new(interfaces, domain, key));
        }
        self.notes.line(|line| match key {
            Some(key) => write!(line, "only datagrams with key {key} are accepted"),
            None => write!(
                line,
                "no key: any machine on this network can send false data; see `scanhub key new` and --key-file"
            ),
        })?;
        self.notes.line(|line| match interfaces {
            [] => write!(line, "no network interface has a link, waiting for one"),
            some => write!(line, "listening on {}", some.join(", ")),
        })
    }

    /// Prints a sample of `sensor`.
    pub(super) fn sample(&mut self, sensor: &str, remote: &ReceivedSample<'_>) -> Result<(), ExitReason> {
        if self.json {
            return sample_json(remote, sensor, &mut self.out);
        }
        let hub = self.names.of(remote.head.hub);
        self.out.line(|line| sample_text(remote, &hub, sensor, line))
    }

    /// Reports samples that were sent before the one with `head` and have not arrived.
    pub(super) fn missed(
        &mut self,
        head: &Head,
        sensor: &str,
        topic: Topic,
        missed: u32,
    ) -> Result<(), ExitReason> {
        if self.json {
            let (sensor, topic) = (Some(sensor), Some(topic.name()));
            return self.out.json(&NoticeJson { sensor, topic, missed, ..NoticeJson::of("missed", head) });
        }
        let hub = self.names.of(head.hub);
        self.notes.line(|line| write!(line, "{hub}.{sensor}/{}: missed {missed}", topic.name()))
    }

    /// Reports the name of the sensor that sent `head`. The sensor was printed under its number before.
    pub(super) fn name_announced(&mut self, head: &Head, sensor: &str) -> Result<(), ExitReason> {
        let number = head.sensor;
        if self.json {
            let (sensor, number) = (Some(sensor), Some(number));
            return self.out.json(&NoticeJson { sensor, number, ..NoticeJson::of("named", head) });
        }
        let hub = self.names.of(head.hub);
        self.notes.line(|line| write!(line, "{hub}.#{number} is {hub}.{sensor}"))
    }

    /// Reports that the clock of the gateway that sent `head` lags this machine's clock by `behind_ns`, or is ahead of
    /// it if the value is negative.
    pub(super) fn clocks_differ(&mut self, head: &Head, behind_ns: i64) -> Result<(), ExitReason> {
        let behind_ms = behind_ns as f64 / 1e6;
        if self.json {
            let behind_ms = Some(behind_ms);
            return self.out.json(&NoticeJson { behind_ms, ..NoticeJson::of("clocks_differ", head) });
        }
        let hub = self.names.of(head.hub);
        let (ms, which) = (behind_ms.abs(), if behind_ms < 0.0 { "ahead of" } else { "behind" });
        self.notes.line(|line| {
            write!(line, "{hub}: its clock is {ms:.0} ms {which} this machine's, so ages are not shown")
        })
    }

    /// Reports that a remote sensor is published as `name`. `here` is true if the sensor's gateway is on this machine.
    pub(super) fn published(&mut self, head: &Head, name: &str, here: bool) -> Result<(), ExitReason> {
        if self.json {
            return self.out.json(&NoticeJson {
                sensor: Some(name),
                here,
                ..NoticeJson::of("published", head)
            });
        }
        let which = if here {
            ", whose gateway is on this machine: use --hub HUB to receive only others"
        } else {
            ""
        };
        self.notes.line(|line| write!(line, "publishing {name}{which}"))
    }

    /// Prints the counters of published samples.
    pub(super) fn publication(
        &mut self,
        publication: &Publication,
        gateways: &GatewayTable,
    ) -> Result<(), ExitReason> {
        let line = PublishedJson::new(publication, self.classes.published);
        if self.json {
            self.out.json(&line)?
        } else {
            self.out.line(|out| line.text(out))?
        }
        for (hub, no_room) in gateways.no_room() {
            if self.json {
                self.out.json(&NoRoomJson { class: self.classes.no_room, hub, no_room })?;
            } else {
                let hub = self.names.of(hub);
                self.out.line(|line| write!(line, "of {hub}: {no_room} beyond --memory"))?;
            }
        }
        Ok(())
    }

    /// Reports a problem.
    pub(super) fn problem(&mut self, what: &str) -> Result<(), ExitReason> {
        if self.json {
            let notice = NoticeJson::of("problem", &Head::default());
            return self.out.json(&NoticeJson { hub: None, epoch: None, message: Some(what), ..notice });
        }
        self.notes.line(|line| write!(line, "{what}"))
    }

    /// Draws the counters over the previous ones.
    pub(super) fn draw(&mut self, gateways: &GatewayTable) -> Result<(), ExitReason> {
        if self.drawn > 0 {
            self.out.raw(format!("\x1b[{}A\x1b[J", self.drawn).as_bytes())?;
        }
        self.drawn = gateways.rows().count() + 2 + usize::from(gateways.evicted().runs > 0);
        self.write_counters(gateways, &[])
    }

    /// Prints the counters. On a terminal, draws over the previous ones. `others` are further reasons for which
    /// datagrams were refused.
    pub(super) fn stats(
        &mut self,
        gateways: &GatewayTable,
        others: &[(&'static str, u64)],
    ) -> Result<(), ExitReason> {
        if !self.json {
            return if self.drawn > 0 { self.draw(gateways) } else { self.write_counters(gateways, others) };
        }
        for row in gateways.rows() {
            let sensor = gateways.row_name(row);
            let replaced = gateways.replaced(row);
            self.out.json(&CountersJson {
                class: self.classes.counters,
                hub: row.hub,
                epoch: row.epoch,
                sensor: &sensor,
                topic: topic(row),
                received: row.received,
                lost: row.lost(),
                duplicate: row.duplicate,
                reordered: row.reordered,
                authenticated: (!self.classes.has_replaced).then_some(self.key.is_some()),
                replaced: self.classes.has_replaced.then_some(replaced),
            })?;
        }
        self.out.json(&EvictedJson::new(gateways.evicted(), self.classes.evicted))?;
        self.out.json(&RefusedJson { class: self.classes.refused, reasons: Reasons { gateways, others } })
    }

    fn write_counters(
        &mut self,
        gateways: &GatewayTable,
        others: &[(&'static str, u64)],
    ) -> Result<(), ExitReason> {
        let titles = ["HUB", "EPOCH", "TOPIC", "RECEIVED", "LOST", "DUPLICATE", "REORDERED", "REPLACED"];
        let titles = &titles[..titles.len() - usize::from(!self.classes.has_replaced)];
        let mut rows = vec![titles.iter().map(|title| String::from(*title)).collect()];
        rows.extend(gateways.rows().map(|row| {
            let replaced = gateways.replaced(row);
            let replaced = replaced.map_or_else(|| "-".into(), |count| count.to_string());
            let mut cells = vec![
                self.names.of(row.hub),
                row.epoch.to_string(),
                format!("{}/{}", gateways.row_name(row), topic(row)),
                row.received.to_string(),
                row.lost().to_string(),
                row.duplicate.to_string(),
                row.reordered.to_string(),
            ];
            cells.extend(self.classes.has_replaced.then_some(replaced));
            cells
        }));
        table(&mut self.out, &rows)?;
        let evicted = gateways.evicted();
        if evicted.runs > 0 {
            self.out.line(|line| EvictedJson::new(evicted, self.classes.evicted).text(line))?;
        }
        self.out.line(|line| {
            write!(line, "refused:")?;
            let mut any = false;
            for (reason, count) in (Reasons { gateways, others }).all().filter(|(_, count)| *count > 0) {
                write!(line, " {reason} {count}")?;
                any = true;
            }
            if any { Ok(()) } else { write!(line, " none") }
        })
    }
}

/// JSON line of class `lan` or `bridge`, with the counters of one topic of a sensor.
#[derive(Serialize)]
struct CountersJson<'a> {
    class: &'static str,
    #[serde(serialize_with = "id")]
    hub: u64,
    epoch: u32,
    sensor: &'a str,
    topic: &'static str,
    received: u64,
    lost: u64,
    duplicate: u64,
    reordered: u64,
    /// Present only for `listen`, because only UDP datagrams may have a MAC.
    #[serde(skip_serializing_if = "Option::is_none")]
    authenticated: Option<bool>,
    /// Number of samples that the sender has replaced, as it announced. Present only for a bridge.
    #[serde(skip_serializing_if = "Option::is_none")]
    replaced: Option<Option<u32>>,
}

/// Class `lan_refused` or `bridge_refused`.
#[derive(Serialize)]
struct RefusedJson<'a> {
    class: &'static str,
    #[serde(flatten)]
    reasons: Reasons<'a>,
}

/// Refused datagrams by reason.
struct Reasons<'a> {
    gateways: &'a GatewayTable,
    others: &'a [(&'static str, u64)],
}

impl Reasons<'_> {
    fn all(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let known =
            DatagramError::ALL.into_iter().map(|reason| (reason.name(), self.gateways.refused(reason)));
        known.chain(self.others.iter().copied())
    }
}

impl Serialize for Reasons<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        for (reason, count) in self.all() {
            map.serialize_entry(reason, &count)?;
        }
        map.end()
    }
}

/// Returns the name of the row's topic.
fn topic(row: &StreamCounters) -> &'static str {
    match Topic::of_number(row.topic) {
        Some(topic) => topic.name(),
        None if row.topic == Announce::NUMBER => "announce",
        None => "unknown",
    }
}

/// JSON line of class `notice`.
#[derive(Serialize)]
struct NoticeJson<'a> {
    class: &'static str,
    kind: &'static str,
    sensor: Option<&'a str>,
    topic: Option<&'static str>,
    missed: u32,
    #[serde(serialize_with = "known_id")]
    hub: Option<u64>,
    epoch: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    behind_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    message: Option<&'a str>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    here: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    number: Option<u8>,
}

impl NoticeJson<'_> {
    /// Creates a notice without details.
    fn of(kind: &'static str, head: &Head) -> Self {
        NoticeJson {
            class: "notice",
            kind,
            sensor: None,
            topic: None,
            missed: 0,
            hub: Some(head.hub),
            epoch: Some(head.epoch),
            behind_ms: None,
            message: None,
            here: false,
            number: None,
        }
    }
}

/// JSON line of class `ready`. Only a receiver that publishes has `domain`, `root` and `pid`.
#[derive(Serialize)]
struct ReadyJson<'a> {
    class: &'static str,
    port: u16,
    interfaces: &'a [&'a str],
    key: Option<&'a str>,
    #[serde(flatten)]
    location: Option<LocationJson<'a>>,
}

#[derive(Serialize)]
struct LocationJson<'a> {
    domain: &'a str,
    root: &'a Path,
    pid: u32,
}

impl<'a> ReadyJson<'a> {
    fn new(interfaces: &'a [&'a str], domain: Option<&'a Domain>, key: Option<&'a str>) -> ReadyJson<'a> {
        let location = domain.map(|domain| LocationJson {
            domain: domain.name(),
            root: domain.root(),
            pid: std::process::id(),
        });
        ReadyJson { class: "ready", port: PORT, interfaces, key, location }
    }
}

/// Class `lan_published` or `bridge_published`.
#[derive(Serialize)]
struct PublishedJson<'a> {
    class: &'static str,
    sensors: Vec<&'a str>,
    unnamed: u64,
    unannounced: u64,
    late: u64,
    capacity: u64,
    shortage: u64,
    unproven: u64,
    no_room: u64,
    loan_failed: u64,
}

/// Class `lan_no_room` or `bridge_no_room`: samples of one gateway.
#[derive(Serialize)]
struct NoRoomJson {
    class: &'static str,
    #[serde(serialize_with = "id")]
    hub: u64,
    no_room: u64,
}

impl<'a> PublishedJson<'a> {
    fn new(publication: &'a Publication, class: &'static str) -> PublishedJson<'a> {
        let dropped = publication.dropped;
        PublishedJson {
            class,
            sensors: publication.names(),
            unnamed: dropped.unnamed,
            unannounced: dropped.unannounced,
            late: dropped.late,
            capacity: dropped.capacity,
            shortage: dropped.shortage,
            unproven: dropped.unproven,
            no_room: dropped.no_room,
            loan_failed: publication.failed(),
        }
    }

    /// Writes the counters as text.
    fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        let PublishedJson { unnamed, unannounced, late, capacity, shortage, .. } = self;
        let PublishedJson { unproven, no_room, loan_failed, .. } = self;
        write!(line, "published: {}; not published: {unnamed} unnamed, ", self.sensors.join(", "))?;
        write!(line, "{unproven} in a gateway's first second, ")?;
        write!(line, "{unannounced} unannounced, {late} late, {capacity} beyond capacity, ")?;
        write!(line, "{no_room} beyond --memory, {shortage} for lack of room, {loan_failed} without memory")
    }
}

/// Class `lan_evicted` or `bridge_evicted`.
#[derive(Serialize)]
struct EvictedJson {
    class: &'static str,
    runs: u64,
    evicted_active: u64,
    received: u64,
    lost: u64,
    duplicate: u64,
    reordered: u64,
    no_room: u64,
}

impl EvictedJson {
    fn new(evicted: EvictedTotals, class: &'static str) -> EvictedJson {
        let EvictedTotals { runs, evicted_active, received, lost, duplicate, reordered, no_room } = evicted;
        EvictedJson { class, runs, evicted_active, received, lost, duplicate, reordered, no_room }
    }

    /// Writes the counters as text.
    fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        let EvictedJson { runs, evicted_active, received, lost, duplicate, reordered, no_room, .. } = self;
        write!(line, "{runs} runs of gateways were evicted, {evicted_active} before their end: ")?;
        write!(line, "received {received}, lost {lost}, ")?;
        write!(line, "duplicate {duplicate}, reordered {reordered}")?;
        if *no_room > 0 { write!(line, ", {no_room} beyond --memory") } else { Ok(()) }
    }
}

fn known_id<S: Serializer>(hub: &Option<u64>, serializer: S) -> Result<S::Ok, S::Error> {
    match hub {
        Some(hub) => id(hub, serializer),
        None => serializer.serialize_none(),
    }
}

/// Prints a sample of `sensor` as JSON.
fn sample_json(remote: &ReceivedSample<'_>, sensor: &str, out: &mut Output<'_>) -> Result<(), ExitReason> {
    // Leave out the flags here, because they are written after all other keys.
    let header = Header { flags: 0, ..remote.header(std::process::id()) };
    show(remote, JsonLine { remote, sensor, header: &header, out })
}

/// Writes a sample of `sensor` and its gateway `hub` as text.
fn sample_text(remote: &ReceivedSample<'_>, hub: &str, sensor: &str, line: &mut Vec<u8>) -> io::Result<()> {
    write!(line, "{hub}.{sensor}/{} ", remote.topic.name())?;
    show(remote, TextLine { header: &remote.header(std::process::id()), line })?;
    if let Some(age_ms) = age_ms(remote) {
        write!(line, ", {age_ms:.1} ms old")?;
    }
    if remote.late { write!(line, ", late") } else { Ok(()) }
}

fn age_ms(remote: &ReceivedSample<'_>) -> Option<f64> {
    remote.age_ns.map(|age_ns| (age_ns / 1000) as f64 / 1000.0)
}

/// Generates `show` from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Shows the payload by `how`, unless there is too little memory to unpack it.
        fn show<E>(remote: &ReceivedSample<'_>, how: impl PrintFormat<E>) -> Result<(), E> {
            match remote.topic {
                $(Topic::$topic => remote
                    .payload
                    .unpack::<scanhub_schema::payload_type!($payload)>()
                    .map_or(Ok(()), |payload| how.show(&*payload)),)*
            }
        }
    };
}

scanhub_schema::for_each_topic!(payloads);

/// A form in which a payload is printed.
trait PrintFormat<E> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> Result<(), E>;
}

struct TextLine<'a> {
    header: &'a Header,
    line: &'a mut Vec<u8>,
}

impl PrintFormat<io::Error> for TextLine<'_> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> io::Result<()> {
        payload.text(self.header, self.line)
    }
}

struct JsonLine<'a, 'out> {
    remote: &'a ReceivedSample<'a>,
    sensor: &'a str,
    header: &'a Header,
    out: &'a mut Output<'out>,
}

impl PrintFormat<ExitReason> for JsonLine<'_, '_> {
    fn show<P: Show + ?Sized>(self, payload: &P) -> Result<(), ExitReason> {
        let (sensor, header) = (self.sensor, self.header);
        payload.json(sensor, header, self)
    }
}

impl Keys for JsonLine<'_, '_> {
    /// Adds the keys that every class of a remote sample has after its own.
    fn take(self, keys: impl Serialize) -> Result<(), ExitReason> {
        #[derive(Serialize)]
        struct OriginFields<T: Serialize> {
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
            flags: Option<json::FlagNames>,
        }
        let ReceivedSample { topic, head: Head { hub, epoch, .. }, late, authenticated, .. } = *self.remote;
        let has_head = !matches!(topic, Topic::Background | Topic::Status);
        let flags = has_head.then(|| json::FlagNames::of(&self.remote.header(std::process::id())));
        let age_ms = age_ms(self.remote);
        self.out.json(&OriginFields { keys, hub, epoch, authenticated, age_ms, late, flags })
    }
}

/// Serializes a hub's ID in the form that all output has: 16 hex digits.
fn id<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:016x}"))
}
