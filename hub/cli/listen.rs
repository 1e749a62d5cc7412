//! `scanhub listen` on the command line.

use std::io::{IsTerminal, stdout};

use clap::Args;
use schema::Failure;
use verbs::ListenOptions;

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Listen {
    /// Network interface to listen on; without it all that have a link
    #[arg(long, value_name = "IF")]
    interface: Option<String>,
    /// Topic of all sensors to listen to, for example zones; all topics if none is named
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// What to call a hub instead of its 16 hex digits, for example robot1=5f3a12bc00d1e2f3
    #[arg(long = "name", value_name = "NAME=HUB")]
    names: Vec<String>,
    /// Hub to hear, by its 16 hex digits or by the name that --name gives it; all if none is named
    #[arg(long = "hub", value_name = "HUB")]
    hubs: Vec<String>,
    /// Only the account: what was received, lost, doubled, out of order, refused
    #[arg(long)]
    stats: bool,
    /// Publish what comes in the domain of this machine as HUB.SENSOR, instead of writing it, so that all programs here
    /// follow remote sensors as they follow those of a hub
    #[arg(long)]
    publish: bool,
    #[command(flatten)]
    limits: Limits,
}

impl Listen {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<ListenOptions, Failure> {
        Ok(ListenOptions {
            interface: self.interface.clone(),
            topics: self.topics.clone(),
            names: self.names.clone(),
            hubs: self.hubs.clone(),
            stats: self.stats,
            publish: if self.publish { Some(everywhere.hub_domain()?) } else { None },
            json: everywhere.json,
            terminal: stdout().is_terminal(),
            bounds: self.limits.bounds(),
        })
    }
}

/// What the help says of signals.
pub(crate) const SIGNALS: &str = "SIGUSR1: the account so far";
