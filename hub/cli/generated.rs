//! `scanhub completions` and `scanhub man`: texts that are generated from the definition of the command line. The
//! scripts call the hidden verb `complete` for the names of the running hub. That verb prints no errors, because they
//! would disturb a user who types.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use clap::{Arg, Args, Command, CommandFactory, ValueEnum};
use clap_complete::shells;
use scanhub_files::output;
use scanhub_schema::{Failure, Kind};
use scanhub_shm::{Domain, Environment};
use scanhub_verbs::context::Context;

use super::Cli;
use crate::print_own;

/// Print the completion script for a shell
#[derive(Args, Debug)]
#[command(
    after_help = "Example:\n  scanhub completions bash > ~/.local/share/bash-completion/completions/scanhub"
)]
pub(crate) struct Completions {
    /// Shell to print for
    shell: Shell,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

impl Completions {
    /// Prints the script.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the script cannot be written.
    pub(crate) fn run(&self, _: &mut Context) -> Result<(), Failure> {
        let mut text = Vec::new();
        let command = &mut Cli::command();
        match self.shell {
            Shell::Bash => clap_complete::generate(shells::Bash, command, NAME, &mut text),
            Shell::Zsh => clap_complete::generate(shells::Zsh, command, NAME, &mut text),
            Shell::Fish => clap_complete::generate(shells::Fish, command, NAME, &mut text),
        }
        let text = String::from_utf8_lossy(&text);
        let text = text.trim_end();
        // The definition of the command line does not contain the names of the hub, so add them.
        match self.shell {
            Shell::Bash => print_own(&format!("{text}\n{}", BASH.trim_end())),
            // The last lines of the script call functions defined before them.
            Shell::Zsh => {
                let (head, body) = text.split_once('\n').unwrap_or((text, ""));
                let body = body.replace(":_default'", ":_scanhub_live'");
                print_own(&format!("{head}\n{}\n{body}", ZSH.trim_end()))
            }
            Shell::Fish => print_own(&format!("{text}\n{}", FISH.trim())),
        }
    }
}

/// Print names of the running hub for the completion scripts
#[derive(Args, Debug)]
#[command(hide = true)]
pub(crate) struct Complete {
    /// The words before the cursor, the program's name first
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl Complete {
    /// Prints the words that can come next, one in a line.
    pub(crate) fn run(&self, _: &mut Context) -> Result<(), Failure> {
        self.print();
        Ok(())
    }

    fn print(&self) {
        let line = CommandLine::read(&Cli::command(), &self.words);
        let Some(name) = line.name_kind else { return };
        let domain = line.value_of("domain").or_else(|| std::env::var("SCANHUB_DOMAIN").ok());
        let domain = domain.unwrap_or_else(|| scanhub_shm::DEFAULT_DOMAIN.to_owned());
        let root = line.value_of("root");
        let root = root.as_deref().map(std::path::Path::new);
        let Ok(locations) = Domain::candidates(&domain, root, &Environment::of_process()) else { return };
        let mut words = match name {
            NameKind::Sensor => scanhub_client::live_sensors(&locations),
            NameKind::Topic => scanhub_client::live_topics(&locations),
        };
        if line.takes_robot && !words.is_empty() {
            words.push(if name == NameKind::Sensor { "robot" } else { "robot/zones" }.to_owned());
        }
        if !words.is_empty() {
            let _ = print_own(&words.join("\n"));
        }
    }
}

/// Kind of the names of the hub that can come next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NameKind {
    Sensor,
    Topic,
}

/// A command line up to the cursor.
#[derive(Debug, Default)]
struct CommandLine {
    /// Kind of the name that is expected next, if it is a name of the hub.
    name_kind: Option<NameKind>,
    /// Whether the name `robot` is accepted, too, which means all sensors together.
    takes_robot: bool,
    values: Vec<(String, String)>,
}

impl CommandLine {
    /// Parses `words`, the program's name first, according to `definition`.
    fn read(definition: &Command, words: &[String]) -> CommandLine {
        let everywhere = Cli::command();
        let mut line = CommandLine::default();
        let (mut command, mut positional) = (definition, 0);
        // Some shells split `--domain=robot` into three words.
        let mut words: VecDeque<&str> =
            words.iter().skip(1).map(String::as_str).filter(|word| *word != "=").collect();
        while let Some(word) = words.pop_front() {
            if let Some(option) = option(command, word).or_else(|| option(&everywhere, word)) {
                let takes_value = option.get_action().takes_values() && !word.contains('=');
                if let Some((_, value)) = word.split_once('=') {
                    line.values.push((option.get_id().to_string(), value.to_owned()));
                }
                if takes_value {
                    match words.pop_front() {
                        Some(value) => line.values.push((option.get_id().to_string(), value.to_owned())),
                        None => {
                            line.name_kind = name(option);
                            return line;
                        }
                    }
                }
            } else if word.starts_with('-') {
                continue;
            } else if let Some(below) = command.find_subcommand(word) {
                (command, positional) = (below, 0);
            } else {
                positional += 1;
            }
        }
        let is_many = |arg: &&Arg| {
            arg.get_num_args().is_some_and(|count| count.max_values() > 1)
                || matches!(arg.get_action(), clap::ArgAction::Append)
        };
        let all: Vec<_> = command.get_positionals().collect();
        let next = all.get(positional).copied().or_else(|| all.last().copied().filter(is_many));
        line.name_kind = next.and_then(name);
        line.takes_robot = ["echo", "hz", "latency", "leds"].contains(&command.get_name());
        line
    }

