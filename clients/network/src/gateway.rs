//! `scanhub gateway`: sends the hub's samples to a network as datagrams. The gateway is an ordinary client. It
//! continues when the hub, a link or the network fails and comes back. It receives nothing from the network.

mod host;
mod interface_monitor;
mod network;
mod udp_destination;

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_schema::datagram::{Announce, GROUP_PREFIX, MTU_SAFE, PORT, group};
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::context::Context;
use scanhub_verbs::duration;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::output::{ExitReason, LossyWriter, Output, verb_result};
use serde::Serialize;

use crate::forward::{self, Forwarder, Selection};
use crate::gateway_identity::begin_run;
use crate::lan::Key;
use crate::lan::outgoing::{ANNOUNCEMENT_INTERVAL, Form};
use crate::{key_file, now};
use interface_monitor::InterfaceMonitor;
use network::{Groups, Network};
use udp_destination::{DestinationEvent, UdpDestination};

/// Send topics to other machines as UDP datagrams, to multicast groups or single hosts
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = after_help())]
pub struct GatewayArgs {
    /// Network interface for the multicast groups. Everyone on its network can read the data. lo: this machine only.
    /// Without an interface, nothing is sent to groups, and --to must name hosts
    #[arg(long, value_name = "NAME")]
    pub interface: Option<String>,
    /// Topics to send: front/scan, */scan for all sensors, or front/* for all topics of a sensor. With :every=4, only
    /// the samples of every fourth telegram. Can be repeated [default: all topics except telegram, lines, motion, early
    /// and cloud, of all sensors]
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    pub topics: Vec<String>,
    // In help texts, brackets are not links.
    #[allow(rustdoc::broken_intra_doc_links)]
    /// Host that gets copies of the datagrams: HOST:PORT or [IPV6]:PORT. The gateway resolves a name again while it
    /// runs. Can be repeated
    #[arg(long, value_name = "HOST:PORT")]
    pub to: Vec<String>,
    /// Send only telegrams, without a header, and each sensor to a port of its own
    #[arg(long, conflicts_with = "background_every")]
    pub bare: bool,
    /// Authenticate every datagram with the key in this file, for `listen --key-file`. `scanhub key new` creates one
    #[arg(long, value_name = "FILE", conflicts_with = "bare")]
    pub key_file: Option<PathBuf>,
    /// Maximum number of networks that datagrams to the groups cross, including the first one [default: 1]
    #[arg(long, value_name = "N")]
    pub ttl: Option<u8>,
    /// Interval at which the background is sent again, for example 10s [default: only when it is new]
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    pub background_every: Option<Duration>,
    /// Maximum size of a datagram in bytes, 576 to 1472. Through a tunnel, 1472 is too large [default: 1372]
    #[arg(long, value_name = "BYTES")]
    pub mtu: Option<usize>,
}

impl GatewayArgs {
    /// Sends until a signal stops the gateway, even while hub or network are unavailable. Counters are printed to
    /// stdout at the end and after each SIGUSR1. Other lines go to stderr, or to stdout with `--json`. A line is
    /// dropped if the reader of the output is too slow for it. Such a reader therefore delays only the end of the
    /// gateway, by a second.
    ///
    /// # Errors
    ///
    /// Returns
    ///
    /// - [`Kind::Configuration`] if the interface does not exist, neither an interface nor a host is named, a host or
    ///   another value is not valid, or the key file contains no key that only this user can read,
    /// - [`Kind::Usage`] if a named topic does not exist,
    /// - [`Kind::NoTopic`] if the first hub lacks a named sensor,
    /// - [`Kind::ResourceExhausted`] if descriptors or memory are short,
    /// - [`Kind::Interrupted`] if a signal stops the run before all hosts are resolved.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (report_requested, stop) = (context.signals.report()?, context.signals.stop()?);
        let display = match (context.json, context.is_terminal) {
            (true, _) => Display::Json,
            (false, true) => Display::Terminal,
            (false, false) => Display::Lines,
        };
        let mut gateway = Gateway::open(self, &context.domain.locations()?, &stop)?;
        let (mut out, mut notes) =
            (LossyWriter::new(&mut context.out, &stop), LossyWriter::new(&mut context.notes, &stop));
        let mut report = Report::new(display, &mut out, &mut notes);
        verb_result(gateway.run(&mut report, &report_requested, &stop))
    }

    /// Checks the options as far as that is possible without network and hub: that the topics are valid, and that no
    /// options exclude each other.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if a topic is not valid, otherwise [`Kind::Configuration`].
    pub fn check(&self) -> Result<(), Failure> {
        self.selection().map(drop)
    }

    fn selection(&self) -> Result<Selection, Failure> {
        let selection = Selection::parse(&self.topics, self.bare)?;
        if self.bare && self.background_every.is_some() {
            let what = "background_every is set, but bare sends only telegrams";
            return Err(Failure::new(Kind::Configuration, what, "remove bare or background_every"));
        }
        if self.bare && self.key_file.is_some() {
            let what = "bare telegrams have no room for a MAC";
            return Err(Failure::new(Kind::Configuration, what, "remove bare or key_file"));
        }
        Ok(selection)
    }
}

