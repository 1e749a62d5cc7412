//! The command `scanhub config`: a hub can load its output, it checks configurations as a hub does, and it shows the
//! source of each value. This file also tests the outputs that are generated from the definition of the command line:
//! examples, suggestions for mistyped names, completions and manual pages.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit;
use crate::testkit::{Outcome, TestEnv, output, skip};

fn text(outcome: &Outcome) -> String {
    String::from_utf8_lossy(&outcome.stdout).into_owned()
}

/// Runs the program with `arguments`, which must succeed, and returns its output.
fn print_config(env: &TestEnv, arguments: &[&str]) -> String {
    let outcome = env.run(arguments);
    assert_eq!((outcome.exit_code, outcome.stderr.as_str()), (Some(0), ""), "{outcome}");
    text(&outcome)
}

#[test]
fn printed_default_loads_and_equals_built_in_defaults() {
    let env = TestEnv::new();
    let default = env.file("default.toml", print_config(&env, &["config", "default"]));
    let ok = "ok: 1 link: front at /dev/ttyUSB0\n";
    assert_eq!(print_config(&env, &["config", "check", &default]), ok);
    let links = ["--link=front=/dev/ttyUSB0"];
    assert_eq!(print_config(&env, &[&["config", "check", "--no-system-config"], &links[..]].concat()), ok);
    let values = |arguments: &[&str]| -> Vec<_> {
        let outcome = env.run(&[&["config", "show", "--json", "--no-system-config"], arguments].concat());
        let lines = outcome.of_class("value");
        lines.iter().map(|line| (line["key"].clone(), line["value"].clone())).collect()
    };
    let without = values(&links);
    assert!(without.len() > 40, "{without:?}");
    assert_eq!(values(&["--config", &default]), without);
}

#[test]
fn config_check_rejects_bad_configurations() {
    let env = TestEnv::new();
    let file = env.file("scanhub.toml", "[[link]]\nname = \"a\"\nprot = \"/dev/x\"\n");
    let gateway = env.file("gateway.toml", "[gateway]\nbackground_every = \"10\"\n");
    let empty = env.file("empty.toml", "");
    let topics = env.file("topics.toml", "[gateway]\ntopics = [\"*/scna\"]\n");
    for (arguments, place) in [
        (vec![topics.as_str()], "section gateway: ".to_owned()),
        (vec![file.as_str()], format!("{file}:3:1: unknown key `prot`")),
        (vec![gateway.as_str()], format!("{gateway}:2:20: ")),
        (vec!["--config", file.as_str()], format!("{file}:3:1: unknown key `prot`")),
        (
            vec!["--no-system-config", "--link=front=x", "--set", "link.front.angle=170"],
            "angle = 170".to_owned(),
        ),
        (vec!["--no-system-config", "--link", "front"], "--link front: no = in it".to_owned()),
        (vec!["--no-system-config"], "no link is configured\n  --link NAME=PORT".to_owned()),
        (vec![empty.as_str()], "no link is configured".to_owned()),
    ] {
        let outcome = env.run(&[&["config", "check"], &arguments[..]].concat());
        assert_eq!((outcome.exit_code, outcome.stdout.len()), (Some(78), 0), "{outcome}");
        assert!(outcome.stderr.contains(&place), "{place}: {outcome}");
        let outcome = env.run(&[&["config", "check", "--json"], &arguments[..]].concat());
        let error = &outcome.of_class("error")[0];
        assert_eq!(
            (outcome.exit_code, error["kind"].as_str()),
            (Some(78), Some("configuration")),
            "{outcome}"
        );
    }
    let missing = env.run(&["config", "check", "/nowhere/scanhub.toml"]);
    assert_eq!((missing.exit_code, missing.stdout.len()), (Some(66), 0), "{missing}");
    assert!(missing.stderr.contains("/nowhere/scanhub.toml: No such file"), "{missing}");
    let link = ["config", "check", "--json", "--no-system-config", "--link", "a=tcp:box:4001"];
    let checked = env.run(&link).of_class("checked");
    assert_eq!(checked[0]["links"][0]["port"], "tcp:box:4001", "{checked:?}");
}

