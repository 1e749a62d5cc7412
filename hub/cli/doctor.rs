//! `scanhub doctor` on the command line: what it takes, and a line for each finding.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_config::{Config, Gateway};
use scanhub_schema::Failure;
use scanhub_tools::doctor::{Bridge, CheckTargets, System, run_checks};
use scanhub_tools::probe::source;

use super::{Everywhere, Run};

#[derive(Args, Debug)]
pub(crate) struct Doctor {
    /// Ports to check: a tty or tcp:HOST:PORT, or the name of a link of the running hub; without one, the ports of the
    /// configuration, or all ports if there are none, and the links of the running hub
    #[arg(value_name = "PORT")]
    ports: Vec<String>,
    /// First remove what dead processes left in this domain; removes nothing while a hub runs there
    #[arg(long)]
    clean: bool,
    /// Router that a bridge of this machine connects to, as in `scanhub bridge --connect`: checks whether that would work.
    /// Can be repeated
    #[arg(long, value_name = "ADDRESS")]
    bridge: Vec<String>,
    /// The same by Zenoh's own configuration, as in `scanhub bridge --config`
    #[arg(long, value_name = "FILE")]
    bridge_config: Option<PathBuf>,
    #[command(flatten)]
    run: Run,
}

impl Doctor {
    pub(crate) fn run(&self, everywhere: &Everywhere, stop: &AtomicBool) -> Result<(), Failure> {
        let sources = self.run.sources();
        let is_said = !(sources.files.is_empty() && sources.links.is_empty() && sources.set.is_empty());
        let read = sources.read();
        let gateway = Gateway::of(&read);
        let targets = CheckTargets {
            ports: self.ports.iter().map(|port| source(port)).collect::<Result<_, _>>()?,
            config: is_said.then(|| Config::of(&read).and_then(|config| gateway.clone().map(|_| config))),
            gateway: gateway.clone().unwrap_or_default(),
            domain: everywhere.hub_domain()?,
            places: everywhere.places()?,
            system: System::this(),
            bridge: Bridge {
                connect: self.bridge.clone(),
                config: self.bridge_config.clone(),
                ..Bridge::default()
            },
            clean: self.clean,
        };
        let mut port = None;
        let mut written = Ok(());
        let mut say = |text: &str| {
            if written.is_ok() {
                written = crate::print(text);
            }
        };
        let outcome = run_checks(&targets, stop, &mut |finding| {
            if everywhere.json {
                return say(&crate::line(finding));
            }
            if port != finding.port {
                port.clone_from(&finding.port);
                let link = finding.link.as_ref().map(|link| format!(" (link {link})"));
                say(&format!("\n{}{}", port.as_deref().unwrap_or_default(), link.unwrap_or_default()));
            }
            say(&finding.to_string());
        });
        written.and(outcome)
    }
}
