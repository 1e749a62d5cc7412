//! What a gateway tells of itself: lines of JSON, or text and one line that is drawn over itself. Refuses to know why.

use std::io::{self, Write};
use std::net::SocketAddr;

use serde::Serialize;

use super::GatewayLook;
use super::network::{Groups, Network};
use super::udp_destination::{News, UdpDestination};
use crate::forward;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::output::{End, Output};

/// Where it is told.
pub(super) struct Report<'a> {
    look: GatewayLook,
    out: Output<'a>,
    notes: Output<'a>,
    /// Datagrams to the first destination, as of the last status line.
    sent: u64,
}

impl<'a> Report<'a> {
    /// Accounts to `out`, and what is no account to `notes` if `out` is not JSON.
    pub(super) fn new(look: GatewayLook, out: &'a mut dyn Write, notes: &'a mut dyn Write) -> Report<'a> {
        Report { look, out: Output::new(out), notes: Output::new(notes), sent: 0 }
    }

    /// Who it is, where it sends, and of which key datagrams have a MAC.
    pub(super) fn begin(&mut self, network: &Network, bare: bool, key: Option<&str>) -> Result<(), End> {
        let to: Vec<_> = network.destinations.copies.iter().map(|copy| copy.name.as_str()).collect();
        if self.look == GatewayLook::Json {
            return self.out.json(&Begin {
                class: "gateway",
                hub: id(network),
                epoch: network.life.epoch,
                interface: network.destinations.groups.as_ref().map(|groups| groups.interface.name()),
                to,
                bare,
                key,
                longest: network.outgoing.longest(),
                renumbered: network.life.is_renumbered,
            });
        }
        if network.life.is_renumbered {
            self.notes.line(|line| write!(line, "{}: {RENUMBERED}", id(network)))?;
        }
        self.out.line(|line| {
            write!(line, "gateway {} epoch {}", id(network), network.life.epoch)?;
            if let Some(groups) = &network.destinations.groups {
                write!(line, " on {}", groups.interface.name())?;
            }
            to.iter().try_for_each(|to| write!(line, ", copies to {to}"))?;
            write!(line, ", datagrams of {} bytes at most", network.outgoing.longest())?;
            key.map_or(Ok(()), |key| write!(line, ", key {key}"))
        })?;
        if key.is_none() && !bare {
            self.notes.line(|line| write!(line, "no key: {NO_KEY}"))?;
        }
        Ok(())
    }

    /// News of the hub.
    pub(super) fn hub(&mut self, notice: Notice) -> Result<(), End> {
        self.wipe()?;
        forward::tell(notice, self.look == GatewayLook::Json, &mut self.out, &mut self.notes)
    }

    /// The state of the interface became another one.
    pub(super) fn interface(&mut self, network: &Network) -> Result<(), End> {
        let Some(Groups { interface, .. }) = &network.destinations.groups else { return Ok(()) };
        match interface.is_up() {
            true => self.link(interface.name(), "up", None),
            false => self.link(interface.name(), "down", Some("no carrier, no IPv4 address, or not there")),
        }
    }

    /// What became of a destination.
    pub(super) fn destination(&mut self, destination: &str, news: &News) -> Result<(), End> {
        match news {
            News::Failing(why) => self.link(destination, "failing", Some(why)),
            News::Well => self.link(destination, "well", None),
        }
    }

    /// The name of a destination has another address now, which is sent to.
    pub(super) fn moved(&mut self, destination: &str, address: SocketAddr) -> Result<(), End> {
        self.link(destination, "moved", Some(&format!("its address is now {address}")))
    }

    /// Samples of `topic` are longer than the longest datagram.
    pub(super) fn misfit(&mut self, topic: &str, longest: usize) -> Result<(), End> {
        let message =
            format!("does not fit into {longest} bytes: --mtu, or the interface's own, is too small");
        self.link(topic, "failing", Some(&message))
    }

    /// The periodic word: an object for each sensor and topic and each destination, or one line on a terminal.
    pub(super) fn periodic(&mut self, network: &Network, hub_lives: bool) -> Result<(), End> {
        match self.look {
            GatewayLook::Json => self.account(network),
            GatewayLook::Lines => Ok(()),
            GatewayLook::Terminal => self.draw(network, hub_lives),
        }
    }

    /// The whole account.
    pub(super) fn account(&mut self, network: &Network) -> Result<(), End> {
        self.wipe()?;
        let json = self.look == GatewayLook::Json;
        forward::account(&network.outgoing, &network.life, "lan", json, &mut self.out)?;
        if network.outgoing.unfit() > 0 && self.look != GatewayLook::Json {
            let longest = network.outgoing.longest();
            self.out.line(|line| {
                write!(line, "too long for {longest} bytes: {}, see --mtu", network.outgoing.unfit())
            })?;
        }
        network.destinations.all().try_for_each(|destination| self.write_destination(network, destination))
    }

    fn write_destination(&mut self, network: &Network, destination: &UdpDestination) -> Result<(), End> {
        let UdpDestination { name, sent, failed, reported, .. } = destination;
        if self.look == GatewayLook::Json {
            return self.out.json(&To {
                class: "lan_to",
                hub: id(network),
                epoch: network.life.epoch,
                to: name,
                sent: *sent,
                send_failed: *failed,
                reported: *reported,
            });
        }
        self.out.line(|line| write!(line, "to {name}: {sent} sent, {failed} failed, {reported} reported"))
    }

    fn link(&mut self, to: &str, state: &'static str, message: Option<&str>) -> Result<(), End> {
        if self.look == GatewayLook::Json {
            return self.out.json(&Link { class: "lan_link", to, state, message });
        }
        self.wipe()?;
        self.notes.line(|line| match message {
            Some(message) => write!(line, "{to}: {state}: {message}"),
            None => write!(line, "{to}: {state}"),
        })
    }

    fn draw(&mut self, network: &Network, hub_lives: bool) -> Result<(), End> {
        // A line that wraps would not be drawn over: it is cut.
        let mut line = [WIPE, b"\x1b[?7l"].concat();
        status(&mut line, network, hub_lives, self.sent)?;
        line.extend(b"\x1b[?7h");
        self.sent = first(network).0;
        self.out.raw(&line)
    }

    fn wipe(&mut self) -> Result<(), End> {
        match self.look {
            GatewayLook::Terminal => self.out.raw(WIPE),
            GatewayLook::Json | GatewayLook::Lines => Ok(()),
        }
    }
}

