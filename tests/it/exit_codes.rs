//! Exit codes for files that a user names: 66 for an input that cannot be read, 73 for an output that cannot be
//! created, and 78 for wrong values in a file that can be read.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::net::UnixListener;

use rustix::fs::{CWD, FileType, Mode, mknodat};

use crate::foreign_user::{OTHER_UID, scanhub, with_another_user};
use crate::testkit::{Outcome, Program, TestEnv};

/// Command lines in which `FILE` stands for an input file. The flag is true if the file is a recording, which may have
/// any size. `doctor` is not in this list, because it reports an unreadable file as a failed check. Files that a
/// configuration names are not in this list, because their names are values of the configuration. An unreadable one
/// leads to exit code 78.
const INPUT_COMMANDS: [(&str, bool); 20] = [
    ("run --no-system-config --config FILE", false),
    ("run --no-system-config --link=a=file:FILE", true),
    ("config check FILE", false),
    ("config show --no-system-config --config FILE", false),
    ("gateway --no-system-config --config FILE", false),
    ("gateway --no-system-config --interface=lo --key-file FILE", false),
    ("listen --key-file FILE", false),
    ("replay --no-system-config FILE", true),
    ("replay --no-system-config --config FILE FILE", true),
    ("simulate --port=PORT --replay FILE", true),
    ("simulate --port=PORT --world FILE", false),
    ("simulate --port=PORT --family=ld --replay FILE", true),
    ("convert FILE OUT.csv", true),
    ("convert FILE OUT.mcap", true),
    ("telegram decode FILE", true),
    ("web --listen=127.0.0.1:0 --replay FILE", true),
    ("web --listen=127.0.0.1:0 --token-file FILE", false),
    ("background front load FILE", false),
    ("track --site FILE", false),
    ("site check FILE", false),
];

/// Command lines in which `FILE` stands for an output file.
const OUTPUT_COMMANDS: [&str; 6] = [
    "record --output FILE",
    "convert LOG FILE",
    "simulate --port=PORT --truth FILE",
    "site check SITE --svg FILE",
    "key new FILE",
    "background front save FILE",
];

const SITE_FILE: &str = "[[sensor]]\nname = \"front\"\npose = { x = 0, y = 0, yaw = 0 }\n[[room]]\nname = \"a\\u0007<b>\"\npolygon = \
                    [[0, 0], [4, 0], [4, 3]]\n";

/// Runs the program with the words of `line` as arguments, in which `file` replaces `FILE`.
fn run(env: &TestEnv, line: &str, file: &str) -> Outcome {
    let words: Vec<String> = line
        .split(' ')
        .map(|word| {
            let word = word.replace("FILE", file).replace("LOG", &env.path_argument("walk.log"));
            word.replace("SITE", &env.path_argument("site.toml")).replace("PORT", &env.path_argument("port"))
        })
        .map(|word| word.replace("OUT", &env.path_argument("out")))
        .collect();
    env.run(&words.iter().map(String::as_str).collect::<Vec<_>>())
}

