//! Tests of `scanhub record` on disks that are full, removed, slow or too small. Topics lose no samples because of the
//! recorder. The recorder buffers as many samples as it can, and reports gaps both in its output and in the file.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;

use crate::testkit::{
    HUP, INT, Outcome, Program, RecordedMessage, Recording, TERM, TestEnv, contiguous_topic_seqs, is_class,
    number, scan, skip, spawn, succeeds, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// Starts a sensor and waits until it streams.
fn sensor(env: &TestEnv) -> [Program; 2] {
    let simulator = env.simulator(&["front"], &["--world=room"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    [simulator, hub]
}

fn is_kind(kind: &str) -> impl Fn(&Value) -> bool {
    move |line| line["kind"] == kind
}

fn await_samples(recorder: &mut Program, count: u64) {
    let samples = |recorder: &mut Program, minimum| {
        let expected = move |line: &Value| line["class"] == "recording" && number(line, "samples") >= minimum;
        number(&recorder.await_line("samples", expected), "samples")
    };
    let before = samples(recorder, 0);
    samples(recorder, before + count);
}

/// Asserts that the recorder ended successfully, and returns the paths of its files in order.
fn files(outcome: &Outcome) -> Vec<PathBuf> {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let end = outcome.of_class("recorded").pop().unwrap_or_else(|| panic!("{outcome}"));
    let files = end["files"].as_array().unwrap().iter();
    files.map(|file| PathBuf::from(file.as_str().unwrap())).collect()
}

/// Asserts that the recorder missed no sample of topic `telegram`.
fn nothing_missed(outcome: &Outcome) {
    let lines = outcome.of_class("summary");
    let telegrams = lines.iter().find(|line| line["topic"] == "telegram").expect("a summary");
    assert_eq!(number(telegrams, "missed"), 0, "{telegrams}");
}

/// Returns the telegrams of several files. Asserts that none is missing between them and that none is duplicated.
fn telegrams(recordings: &[Recording]) -> Vec<&RecordedMessage> {
    let all: Vec<_> = recordings.iter().flat_map(|recording| recording.of("front/telegram")).collect();
    contiguous_topic_seqs(&all);
    all
}

#[test]
fn splits_a_recording_and_keeps_the_last_files() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    let file = env.path_argument("walk.mcap");
    let mut recorder = env.start(&["record", "--json", "--split=128KiB", "--keep=3", "-o", &file]);
    for _ in 0..4 {
        recorder.await_line("the next file", is_kind("file"));
    }
    await_samples(&mut recorder, 20);
    let outcome = recorder.end(INT);
    let files = files(&outcome);
    assert_eq!(files[0], env.path("walk-0001.mcap"));
    let (removed, stay) = files.split_at(files.len() - 3);
    assert!(removed.iter().all(|file| !file.exists()), "{files:?}");
    // On a busy machine, a delayed recorder writes everything that has arrived as one chunk. One of the files may then
    // exceed the limit of 128 KiB.
    let lengths: Vec<_> = stay.iter().map(|file| fs::metadata(file).unwrap().len()).collect();
    assert!(lengths.iter().all(|length| *length <= 160 << 10), "{lengths:?}");
    assert!(lengths.iter().filter(|length| **length <= 128 << 10).count() > 1, "{lengths:?}");
    let recordings: Vec<_> = stay.iter().map(|file| Recording::read_complete(file)).collect();
    let expected = |number: usize| (files.len() - 3 + number).to_string();
    for (number, recording) in recordings.iter().enumerate() {
        // Each file begins with the status, so that a file can be replayed without the earlier ones.
        assert_eq!(recording.messages[0].topic, "front/status");
        assert_eq!(recording.metadata("scanhub")[0]["part"], expected(number + 1));
        assert_eq!(recording.metadata("scanhub.run").len(), 1);
    }
    nothing_missed(&outcome);
    assert!(telegrams(&recordings).len() > 20);
}

#[test]
fn keeps_the_last_files_of_all_runs_when_forced() {
    let env = TestEnv::new();
    let [_simulator, hub] = sensor(&env);
    let file = env.path_argument("walk.mcap");
    let words = ["record", "--split=1h", "--keep=2", "--force", "-o", &file];
    let names = || {
        let names = fs::read_dir(env.path("walk.mcap").parent().unwrap()).unwrap();
        let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.filter(|name| name.starts_with("walk")).collect();
        names.sort();
        names
    };
    let removed = [1, 2, 3].map(|_| {
        let mut recorder = env.start(&[&words[..], &["--json"]].concat());
        let first = recorder.await_line("the first line", is_class("recording"));
        await_samples(&mut recorder, 10);
        files(&recorder.end(INT));
        number(&first, "older_removed")
    });
    assert_eq!(removed, [0, 0, 1]);
    assert_eq!(names(), ["walk-0002.mcap", "walk-0003.mcap"]);
    // A file to which another recorder writes is not removed, and does not count as one of the files that `--keep`
    // keeps.
    let mut other = env.start(&["record", "--json", "--force", "-o", &env.path_argument("walk-0001.mcap")]);
    await_samples(&mut other, 10);
    fs::write(env.path("walk-0000.mcap"), "my notes").unwrap();
    let outcome = env.run(&[&words[..], &["-n", "50"]].concat());
    let text = String::from_utf8_lossy(&outcome.stdout).into_owned();
    let first = format!(
        "records into {}; the first sample in it removes 1 file of an earlier run (--keep)",
        env.path_argument("walk-0004.mcap")
    );
    assert_eq!((outcome.exit_code, text.lines().next()), (Some(0), Some(&first[..])), "{outcome}");
    let all = ["walk-0000.mcap", "walk-0001.mcap", "walk-0003.mcap", "walk-0004.mcap"];
    assert_eq!(names(), all);
    files(&other.end(INT));
    // A run that records no samples removes no files, and neither does a run that is refused.
    assert_eq!(hub.end(INT).exit_code, Some(0));
    assert_eq!(env.run(&[&words[..], &["-n", "50"]].concat()).exit_code, Some(3));
    assert_eq!(env.run(&["record", "--split=1h", "--keep=2", "-o", &file]).exit_code, Some(73));
    assert_eq!(names(), all);
}

#[test]
fn file_at_its_size_limit_starts_the_next_file() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    // The limit is 128 blocks, which have 512 or 1024 bytes, depending on the shell.
    let limited = ["sh", "-c", "ulimit -f 128; exec \"$@\"", "sh"];
    let mut recorder = start_in(&env, &limited, &["record", "--json", "-o", &env.path_argument("walk.mcap")]);
    recorder.await_line("the next file", is_kind("file"));
    recorder.await_line("the next file", is_kind("file"));
    let outcome = recorder.end(INT);
    let files = files(&outcome);
    assert_eq!(files[..2], [env.path("walk.mcap"), env.path("walk-0002.mcap")]);
    // Only the last file has an index. The other files have no room for theirs.
    let recordings: Vec<_> = files.iter().map(|file| Recording::read_interrupted(file)).collect();
    nothing_missed(&outcome);
    assert!(telegrams(&recordings).len() > 50);
}

#[test]
fn recorder_waits_for_a_missing_directory() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    let place = env.path("usb");
    fs::create_dir(&place).unwrap();
    let file = place.join("walk.mcap");
    let mut recorder = env.start(&["record", "--json", "-o", &file.display().to_string()]);
    await_samples(&mut recorder, 20);
    fs::rename(&place, env.path("unplugged")).unwrap();
    let problem = recorder.await_line("a failed write", is_kind("write_failed"));
    assert_eq!(problem["file"], file.display().to_string());
    fs::create_dir(&place).unwrap();
    recorder.await_line("the resumed write", is_kind("write_resumed"));
    await_samples(&mut recorder, 20);
    let outcome = recorder.end(INT);
    assert_eq!(files(&outcome)[1], place.join("walk-0002.mcap"));
    // The samples that were written before the recorder noticed the loss are in the renamed directory.
    let places = [env.path("unplugged/walk.mcap"), place.join("walk-0002.mcap")];
    let recordings = [Recording::read_interrupted(&places[0]), Recording::read_complete(&places[1])];
    nothing_missed(&outcome);
    assert!(telegrams(&recordings).len() > 10);
}