fn status(line: &mut Vec<u8>, network: &Network, hub_lives: bool, sent_before: u64) -> io::Result<()> {
    let is_down = network.destinations.groups.as_ref().is_some_and(|groups| !groups.interface.is_up());
    let state = if is_down { " down" } else { "" };
    let hub = if hub_lives { "" } else { "no hub, " };
    let (sent, name) = first(network);
    write!(line, "{hub}{name}{state}: {}/s", sent - sent_before)?;
    for (number, destination) in network.destinations.all().enumerate() {
        let UdpDestination { name, sent, failed, .. } = destination;
        match number {
            0 => write!(line, ", {sent} sent")?,
            _ => write!(line, "; {name}: {sent} sent")?,
        }
        if number > 0 || *failed > 0 {
            write!(line, ", {failed} failed")?;
        }
    }
    let missed: u64 =
        network.outgoing.account().flat_map(|sensor| sensor.used()).map(|(_, row)| row.missed).sum();
    if missed > 0 {
        write!(line, "; {missed} missed")?;
    }
    if network.outgoing.unfit() > 0 {
        write!(line, "; {} too long", network.outgoing.unfit())
    } else {
        Ok(())
    }
}

/// How many datagrams went to the first destination, which there always is, and its name.
fn first(network: &Network) -> (u64, &str) {
    network.destinations.all().next().map_or((0, ""), |destination| (destination.sent, &destination.name))
}

fn id(network: &Network) -> String {
    format!("{:016x}", network.life.hub)
}

/// Class `gateway`.
#[derive(Serialize)]
struct Begin<'a> {
    class: &'static str,
    hub: String,
    epoch: u32,
    interface: Option<&'a str>,
    to: Vec<&'a str>,
    bare: bool,
    key: Option<&'a str>,
    longest: usize,
    renumbered: bool,
}

/// Class `lan_to`.
#[derive(Serialize)]
struct To<'a> {
    class: &'static str,
    hub: String,
    epoch: u32,
    to: &'a str,
    sent: u64,
    send_failed: u64,
    reported: u64,
}

/// Class `lan_link`.
#[derive(Serialize)]
struct Link<'a> {
    class: &'static str,
    to: &'a str,
    state: &'static str,
    message: Option<&'a str>,
}

/// Why a gateway has another number than is kept.
const RENUMBERED: &str = "a new number, because the one that is kept here was drawn on another machine";
/// What a gateway without a key says once.
const NO_KEY: &str = "receivers cannot know who sends; see `scanhub key new` and --key-file";
/// To the line's begin, and nothing on it (ECMA-48).
const WIPE: &[u8] = b"\r\x1b[K";
