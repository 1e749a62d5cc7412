//! `scanhub gateway` on the command line.

use std::io::{IsTerminal, stdout};
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use config::Sources;
use schema::{Failure, Kind};
use verbs::{GatewayLook, GatewayOptions, duration};

use super::{Configured, Everywhere};

/// Each flag is also a key of section `gateway` of the configuration, and wins over it.
#[derive(Args, Debug, Default)]
pub(crate) struct Gateway {
    /// Network interface for the groups: everybody on that network can read what is sent. Without it, nothing is sent to
    /// groups, and --to must name hosts. lo: this machine only
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// Topics to send: front/scan, */scan for all sensors or front/* for all topics. With :every=4, only the samples of
    /// every fourth telegram. Can be repeated [default: all topics except telegrams and lines, of all sensors]
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    topics: Vec<String>,
    // Help for people, in which brackets are no link.
    #[allow(rustdoc::broken_intra_doc_links)]
    /// Host that gets copies, HOST:PORT or [IPV6]:PORT; a name is resolved again while the gateway runs. Can be repeated
    #[arg(long, value_name = "HOST:PORT")]
    to: Vec<String>,
    /// Send only telegrams, without a header, each sensor on its own port
    #[arg(long, conflicts_with = "background_every")]
    bare: bool,
    /// File with the key of which every datagram gets a MAC, so that `listen --key-file` knows who sent it; `scanhub key
    /// new` makes one
    #[arg(long, value_name = "FILE", conflicts_with = "bare")]
    key_file: Option<PathBuf>,
    /// How many networks datagrams to the groups may cross, including the first one [default: 1]
    #[arg(long, value_name = "N")]
    ttl: Option<u8>,
    /// Send the background also at this interval, not only when it is new, for example 10s
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    background_every: Option<Duration>,
    /// Longest datagram in bytes, up to 1472 if no tunnel is on the way [default: 1372]
    #[arg(long, value_name = "BYTES")]
    mtu: Option<usize>,
    #[command(flatten)]
    configured: Configured,
}

impl Gateway {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        let options = self.over(config::Gateway::load(&self.configured.sources())?, everywhere)?;
        if self.topics.is_empty() {
            // They come from the configuration.
            options.check().map_err(of_section)?;
        }
        Ok(options)
    }

    /// Checks that a gateway accepts the section in `sources`.
    pub(super) fn check(sources: &Sources, everywhere: &Everywhere) -> Result<(), Failure> {
        let checked = Gateway::default().over(config::Gateway::load(sources)?, everywhere)?.check();
        checked.map_err(of_section)
    }

    /// These flags, and the values `said` in the section where a flag is missing.
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
            key_file: self.key_file.clone().or(said.key_file),
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

/// How often the configuration has the background sent.
fn background_every(said: &config::Gateway) -> Result<Option<Duration>, Failure> {
    let every = said.background_every.as_ref().map(|(text, place)| {
        let refuse =
            |what| Failure::new(Kind::Configuration, format!("{place}: {what}"), "write 10s, 250ms, 5m");
        duration::parse(text).map_err(refuse)
    });
    every.transpose()
}

/// Where it sends, for the end of the help.
pub(crate) const GROUPS: &str = "groups, port 22200: 239.255.76.80 announce, status; .81 zones, marks, foreground; \
.82 scan, background; .83 telegram\nbare: 239.255.76.83, port 22201 for the first sensor, 22202 for the second ..\n\
SIGUSR1: print the counts so far";
