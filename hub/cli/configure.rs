//! `scanhub configure` on the command line: what it takes, and what it says.

use std::io::{IsTerminal, stderr, stdout};
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_schema::Failure;
use scanhub_tools::configure::{ConfigureEvent, ConfigureRequest, configure};
use scanhub_tools::probe::source;

use super::Everywhere;
use super::probe::Progress;

#[derive(Args, Debug)]
pub(crate) struct Configure {
    /// Port of the sensor: a tty or tcp:HOST:PORT
    #[arg(value_name = "PORT")]
    port: String,
    /// Settings to write: unit=mm|cm, mode=NAME|0x01, availability=1|2|3, indices=on|off, sensitivity=standard|medium|low|high,
    /// power_on_baud=9600|keep, configuration=HEX
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Password of the installation mode
    #[arg(long, default_value = "SICK_LMS", value_name = "WORD")]
    password: String,
}

/// Who must confirm, for the end of the help.
pub(crate) const CONSENT: &str = "A person must confirm. If stdin or stderr is not a terminal, the difference is \
                                  shown, nothing is written, and the exit code is 2";

impl Configure {
    pub(crate) fn run(&self, everywhere: &Everywhere, stop: &AtomicBool) -> Result<(), Failure> {
        let request = ConfigureRequest {
            source: source(&self.port)?,
            places: everywhere.places()?,
            settings: self.settings.clone(),
            password: self.password.clone(),
        };
        let json = everywhere.json;
        let mut progress = Progress::new();
        let outcome = configure(&request, stop, &mut |news| match news {
            ConfigureEvent::Searching(rate) => progress.show(&format!("looking at {rate} Bd")),
            ConfigureEvent::Step(what) => progress.show(what),
            ConfigureEvent::Asking => progress.clear(),
            ConfigureEvent::Difference(difference) => {
                progress.clear();
                crate::say(&if json { crate::line(difference) } else { difference.to_string() });
                // The person who confirms must see it, even if stdout is redirected.
                if !stdout().is_terminal() && stderr().is_terminal() {
                    crate::complain(&difference.to_string());
                }
            }
            ConfigureEvent::Configured(configured) => {
                progress.clear();
                crate::say(&if json { crate::line(configured) } else { configured.to_string() });
            }
        });
        if outcome.is_err() {
            progress.leave();
        }
        outcome
    }
}
