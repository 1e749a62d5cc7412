//! Command line: the table of the verbs, and the options of all verbs.

mod bridge;
mod config;
mod convert;
mod gateway;
mod generated;
pub(crate) mod run;
mod simulate;

use std::path::PathBuf;

use clap::builder::StyledStr;
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, CommandFactory, FromArgMatches, Parser, Subcommand};
use scanhub_network as network;
use scanhub_perception::verbs as perception;
use scanhub_schema::{Failure, Family};
use scanhub_shm::DEFAULT_DOMAIN;
use scanhub_tools::{configure, probe, telegram};
use scanhub_verbs::context::Context;
use scanhub_verbs::with_new_name;
use scanhub_verbs::{background, control, echo, hz, info, latency, leds, list, record, zones};
use scanhub_viewer as viewer;

use crate::{demo, replay};

/// Share laser scanners (SICK LMS 2xx, LDROBOT, RPLIDAR) between programs. One hub reads the ports; any number of programs get
/// the scans.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) verb: Verb,
    #[command(flatten)]
    pub(crate) global: GlobalOptions,
}

impl Cli {
    /// Parses the command line of this process.
    pub(crate) fn of_process() -> Result<Cli, clap::Error> {
        let command = Cli::command();
        let template = help_template(&command);
        let mut command = command.help_template(template);
        let matches = command.try_get_matches_from_mut(std::env::args_os()).map_err(with_new_name)?;
        refuse_hub(&mut command, &matches)?;
        refuse_json(&mut command, &matches)?;
        Cli::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
    }
}

/// Returns an error if the command line names a hub for a verb that runs its own. A domain in the environment names the
/// user's usual hub, so these verbs ignore it.
fn refuse_hub(command: &mut Command, matches: &ArgMatches) -> Result<(), clap::Error> {
    let is_given = |id: &&str| matches.value_source(id) == Some(ValueSource::CommandLine);
    let (name, verb, remedy) = match matches.subcommand() {
        Some(("demo", _)) => ("demo", "demo", "; demo shows the name of its domain"),
        Some(("web", web)) if web.contains_id("replay") => ("web", "web --replay", ""),
        _ => return Ok(()),
    };
    let Some(id) = ["domain", "root"].into_iter().find(is_given) else { return Ok(()) };
    let message = format!(
        "{verb} runs its own hub in its own domain, and cannot be used with --{id}\n\n  \
         tip: leave out --{id}{remedy}"
    );
    let command = command.find_subcommand_mut(name).expect("a verb");
    Err(command.error(ErrorKind::ArgumentConflict, message))
}

/// Returns an error if `--json` stands before a verb whose flags conflict with it. clap detects such a conflict only if
/// `--json` stands after the verb.
fn refuse_json(command: &mut Command, matches: &ArgMatches) -> Result<(), clap::Error> {
    let Some((name, own)) = matches.subcommand().filter(|_| matches.get_flag("json")) else { return Ok(()) };
    let command = command.find_subcommand_mut(name).expect("a verb");
    let conflicts =
        |arg: &Arg| command.get_arg_conflicts_with(arg).iter().any(|other| other.get_id() == "json");
    let is_given = |arg: &&Arg| own.value_source(arg.get_id().as_str()) == Some(ValueSource::CommandLine);
    let Some(flag) = command.get_arguments().filter(is_given).find(|arg| conflicts(arg)) else {
        return Ok(());
    };
    let message = format!("the argument '{flag}' cannot be used with '--json'");
    Err(command.error(ErrorKind::ArgumentConflict, message))
}

/// Options of all verbs.
#[derive(Args, Clone, Debug)]
pub(crate) struct GlobalOptions {
    /// Domain of the hub, which distinguishes several hubs on a machine: 1 to 16 characters of a-z, 0-9 and -
    #[arg(long, global = true, env = "SCANHUB_DOMAIN", default_value = DEFAULT_DOMAIN, value_name = "NAME")]
    pub(crate) domain: String,
    /// Directory that contains the directory of the domain, in place of the default locations
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) root: Option<PathBuf>,
    /// Print one JSON object per line
    #[arg(long, global = true)]
    pub(crate) json: bool,
}

/// Defines the enum of all verbs, and the groups of the help, from the table below. A verb is run by its function `run`,
/// which takes the [`Context`], or by the expression after the arrow.
macro_rules! verbs {
    ($($group:literal { $($verb:ident($args:ty) $(=> |$name:ident, $context:ident| $run:expr)?,)* })*) => {
        /// Verb with its arguments.
        #[derive(Debug, Subcommand)]
        pub(crate) enum Verb {
            $($($verb($args),)*)*
        }

        impl Verb {
            /// Runs the verb.
            pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
                match self {
                    $($(Verb::$verb(args) => verbs!(@run args, context $(, $name, $context, $run)?),)*)*
                }
            }
        }

        /// Groups of the help in their order, each with the names of its variants of [`Verb`].
        const GROUPS: &[(&str, &[&str])] = &[$(($group, &[$(stringify!($verb)),*])),*];
    };
    (@run $args:ident, $process:ident) => {
        $args.run($process)
    };
    (@run $args:ident, $process:ident, $name:ident, $context:ident, $run:expr) => {{
        let ($name, $context) = ($args, $process);
        $run
    }};
}