#[test]
fn recorder_waits_while_the_disk_is_full() {
    let env = TestEnv::new();
    let place = env.path("small");
    fs::create_dir(&place).unwrap();
    let mount = format!("mount -t tmpfs -o size=256k none {0} && echo > {0}/filler", place.display());
    if !succeeds(Command::new("unshare").args(["-rm", "sh", "-c", &mount])) {
        skip("mounts", "this user may not make a file system of its own (unshare -rm, mount)");
        return;
    }
    let _others = sensor(&env);
    let script = format!("{mount} && head -c 131072 /dev/zero > {}/filler && exec \"$@\"", place.display());
    let file = place.join("walk.mcap").display().to_string();
    let mut recorder =
        start_in(&env, &["unshare", "-rm", "sh", "-c", &script, "sh"], &["record", "--json", "-o", &file]);
    recorder.await_line("a failed write", is_kind("write_failed"));
    // Path of the small file system, which only the recorder's mount namespace contains.
    let path_in_namespace = PathBuf::from(format!("/proc/{}/root{}", recorder.pid(), place.display()));
    let full = Recording::read_interrupted(&path_in_namespace.join("walk.mcap"));
    assert!(!full.of("front/telegram").is_empty(), "no complete chunk in the file");
    fs::remove_file(path_in_namespace.join("filler")).unwrap();
    recorder.await_line("the resumed write", is_kind("write_resumed"));
    let before = Recording::read_interrupted(&path_in_namespace.join("walk.mcap")).messages.len();
    wait_until("a continued recording", || {
        Recording::read_interrupted(&path_in_namespace.join("walk.mcap")).messages.len() > before
    });
    // The small file system ends together with the recorder's namespace, so open the file before the recorder ends.
    let mut open = fs::File::open(path_in_namespace.join("walk.mcap")).unwrap();
    let outcome = recorder.end(INT);
    assert_eq!(files(&outcome).len(), 1);
    let mut bytes = Vec::new();
    open.read_to_end(&mut bytes).unwrap();
    nothing_missed(&outcome);
    telegrams(&[Recording::read_complete(Path::new(&env.file("walk.mcap", bytes)))]);
}

