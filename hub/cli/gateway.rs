//! `scanhub gateway` on the command line.

use std::io::{IsTerminal, stdout};
use std::time::Duration;

use clap::Args;
use config::Sources;
use schema::{Failure, Kind};
use verbs::{GatewayLook, GatewayOptions, duration};

use super::{Configured, Everywhere};

/// Each flag is also a key of section `gateway` of the configuration, and wins over it.
#[derive(Args, Debug, Default)]
pub(crate) struct Gateway {
    /// Network interface of the groups: whoever is on it can read all that is sent. Without one nothing goes to groups, and
    /// hosts have to be named. lo is this machine alone
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// What goes out, front/scan, */scan for all sensors or front/* for all topics; :every=4 behind it keeps the samples of every fourth telegram.
    /// May be given several times; without it all topics but telegrams, of all sensors
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    topics: Vec<String>,
    // Help for people, in which brackets are no link.
    #[allow(rustdoc::broken_intra_doc_links)]
    /// A host that gets copies, or [IPV6]:PORT; a name is asked for again while it runs. May be given
    /// several times
    #[arg(long, value_name = "HOST:PORT")]
    to: Vec<String>,
    /// The telegrams and nothing else, without a header, each sensor's to a port of its own
    #[arg(long, conflicts_with = "background_every")]
    bare: bool,
    /// How many networks what goes to the groups may cross, the first one included [default: 1]
    #[arg(long, value_name = "N")]
    ttl: Option<u8>,
    /// The background goes out so often, and not only when it is a new one, for example 10s
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    background_every: Option<Duration>,
    /// The longest datagram in bytes, up to 1472 where no tunnel is on the way [default: 1372]
    #[arg(long, value_name = "BYTES")]
    mtu: Option<usize>,
    #[command(flatten)]
    configured: Configured,
}

impl Gateway {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        let options = self.over(config::Gateway::load(&self.configured.sources())?, everywhere)?;
        if self.topics.is_empty() {
            // They stand in the configuration.
            options.check().map_err(of_section)?;
        }
        Ok(options)
    }

    /// Whether the section in `sources` is one that a gateway takes.
    pub(super) fn check(sources: &Sources, everywhere: &Everywhere) -> Result<(), Failure> {
        let checked = Gateway::default().over(config::Gateway::load(sources)?, everywhere)?.check();
        checked.map_err(of_section)
    }

    /// These flags over what is `said` in the section.
    fn over(&self, said: config::Gateway, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        let every = background_every(&said)?;
        let or = |flags: &[String], said: Option<Vec<String>>| match flags {
            [] => said.unwrap_or_default(),
            flags => flags.to_vec(),
        };
        Ok(GatewayOptions {
            interface: self.interface.clone().or(said.interface),
            topics: or(&self.topics, said.topics),
            to: or(&self.to, said.to),
            bare: self.bare || said.bare.unwrap_or_default(),
            ttl: self.ttl.or(said.ttl).unwrap_or(config::Gateway::TTL),
            background_every: self.background_every.or(every),
            longest: self.mtu.or(said.mtu).unwrap_or(config::Gateway::MTU),
            look: match (everywhere.json, stdout().is_terminal()) {
                (true, _) => GatewayLook::Json,
                (false, true) => GatewayLook::Terminal,
                (false, false) => GatewayLook::Lines,
            },
            places: everywhere.places()?,
        })
    }
}

fn of_section(failure: Failure) -> Failure {
    Failure::new(Kind::Configuration, format!("section gateway: {}", failure.message), failure.hint)
}

/// How often the configuration wants a background to go out.
fn background_every(said: &config::Gateway) -> Result<Option<Duration>, Failure> {
    let every = said.background_every.as_ref().map(|(text, place)| {
        let refuse =
            |what| Failure::new(Kind::Configuration, format!("{place}: {what}"), "write 10s, 250ms, 5m");
        duration::parse(text).map_err(refuse)
    });
    every.transpose()
}

/// What the help says of where it sends.
pub(crate) const GROUPS: &str = "groups, port 22200: 239.255.76.80 announce, status; .81 zones, marks, foreground; \
.82 scan, background; .83 telegram\nbare: 239.255.76.83, port 22201 for the first sensor, 22202 for the second ..\n\
SIGUSR1: the account so far";
