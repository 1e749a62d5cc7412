//! `scanhub gateway`: what the hub publishes, as datagrams on a network, one message each and nothing sent twice. An
//! ordinary client of the hub that outlives it, its links and its own network. Takes nothing from the network.

mod host;
mod network;
mod report;
mod udp_destination;
mod uplink;

use std::io::Write;
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::lan::Key;
use crate::lan::outgoing::{ANNOUNCE_EVERY, Form};
use scanhub_schema::{Failure, Kind};
use scanhub_shm::Domain;

use crate::forward::{Forwarder, Selection, begin_life};
use crate::key_file;
use crate::stamp;
use network::Network;
use report::Report;
use scanhub_verbs::lossy_writer::LossyWriter;
use scanhub_verbs::output::{End, quiet};
use uplink::Uplink;

/// What `gateway` is asked for.
#[derive(Clone, Debug)]
pub struct GatewayOptions {
    /// The network interface of the groups; without one nothing goes to groups.
    pub interface: Option<String>,
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`, with `:every=N` to thin it; none: the default topics of all
    /// sensors, see [`Selection::is_default`].
    pub topics: Vec<String>,
    /// `HOST:PORT` of those that get copies; a name is asked for again while it runs, as its address may change.
    pub to: Vec<String>,
    /// Telegrams and nothing else, without a header.
    pub bare: bool,
    /// The file with the key of which every datagram gets a MAC.
    pub key_file: Option<PathBuf>,
    /// How many routers pass on what goes to the groups.
    pub ttl: u8,
    /// The background goes out so often, besides when it is a new one.
    pub background_every: Option<Duration>,
    /// The longest datagram, in bytes.
    pub longest: usize,
    /// How it tells of itself.
    pub look: GatewayLook,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

impl GatewayOptions {
    /// What can be known without a network and without a hub: whether the topics are some, and go with the rest.
    ///
    /// [`Kind::Usage`] with the topics that there are, else [`Kind::Configuration`].
    pub fn check(&self) -> Result<(), Failure> {
        self.selection().map(drop)
    }

    fn selection(&self) -> Result<Selection, Failure> {
        let selection = Selection::parse(&self.topics, self.bare)?;
        if self.bare && self.background_every.is_some() {
            let what = "no background is sent where only telegrams are";
            return Err(Failure::new(Kind::Configuration, what, "leave bare or background_every out"));
        }
        if self.bare && self.key_file.is_some() {
            let what = "bare telegrams have no room for a MAC";
            return Err(Failure::new(Kind::Configuration, what, "leave bare or key_file out"));
        }
        Ok(selection)
    }
}

/// How a gateway tells of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GatewayLook {
    /// Lines at the begin, at the end and when asked.
    Lines,
    /// Objects, once a second.
    Json,
    /// One line that is drawn over itself.
    Terminal,
}

/// Sends until `stop` is set, whatever becomes of the hub and of the network. The account goes to `out` at the end and
/// whenever `tell` is set; what is no account to `notes` (stderr) if `out` is not JSON. Lines for which there is no room
/// are left out: whoever does not read delays nothing but the end, and that by a second.
///
/// [`Kind::Configuration`] if there is no such interface, neither an interface nor a host is named, a destination is no host,
/// a value is not possible, or the key file holds no key of this user alone; [`Kind::Usage`] if there is no such topic; [`Kind::NoTopic`] if the first hub that is met has no
/// such sensor; [`Kind::Short`] if descriptors or memory are; [`Kind::Interrupted`] if `stop` is set before it is known
/// where the hosts are.
pub fn gateway(
    options: &GatewayOptions,
    out: &mut (impl Write + AsFd),
    notes: &mut (impl Write + AsFd),
    tell: &AtomicBool,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let mut gateway = Gateway::open(options, stop)?;
    let (mut out, mut notes) = (LossyWriter::around(out, stop), LossyWriter::around(notes, stop));
    let mut report = Report::new(options.look, &mut out, &mut notes);
    quiet(gateway.run(&mut report, tell, stop))
}

struct Gateway<'a> {
    options: &'a GatewayOptions,
    /// Of its key, if there is one.
    key_name: Option<String>,
    forwarder: Forwarder,
    network: Network,
    tick_at: Instant,
}

/// In the place of an interface, in the name of the file that keeps a gateway's number: it sends to no group.
const HOSTS: &str = "hosts";

/// Between two lines of the account, which come with the announcements.
const TICK: Duration = ANNOUNCE_EVERY;

impl<'a> Gateway<'a> {
    fn open(options: &'a GatewayOptions, stop: &AtomicBool) -> Result<Gateway<'a>, Failure> {
        let selection = options.selection()?;
        if options.interface.is_none() && options.to.is_empty() {
            return Err(uplink::nowhere());
        }
        let key = options.key_file.as_deref().map(key_file::read).transpose()?;
        let interface = options.interface.as_deref().map(Uplink::open).transpose()?;
        let domain = options.places.first().map(Domain::name).unwrap_or_default();
        let life = begin_life(domain, interface.as_ref().map_or(HOSTS, Uplink::name))?;
        let key_name = key.as_ref().map(Key::name);
        let form = match key {
            Some(key) => Form::Authenticated(key),
            None if options.bare => Form::Bare,
            None => Form::Sealed,
        };
        let mut network =
            Network::open(life, interface, &options.to, form, options.ttl, options.longest, stop)?;
        let forwarder = Forwarder::new(selection, &options.places, &mut network);
        Ok(Gateway { options, key_name, forwarder, network, tick_at: Instant::now() })
    }

    fn run(&mut self, report: &mut Report<'_>, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        report.begin(&self.network, self.options.bare, self.key_name.as_deref())?;
        if self.network.destinations.groups.as_ref().is_some_and(|groups| !groups.interface.is_up()) {
            report.interface(&self.network)?;
        }
        let end = self.go_on(report, tell, stop);
        // However it ends: how many were sent is the last word.
        self.announce();
        end.and_then(|()| report.account(&self.network))
    }

    fn go_on(&mut self, report: &mut Report<'_>, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        while !stop.load(Ordering::Relaxed) {
            if self.network.destinations.look() {
                report.interface(&self.network)?;
            }
            // What is there comes before the question whether the hub still is: that takes longer than sending.
            let more = self.forwarder.forward(&mut self.network)?;
            let now = Instant::now();
            self.forwarder.look(now, &mut self.network, &mut |notice| report.hub(notice))?;
            self.tick(report, now)?;
            if tell.swap(false, Ordering::Relaxed) {
                report.account(&self.network)?;
            }
            if !more {
                self.forwarder.wait(self.tick_at.saturating_duration_since(now))?;
            }
        }
        Ok(())
    }

    /// Once a second: announcements, backgrounds, and what became of destinations.
    fn tick(&mut self, report: &mut Report<'_>, now: Instant) -> Result<(), End> {
        if now < self.tick_at {
            return Ok(());
        }
        self.tick_at = now + TICK;
        if let Some(every) = self.options.background_every {
            let Network { outgoing, destinations, .. } = &mut self.network;
            outgoing.repeat(every, stamp::now(), destinations);
        }
        self.announce();
        for destination in self.network.destinations.all_mut() {
            if let Some(address) = destination.follow_name(now) {
                report.moved(&destination.name, address)?;
            }
            if let Some(news) = destination.news() {
                report.destination(&destination.name, &news)?;
            }
        }
        if let Some(what) = self.network.outgoing.misfit() {
            report.misfit(&what, self.network.outgoing.longest())?;
        }
        report.periodic(&self.network, self.forwarder.is_there())
    }

    fn announce(&mut self) {
        let Network { outgoing, destinations, .. } = &mut self.network;
        outgoing.announce(stamp::now(), destinations);
    }
}
