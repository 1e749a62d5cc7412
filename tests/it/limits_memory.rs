//! Shortage of shared memory, when a program starts or later. Programs print a message and exit with 75, and no signal
//! such as SIGBUS ends them. Programs that are already attached lose no samples. Each test has its own /dev/shm in its
//! own mount namespace.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::process::Command;

use crate::testkit::{
    INT, Outcome, TERM, TestEnv, contiguous_numbers, is_class, own_program, rerun_test, single_test_args,
    skip, status, succeeds,
};
use rustix::process::Signal;

/// Variable that is set in the process that runs in the namespace.
const NAMESPACE_VARIABLE: &str = "SCANHUB_TEST_INSIDE";

/// Runs `test`, whose name is `name`, in a new mount namespace. Skips the test if the system does not allow namespaces.
fn in_a_namespace(name: &str, test: impl FnOnce()) {
    if std::env::var_os(NAMESPACE_VARIABLE).is_some() {
        return test();
    }
    let mut unshare = Command::new("unshare");
    unshare.arg("--mount");
    if !rustix::process::getuid().is_root() {
        unshare.arg("--map-root-user");
    }
    let mut attempt = Command::new("unshare");
    attempt.args(unshare.get_args()).args(["mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]);
    if !succeeds(attempt) {
        skip("mounts", "this user may not create a mount namespace");
        return;
    }
    unshare.arg(own_program()).args(single_test_args(name)).env(NAMESPACE_VARIABLE, "1");
    rerun_test(name, unshare);
}

/// Mounts a new, empty file system of `bytes` bytes at /dev/shm.
fn mount(bytes: u64) {
    let size = format!("size={bytes}");
    let mounted = status(Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs", "/dev/shm"]));
    assert!(mounted.is_ok_and(|status| status.success()), "cannot mount a tmpfs of {bytes} bytes");
}

fn unmount() {
    assert!(status(Command::new("umount").arg("/dev/shm")).is_ok_and(|status| status.success()));
}

/// Fills /dev/shm except for `remaining` bytes.
fn fill(remaining: u64) {
    let mut file = File::create(FILL_FILE).expect("an empty file needs no memory");
    let mut len = 0;
    loop {
        match file.write(&[0xFF; 4096]) {
            Ok(written) => len += written as u64,
            Err(error) if error.kind() == ErrorKind::StorageFull => break,
            Err(error) => panic!("{error}"),
        }
    }
    file.set_len(len.saturating_sub(remaining)).expect("the file can be truncated");
}

/// Frees the memory that [`fill`] has used. If a new /dev/shm has been mounted since, the file no longer exists.
fn free() {
    if let Ok(file) = OpenOptions::new().write(true).open(FILL_FILE) {
        file.set_len(0).expect("the file can be truncated");
    }
}

const FILL_FILE: &str = "/dev/shm/fill";

/// Asserts that a program succeeded, or that it reported a shortage of memory.
fn assert_done_or_out_of_memory(outcome: &Outcome) {
    match outcome.exit_code {
        Some(0) => {}
        Some(75) => assert!(outcome.stderr.contains("shared memory is"), "{outcome}"),
        _ => panic!("{outcome}"),
    }
}

#[test]
fn hub_starts_or_reports_the_memory_it_needs() {
    in_a_namespace("limits_memory::hub_starts_or_reports_the_memory_it_needs", || {
        let env = TestEnv::new();
        let run = ["run".to_owned(), "--json".to_owned(), env.lms_link("front")];
        let short = |bytes: u64| {
            mount(bytes);
            let outcome = env.run(&run);
            unmount();
            assert_eq!((outcome.exit_code, outcome.stdout.is_empty()), (Some(75), true), "{outcome}");
            let free = format!("shared memory is short: /dev/shm: {} kB free, ", bytes / 1024);
            let rest_of_message = outcome.stderr.split_once(&free).unwrap_or_else(|| panic!("{outcome}")).1;
            let needed =
                rest_of_message.split_once(" kB needed").and_then(|(number, _)| number.parse::<u64>().ok());
            needed.unwrap_or_else(|| panic!("{outcome}")) * 1024
        };
        let needed = short(16 << 10);
        assert!(needed <= 8 << 20, "one link needs {needed} bytes");
        for bytes in (15..22)
            .map(|shift| 1 << shift)
            .filter(|bytes| *bytes < needed)
            .chain([(needed / 4096 - 1) * 4096])
        {
            assert_eq!(short(bytes), needed);
        }
        for bytes in [needed.next_multiple_of(4096), 8 << 20, 16 << 20] {
            mount(bytes);
            let hub = env.hub(&[env.lms_link("front")]);
            assert_eq!(env.info("front")["state"], "absent");
            assert_eq!(hub.end(TERM).exit_code, Some(0));
            assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
            unmount();
        }
    });
}

#[test]
fn full_memory_does_not_stop_attached_subscribers() {
    in_a_namespace("limits_memory::full_memory_does_not_stop_attached_subscribers", || {
        mount(8 << 20);
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &["--seed=41", "--baud=500000"]);
        let hub = env.hub(&[env.lms_link("front")]);
        let mut scans = env.echo(&["front/scan"]);
        scans.await_lines(10, "a scan", is_class("scan"));
        for _ in 0..2 {
            fill(0);
            scans.await_lines(20, "a scan", is_class("scan"));
            for verb in [
                &["info", "front"][..],
                &["list"],
                &["echo", "front/scan"],
                &["echo", "front/telegram", "front/status", "-n", "1"],
                &["hz", "-n", "1"],
                &["control", "front", "resync"],
            ] {
                let outcome = env.run(&[verb, &["--json"]].concat());
                let lines = outcome.lines();
                let error = lines.last().unwrap_or_else(|| panic!("{outcome}"));
                assert_eq!((outcome.exit_code, &error["kind"]), (Some(75), &"short".into()), "{outcome}");
                let message = error["message"].as_str().unwrap_or_default();
                assert!(message.starts_with("shared memory is short: /dev/shm: "), "{outcome}");
            }
            scans.await_lines(20, "a scan", is_class("scan"));
            free();
            assert_eq!(env.info("front")["state"], "streaming");
            assert_eq!(env.run(&["echo", "front/scan", "-n", "5"]).exit_code, Some(0));
        }
        let outcome = scans.end(INT);
        contiguous_numbers(&outcome.of_class("scan"), "topic_seq");
        assert_eq!(outcome.of_class("summary")[0]["missed"], 0);
        assert_eq!(env.info("front")["counters"]["loan_failed"], 0);
        assert_eq!(hub.end(TERM).exit_code, Some(0));
    });
}

#[test]
fn concurrent_clients_end_cleanly_with_little_memory() {
    in_a_namespace("limits_memory::concurrent_clients_end_cleanly_with_little_memory", || {
        mount(8 << 20);
        let env = TestEnv::new();
        let hub = env.hub(&[env.lms_link("front")]);
        let mut short = 0;
        for pages in [0, 1, 15, 16, 17, 18, 20, 24, 32] {
            fill(pages * 4096);
            let topics = ["front/telegram", "front/scan", "front/status"];
            let words = [&["echo"], &topics[..], &["-n", "1"]].concat();
            let together: Vec<_> = (0..8).map(|_| env.start(&words)).collect();
            for program in together {
                let outcome = program.wait();
                assert_done_or_out_of_memory(&outcome);
                short += usize::from(outcome.exit_code == Some(75));
            }
            free();
        }
        assert!(short >= 24, "memory was never short: {short}");
        assert_eq!(env.info("front")["state"], "absent");
        assert_eq!(hub.end(TERM).exit_code, Some(0));
    });
}

#[test]
fn bus_error_ends_with_an_error_line() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=42", "--baud=500000"]);
    let hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.start(&["echo", "--json", "front/scan"]);
    subscriber.await_lines(3, "a scan", is_class("scan"));
    for (program, on_stdout) in [(hub, false), (subscriber, true)] {
        let outcome = program.end(Signal::BUS);
        let error = if on_stdout {
            outcome.lines().pop()
        } else {
            outcome.stderr.lines().last().and_then(|line| serde_json::from_str(line).ok())
        };
        let error = error.unwrap_or_else(|| panic!("{outcome}"));
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(75), &"short".into()), "{outcome}");
        assert!(error["message"].as_str().is_some_and(|message| message.contains("full")), "{outcome}");
    }
    let outcome = env.hub(&[env.lms_link("front")]).end(Signal::BUS);
    assert_eq!(outcome.exit_code, Some(75), "{outcome}");
}
