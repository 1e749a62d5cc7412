//! Machines with faults, and a healthy machine. `scanhub doctor` finds each fault and names the remedy, and reports no
//! problem on the healthy machine. With `--nocapture`, the tests print the faults as a table. The tests write the
//! system files that an administrator may have written into their own directory.

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

/// Returns a command in which `sh` runs `doctor` after the words `words`, such as `ulimit -f 100; exec`.
fn command_under(env: &TestEnv, words: &str, arguments: &[&str]) -> Command {
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
fn doctor_has_no_findings_on_a_healthy_machine() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let flags = [env.link("front"), "--set=gateway.interface=lo".to_owned()];
    let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
    let examine = || {
        let findings = Findings::of(&env, &flags);
        // Leave out the checks whose result depends on the setup of the machine on which the test runs.
        let not_of_the_machine = ["service", "udev", "logout"];
        assert!(not_of_the_machine.iter().all(|name| !findings.state_and_text(name).1.is_empty()));
        findings.without(&not_of_the_machine).assert_no_problem();
        findings
    };
    let findings = examine();
    assert!(
        findings.state_and_text("version").1.contains(env!("CARGO_PKG_VERSION")),
        "{:?}",
        findings.state_and_text("version")
    );
    let hub = env.hub(&flags[..1]);
    env.await_info("front", |info| info["state"] == "streaming");
    assert!(examine().state_and_text("version").1.ends_with("the hub runs the same program"));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert!(examine().state_and_text("leftovers").1.starts_with("none"), "files remain after a normal exit");
    healthy_machine(&env).assert_no_problem();
}

/// Creates the system files of a machine on which everything is installed, and returns the findings for an ordinary
/// user.
fn healthy_machine(env: &TestEnv) -> Findings {
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
    healthy_layout(env)
}

/// Returns the findings for user 1000 on the machine in the environment's directory `machine`.
fn healthy_layout(env: &TestEnv) -> Findings {
    // Leave out findings about the ports of the machine on which the test runs. Tests differ in these ports.
    port_findings(env).without_ports().without(&["ports", "multicast"])
}

/// Returns all findings, including those about ports of the real machine and about adapters of the simulated machine.
fn port_findings(env: &TestEnv) -> Findings {
    let targets = CheckTargets {
        ports: Vec::new(),
        config: None,
        gateway: Gateway { interface: Some("lo".to_owned()), ..Gateway::default() },
        domain: env.domain(),
        locations: Vec::new(),
        system: System::at(env.path("machine"), 1000),
        bridge: Bridge::default(),
        clean: false,
    };
    let mut lines = Vec::new();
    let mut add_finding = |finding: &scanhub_tools::doctor::Finding| {
        lines.push(serde_json::to_value(finding).expect("a finding can be written as JSON"))
    };
    let _ = run_checks(&targets, &AtomicBool::new(false), &mut add_finding);
    Findings::in_lines(lines)
}

#[test]
fn reports_missing_module_and_brltty_for_an_adapter() {
    let env = TestEnv::new();
    let put = |path: &str, text: &str| {
        let path = env.path("machine").join(path);
        fs::create_dir_all(path.parent().expect("a directory")).expect("can be created");
        fs::write(path, text).expect("can be written");
    };
    put("sys/bus/usb/devices/1-1/idVendor", "1a86\n");
    put("sys/bus/usb/devices/1-1/idProduct", "7523\n");
    let ports = || {
        let findings = port_findings(&env);
        // The state is `failed` only if the real machine has no port to examine, and `warning` otherwise.
        let (state, finding) = findings.state_and_text("ports");
        assert!(["warning", "failed"].contains(&state), "{state}");
        (state.to_owned(), finding.to_owned(), findings)
    };
    let (state, finding, findings) = ports();
    assert!(
        finding.contains("(CH340, 1a86:7523) has no port: the kernel module ch341 is not loaded"),
        "{finding}"
    );
    findings.assert_problem("an adapter without its module", "ports", &state, "sudo modprobe ch341");
    put("proc/812/comm", "brltty\n");
    let (state, finding, findings) = ports();
    assert!(finding.contains("brltty, process 812"), "{finding}");
    findings.assert_problem("an adapter that brltty takes away", "ports", &state, "sudo apt remove brltty");
}

