//! Reports of a bridge about itself, its links, and the samples that it sends. `receiving.rs` reports the received
//! samples.

use std::io::Write;

use scanhub_network::report_notice;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::output::{ExitReason, Output};
use serde::Serialize;

use crate::BridgeOptions;
use crate::diagnosis::Diagnosis;
use crate::sending::BridgeSender;
use crate::session::LinkEvent;

/// Writer of a bridge's reports.
pub(crate) struct Report<'a> {
    json: bool,
    /// Causes reported since the last connection. The remedy of each cause is printed only once.
    reported: Vec<Diagnosis>,
    out: Output<'a>,
    notes: Output<'a>,
}

impl<'a> Report<'a> {
    /// Writes statistics to `out`, and everything else to `notes` unless `out` is JSON.
    pub(crate) fn new(json: bool, out: Output<'a>, notes: Output<'a>) -> Report<'a> {
        Report { json, reported: Vec::new(), out, notes }
    }

    /// Returns whether statistics are written periodically.
    pub(crate) fn is_periodic(&self) -> bool {
        self.json
    }

    /// Reports that the bridge is ready, with its hub ID, epoch and addresses.
    pub(crate) fn begin(
        &mut self,
        options: &BridgeOptions,
        sending: Option<&BridgeSender>,
    ) -> Result<(), ExitReason> {
        let identity = sending.map(|sending| &sending.identity);
        let publish = options.publish.as_ref().map(|publish| publish.domain.name());
        if self.json {
            return self.out.json(&ReadyJson {
                class: "bridge_ready",
                hub: identity.map(|identity| format!("{:016x}", identity.hub)),
                epoch: identity.map(|identity| identity.epoch),
                renumbered: identity.is_some_and(|identity| identity.is_renumbered),
                connect: &options.connect,
                listen: &options.listen,
                publish,
                pid: std::process::id(),
            });
        }
        self.out.line(|line| {
            write!(line, "bridge")?;
            if let Some(identity) = identity {
                write!(line, " {:016x} epoch {}", identity.hub, identity.epoch)?;
            }
            options.connect.iter().try_for_each(|to| write!(line, ", connects to {to}"))?;
            options.listen.iter().try_for_each(|at| write!(line, ", listens on {at}"))?;
            publish.map_or(Ok(()), |domain| write!(line, ", publishes in domain {domain}"))
        })
    }

    /// Reports an event of the hub.
    pub(crate) fn hub(&mut self, notice: Notice) -> Result<(), ExitReason> {
        report_notice(notice, self.json, &mut self.out, &mut self.notes)
    }

    /// Reports that there is no connection yet. The bridge keeps trying.
    pub(crate) fn waiting(&mut self, options: &BridgeOptions) -> Result<(), ExitReason> {
        let message = match &options.connect[..] {
            [] => "waiting for the routers in --config".to_owned(),
            routers => format!("waiting for a router: {}", routers.join(", ")),
        };
        if self.json {
            return self.out.json(&LinkJson { message: Some(&message), ..LinkJson::of("waiting") });
        }
        self.notes.line(|line| write!(line, "{message}"))
    }

    /// Reports an event of a link. When a cause occurs for the first time since the last connection, also prints the
    /// remedy.
    pub(crate) fn link(&mut self, event: &LinkEvent) -> Result<(), ExitReason> {
        let LinkEvent::Failing(words) = event else {
            let is_up = *event == LinkEvent::Up;
            if is_up {
                self.reported.clear();
            }
            if self.json {
                return self.out.json(&LinkJson::of(if is_up { "up" } else { "down" }));
            }
            let words = if is_up { "connected" } else { "disconnected" };
            return self.notes.line(|line| write!(line, "{words}"));
        };
        let known = Diagnosis::of(words);
        if self.json {
            let (finding, remedy) = (known.map(|known| known.finding), known.map(|known| known.remedy));
            return self.out.json(&LinkJson {
                message: Some(words),
                finding,
                remedy,
                ..LinkJson::of("failing")
            });
        }
        let new = known.filter(|known| !self.reported.contains(known));
        self.reported.extend(new);
        let Some(Diagnosis { finding, remedy }) = new else {
            return self.notes.line(|line| write!(line, "{words}"));
        };
        self.notes.line(|line| write!(line, "{finding}: {words}"))?;
        self.notes.line(|line| write!(line, "  {remedy}"))
    }

    /// Reports the statistics of sent samples.
    pub(crate) fn write_counters(&mut self, sending: &BridgeSender) -> Result<(), ExitReason> {
        sending.write_counters(self.json, &mut self.out)
    }

    /// Reports the number of connections that failed or were refused.
    pub(crate) fn refused(&mut self, connection: u64) -> Result<(), ExitReason> {
        if self.json {
            return self.out.json(&RefusedJson { class: "bridge_refused", connection });
        }
        match connection {
            0 => Ok(()),
            _ => self.out.line(|line| write!(line, "refused: connection {connection}")),
        }
    }
}

/// JSON line of class `bridge_ready`.
#[derive(Serialize)]
struct ReadyJson<'a> {
    class: &'static str,
    hub: Option<String>,
    epoch: Option<u32>,
    renumbered: bool,
    connect: &'a [String],
    listen: &'a [String],
    publish: Option<&'a str>,
    pid: u32,
}

/// JSON line of class `bridge_refused`, for a bridge that receives nothing.
#[derive(Serialize)]
struct RefusedJson {
    class: &'static str,
    connection: u64,
}

/// JSON line of class `bridge_link`.
#[derive(Serialize)]
struct LinkJson<'a> {
    class: &'static str,
    state: &'static str,
    message: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    finding: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    remedy: Option<&'static str>,
}

impl LinkJson<'_> {
    /// Returns a line that has only a state.
    fn of(state: &'static str) -> Self {
        LinkJson { class: "bridge_link", state, message: None, finding: None, remedy: None }
    }
}
