//! `scanhub zones` on the command line.

use std::io::{Write, stderr};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use clap::{Args, Subcommand};
use scanhub_schema::Failure;
use scanhub_tools::Progress;
use scanhub_verbs::{MaskOptions, duration};

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Zones {
    /// The sensor
    sensor: String,
    #[command(subcommand)]
    order: Order,
}

#[derive(Debug, Subcommand)]
enum Order {
    /// Learn what the sensor sees of its own robot, and print it as configuration. Place the robot in an open area with
    /// nobody near it
    Mask {
        /// How long to look, for example 10s
        #[arg(long = "for", default_value = "10s", value_name = "DURATION", value_parser = duration::parse)]
        run_for: Duration,
        /// Only points within this distance (metres) of the robot's centre can be its body [default: the largest circle
        /// of the zones]
        #[arg(long, value_name = "RADIUS")]
        within: Option<f64>,
    },
}

impl Zones {
    pub(crate) fn run(
        &self,
        everywhere: &Everywhere,
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let Order::Mask { run_for, within } = self.order;
        let options = MaskOptions {
            sensor: self.sensor.clone(),
            run_for,
            within_m: within,
            json: everywhere.json,
            places: everywhere.places()?,
        };
        let mut progress = Progress::on_stderr();
        let mut tell = |what: Option<&str>| match what {
            Some(what) => progress.show(what),
            None => progress.clear(),
        };
        scanhub_verbs::mask(&options, out, &mut stderr(), &mut tell, stop)
    }
}