#[test]
fn finds_faults_of_service_and_udev_rule() {
    let env = TestEnv::new();
    healthy_machine(&env);
    let at = |path: &str| env.path("machine").join(path);
    let remove = |path: &str| fs::remove_file(at(path)).unwrap_or_else(|error| panic!("{path}: {error}"));
    remove("var/lib/systemd/linger/robot");
    healthy_layout(&env).assert_problem(
        "logging out removes shared memory",
        "logout",
        "warning",
        "enable-linger robot",
    );
    remove("sys/fs/cgroup/system.slice/scanhub.service/cgroup.procs");
    healthy_layout(&env).assert_problem(
        "the service does not run",
        "service",
        "failed",
        "systemctl status scanhub",
    );
    remove("usr/local/bin/scanhub");
    healthy_layout(&env).assert_problem(
        "the service's program does not exist",
        "service",
        "failed",
        "install.sh",
    );
    write_program(at("usr/local/bin/scanhub"), "#!/bin/sh\necho scanhub 0.0.1\n");
    let stale = healthy_layout(&env);
    stale.assert_problem("the service has another version", "service", "warning", "restart scanhub");
    assert!(
        stale.state_and_text("service").1.contains("version 0.0.1"),
        "{:?}",
        stale.state_and_text("service")
    );
    fs::write(at("etc/udev/rules.d/60-scanhub.rules"), "# of a year ago\n").expect("can be written");
    healthy_layout(&env).assert_problem("the udev rule has another version", "udev", "warning", "install.sh");
}

#[test]
fn finds_resource_shortages() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let limited = |words| Findings::in_outcome(&Program::start(command_under(&env, words, &[&link])).wait());
    limited("ulimit -n 64").assert_problem("descriptors are short", "descriptors", "failed", "LimitNOFILE=");
    limited("ulimit -n 128").assert_problem(
        "descriptors for few subscribers",
        "descriptors",
        "warning",
        "sudo prlimit --pid $$ --nofile=",
    );
    limited("ulimit -f 100").assert_problem(
        "the length of files is limited",
        "file-size",
        "failed",
        "ulimit -f unlimited",
    );
    let unshare = ["unshare", "--mount", "--map-root-user"];
    let unshare = &unshare[..if rustix::process::getuid().is_root() { 2 } else { 3 }];
    let mounted = |options: &str, after: &str| {
        let mut command = Command::new(unshare[0]);
        let mount = format!("mount -t tmpfs -o {options} tmpfs /dev/shm && {after}");
        command.args(&unshare[1..]).args(["sh", "-c", &format!("{mount} && exec \"$@\""), "sh"]);
        command
    };
    if !succeeds(mounted("size=64k", "true").arg("true")) {
        skip("mounts", "this user may not create a mount namespace");
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
        findings.assert_problem(set_up, "memory", "failed", remedy);
    }
}

#[test]
fn finds_domain_faults() {
    let env = TestEnv::new();
    let root = env.domain().root().to_owned();
    fs::create_dir(&root).expect("can be created");
    fs::set_permissions(&root, fs::Permissions::from_mode(0o777)).expect("the file belongs to this user");
    Findings::of(&env, &[]).assert_problem(
        "other users can write in the domain",
        "domain",
        "failed",
        "chmod go-w",
    );
    if std::os::unix::fs::chown(&root, Some(1), None).is_ok() {
        fs::set_permissions(&root, fs::Permissions::from_mode(0o700)).expect("root is permitted");
        Findings::of(&env, &[]).assert_problem(
            "the domain belongs to another user",
            "domain",
            "failed",
            "run as user 1",
        );
    } else {
        skip("root", "only root can change the owner of a directory");
    }
    let nowhere = env.command_at(Path::new("/dev/null"), &["doctor", "--json", "--no-system-config"]);
    let findings = Findings::in_outcome(&Program::start(nowhere).wait());
    findings.assert_problem("no domain can be created there", "domain", "failed", "--root");
}

