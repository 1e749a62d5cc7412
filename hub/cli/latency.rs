//! `scanhub latency` on the command line.

use std::io::{IsTerminal, stdout};
use std::time::Duration;

use clap::{Args, ValueEnum};
use scanhub_client::Wait;
use schema::Failure;
use verbs::{LatencyOptions, duration};

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Latency {
    /// What to follow: front/scan, rear/telegram, robot1.front/zones ..
    #[arg(required = true, value_name = "SENSOR/TOPIC")]
    topics: Vec<String>,
    /// Exit 5 if more than one in a hundred samples of a topic is older on arrival, for example 1ms
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    max_p99: Option<Duration>,
    /// How to wait for samples
    #[arg(long, value_enum, default_value = "doorbell")]
    wait: By,
    /// Neither real-time priority nor locked memory, also where they are permitted
    #[arg(long)]
    no_realtime: bool,
    #[command(flatten)]
    limits: Limits,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum By {
    /// Asleep at a word in shared memory, at which one call of the hub wakes all
    Doorbell,
    /// Asleep at the event that other languages listen to: one message of the hub to each consumer
    Event,
    /// Not asleep: takes a whole processor
    Spin,
}

impl Latency {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<LatencyOptions, Failure> {
        Ok(LatencyOptions {
            topics: self.topics.clone(),
            json: everywhere.json,
            terminal: stdout().is_terminal(),
            wait: match self.wait {
                By::Doorbell => Wait::Doorbell,
                By::Event => Wait::Event,
                By::Spin => Wait::Spin,
            },
            realtime: !self.no_realtime,
            max_p99: self.max_p99,
            bounds: self.limits.bounds(),
            places: everywhere.places()?,
        })
    }
}

/// What the help says of what is measured.
pub(crate) const SPANS: &str = "line: first byte to last; network: a remote sensor's first byte to the arrival on this \
machine, by the wall clocks of both; hub: last byte until sent; wake: sent until received; age: last byte, or arrival on \
this machine, until received, which is what --max-p99 judges; total: all of it\n\n\
A hundred scans a check: scanhub latency front/scan -n 100 --timeout 5s --max-p99 1ms";
