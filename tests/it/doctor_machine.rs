//! Machines that are broken on purpose, and one that is well: `scanhub doctor` finds what is wrong with each and names the
//! remedy, and has no complaint of the other. `--nocapture` shows them as a table. What an administrator may have
//! written is laid out below a directory of the test.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;

use crate::testkit::{
    Findings, KILL, Program, TERM, TestEnv, in_a_network, is_class, shared_memory, skip, succeeds,
    write_program,
};
use scanhub_config::Gateway;
use scanhub_shm::Domain;
use scanhub_tools::doctor::{Bridge, CheckTargets, System, run_checks};

/// `sh` with these words before the program, as `ulimit -f 100; exec`, and its arguments.
fn under(env: &TestEnv, words: &str, arguments: &[&str]) -> Command {
    let inner = env.command(&[&["doctor", "--json", "--no-system-config"], arguments].concat());
    let mut command = Command::new("sh");
    command
        .args(["-c", &format!("{words} && exec \"$@\""), "sh"])
        .arg(inner.get_program())
        .args(inner.get_args());
    command.env_remove("SCANHUB_CONFIG").env("SCANHUB_END_WITH_PARENT", "1");
    command
}

#[test]
fn a_set_up_that_is_well() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let flags = [env.link("front"), "--set=gateway.interface=lo".to_owned()];
    let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
    let examine = || {
        let findings = Findings::of(&env, &flags);
        // How this machine itself is set up no test can know.
        let not_of_the_machine = ["service", "udev", "logout"];
        assert!(not_of_the_machine.iter().all(|name| !findings.said(name).1.is_empty()));
        findings.without(&not_of_the_machine).are_silent();
        findings
    };
    let findings = examine();
    assert!(findings.said("version").1.contains(env!("CARGO_PKG_VERSION")), "{:?}", findings.said("version"));
    let hub = env.hub(&flags[..1]);
    env.await_info("front", |info| info["state"] == "streaming");
    assert!(examine().said("version").1.ends_with("the hub runs the same program"));
    assert_eq!(hub.end(TERM).code, Some(0));
    assert!(examine().said("leftovers").1.starts_with("none"), "an orderly end leaves nothing");
    well_kept(&env).are_silent();
}

/// A machine on which everything is installed, looked at by an ordinary user.
fn well_kept(env: &TestEnv) -> Findings {
    let machine = env.path("machine");
    let put = |path: &str, text: &str| {
        let path = machine.join(path);
        fs::create_dir_all(path.parent().expect("a directory")).expect("can be created");
        fs::write(path, text).expect("can be written");
    };
    let dist = |name: &str| {
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("hub/dist").join(name)).expect(name)
    };
    put("etc/passwd", "robot:x:1000:1000::/home/robot:/bin/sh\n");
    put("run/systemd/users/1000", "");
    put("var/lib/systemd/linger/robot", "");
    put("etc/udev/rules.d/60-scanhub.rules", &dist("60-scanhub.rules"));
    put("etc/systemd/system/scanhub.service", &dist("scanhub.service"));
    put("etc/systemd/system/multi-user.target.wants/scanhub.service", "");
    put("run/systemd/system/here", "");
    put("sys/fs/cgroup/system.slice/scanhub.service/cgroup.procs", "7\n");
    fs::create_dir_all(machine.join("usr/local/bin")).expect("can be created");
    let _ = symlink(crate::testkit::own_program(), machine.join("usr/local/bin/scanhub"));
    laid_out(env)
}

/// What is found on the machine below the environment's directory `machine`, for the user 1000.
fn laid_out(env: &TestEnv) -> Findings {
    // The ports of this machine are unknown to a test.
    with_ports(env).of_machine().without(&["ports", "multicast"])
}

/// All findings, including the ports of this machine and the adapters of the made-up one.
fn with_ports(env: &TestEnv) -> Findings {
    let targets = CheckTargets {
        ports: Vec::new(),
        config: None,
        gateway: Gateway { interface: Some("lo".to_owned()), ..Gateway::default() },
        domain: env.place(),
        places: Vec::new(),
        system: System::at(env.path("machine"), 1000),
        bridge: Bridge::default(),
        clean: false,
    };
    let mut lines = Vec::new();
    let mut tell = |finding: &scanhub_tools::doctor::Finding| {
        lines.push(serde_json::to_value(finding).expect("is JSON"))
    };
    let _ = run_checks(&targets, &AtomicBool::new(false), &mut tell);
    Findings::in_lines(lines)
}

#[test]
fn names_what_keeps_an_adapter_from_having_a_port() {
    let env = TestEnv::new();
    let put = |path: &str, text: &str| {
        let path = env.path("machine").join(path);
        fs::create_dir_all(path.parent().expect("a directory")).expect("can be created");
        fs::write(path, text).expect("can be written");
    };
    put("sys/bus/usb/devices/1-1/idVendor", "1a86\n");
    put("sys/bus/usb/devices/1-1/idProduct", "7523\n");
    let ports = || {
        let findings = with_ports(&env);
        // It is a failure only where this machine has no port to examine.
        let (state, finding) = findings.said("ports");
        assert!(["warning", "failed"].contains(&state), "{state}");
        (state.to_owned(), finding.to_owned(), findings)
    };
    let (state, finding, findings) = ports();
    assert!(
        finding.contains("(CH340, 1a86:7523) has no port: the kernel module ch341 is not loaded"),
        "{finding}"
    );
    findings.complain("an adapter without its module", "ports", &state, "sudo modprobe ch341");
    put("proc/812/comm", "brltty\n");
    let (state, finding, findings) = ports();
    assert!(finding.contains("brltty, process 812"), "{finding}");
    findings.complain("an adapter that brltty takes away", "ports", &state, "sudo apt remove brltty");
}

