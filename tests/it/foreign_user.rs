//! Attacks by another user of the same machine. An attack may make the hub and its clients refuse to run, with a
//! message that names the attacker, but it does no other harm. Each test has its own /tmp and /dev/shm. The hub and its
//! clients run as root, so no file permission would stop them from changing a wrong file. The attacker is not root.

use std::fs;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt, symlink};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit;
use crate::testkit::{INT, KILL, Outcome, Program, TERM, TestEnv, is_class, succeeds, wait_until};

/// Variable that is set in the process that runs in the new namespace.
const NAMESPACE_VARIABLE: &str = "SCANHUB_TEST_STRANGERS";
pub(crate) const OTHER_UID: u32 = 65533;
/// Content of a file of root, which no program may change.
const CONTENT: &str = "not a lock";

/// Runs `test`, whose name is `name`, in a namespace with its own /tmp and /dev/shm. Skips the test if the system does
/// not allow namespaces.
pub(crate) fn with_another_user(name: &str, test: impl FnOnce()) {
    if std::env::var_os(NAMESPACE_VARIABLE).is_some() {
        return test();
    }
    // The programs may be in a directory below /tmp, which the new /tmp hides. Copy them to /mnt first.
    let script = "mount -t tmpfs -o mode=755 none /mnt && cp \"$1\" /mnt/test && cp \"$2\" /mnt/scanhub \
                  && mount -t tmpfs -o mode=1777 none /tmp && mount -t tmpfs -o mode=1777 none /dev/shm";
    let unshare = |then: &str| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", &format!("{script} && {then}"), "sh"]);
        command.arg(testkit::own_program()).arg(env!("CARGO_BIN_EXE_scanhub"));
        command
    };
    let is_root = rustix::process::getuid().is_root();
    if !is_root || !succeeds(unshare("true")) {
        testkit::skip("root", "only root can start programs as another user, and it needs a mount namespace");
        return;
    }
    let mut inside = unshare(&format!("exec /mnt/test --exact {name} --nocapture"));
    inside.env(NAMESPACE_VARIABLE, "1").env(testkit::PROGRAM_PATH_VARIABLE, "/mnt/scanhub").current_dir("/");
    testkit::rerun_test(name, inside);
}

/// Returns a command that runs the program with only these arguments and a minimal environment, as this user.
pub(crate) fn scanhub(user: u32, arguments: &[&str]) -> Command {
    let mut command = Command::new("/mnt/scanhub");
    command.args(arguments).env_clear().env("SCANHUB_END_WITH_PARENT", "1").uid(user).gid(user);
    command
}

fn run(user: u32, arguments: &[&str]) -> Outcome {
    Program::start(scanhub(user, arguments)).wait()
}

/// Runs a line of shell as the other user. The line must succeed.
pub(crate) fn run_as_other_user(script: &str) {
    assert!(succeeds_as_other_user(script), "{script}");
}

/// Returns whether a line of shell succeeds as the other user.
fn succeeds_as_other_user(script: &str) -> bool {
    let mut shell = Command::new("sh");
    shell.args(["-c", script]).uid(OTHER_UID).gid(OTHER_UID).current_dir("/tmp");
    succeeds(shell)
}

/// Creates a private directory of root with files that `doctor --clean` removes from a domain.
fn create_victim_directory() -> PathBuf {
    let prey = PathBuf::from("/tmp/prey");
    fs::DirBuilder::new().mode(0o700).create(&prey).expect("a directory");
    fs::create_dir(prey.join("empty")).expect("a directory");
    for file in ["hub.lock", "listen.lock", "front.sensor", "prefix", "letter"] {
        fs::write(prey.join(file), CONTENT).expect("a file");
    }
    prey
}

fn check_untouched(target: &Path) {
    let mut names: Vec<_> = fs::read_dir(target)
        .expect("the directory exists")
        .map(|it| it.expect("a name").file_name())
        .collect();
    names.sort();
    assert_eq!(names, ["empty", "front.sensor", "hub.lock", "letter", "listen.lock", "prefix"]);
    for file in names.iter().filter(|name| *name != "empty") {
        assert_eq!(fs::read_to_string(target.join(file)).expect("a file"), CONTENT, "{file:?}");
    }
}

/// Asserts that hub, clients and `doctor` fail with a message that contains all of `words`, and that they do not change
/// the files in `target`.
fn check_all_refuse(target: &Path, base: &[&str], words: &[&str]) {
    for verb in [
        &["run", "--no-system-config", "--link=front=/tmp/no-port"][..],
        &["doctor", "--clean", "--no-system-config"],
        &["list"],
        &["echo", "front/scan", "--for=1s"],
    ] {
        let outcome = run(0, &[verb, base].concat());
        let output_text = format!("{}{}", outcome.stderr, String::from_utf8_lossy(&outcome.stdout));
        assert!(matches!(outcome.exit_code, Some(1 | 3 | 5)), "{verb:?}: {outcome}");
        for word in words {
            assert!(output_text.contains(word), "{verb:?} does not print {word:?}: {outcome}");
        }
        check_untouched(target);
    }
}

