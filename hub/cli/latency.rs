//! `scanhub latency` on the command line.

use std::io::{IsTerminal, stdout};
use std::time::Duration;

use clap::{Args, ValueEnum};
use scanhub_client::Wait;
use scanhub_schema::Failure;
use scanhub_verbs::{LatencyOptions, duration};

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Latency {
    /// Topics to follow: front/scan, rear/telegram, robot1.front/zones ..
    #[arg(required = true, value_name = "SENSOR/TOPIC")]
    topics: Vec<String>,
    /// Exit with 5 if more than one in a hundred samples of a topic is older on arrival, for example 1ms
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    max_p99: Option<Duration>,
    /// How to wait for samples
    #[arg(long, value_enum, default_value = "doorbell")]
    wait: By,
    /// Do not ask for real-time priority and locked memory
    #[arg(long)]
    no_realtime: bool,
    #[command(flatten)]
    limits: Limits,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum By {
    /// Sleep on a word in shared memory; one call of the hub wakes all
    Doorbell,
    /// Sleep on the event; the hub sends one message to each consumer
    Event,
    /// Do not sleep; uses a whole processor
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

/// What is measured, for the end of the help.
pub(crate) const SPANS: &str = "line: first byte to last; network: a remote sensor's first byte to the arrival on this \
machine, by the wall clocks of both; hub: last byte until sent; wake: sent until received; age: last byte, or arrival on \
this machine, until received, which --max-p99 checks; total: all of it\n\n\
To check a hundred scans: scanhub latency front/scan -n 100 --timeout 5s --max-p99 1ms";
