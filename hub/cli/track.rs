//! `scanhub track` on the command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use scanhub_perception::verbs::TrackOptions;
use scanhub_schema::Failure;
use scanhub_verbs::{Bounds, duration};

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Track {
    /// The site file: sensors, rooms and doors
    #[arg(long, value_name = "FILE")]
    site: PathBuf,
    /// Also publish the topics NAME/tracks and NAME/events. NAME must not be in use
    #[arg(long = "as", value_name = "NAME", value_parser = tracker)]
    name: Option<String>,
    /// Print only how many went through this door, each time that somebody does. Can be repeated
    #[arg(long, value_name = "DOOR")]
    count: Vec<String>,
    /// How long to wait for a sensor's scan after other sensors have sent later ones
    #[arg(long, default_value = "80ms", value_name = "DURATION", value_parser = duration::parse)]
    delay: Duration,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Exit with 3 after this time without a scan
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    timeout: Option<Duration>,
}

/// A name that topics of a tracker can have.
fn tracker(name: &str) -> Result<String, String> {
    scanhub_schema::check_sensor(name).map(|()| name.to_owned()).map_err(|failure| format!("{failure}"))
}

impl Track {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<TrackOptions, Failure> {
        Ok(TrackOptions {
            site: scanhub_perception::track::Site::read(&self.site)?,
            name: self.name.clone(),
            count: self.count.clone(),
            delay: self.delay,
            json: everywhere.json,
            bounds: Bounds { count: None, run_for: self.run_for, timeout: self.timeout },
            places: everywhere.places()?,
        })
    }
}
