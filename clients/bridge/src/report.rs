//! What a bridge tells of itself, of its links, and of what goes out. What comes in is told where it is counted. Refuses to
//! know why.

use std::io::Write;

use schema::Topic;
use serde::Serialize;
use verbs::network::{End, Notice, Output, tell};

use crate::BridgeOptions;
use crate::engine::News;
use crate::sending::Sending;

/// Where it is told.
pub(crate) struct Report<'a> {
    json: bool,
    out: Output<'a>,
    notes: Output<'a>,
}

impl<'a> Report<'a> {
    /// Accounts to `out`, and what is no account to `notes` if `out` is not JSON.
    pub(crate) fn new(json: bool, out: Output<'a>, notes: Output<'a>) -> Report<'a> {
        Report { json, out, notes }
    }

    /// Whether it accounts by itself, now and then.
    pub(crate) fn is_periodic(&self) -> bool {
        self.json
    }

    /// Who it is, and what it will do.
    pub(crate) fn begin(&mut self, options: &BridgeOptions, sending: Option<&Sending>) -> Result<(), End> {
        let life = sending.map(|sending| &sending.life);
        let publish = options.publish.as_ref().map(|publish| publish.domain.name());
        if self.json {
            return self.out.json(&Begin {
                class: "bridge_ready",
                hub: life.map(|life| format!("{:016x}", life.hub)),
                epoch: life.map(|life| life.epoch),
                renumbered: life.is_some_and(|life| life.is_renumbered),
                connect: &options.connect,
                listen: &options.listen,
                publish,
                pid: std::process::id(),
            });
        }
        self.out.line(|line| {
            write!(line, "bridge")?;
            if let Some(life) = life {
                write!(line, " {:016x} epoch {}", life.hub, life.epoch)?;
            }
            options.connect.iter().try_for_each(|to| write!(line, ", connects to {to}"))?;
            options.listen.iter().try_for_each(|at| write!(line, ", listens on {at}"))?;
            publish.map_or(Ok(()), |domain| write!(line, ", publishes in domain {domain}"))
        })
    }

    /// News of the hub.
    pub(crate) fn hub(&mut self, notice: Notice) -> Result<(), End> {
        tell(notice, self.json, &mut self.out, &mut self.notes)
    }

    /// News of the links.
    pub(crate) fn link(&mut self, news: &News) -> Result<(), End> {
        let (state, message) = match news {
            News::Up => ("up", None),
            News::Down => ("down", None),
            News::Failing(why) => ("failing", Some(why.as_str())),
        };
        if self.json {
            return self.out.json(&Link { class: "bridge_link", state, message });
        }
        self.notes.line(|line| match (news, message) {
            (News::Up, _) => write!(line, "connected"),
            (News::Down, _) => write!(line, "nobody is connected"),
            (News::Failing(_), message) => write!(line, "{}", message.unwrap_or_default()),
        })
    }

    /// The account of what goes out.
    pub(crate) fn account(&mut self, sending: &Sending) -> Result<(), End> {
        let hub = format!("{:016x}", sending.life.hub);
        let outgoing = sending.outgoing();
        for sensor in outgoing.account() {
            for (topic, row) in sensor.used() {
                let name = topic.map_or("announce", Topic::name);
                if self.json {
                    self.out.json(&Line {
                        class: "bridge",
                        hub: &hub,
                        epoch: sending.life.epoch,
                        sensor: &sensor.name,
                        topic: name,
                        sent: row.sent,
                        send_failed: row.failed,
                        bytes: row.bytes,
                        missed: row.missed,
                        replaced: row.replaced,
                    })?;
                } else {
                    self.out.line(|line| {
                        write!(line, "{}/{name}: {} sent, ", sensor.name, row.sent)?;
                        write!(line, "{} replaced, {} failed, ", row.replaced, row.failed)?;
                        write!(line, "{} bytes", row.bytes)?;
                        if row.missed > 0 { write!(line, ", {} missed", row.missed) } else { Ok(()) }
                    })?;
                }
            }
        }
        Ok(())
    }
}

/// Class `bridge_ready`.
#[derive(Serialize)]
struct Begin<'a> {
    class: &'static str,
    hub: Option<String>,
    epoch: Option<u32>,
    renumbered: bool,
    connect: &'a [String],
    listen: &'a [String],
    publish: Option<&'a str>,
    pid: u32,
}

/// Class `bridge_link`.
#[derive(Serialize)]
struct Link<'a> {
    class: &'static str,
    state: &'static str,
    message: Option<&'a str>,
}

/// Class `bridge` of what goes out.
#[derive(Serialize)]
struct Line<'a> {
    class: &'static str,
    hub: &'a str,
    epoch: u32,
    sensor: &'a str,
    topic: &'static str,
    sent: u64,
    send_failed: u64,
    bytes: u64,
    missed: u64,
    replaced: u64,
}