/// Form of a gateway's output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Display {
    /// Lines at the start, at the end and on request.
    Lines,
    /// JSON objects, once a second.
    Json,
    /// One line that each update overwrites.
    Terminal,
}

/// A running gateway.
struct Gateway<'a> {
    args: &'a GatewayArgs,
    /// Name of the gateway's key, if it has one.
    key_name: Option<String>,
    forwarder: Forwarder,
    network: Network,
    tick_at: Instant,
}

/// Word that replaces the interface in the name of the file with the gateway's number, if the gateway sends only to
/// hosts.
const HOSTS: &str = "hosts";

/// Interval between announcements, and between reports of the counters.
const TICK_INTERVAL: Duration = ANNOUNCEMENT_INTERVAL;

impl<'a> Gateway<'a> {
    fn open(args: &'a GatewayArgs, locations: &[Domain], stop: &AtomicBool) -> Result<Gateway<'a>, Failure> {
        let selection = args.selection()?;
        if args.interface.is_none() && args.to.is_empty() {
            return Err(interface_monitor::no_destination());
        }
        let key = args.key_file.as_deref().map(key_file::read).transpose()?;
        let interface = args.interface.as_deref().map(InterfaceMonitor::open).transpose()?;
        let domain = locations.first().map(Domain::name).unwrap_or_default();
        let identity = begin_run(domain, interface.as_ref().map_or(HOSTS, InterfaceMonitor::name))?;
        let key_name = key.as_ref().map(Key::name);
        let form = match key {
            Some(key) => Form::Authenticated(key),
            None if args.bare => Form::Bare,
            None => Form::Sealed,
        };
        let (ttl, longest) = (args.ttl.unwrap_or(1), args.mtu.unwrap_or(MTU_SAFE));
        let mut network = Network::open(identity, interface, &args.to, form, ttl, longest, stop)?;
        let forwarder = Forwarder::new(selection, locations, &mut network);
        Ok(Gateway { args, key_name, forwarder, network, tick_at: Instant::now() })
    }

    fn run(
        &mut self,
        report: &mut Report<'_>,
        report_requested: &AtomicBool,
        stop: &AtomicBool,
    ) -> Result<(), ExitReason> {
        report.begin(&self.network, self.args.bare, self.key_name.as_deref())?;
        if self.network.destinations.groups.as_ref().is_some_and(|groups| !groups.interface.is_up()) {
            report.interface(&self.network)?;
        }
        let end = self.forward(report, report_requested, stop);
        // The last announcement contains the final numbers, so that listeners can count lost samples.
        self.announce();
        end.and_then(|()| report.write_counters(&self.network))
    }

    fn forward(
        &mut self,
        report: &mut Report<'_>,
        report_requested: &AtomicBool,
        stop: &AtomicBool,
    ) -> Result<(), ExitReason> {
        while !stop.load(Ordering::Relaxed) {
            if self.network.destinations.update() {
                report.interface(&self.network)?;
            }
            // Send waiting samples before checking the hub, because the check takes longer.
            let more = self.forwarder.forward(&mut self.network)?;
            let now = Instant::now();
            self.forwarder.check_hub(now, &mut self.network, &mut |notice| report.hub(notice))?;
            self.tick(report, now)?;
            if report_requested.swap(false, Ordering::Relaxed) {
                report.write_counters(&self.network)?;
            }
            if !more {
                self.forwarder.wait(self.tick_at.saturating_duration_since(now))?;
            }
        }
        Ok(())
    }

    /// Does the periodic work once a second: announcements, backgrounds, and reports about destinations.
    fn tick(&mut self, report: &mut Report<'_>, now: Instant) -> Result<(), ExitReason> {
        if now < self.tick_at {
            return Ok(());
        }
        self.tick_at = now + TICK_INTERVAL;
        if let Some(every) = self.args.background_every {
            let Network { outgoing, destinations, .. } = &mut self.network;
            outgoing.repeat(every, crate::now(), destinations);
        }
        self.announce();
        for destination in self.network.destinations.all_mut() {
            if let Some(address) = destination.follow_name(now) {
                report.moved(&destination.name, address)?;
            }
            if let Some(event) = destination.check() {
                report.destination(&destination.name, &event)?;
            }
        }
        if let Some(what) = self.network.outgoing.take_oversized() {
            report.oversized(&what, self.network.outgoing.max_datagram_len())?;
        }
        report.periodic(&self.network, self.forwarder.is_hub_running())
    }

    fn announce(&mut self) {
        let Network { outgoing, destinations, .. } = &mut self.network;
        outgoing.announce(now(), destinations);
    }
}

/// Output of a gateway.
struct Report<'a> {
    display: Display,
    out: Output<'a>,
    notes: Output<'a>,
    /// Number of datagrams that had been sent to the first destination when the last status line was drawn.
    sent: u64,
}