#[test]
fn what_an_administrator_may_have_left() {
    let env = TestEnv::new();
    well_kept(&env);
    let at = |path: &str| env.path("machine").join(path);
    let remove = |path: &str| fs::remove_file(at(path)).unwrap_or_else(|error| panic!("{path}: {error}"));
    remove("var/lib/systemd/linger/robot");
    laid_out(&env).complain(
        "logging out takes shared memory away",
        "logout",
        "warning",
        "enable-linger robot",
    );
    remove("sys/fs/cgroup/system.slice/scanhub.service/cgroup.procs");
    laid_out(&env).complain("the service does not run", "service", "failed", "systemctl status scanhub");
    remove("usr/local/bin/scanhub");
    laid_out(&env).complain("the service's program is gone", "service", "failed", "install.sh");
    write_program(at("usr/local/bin/scanhub"), "#!/bin/sh\necho scanhub 0.0.1\n");
    let stale = laid_out(&env);
    stale.complain("the service is of another version", "service", "warning", "restart scanhub");
    assert!(stale.said("service").1.contains("version 0.0.1"), "{:?}", stale.said("service"));
    fs::write(at("etc/udev/rules.d/60-scanhub.rules"), "# of a year ago\n").expect("can be written");
    laid_out(&env).complain("the udev rule is of another version", "udev", "warning", "install.sh");
}

#[test]
fn what_is_short() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let limited = |words| Findings::in_outcome(&Program::start(under(&env, words, &[&link])).wait());
    limited("ulimit -n 64").complain("descriptors are short", "descriptors", "failed", "LimitNOFILE=");
    limited("ulimit -n 128").complain(
        "descriptors for few consumers",
        "descriptors",
        "warning",
        "sudo prlimit --pid $$ --nofile=",
    );
    limited("ulimit -f 100").complain("files may not be long", "file-size", "failed", "ulimit -f unlimited");
    let unshare = ["unshare", "--mount", "--map-root-user"];
    let unshare = &unshare[..if rustix::process::getuid().is_root() { 2 } else { 3 }];
    let mounted = |options: &str, after: &str| {
        let mut command = Command::new(unshare[0]);
        let mount = format!("mount -t tmpfs -o {options} tmpfs /dev/shm && {after}");
        command.args(&unshare[1..]).args(["sh", "-c", &format!("{mount} && exec \"$@\""), "sh"]);
        command
    };
    if !succeeds(mounted("size=64k", "true").arg("true")) {
        skip("mounts", "this user may not make a mount namespace");
        return;
    }
    for (set_up, options, after, remedy) in [
        ("shared memory is small", "size=1m", "true", "--shm-size=64m"),
        ("shared memory is full", "size=16m", "head -c 15m /dev/zero > /dev/shm/fill", "free some"),
        ("shared memory has room for few files", "size=64m,nr_inodes=9", "true", "nr_inodes"),
        ("shared memory cannot be written to", "size=64m,ro", "true", "remount,rw"),
    ] {
        let inner = env.command(&["doctor", "--json", "--no-system-config", &link]);
        let mut command = mounted(options, after);
        command.arg(inner.get_program()).args(inner.get_args()).env("SCANHUB_END_WITH_PARENT", "1");
        let findings = Findings::in_outcome(&Program::start(command).wait());
        findings.complain(set_up, "memory", "failed", remedy);
    }
}

#[test]
fn what_is_wrong_with_the_domain() {
    let env = TestEnv::new();
    let root = env.place().root().to_owned();
    fs::create_dir(&root).expect("can be created");
    fs::set_permissions(&root, fs::Permissions::from_mode(0o777)).expect("it is ours");
    Findings::of(&env, &[]).complain("others may write in the domain", "domain", "failed", "chmod go-w");
    if std::os::unix::fs::chown(&root, Some(1), None).is_ok() {
        fs::set_permissions(&root, fs::Permissions::from_mode(0o700)).expect("root may");
        Findings::of(&env, &[]).complain("the domain is another user's", "domain", "failed", "run as user 1");
    } else {
        skip("root", "this user cannot give a directory away");
    }
    let nowhere = env.command_at(Path::new("/dev/null"), &["doctor", "--json", "--no-system-config"]);
    let findings = Findings::in_outcome(&Program::start(nowhere).wait());
    findings.complain("no domain can be created there", "domain", "failed", "--root");
}

