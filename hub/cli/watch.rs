//! `scanhub watch` on the command line.

use std::io::{IsTerminal, stdout};

use clap::Args;
use scanhub_schema::{Failure, Kind};
use scanhub_viewer::WatchOptions;

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Watch {
    /// Sensors to show [default: all]
    #[arg(value_name = "SENSOR")]
    sensors: Vec<String>,
    #[command(flatten)]
    limits: Limits,
}

impl Watch {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<WatchOptions, Failure> {
        if everywhere.json || !can_show_pictures() {
            let sensor = self.sensors.first().map_or("robot/zones".to_owned(), |name| format!("{name}/scan"));
            let hint = format!("lines for files and programs: scanhub echo {sensor}, with --json as objects");
            let what = if everywhere.json { "a picture is no JSON" } else { "the picture needs a terminal" };
            return Err(Failure::new(Kind::Usage, what, hint));
        }
        Ok(WatchOptions {
            sensors: self.sensors.clone(),
            colours: colours(),
            note: String::new(),
            bounds: self.limits.bounds(),
            places: everywhere.places()?,
        })
    }
}

/// Whether stdout is a terminal with cursor control.
pub(crate) fn can_show_pictures() -> bool {
    stdout().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb")
}

/// Whether colours are wanted: `NO_COLOR` is unset or empty (<https://no-color.org>).
pub(crate) fn colours() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// The keys, for the end of the help.
pub(crate) const KEYS: &str = "\
Keys: q quits, ? lists the other keys. NO_COLOR=1 shows signs instead of colours. From another machine: ssh -t robot scanhub watch.";