#[test]
fn config_show_aligns_values_and_sources() {
    let env = TestEnv::new();
    let file =
        env.file("scanhub.toml", "[[link]]\nname = \"a\"\nport = \"/dev/x\"\n[zones]\nradii = [2.0, 1.0]\n");
    let words = ["config", "show", "--no-system-config", "--config", &file, "--set", "link.a.pose.x=0.3"];
    let shown = print_config(&env, &words);
    let row = |key: &str| {
        let found = shown.lines().find(|line| line.split_whitespace().next() == Some(key));
        found.unwrap_or_else(|| panic!("no {key}: {shown}"))
    };
    assert!(row("link.a.zones.radii").contains("  [2.0, 1.0]  "), "{shown}");
    assert!(row("link.a.zones.radii").ends_with(&format!("  {file}:5:9")), "{shown}");
    assert!(row("link.a.pose.x").ends_with("  --set link.a.pose.x=0.3"), "{shown}");
    assert!(row("link.a.family").ends_with("  default"), "{shown}");
    let columns = [file.as_str(), "default", "--set"];
    let begins: Vec<_> =
        shown.lines().map(|line| columns.iter().find_map(|word| line.find(&format!("  {word}")))).collect();
    // The source of the value must start at the same column in every row. Each source begins with one of these words.
    assert!(begins.iter().all(|at| at.is_some() && *at == begins[0]), "{shown}");
}

#[test]
fn mistyped_key_error_suggests_the_nearest_name() {
    let env = TestEnv::new();
    for (arguments, nearest) in [
        (&["ehco"][..], "'echo'"),
        (&["echo", "--jsn"], "'--json'"),
        (&["config", "shwo"], "'show'"),
        (&["run", "--lnik", "a=b"], "'--link'"),
    ] {
        let outcome = env.run(arguments);
        assert_eq!(outcome.exit_code, Some(2), "{outcome}");
        assert!(outcome.stderr.contains("tip: "), "{outcome}");
        assert!(outcome.stderr.contains(nearest), "{outcome}");
    }
    let outcome = env.run(&["wacth", "--json"]);
    let error = &outcome.lines()[0];
    assert_eq!(
        (outcome.exit_code, &error["hint"]),
        (Some(2), &"a similar subcommand exists: 'watch'".into())
    );
}

/// Returns the verbs that the help lists, except `help` itself.
fn verbs(env: &TestEnv) -> Vec<String> {
    let help = print_config(env, &["--help"]);
    let rows =
        help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let verbs = rows.filter(|row| row.starts_with("  ") && !row.starts_with("   "));
    verbs
        .filter_map(|row| row.split_whitespace().next())
        .filter(|verb| *verb != "help")
        .map(str::to_owned)
        .collect()
}

#[test]
fn every_verb_has_an_example_a_page_and_a_completion() {
    let env = TestEnv::new();
    let verbs = verbs(&env);
    assert!(verbs.len() > 15, "{verbs:?}");
    let pages = env.path_argument("man");
    print_config(&env, &["man", &pages]);
    let completions = ["bash", "zsh", "fish"].map(|shell| print_config(&env, &["completions", shell]));
    for verb in &verbs {
        // `bridge` is a separate program, which `cargo test` does not build for these tests. The tests of the bridge
        // check its help.
        let is_apart = verb == "bridge";
        assert!(
            is_apart || print_config(&env, &[verb, "--help"]).contains(&format!("  scanhub {verb}")),
            "{verb}"
        );
        let page = fs::read_to_string(Path::new(&pages).join(format!("scanhub-{verb}.1")));
        let page = page.unwrap_or_else(|error| panic!("{verb}: {error}"));
        assert!(page.contains(&format!("scanhub {verb}")), "{page}");
        for text in &completions {
            assert!(text.contains(verb.as_str()), "{verb}: {text}");
        }
    }
    assert!(print_config(&env, &["man"]).contains(".TH scanhub 1"));
    let refused = env.run(&["man", "/dev/null/man"]);
    assert_eq!(
        (refused.exit_code, refused.stderr.contains("/dev/null/man: ")),
        (Some(73), true),
        "{refused}"
    );

    // This command runs bash to print the completions that bash offers. bash is installed on most machines.
    let script = env.file("completion", &completions[0]);
    let ask = "source \"$0\"; COMP_WORDS=(scanhub ec); COMP_CWORD=1; _scanhub scanhub ec scanhub; echo \"${COMPREPLY[*]}\"";
    match output(Command::new("bash").args(["-c", ask, &script])) {
        Ok(completion_output) => {
            assert_eq!(String::from_utf8_lossy(&completion_output.stdout).trim(), "echo")
        }
        Err(error) => skip("bash", error),
    }
}