impl<'a> Report<'a> {
    /// Creates a report that prints counters to `out`, and everything else to `notes`, or to `out` with JSON.
    fn new(display: Display, out: &'a mut dyn Write, notes: &'a mut dyn Write) -> Report<'a> {
        Report { display, out: Output::new(out), notes: Output::new(notes), sent: 0 }
    }

    /// Reports the gateway's identity, its destinations and its key.
    fn begin(&mut self, network: &Network, bare: bool, key: Option<&str>) -> Result<(), ExitReason> {
        let to: Vec<_> = network.destinations.copies.iter().map(|copy| copy.name.as_str()).collect();
        if self.display == Display::Json {
            return self.out.json(&GatewayJson {
                class: "gateway",
                hub: id(network),
                epoch: network.identity.epoch,
                interface: network.destinations.groups.as_ref().map(|groups| groups.interface.name()),
                to,
                bare,
                key,
                longest: network.outgoing.max_datagram_len(),
                renumbered: network.identity.is_renumbered,
            });
        }
        if network.identity.is_renumbered {
            self.notes.line(|line| write!(line, "{}: {RENUMBERED_REASON}", id(network)))?;
        }
        self.out.line(|line| {
            write!(line, "gateway {} epoch {}", id(network), network.identity.epoch)?;
            if let Some(groups) = &network.destinations.groups {
                write!(line, " on {}", groups.interface.name())?;
            }
            to.iter().try_for_each(|to| write!(line, ", copies to {to}"))?;
            write!(line, ", datagrams of {} bytes at most", network.outgoing.max_datagram_len())?;
            key.map_or(Ok(()), |key| write!(line, ", key {key}"))
        })?;
        if key.is_none() && !bare {
            self.notes.line(|line| write!(line, "no key: {NO_KEY_NOTE}"))?;
        }
        Ok(())
    }

    /// Reports a notice about the hub.
    fn hub(&mut self, notice: Notice) -> Result<(), ExitReason> {
        self.clear_line()?;
        forward::report_notice(notice, self.display == Display::Json, &mut self.out, &mut self.notes)
    }

    /// Reports a new state of the interface.
    fn interface(&mut self, network: &Network) -> Result<(), ExitReason> {
        let Some(Groups { interface, .. }) = &network.destinations.groups else { return Ok(()) };
        match interface.is_up() {
            true => self.link(interface.name(), "up", None),
            false => {
                self.link(interface.name(), "down", Some("no carrier, no IPv4 address, or no such interface"))
            }
        }
    }

    /// Reports a state change of a destination.
    fn destination(&mut self, destination: &str, event: &DestinationEvent) -> Result<(), ExitReason> {
        match event {
            DestinationEvent::Failing(reason) => self.link(destination, "failing", Some(reason)),
            DestinationEvent::Recovered => self.link(destination, "recovered", None),
        }
    }

    /// Reports the new address of a destination.
    fn moved(&mut self, destination: &str, address: SocketAddr) -> Result<(), ExitReason> {
        self.link(destination, "moved", Some(&format!("its address is now {address}")))
    }

    /// Reports that samples of `topic` do not fit into the maximum number of datagrams.
    fn oversized(&mut self, topic: &str, longest: usize) -> Result<(), ExitReason> {
        let message =
            format!("does not fit into {longest} bytes: --mtu, or the interface's own, is too small");
        self.link(topic, "failing", Some(&message))
    }

    /// Prints the periodic report: JSON lines with all counters, or a status line on a terminal.
    fn periodic(&mut self, network: &Network, is_hub_running: bool) -> Result<(), ExitReason> {
        match self.display {
            Display::Json => self.write_counters(network),
            Display::Lines => Ok(()),
            Display::Terminal => self.draw(network, is_hub_running),
        }
    }

    /// Prints all counters.
    fn write_counters(&mut self, network: &Network) -> Result<(), ExitReason> {
        self.clear_line()?;
        let json = self.display == Display::Json;
        forward::write_counters(&network.outgoing, &network.identity, "lan", json, &mut self.out)?;
        if network.outgoing.oversized_samples() > 0 && self.display != Display::Json {
            let longest = network.outgoing.max_datagram_len();
            self.out.line(|line| {
                write!(
                    line,
                    "too long for {longest} bytes: {}, see --mtu",
                    network.outgoing.oversized_samples()
                )
            })?;
        }
        network.destinations.all().try_for_each(|destination| self.write_destination(network, destination))
    }

    fn write_destination(
        &mut self,
        network: &Network,
        destination: &UdpDestination,
    ) -> Result<(), ExitReason> {
        let UdpDestination { name, sent, failed, reported, .. } = destination;
        if self.display == Display::Json {
            return self.out.json(&DestinationJson {
                class: "lan_to",
                hub: id(network),
                epoch: network.identity.epoch,
                to: name,
                sent: *sent,
                send_failed: *failed,
                reported: *reported,
            });
        }
        self.out.line(|line| write!(line, "to {name}: {sent} sent, {failed} failed, {reported} reported"))
    }

    fn link(&mut self, to: &str, state: &'static str, message: Option<&str>) -> Result<(), ExitReason> {
        if self.display == Display::Json {
            return self.out.json(&LinkJson { class: "lan_link", to, state, message });
        }
        self.clear_line()?;
        self.notes.line(|line| match message {
            Some(message) => write!(line, "{to}: {state}: {message}"),
            None => write!(line, "{to}: {state}"),
        })
    }

    /// Draws the status line over the previous one.
    fn draw(&mut self, network: &Network, is_hub_running: bool) -> Result<(), ExitReason> {
        // Disable wrapping, because the next update could not overwrite a wrapped line.
        let mut line = [CLEAR_LINE, b"\x1b[?7l"].concat();
        write_status(&mut line, network, is_hub_running, self.sent)?;
        line.extend(b"\x1b[?7h");
        self.sent = first(network).0;
        self.out.raw(&line)
    }

    /// Clears the status line on a terminal.
    fn clear_line(&mut self) -> Result<(), ExitReason> {
        match self.display {
            Display::Terminal => self.out.raw(CLEAR_LINE),
            Display::Json | Display::Lines => Ok(()),
        }
    }
}

