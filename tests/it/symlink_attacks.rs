//! Tests of symbolic links that another user has created where programs of root write files. The files to which the
//! links point must stay unchanged.

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::process::Command;

use crate::foreign_user::{run_as_other_user, scanhub, with_another_user};
use crate::testkit::{INT, Outcome, Program, TERM, is_class, wait_until};

const TARGET_FILE: &str = "/mnt/victim";
const TARGET_CONTENT: &str = "a file of root";

/// Creates the file of root that must not change, and the input files of the verbs, in a directory to which the other
/// user cannot write.
fn prepare() {
    fs::write(TARGET_FILE, TARGET_CONTENT).expect("a file");
    let scan = format!("FLASER 181{} 0 0 0 0 0 0 1.5 host 1.5\n", " 1.5".repeat(181));
    fs::write("/mnt/walk.log", scan).expect("a file");
    let site = "[[sensor]]\nname = \"front\"\npose = { x = 0, y = 0, yaw = 0 }\n[[room]]\nname = \"a\"\npolygon = [[0, 0], [4, 0], [4, 3]]\n";
    fs::write("/mnt/site.toml", site).expect("a file");
}

fn run(words: &[&str]) -> Outcome {
    Program::start(scanhub(0, words)).wait()
}

/// Returns command lines of root that write to `file`.
fn outputs(file: &str) -> [Vec<&str>; 10] {
    [
        vec!["convert", "/mnt/walk.log", file],
        vec!["convert", "/mnt/walk.log", file, "--force"],
        vec!["record", "-o", file],
        vec!["record", "-o", file, "--force"],
        vec!["simulate", "--port=/mnt/port", "--truth", file],
        vec!["simulate", "--port=/mnt/port", "--truth", file, "--force"],
        vec!["site", "check", "/mnt/site.toml", "--svg", file],
        vec!["site", "check", "/mnt/site.toml", "--svg", file, "--force"],
        vec!["key", "new", file],
        vec!["background", "front", "save", file, "--force"],
    ]
}

#[test]
fn symlinked_outputs_are_refused() {
    with_another_user("symlink_attacks::symlinked_outputs_are_refused", || {
        prepare();
        run_as_other_user(
            "ln -s /mnt/victim /tmp/out.mcap && ln -s /mnt /tmp/way && ln -s /mnt/new /tmp/dangling.mcap",
        );
        for (file, message) in [
            ("/tmp/out.mcap", "it is a link to /mnt/victim"),
            ("/tmp/dangling.mcap", "it is a link to /mnt/new"),
            ("/tmp/way/victim", "/tmp/way is a link of user 65533"),
            ("/tmp/way/new.mcap", "/tmp/way is a link of user 65533"),
        ] {
            for words in outputs(file) {
                let outcome = run(&words);
                let is_format = words[0] == "convert" && file.ends_with("victim");
                assert!(
                    outcome.exit_code == Some(73) || is_format && outcome.exit_code == Some(2),
                    "{words:?}: {outcome}"
                );
                assert!(outcome.stderr.contains(message) || is_format, "{words:?}: {outcome}");
            }
        }
        assert_eq!(fs::read_to_string(TARGET_FILE).expect("a readable file"), TARGET_CONTENT);
        assert!(!fs::exists("/mnt/new").unwrap() && !fs::exists("/mnt/new.mcap").unwrap());
    });
}

