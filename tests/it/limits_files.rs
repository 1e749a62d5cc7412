//! Files that could use too much memory or time: a device or a pipe instead of a file, a file that unpacks to much more
//! than its size, and a file with thousands of channels or links. The program refuses or reads each of these files
//! within 64 MB of memory and a second, with a suitable message and exit code.

use std::io::Write;
use std::process::Command;

use crate::testkit;
use crate::testkit::{Outcome, Program, TestEnv};
use flate2::Compression;
use flate2::write::GzEncoder;
use rustix::fs::{CWD, FileType, Mode, mknodat};
use scanhub_schema::file::ENCODING;

/// Runs the program with at most 96,000 kB of address space and two seconds of CPU time. The program itself uses about
/// 23 MB of the address space. Two seconds allow for one second of work, because tests run an unoptimized build.
fn run_bounded(env: &TestEnv, arguments: &[&str]) -> Outcome {
    let own = env.command(arguments);
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -v 96000 && ulimit -t 2 && exec \"$0\" \"$@\""]).arg(own.get_program());
    command.args(own.get_args());
    let changed = own.get_envs().map(|(key, value)| (key.to_owned(), value.map(ToOwned::to_owned)));
    for (key, value) in changed.collect::<Vec<_>>() {
        match value {
            Some(value) => command.env(key, value),
            None => command.env_remove(key),
        };
    }
    Program::start(command).wait()
}

fn assert_refused(env: &TestEnv, arguments: &[&str], code: i32, words: &str) {
    let outcome = run_bounded(env, arguments);
    assert_eq!(outcome.exit_code, Some(code), "{arguments:?}: {outcome}");
    assert!(outcome.stderr.contains(words), "{arguments:?}: {outcome}");
}

/// Creates a named pipe that no process writes to.
fn pipe(env: &TestEnv) -> String {
    let path = env.path("pipe");
    mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).expect("a pipe");
    path.display().to_string()
}

