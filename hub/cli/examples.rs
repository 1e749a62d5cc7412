//! An example for each verb, as its help and its manual page show it. A test parses each of them as a command line, and
//! the examples of the pages too.

#[cfg(test)]
#[path = "../../tests/it/pages/blocks.rs"]
mod blocks;
#[cfg(test)]
#[path = "../../tests/it/pages/shell.rs"]
mod shell;

use clap::Command;

/// `command` with an example below the help of each verb.
pub(super) fn with_examples(command: Command) -> Command {
    EXAMPLES.iter().fold(command, |command, (path, lines)| {
        let path: Vec<&str> = path.split(' ').collect();
        put(command, &path, lines)
    })
}

/// `command` with `lines` below the help of its subcommand at `path`.
fn put(command: Command, path: &[&str], lines: &[&str]) -> Command {
    match path {
        [] => below(command, lines),
        [verb, rest @ ..] => command.mut_subcommand(verb, |verb| put(verb, rest, lines)),
    }
}

fn below(verb: Command, lines: &[&str]) -> Command {
    let title = if lines.len() == 1 { "Example" } else { "Examples" };
    let examples = format!("{title}:\n  {}", lines.join("\n  "));
    let text = match verb.get_after_help() {
        Some(more) => format!("{examples}\n\n{more}"),
        None => examples,
    };
    verb.after_help(text)
}