#[test]
fn directories_are_not_created_through_foreign_links() {
    with_another_user("symlink_attacks::directories_are_not_created_through_foreign_links", || {
        fs::create_dir("/mnt/prey").expect("a directory");
        run_as_other_user("ln -s /mnt/prey /tmp/way && ln -s /mnt/new /tmp/dangling");
        for directory in ["way", "way/new", "way/new/deep", "dangling", "dangling/deep"] {
            for (place, path) in [("/", format!("/tmp/{directory}")), ("/tmp", directory.to_owned())] {
                let mut man = scanhub(0, &["man", &path]);
                man.current_dir(place);
                let outcome = Program::start(man).wait();
                assert_eq!(outcome.exit_code, Some(73), "{path}: {outcome}");
                assert!(outcome.stderr.contains(" is a link of user 65533"), "{path}: {outcome}");
            }
        }
        assert_eq!(fs::read_dir("/mnt/prey").expect("a readable directory").count(), 0);
        assert!(!fs::exists("/mnt/new").unwrap());
        // Inside a directory to which all users can write, the program creates new directories as usual.
        let outcome = run(&["man", "/tmp/pages/deep"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert!(fs::exists("/tmp/pages/deep/scanhub-run.1").unwrap());
    });
}

/// If a name contained only the process ID, another user could create a link with this name before the process starts.
#[test]
fn temporary_file_names_cannot_be_guessed() {
    with_another_user("symlink_attacks::temporary_file_names_cannot_be_guessed", || {
        prepare();
        // The program replaces the shell, and therefore has the shell's process ID, which is in the link's name.
        let planted = |name: &str, words: &str| {
            let link = format!("setpriv --reuid=65533 --clear-groups ln -s /mnt/victim /tmp/.{name}.$$");
            let mut shell = Command::new("sh");
            shell.args([
                "-c",
                &format!("{link} && test -L /tmp/.{name}.$$ && exec /mnt/scanhub {words} /tmp/{name}"),
            ]);
            let outcome = Program::start(shell).wait();
            assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        };
        planted("out.mcap", "convert /mnt/walk.log");
        planted("plan.svg", "site check /mnt/site.toml --svg");
        assert_eq!(fs::read_to_string(TARGET_FILE).expect("a readable file"), TARGET_CONTENT);
        for file in ["/tmp/out.mcap", "/tmp/plan.svg"] {
            let file = fs::symlink_metadata(file).expect("an output file");
            assert!(file.is_file() && file.uid() == 0);
        }
    });
}

/// After `sudo -E`, a variable in the environment of another user may name the state directory.
#[test]
fn state_directory_of_another_user_is_not_used() {
    with_another_user("symlink_attacks::state_directory_of_another_user_is_not_used", || {
        prepare();
        fs::create_dir("/mnt/prey").expect("a directory");
        // Each command creates a link at another level of the path that a program would open.
        let plant = [
            "mkdir -p /tmp/state/scanhub && ln -s /mnt/victim /tmp/state/scanhub/gateway-scanhub-lo-1",
            "rm -r /tmp/state/scanhub && ln -s /mnt/prey /tmp/state/scanhub",
            "rm /tmp/state/scanhub && mkdir /tmp/state/scanhub && ln -s /mnt/prey /tmp/state/scanhub/scanhub",
            "rm -r /tmp/state && ln -s /mnt/prey /tmp/state",
        ];
        for script in plant {
            run_as_other_user(script);
            let with_state = |words: &[&str]| -> Command {
                let mut command = scanhub(0, words);
                command.env("XDG_STATE_HOME", "/tmp/state");
                command
            };
            let gateway =
                Program::start(with_state(&["gateway", "--no-system-config", "--interface=lo"])).wait();
            assert_eq!(gateway.exit_code, Some(73), "{script}: {gateway}");
            assert!(gateway.stderr.contains("65533"), "the owner is named: {script}: {gateway}");
            let run = ["run", "--json", "--no-system-config", "--link=front=/mnt/no-port", "--root=/mnt/hub"];
            let hub = Program::start(with_state(&run)).ready();
            let hub = hub.end(TERM);
            assert!(hub.stderr.contains("nothing is kept across restarts: "), "{script}: {hub}");
            assert!(hub.stderr.contains("65533") && hub.stderr.contains("XDG_STATE_HOME"), "{script}: {hub}");
        }
        assert_eq!(fs::read_to_string(TARGET_FILE).expect("a readable file"), TARGET_CONTENT);
        assert_eq!(fs::read_dir("/mnt/prey").expect("a readable directory").count(), 0);
    });
}

#[test]
fn files_of_a_gateway_are_private() {
    with_another_user("symlink_attacks::files_of_a_gateway_are_private", || {
        fs::create_dir_all("/mnt/state/scanhub").expect("a directory");
        let file = "/mnt/state/scanhub/gateway-scanhub-lo-1";
        // Assume that an earlier version has left the file with a mode that lets all users write.
        fs::write(file, "").expect("a file");
        fs::set_permissions(file, Permissions::from_mode(0o666)).expect("permission to change the mode");
        let mut command = scanhub(0, &["gateway", "--json", "--no-system-config", "--interface=lo"]);
        command.env("XDG_STATE_HOME", "/mnt/state");
        let mut gateway = Program::start(command);
        gateway.await_line("the first line", is_class("gateway"));
        assert_eq!(fs::metadata(file).expect("a state file").mode() & 0o777, 0o600);
        gateway.end(INT);
    });
}

/// Another user cannot block a demo by creating the demo's usual directory.
#[test]
fn demo_runs_if_its_usual_directory_is_occupied() {
    with_another_user("symlink_attacks::demo_runs_if_its_usual_directory_is_occupied", || {
        run_as_other_user("mkdir -m 777 /tmp/scanhub-0");
        let mut demo = scanhub(0, &["demo", "--headless", "--json"]);
        demo.env("PATH", std::env::var_os("PATH").unwrap_or_default());
        // Without this variable, and if /run belongs to root, the demo usually takes the directory that the other user
        // has created.
        demo.env_remove("XDG_RUNTIME_DIR");
        let mut demo = Program::start(demo);
        let ready = demo.await_line("ready", is_class("ready"));
        let root = ready["root"].as_str().expect("a directory").to_owned();
        let list = || {
            run(&[
                "list",
                "--domain",
                ready["domain"].as_str().unwrap(),
                "--root",
                root.rsplit_once('/').unwrap().0,
            ])
        };
        wait_until("its sensors stream", || String::from_utf8_lossy(&list().stdout).contains("front/scan"));
        demo.end(INT);
        assert!(!fs::exists(&root).unwrap());
    });
}
