//! `scanhub leds` on the command line.

use std::io::{IsTerminal, stdout};
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use scanhub_schema::Failure;
use scanhub_verbs::{LedsLook, LedsOptions, duration};

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Leds {
    /// The sensor, or robot for the verdict over all sensors
    sensor: String,
    /// LEDs of this machine that show the lights too: green=NAME, yellow=NAME, red=NAME, mark=NAME, separated by commas;
    /// red is lit when the verdict is unknown, and after the end
    #[arg(long = "led", value_name = "LIGHT=NAME", value_delimiter = ',')]
    leds: Vec<String>,
    /// Directory of the LEDs
    #[arg(long, default_value = "/sys/class/leds", value_name = "DIR")]
    led_root: PathBuf,
    /// How long a better verdict must last before it is shown; a worse one is shown at once
    #[arg(long, default_value = "300ms", value_name = "DURATION", value_parser = duration::parse)]
    hold: Duration,
    /// Show early warnings too, before a scan is complete (docs/early.md)
    #[arg(long)]
    early: bool,
    #[command(flatten)]
    limits: Limits,
}

impl Leds {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<LedsOptions, Failure> {
        Ok(LedsOptions {
            sensor: self.sensor.clone(),
            leds: self.leds.clone(),
            led_root: self.led_root.clone(),
            look: match (everywhere.json, stdout().is_terminal()) {
                (true, _) => LedsLook::Json,
                (false, true) => LedsLook::Terminal { colours: scanhub_viewer::colors() },
                (false, false) => LedsLook::Lines,
            },
            hold: self.hold,
            early: self.early,
            bounds: self.limits.bounds(),
            places: everywhere.places()?,
        })
    }
}

/// What the lights mean, for the end of the help.
pub(crate) const MEANING: &str =
    "green: clear, yellow: slow, red: stop or unknown, mark: at least one reflector mark";
