//! `scanhub site` on the command line: the plan that `track` follows people in.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_files::output;
use scanhub_schema::Failure;
use serde::Serialize;

use crate::{line, print};

#[derive(Args, Debug)]
pub(crate) struct Site {
    #[command(subcommand)]
    order: Order,
}

#[derive(Debug, Subcommand)]
enum Order {
    /// Check a site file; if it has an error, show the place and exit with 78
    Check {
        /// The site file: sensors, rooms and doors
        file: PathBuf,
        /// Draw the plan into this file
        #[arg(long, value_name = "OUT")]
        svg: Option<PathBuf>,
        /// Replace an existing file of --svg
        #[arg(long, requires = "svg")]
        force: bool,
    },
}

#[derive(Serialize)]
struct Checked {
    class: &'static str,
    sensors: Vec<String>,
    rooms: Vec<String>,
    /// Those that no sensor is in.
    unwatched: Vec<String>,
    doors: Vec<String>,
    gaps: usize,
    ignored: Vec<String>,
}

impl Site {
    pub(crate) fn run(&self, json: bool) -> Result<(), Failure> {
        let Order::Check { file, svg, force } = &self.order;
        let site = scanhub_perception::track::Site::read(file)?;
        if let Some(out) = svg {
            output::write(out, site.svg().as_bytes(), *force)?;
        }
        let watched = site.watched();
        let rooms: Vec<String> = site.rooms.iter().map(|room| room.name.clone()).collect();
        let checked = Checked {
            class: "site",
            sensors: site.sensors.iter().map(|sensor| sensor.name.clone()).collect(),
            unwatched: rooms
                .iter()
                .zip(&watched)
                .filter(|(_, seen)| !**seen)
                .map(|(name, _)| name.clone())
                .collect(),
            rooms,
            doors: site.doors.iter().map(|door| door.name.clone()).collect(),
            gaps: site.gaps.len(),
            ignored: site.ignored.iter().map(|area| area.name.clone()).collect(),
        };
        print(&if json { line(&checked) } else { checked.text() })
    }
}

impl Checked {
    fn text(&self) -> String {
        let mut text = format!(
            "sensors: {}\nrooms: {}\ndoors: {}\ngaps: {}",
            self.sensors.join(", "),
            self.rooms.join(", "),
            if self.doors.is_empty() { "none".to_owned() } else { self.doors.join(", ") },
            self.gaps
        );
        if !self.ignored.is_empty() {
            text += &format!("\nignored areas: {}", self.ignored.join(", "));
        }
        if !self.unwatched.is_empty() {
            text += &format!("\nno sensor is in: {}", self.unwatched.join(", "));
        }
        text
    }
}
