//! What a bridge tells of itself, of its links, and of what goes out. What comes in is told where it is counted. Refuses to
//! know why.

use std::io::Write;

use serde::Serialize;
use verbs::network::{End, Notice, Output, account, tell};

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
        account(&sending.outgoing(), &sending.life, "bridge", self.json, &mut self.out)
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
