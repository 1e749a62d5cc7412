//! `scanhub probe` on the command line: what it takes, and what it says.

use std::io::{IsTerminal, Write, stderr};
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_port::{Candidate, PortlessAdapter};
use scanhub_schema::Failure;
use scanhub_tools::probe::{Ports, probe, source};
use serde::Serialize;

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Probe {
    /// Port to look at: a tty or tcp:HOST:PORT; without one, the ports of this machine are listed
    #[arg(value_name = "PORT")]
    port: Option<String>,
    /// Print only the link for a configuration file
    #[arg(long, requires = "port", conflicts_with = "json")]
    toml: bool,
}

impl Probe {
    pub(crate) fn run(&self, everywhere: &Everywhere, stop: &AtomicBool) -> Result<(), Failure> {
        let json = everywhere.json;
        let Some(port) = &self.port else {
            let ports = Ports::of_machine();
            for candidate in &ports.candidates {
                crate::print(&if json { crate::line(&Line::of(candidate)) } else { describe(candidate) })?;
            }
            for adapter in &ports.portless {
                crate::print(&if json { crate::line(&Adapter::of(adapter)) } else { explain(adapter) })?;
            }
            return ports.check();
        };
        let mut progress = Progress::new();
        let places = everywhere.places()?;
        let found =
            probe(&source(port)?, &places, stop, |rate| progress.show(&format!("looking at {rate} Bd")));
        if found.is_err() {
            progress.leave();
        }
        drop(progress);
        let found = found?;
        crate::print(&if json {
            crate::line(&found)
        } else if self.toml {
            found.link.toml()
        } else {
            format!("{port}\n{found}")
        })
    }
}

/// A line on the terminal that the next one overwrites; nothing if there is no terminal.
pub(crate) struct Progress {
    is_terminal: bool,
    /// Whether there is something on the line.
    is_shown: bool,
}

impl Progress {
    pub(crate) fn new() -> Progress {
        Progress { is_terminal: stderr().is_terminal(), is_shown: false }
    }

    pub(crate) fn show(&mut self, text: &str) {
        if self.is_terminal {
            let _ = write!(stderr(), "\r\x1b[K{text} ..");
            self.is_shown = true;
        }
    }

    pub(crate) fn clear(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            let _ = write!(stderr(), "\r\x1b[K");
        }
    }

    /// Keeps the last text on its own line: that step failed, and the reason is printed next.
    pub(crate) fn leave(&mut self) {
        if std::mem::take(&mut self.is_shown) {
            let _ = writeln!(stderr());
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}

/// Class `candidate`.
#[derive(Serialize)]
struct Line<'a> {
    class: &'static str,
    port: String,
    device: String,
    driver: Option<&'a str>,
    product: Option<&'a str>,
    permitted: bool,
    /// The process that has it open.
    holder: Option<u32>,
    program: Option<&'a str>,
    /// The name below by-id that another adapter has too.
    shared_name: Option<String>,
    caution: Option<String>,
    remedy: Option<String>,
}

impl<'a> Line<'a> {
    fn of(candidate: &'a Candidate) -> Line<'a> {
        let (caution, remedy) = caution(candidate).unzip();
        Line {
            class: "candidate",
            port: candidate.name.display().to_string(),
            device: candidate.device.display().to_string(),
            driver: candidate.driver.as_deref(),
            product: candidate.product.as_deref(),
            permitted: candidate.is_permitted,
            holder: candidate.holder.as_ref().map(|holder| holder.pid),
            program: candidate.holder.as_ref().map(|holder| holder.program.as_str()),
            shared_name: candidate.shared_name.as_ref().map(|name| name.display().to_string()),
            caution,
            remedy,
        }
    }
}

/// Class `adapter`.
#[derive(Serialize)]
struct Adapter<'a> {
    class: &'static str,
    usb: &'a str,
    id: &'a str,
    chip: &'a str,
    module: &'a str,
    problem: String,
    remedy: String,
}

impl<'a> Adapter<'a> {
    fn of(adapter: &'a PortlessAdapter) -> Adapter<'a> {
        Adapter {
            class: "adapter",
            usb: &adapter.usb,
            id: &adapter.id,
            chip: adapter.chip,
            module: adapter.module,
            problem: adapter.to_string(),
            remedy: adapter.remedy(),
        }
    }
}

/// Returns the caution about a port, including one about the name that it shares.
fn caution(candidate: &Candidate) -> Option<(String, String)> {
    candidate.caution(candidate.shared_name.as_ref().unwrap_or(&candidate.name))
}

fn explain(adapter: &PortlessAdapter) -> String {
    format!("{adapter}\n  {}", adapter.remedy())
}

fn describe(candidate: &Candidate) -> String {
    let Candidate { name, device, driver, product, holder, is_permitted, .. } = candidate;
    let state = match (holder, is_permitted) {
        (Some(holder), _) => format!("in use by {holder}"),
        (None, true) => "free".to_owned(),
        (None, false) => format!("no permission: scanhub doctor {} shows the reason", name.display()),
    };
    let device = (name != device).then(|| device.display().to_string());
    let facts: Vec<String> =
        [device, product.clone(), driver.clone(), Some(state)].into_iter().flatten().collect();
    let caution = caution(candidate).map(|(what, remedy)| format!("\n  {what}; {remedy}"));
    format!("{}  {}{}", name.display(), facts.join(", "), caution.unwrap_or_default())
}