/// Writes the status line. The rate is the number of datagrams since `sent_before`.
fn write_status(
    line: &mut Vec<u8>,
    network: &Network,
    is_hub_running: bool,
    sent_before: u64,
) -> io::Result<()> {
    let is_down = network.destinations.groups.as_ref().is_some_and(|groups| !groups.interface.is_up());
    let state = if is_down { " down" } else { "" };
    let hub = if is_hub_running { "" } else { "no hub, " };
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
        network.outgoing.counters().flat_map(|sensor| sensor.used_topics()).map(|(_, row)| row.missed).sum();
    if missed > 0 {
        write!(line, "; {missed} missed")?;
    }
    if network.outgoing.oversized_samples() > 0 {
        write!(line, "; {} too long", network.outgoing.oversized_samples())
    } else {
        Ok(())
    }
}

/// Returns the number of datagrams that were sent to the first destination, and its name. Each gateway has a
/// destination.
fn first(network: &Network) -> (u64, &str) {
    network.destinations.all().next().map_or((0, ""), |destination| (destination.sent, &destination.name))
}

/// Returns the gateway's number in the form that all output has: 16 hex digits.
fn id(network: &Network) -> String {
    format!("{:016x}", network.identity.hub)
}

/// JSON line of class `gateway`.
#[derive(Serialize)]
struct GatewayJson<'a> {
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