    fn value_of(&self, id: &str) -> Option<String> {
        self.values.iter().rev().find(|(flag, _)| flag == id).map(|(_, value)| value.clone())
    }
}

/// Returns the option that `word` starts with.
fn option<'a>(command: &'a Command, word: &str) -> Option<&'a Arg> {
    let (bare, _) = word.split_once('=').unwrap_or((word, ""));
    let is_it = |arg: &&Arg| match (bare.strip_prefix("--"), bare.strip_prefix('-')) {
        (Some(long), _) => arg.get_long() == Some(long),
        (None, Some(short)) => arg.get_short().is_some_and(|known| short == known.to_string()),
        _ => false,
    };
    command.get_arguments().find(is_it)
}

/// Returns the kind of names of a hub that `arg` takes, by its value name.
fn name(arg: &Arg) -> Option<NameKind> {
    let named = arg.get_value_names().and_then(|names| names.first()).map(|name| name.to_string());
    match named.unwrap_or_else(|| arg.get_id().to_string().to_uppercase()).as_str() {
        "SENSOR" => Some(NameKind::Sensor),
        text if text.starts_with("SENSOR/TOPIC") => Some(NameKind::Topic),
        _ => None,
    }
}

/// Appended to the script for bash: adds the names of the hub to the words of the script.
const BASH: &str = r#"
_scanhub_live() {
    _scanhub "$@"
    local known
    [[ $2 == -* ]] && return 0
    known=$("$1" complete -- "${COMP_WORDS[@]:0:COMP_CWORD}" 2>/dev/null)
    [[ -z $known ]] || COMPREPLY=($(compgen -W "$known" -- "$2"))
}
complete -F _scanhub_live -o bashdefault -o default scanhub
"#;

/// Inserted into the script for zsh: completes names of the hub in place of file names.
const ZSH: &str = r#"
_scanhub_live() {
    local -a typed known
    typed=(${(z)LBUFFER})
    [[ $LBUFFER == *[[:space:]] ]] || typed[-1]=()
    known=(${(f)"$(${typed[1]} complete -- $typed 2>/dev/null)"})
    if (( ${#known} )); then compadd -a known; else _default "$@"; fi
}
"#;

/// Appended to the script for fish: adds the names of the hub.
const FISH: &str = r#"
complete -c scanhub -a '(set -l typed (commandline -opc); $typed[1] complete -- $typed 2>/dev/null)'
"#;

/// Print or write the manual pages
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Man {
    /// Directory for a page of each verb: scanhub-run.1 .. Without a directory, the page of the program is printed
    #[arg(value_name = "DIR")]
    directory: Option<PathBuf>,
}

const EXAMPLES: &str = "\
Examples:
  scanhub man | man -l -
  scanhub man ~/.local/share/man/man1";

impl Man {
    /// Prints the page of the program, or writes all pages.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the directory cannot be written to, and [`Kind::Failed`] if stdout cannot.
    pub(crate) fn run(&self, _: &mut Context) -> Result<(), Failure> {
        match &self.directory {
            Some(directory) => write_pages(directory),
            None => {
                let mut page = Vec::new();
                let rendered = clap_mangen::Man::new(Cli::command()).render(&mut page);
                rendered.map_err(|error| Failure::new(Kind::Failed, format!("no page: {error}"), ""))?;
                print_own(String::from_utf8_lossy(&page).trim_end())
            }
        }
    }
}

/// Writes the pages of the program and all verbs to `directory`.
fn write_pages(directory: &Path) -> Result<(), Failure> {
    output::create_directory(directory)?;
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    write_page(command, directory)
}

/// Writes the page of `command` and those of its subcommands. Pages of an earlier version are replaced.
fn write_page(command: clap::Command, directory: &Path) -> Result<(), Failure> {
    for command in command.get_subcommands().filter(|command| !command.is_hide_set()) {
        write_page(command.clone(), directory)?;
    }
    let man = clap_mangen::Man::new(command);
    let (path, mut page) = (directory.join(man.get_filename()), Vec::new());
    man.render(&mut page).map_err(|error| output::unwritable(&path, &error))?;
    output::write(&path, &page, true)
}

const NAME: &str = env!("CARGO_PKG_NAME");

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(text: &str) -> Option<NameKind> {
        let words: Vec<_> = text.split_whitespace().map(String::from).collect();
        CommandLine::read(&Cli::command(), &words).name_kind
    }

    #[test]
    fn completes_names_of_the_hub_where_a_verb_takes_them() {
        for text in [
            "scanhub echo",
            "scanhub echo front/scan",
            "scanhub --json --domain x echo --for 3s",
            "scanhub hz",
            "scanhub latency",
            "scanhub record -o x.mcap",
            "scanhub gateway --topic",
        ] {
            assert_eq!(wanted(text), Some(NameKind::Topic), "{text}");
        }
        for text in [
            "scanhub info",
            "scanhub control",
            "scanhub background",
            "scanhub leds --json",
            "scanhub zones",
            "scanhub watch",
            "scanhub watch front",
        ] {
            assert_eq!(wanted(text), Some(NameKind::Sensor), "{text}");
        }
        for text in [
            "",
            "scanhub",
            "scanhub run",
            "scanhub echo --for",
            "scanhub echo --domain",
            "scanhub info front",
            "scanhub control front",
            "scanhub background front",
            "scanhub background front save",
            "scanhub record -o",
            "scanhub replay",
            "scanhub nonsense",
        ] {
            assert_eq!(wanted(text), None, "{text}");
        }
    }

    #[test]
    fn reads_domain_in_every_notation() {
        for text in ["scanhub --domain x echo", "scanhub echo --domain=x", "scanhub echo --domain = x"] {
            let words: Vec<_> = text.split_whitespace().map(String::from).collect();
            let line = CommandLine::read(&Cli::command(), &words);
            assert_eq!(
                (line.name_kind, line.value_of("domain")),
                (Some(NameKind::Topic), Some("x".into())),
                "{text}"
            );
        }
    }
}
