//! Tests of `scanhub watch` on a terminal: the picture follows the hub, the keys and the size of the window. However
//! the program ends, it restores the terminal.

use std::fs::{self, File};
use std::process::Command;

use crate::testkit;
use crate::testkit::{INT, KILL, TERM, TerminalSession, TestEnv, Tmux, can_open_terminal};
use rustix::process::Signal;

const TERMINAL_SIZE: (u16, u16) = (60, 20);

/// World with a wall ahead, a reflector, and a post within the robot's inner zone.
const WORLD: &str =
    "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n
[[thing]]\nradius_mm = 20\npose = [0, 400]\n
[[thing]]\nline = [[900, 2000], [1000, 2000]]\nsurface = \"reflector\"\n";

fn start_session(env: &TestEnv, arguments: &[&str]) -> TerminalSession {
    let mut command = env.command(&[&["watch"], arguments].concat());
    command.env_remove("NO_COLOR");
    TerminalSession::start(&command, TERMINAL_SIZE)
}

fn is_braille(character: char) -> bool {
    ('\u{2801}'..='\u{28ff}').contains(&character)
}

#[test]
fn watch_refuses_files_and_pipes() {
    let env = TestEnv::new();
    let outcome = env.run(&["watch", "front"]);
    assert_eq!((outcome.exit_code, &outcome.stdout[..]), (Some(2), &b""[..]), "{outcome}");
    assert!(outcome.stderr.contains("scanhub echo front/scan"), "{outcome}");
    let outcome = env.run(&["watch", "--json"]);
    assert_eq!(
        (outcome.exit_code, &outcome.of_class("error")[0]["kind"]),
        (Some(2), &"usage".into()),
        "{outcome}"
    );
}