#[test]
fn counts_samples_dropped_because_of_a_slow_output() {
    let env = TestEnv::new();
    let stream: Vec<u8> = (0..40_000_u32).flat_map(|seed| scan((seed % 8000) as u16)).collect();
    env.file("stream", stream);
    // A pipe from which no program reads acts as the slowest possible disk. The test opens the pipe for reading,
    // because otherwise the shell would wait when it opens the pipe for writing.
    let pipe = env.path("pipe");
    assert!(succeeds(Command::new("mkfifo").arg(&pipe)));
    let open = fs::File::options().read(true).write(true).open(&pipe).unwrap();
    let shell = format!("exec \"$@\" 2>&1 > {}", pipe.display());
    let topics = ["record", "--json", "-o", "-", "front/telegram", "front/scan", "front/status"];
    let mut recorder = start_in(&env, &["sh", "-c", &shell, "sh"], &topics);
    recorder.await_line("the first line", is_class("recording"));
    let mut reader = fs::File::open(&pipe).unwrap();
    drop(open);
    // Replay in a loop, because a busy machine may lose most samples in the first pass, before the recorder can receive
    // them.
    let stream = env.path_argument("stream");
    let words = ["replay", "--json", "--no-system-config", "--loop", "--rate=max", &stream];
    let _hub = env.start(&words).ready();
    recorder.await_line("the gap", is_kind("gap_begins"));
    let read = thread::spawn(move || {
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes).map(|_| bytes)
    });
    let gap = recorder.await_line("the end of the gap", is_kind("gap_ends"));
    let outcome = recorder.end(INT);
    let end = outcome.of_class("recorded").pop().unwrap_or_else(|| panic!("{outcome}"));
    let recording = Recording::read(&read.join().unwrap().unwrap(), &pipe);
    assert!(number(&gap, "dropped") > 0 && number(&end, "dropped") >= number(&gap, "dropped"), "{end}");
    assert_eq!(number(&end, "samples"), recording.messages.len() as u64);
    let dropped = |gap: &&BTreeMap<String, String>| -> u64 {
        let counts = gap.iter().filter(|(key, _)| key.contains('/'));
        counts.map(|(_, count)| count.parse::<u64>().unwrap()).sum()
    };
    let noted: u64 = recording.metadata("scanhub.gap").iter().map(dropped).sum();
    assert_eq!(noted, number(&end, "dropped"));
}

