//! `scanhub run`, which runs the hub, and `scanhub doctor`, which reads the same configuration.

use std::path::{Path, PathBuf};

use clap::Args;
use scanhub_config::{Config, Sources};
use scanhub_schema::Failure;
use scanhub_shm::Domain;
use scanhub_tools::doctor::DoctorArgs;
use scanhub_verbs::context::Context;
use serde::Serialize;

use crate::{print_status, to_json_line};

/// Run the hub in the foreground, until SIGINT or SIGTERM
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Run {
    #[command(flatten)]
    configured: ConfigOptions,
    /// Add a link with default settings. PORT is a tty, tcp:HOST:PORT or file:PATH[?rate=max]. Keys of the link can follow,
    /// for example front=/dev/ttyUSB0,family=ld
    #[arg(long, value_name = "NAME=PORT[,KEY=VALUE]")]
    link: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  scanhub run --link front=/dev/ttyUSB0
  scanhub run --link front=/dev/ttyUSB0 --set 'zones.radii=[1.2,0.7]'
  scanhub run --config robot.toml";

impl Run {
    /// Runs the hub until SIGINT or SIGTERM.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let domain = context.domain.of_hub()?;
        let read = || Config::load(&self.sources());
        scanhub_daemon::run(&read, &domain, |ready| print_ready(ready, &domain, context.json))
    }

    /// Returns the sources of the configuration.
    pub(crate) fn sources(&self) -> Sources {
        Sources { links: self.link.clone(), ..self.configured.sources() }
    }
}

/// Options that name the sources of a configuration, apart from links.
#[derive(Args, Debug, Default)]
pub(crate) struct ConfigOptions {
    /// Read this TOML file, after those in /etc/scanhub
    #[arg(long, env = "SCANHUB_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Do not read /etc/scanhub
    #[arg(long)]
    no_system_config: bool,
    /// Set one value, for example link.front.angle=100
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl ConfigOptions {
    /// Returns the sources, without links.
    pub(crate) fn sources(&self) -> Sources {
        let mut files = if self.no_system_config { Vec::new() } else { Sources::system() };
        files.extend(self.config.clone());
        Sources { files, set: self.set.clone(), links: Vec::new() }
    }
}

/// Check the setup and show how to fix what is wrong
#[derive(Args, Debug)]
#[command(after_help = DOCTOR_EXAMPLES)]
pub(crate) struct Doctor {
    #[command(flatten)]
    args: DoctorArgs,
    #[command(flatten)]
    run: Run,
}

const DOCTOR_EXAMPLES: &str = "\
Examples:
  scanhub doctor
  scanhub doctor /dev/ttyUSB0
  scanhub doctor --clean";

impl Doctor {
    /// Checks the setup that [`Run`] would use.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let domains = (context.domain.of_hub()?, context.domain.locations()?);
        let stop = context.signals.stop()?;
        self.args.run(&self.run.sources(), domains, context.json, &mut context.out, &stop)
    }
}

/// Prints that a hub is ready.
pub(crate) fn print_ready(ready: &scanhub_daemon::StartReport, domain: &Domain, json: bool) {
    print_status(&if json {
        to_json_line(&HubReady {
            class: "ready",
            domain: domain.name(),
            root: domain.root(),
            pid: std::process::id(),
            boot: format!("{:016x}", ready.boot),
            sensors: &ready.sensors,
            waiting: &ready.waiting,
        })
    } else {
        let root = domain.root().display();
        let without_port: Vec<_> =
            ready.waiting.iter().filter(|name| !ready.taken.contains(name)).cloned().collect();
        let waiting = |what: &str, names: &[String]| match names {
            [] => String::new(),
            names => format!("; waiting for the {what} of {}", names.join(", ")),
        };
        let (ports, names) = (waiting("port", &without_port), waiting("name", &ready.taken));
        format!("ready {} in {root}, sensors: {}{ports}{names}", domain.name(), ready.sensors.join(", "))
    });
}

/// JSON line of class `ready`. The order of the keys is part of the contract.
#[derive(Serialize)]
struct HubReady<'a> {
    class: &'static str,
    domain: &'a str,
    root: &'a Path,
    pid: u32,
    boot: String,
    sensors: &'a [String],
    waiting: &'a [String],
}