#[test]
fn watch_reacts_to_hub_keys_and_window_size() {
    if !can_open_terminal() {
        return;
    }
    let env = TestEnv::new();
    let mut watch = start_session(&env, &[]);
    watch.wait_for_text("no hub: waiting for it");
    let world = format!("--world={}", env.file("world", WORLD));
    let _sensor = env.simulator(&["front"], &["--seed=71", "--baud=500000", &world]);
    let hub = env.hub(&[env.link("front")]);
    watch.wait_for_text("1 front    streaming");
    watch.wait_for_text(" STOP  front, nearest 0.3");
    watch.wait_for_text("0.60!");
    watch.await_rows("picture with a mark", |rows| {
        let picture = || rows[1..17].iter().flat_map(|row| row.chars());
        picture().any(is_braille) && picture().any(|sign| sign == '*')
    });
    assert!(watch.text().contains("\x1b[38;5;1"), "a stop is red");

    // When the size of the window changes, the program draws everything again.
    watch.resize((110, 30));
    watch.await_rows("keys in the last row", |rows| rows[29].starts_with("q quit"));
    watch.await_rows("sensor with its marks", |rows| rows[28].contains("marks 1  objects"));

    // Keys hide the marks, show and hide the help, and hold the picture.
    watch.press("m?");
    watch.wait_for_text("┌ scanhub watch ");
    watch.press("? ");
    watch.wait_for_text("HELD");
    watch.await_rows("picture without marks", |rows| !rows[1..28].concat().contains('*'));
    watch.press(" ");

    // The hub computes lines only while they have a subscriber. A key shows the position of the cursor, and another key
    // lists the counters.
    assert_eq!(env.subscribers("front/lines"), 0);
    watch.press("e");
    testkit::wait_until("a subscriber to lines", || env.subscribers("front/lines") == 1);
    watch.press("e");
    testkit::wait_until("no subscriber", || env.subscribers("front/lines") == 0);
    watch.press("x\x1b[A");
    watch.wait_for_text(" m from the robot, x ");
    watch.press("x");
    watch.await_rows("nothing is read out", |rows| !rows.concat().contains("from the robot"));
    // A click of the mouse (in SGR encoding) shows the clicked position, too. The Escape key hides it again.
    watch.press("\x1b[<0;40;12M\x1b[<0;40;12m");
    watch.wait_for_text(" m from the robot, x ");
    watch.press("\x1b");
    watch.await_rows("nothing is read out", |rows| !rows.concat().contains("from the robot"));
    watch.press("n");
    watch.wait_for_text("damaged on the line, last 10 s");
    watch.wait_for_text("bytes_in_telegrams");
    watch.press("n");

    // Keys send requests to the hub, and the program shows their results.
    watch.press("F");
    watch.wait_for_text("front: background is frozen");
    watch.wait_for_text("missed 0  frozen");
    let model = env.run(&["background", "front", "show"]);
    assert!(String::from_utf8_lossy(&model.stdout).contains("frozen"), "{model}");
    watch.press("F");
    watch.wait_for_text("front: background continues learning");
    watch.press("R");
    watch.wait_for_text("front: background is learned again");

    // Kill the hub, and start another one. While the picture is held, the verdict must still be the current one.
    watch.press(" ");
    watch.wait_for_text(" STOP  HELD  front");
    drop(hub.end(KILL));
    watch.wait_for_text("no hub: waiting for it");
    watch.wait_for_text(" UNKNOWN  HELD  front");
    watch.press(" ");
    watch.wait_for_text(" UNKNOWN  front");
    let hub = env.hub(&[env.link("front")]);
    watch.wait_for_text(" STOP  front");
    watch.wait_for_text(&format!("hub {}", hub.pid()));
    watch.press("q");
    assert_eq!(watch.finish(), (Some(0), String::new(), true));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn watch_restores_the_terminal_after_every_exit() {
    if !can_open_terminal() {
        return;
    }
    let env = TestEnv::new();
    for signal in [INT, TERM, Signal::HUP, Signal::QUIT] {
        let watch = start_session(&env, &[]);
        watch.wait_for_text("no hub");
        watch.signal(signal);
        assert_eq!(watch.finish(), (Some(0), String::new(), true), "{signal:?}");
    }
    for key in ["q", "\x1b", "\x03"] {
        let mut watch = start_session(&env, &[]);
        watch.wait_for_text("no hub");
        watch.press(key);
        assert_eq!(watch.finish(), (Some(0), String::new(), true), "{key:?}");
    }
    // As with all verbs that subscribe, a run with a time limit fails without a hub.
    let (code, below, is_whole) = start_session(&env, &["--for=5s"]).finish();
    assert!(code == Some(3) && below.contains("scanhub: no hub in domain") && is_whole, "{code:?} {below:?}");
    let _hub = env.hub(&[env.link("front")]);
    let mut watch = start_session(&env, &["front", "--for=5m"]);
    watch.wait_for_text("1 front");
    watch.press("\x03");
    let (code, _, is_whole) = watch.finish();
    assert_eq!((code, is_whole), (Some(130), true));
    let (code, below, is_whole) = start_session(&env, &["side"]).finish();
    assert!(code == Some(3) && below.contains("there are front") && is_whole, "{code:?} {below:?}");
}

#[test]
fn no_color_disables_all_colors() {
    if !can_open_terminal() {
        return;
    }
    let env = TestEnv::new();
    let mut command = env.command(&["watch"]);
    command.env("NO_COLOR", "1");
    let mut watch = TerminalSession::start(&command, TERMINAL_SIZE);
    let world = format!("--world={}", env.file("world", WORLD));
    let _sensor = env.simulator(&["front"], &["--seed=72", "--baud=500000", &world]);
    let _hub = env.hub(&[env.link("front")]);
    watch.wait_for_text(" STOP  front");
    watch.wait_for_text("0.60!");
    watch.press("q");
    let text = watch.text();
    assert_eq!(watch.finish().0, Some(0));
    assert!(!text.contains("\x1b[38;5") && !text.contains("\x1b[48;5"), "{text:?}");
}

#[test]
fn demo_shows_watch_on_a_terminal() {
    if !can_open_terminal() {
        return;
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    let temporary = tempfile::tempdir().expect("a directory");
    command.arg("demo").env("TMPDIR", temporary.path());
    let mut demo = TerminalSession::start(&command, (80, 30));
    let name = format!("demo-{}", demo.pid());
    demo.wait_for_text("1 front    streaming");
    demo.wait_for_text("2 rear     streaming");
    demo.press("q");
    let (code, below, is_whole) = demo.finish();
    assert!(code == Some(0) && is_whole, "{code:?} {below:?}");
    assert_eq!(below.matches(" 0 lost in ").count(), 2, "{below:?}");
    assert_eq!(
        std::fs::read_dir(&temporary).expect("a readable directory").count(),
        0,
        "the directory was not removed"
    );
    assert!(testkit::shared_memory(&format!("sh_{name}_")).is_empty(), "the domain was not removed");
}

#[test]
fn demo_on_a_terminal_ends_after_its_time() {
    if !can_open_terminal() {
        return;
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    let temporary = tempfile::tempdir().expect("a directory");
    command.args(["demo", "--for=3s"]).env("TMPDIR", temporary.path());
    let (code, below, is_whole) = TerminalSession::start(&command, (80, 30)).finish();
    assert!(code == Some(0) && is_whole, "{code:?} {below:?}");
    assert_eq!(below.matches(" sent, ").count(), 2, "{below:?}");
}

#[test]
fn closed_terminal_ends_watch_without_error() {
    if !can_open_terminal() {
        return;
    }
    let env = TestEnv::new();
    let _sensor = env.simulator(&["front"], &["--seed=73", "--baud=500000"]);
    for streams in [false, true] {
        let _hub = streams.then(|| env.hub(&[env.link("front")]));
        // Close the terminal with SIGHUP, as a shell's terminal does, and without SIGHUP.
        for has_controlling_terminal in [true, false] {
            let errors = env.path("errors");
            let file = File::create(&errors).expect("a file");
            let watch = TerminalSession::start_for_hang_up(
                &env.command(&["watch"]),
                TERMINAL_SIZE,
                has_controlling_terminal,
                file,
            );
            watch.wait_for_text(if streams { "1 front    streaming" } else { "no hub: waiting for it" });
            let code = watch.hang_up();
            let errors = fs::read_to_string(errors).expect("the error output");
            assert_eq!(
                (code, errors.as_str()),
                (Some(0), ""),
                "told {has_controlling_terminal}, streams {streams}"
            );
        }
    }
}

#[test]
fn tmux_shows_picture_help_and_narrow_windows() {
    let env = TestEnv::new();
    // If the test is killed, the commands in the window end on their own after a while.
    let program = env!("CARGO_BIN_EXE_scanhub");
    let line = format!("{program} demo --for=60s; echo ended with $?; sleep 20");
    let Some(tmux) = Tmux::start(&env, &line, (80, 30)) else { return };
    let is_picture = |rows: &[String]| rows[1..].iter().flat_map(|row| row.chars()).any(is_braille);
    // The list shows the sensors in the order in which the hub created their topics, which may vary.
    let streams = |rows: &[String], sensor: &str| {
        let mut of_sensor = rows.iter().filter(|row| row.starts_with("1 ") || row.starts_with("2 "));
        of_sensor.any(|row| row[2..].starts_with(sensor) && row.contains("streaming"))
    };
    let both = |rows: &[String]| streams(rows, "front") && streams(rows, "rear") && is_picture(rows);
    let rows = tmux.await_rows("picture of both sensors", both);
    assert_eq!(rows.len(), 30);
    tmux.press(&["?"]);
    tmux.await_rows("help", |rows| rows.iter().any(|row| row.contains("┌ scanhub watch ")));
    tmux.resize((60, 30));
    let fits = |rows: &[String]| rows.iter().all(|row| row.chars().count() <= 60);
    tmux.await_rows("help in a narrow window", |rows| {
        fits(rows) && rows.iter().any(|row| row.contains("┌ scanhub watch "))
    });
    tmux.press(&["?"]);
    let is_help_closed = |rows: &[String]| !rows.iter().any(|row| row.contains("┌ scanhub watch "));
    tmux.await_rows("picture in a narrow window", |rows| fits(rows) && is_help_closed(rows) && both(rows));
    tmux.resize((140, 30));
    tmux.await_rows("a wide window", |rows| !fits(rows) && both(rows));
    tmux.press(&["q"]);
    // The exit code 130 shows that the demo was interrupted before its time had elapsed.
    let rows = tmux.await_rows("end", |rows| rows.iter().any(|row| row == "ended with 130"));
    assert!(!is_picture(&rows), "the terminal still shows the picture:\n{}", rows.join("\n"));
    assert_eq!(rows.iter().filter(|row| row.contains(" 0 lost in ")).count(), 2, "{}", rows.join("\n"));
}