// The groups and their order are those of the help and of docs/verbs.md. Tools are run by expressions, because their
// crate does not depend on the crate of `Context`.
verbs! {
    "Run" {
        Run(run::Run),
        Demo(demo::Demo),
        Simulate(Box<simulate::Simulate>),
        Control(control::ControlArgs),
    }
    "Look" {
        List(list::ListArgs),
        Info(info::InfoArgs),
        Watch(viewer::WatchArgs),
        Web(viewer::WebArgs) => |web, it| replay::page::run(web, it),
        Echo(echo::EchoArgs),
        Hz(hz::HzArgs),
        Latency(latency::LatencyArgs),
        Leds(leds::LedsArgs),
        Track(perception::TrackArgs),
        Tilt(perception::TiltArgs),
    }
    "Record and replay" {
        Record(record::RecordArgs),
        Replay(replay::Replay),
        Convert(convert::Convert),
        Telegram(telegram::TelegramArgs) => |telegram, it| telegram.run(it.json, &mut it.out),
    }
    "Share" {
        Gateway(gateway::Gateway),
        Listen(network::ListenArgs),
        Bridge(bridge::Bridge),
        Key(network::KeyArgs),
    }
    "Set up" {
        Probe(probe::ProbeArgs) => |probe, it|
            probe.run(it.json, || it.domain.locations(), &mut it.out, &*it.signals.stop()?),
        Doctor(run::Doctor),
        Configure(configure::ConfigureArgs) => |configure, it|
            configure.run(it.json, &it.domain.locations()?, &mut it.out, &*it.signals.any_stop()?),
        Config(config::Config),
        Zones(zones::ZonesArgs),
        Background(background::BackgroundArgs),
        Site(perception::SiteArgs),
        Completions(generated::Completions),
        Complete(generated::Complete),
        Man(generated::Man),
    }
}

/// Returns the template of the program's help. clap has no headings for verbs, so the template contains their rows.
fn help_template(command: &Command) -> StyledStr {
    let styles = command.get_styles();
    let (header, literal) = (styles.get_header(), styles.get_literal());
    let mut rows = String::new();
    for (group, verbs) in GROUPS {
        rows += &format!("{header}{group}:{header:#}\n");
        for verb in verbs.iter().filter_map(|variant| command.find_subcommand(variant.to_lowercase())) {
            if verb.is_hide_set() {
                continue;
            }
            let (name, about) = (verb.get_name(), verb.get_about().cloned().unwrap_or_default());
            rows += &format!("  {literal}{name:11}{literal:#}  {}\n", about.ansi());
        }
    }
    let start = START.map(|(line, meaning)| format!("  {literal}{line:37}{literal:#}  {meaning}\n")).concat();
    StyledStr::from(format!(
        "{{about-with-newline}}\n\
         {header}Start here:{header:#}\n{start}\n\
         {{usage-heading}} {{usage}}\n\n\
         {header}Commands:{header:#}\n{rows}\n\
         {header}Options:{header:#}\n{{options}}\n\n\
         `scanhub COMMAND --help` shows the options of a command and examples.\n"
    ))
}

/// First commands of a new user, each with its effect.
const START: [(&str, &str); 3] = [
    ("scanhub demo", "Show simulated scanners in this terminal; no hardware is needed"),
    ("scanhub probe /dev/ttyUSB0", "Identify the scanner at a port"),
    ("scanhub run --link front=/dev/ttyUSB0", "Run the hub. Then, in another terminal: scanhub watch"),
];

/// Parses the name of a family.
pub(crate) fn family(text: &str) -> Result<Family, String> {
    let names = || Family::ALL.map(Family::name).join(", ");
    Family::parse(&text.to_lowercase()).ok_or_else(|| format!("one of {}, not {text:?}", names()))
}