#[test]
fn fallback_directory_of_another_user_is_refused() {
    with_another_user("foreign_user::fallback_directory_of_another_user_is_refused", || {
        let prey = create_victim_directory();
        run_as_other_user("mkdir /tmp/scanhub-0 && ln -s /tmp/prey /tmp/scanhub-0/scanhub");
        check_all_refuse(&prey, &[], &["/tmp/scanhub-0", "belongs to user 65533"]);
        run_as_other_user("rm -r /tmp/scanhub-0 && ln -s /tmp/prey /tmp/scanhub-0");
        check_all_refuse(&prey, &[], &["/tmp/scanhub-0", "is a link"]);
        // The domain itself belongs to root, but the owner of the parent directory could replace it.
        run_as_other_user("rm /tmp/scanhub-0 && mkdir -m 777 /tmp/scanhub-0");
        fs::DirBuilder::new().mode(0o700).create("/tmp/scanhub-0/scanhub").expect("a domain");
        check_all_refuse(&prey, &[], &["/tmp/scanhub-0", "belongs to user 65533"]);
    });
}

#[test]
fn links_in_a_domain_and_its_parents_are_refused() {
    with_another_user("foreign_user::links_in_a_domain_and_its_parents_are_refused", || {
        let prey = create_victim_directory();
        let base = Path::new("/tmp/base");
        fs::DirBuilder::new().mode(0o700).create(base).expect("the directory can be created");
        fs::create_dir(base.join("scanhub")).expect("a domain");
        let mode = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).expect("root can change the mode")
        };
        mode(&base.join("scanhub"), 0o777);
        mode(base, 0o755);
        run_as_other_user("ln -s /tmp/prey/letter /tmp/base/scanhub/hub.lock");
        check_all_refuse(&prey, &["--root=/tmp/base"], &["/tmp/base/scanhub", "mode 0777", "chmod go-w"]);
        mode(&base.join("scanhub"), 0o700);
        check_all_refuse(&prey, &["--root=/tmp/base"], &["/tmp/base/scanhub/hub.lock", "is a link"]);
        fs::remove_file(base.join("scanhub/hub.lock")).expect("root can remove the file");
        // A symlink above the base directory is followed only if it belongs to root and only root can write to its
        // directory. In /tmp, no symlink is followed.
        run_as_other_user("ln -s /tmp/base /tmp/way");
        check_all_refuse(&prey, &["--root=/tmp/way/b"], &["/tmp/way", "is a link of user 65533"]);
        symlink(base, "/mnt/way").expect("root can create a link");
        let domain =
            scanhub(0, &["run", "--json", "--no-system-config", "--link=front=/tmp/no", "--root=/mnt/way/b"]);
        let hub = Program::start(domain).ready();
        assert!(base.join("b/scanhub/hub.lock").exists());
        assert_eq!(hub.end(INT).exit_code, Some(0));
    });
}

/// Returns the shared-memory segments of the domain of `env`, sorted by path.
fn segments(env: &TestEnv) -> Vec<PathBuf> {
    let mut paths = testkit::shared_memory(&env.domain().prefix());
    paths.sort();
    paths
}

/// Returns everything that another user may do with `path` but should not. This is the mode of `path` if it is not
/// private, and each attack that succeeded.
fn allowed_attacks(path: &Path) -> Vec<String> {
    let mode = fs::metadata(path).map_or(0, |metadata| metadata.mode() & 0o077);
    let path = path.display();
    let attacks = [
        format!("echo x > {path}"),
        format!("cat {path}"),
        format!("truncate -s 0 {path}"),
        format!("rm -f {path}"),
        format!("mv {path} /dev/shm/other"),
    ];
    let attacks = attacks.map(|attack| format!("[ -e {path} ] && {attack}"));
    let mode = (mode != 0).then(|| format!("{path} has mode {mode:03o}"));
    mode.into_iter().chain(attacks.into_iter().filter(|attack| succeeds_as_other_user(attack))).collect()
}

