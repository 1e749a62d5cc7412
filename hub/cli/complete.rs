//! What the running hub adds to a completion: the names of its sensors, where the command line takes one. It prints no
//! errors, because nobody reads them while typing.

use std::collections::VecDeque;

use clap::{Arg, Args, Command, CommandFactory};
use scanhub_shm::{Domain, Environment};

use super::{Cli, command};
use crate::print_own;

/// Internal: the scripts of `completions` call it.
#[derive(Args, Debug)]
pub(crate) struct Complete {
    /// The words before the cursor, the program's name first
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl Complete {
    /// Prints what can come next, one word a line.
    pub(crate) fn run(&self) {
        let line = Line::read(&command(), &self.words);
        let Some(name) = line.wanted else { return };
        let domain = line.value_of("domain").or_else(|| std::env::var("SCANHUB_DOMAIN").ok());
        let domain = domain.unwrap_or_else(|| scanhub_shm::DEFAULT_DOMAIN.to_owned());
        let root = line.value_of("root");
        let root = root.as_deref().map(std::path::Path::new);
        let Ok(places) = Domain::candidates(&domain, root, &Environment::of_process()) else { return };
        let mut words = match name {
            Name::Sensor => scanhub_client::live_sensors(&places),
            Name::Topic => scanhub_client::live_topics(&places),
        };
        if line.takes_robot && !words.is_empty() {
            words.push(if name == Name::Sensor { "robot" } else { "robot/zones" }.to_owned());
        }
        if !words.is_empty() {
            let _ = print_own(&words.join("\n"));
        }
    }
}

/// Which names of the hub can come next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Name {
    Sensor,
    Topic,
}

/// A command line up to the cursor.
#[derive(Debug, Default)]
struct Line {
    /// The name that comes next, if it is one of the hub.
    wanted: Option<Name>,
    /// Whether `robot`, all sensors together, is accepted too.
    takes_robot: bool,
    values: Vec<(String, String)>,
}

impl Line {
    /// Reads `words`, the program's name first, by the definition `whole`.
    fn read(whole: &Command, words: &[String]) -> Line {
        let everywhere = Cli::command();
        let mut line = Line::default();
        let (mut command, mut positional) = (whole, 0);
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
                            line.wanted = name(option);
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
        line.wanted = next.and_then(name);
        line.takes_robot = ["echo", "hz", "latency", "leds"].contains(&command.get_name());
        line
    }

    fn value_of(&self, id: &str) -> Option<String> {
        self.values.iter().rev().find(|(known, _)| known == id).map(|(_, value)| value.clone())
    }
}

/// The option that `word` starts with.
fn option<'a>(command: &'a Command, word: &str) -> Option<&'a Arg> {
    let (bare, _) = word.split_once('=').unwrap_or((word, ""));
    let is_it = |arg: &&Arg| match (bare.strip_prefix("--"), bare.strip_prefix('-')) {
        (Some(long), _) => arg.get_long() == Some(long),
        (None, Some(short)) => arg.get_short().is_some_and(|known| short == known.to_string()),
        _ => false,
    };
    command.get_arguments().find(is_it)
}

/// Which name of a hub `arg` takes; its value name tells.
fn name(arg: &Arg) -> Option<Name> {
    let named = arg.get_value_names().and_then(|names| names.first()).map(|name| name.to_string());
    match named.unwrap_or_else(|| arg.get_id().to_string().to_uppercase()).as_str() {
        "SENSOR" => Some(Name::Sensor),
        text if text.starts_with("SENSOR/TOPIC") => Some(Name::Topic),
        _ => None,
    }
}

/// Appended to the script for bash: what the script knows, and what the hub knows.
pub(super) const BASH: &str = r#"
_scanhub_live() {
    _scanhub "$@"
    local known
    [[ $2 == -* ]] && return 0
    known=$("$1" complete -- "${COMP_WORDS[@]:0:COMP_CWORD}" 2>/dev/null)
    [[ -z $known ]] || COMPREPLY=($(compgen -W "$known" -- "$2"))
}
complete -F _scanhub_live -o bashdefault -o default scanhub
"#;

/// Appended to the script for zsh: replaces file names.
pub(super) const ZSH: &str = r#"
_scanhub_live() {
    local -a typed known
    typed=(${(z)LBUFFER})
    [[ $LBUFFER == *[[:space:]] ]] || typed[-1]=()
    known=(${(f)"$(${typed[1]} complete -- $typed 2>/dev/null)"})
    if (( ${#known} )); then compadd -a known; else _default "$@"; fi
}
"#;

/// Appended to the script for fish.
pub(super) const FISH: &str = r#"
complete -c scanhub -a '(set -l typed (commandline -opc); $typed[1] complete -- $typed 2>/dev/null)'
"#;

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(text: &str) -> Option<Name> {
        let words: Vec<_> = text.split_whitespace().map(String::from).collect();
        Line::read(&command(), &words).wanted
    }

    #[test]
    fn where_a_name_of_the_hub_can_stand() {
        for text in [
            "scanhub echo",
            "scanhub echo front/scan",
            "scanhub --json --domain x echo --for 3s",
            "scanhub hz",
            "scanhub latency",
            "scanhub record -o x.mcap",
            "scanhub gateway --topic",
        ] {
            assert_eq!(wanted(text), Some(Name::Topic), "{text}");
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
            assert_eq!(wanted(text), Some(Name::Sensor), "{text}");
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
    fn a_domain_is_heard_however_it_is_written() {
        for text in ["scanhub --domain x echo", "scanhub echo --domain=x", "scanhub echo --domain = x"] {
            let words: Vec<_> = text.split_whitespace().map(String::from).collect();
            let line = Line::read(&command(), &words);
            assert_eq!(
                (line.wanted, line.value_of("domain")),
                (Some(Name::Topic), Some("x".into())),
                "{text}"
            );
        }
    }
}
