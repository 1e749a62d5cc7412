//! Tests of docs/sharing.md: a hub that runs as one user, and subscribers that run as another user. Each test has its
//! own network, /run, /tmp and /dev/shm.

use std::fs;
use std::os::unix::fs::{DirBuilderExt, chown};
use std::os::unix::process::CommandExt;
use std::process::Command;

use crate::testkit;
use crate::testkit::{INT, Program, TERM, is_class, number, succeeds, wait_until};
use serde_json::{Value, json};

const SHARING_PAGE: &str = include_str!("../../docs/sharing.md");
/// Variable that is set when the test runs again inside the namespaces.
const NAMESPACE_VARIABLE: &str = "SCANHUB_TEST_SHARING";
/// User IDs of the tests. No user with such an ID needs to exist on the system.
const HUB_UID: u32 = 65531;
const OTHER_UID: u32 = 65532;

/// Runs `test`, which is called `name`, in new namespaces as root. Skips the test if the system does not allow this.
fn in_namespace(name: &str, test: impl FnOnce()) {
    if std::env::var_os(NAMESPACE_VARIABLE).is_some() {
        return test();
    }
    // The mount on /tmp may hide the programs, so copy them to /mnt first.
    let script = "ip link set lo up && mount -t tmpfs -o mode=755 none /mnt && cp \"$1\" /mnt/test && cp \"$2\" /mnt/scanhub \
                  && mount -t tmpfs -o mode=755 none /run && mount -t tmpfs -o mode=1777 none /tmp \
                  && mount -t tmpfs -o mode=1777 none /dev/shm";
    let unshare = |then: &str| {
        let mut command = Command::new("unshare");
        command.args(["--net", "--mount", "sh", "-c", &format!("{script} && {then}"), "sh"]);
        command.arg(testkit::own_program()).arg(env!("CARGO_BIN_EXE_scanhub"));
        command
    };
    let is_root = rustix::process::getuid().is_root();
    if !is_root || !succeeds(unshare("true")) {
        testkit::skip("root", "only root can be two users, and needs namespaces and `ip` for it");
        return;
    }
    let mut inside = unshare(&format!("exec /mnt/test --exact {name} --nocapture"));
    inside.env(NAMESPACE_VARIABLE, "1").current_dir("/");
    testkit::rerun_test(name, inside);
}

/// Creates a directory at `path` that only `user` can access.
fn create_directory_of(user: u32, path: &str) {
    fs::DirBuilder::new().recursive(true).mode(0o700).create(path).expect("a directory");
    chown(path, Some(user), Some(user)).expect("permission of root");
}

/// Returns a command that runs the program in the environment of a login session of `user`. If `user` is the hub's
/// user, the command also has the environment of the hub's service.
fn scanhub(user: u32, arguments: &[&str]) -> Command {
    let mut command = Command::new("/mnt/scanhub");
    command.args(arguments).env_clear().env("SCANHUB_END_WITH_PARENT", "1").current_dir("/");
    command.env("XDG_RUNTIME_DIR", format!("/run/user/{user}")).env("HOME", format!("/tmp/{user}"));
    if user == HUB_UID {
        command.env("RUNTIME_DIRECTORY", "/run/scanhub");
    }
    command.uid(user).gid(user);
    command
}

fn start(user: u32, arguments: &[&str]) -> Program {
    Program::start(scanhub(user, arguments))
}

/// Returns the arguments of a command line on the page. This is the line that equals `begin`, or else the first line
/// that starts with `begin`.
fn arguments_on_page(begin: &str) -> Vec<&'static str> {
    let find = |is_it: &dyn Fn(&str) -> bool| SHARING_PAGE.lines().find(|line| is_it(line));
    let line = find(&|line| line == begin).or_else(|| find(&|line| line.starts_with(begin)));
    line.unwrap_or_else(|| panic!("no line {begin:?}")).split(' ').skip(1).collect()
}

/// Does the same as [`arguments_on_page`], but replaces the ID on the page by `hub`, and appends `--json`.
fn arguments_with_hub(begin: &str, hub: &str) -> Vec<String> {
    let words = arguments_on_page(begin).into_iter().map(|word| word.replace("5f3a12bc00d1e2f3", hub));
    words.chain(["--json".to_owned()]).collect()
}

