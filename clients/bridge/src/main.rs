//! The program `scanhub-bridge`: command line, signals and exit code. `scanhub bridge` runs it with the same arguments.
#![forbid(unsafe_code)]

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Parser;
use scanhub_bridge::{BridgeOptions, PublishOptions, Ros2Options, SendOptions, bridge, check};
use scanhub_network::received_topics;
use scanhub_ros::RosNames;
use scanhub_ros::rmw_zenoh::Distro;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Printable};
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment, publisher_domain};

/// Send and receive topics over Zenoh, through a router or as a router: to other rooms, over Wi-Fi, over the internet
#[derive(Debug, Parser)]
#[command(name = "scanhub-bridge", version, max_term_width = 100, after_help = EXAMPLES, args_override_self = true)]
struct Cli {
    /// Router to connect to: tcp/HOST:PORT or tls/HOST:PORT. Can be repeated; the first one that responds is used
    #[arg(long, value_name = "ADDRESS")]
    connect: Vec<String>,
    /// Address on which the bridge listens as a router: tcp/0.0.0.0:7447, or tls/.. with certificates. Can be repeated
    #[arg(long, value_name = "ADDRESS")]
    listen: Vec<String>,
    /// Configuration file of Zenoh in JSON5, for TLS, users and access control. --connect and --listen are added to it
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Topics to send: front/scan, */scan for all sensors, or front/* for all topics of a sensor. With :every=4, only
    /// the samples of every fourth telegram. Can be repeated [default: all topics except telegram, lines, motion, early
    /// and cloud, of all sensors]. With --publish, also the topics to receive, each in the form */scan
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    topics: Vec<String>,
    /// Publish topics of other machines in a domain of this machine, as HUB.SENSOR/TOPIC. The bridge then sends only
    /// with --send
    #[arg(long)]
    publish: bool,
    /// Send topics in addition to --publish or --ros2
    #[arg(long)]
    send: bool,
    /// Name for a hub, in place of its 16 hex digits, for example robot1=5f3a12bc00d1e2f3
    #[arg(long = "name", value_name = "NAME=HUB", requires = "publish")]
    names: Vec<String>,
    /// Hub to publish: its 16 hex digits, or its name from --name [default: all]
    #[arg(long = "hub", value_name = "HUB", requires = "publish")]
    hubs: Vec<String>,
    /// Maximum number of subscribers of each published topic, 1 to 250
    #[arg(long, value_name = "N", requires = "publish", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=250))]
    subscribers: u16,
    /// Shared memory that all published topics may take together, in MB (2^20 bytes). A sensor that does not fit is refused
    #[arg(long, value_name = "MB", requires = "publish", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
    /// Connect, print problems with their remedies, and exit, without sending or publishing topics
    #[arg(long, conflicts_with = "publish")]
    check: bool,
    /// Run as a ROS 2 node (rmw_zenoh) that publishes the hub's topics. The bridge then sends topics in Zenoh's own
    /// form only with --send
    #[arg(long)]
    ros2: bool,
    /// ROS 2 release of the nodes that receive the topics: humble, jazzy, kilted or rolling
    #[arg(long, value_name = "NAME", requires = "ros2", default_value = "jazzy", value_parser = distro)]
    ros_distro: Distro,
    /// ROS_DOMAIN_ID of the node, 0 to 232 [default: the value in the environment, or 0]
    #[arg(long, value_name = "N", requires = "ros2", value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_DOMAIN_ID)))]
    domain_id: Option<u32>,
    /// Namespace before all topics of ROS 2, for example robot1
    #[arg(long, value_name = "NAME", requires = "ros2", default_value = "")]
    namespace: String,
    /// Prefix of the sensors' topics in ROS 2, for example lidars for /lidars/front/scan
    #[arg(long, value_name = "NAME", requires = "ros2", default_value = "")]
    topic_prefix: String,
    /// Frame of a sensor in ROS 2, for example front=laser [default: its name]
    #[arg(long = "frame", value_name = "SENSOR=FRAME", requires = "ros2")]
    frames: Vec<String>,
    /// Domain of the hub, which distinguishes several hubs on a machine: 1 to 16 characters of a-z, 0-9 and -
    #[arg(long, env = "SCANHUB_DOMAIN", default_value = DEFAULT_DOMAIN, value_name = "NAME")]
    domain: String,
    /// Directory that contains the directory of the domain, in place of the default locations
    #[arg(long, value_name = "DIR")]
    root: Option<PathBuf>,
    /// Print one JSON object per line
    #[arg(long)]
    json: bool,
}