#[test]
fn foreign_shared_memory_does_not_disturb_the_hub() {
    with_another_user("foreign_user::foreign_shared_memory_does_not_disturb_the_hub", || {
        // Without a random prefix, the domain would use this name for its doorbell.
        run_as_other_user("touch /dev/shm/sh_scanhub_front.bell");
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], &["--baud=500000"]);
        let hub = env.hub(&[env.link("front")]);
        let mut subscriber = env.echo(&["front/scan"]);
        let mut allowed = Vec::new();
        // The hub removes the segments of an exited subscriber while it publishes the next scans. This may change the
        // list of segments during the attacks, so they are repeated.
        wait_until("the attacks change nothing", || {
            let own = segments(&env);
            subscriber.await_lines(10, "a scan", is_class("scan"));
            assert!(own.iter().any(|path| path.to_string_lossy().ends_with(".global_mgmt")), "{own:?}");
            allowed = own.iter().flat_map(|path| allowed_attacks(path)).collect();
            own == segments(&env)
        });
        assert!(allowed.is_empty(), "{allowed:?}");
        // The prefix is not secret, because every user can see the names of the segments. Useless files with this
        // prefix do no harm.
        let prefix =
            fs::read_to_string(env.domain().root().join("prefix")).expect("the hub has written its prefix");
        let prefix = prefix.trim_end();
        run_as_other_user(&format!(
            "touch /dev/shm/{prefix}anything; ln -s /mnt/letter /dev/shm/{prefix}link"
        ));
        fs::write("/mnt/letter", CONTENT).expect("a file");
        let mut second = env.echo(&["front/zones"]);
        second.await_line("a verdict", is_class("zones"));
        let doctor = env.run(&["doctor", "--json", "--no-system-config"]);
        let finding =
            doctor.lines().into_iter().find(|line| line["name"] == "foreign-files").expect("a finding");
        let text = finding.to_string();
        assert!(text.contains(&format!("{prefix}anything")) && text.contains("65533"), "{text}");

        // The hub removes its doorbell when it exits. The waiting subscriber keeps the prefix in use, so another user
        // can create a file with the name of the next hub's doorbell.
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        run_as_other_user(&format!("mkfifo /dev/shm/{prefix}front.bell"));
        let refused = env.run(&["run", "--no-system-config", &env.link("front")]);
        assert_eq!(refused.exit_code, Some(1), "{refused}");
        for word in [&format!("{prefix}front.bell belongs to user 65533"), "sudo rm"] {
            assert!(refused.stderr.contains(word), "{word}: {refused}");
        }
        run_as_other_user(&format!("rm /dev/shm/{prefix}front.bell"));
        let hub = env.hub(&[env.link("front")]);
        subscriber.await_line("the next hub", |line| line["kind"] == "hub_back");
        subscriber.await_line("a scan", is_class("scan"));
        // A killed hub leaves all of its files. The next hub must start in spite of them.
        assert_eq!(hub.end(KILL).exit_code, None);
        let hub = env.hub(&[env.link("front")]);
        subscriber.await_line("the third hub", |line| line["kind"] == "hub_back");
        subscriber.await_line("a scan", is_class("scan"));
        for program in [subscriber, second, hub] {
            assert_eq!(program.end(INT).exit_code, Some(0));
        }
        // After the last program has exited, only the files of the other user remain, and nothing was written to them.
        assert_eq!(
            segments(&env),
            [format!("/dev/shm/{prefix}anything"), format!("/dev/shm/{prefix}link")].map(PathBuf::from)
        );
        assert_eq!(fs::read_to_string("/mnt/letter").expect("a file"), CONTENT);
        let next = env.hub(&[env.link("front")]);
        let others =
            fs::read_to_string(env.domain().root().join("prefix")).expect("the hub has written its prefix");
        assert_ne!(others.trim_end(), prefix);
        assert_eq!((next.end(INT).exit_code, simulator.end(INT).exit_code), (Some(0), Some(0)));
    });
}

#[test]
fn hub_of_another_user_is_reported_with_a_remedy() {
    with_another_user("foreign_user::hub_of_another_user_is_reported_with_a_remedy", || {
        run_as_other_user("mkdir -m 755 /tmp/theirs");
        let arguments = ["run", "--json", "--no-system-config", "--link=front=/tmp/no", "--root=/tmp/theirs"];
        let hub = Program::start(scanhub(OTHER_UID, &arguments)).ready();
        for doorbell in testkit::shared_memory("sh_scanhub_")
            .iter()
            .filter(|path| path.extension().is_some_and(|it| it == "bell"))
        {
            fs::remove_file(doorbell).expect("root is permitted");
        }
        for verb in [
            &["list"][..],
            &["info", "front"],
            &["echo", "front/status", "--for=1s"],
            &["zones", "front", "mask"],
        ] {
            let outcome = run(0, &[verb, &["--root=/tmp/theirs"]].concat());
            assert_eq!(outcome.exit_code, Some(3), "{outcome}");
            for word in ["belongs to user 65533", "gateway --interface lo", "listen --publish"] {
                assert!(outcome.stderr.contains(word), "{word}: {outcome}");
            }
        }
        let outcome_of_owner = run(OTHER_UID, &["list", "--root=/tmp/theirs"]);
        assert_eq!(outcome_of_owner.exit_code, Some(0), "{outcome_of_owner}");
        assert_eq!(hub.end(INT).exit_code, Some(0));
        wait_until("shared memory is removed", || testkit::shared_memory("sh_scanhub_").is_empty());
    });
}