fn words(texts: &[String]) -> Vec<&str> {
    texts.iter().map(String::as_str).collect()
}

#[test]
fn commands_of_the_page_work_for_another_user() {
    in_namespace("sharing::commands_of_the_page_work_for_another_user", || {
        fs::create_dir("/run/user").expect("an empty /run");
        create_directory_of(HUB_UID, "/run/scanhub");
        for user in [HUB_UID, OTHER_UID] {
            create_directory_of(user, &format!("/run/user/{user}"));
            create_directory_of(user, &format!("/tmp/{user}"));
        }
        let port = format!("/tmp/{HUB_UID}/front");
        let port_flag = format!("--port={port}");
        let _simulator =
            start(HUB_UID, &["simulate", "--json", &port_flag, "--seed=61", "--baud=500000"]).ready();
        let link = format!("--link=front={port}");
        let _hub = start(HUB_UID, &["run", "--json", &link]).ready();
        // Without the listener, the other user cannot receive from the hub, because this user cannot access the hub's
        // memory.
        let alone = start(OTHER_UID, &["echo", "front/scan", "--json", "-n", "1"]).wait();
        assert_ne!(alone.exit_code, Some(0), "{alone}");

        let mut gateway = start(HUB_UID, &[&arguments_on_page("scanhub gateway")[..], &["--json"]].concat());
        let begin = gateway.await_line("the first line", is_class("gateway"));
        let hub = begin["hub"].as_str().unwrap_or_default().to_owned();
        let mut listener =
            start(OTHER_UID, &words(&arguments_with_hub("scanhub listen --publish --interface lo", &hub)))
                .ready();
        let published = listener.await_line("a sensor", |line| line["kind"] == "published");
        assert_eq!(published["sensor"], json!(format!("{hub}.front")));
        let listed = start(OTHER_UID, &words(&arguments_with_hub("scanhub list", &hub))).wait();
        let is_scan = |line: &&Value| line["class"] == "topic" && line["topic"] == "scan";
        assert!(listed.lines().iter().any(|line| is_scan(&line)), "{listed}");
        let mut there = start(HUB_UID, &["echo", "front/scan", "--json"]);
        there.await_line("a scan", is_class("scan"));
        let mut echo = start(OTHER_UID, &words(&arguments_with_hub("scanhub echo 5f3a", &hub)));
        let scan = echo.await_lines(40, "scans", is_class("scan")).pop().expect("forty scans");
        let same = there.await_line("the same scan", |line| line["seq"] == scan["seq"]);
        assert_eq!((&scan["ranges"], &scan["wall_ns"]), (&same["ranges"], &same["wall_ns"]));
        drop(there.end(INT));
        let echoed = echo.end(INT);
        assert_eq!(
            (echoed.exit_code, number(&echoed.of_class("summary")[0], "missed")),
            (Some(0), 0),
            "{echoed}"
        );
        assert_eq!(listener.end(TERM).exit_code, Some(0));

        // This listener publishes the sensors of the hub under a given name.
        let named = arguments_with_hub("scanhub listen --publish --interface lo --name", &hub);
        let listener = start(OTHER_UID, &words(&named)).ready();
        wait_until("the name is there", || {
            let outcome = start(OTHER_UID, &["list", "--json"]).wait();
            outcome.of_class("topic").iter().any(|line| line["sensor"] == "here.front")
        });
        let echoed =
            start(OTHER_UID, &[&arguments_on_page("scanhub echo here")[..], &["--json", "-n", "3"]].concat())
                .wait();
        assert_eq!((echoed.exit_code, echoed.of_class("scan").len()), (Some(0), 3), "{echoed}");
        assert_eq!(listener.end(TERM).exit_code, Some(0));
        assert_eq!(gateway.end(TERM).exit_code, Some(0));
    });
}

/// Domain of the hubs that [`reports_the_user_of_a_running_hub`] starts. The name is unique, because hubs of other
/// tests are visible in /proc, too.
const DOMAIN_FLAG: &str = "--domain=whose";

