//! Tests of `scanhub replay`, which is a hub whose ports are a recording: its options, its keys on the keyboard, and
//! its end.

use std::collections::BTreeMap;

use crate::testkit;
use crate::testkit::{INT, Outcome, Program, TERM, TerminalSession, TestEnv, is_class, number};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Header, Marks, Topic};
use serde_json::Value;

/// Writes a log with a scan every `period_ms`, starting at 1000 s.
fn log(env: &TestEnv, scans: u64, period_ms: u64) -> String {
    let line = |scan: u64| {
        let ranges = vec!["1.5"; 181].join(" ");
        let at = 1000.0 + (scan * period_ms) as f64 / 1000.0;
        format!("FLASER 181 {ranges} 0 0 0 0 0 0 {at} host {at}\n")
    };
    env.file("log", (0..scans).map(line).collect::<String>())
}

fn start(env: &TestEnv, words: &[&str]) -> Program {
    env.start(&[&["replay", "--json", "--no-system-config"], words].concat()).ready()
}

/// Returns the wall-clock times of the scans, in milliseconds since the start of the log.
fn wall_times_ms(outcome: &Outcome) -> Vec<u64> {
    outcome.of_class("scan").iter().map(|scan| number(scan, "wall_ns") / 1_000_000 - 1_000_000).collect()
}

fn replay_summary(outcome: &Outcome) -> Value {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    outcome.of_class("replayed").pop().unwrap_or_else(|| panic!("no summary of the replay: {outcome}"))
}

fn resume(env: &TestEnv) {
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
}

#[test]
fn plays_whole_recording_with_its_times_after_resume() {
    let env = TestEnv::new();
    let player = start(&env, &[&log(&env, 12, 80), "--paused"]);
    let mut subscriber = env.echo(&["front/scan", "front/status"]);
    env.await_info("front", |info| info["state"] == "paused");
    resume(&env);
    subscriber.await_line("the end", |line| line["state"] == "silent");
    let end = replay_summary(&player.wait());
    assert_eq!((number(&end, "telegrams"), number(&end, "laps")), (12, 0));
    assert_eq!(end["position_s"], 0.88);
    assert!(end["paused_s"].as_f64() > Some(0.0), "{end}");
    subscriber.await_line("the end", |line| line["kind"] == "hub_gone");
    let outcome = subscriber.end(INT);
    assert_eq!(wall_times_ms(&outcome), (0..12).map(|scan| scan * 80).collect::<Vec<_>>());
    let stamps: Vec<_> = outcome.of_class("scan").iter().map(|scan| number(scan, "stamp_ns")).collect();
    assert!(stamps.windows(2).all(|pair| pair[1] - pair[0] == 80_000_000), "{stamps:?}");
}

#[test]
fn replay_plays_a_time_range_faster() {
    let env = TestEnv::new();
    let player = start(&env, &[&log(&env, 60, 100), "--paused", "--start=2s", "--end=4s", "--rate=4"]);
    let mut subscriber = env.echo(&["front/scan", "front/status"]);
    resume(&env);
    subscriber.await_line("the end", |line| line["state"] == "silent");
    let outcome = subscriber.end(INT);
    assert_eq!(wall_times_ms(&outcome), (20..40).map(|scan| scan * 100).collect::<Vec<_>>());
    let scans = outcome.of_class("scan");
    assert_eq!((number(&scans[0], "seq"), number(&scans[0], "topic_seq")), (0, 0));
    let stamps: Vec<_> = scans.iter().map(|scan| number(scan, "stamp_ns")).collect();
    assert!(stamps.windows(2).all(|pair| pair[1] - pair[0] == 25_000_000), "{stamps:?}");
    assert_eq!(number(&replay_summary(&player.wait()), "telegrams"), 20);
}

/// Writes a log of an LMS at half degrees whose robot turns in a room at an increasing rate.
fn log_of_turning_robot(env: &TestEnv, scans: u64) -> String {
    const PERIOD_S: f64 = 0.026_64;
    let range = |angle: f64| {
        let walls = [(3.0, 0.0), (2.0, 90.0), (4.0, 180.0), (2.5, 270.0_f64)];
        let to = |(distance, normal): (f64, f64)| (distance, (angle - normal).to_radians().cos());
        let ahead = walls.into_iter().map(to).filter(|(_, cos)| *cos > 1e-3);
        ahead.map(|(distance, cos)| distance / cos).fold(f64::INFINITY, f64::min)
    };
    let line = |scan: u64| {
        let yaw = 0.02 * (scan * scan) as f64;
        let ranges: Vec<_> =
            (0..361).map(|i| format!("{:.3}", range(yaw - 90.0 + 0.5 * f64::from(i)))).collect();
        let at = 1000.0 + scan as f64 * PERIOD_S;
        format!("FLASER 361 {} 0 0 0 0 0 0 {at:.5} host {at:.5}\n", ranges.join(" "))
    };
    env.file("turning", (0..scans).map(line).collect::<String>())
}