#[test]
fn unreadable_input_file_exits_with_66() {
    let env = TestEnv::new();
    let long = env.file("long", "# long\n".repeat(100_000));
    // The programs refuse a file with a key if other users can read it, so make this file private.
    fs::set_permissions(&long, Permissions::from_mode(0o600)).expect("the file belongs to this user");
    let [directory, pipe, socket] = ["directory", "pipe", "socket"].map(|name| env.path(name));
    fs::create_dir(&directory).expect("a directory");
    mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).expect("a pipe");
    let _listener = UnixListener::bind(&socket).expect("a socket");
    for (line, is_recording) in INPUT_COMMANDS {
        for file in ["absent", "directory", "pipe", "socket"].map(|name| env.path_argument(name)) {
            let outcome = run(&env, line, &file);
            assert_eq!(outcome.exit_code, Some(66), "{line} {file}: {outcome}");
            assert!(outcome.stderr.contains(&file), "the message must name the file: {line}: {outcome}");
        }
        let files = if is_recording { vec!["/dev/zero"] } else { vec!["/dev/zero", &long] };
        for file in files {
            assert_eq!(run(&env, line, file).exit_code, Some(66), "{line} {file}");
        }
    }
    // `telegram decode` accepts any bytes. It reports bytes that are not part of a telegram, and exits with 5.
    let is_checked = |line: &str| !line.contains("--config") && !line.starts_with("telegram");
    let mut random = fastrand::Rng::with_seed(43);
    let junk = env.file("junk", std::iter::repeat_with(|| random.u8(..)).take(50_000).collect::<Vec<u8>>());
    let zeros = env.file("zeros", vec![0; 50_000]);
    for (line, _) in
        INPUT_COMMANDS.into_iter().filter(|(line, is_recording)| *is_recording && is_checked(line))
    {
        for file in [&junk, &zeros] {
            let outcome = run(&env, line, file);
            assert_eq!(outcome.exit_code, Some(66), "{line} {file}: {outcome}");
            assert!(outcome.stderr.contains(file), "the message must name the file: {line}: {outcome}");
        }
    }
    assert!(!env.path("out.csv").exists() && !env.path("out.mcap").exists());
}

#[test]
fn input_without_permission_exits_with_66() {
    with_another_user("exit_codes::input_without_permission_exits_with_66", || {
        fs::write("/tmp/secret", "text").expect("a file");
        fs::set_permissions("/tmp/secret", Permissions::from_mode(0o600))
            .expect("the file belongs to this user");
        for (line, _) in INPUT_COMMANDS {
            let line =
                line.replace("FILE", "/tmp/secret").replace("PORT", "/tmp/port").replace("OUT", "/tmp/out");
            let outcome = Program::start(scanhub(OTHER_UID, &line.split(' ').collect::<Vec<_>>())).wait();
            assert_eq!(outcome.exit_code, Some(66), "{line}: {outcome}");
            assert!(outcome.stderr.contains("Permission denied"), "{line}: {outcome}");
        }
    });
}

#[test]
fn invalid_value_in_a_readable_file_exits_with_78() {
    let env = TestEnv::new();
    let file = env.file("wrong.toml", "[[link]]\nname = 7\n");
    for line in [
        "run --no-system-config --config FILE",
        "config check FILE",
        "gateway --no-system-config --config FILE",
        "simulate --port=PORT --world FILE",
        "site check FILE",
        "track --site FILE",
        "web --listen=127.0.0.1:0 --token-file FILE",
    ] {
        let outcome = run(&env, line, &file);
        assert_eq!(outcome.exit_code, Some(78), "{line}: {outcome}");
        assert!(outcome.stderr.contains("wrong.toml"), "{line}: {outcome}");
    }
    fs::set_permissions(&file, Permissions::from_mode(0o600)).expect("the file belongs to this user");
    for line in ["gateway --no-system-config --interface=lo --key-file FILE", "listen --key-file FILE"] {
        assert_eq!(run(&env, line, &file).exit_code, Some(78), "{line}");
    }
}