/// Returns the words with which bash completes the last one of `words`, which is incomplete. If bash is not installed,
/// skips the rest of the test and returns `None`.
fn complete_words(env: &TestEnv, words: &[&str]) -> Option<Vec<String>> {
    let program = Path::new(env!("CARGO_BIN_EXE_scanhub"));
    let script = env.file("completion", print_config(env, &["completions", "bash"]));
    let ask = "source \"$0\"; COMP_WORDS=(\"$@\"); COMP_CWORD=$(($# - 1)); \
               \"$(complete -p scanhub | sed 's/.*-F \\([^ ]*\\).*/\\1/')\" \"$1\" \"${@: -1}\" \"${@: -2:1}\"; printf '%s\\n' \"${COMPREPLY[@]}\"";
    let path = format!("{}:{}", program.parent()?.display(), std::env::var("PATH").unwrap_or_default());
    let mut bash = Command::new("bash");
    bash.args(["-c", ask, &script, "scanhub"]).args(words).env("PATH", path);
    let completion_output = match output(bash) {
        Ok(completion_output) => completion_output,
        Err(error) => {
            skip("bash", error);
            return None;
        }
    };
    assert_eq!(
        (completion_output.status.success(), completion_output.stderr.is_empty()),
        (true, true),
        "{completion_output:?}"
    );
    Some(String::from_utf8_lossy(&completion_output.stdout).lines().map(String::from).collect())
}

#[test]
fn completes_sensors_and_topics_of_the_running_hub() {
    let env = TestEnv::new();
    let (domain, root) = (format!("--domain={}", env.domain().name()), env.domain().root().to_owned());
    let root = format!("--root={}", root.parent().expect("a directory").display());
    let ask = |words: &[&str]| complete_words(&env, &[&words[..1], &[&domain, &root], &words[1..]].concat());
    let Some(before) = ask(&["echo", "front/s"]) else { return };
    assert_eq!(before, [""; 1], "without a hub, there is no completion");
    let hub = env.hub(&["--link=front=/no/such/port", "--link=rear=/no/such/port2"]);
    for (words, expected) in [
        (&["echo", "front/s"][..], &["front/scan", "front/status"][..]),
        (&["hz", "front/scan", "rear/sc"], &["rear/scan"]),
        (&["gateway", "--topic", "rear/z"], &["rear/zones"]),
        (&["info", ""], &["front", "rear"]),
        (&["control", "r"], &["rear"]),
        (&["leds", "ro"], &["robot"]),
        (&["control", "rear", "pau"], &["pause"]),
        (&["echo", "--cs"], &["--csv"]),
    ] {
        assert_eq!(
            ask(words).as_deref(),
            Some(&expected.iter().map(|&it| it.to_owned()).collect::<Vec<_>>()[..]),
            "{words:?}"
        );
    }
    assert_eq!(hub.end(testkit::TERM).exit_code, Some(0));
}

/// Returns all files below `directory`.
fn files(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

#[test]
fn install_script_removes_manuals_and_completions() {
    let env = TestEnv::new();
    let install = |arguments: &[&str]| {
        let mut command = Command::new("sh");
        command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/hub/dist/install.sh")).args(arguments);
        let done = output(command.env("DESTDIR", env.path("root"))).expect("a shell starts");
        assert!(done.status.success(), "{done:?}");
        String::from_utf8_lossy(&done.stderr).into_owned()
    };
    assert_eq!(install(&["--program", env!("CARGO_BIN_EXE_scanhub")]), "");
    let root = env.path("root");
    let local = root.join("usr/local");
    for file in [
        "bin/scanhub",
        "share/man/man1/scanhub.1",
        "share/man/man1/scanhub-run.1",
        "share/man/man1/scanhub-config-show.1",
        "share/bash-completion/completions/scanhub",
        "share/zsh/site-functions/_scanhub",
        "share/fish/vendor_completions.d/scanhub.fish",
    ] {
        assert!(fs::metadata(local.join(file)).is_ok_and(|file| file.len() > 0), "{file}");
    }
    let unit = fs::read_to_string(root.join("etc/systemd/system/scanhub.service")).expect("a unit");
    assert!(unit.contains("\nExecReload=/bin/kill -HUP $MAINPID\n"), "{unit}");
    install(&["--remove"]);
    assert_eq!(files(&root), Vec::<PathBuf>::new());
    // If the program does not run on this machine, the script installs it without manual pages and completions.
    let other = env.file("other", "of another processor");
    assert!(install(&["--program", &other]).contains("no manual pages, no completions"));
    assert!(!local.join("share").exists() || files(&local.join("share")).is_empty());
}
