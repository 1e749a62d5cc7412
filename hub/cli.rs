//! The command line: which verbs there are and what they take. Syntax only; what a value means is checked by whoever
//! uses it.

mod background;
mod complete;
mod config;
mod configure;
mod control;
mod convert;
mod doctor;
mod examples;
mod gateway;
mod generated;
mod latency;
mod leds;
mod listen;
mod probe;
pub(crate) mod record;
pub(crate) mod replay;
pub(crate) mod simulate;
mod telegram;
pub(crate) mod watch;
mod zones;

use std::path::PathBuf;
use std::time::Duration;

use ::config::Sources;
use clap::{Args, Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use schema::{DEFAULT_DOMAIN, Domain, Environment, Failure};
use verbs::{Bounds, duration};

pub(crate) use self::config::Config;
pub(crate) use background::Background;
pub(crate) use complete::Complete;
pub(crate) use control::Control;
pub(crate) use convert::Convert;
pub(crate) use gateway::Gateway;
pub(crate) use generated::{Completions, Man};
pub(crate) use latency::Latency;
pub(crate) use leds::Leds;
pub(crate) use listen::Listen;
pub(crate) use record::Record;
pub(crate) use replay::Replay;
pub(crate) use telegram::{Telegram, Way};
pub(crate) use watch::Watch;
pub(crate) use zones::Zones;

/// Laser scanners on serial lines, for more than one program: a hub that publishes telegrams and scans into shared
/// memory, and the programs that listen.
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
    /// Domain of the hub: 1 to 16 of a-z, 0-9 and -
    #[arg(long, global = true, env = "SCANHUB_DOMAIN", default_value = DEFAULT_DOMAIN, value_name = "NAME")]
    pub(crate) domain: String,
    /// Directory that holds the domain, instead of the usual ones
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) root: Option<PathBuf>,
    /// One JSON object per line
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

impl Everywhere {
    /// The domain as a hub opens it.
    pub(crate) fn hub_domain(&self) -> Result<Domain, Failure> {
        Domain::of_hub(&self.domain, self.root.as_deref(), &Environment::of_process())
    }

    /// The directories that may hold domains.
    pub(crate) fn bases(&self) -> Vec<PathBuf> {
        self.root.clone().map_or_else(|| Environment::of_process().bases(), |root| vec![root])
    }