#[test]
fn simultaneous_signals_count_as_one_stop_request() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    // The pipe is so small that the recorder has to wait for the pipe's reader, even while the recorder ends.
    let pipe = env.path("pipe");
    assert!(succeeds(Command::new("mkfifo").arg(&pipe)));
    let open = fs::File::options().read(true).write(true).open(&pipe).unwrap();
    rustix::pipe::fcntl_setpipe_size(&open, 4096).unwrap();
    let shell = format!("exec \"$@\" 2>&1 > {}", pipe.display());
    let mut recorder = start_in(&env, &["sh", "-c", &shell, "sh"], &["record", "--json", "-o", "-"]);
    recorder.await_line("the first line", is_class("recording"));
    let mut reader = fs::File::open(&pipe).unwrap();
    drop(open);
    wait_until("a subscriber to status", || env.subscribers("front/status") > 0);
    recorder.await_lines(2, "progress", is_class("recording"));
    // Stop the recorder, so that it cannot handle the first signal before the last one was sent. A test of the crate
    // `verbs` checks, without a clock, how much time may pass between the signals of one request.
    recorder.signal(Signal::STOP);
    wait_until("a stopped process", || recorder.is_stopped());
    [INT, TERM, HUP, Signal::QUIT].into_iter().for_each(|signal| recorder.signal(signal));
    recorder.signal(Signal::CONT);
    recorder.await_line("the last summary", |line| line["class"] == "summary" && line["topic"] == "status");
    let read = thread::spawn(move || {
        let mut bytes = Vec::new();
        reader.read_to_end(&mut bytes).map(|_| bytes)
    });
    let outcome = recorder.wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let bytes = read.join().unwrap().unwrap();
    assert!(bytes.len() > 4096 && bytes.ends_with(b"\x89MCAP0\r\n"), "{} bytes", bytes.len());
}

#[test]
fn failed_start_leaves_no_file() {
    let env = TestEnv::new();
    let limited = ["sh", "-c", "ulimit -f 0; exec \"$@\"", "sh"];
    let outcome =
        start_in(&env, &limited, &["record", "--json", "-o", &env.path_argument("walk.mcap")]).wait();
    assert_eq!(outcome.exit_code, Some(75), "{outcome}");
    assert_eq!(outcome.of_class("error")[0]["kind"], "short", "{outcome}");
    assert!(!env.path("walk.mcap").exists());
    std::os::unix::fs::symlink("/dev/null", env.path("nothing")).unwrap();
    let outcome = env.run(&["record", "--json", "--force", "--for=5s", "-o", &env.path_argument("nothing")]);
    assert_eq!(outcome.exit_code, Some(73), "{outcome}");
    assert!(outcome.to_string().contains("it is a link to /dev/null"), "{outcome}");
    assert!(fs::symlink_metadata(env.path("nothing")).is_ok());
}

