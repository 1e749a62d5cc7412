//! What a receiver says beside samples: that it hears, what went wrong, and the account of everything that came and did
//! not.

mod classes;

use std::io::Write;

use crate::lan::incoming::{PeerTable, Remote};
use crate::lan::{Row, StreamStats};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, DatagramError, Head};
use scanhub_shm::Domain;
use serde::Serialize;
use serde::ser::{SerializeMap, Serializer};

use super::names::Names;
use super::publish::Publication;
use super::remote::{self, id};
use classes::{NoRoom, Notice, Published, Ready, Sums};
use scanhub_verbs::output::{End, Output, table};

/// The classes of an account, by the network that it is of.
#[derive(Clone, Copy, Debug)]
pub struct Words {
    row: &'static str,
    refused: &'static str,
    given_up: &'static str,
    published: &'static str,
    no_room: &'static str,
    /// Whether it is told how many samples senders replaced by newer ones.
    tells_replaced: bool,
}

impl Words {
    /// Datagrams of a LAN.
    pub const LAN: Words = Words {
        row: "lan",
        refused: "lan_refused",
        given_up: "lan_given_up",
        published: "lan_published",
        no_room: "lan_no_room",
        tells_replaced: false,
    };
    /// What comes over a bridge.
    pub const BRIDGE: Words = Words {
        row: "bridge",
        refused: "bridge_refused",
        given_up: "bridge_given_up",
        published: "bridge_published",
        no_room: "bridge_no_room",
        tells_replaced: true,
    };
}

/// Where it is said, and how.
pub(crate) struct Report<'a> {
    json: bool,
    words: Words,
    out: Output<'a>,
    notes: Output<'a>,
    /// What gateways are called for people.
    pub(super) names: Names,
    /// What the key is called without which nothing is believed, if there is one.
    key: Option<String>,
    /// Lines of the account that stand on the terminal.
    drawn: usize,
}