    /// The places in which a client looks for it.
    pub(crate) fn places(&self) -> Result<Vec<Domain>, Failure> {
        Domain::candidates(&self.domain, self.root.as_deref(), &Environment::of_process())
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// The hub, in the foreground, until SIGINT or SIGTERM
    Run(Run),
    /// A hub whose sensors are a recording, with the keys of a player
    #[command(after_help = replay::KEYS)]
    Replay(Replay),
    /// Two simulated sensors, the hub and a consumer for each, in one terminal
    Demo(Demo),
    /// Sensors at the other end of ptys
    #[command(after_help = simulate::fault_table())]
    Simulate(Box<simulate::Simulate>),
    /// What is at the other end of a port; without one, which ports there are
    Probe(probe::Probe),
    /// Change what a sensor keeps for ever, after showing the difference and asking
    #[command(after_help = configure::CONSENT)]
    Configure(configure::Configure),
    /// The configuration: one to begin with, whether one is right, what is in effect and where it is said
    Config(Config),
    /// Every condition that a working set-up needs, and what to do where one is not met
    Doctor(doctor::Doctor),
    /// Sensors and topics of the running hub
    List {
        /// Every live domain of this user instead
        #[arg(long)]
        domains: bool,
    },
    /// State, settings and counters of sensors
    Info {
        /// One sensor instead of all
        sensor: Option<String>,
    },
    /// Samples as they come
    Echo(Echo),
    /// Rate, jitter and loss of topics
    Hz(Hz),
    /// How old samples are on arrival, and where they spent that time: percentiles
    #[command(after_help = latency::SPANS)]
    Latency(Latency),
    /// The live picture in the terminal: what the sensors see, marks, zones and the verdict
    #[command(after_help = watch::KEYS)]
    Watch(Watch),
    /// What the hub publishes, in MCAP files
    #[command(after_help = record::READING)]
    Record(Record),
    /// Telegrams explained field by field, and written
    Telegram(Telegram),
    /// Stop a sensor, let it stream again, or begin anew with it
    Control(Control),
    /// The background model of a sensor: look at it, learn it anew, hold it, keep it in a file
    Background(Background),
    /// The zones around the robot: which part of its view the robot itself takes
    Zones(Zones),
    /// The zone verdict and the marks as lights: in the terminal, and on diodes of this machine
    #[command(after_help = leds::MEANING)]
    Leds(Leds),
    /// What the hub publishes, as UDP datagrams on a network: one message each, to multicast groups and to hosts
    #[command(after_help = gateway::GROUPS)]
    Gateway(Gateway),
    /// What the gateways of other machines send over the network, and what of it was lost
    #[command(after_help = listen::SIGNALS)]
    Listen(Listen),
    /// A recording in another form, or a damaged one made whole
    #[command(after_help = convert::REPAIR)]
    Convert(Convert),
    /// The completion of this command line for a shell
    Completions(Completions),
    /// Names of the running hub for those completions
    #[command(hide = true)]
    Complete(Complete),
    /// Manual pages
    Man(Man),
}

#[derive(Args, Debug)]
pub(crate) struct Run {
    #[command(flatten)]
    pub(crate) configured: Configured,
    /// A link with its defaults; PORT is a tty, tcp:HOST:PORT or file:PATH[?rate=max]
    #[arg(long, value_name = "NAME=PORT")]
    pub(crate) link: Vec<String>,
}

impl Run {
    /// Where the configuration is to be read from.
    pub(crate) fn sources(&self) -> Sources {
        Sources { links: self.link.clone(), ..self.configured.sources() }
    }
}

/// Where a configuration is said, apart from links.
#[derive(Args, Debug, Default)]
pub(crate) struct Configured {
    /// TOML file, read after those in /etc/scanhub
    #[arg(long, env = "SCANHUB_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Do not read /etc/scanhub
    #[arg(long)]
    no_system_config: bool,
    /// One value, for example link.front.angle=100
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
    /// No live view: a summary line per sensor at the end, and exit 5 if a telegram was lost
    #[arg(long)]
    pub(crate) headless: bool,
    /// How long, for example 10s; without it until Ctrl-C
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    pub(crate) run_for: Option<Duration>,
    /// Seed of rooms and people
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
}

#[derive(Args, Debug)]
pub(crate) struct Limits {
    /// End after so many samples
    #[arg(short = 'n', value_name = "COUNT", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// End after so long, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Longest silence, before the first sample and between two; then exit 3
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    timeout: Option<Duration>,
}

impl Limits {
    pub(crate) fn bounds(&self) -> Bounds {
        Bounds { count: self.count, run_for: self.run_for, timeout: self.timeout }
    }
}

#[derive(Args, Debug)]
pub(crate) struct Echo {
    /// What to follow: front/scan, */scan for all sensors, front/* for all topics; or robot/zones, all sensors' zones in one
    #[arg(required = true, value_name = "SENSOR/TOPIC")]
    pub(crate) topics: Vec<String>,
    /// Comma-separated values
    #[arg(long, conflicts_with_all = ["json", "raw"])]
    pub(crate) csv: bool,
    /// The bytes themselves: telegrams, or the payload of another topic
    #[arg(long, conflicts_with = "json")]
    pub(crate) raw: bool,
    #[command(flatten)]
    pub(crate) limits: Limits,
}

#[derive(Args, Debug)]
pub(crate) struct Hz {
    /// What to follow: front/scan, */scan for all sensors, front/* for all topics; without it everything
    #[arg(value_name = "SENSOR/TOPIC")]
    pub(crate) topics: Vec<String>,
    /// Span of time that a line looks back on
    #[arg(long, default_value = "10s", value_name = "DURATION", value_parser = duration::parse)]
    pub(crate) window: Duration,
    #[command(flatten)]
    pub(crate) limits: Limits,
}