/// Examples by the path to the verb.
const EXAMPLES: &[(&str, &[&str])] = &[
    (
        "run",
        &[
            "scanhub run --link front=/dev/ttyUSB0",
            "scanhub run --link front=/dev/ttyUSB0 --set 'zones.radii=[1.2,0.7]'",
            "scanhub run --config robot.toml",
        ],
    ),
    (
        "replay",
        &[
            "scanhub replay walk.mcap",
            "scanhub replay walk.mcap --rate max --set 'zones.radii=[1.2,0.7]'",
            "scanhub replay walk.mcap --start 1m --end 90s --loop --paused",
        ],
    ),
    (
        "demo",
        &[
            "scanhub demo",
            "scanhub demo --world house",
            "scanhub demo --family mixed",
            "scanhub demo --headless --for 10s",
        ],
    ),
    (
        "simulate",
        &[
            "scanhub simulate --port /tmp/front --world room",
            "scanhub simulate --port /tmp/front --fault loss=0.00135,burst=1.89",
            "scanhub simulate --port /tmp/front --replay robot.mcap --sensor front",
            "scanhub simulate --family rplidar --model a1 --tcp 127.0.0.1:0",
        ],
    ),
    (
        "probe",
        &["scanhub probe", "scanhub probe /dev/ttyUSB0", "scanhub probe /dev/ttyUSB0 --toml >> scanhub.toml"],
    ),
    ("configure", &["scanhub configure /dev/ttyUSB0 unit=mm"]),
    (
        "config",
        &[
            "scanhub config default > scanhub.toml",
            "scanhub config check scanhub.toml",
            "scanhub config show",
        ],
    ),
    ("config default", &["scanhub config default > scanhub.toml"]),
    ("config check", &["scanhub config check scanhub.toml"]),
    (
        "config show",
        &["scanhub config show", "scanhub config show --config robot.toml --set link.front.angle=100"],
    ),
    ("doctor", &["scanhub doctor", "scanhub doctor /dev/ttyUSB0", "scanhub doctor --clean"]),
    ("key", &["scanhub key new lan.key"]),
    ("key new", &["scanhub key new lan.key"]),
    ("list", &["scanhub list"]),
    ("info", &["scanhub info front"]),
    (
        "echo",
        &[
            "scanhub echo front/scan",
            "scanhub echo front/zones --json -n 10",
            "scanhub echo front/scan --csv > scans.csv",
        ],
    ),
    ("hz", &["scanhub hz front/scan --for 10s"]),
    ("latency", &["scanhub latency front/scan --for 10s --max-p99 1ms"]),
    (
        "telegram",
        &["scanhub telegram decode recording.bin", "echo 02 00 01 00 31 15 12 | scanhub telegram decode"],
    ),
    (
        "telegram decode",
        &["scanhub telegram decode recording.bin", "echo 02 00 01 00 31 15 12 | scanhub telegram decode"],
    ),
    (
        "convert",
        &[
            "scanhub convert killed.mcap whole.mcap",
            "scanhub convert robot.mcap front.log.gz --sensor front",
            "scanhub convert room.log.gz room.mcap",
            "scanhub convert walk.mcap ros.mcap --ros2",
            "scanhub convert walk.mcap points.mcap --ros2 --points",
            "scanhub convert robot.mcap front.csv --sensor front --meters",
            "scanhub convert robot.mcap marks.csv --topic front/marks",
        ],
    ),
    ("watch", &["scanhub watch", "scanhub watch front"]),
    ("web", &["scanhub web", "scanhub web --listen 8090", "scanhub web --listen 0.0.0.0 --token carrot"]),
    (
        "record",
        &[
            "scanhub record",
            "scanhub record --ros2 -o ros.mcap --for 10m",
            "scanhub record --all --split 512MiB --keep 20",
            "scanhub record -o walk.mcap --split 1h --keep 20 --force",
        ],
    ),
    ("control", &["scanhub control front pause"]),
    ("background", &["scanhub background front save front.json"]),
    ("background show", &["scanhub background front show"]),
    ("background reset", &["scanhub background front reset"]),
    ("background freeze", &["scanhub background front freeze"]),
    ("background thaw", &["scanhub background front thaw"]),
    ("background save", &["scanhub background front save front.json"]),
    ("background load", &["scanhub background front load front.json"]),
    ("zones", &["scanhub zones front mask --for 10s"]),
    ("zones mask", &["scanhub zones front mask --for 10s"]),
    ("track", &["scanhub track --site house.toml", "scanhub track --site house.toml --count left"]),
    (
        "tilt",
        &[
            "scanhub tilt front --angles mount --axis-at 0,0,0.9 --as hall",
            "scanhub tilt front --angles mount --axis-at 0,0,0.9 --near 0.3,1.2,-0.5,0.5,0.05,1.6",
        ],
    ),
    ("site", &["scanhub site check house.toml"]),
    ("site check", &["scanhub site check house.toml --svg house.svg"]),
    ("leds", &["scanhub leds front", "scanhub leds robot --led green=led0"]),
    ("gateway", &["scanhub gateway --interface eth0 --topic '*/zones' --topic front/scan:every=4"]),
    (
        "bridge",
        &[
            "scanhub bridge --listen tcp/0.0.0.0:7447",
            "scanhub bridge --connect tcp/robot:7447 --publish --name robot1=5f3a12bc00d1e2f3",
            "scanhub bridge --help",
        ],
    ),
    ("listen", &["scanhub listen --interface eth0 --stats"]),
    ("completions", &["scanhub completions bash > ~/.local/share/bash-completion/completions/scanhub"]),
    ("man", &["scanhub man | man -l -", "scanhub man ~/.local/share/man/man1"]),
];

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ArgMatches;

    /// How this program parses its first command line in `line`.
    fn read(line: &str) -> ArgMatches {
        let words = shell::of_the_program(line);
        let first = words.first().unwrap_or_else(|| panic!("nothing for this program: {line}"));
        let read = crate::cli::command().try_get_matches_from(first);
        read.unwrap_or_else(|error| panic!("{line}: {error}"))
    }

    /// The paths to all verbs below `command`.
    fn paths(command: &Command, before: &str) -> Vec<String> {
        // A hidden verb needs no example.
        let verbs = command.get_subcommands().filter(|verb| !verb.is_hide_set());
        let ways = verbs.flat_map(|verb| {
            let path = format!("{before}{}", verb.get_name());
            let deeper = paths(verb, &format!("{path} "));
            [vec![path], deeper].concat()
        });
        ways.collect()
    }

    #[test]
    fn every_verb_has_an_example_that_can_be_read() {
        let command = crate::cli::command();
        let paths = paths(&command, "");
        assert_eq!(paths.len(), EXAMPLES.len(), "{paths:?}");
        for path in &paths {
            let example = EXAMPLES.iter().find(|(way, _)| way == path);
            let (_, lines) = example.unwrap_or_else(|| panic!("{path} has no example"));
            for line in *lines {
                let read = read(line);
                let mut matches = &read;
                for verb in path.split(' ') {
                    let (name, deeper) = matches.subcommand().unwrap_or_else(|| panic!("{line}: no {verb}"));
                    assert_eq!(name, verb, "{line}");
                    matches = deeper;
                }
            }
        }
        command.debug_assert();
    }

    #[test]
    fn every_example_runs_in_zsh_unchanged() {
        let of_help = EXAMPLES.iter().flat_map(|(_, lines)| lines.iter().map(|line| (*line).to_owned()));
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
                for words in shell::of_the_program(&line) {
                    let read = crate::cli::command().try_get_matches_from(&words);
                    read.unwrap_or_else(|error| panic!("{}: {line}: {error}", block.place));
                    count += 1;
                }
            }
        }
        assert!(count > 40, "{count}");
        let unknown = crate::cli::command().try_get_matches_from(["scanhub", "record", "--ros3"]);
        assert!(unknown.is_err(), "what is wrong would be found");
    }
}