/// JSON line of class `lan_to`.
#[derive(Serialize)]
struct DestinationJson<'a> {
    class: &'static str,
    hub: String,
    epoch: u32,
    to: &'a str,
    sent: u64,
    send_failed: u64,
    reported: u64,
}

/// JSON line of class `lan_link`.
#[derive(Serialize)]
struct LinkJson<'a> {
    class: &'static str,
    to: &'a str,
    state: &'static str,
    message: Option<&'a str>,
}

/// Reason why a gateway does not use the stored number.
const RENUMBERED_REASON: &str = "a new number, because the saved one belongs to another machine";
/// Note that a gateway without a key prints.
const NO_KEY_NOTE: &str = "receivers cannot know who sends; see `scanhub key new` and --key-file";
/// Moves the cursor to the start of the line, and clears it (ECMA-48).
const CLEAR_LINE: &[u8] = b"\r\x1b[K";

const EXAMPLE: &str = "\
Example:
  scanhub gateway --interface eth0 --topic '*/zones' --topic front/scan:every=4";

/// Returns an example, and the groups with their topics, for the end of the help.
fn after_help() -> String {
    let mut text = format!("{EXAMPLE}\n\nGroups, port {PORT}:\n");
    for (address, topics) in groups_and_topics() {
        text += &format!("  {address}  {topics}\n");
    }
    text + "With --bare: 239.255.76.83, port 22201 for the first sensor, 22202 for the second ..\nSIGUSR1: print the counts so far"
}

/// Returns the address of each multicast group, and the names of the topics that are sent to it.
fn groups_and_topics() -> Vec<(String, String)> {
    let mut groups = BTreeMap::from([(Announce::GROUP, vec!["announce"])]);
    for topic in Topic::ALL {
        groups.entry(group(topic)).or_default().push(topic.name());
    }
    let [a, b, c] = GROUP_PREFIX;
    let row = |(last, topics): (u8, Vec<&str>)| (format!("{a}.{b}.{c}.{last}"), topics.join(", "));
    groups.into_iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads a file of this repository, without line breaks, backquotes and comment marks.
    fn page_text(path: &str) -> String {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path);
        let text = std::fs::read_to_string(path).unwrap().replace(['`'], "").replace("///", "");
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn pages_list_topics_that_are_not_sent_by_default() {
        let not_sent: Vec<_> =
            Topic::ALL.into_iter().filter(|topic| !Selection::is_default(*topic)).collect();
        let names: Vec<_> = not_sent.iter().map(|topic| topic.name()).collect();
        let (last, first) = names.split_last().unwrap();
        let sentence = format!("all topics except {} and {last}", first.join(", "));
        let pages = ["docs/configuration.md", "docs/datagram.md", "docs/bridge.md"];
        for path in pages.iter().chain(&["clients/network/src/gateway.rs", "clients/bridge/src/main.rs"]) {
            assert!(page_text(path).contains(&sentence), "{path} does not say: {sentence}");
        }
    }

    #[test]
    fn help_lists_every_topic_with_its_group() {
        let help = after_help();
        for (address, topics) in groups_and_topics() {
            assert!(help.contains(&format!("{address}  {topics}\n")), "{help}");
        }
        let all: usize = groups_and_topics().iter().map(|(_, topics)| topics.split(", ").count()).sum();
        assert_eq!(all, Topic::ALL.len() + 1);
    }
}