fn gzip_file(env: &TestEnv, name: &str, content: &[u8]) -> String {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(content).expect("the content can be compressed");
    env.file(name, encoder.finish().expect("the content can be compressed"))
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

/// Returns an MCAP file that has these records between its header and its end.
fn mcap(records: &[Vec<u8>]) -> Vec<u8> {
    const MAGIC: &[u8] = b"\x89MCAP0\r\n";
    let header = record(1, &[text(""), text("")].concat());
    let end = [record(15, &[0; 4]), record(2, &[0; 20])].concat();
    [MAGIC, &header, &records.concat(), &end, MAGIC].concat()
}

fn channel(id: u16, topic: &str, encoding: &str) -> Vec<u8> {
    record(4, &[&id.to_le_bytes()[..], &[0; 2], &text(topic), &text(encoding), &[0; 4]].concat())
}

#[test]
fn rejects_devices_pipes_and_directories_at_once() {
    let env = TestEnv::new();
    let pipe = pipe(&env);
    for (path, words) in
        [(&pipe[..], "it is a pipe"), ("/dev/zero", "it is a device"), ("/", "it is a directory")]
    {
        let model = format!("[[link]]\nname = \"a\"\nport = \"x\"\n[background]\nstart = \"{path}\"\n");
        let model = env.file("model.toml", model);
        for arguments in [
            &["config", "check", path][..],
            &["run", "--config", path],
            &["gateway", "--config", path],
            &["config", "check", &model],
            &["run", "--config", &model],
            &["simulate", "--port", "p", "--world", path],
            &["simulate", "--port", "p", "--replay", path],
            &["replay", path],
            &["convert", path, "x.mcap"],
            &["background", "a", "load", path],
        ] {
            // Here, the file's name is a value in the configuration, so the exit code is 78.
            let code = if arguments.contains(&model.as_str()) { 78 } else { 66 };
            assert_refused(&env, arguments, code, words);
        }
    }
    // Standard input is accepted as an input file if it is a file, but not if it is a pipe.
    let file = env.file("links.toml", "[[link]]\nname = \"a\"\nport = \"x\"\n");
    let check = |stdin: std::process::Stdio| {
        let command = env.command(&["config", "check", "/dev/stdin"]);
        Program::start_with(command, stdin).wait()
    };
    let taken = check(std::fs::File::open(&file).expect("the file can be opened").into());
    assert_eq!((taken.exit_code, &taken.stdout[..]), (Some(0), &b"ok: 1 link: a at x\n"[..]), "{taken}");
    let outcome = check(std::process::Stdio::piped());
    assert_eq!(outcome.exit_code, Some(66), "{outcome}");
    assert!(outcome.stderr.contains("/dev/stdin: it is a pipe, not a regular file"), "{outcome}");
}

#[test]
fn rejects_decompression_bombs() {
    let env = TestEnv::new();
    let long = |len: usize| {
        record(
            9,
            &[&[0; 16][..], &text("a"), &text("b"), &(len as u64).to_le_bytes(), &vec![0; len + 4]].concat(),
        )
    };
    let bomb = gzip_file(&env, "bomb.mcap.gz", &mcap(&[long(100 << 20)]));
    let zeros = gzip_file(&env, "zeros.bin.gz", &vec![0; 100 << 20]);
    assert_refused(
        &env,
        &["convert", &zeros, &env.path_argument("x.mcap")],
        66,
        "there is no telegram in it",
    );
    let telegrams: Vec<u8> = (0..100).flat_map(testkit::scan).collect();
    let stream = gzip_file(&env, "stream.bin.gz", &[&telegrams[..], &vec![0; 100 << 20]].concat());
    for file in [&bomb, &stream] {
        assert_refused(
            &env,
            &["convert", file, &env.path_argument("x.mcap")],
            66,
            "unpacks to more than 400 times its length",
        );
        assert_refused(&env, &["replay", file], 66, "`zcat FILE > WHOLE`");
    }
}

#[test]
fn reads_long_chunks_up_to_the_limit() {
    let env = TestEnv::new();
    let chunk = |len: usize| {
        let content = record(5, &vec![0; len]);
        let size = (content.len() as u64).to_le_bytes();
        record(6, &[&[0; 16][..], &size, &[0; 4], &text(""), &size, &content].concat())
    };
    let whole = env.file("whole.mcap", mcap(&[channel(0, "t", "cdr"), chunk(7 << 20), chunk(7 << 20)]));
    let copy = env.path_argument("copy.mcap");
    let outcome = run_bounded(&env, &["convert", &whole, &copy, "--compression", "none"]);
    assert_eq!((outcome.exit_code, outcome.stderr.contains("missing")), (Some(0), false), "{outcome}");
    assert!(std::fs::metadata(&copy).expect("the file exists").len() > 14 << 20);
    let long = env.file("long.mcap", mcap(&[channel(0, "t", "cdr"), chunk(20 << 20)]));
    assert_refused(&env, &["convert", &long, &copy, "--force"], 66, "it has a chunk of 20 MB; at most 8");
    assert_refused(&env, &["convert", &long, &copy, "--force"], 66, "mcap filter");
}

#[test]
fn reads_60000_channels_within_the_limits() {
    let env = TestEnv::new();
    let channels = |topic: fn(u16) -> String, encoding| -> Vec<_> {
        (0..60_000).map(|id| channel(id, &topic(id), encoding)).collect()
    };
    let copy = env.path_argument("copy.mcap");
    for (name, is_whole) in [("whole.mcap", true), ("cut.mcap", false)] {
        let cut = |mut file: Vec<u8>| {
            file.truncate(file.len() - if is_whole { 0 } else { 30 });
            file
        };
        let ours = env.file(name, cut(mcap(&channels(|id| format!("s{id}/telegram"), ENCODING))));
        assert_refused(&env, &["convert", &ours, &copy, "--force"], 66, "it names more than 4096 sensors");
        assert_refused(&env, &["replay", &ours], 66, "it names more than 4096 sensors");
        let others = env.file(name, cut(mcap(&channels(|id| format!("t{id}"), "cdr"))));
        let outcome = run_bounded(&env, &["convert", &others, &copy, "--force", "--compression", "none"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let some = channels(|id| format!("s{}/telegram", id % 4000), ENCODING);
        let some = env.file(name, cut(mcap(&some)));
        let outcome = run_bounded(&env, &["convert", &some, &copy, "--force", "--compression", "none"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert_refused(&env, &["replay", &some], 78, "more than 256 links");
    }
}

#[test]
fn rejects_surplus_links_at_the_first_one() {
    let env = TestEnv::new();
    let links = |count: u32| -> String {
        (0..count).map(|n| format!("[[link]]\nname = \"s{n}\"\nport = \"/dev/x{n}\"\n")).collect()
    };
    let max_links = env.file("most.toml", links(256));
    let outcome = run_bounded(&env, &["config", "check", &max_links]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let more = env.file("more.toml", links(11_000));
    assert_refused(&env, &["config", "check", &more], 78, "more.toml:770:8: more than 256 links");
    let far_more = env.file("far-more.toml", links(20_000));
    assert_refused(&env, &["config", "check", &far_more], 66, "it is longer than 524288 bytes");
    // The configuration stores the location of each value in the file, and here there are 39,000 values.
    let sectors = "{from_deg=1.0,to_deg=2.0,range=0.1},".repeat(13_000);
    let sectors = format!("{}[zones]\nbody_mask = [{sectors}]\n", links(2));
    let outcome = run_bounded(&env, &["config", "check", &env.file("sectors.toml", sectors)]);
    assert!(matches!(outcome.exit_code, Some(0 | 78)), "{outcome}");
}