#[test]
fn output_that_cannot_be_created_exits_with_73() {
    let env = TestEnv::new();
    let scan = format!("FLASER 181{} 0 0 0 0 0 0 1.5 host 1.5\n", " 1.5".repeat(181));
    env.file("walk.log", scan);
    env.file("site.toml", SITE_FILE);
    let [directory, pipe, link, dangling] =
        ["directory.mcap", "pipe.mcap", "link.mcap", "dangling.mcap"].map(|name| env.path(name));
    let file = env.file("old.mcap", "old");
    fs::create_dir(&directory).expect("a directory");
    mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).expect("a pipe");
    symlink(&file, &link).expect("a link");
    symlink("absent", &dangling).expect("a link");
    for line in OUTPUT_COMMANDS {
        let refused = |file: &str, message: &str| {
            for line in [line.to_owned(), format!("{line} --force")] {
                if line.starts_with("key") && line.ends_with("--force") {
                    continue;
                }
                let outcome = run(&env, &line, file);
                assert_eq!(outcome.exit_code, Some(73), "{line} {file}: {outcome}");
                assert!(outcome.stderr.contains(message), "{line} {file}: {outcome}");
            }
        };
        refused(&env.path_argument("directory.mcap"), "it is a directory");
        refused(&env.path_argument("pipe.mcap"), "it is a pipe");
        refused(&env.path_argument("link.mcap"), &format!("it is a link to {file}"));
        refused(&env.path_argument("dangling.mcap"), "it is a link to absent");
        refused(&env.path_argument("nowhere/new.mcap"), "No such file or directory");
        // `convert` is left out here, because it fails earlier: it has no format for this name.
        if !line.starts_with("convert") {
            refused("/dev/null", "it is a device");
        }
        let outcome = run(&env, line, &file);
        assert_eq!(outcome.exit_code, Some(73), "{line}: {outcome}");
        assert!(outcome.stderr.contains("old.mcap exists"), "{line}: {outcome}");
    }
    assert_eq!(fs::read_to_string(&file).expect("the file exists"), "old");
    assert!(!env.path("absent").exists() && !env.path("nowhere").exists());
}

#[test]
fn force_replaces_existing_output() {
    let env = TestEnv::new();
    env.file("site.toml", SITE_FILE);
    let file = env.file("old.svg", "old");
    assert_eq!(run(&env, "site check SITE --svg FILE --force", &file).exit_code, Some(0));
    let drawing = fs::read_to_string(&file).expect("a drawing");
    assert!(drawing.contains(">a?&lt;b&gt;<"), "{drawing}");
    let truth = env.file("truth", "old");
    let simulator = env.start(&[
        "simulate",
        "--json",
        "--port",
        &env.path_argument("port"),
        "--truth",
        &truth,
        "--force",
    ]);
    drop(simulator.ready());
    assert!(!fs::read_to_string(&truth).expect("a file").starts_with("old"));
    // `man` checks the paths of all pages before it writes any page.
    let pages = env.path_argument("man");
    fs::create_dir(&pages).expect("a directory");
    let page = env.path("man/scanhub-run.1");
    symlink(&file, &page).expect("a link");
    let outcome = env.run(&["man", &pages]);
    assert_eq!(outcome.exit_code, Some(73), "{outcome}");
    assert!(outcome.stderr.contains("scanhub-run.1: it is a link to"), "{outcome}");
    fs::remove_file(&page).expect("the file belongs to this user");
    for _ in 0..2 {
        assert_eq!(env.run(&["man", &pages]).exit_code, Some(0));
    }
    assert!(fs::read_to_string(&page).expect("a page").contains("scanhub-run"));
    assert_eq!(fs::read_to_string(&file).expect("a drawing"), drawing);
}

#[test]
fn token_file_must_be_readable_only_by_its_user() {
    let env = TestEnv::new();
    let file = env.file("token", "carrot\n");
    let web = |env: &TestEnv| env.command(&["web", "--json", "--listen=127.0.0.1:0", "--token-file", &file]);
    fs::set_permissions(&file, Permissions::from_mode(0o640)).expect("the file belongs to this user");
    let refused = Program::start(web(&env)).wait();
    assert_eq!(refused.exit_code, Some(78), "{refused}");
    assert!(refused.to_string().contains("mode 0640"), "{refused}");
    fs::set_permissions(&file, Permissions::from_mode(0o600)).expect("the file belongs to this user");
    let mut command = web(&env);
    command.env("SCANHUB_WEB_TOKEN", "of-the-environment");
    let mut web = Program::start(command);
    let ready = web.await_line("ready", |line| line["class"] == "ready");
    assert!(ready["url"].as_str().is_some_and(|url| url.ends_with("/?token=carrot")), "{ready}");
}