/// Starts the program as `sudo` does, without the environment variables of a login session.
fn by_sudo(user: u32, arguments: &[&str]) -> Program {
    let mut command = scanhub(user, arguments);
    command.env_remove("XDG_RUNTIME_DIR").env_remove("RUNTIME_DIRECTORY");
    Program::start(command)
}

/// Asserts that verbs that `caller` starts find no hub and suggest a command. Asserts that this command, run as
/// `owner`, lists the topics of `hub`, which belongs to `owner`.
fn assert_suggestion_works(caller: &dyn Fn(&[&str]) -> Program, owner: u32, hub: &Program) {
    let sudo = if owner == 0 { "sudo".to_owned() } else { format!("sudo -u '#{owner}'") };
    let suggested = format!("process {}: {sudo} /mnt/scanhub ", hub.pid());
    for verb in [&["list"][..], &["info"], &["control", "front", "pause"], &["echo", "front/scan", "-n", "1"]]
    {
        let outcome = caller(&[verb, &[DOMAIN_FLAG]].concat()).wait();
        assert_eq!(outcome.exit_code, Some(3), "{outcome}");
        assert!(outcome.stderr.contains("no hub of this user in domain whose"), "{outcome}");
        let rest = outcome.stderr.split(&suggested).nth(1).and_then(|rest| rest.split(';').next());
        let words: Vec<&str> = rest.unwrap_or_else(|| panic!("{suggested}: {outcome}")).split(' ').collect();
        let listed = by_sudo(owner, &words).wait();
        assert!(
            listed.exit_code == Some(0) && listed.to_string().contains("front/scan"),
            "{words:?}: {listed}"
        );
    }
    // A verb that waits for a hub suggests the command, too.
    let mut echo = caller(&["echo", "front/scan", "--json", DOMAIN_FLAG]);
    let notice = echo.await_line("no hub", |line| line["kind"] == "hub_gone");
    assert!(notice["hint"].as_str().is_some_and(|hint| hint.contains(&suggested)), "{notice}");
    assert_eq!(echo.end(INT).exit_code, Some(0));
}

#[test]
fn reports_the_user_of_a_running_hub() {
    in_namespace("sharing::reports_the_user_of_a_running_hub", || {
        fs::create_dir("/run/user").expect("an empty /run");
        create_directory_of(HUB_UID, "/run/scanhub");
        for user in [HUB_UID, OTHER_UID] {
            create_directory_of(user, &format!("/run/user/{user}"));
            create_directory_of(user, &format!("/tmp/{user}"));
        }
        let run = ["run", "--json", "--no-system-config", "--link=front=tcp:127.0.0.1:9", DOMAIN_FLAG];
        let other = |arguments: &[&str]| start(OTHER_UID, arguments);
        let root = |arguments: &[&str]| by_sudo(0, arguments);

        let service = start(HUB_UID, &run).ready();
        assert_suggestion_works(&other, HUB_UID, &service);
        assert_eq!(service.end(TERM).exit_code, Some(0));

        let of_root = by_sudo(0, &run).ready();
        assert_suggestion_works(&other, 0, &of_root);
        assert_eq!(of_root.end(TERM).exit_code, Some(0));

        let of_session = start(OTHER_UID, &run).ready();
        assert_suggestion_works(&root, OTHER_UID, &of_session);
        assert_eq!(of_session.end(TERM).exit_code, Some(0));

        // Other users cannot read the variables of a process, so they cannot see the domain of this hub, which is only
        // in SCANHUB_DOMAIN.
        let mut command = scanhub(0, &run[..run.len() - 1]);
        command.env_remove("XDG_RUNTIME_DIR").env("SCANHUB_DOMAIN", "whose");
        let of_variable = Program::start(command).ready();
        let pid = of_variable.pid();
        let outcome = other(&["list", DOMAIN_FLAG]).wait();
        assert!(
            outcome.exit_code == Some(3) && outcome.stderr.contains("in an unknown domain, process "),
            "{outcome}"
        );
        let listed = by_sudo(0, &["list", "--domains", "--json"]).wait();
        let is_it = |line: &&Value| line["pid"] == json!(pid);
        assert!(
            listed.of_class("domain").iter().any(|line| line["domain"] == "whose" && is_it(&line)),
            "{listed}"
        );
        let listed = other(&["list", "--domains", "--json"]).wait();
        let unreachable = listed.of_class("unreachable");
        let line = unreachable.iter().find(is_it).expect("a line");
        let remedy = json!("sudo /mnt/scanhub list --domains");
        assert_eq!(
            (&line["domain"], &line["user"], &line["remedy"]),
            (&Value::Null, &json!("root"), &remedy)
        );
        // The web server prints in its terminal that the hub belongs to another user.
        let mut web = other(&["web", "--listen", "127.0.0.1:0", DOMAIN_FLAG]);
        web.wait_for_text("no hub of this user in domain whose");
        assert_eq!(web.end(TERM).exit_code, Some(0));
        assert_eq!(of_variable.end(TERM).exit_code, Some(0));

        // If a hub of the same user is in another directory, it is listed.
        let below = start(OTHER_UID, &[&run[..], &["--root", &format!("/tmp/{OTHER_UID}")]].concat()).ready();
        let listed = other(&["list", "--domains", "--json"]).wait();
        let root = json!(format!("/tmp/{OTHER_UID}/whose"));
        assert!(listed.of_class("domain").iter().any(|line| line["root"] == root), "{listed}");
        assert_eq!(below.end(TERM).exit_code, Some(0));
    });
}