#[cfg(test)]
#[path = "../tests/it/pages/blocks.rs"]
mod blocks;
#[cfg(test)]
#[path = "../tests/it/pages/shell.rs"]
mod shell;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the result of parsing the first command of this program in `line`.
    fn read(line: &str) -> ArgMatches {
        let words = shell::scanhub_commands(line);
        let first = words.first().unwrap_or_else(|| panic!("nothing for this program: {line}"));
        let read = Cli::command().try_get_matches_from(first);
        read.unwrap_or_else(|error| panic!("{line}: {error}"))
    }

    /// Returns the examples in the help of all verbs below `command`, each with the path to its verb.
    fn examples(command: &Command, before: &str) -> Vec<(String, String)> {
        let mut examples = Vec::new();
        // A hidden verb needs no example.
        for verb in command.get_subcommands().filter(|verb| !verb.is_hide_set()) {
            let path = format!("{before}{}", verb.get_name());
            let help = verb.get_after_help().map(ToString::to_string).unwrap_or_default();
            let title = help.lines().next().unwrap_or_default();
            let lines = help.lines().skip(1).map_while(|line| line.strip_prefix("  "));
            let own: Vec<_> = lines.map(|line| (path.clone(), line.to_owned())).collect();
            let expected = match own.len() {
                0 => panic!("{path} has no example: {help:?}"),
                1 => "Example:",
                _ => "Examples:",
            };
            assert_eq!(title, expected, "{path}: {help}");
            examples.extend(own);
            examples.extend(self::examples(verb, &format!("{path} ")));
        }
        examples
    }

    #[test]
    fn every_verb_has_an_example_that_can_be_read() {
        let command = Cli::command();
        for (path, line) in examples(&command, "") {
            let read = read(&line);
            let mut matches = &read;
            for verb in path.split(' ') {
                let (name, deeper) = matches.subcommand().unwrap_or_else(|| panic!("{line}: no {verb}"));
                assert_eq!(name, verb, "{line}");
                matches = deeper;
            }
        }
        command.debug_assert();
    }

    #[test]
    fn every_verb_is_in_one_group_of_help_and_page() {
        let command = Cli::command();
        let visible: Vec<_> = command.get_subcommands().filter(|verb| !verb.is_hide_set()).collect();
        let help = command.clone().help_template(help_template(&command)).render_help().to_string();
        let page = include_str!("../docs/verbs.md");
        let mut groups = Vec::new();
        let rows =
            help.lines().skip_while(|row| *row != "Commands:").skip(1).take_while(|row| !row.is_empty());
        for row in rows {
            match row.strip_prefix("  ") {
                Some(verb) => {
                    let (_, verbs): &mut (&str, Vec<&str>) = groups.last_mut().expect("a group");
                    verbs.extend(verb.split_whitespace().next());
                }
                None => groups.push((row.trim_end_matches(':'), Vec::new())),
            }
        }
        assert_eq!(groups.iter().map(|(group, _)| *group).collect::<Vec<_>>(), GROUP_TITLES);
        for verb in visible {
            let is_in = |(_, verbs): &&(&str, Vec<&str>)| verbs.contains(&verb.get_name());
            assert_eq!(groups.iter().filter(is_in).count(), 1, "{}", verb.get_name());
        }
        assert_eq!(groups_of_page(page), groups, "docs/verbs.md");
    }

    const GROUP_TITLES: [&str; 5] = ["Run", "Look", "Record and replay", "Share", "Set up"];

    /// Returns the groups of `page` with their verbs, in the order of their rows.
    fn groups_of_page(page: &str) -> Vec<(&str, Vec<&str>)> {
        let sections =
            page.split("\n## ").skip(1).map(|section| section.split_once('\n').unwrap_or_default());
        sections
            .filter(|(title, _)| GROUP_TITLES.contains(title))
            .map(|(title, rows)| {
                let cells = rows.lines().filter_map(|row| row.strip_prefix("| `")?.split(" |").next());
                let names =
                    cells.flat_map(|cell| cell.split(", `")).filter_map(|cell| cell.split(['`', ' ']).next());
                let mut names: Vec<_> = names.collect();
                names.dedup();
                (title, names)
            })
            .collect()
    }

    #[test]
    fn every_example_runs_in_zsh_unchanged() {
        let of_help = examples(&Cli::command(), "").into_iter().map(|(_, line)| line);
        let of_pages = blocks::blocks().into_iter().filter(|block| block.language == "sh");
        let of_pages = of_pages.flat_map(|block| shell::lines(&block.text));
        for line in of_help.chain(of_pages) {
            assert_eq!(shell::patterns(&line), Vec::<String>::new(), "{line}");
        }
    }

    #[test]
    fn every_command_line_on_a_page_can_be_read() {
        let mut count = 0;
        for block in blocks::blocks().into_iter().filter(|block| block.language == "sh") {
            for line in shell::lines(&block.text) {
                for words in shell::scanhub_commands(&line) {
                    let read = Cli::command().try_get_matches_from(&words);
                    read.unwrap_or_else(|error| panic!("{}: {line}: {error}", block.location));
                    count += 1;
                }
            }
        }
        assert!(count > 40, "{count}");
        let unknown = Cli::command().try_get_matches_from(["scanhub", "record", "--ros3"]);
        assert!(unknown.is_err(), "what is wrong would be found");
    }
}