/// Text below the help.
const EXAMPLES: &str = "Examples:
  scanhub bridge --listen tcp/0.0.0.0:7447
  scanhub bridge --connect tcp/robot:7447 --publish --name robot1=5f3a12bc00d1e2f3
  scanhub bridge --connect tcp/localhost:7447 --ros2
  scanhub bridge --connect tls/router.example:7447 --config zenoh.json5

SIGUSR1: print the counts so far";

impl Cli {
    fn options(self) -> Result<BridgeOptions, Failure> {
        let environment = Environment::of_process();
        let sends = self.send || !self.publish && !self.ros2;
        let ros2 = self.ros2.then(|| self.ros2(&environment, !sends)).transpose()?;
        let send = sends.then(|| {
            let locations = Domain::candidates(&self.domain, self.root.as_deref(), &environment)?;
            Ok::<_, Failure>(SendOptions { topics: self.topics.clone(), locations })
        });
        let publish = self.publish.then(|| {
            let domain = publisher_domain(&self.domain, self.root.as_deref(), &environment)?;
            let limits = TopicLimits { subscribers: self.subscribers.into(), ..TopicLimits::default() };
            let topics = received_topics(&self.topics)?;
            let memory = u64::from(self.memory) << 20;
            Ok::<_, Failure>(PublishOptions {
                domain,
                topics,
                names: self.names,
                hubs: self.hubs,
                limits,
                memory,
            })
        });
        Ok(BridgeOptions {
            connect: self.connect,
            listen: self.listen,
            config: self.config,
            send: send.transpose()?,
            publish: publish.transpose()?,
            ros2,
            json: self.json,
        })
    }
}

impl Cli {
    fn ros2(&self, environment: &Environment, reports_hub: bool) -> Result<Ros2Options, Failure> {
        let frame = |text: &String| {
            let (sensor, frame) = text.split_once('=').ok_or_else(|| no_name("--frame", text))?;
            Ok((sensor.to_owned(), frame.to_owned()))
        };
        let frames = self.frames.iter().map(frame).collect::<Result<Vec<_>, Failure>>()?;
        for (at, (sensor, frame)) in frames.iter().enumerate() {
            if frames[..at].iter().any(|(other, _)| other == sensor) {
                let what = format!("--frame: {sensor} has two frames");
                return Err(Failure::new(Kind::Usage, what, "name each sensor once"));
            }
            if frame == scanhub_ros::BASE_FRAME {
                let what = format!("--frame: {sensor}={frame} is the frame of the robot itself");
                return Err(Failure::new(Kind::Usage, what, "give the sensor its own frame"));
            }
        }
        // Check each flag separately, so that the message names the wrong one.
        RosNames::new(&self.namespace, "", Vec::new()).map_err(|name| no_name("--namespace", &name))?;
        RosNames::new("", &self.topic_prefix, Vec::new()).map_err(|name| no_name("--topic-prefix", &name))?;
        let names = RosNames::new(&self.namespace, &self.topic_prefix, frames)
            .map_err(|name| no_name("--frame", &name))?;
        Ok(Ros2Options {
            topics: self.topics.clone(),
            locations: Domain::candidates(&self.domain, self.root.as_deref(), environment)?,
            domain_id: self.domain_id.map_or_else(domain_id, Ok)?,
            distro: self.ros_distro,
            names,
            reports_hub,
        })
    }
}

/// Highest domain ID of ROS 2 on Linux.
const MAX_DOMAIN_ID: u32 = 232;

/// Returns the domain ID from `ROS_DOMAIN_ID`, or 0 if it is not set. Called only for a ROS 2 node, so that an invalid
/// value does not affect other bridges.
fn domain_id() -> Result<u32, Failure> {
    let value = std::env::var("ROS_DOMAIN_ID").unwrap_or_default();
    match value.as_str() {
        "" => Ok(0),
        value => value.parse().ok().filter(|number| *number <= MAX_DOMAIN_ID).ok_or_else(|| {
            let hint =
                format!("use a number from 0 to {MAX_DOMAIN_ID}, or --domain-id, which takes precedence");
            Failure::new(Kind::Usage, format!("ROS_DOMAIN_ID={value} is not a valid domain ID"), hint)
        }),
    }
}

