//! The command line: the verbs and their arguments. Syntax only; the code that uses a value checks what it means.

mod bridge;
mod complete;
mod config;
mod convert;
mod examples;
mod gateway;
mod generated;
pub(crate) mod replay;
pub(crate) mod simulate;

use std::path::PathBuf;
use std::time::Duration;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use scanhub_config::Sources;
use scanhub_network::{KeyArgs, ListenArgs, VerbOptions};
use scanhub_perception::verbs::{SiteArgs, TiltArgs, TrackArgs};
use scanhub_schema::{Failure, Family};
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment};
use scanhub_verbs::{BackgroundArgs, ControlArgs, EchoArgs, HzArgs, InfoArgs, ListArgs, ZonesArgs, duration};

use crate::demo::{Families, World};

pub(crate) use self::config::Config;
pub(crate) use bridge::Bridge;
pub(crate) use complete::Complete;
pub(crate) use convert::Convert;
pub(crate) use gateway::Gateway;
pub(crate) use generated::{Completions, Man};
pub(crate) use replay::Replay;

/// Share laser scanners (SICK LMS 2xx, LDROBOT, RPLIDAR) between programs. One hub reads the ports; any number of programs get
/// the scans.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) verb: Verb,
    #[command(flatten)]
    pub(crate) everywhere: Everywhere,
}

/// The whole definition.
pub(crate) fn command() -> Command {
    examples::with_examples(Cli::command())
}

impl Cli {
    /// The command line of this process.
    pub(crate) fn of_process() -> Result<Cli, clap::Error> {
        let mut command = command();
        let matches = command.try_get_matches_from_mut(std::env::args_os())?;
        Cli::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
    }
}

/// What every verb takes.
#[derive(Args, Clone, Debug)]
pub(crate) struct Everywhere {
    /// Name of the hub, if several run on this machine: 1 to 16 of a-z, 0-9 and -
    #[arg(long, global = true, env = "SCANHUB_DOMAIN", default_value = DEFAULT_DOMAIN, value_name = "NAME")]
    pub(crate) domain: String,
    /// Use the hub in this directory
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) root: Option<PathBuf>,
    /// Print one JSON object per line
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

impl Everywhere {
    /// The domain as a hub opens it.
    pub(crate) fn hub_domain(&self) -> Result<Domain, Failure> {
        Domain::of_hub(&self.domain, self.root.as_deref(), &Environment::of_process())
    }

    /// Returns the domain in which a program publishes: the running one, otherwise that of a hub that starts now.
    pub(crate) fn publisher_domain(&self) -> Result<Domain, Failure> {
        scanhub_shm::publisher_domain(&self.domain, self.root.as_deref(), &Environment::of_process())
    }

    /// Returns the options for a verb that reads them itself.
    pub(crate) fn verb(&self) -> VerbOptions<'_> {
        VerbOptions { domain: &self.domain, root: self.root.as_deref(), json: self.json }
    }

    /// The places in which a client looks for it.
    pub(crate) fn places(&self) -> Result<Vec<Domain>, Failure> {
        Domain::candidates(&self.domain, self.root.as_deref(), &Environment::of_process())
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Run the hub in the foreground, until SIGINT or SIGTERM
    Run(Run),
    /// Run a hub that plays a recording instead of sensors, with the keys of a player
    #[command(after_help = replay::KEYS)]
    Replay(Replay),
    /// Run simulated sensors, the hub and a consumer for each in one terminal
    Demo(Demo),
    /// Simulate sensors at the other end of ptys, or behind TCP
    #[command(after_help = simulate::fault_table())]
    Simulate(Box<simulate::Simulate>),
    /// Show the sensor at a port; without a port, list the ports
    Probe(scanhub_tools::probe::ProbeArgs),
    /// Change a sensor's EEPROM settings: shows the difference and asks first
    #[command(after_help = scanhub_tools::configure::CONSENT)]
    Configure(scanhub_tools::configure::ConfigureArgs),
    /// Print a default configuration, check one, or show the values in effect and their origin
    Config(Config),
    /// Check the setup and show how to fix what is wrong
    Doctor {
        #[command(flatten)]
        args: scanhub_tools::doctor::DoctorArgs,
        #[command(flatten)]
        run: Run,
    },
    /// List the sensors and topics of the running hub
    List(ListArgs),
    /// Show state, settings and counters of sensors
    Info(InfoArgs),
    /// Print samples as they arrive
    Echo(EchoArgs),
    /// Measure rate, jitter and loss of topics
    Hz(HzArgs),
    /// Measure how old samples are on arrival, split into line, hub and wake-up: percentiles
    Latency(scanhub_verbs::LatencyArgs),
    /// Show the live picture in the terminal: what the sensors see, marks, zones and the verdict
    Watch(scanhub_viewer::WatchArgs),
    /// Serve the live picture to browsers, and to Foxglove and Lichtblick
    Web(scanhub_viewer::WebArgs),
    /// Record what the hub publishes in MCAP files
    Record(scanhub_verbs::RecordArgs),
    /// Explain telegrams field by field, or write them
    Telegram(scanhub_tools::telegram::TelegramArgs),
    /// Pause a sensor, resume it, or restart its session
    Control(ControlArgs),
    /// Show, reset, freeze, save or load the background model of a sensor
    Background(BackgroundArgs),
    /// Learn which part of a sensor's view is the robot itself
    Zones(ZonesArgs),
    /// Follow people across the sensors and rooms of a site, and count them at doors
    Track(TrackArgs),
    /// 3D from a tilting scanner: points, background, obstacles
    Tilt(TiltArgs),
    /// Check and draw the plan of sensors, rooms and doors that people are followed in
    Site(SiteArgs),
    /// Show the zone verdict and the marks as lights, in the terminal and on LEDs of this machine
    Leds(scanhub_verbs::LedsArgs),
    /// Send what the hub publishes as UDP datagrams, one sample each, to multicast groups and to hosts
    #[command(after_help = scanhub_network::groups_help())]
    Gateway(Gateway),
    /// Receive what gateways of other machines send, and show what was lost
    #[command(after_help = scanhub_network::LISTEN_SIGNALS)]
    Listen(ListenArgs),
    /// Carry topics to other machines and back over Zenoh, through a router or as one (program scanhub-bridge)
    Bridge(Bridge),
    /// Make the key that gateways and listeners share
    Key(KeyArgs),
    /// Convert a recording to another format, or repair a damaged one
    #[command(after_help = convert::REPAIR)]
    Convert(Convert),
    /// Print the completion script for a shell
    Completions(Completions),
    /// Print names of the running hub for the completion scripts
    #[command(hide = true)]
    Complete(Complete),
    /// Print or write the manual pages
    Man(Man),
}