#[test]
fn motion_is_the_same_at_all_rates() {
    const SCAN_COUNT: u64 = 60;
    let env = TestEnv::new();
    let log = log_of_turning_robot(&env, SCAN_COUNT);
    let motion = |rate: &str| {
        let player = start(&env, &[&log, "--paused", "--set=link.front.background.method=moving", rate]);
        let mut subscriber = env.echo(&["front/motion", "front/status"]);
        resume(&env);
        subscriber.await_line("the end", |line| line["state"] == "silent");
        let outcome = subscriber.end(INT);
        assert_eq!(number(&replay_summary(&player.wait()), "telegrams"), SCAN_COUNT);
        let keys =
            ["method", "dx_m", "dy_m", "dyaw_deg", "covariance", "x_m", "y_m", "yaw_deg", "pose_covariance"];
        let values = |line: &Value| (number(line, "seq"), keys.map(|key| line[key].clone()));
        outcome.of_class("motion").iter().map(values).collect::<BTreeMap<_, _>>()
    };
    let recorded = motion("--rate=1");
    assert_eq!(recorded.len() as u64, SCAN_COUNT);
    assert!(recorded.values().skip(1).all(|values| values[0] != "first" && values[0] != "refused"));
    for rate in ["--rate=0.5", "--rate=4", "--rate=max"] {
        let found = motion(rate);
        // At the rate `max`, a subscriber may miss samples.
        assert!(found.len() as u64 > SCAN_COUNT / 2, "{rate}: {}", found.len());
        for (seq, values) in found {
            assert_eq!(Some(&values), recorded.get(&seq), "{rate}, scan {seq}");
        }
    }
}

#[test]
fn loops_until_interrupted() {
    let env = TestEnv::new();
    let player = start(&env, &[&log(&env, 5, 20), "--loop"]);
    let mut subscriber = env.echo(&["front/scan"]);
    let scans = subscriber.await_lines(12, "a scan", is_class("scan"));
    let walls: Vec<_> = scans.iter().map(|scan| number(scan, "wall_ns") / 1_000_000 - 1_000_000).collect();
    assert!(walls.iter().filter(|wall| **wall == 0).count() >= 2, "{walls:?}");
    assert!(number(&replay_summary(&player.end(INT)), "laps") >= 2);
}

#[test]
fn hold_keeps_the_hub_running_and_pause_stops_it() {
    let env = TestEnv::new();
    let player = start(&env, &[&log(&env, 100, 100), "--sensor=left", "--hold"]);
    assert_eq!(env.run(&["control", "left", "pause"]).exit_code, Some(0));
    env.await_info("left", |info| info["state"] == "paused");
    assert!(number(&replay_summary(&player.end(TERM)), "telegrams") < 100);
    let player = start(&env, &[&log(&env, 100, 100), "--rate=max", "--hold"]);
    let info = env.await_info("front", |info| info["state"] == "silent");
    assert_eq!((number(&info["counters"], "telegrams"), &info["angle_deg"]), (100, &180.into()));
    // The replay holds at the end of the recording. Without `--hold`, it would have exited after a second.
    assert_eq!(number(&replay_summary(&player.end(TERM)), "telegrams"), 100);
}