#[test]
fn recorder_fails_if_its_reader_closes_the_pipe() {
    let env = TestEnv::new();
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let refused = |outcome: std::process::Output| {
        let errors = String::from_utf8_lossy(&outcome.stderr).into_owned();
        assert_eq!(outcome.status.code(), Some(1), "{errors}");
        assert!(errors.contains("the reader of the recording has exited"), "{errors}");
    };
    let begin = |words: &[&str], writer: io::PipeWriter| {
        let mut command = env.command(&[&["record", "-o", "-"], words].concat());
        spawn(command.stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped())).unwrap()
    };
    refused(begin(&[], writer).wait_with_output().unwrap());
    // If the reader closes the pipe during the recording, the recorder reports the same error.
    let _others = sensor(&env);
    let (mut reader, writer) = io::pipe().unwrap();
    let recorder = begin(&["--for=60s"], writer);
    reader.read_exact(&mut [0; 20_000]).unwrap();
    drop(reader);
    refused(recorder.wait_with_output().unwrap());
}

#[test]
fn samples_of_a_removed_file_are_not_counted() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    let file = env.path_argument("walk.mcap");
    let mut recorder = env.start(&["record", "--json", "-o", &file]);
    await_samples(&mut recorder, 20);
    fs::remove_file(&file).unwrap();
    let lost_file = recorder.await_line("the loss", is_kind("file_removed"));
    assert_eq!(lost_file["file"], file);
    await_samples(&mut recorder, 20);
    let outcome = recorder.end(INT);
    let end = outcome.of_class("recorded").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!(
        (number(&end, "removed"), number(&lost_file, "samples") >= 20),
        (number(&lost_file, "samples"), true)
    );
    let next = Recording::read_complete(&env.path("walk-0002.mcap"));
    let repeated = 1;
    assert_eq!(number(&end, "samples") + repeated, next.messages.len() as u64, "{outcome}");
    assert_eq!(number(&end, "bytes"), fs::metadata(env.path("walk-0002.mcap")).unwrap().len());
    // If a file is removed just before the recorder ends, the samples in it count as removed, too.
    let mut recorder = env.start(&["record", "--json", "--force", "-o", &file]);
    await_samples(&mut recorder, 20);
    fs::remove_file(&file).unwrap();
    let outcome = recorder.end(INT);
    let end = outcome.of_class("recorded").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert!(number(&end, "removed") >= 20, "{end}");
}

#[test]
fn second_recorder_of_a_file_is_refused() {
    let env = TestEnv::new();
    let _others = sensor(&env);
    let file = env.path_argument("walk.mcap");
    let mut recorder = env.start(&["record", "--json", "-o", &file]);
    await_samples(&mut recorder, 20);
    let second = env.run(&["record", "--json", "--force", "-o", &file]);
    let error = &second.of_class("error")[0];
    assert_eq!((second.exit_code, &error["kind"]), (Some(73), &"output".into()), "{second}");
    assert!(error["message"].as_str().unwrap().contains("another recorder writes it"), "{error}");
    await_samples(&mut recorder, 20);
    nothing_missed(&recorder.end(INT));
    telegrams(&[Recording::read_complete(Path::new(&file))]);
}

/// Starts the program with the words of `before` in front of its command line.
fn start_in(env: &TestEnv, before: &[&str], arguments: &[&str]) -> Program {
    let program = env.command(arguments);
    let mut command = Command::new(before[0]);
    command.args(&before[1..]).arg(program.get_program()).args(program.get_args());
    for (key, value) in program.get_envs() {
        match value {
            Some(value) => command.env(key, value),
            None => command.env_remove(key),
        };
    }
    Program::start(command)
}