/// Returns the failure for a `text` that is not a valid ROS name. Names in ROS consist of letters, digits and `_`.
fn no_name(flag: &str, text: &str) -> Failure {
    let hint = match flag {
        "--frame" => "write SENSOR=FRAME with a frame of letters, digits and _, for example front=laser",
        _ => "use words of letters, digits and _, separated by slashes: robot1, or site/robot1",
    };
    Failure::new(Kind::Usage, format!("{flag}: {text:?} is not a valid ROS 2 name"), hint)
}

fn distro(name: &str) -> Result<Distro, String> {
    Distro::parse(name).ok_or_else(|| format!("one of {}", Distro::ALL.map(Distro::name).join(", ")))
}

fn main() -> ExitCode {
    let cli = Cli::try_parse().unwrap_or_else(|error| scanhub_verbs::with_new_name(error).exit());
    let json = cli.json;
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            // Ignore an error, because the reader has closed the stream and would not see a message about it.
            let _ = match json {
                true => writeln!(io::stdout(), "{}", Printable(&scanhub_verbs::error_line(&failure))),
                false => writeln!(io::stderr(), "scanhub-bridge: {}", Printable(&failure.to_string())),
            };
            ExitCode::from(failure.kind.exit_code())
        }
    }
}

fn run(cli: Cli) -> Result<(), Failure> {
    let is_check = cli.check;
    let options = cli.options()?;
    let (stop, report_requested) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let signals = [
        (signal_hook::consts::SIGINT, &stop),
        (signal_hook::consts::SIGTERM, &stop),
        (signal_hook::consts::SIGUSR1, &report_requested),
    ];
    for (signal, flag) in signals {
        signal_hook::flag::register(signal, flag.clone()).map_err(|error| {
            Failure::new(Kind::Failed, format!("cannot install signal handlers: {error}"), "")
        })?;
    }
    if is_check {
        return check(&options, &stop, &mut io::stdout());
    }
    bridge(&options, &report_requested, &stop)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(words: &[&str]) -> Cli {
        Cli::try_parse_from([&["scanhub-bridge"], words].concat()).unwrap_or_else(|error| panic!("{error}"))
    }

    #[test]
    fn old_flag_is_an_error_that_states_the_new_one() {
        let error =
            Cli::try_parse_from(["scanhub-bridge", "--publish", "--consumers=3"]).expect_err("an old name");
        let text = scanhub_verbs::with_new_name(error).to_string();
        assert!(text.contains("'--consumers'") && text.contains("'--subscribers'"), "{text}");
        assert_eq!(parse(&["--publish", "--subscribers=3"]).subscribers, 3);
    }

    #[test]
    fn later_domain_overrides_and_endpoints_accumulate() {
        let words =
            ["--domain", "scanhub", "--connect", "tcp/a:1", "--domain", "lab", "--connect", "tcp/b:1"];
        let cli = parse(&words);
        assert_eq!((cli.domain.as_str(), cli.connect.len()), ("lab", 2));
        assert!(parse(&["--json", "--json"]).json);
    }

    #[test]
    fn error_names_the_invalid_flag() {
        for (flag, value) in [("--namespace", "/robot1/"), ("--topic-prefix", "a b"), ("--frame", "front=1a")]
        {
            let failure = parse(&["--root", "/tmp", "--ros2", flag, value]).options().unwrap_err();
            assert!(failure.kind == Kind::Usage && failure.message.starts_with(flag), "{failure}");
        }
        let failure = parse(&["--root", "/tmp", "--publish", "--topic=front/scan"]).options().unwrap_err();
        assert!(failure.kind == Kind::Usage && failure.message.contains("front/scan"), "{failure}");
    }

    #[test]
    fn sends_by_default_but_not_with_publish_or_ros2() {
        let directions = |words: &[&str]| {
            let options = parse(words).options().unwrap();
            (options.send.is_some(), options.publish.is_some())
        };
        let root = ["--root", "/tmp"];
        assert_eq!(directions(&root), (true, false));
        assert_eq!(directions(&[&root[..], &["--publish"]].concat()), (false, true));
        assert_eq!(directions(&[&root[..], &["--publish", "--send"]].concat()), (true, true));
        assert_eq!(directions(&[&root[..], &["--send"]].concat()), (true, false));
        assert_eq!(directions(&[&root[..], &["--ros2"]].concat()), (false, false));
        assert_eq!(directions(&[&root[..], &["--ros2", "--send"]].concat()), (true, false));
    }
}