/// Writes a recording of two runs of a hub. Each run has ten telegrams, and the sixth telegram reports how the values
/// are encoded. `format_versions` has a `seq` for each run. From this telegram on, the recorded hub knew the encoding
/// and published marks.
fn recording_of_two_runs(env: &TestEnv, format_versions: [u64; 2]) -> String {
    let file = std::fs::File::create(env.path("lives.mcap")).expect("a file");
    let mut writer = Writer::begin(file, "", BTreeMap::new()).expect("a new recording");
    for (run, understood) in format_versions.into_iter().enumerate() {
        for seq in 0..10 {
            let reply = lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10);
            let telegram = if seq == 5 { reply.bytes().to_vec() } else { testkit::scan(seq as u16) };
            let at = (run as u64 * 20 + seq) * 20_000_000;
            let (stamp_first_ns, stamp_last_ns) = (1_000_000_000 + at, 1_010_000_000 + at);
            let mut header = Header {
                seq,
                topic_seq: seq,
                stamp_first_ns,
                stamp_last_ns,
                wall_ns: 1_700_000_000_000_000_000 + at,
                boot: 7 + run as u64,
                hub_pid: 1,
                period_us: 26_640,
                ..Header::default()
            };
            header.set_sent_at(stamp_last_ns + 1000);
            writer.write_sample("front", Topic::Telegram, &header, &telegram).expect("a written sample");
            if seq != 5 && seq >= understood {
                let mut room = [0; 4096];
                let len = Marks::default().pack(&mut room).expect("a buffer that is large enough");
                writer.write_sample("front", Topic::Marks, &header, &room[..len]).expect("a written sample");
            }
        }
    }
    writer.finish().expect("a complete recording");
    env.path("lives.mcap").display().to_string()
}

/// Writes a recording of 20 s. Six of ten scans are missing, as on a bad line, and there is a pause of two seconds in
/// the middle.
fn recording_with_gaps(env: &TestEnv) -> String {
    let file = std::fs::File::create(env.path("lossy.mcap")).expect("a file");
    let mut writer = Writer::begin(file, "", BTreeMap::new()).expect("a new recording");
    let is_lost = |scan: &u64| scan % 10 > 3 || (300..375).contains(scan);
    for (seq, scan) in (0..750).filter(|scan| !is_lost(scan)).enumerate() {
        let at = scan * 26_640_000;
        let seq = seq as u64;
        let mut header = Header {
            seq,
            topic_seq: seq,
            stamp_first_ns: 1_000_000_000 + at,
            stamp_last_ns: 1_014_000_000 + at,
            wall_ns: 1_700_000_000_000_000_000 + at,
            boot: 7,
            hub_pid: 1,
            period_us: 26_640,
            ..Header::default()
        };
        header.set_sent_at(header.stamp_last_ns + 1000);
        writer
            .write_sample("front", Topic::Telegram, &header, &testkit::scan(seq as u16))
            .expect("a written sample");
    }
    writer.finish().expect("a complete recording");
    env.path("lossy.mcap").display().to_string()
}

#[test]
fn missing_scans_are_not_reported_as_silence() {
    let env = TestEnv::new();
    let player = start(&env, &[&recording_with_gaps(&env), "--rate=2", "--set=link.front.mode=0", "--hold"]);
    testkit::wait_until("a rate in the list", || {
        let listed = env.run(&["list", "--json"]);
        assert_eq!(listed.exit_code, Some(0), "{listed}");
        let rate =
            listed.lines().into_iter().find(|line| line["topic"] == "scan").map(|line| line["hz"].clone());
        // The recording has 15 of the 37.5 scans per second. The replay is twice as fast, so `list` reports about 30.
        rate.and_then(|rate| rate.as_f64()).is_some_and(|hz| (15.0..60.0).contains(&hz))
    });
    env.await_info("front", |info| info["last_error"] == "the recording is at its end");
    let outcome = player.end(INT);
    let count_in_log = |word: &str| outcome.stderr.lines().filter(|line| line.contains(word)).count();
    // Each of the two messages is logged twice: `silent` for the pause and for the end, `streaming` before each of
    // them.
    assert_eq!((count_in_log("front: silent"), count_in_log("front: streaming")), (2, 2), "{outcome}");
}

#[test]
fn replay_has_no_scans_while_the_mode_is_unknown() {
    // In each case, the recorded hub knew the encoding in one of the two runs from the start, because an earlier run
    // had saved it.
    for understood in [[0, 6], [6, 0]] {
        let env = TestEnv::new();
        let player = start(&env, &[&recording_of_two_runs(&env, understood), "--paused"]);
        let mut subscriber = env.echo(&["front/scan", "front/status"]);
        resume(&env);
        subscriber.await_line("the end", |line| line["last_error"] == "the recording is at its end");
        let scans: Vec<_> =
            subscriber.end(INT).of_class("scan").iter().map(|scan| number(scan, "seq")).collect();
        assert_eq!(number(&replay_summary(&player.wait()), "telegrams"), 20);
        let of = |run: u64, from| (from..10).filter(|seq| *seq != 5).map(move |seq| 10 * run + seq);
        assert!(scans.iter().copied().eq(of(0, understood[0]).chain(of(1, understood[1]))), "{scans:?}");
    }
}

