//! `scanhub gateway` on the command line.

use std::io::{IsTerminal, stdout};
use std::time::Duration;

use clap::Args;
use clients::{GatewayLook, GatewayOptions, duration};
use schema::Failure;
use schema::datagram::MTU_SAFE;

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Gateway {
    /// Network interface of the groups; need not be named if only one is up and has multicast
    #[arg(long, env = "SCANHUB_INTERFACE", value_name = "NAME")]
    interface: Option<String>,
    /// What goes out, front/scan or */scan for all sensors; :every=4 behind it keeps the samples of every fourth telegram.
    /// May be given several times; without it all topics but telegrams, of all sensors
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    topics: Vec<String>,
    /// A host that gets copies, besides the groups; may be given several times
    #[arg(long, value_name = "HOST:PORT")]
    to: Vec<String>,
    /// The telegrams and nothing else, without a header, each sensor's to a port of its own
    #[arg(long, conflicts_with = "background_every")]
    bare: bool,
    /// How many routers may pass on what goes to the groups, and one more
    #[arg(long, default_value_t = 1, value_name = "N")]
    ttl: u8,
    /// The background goes out so often, and not only when it is a new one, for example 10s
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    background_every: Option<Duration>,
    /// The longest datagram in bytes; 1472 where no tunnel is on the way
    #[arg(long, default_value_t = MTU_SAFE, value_name = "BYTES")]
    mtu: usize,
}

impl Gateway {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        Ok(GatewayOptions {
            interface: self.interface.clone(),
            topics: self.topics.clone(),
            to: self.to.clone(),
            bare: self.bare,
            ttl: self.ttl,
            background_every: self.background_every,
            longest: self.mtu,
            look: match (everywhere.json, stdout().is_terminal()) {
                (true, _) => GatewayLook::Json,
                (false, true) => GatewayLook::Terminal,
                (false, false) => GatewayLook::Lines,
            },
            places: everywhere.places()?,
        })
    }
}

/// What the help says of where it sends.
pub(crate) const GROUPS: &str = "groups, port 22200: 239.255.76.80 announce, status; .81 zones, marks, foreground; \
.82 scan, background; .83 telegram\nbare: 239.255.76.83, port 22201 for the first sensor, 22202 for the second ..\n\
SIGUSR1: the account so far";
