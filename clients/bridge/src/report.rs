//! What a bridge tells of itself, of its links, and of what goes out. What comes in is told where it is counted. Refuses to
//! know why.

use std::io::Write;

use serde::Serialize;
use verbs::network::{End, Notice, Output, account, tell};

use crate::BridgeOptions;
use crate::diagnosis::Diagnosis;
use crate::engine::News;
use crate::sending::Sending;

/// Where it is told.
pub(crate) struct Report<'a> {
    json: bool,
    /// What was told to be wrong since somebody was connected: the remedy is told once.
    told: Vec<Diagnosis>,
    out: Output<'a>,
    notes: Output<'a>,
}

impl<'a> Report<'a> {
    /// Accounts to `out`, and what is no account to `notes` if `out` is not JSON.
    pub(crate) fn new(json: bool, out: Output<'a>, notes: Output<'a>) -> Report<'a> {
        Report { json, told: Vec::new(), out, notes }
    }

    /// Whether it accounts by itself, now and then.
    pub(crate) fn is_periodic(&self) -> bool {
        self.json
    }

    /// It is ready: who it is, and what it does.
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

    /// Nobody is connected yet, and it goes on trying.
    pub(crate) fn waiting(&mut self, options: &BridgeOptions) -> Result<(), End> {
        let message = match &options.connect[..] {
            [] => "waits for the routers that --config names".to_owned(),
            routers => format!("waits for a router: {}", routers.join(", ")),
        };
        if self.json {
            return self.out.json(&Link { message: Some(&message), ..Link::of("waiting") });
        }
        self.notes.line(|line| write!(line, "{message}"))
    }

    /// News of the links.
    pub(crate) fn link(&mut self, news: &News) -> Result<(), End> {
        let News::Failing(words) = news else {
            let is_up = *news == News::Up;
            if is_up {
                self.told.clear();
            }
            if self.json {
                return self.out.json(&Link::of(if is_up { "up" } else { "down" }));
            }
            let words = if is_up { "connected" } else { "nobody is connected" };
            return self.notes.line(|line| write!(line, "{words}"));
        };
        let known = Diagnosis::of(words);
        if self.json {
            let (finding, remedy) = (known.map(|known| known.finding), known.map(|known| known.remedy));
            return self.out.json(&Link { message: Some(words), finding, remedy, ..Link::of("failing") });
        }
        let new = known.filter(|known| !self.told.contains(known));
        self.told.extend(new);
        let Some(Diagnosis { finding, remedy }) = new else {
            return self.notes.line(|line| write!(line, "{words}"));
        };
        self.notes.line(|line| write!(line, "{finding}: {words}"))?;
        self.notes.line(|line| write!(line, "  {remedy}"))
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
    #[serde(skip_serializing_if = "Option::is_none")]
    finding: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    remedy: Option<&'static str>,
}

impl Link<'_> {
    /// As long as nothing else is said.
    fn of(state: &'static str) -> Self {
        Link { class: "bridge_link", state, message: None, finding: None, remedy: None }
    }
}