#[derive(Args, Debug)]
pub(crate) struct Run {
    #[command(flatten)]
    pub(crate) configured: Configured,
    /// Add a link with default settings; PORT is a tty, tcp:HOST:PORT or file:PATH[?rate=max], and keys of the link may follow
    /// it, as in front=/dev/ttyUSB0,family=ld
    #[arg(long, value_name = "NAME=PORT[,KEY=VALUE]")]
    pub(crate) link: Vec<String>,
}

impl Run {
    /// Where the configuration is read from.
    pub(crate) fn sources(&self) -> Sources {
        Sources { links: self.link.clone(), ..self.configured.sources() }
    }
}

/// Where a configuration is read from, apart from links.
#[derive(Args, Debug, Default)]
pub(crate) struct Configured {
    /// Read this TOML file after those in /etc/scanhub
    #[arg(long, env = "SCANHUB_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Do not read /etc/scanhub
    #[arg(long)]
    no_system_config: bool,
    /// Set one value, for example link.front.angle=100
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl Configured {
    pub(crate) fn sources(&self) -> Sources {
        let mut files = if self.no_system_config { Vec::new() } else { Sources::system() };
        files.extend(self.config.clone());
        Sources { files, set: self.set.clone(), links: Vec::new() }
    }
}

#[derive(Args, Debug)]
pub(crate) struct Demo {
    /// Run without the live view: print a summary line per sensor at the end; exit 5 if a telegram was lost
    #[arg(long)]
    pub(crate) headless: bool,
    /// Stop after this time, for example 10s [default: at Ctrl-C]
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    pub(crate) run_for: Option<Duration>,
    /// demo: two sensors on a robot. house: four sensors in two rooms, and people who are followed from room to room. tilt: a
    /// tilting scanner that finds obstacles in 3D
    #[arg(long, default_value = "demo", value_name = "WORLD", value_parser = worlds())]
    pub(crate) world: World,
    /// Seed of rooms and people
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Of which family the sensors are; mixed: one of each family
    #[arg(long, default_value = Family::ALL[0].name(), value_name = "FAMILY", value_parser = families())]
    pub(crate) family: Families,
}

fn worlds() -> impl TypedValueParser<Value = World> {
    PossibleValuesParser::new(World::NAMES)
        .map(|name| World::parse(&name).expect("one of the possible names"))
}

fn families() -> impl TypedValueParser<Value = Families> {
    PossibleValuesParser::new(Families::names())
        .map(|name| Families::parse(&name).expect("one of the possible names"))
}

/// Parses the name of a family.
fn family(text: &str) -> Result<Family, String> {
    let names = || Family::ALL.map(Family::name).join(", ");
    Family::parse(&text.to_lowercase()).ok_or_else(|| format!("one of {}, not {text:?}", names()))
}