#[test]
fn ignores_configured_links_that_were_not_recorded() {
    let env = TestEnv::new();
    let text = "[[link]]\nname = \"front\"\nport = \"/dev/x\"\npose = { x = 0.25 }\n[[link]]\nname = \"rear\"\nport = \"y\"\n";
    let config = format!("--config={}", env.file("config.toml", text));
    let player = start(&env, &[&log(&env, 3, 100), &config, "--hold"]);
    assert_eq!(env.info("front")["pose"]["x_m"], 0.25);
    let outcome = player.end(INT);
    assert_eq!(outcome.of_class("ready")[0]["sensors"], Value::from(vec!["front"]));
    assert!(outcome.stderr.contains("rear: not in the recording, ignored"), "{outcome}");
}

#[test]
fn refuses_bad_ranges_rates_and_sensors() {
    let env = TestEnv::new();
    let log = log(&env, 3, 100);
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vectors/recording/v1.mcap");
    for (words, code, message) in [
        (&["/no/such/file"][..], 66, "cannot read recording /no/such/file"),
        (&[&log, "--start=2s", "--end=1s"], 2, "--end 1s is not after --start 2s"),
        (&[&log, "--end=0s"], 2, "--end 0ns is not after --start 0ns"),
        (&[&log, "--rate=0"], 2, "--rate"),
        (&[&log, "--loop", "--hold"], 2, "--loop"),
        (&[&log, "--start=201ms"], 2, "which lasts 0.200 s"),
        (&[&log, "--start=1h", "--hold"], 2, "--start 3600 s is after the end of "),
        (&[&log, "--sensor=Front"], 2, "sensor name \"Front\" is not possible"),
        (&[golden, "--sensor=left"], 3, "has no sensor \"left\""),
    ] {
        let outcome = env.run(&[&["replay"], words].concat());
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        assert!(outcome.stderr.contains(message), "{outcome}");
    }
}

#[test]
fn keys_control_the_replay() {
    let env = TestEnv::new();
    let words = ["replay", "--no-system-config", "--paused", &log(&env, 300, 100)];
    let mut sitting = TerminalSession::start(&env.command(&words), (100, 30));
    sitting.wait_for_text("paused; space continues");
    let await_text =
        |sitting: &TerminalSession, word: &str| testkit::wait_until(word, || sitting.text().contains(word));
    sitting.press(".");
    await_text(&sitting, "  1 telegrams  paused");
    sitting.press("\x1b[C");
    await_text(&sitting, "  2 telegrams  paused");
    sitting.press("--");
    await_text(&sitting, "  x0.25  2 telegrams  paused");
    sitting.press("+++ ");
    await_text(&sitting, "  x2  ");
    await_text(&sitting, "space pauses");
    sitting.press(" ");
    env.await_info("front", |info| info["state"] == "paused");
    sitting.press("q");
    let (code, text, is_as_before) = sitting.finish_plain();
    assert_eq!((code, is_as_before), (Some(0), true), "{text}");
    let last = text.lines().last().unwrap_or_default();
    assert!(last.contains("replayed ") && last.contains(" telegrams up to 0:"), "{text}");
}

#[test]
fn signal_restores_the_terminal() {
    for signal in [INT, TERM] {
        let env = TestEnv::new();
        let words = ["replay", "--no-system-config", &log(&env, 300, 100)];
        let sitting = TerminalSession::start(&env.command(&words), (100, 30));
        sitting.wait_for_text("space pauses");
        sitting.signal(signal);
        let (code, text, is_as_before) = sitting.finish_plain();
        assert_eq!((code, is_as_before), (Some(0), true), "{text}");
    }
}

#[test]
fn replay_ends_when_its_terminal_closes() {
    let env = TestEnv::new();
    let words = ["replay", "--no-system-config", "--loop", "--paused", &log(&env, 300, 100)];
    let errors = env.path("errors");
    let file = std::fs::File::create(&errors).expect("a file");
    let sitting = TerminalSession::start_for_hang_up(&env.command(&words), (100, 30), true, file);
    sitting.wait_for_text("ready ");
    sitting.hang_up();
    let errors = std::fs::read_to_string(errors).expect("the error output");
    assert!(!errors.contains("panicked"), "{errors}");
}