#[test]
fn clean_removes_files_of_killed_hubs_only() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let hub = env.hub(&[&link]);
    let before = env.leftover_files();
    let alive = Findings::of(&env, &["--clean"]);
    assert!(
        alive.state_and_text("clean").0 == "skipped"
            && alive.state_and_text("clean").1.contains(&hub.pid().to_string())
    );
    assert!(before.iter().all(|path| path.exists()), "{before:?}");
    hub.end(KILL);
    Findings::of(&env, &[]).assert_problem("a hub was killed", "leftovers", "warning", "doctor --clean");
    // A domain with a similar name, and a domain with the same name in another location. A hub runs in each of them, so
    // `--clean` must not change either domain.
    let (neighbour, other) = (TestEnv::new(), env.path("other"));
    let other_hub = Program::start(env.command_at(&other, &["run", "--json", &link])).ready();
    let held = env.leftover_files().len();
    let hub = neighbour.hub(&[&link]);
    let neighbours = neighbour.leftover_files();
    let clean = Findings::of(&env, &["--clean"]);
    assert!(
        clean.state_and_text("clean").1.starts_with("removed what 1 process left"),
        "{:?}",
        clean.state_and_text("clean")
    );
    clean.without(&["multicast", "logout", "service", "udev", "port"]).without_ports().assert_no_problem();
    assert!(!env.domain().root().exists());
    let left = env.leftover_files();
    assert!(left.len() < held && !left.is_empty(), "{left:?}");
    assert_eq!(neighbour.leftover_files(), neighbours);
    // The hub in the other location still runs, and it removes its own files when it exits.
    assert_eq!(other_hub.end(TERM).exit_code, Some(0));
    assert_eq!((env.leftover_files().len(), hub.end(TERM).exit_code), (0, Some(0)));
}

#[test]
fn clean_keeps_the_domain_of_a_waiting_subscriber() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let link = env.link("front");
    let hub = env.hub(&[&link]);
    let mut subscriber = env.echo(&["front/scan"]);
    subscriber.await_line("a scan", is_class("scan"));
    hub.end(KILL);
    Findings::of(&env, &["--clean", "/dev/null"]);
    assert!(env.domain().root().exists());
    let _hub = env.hub(&[&link]);
    let is_anew = |line: &serde_json::Value| line["class"] == "scan" && line["topic_seq"] == 0;
    subscriber.await_line("a scan of the next hub", is_anew);
}

#[test]
fn clean_removes_files_of_a_deleted_domain() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("absent")]);
    hub.end(KILL);
    fs::remove_dir_all(env.domain().root()).expect("the file belongs to this user");
    let findings = Findings::of(&env, &[]);
    findings.assert_problem("files of a deleted domain", "leftovers", "warning", "doctor --clean");
    // A process still reads one of the files, so `--clean` must not remove that file.
    let files = env.leftover_files();
    let held = fs::File::open(&files[0]).expect("the file belongs to this user");
    Findings::of(&env, &["--clean"]);
    assert_eq!(env.leftover_files(), files[..1]);
    drop(held);
    Findings::of(&env, &["--clean"]);
    assert!(shared_memory(&env.domain().prefix()).is_empty());
    assert_eq!(Findings::of(&env, &["--clean"]).state_and_text("clean").1, "nothing to remove");
}

#[test]
fn finds_two_hubs_and_a_replaced_program() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let program = env.path("scanhub");
    // Another process must write the program. The doc of `write_program` gives the reason.
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
    fs::remove_file(&program).expect("the file belongs to this user");
    let name = env.domain().name().to_owned();
    let mut doctor = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    doctor.args(["doctor", "--json", "--no-system-config", "--domain", &name, &link]);
    doctor
        .env("RUNTIME_DIRECTORY", &service)
        .env("XDG_RUNTIME_DIR", env.path("b"))
        .env_remove("SCANHUB_CONFIG");
    let findings = Findings::in_outcome(&Program::start(doctor).wait());
    findings.assert_problem("two hubs of one name", "hubs", "warning", "--domain");
    findings.assert_problem("the hub's program was replaced", "version", "warning", "restart scanhub");
    assert!(Domain::at(&name, &user).is_ok_and(|second| {
        findings.state_and_text("hubs").1.contains(&second.root().display().to_string())
    }));
}

#[test]
fn finds_missing_gateway_interface() {
    in_a_network("doctor_machine::finds_missing_gateway_interface", || {
        let env = TestEnv::new();
        // No interface is configured, so `doctor` sends nothing to a network.
        assert_eq!(Findings::of(&env, &[]).state_and_text("multicast").0, "skipped");
        let interface = Findings::of(&env, &["--set", "gateway.interface=eth7"]);
        interface.assert_problem(
            "the gateway's interface does not exist",
            "multicast",
            "failed",
            "there are lo",
        );
    });
}