impl<'a> Report<'a> {
    pub(super) fn new(
        json: bool,
        words: Words,
        out: Output<'a>,
        notes: Output<'a>,
        names: Names,
        key: Option<String>,
    ) -> Report<'a> {
        Report { json, words, out, notes, names, key, drawn: 0 }
    }

    /// The groups are joined on `interfaces`; what comes will be published in `domain`, if there is one.
    pub(crate) fn ready(&mut self, interfaces: &[&str], domain: Option<&Domain>) -> Result<(), End> {
        let key = self.key.as_deref();
        if self.json {
            return self.out.json(&Ready::new(interfaces, domain, key));
        }
        self.notes.line(|line| match key {
            Some(key) => write!(line, "only datagrams with key {key} are believed"),
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

    /// A sample of the sensor that is called so.
    pub(super) fn sample(&mut self, sensor: &str, remote: &Remote<'_>) -> Result<(), End> {
        if self.json {
            return remote::json(remote, sensor, &mut self.out);
        }
        let hub = self.names.of(remote.datagram.head.hub);
        self.out.line(|line| remote::text(remote, &hub, sensor, line))
    }

    /// Samples of `topic` of `sensor` were sent before the one with `head` and did not come, or not yet.
    pub(super) fn missed(&mut self, head: &Head, sensor: &str, topic: Topic, missed: u32) -> Result<(), End> {
        if self.json {
            let (sensor, topic) = (Some(sensor), Some(topic.name()));
            return self.out.json(&Notice { sensor, topic, missed, ..Notice::of("missed", head) });
        }
        let hub = self.names.of(head.hub);
        self.notes.line(|line| write!(line, "{hub}.{sensor}/{}: missed {missed}", topic.name()))
    }

    /// The sensor that sent `head` is called so; what was written of it before has its number.
    pub(super) fn named(&mut self, head: &Head, sensor: &str) -> Result<(), End> {
        let number = head.sensor;
        if self.json {
            let (sensor, number) = (Some(sensor), Some(number));
            return self.out.json(&Notice { sensor, number, ..Notice::of("named", head) });
        }
        let hub = self.names.of(head.hub);
        self.notes.line(|line| write!(line, "{hub}.#{number} is {hub}.{sensor}"))
    }

    /// The clock of the machine that sent `head` is so much behind this one's.
    pub(super) fn clocks_differ(&mut self, head: &Head, behind_ns: i64) -> Result<(), End> {
        let behind_ms = behind_ns as f64 / 1e6;
        if self.json {
            let behind_ms = Some(behind_ms);
            return self.out.json(&Notice { behind_ms, ..Notice::of("clocks_differ", head) });
        }
        let hub = self.names.of(head.hub);
        let (ms, which) = (behind_ms.abs(), if behind_ms < 0.0 { "ahead of" } else { "behind" });
        self.notes.line(|line| {
            write!(line, "{hub}: its clock is {ms:.0} ms {which} this machine's, so ages are not shown")
        })
    }

    /// A remote sensor is published as `name`; `here`: it is this machine's own.
    pub(super) fn published(&mut self, head: &Head, name: &str, here: bool) -> Result<(), End> {
        if self.json {
            return self.out.json(&Notice { sensor: Some(name), here, ..Notice::of("published", head) });
        }
        let which = if here {
            ", whose gateway is on this machine: use --hub HUB to receive only others"
        } else {
            ""
        };
        self.notes.line(|line| write!(line, "publishing {name}{which}"))
    }

    /// What became of all that came, in shared memory.
    pub(super) fn publication(&mut self, publication: &Publication) -> Result<(), End> {
        let line = Published::new(publication, self.words.published);
        if self.json {
            self.out.json(&line)?
        } else {
            self.out.line(|out| line.text(out))?
        }
        for &(hub, no_room) in publication.no_room() {
            if self.json {
                self.out.json(&NoRoom { class: self.words.no_room, hub, no_room })?;
            } else {
                let hub = self.names.of(hub);
                self.out.line(|line| write!(line, "of {hub}: {no_room} beyond --memory"))?;
            }
        }
        Ok(())
    }

    /// Something is wrong here.
    pub(super) fn trouble(&mut self, what: &str) -> Result<(), End> {
        if self.json {
            let notice = Notice::of("trouble", &Head::default());
            return self.out.json(&Notice { hub: None, epoch: None, message: Some(what), ..notice });
        }
        self.notes.line(|line| write!(line, "{what}"))
    }

    /// The account as it stands, over the one that was drawn before.
    pub(super) fn draw(&mut self, stats: &StreamStats, peers: &PeerTable) -> Result<(), End> {
        if self.drawn > 0 {
            self.out.raw(format!("\x1b[{}A\x1b[J", self.drawn).as_bytes())?;
        }
        self.drawn = stats.rows().count() + 2 + usize::from(stats.given_up().lives > 0);
        self.text_account(stats, peers, &[])
    }

    /// The account as it stands, over the one that stands on the terminal, if any does; `others` are more reasons why
    /// something was refused.
    pub(super) fn stats(
        &mut self,
        stats: &StreamStats,
        peers: &PeerTable,
        others: &[(&'static str, u64)],
    ) -> Result<(), End> {
        if !self.json {
            return if self.drawn > 0 {
                self.draw(stats, peers)
            } else {
                self.text_account(stats, peers, others)
            };
        }
        for row in stats.rows() {
            let sensor = peers.row_name(row.hub, row.epoch, row.sensor);
            let replaced = peers.replaced(row.hub, row.epoch, row.sensor, row.topic);
            self.out.json(&Counted {
                class: self.words.row,
                hub: row.hub,
                epoch: row.epoch,
                sensor: &sensor,
                topic: topic(row),
                received: row.received,
                lost: row.lost(),
                duplicate: row.duplicate,
                reordered: row.reordered,
                authenticated: (!self.words.tells_replaced).then_some(self.key.is_some()),
                replaced: self.words.tells_replaced.then_some(replaced),
            })?;
        }
        self.out.json(&Sums::new(stats.given_up(), self.words.given_up))?;
        self.out.json(&Refused { class: self.words.refused, reasons: Reasons { stats, others } })
    }

    fn text_account(
        &mut self,
        stats: &StreamStats,
        peers: &PeerTable,
        others: &[(&'static str, u64)],
    ) -> Result<(), End> {
        let titles = ["HUB", "EPOCH", "TOPIC", "RECEIVED", "LOST", "DUPLICATE", "REORDERED", "REPLACED"];
        let titles = &titles[..titles.len() - usize::from(!self.words.tells_replaced)];
        let mut rows = vec![titles.iter().map(|title| String::from(*title)).collect()];
        rows.extend(stats.rows().map(|row| {
            let replaced = peers.replaced(row.hub, row.epoch, row.sensor, row.topic);
            let replaced = replaced.map_or_else(|| "-".into(), |count| count.to_string());
            let mut cells = vec![
                self.names.of(row.hub),
                row.epoch.to_string(),
                format!("{}/{}", peers.row_name(row.hub, row.epoch, row.sensor), topic(row)),
                row.received.to_string(),
                row.lost().to_string(),
                row.duplicate.to_string(),
                row.reordered.to_string(),
            ];
            cells.extend(self.words.tells_replaced.then_some(replaced));
            cells
        }));
        table(&mut self.out, &rows)?;
        let given_up = stats.given_up();
        if given_up.lives > 0 {
            self.out.line(|line| Sums::new(given_up, self.words.given_up).text(line))?;
        }
        self.out.line(|line| {
            write!(line, "refused:")?;
            let mut any = false;
            for (reason, count) in (Reasons { stats, others }).all().filter(|(_, count)| *count > 0) {
                write!(line, " {reason} {count}")?;
                any = true;
            }
            if any { Ok(()) } else { write!(line, " none") }
        })
    }
}

/// Class `lan` or `bridge` of what comes.
#[derive(Serialize)]
struct Counted<'a> {
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
    /// Of datagrams, which may have a MAC.
    #[serde(skip_serializing_if = "Option::is_none")]
    authenticated: Option<bool>,
    /// Of a bridge: as its sender announced it, if it did.
    #[serde(skip_serializing_if = "Option::is_none")]
    replaced: Option<Option<u32>>,
}

/// Class `lan_refused` or `bridge_refused`.
#[derive(Serialize)]
struct Refused<'a> {
    class: &'static str,
    #[serde(flatten)]
    reasons: Reasons<'a>,
}

/// How much was refused, by the reason.
struct Reasons<'a> {
    stats: &'a StreamStats,
    others: &'a [(&'static str, u64)],
}

impl Reasons<'_> {
    fn all(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let known = DatagramError::ALL.into_iter().map(|why| (why.name(), self.stats.refused(why)));
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

/// The topic's name; an account has no other ones.
fn topic(row: &Row) -> &'static str {
    match Topic::of_number(row.topic) {
        Some(topic) => topic.name(),
        None if row.topic == Announce::NUMBER => "announce",
        None => "unknown",
    }
}