#[test]
fn what_a_dead_hub_left_is_taken_away_and_a_living_ones_is_not() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let hub = env.hub(&[&link]);
    let before = env.left_behind();
    let alive = Findings::of(&env, &["--clean"]);
    assert!(alive.said("clean").0 == "skipped" && alive.said("clean").1.contains(&hub.pid().to_string()));
    assert!(before.iter().all(|path| path.exists()), "{before:?}");
    hub.end(KILL);
    Findings::of(&env, &[]).complain("a hub was killed", "leftovers", "warning", "doctor --clean");
    // A neighbour whose name begins alike, and one that is a hub of this name elsewhere.
    let (neighbour, other) = (TestEnv::new(), env.path("other"));
    let theirs = Program::start(env.command_at(&other, &["run", "--json", &link])).ready();
    let held = env.left_behind().len();
    let hub = neighbour.hub(&[&link]);
    let neighbours = neighbour.left_behind();
    let clean = Findings::of(&env, &["--clean"]);
    assert!(clean.said("clean").1.starts_with("removed what 1 process left"), "{:?}", clean.said("clean"));
    clean.without(&["multicast", "logout", "service", "udev", "port"]).of_machine().are_silent();
    assert!(!env.place().root().exists());
    let left = env.left_behind();
    assert!(left.len() < held && !left.is_empty(), "{left:?}");
    assert_eq!(neighbour.left_behind(), neighbours);
    // The other one is as it was: who comes now finds it.
    assert_eq!(theirs.end(TERM).code, Some(0));
    assert_eq!((env.left_behind().len(), hub.end(TERM).code), (0, Some(0)));
}

#[test]
fn who_waits_for_the_next_hub_keeps_what_it_has() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let link = env.link("front");
    let hub = env.hub(&[&link]);
    let mut consumer = env.echo(&["front/scan"]);
    consumer.await_line("a scan", is_class("scan"));
    hub.end(KILL);
    Findings::of(&env, &["--clean", "/dev/null"]);
    assert!(env.place().root().exists());
    let _hub = env.hub(&[&link]);
    let is_anew = |line: &serde_json::Value| line["class"] == "scan" && line["topic_seq"] == 0;
    consumer.await_line("a scan of the next hub", is_anew);
}

#[test]
fn files_without_a_domain_are_taken_away() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("absent")]);
    hub.end(KILL);
    fs::remove_dir_all(env.place().root()).expect("it is ours");
    let findings = Findings::of(&env, &[]);
    findings.complain("files of a domain that is gone", "leftovers", "warning", "doctor --clean");
    // Somebody still reads one of them.
    let files = env.left_behind();
    let held = fs::File::open(&files[0]).expect("it is ours");
    Findings::of(&env, &["--clean"]);
    assert_eq!(env.left_behind(), files[..1]);
    drop(held);
    Findings::of(&env, &["--clean"]);
    assert!(shared_memory(&env.place().prefix()).is_empty());
    assert_eq!(Findings::of(&env, &["--clean"]).said("clean").1, "nothing to remove");
}

#[test]
fn two_hubs_and_one_that_was_replaced() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let program = env.path("scanhub");
    // For the reason that `write_program` gives, another process writes it.
    let mut copy = Command::new("sh");
    copy.args(["-c", "cp \"$1\" \"$0\" && echo another build >> \"$0\""]).arg(&program);
    assert!(succeeds(copy.arg(env!("CARGO_BIN_EXE_scanhub"))), "can be copied");
    let run_at = |program: &Path, root: &Path| {
        let inner = env.command_at(root, &["run", "--json", "--no-system-config", &link]);
        let mut command = Command::new(program);
        command.args(inner.get_args()).env("SCANHUB_END_WITH_PARENT", "1").env_remove("SCANHUB_CONFIG");
        Program::start(command).ready()
    };
    let (service, user) = (env.path("a"), env.path("b/scanhub"));
    let _first = run_at(&program, &service);
    let _second = run_at(Path::new(env!("CARGO_BIN_EXE_scanhub")), &user);
    fs::remove_file(&program).expect("it is ours");
    let name = env.place().name().to_owned();
    let mut doctor = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    doctor.args(["doctor", "--json", "--no-system-config", "--domain", &name, &link]);
    doctor
        .env("RUNTIME_DIRECTORY", &service)
        .env("XDG_RUNTIME_DIR", env.path("b"))
        .env_remove("SCANHUB_CONFIG");
    let findings = Findings::in_outcome(&Program::start(doctor).wait());
    findings.complain("two hubs of one name", "hubs", "warning", "--domain");
    findings.complain("the hub's program was replaced", "version", "warning", "restart scanhub");
    assert!(
        Domain::at(&name, &user)
            .is_ok_and(|second| findings.said("hubs").1.contains(&second.root().display().to_string()))
    );
}

#[test]
fn no_way_to_the_network() {
    in_a_network("doctor_machine::no_way_to_the_network", || {
        let env = TestEnv::new();
        // Nobody named an interface: nothing goes to a network.
        assert_eq!(Findings::of(&env, &[]).said("multicast").0, "skipped");
        let interface = Findings::of(&env, &["--set", "gateway.interface=eth7"]);
        interface.complain("the gateway's interface is gone", "multicast", "failed", "there are lo");
    });
}
