//! `scanhub listen` on the command line.

use std::io::{IsTerminal, stdout};
use std::path::PathBuf;

use clap::Args;
use scanhub_network::ListenOptions;
use scanhub_schema::Failure;
use scanhub_schema::limits::TopicLimits;
use scanhub_shm::StateDirectory;

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Listen {
    /// Network interface to listen on [default: all that have a link]
    #[arg(long, value_name = "IF")]
    interface: Option<String>,
    /// Topic to listen to, of all sensors, for example zones [default: all topics]
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Name a hub, instead of its 16 hex digits, for example robot1=5f3a12bc00d1e2f3
    #[arg(long = "name", value_name = "NAME=HUB")]
    names: Vec<String>,
    /// Hub to listen to, by its 16 hex digits or its name from --name [default: all]
    #[arg(long = "hub", value_name = "HUB")]
    hubs: Vec<String>,
    /// Accept only datagrams that are authenticated with the key in this file, and each of them once. Clocks must agree
    /// within 5 s
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
    /// Print only the counts: received, lost, duplicate, reordered, refused
    #[arg(long)]
    stats: bool,
    /// Publish the samples in this machine's domain as HUB.SENSOR instead of printing them, so that all programs here can
    /// use them like sensors of a hub
    #[arg(long)]
    publish: bool,
    /// Places for consumers of each published topic, 1 to 250
    #[arg(long, value_name = "N", requires = "publish", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=250))]
    consumers: u16,
    /// Shared memory that all published topics may take together, in MB (2^20 bytes). A sensor that does not fit is refused
    #[arg(long, value_name = "MB", requires = "publish", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
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
            key_file: self.key_file.clone(),
            state: StateDirectory::of_domain(&everywhere.domain),
            stats: self.stats,
            publish: if self.publish { Some(everywhere.publisher_domain()?) } else { None },
            limits: TopicLimits { consumers: self.consumers.into(), ..TopicLimits::default() },
            memory: u64::from(self.memory) << 20,
            json: everywhere.json,
            terminal: stdout().is_terminal(),
            bounds: self.limits.bounds(),
        })
    }
}

/// What signals do, for the end of the help.
pub(crate) const SIGNALS: &str = "SIGUSR1: print the counts so far";