/// The page has a configuration for a service, which must be valid for a gateway.
#[test]
fn configuration_on_the_page_is_valid() {
    let block =
        SHARING_PAGE.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a block");
    let env = testkit::TestEnv::new();
    let file = env.file("scanhub.toml", block);
    let shown = env.run(&[
        "config",
        "show",
        "--json",
        "--no-system-config",
        "--link=front=/dev/x",
        &format!("--config={file}"),
    ]);
    let is_it = |line: &Value| line["key"] == "gateway.interface" && line["value"] == "lo";
    assert!(shown.lines().iter().any(is_it), "{shown}");
}

/// Runs the three commands of docs/tilt.md in the order of the page, in which the mount publishes before a hub runs.
#[test]
fn mount_and_hub_share_a_domain_in_either_order() {
    in_namespace("sharing::mount_and_hub_share_a_domain_in_either_order", || {
        fs::create_dir("/run/user").expect("an empty /run");
        for user in [0, OTHER_UID] {
            create_directory_of(user, &format!("/run/user/{user}"));
            create_directory_of(user, &format!("/tmp/{user}"));
        }
        for (user, has_session) in [(0, true), (0, false), (OTHER_UID, true), (OTHER_UID, false)] {
            let start: fn(u32, &[&str]) -> Program = if has_session { start } else { by_sudo };
            let port = format!("/tmp/{user}/lms");
            let port_flag = format!("--port={port}");
            let simulate =
                ["simulate", "--json", &port_flag, "--world=tilt", "--angles=mount", "--baud=500000"];
            let simulator = start(user, &simulate).ready();
            let run = ["run", "--json", "--no-system-config", &format!("--link=front={port}")];
            let hub = start(user, &run).ready();
            let mut tilt = start(
                user,
                &[
                    "tilt",
                    "front",
                    "--angles=mount",
                    "--axis-at=0,0,0.9",
                    "--sensor-at=0.06,0,0.94",
                    "--json",
                ],
            );
            tilt.await_line("a sweep", is_class("obstacles"));
            assert!(!fs::exists("/run/scanhub").expect("/run can be read"), "a service's place is not ours");
            assert_eq!((tilt.end(INT).exit_code, hub.end(INT).exit_code), (Some(0), Some(0)));
            // After the hub has exited, the mount still publishes in its directory, and the next hub uses the same
            // directory.
            let hub = start(user, &run).ready();
            let mut echo = start(user, &["echo", "mount/tilt", "--json"]);
            echo.await_line("an angle", is_class("tilt"));
            assert_eq!((echo.end(INT).exit_code, hub.end(INT).exit_code), (Some(0), Some(0)));
            assert_eq!(simulator.end(INT).exit_code, Some(0));
            assert_eq!(testkit::shared_memory("sh_scanhub_"), Vec::<std::path::PathBuf>::new());
        }
    });
}
