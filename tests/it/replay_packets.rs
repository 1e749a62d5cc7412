//! Tests of recordings of rotating scanners: the packets of these scanners are replayed like telegrams of an LMS, and
//! the replay publishes the same scans as the hub that was recorded.

use std::collections::BTreeMap;
use std::path::Path;

use crate::testkit::Recording;
use crate::testkit::{INT, Program, TERM, TestEnv, is_class, number};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{self, Writer};
use scanhub_schema::{Family, Flags, Header, Reasons, Scan, Topic};
use serde_json::Value;

/// Starts a recorder with `flags` and waits until it is attached.
pub(crate) fn recorder(env: &TestEnv, name: &str, flags: &[&str]) -> Program {
    let file = env.path_argument(name);
    let before = env.subscribers("front/telegram");
    let recorder = env.start(&[&["record", "--json", "-o", &file], flags].concat());
    crate::testkit::wait_until("the recorder is attached", || env.subscribers("front/telegram") > before);
    recorder
}

/// Records two files, `all.mcap` and `telegrams.mcap`, until a subscriber has received `scans` scans. The scanner has
/// the model `model`, and its line has faults.
fn record(env: &TestEnv, model: &str, settings: &[&str], scans: usize) {
    let set = ["family=ld"].iter().chain(settings).map(|set| format!("--set=link.front.{set}"));
    let hub = env.hub(&[vec![env.link("front")], set.collect()].concat());
    let recorders = [recorder(env, "all.mcap", &["--all"]), recorder(env, "telegrams.mcap", &["*/telegram"])];
    let mut echo = env.echo(&["front/scan"]);
    let model = format!("--model={model}");
    let faults = "--fault=loss=0.004,burst=40";
    let words = ["--family=ld", &model, "--world=room", "--seed=5", faults];
    let simulator = env.simulator(&["front"], &words);
    echo.await_lines(scans, "a scan", is_class("scan"));
    for recorder in recorders {
        assert_eq!(recorder.end(INT).exit_code, Some(0));
    }
    assert_eq!((echo.end(INT).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

/// Replays `name` with the flags `words`, and records the result in `replayed.mcap`. Returns the last line of `replay`.
pub(crate) fn replay(env: &TestEnv, name: &str, words: &[&str]) -> Value {
    let file = env.path_argument(name);
    let words = [&["replay", "--json", "--no-system-config", "--paused", &file], words].concat();
    let player = env.start(&words).ready();
    let recorder = recorder(env, "replayed.mcap", &["--all", "--force"]);
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    let outcome = player.wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert_eq!(recorder.end(INT).exit_code, Some(0));
    outcome.of_class("replayed").pop().expect("a summary")
}

/// Returns the headers and payloads of all samples of `topic` in a file.
pub(crate) fn samples(file: &Path, topic: &str) -> Vec<(Header, Vec<u8>)> {
    let recording = Recording::read_complete(file);
    let parts = |data: &[u8]| file::split_message(data).map(|(header, payload)| (header, payload.to_vec()));
    recording.of(topic).iter().map(|message| parts(&message.data).expect("a sample")).collect()
}

pub(crate) fn scan(payload: &[u8]) -> Box<Scan> {
    let mut scan = Box::default();
    assert!(Scan::unpack_into(&mut scan, payload));
    scan
}

/// Asserts that recorded scans are replayed unchanged. Does not compare stamps, because they depend on when the hub was
/// scheduled. `tests/world` checks the stamps of a live stream in virtual time (invariant `turns`).
fn check_scans(recorded: &[(Header, Vec<u8>)], replayed: &[(Header, Vec<u8>)]) {
    let by_seq: BTreeMap<u64, _> =
        replayed.iter().map(|(header, payload)| (header.seq, (header, payload))).collect();
    let (mut compared, mut incomplete, mut suspect, mut absent) = (0, 0, 0, Vec::new());
    for (header, payload) in recorded {
        let Some((played, bytes)) = by_seq.get(&header.seq) else {
            absent.push(header.seq);
            continue;
        };
        let (then, now) = (scan(payload), scan(bytes));
        assert_eq!(then.ranges(), now.ranges(), "{}", header.seq);
        let exact =
            |scan: &Scan| (0..scan.beams()).map(|beam| scan.angle(beam).to_bits()).collect::<Vec<_>>();
        assert_eq!(exact(&then), exact(&now), "{}", header.seq);
        assert_eq!(then.intensities(), now.intensities());
        assert_eq!((then.flags, then.collisions, then.family), (now.flags, now.collisions, now.family));
        let line_error = Reasons::LINE_ERROR;
        assert_eq!(header.reasons & !line_error, played.reasons & !line_error, "{}", header.seq);
        assert_eq!(played.flags & Flags::REPLAYED, Flags::REPLAYED);
        compared += 1;
        incomplete += u32::from(then.is_incomplete());
        suspect += u32::from(header.reasons != 0);
    }
    // On a busy machine, the recorder may miss scans of the replay. The `topic_seq` of the others shows how many.
    let gap = |pair: &[(Header, Vec<u8>)]| pair[1].0.topic_seq - pair[0].0.topic_seq - 1;
    let missed: u64 = replayed.windows(2).map(gap).sum();
    assert!(absent.len() as u64 <= missed, "no scans of {absent:?}, {missed} missed");
    assert!(compared > 20, "{compared} of {}", recorded.len());
    assert!(incomplete > 0 && suspect > 0, "the faults did nothing: {incomplete} {suspect}");
}

#[test]
fn replayed_scans_equal_recorded_scans() {
    let env = TestEnv::new();
    record(&env, "ld19", &[], 45);
    let recorded = samples(&env.path("all.mcap"), "front/scan");
    let packets = samples(&env.path("telegrams.mcap"), "front/telegram");
    assert!(packets.iter().all(|(header, _)| header.family() == Some(Family::Ld)));
    for name in ["telegrams.mcap", "all.mcap"] {
        let end = replay(&env, name, &[]);
        assert_eq!(number(&end, "telegrams"), samples(&env.path(name), "front/telegram").len() as u64);
        let file = env.path("replayed.mcap");
        let replayed = samples(&file, "front/telegram");
        let expected = samples(&env.path(name), "front/telegram");
        // On a busy machine, the recorder of the replay may miss some telegrams.
        assert!(replayed.len() > expected.len() / 2, "{name}: {} of {}", replayed.len(), expected.len());
        for (header, bytes) in &replayed {
            let (recorded, recorded_bytes) = &expected[header.topic_seq as usize];
            let is_equal = bytes == recorded_bytes
                && (header.reasons, header.wall_ns) == (recorded.reasons, recorded.wall_ns);
            assert!(is_equal, "{name}: telegram {} is not equal bit for bit", header.topic_seq);
        }
        check_scans(&recorded, &samples(&file, "front/scan"));
    }
    let info = |words: &[&str]| {
        let file = env.path_argument("all.mcap");
        let words =
            [&["replay", "--json", "--no-system-config", "--hold", "--rate=max", &file], words].concat();
        let player = env.start(&words).ready();
        let info = env.await_info("front", |info| info["last_error"] == "the recording is at its end");
        assert_eq!(player.end(TERM).exit_code, Some(0));
        info
    };
    let known = info(&[]);
    assert_eq!((&known["type"], number(&known, "angle_deg")), (&"LD19".into(), 360), "{known}");
    // A configured value takes precedence over a recorded value.
    let fewer = info(&["--set=link.front.beams=300"]);
    assert_eq!(fewer["step_deg"], 1.2, "{fewer}");
}

#[test]
fn replay_uses_the_recorded_number_of_beams() {
    let env = TestEnv::new();
    record(&env, "stl27l", &["model=stl27l", "beams=1000"], 25);
    let recorded = samples(&env.path("all.mcap"), "front/scan");
    replay(&env, "all.mcap", &[]);
    check_scans(&recorded, &samples(&env.path("replayed.mcap"), "front/scan"));
    // A recording that has only telegrams lacks the number of beams, so the replay uses the default of the model.
    replay(&env, "telegrams.mcap", &["--rate=max"]);
    let replayed = samples(&env.path("replayed.mcap"), "front/scan");
    assert!(!replayed.is_empty() && replayed.iter().all(|(_, payload)| scan(payload).beams() == 2_160));
}

#[test]
fn replays_a_part_and_in_a_loop() {
    let env = TestEnv::new();
    record(&env, "ld19", &[], 30);
    let recorded = samples(&env.path("all.mcap"), "front/scan");
    let end = replay(&env, "telegrams.mcap", &["--start=1s", "--end=2s", "--rate=2"]);
    assert!((0.9..=2.0).contains(&end["position_s"].as_f64().expect("seconds")), "{end}");
    let replayed = samples(&env.path("replayed.mcap"), "front/scan");
    assert!((8..=12).contains(&replayed.len()), "{} scans in a second", replayed.len());
    let ranges_of = |(_, payload): &(Header, Vec<u8>)| scan(payload).ranges().to_vec();
    let expected: Vec<_> = recorded.iter().map(ranges_of).collect();
    // The first and the last scan may contain only a part of a revolution.
    let inner = &replayed[1..replayed.len() - 1];
    let positions: Vec<_> =
        inner.iter().map(|scan| expected.iter().position(|ranges| *ranges == ranges_of(scan))).collect();
    let found: Vec<_> = positions.iter().flatten().collect();
    assert!(
        !found.is_empty() && found.is_sorted_by(|a, b| a < b),
        "other scans, or another order: {positions:?}"
    );
    // On a busy machine, the recorder may have missed scans. The replay nevertheless publishes them, because it
    // computes them from the telegrams.
    let is_complete = recorded.windows(2).all(|pair| pair[1].0.topic_seq == pair[0].0.topic_seq + 1);
    assert!(!is_complete || found.len() == inner.len(), "other scans: {positions:?}");
    assert!(replayed.windows(2).all(|pair| pair[0].0.stamp_first_ns < pair[1].0.stamp_first_ns));
    let file = env.path_argument("telegrams.mcap");
    let player =
        env.start(&["replay", "--json", "--no-system-config", "--loop", "--rate=max", &file]).ready();
    let mut echo = env.echo(&["front/scan"]);
    echo.await_lines(100, "scans of several laps", is_class("scan"));
    let outcome = player.end(INT);
    assert!(number(&outcome.of_class("replayed")[0], "laps") >= 2, "{outcome}");
}

#[test]
fn stream_file_is_played_by_the_scanners_clock() {
    let env = TestEnv::new();
    record(&env, "ld19", &[], 30);
    let (recording, bytes) = (env.path_argument("telegrams.mcap"), env.path_argument("telegrams.bin"));
    assert_eq!(env.run(&["convert", &recording, &bytes]).exit_code, Some(0));
    let recorded = samples(&env.path("all.mcap"), "front/scan");
    let family = "--set=link.front.family=ld";
    let words = ["replay", "--json", "--no-system-config", "--hold", "--paused", family, &bytes];
    let player = env.start(&words).ready();
    let mut echo = env.echo(&["front/scan"]);
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    let scans = echo.await_lines(20, "a scan", is_class("scan"));
    assert_eq!((echo.end(INT).exit_code, player.end(INT).exit_code), (Some(0), Some(0)));
    let stamps = |of: &Value| number(of, "stamp_ns") as i64;
    // The first revolution of the replay depends on the bytes before it, so scans are not matched by number, but by
    // their ranges.
    let ranges: Vec<Vec<Option<u64>>> = scans
        .iter()
        .map(|line| line["ranges"].as_array().expect("ranges").iter().map(Value::as_u64).collect())
        .collect();
    let then: Vec<Vec<Option<u64>>> = recorded
        .iter()
        .map(|(_, payload)| {
            let scan = scan(payload);
            (0..scan.beams()).map(|beam| scan.distance_mm(beam).map(u64::from)).collect()
        })
        .collect();
    let places: Vec<_> = ranges.iter().map(|ranges| then.iter().position(|other| other == ranges)).collect();
    assert!(places.iter().flatten().count() >= 18, "{places:?}");
    let known: Vec<_> =
        places.iter().zip(&scans).filter_map(|(place, line)| Some(((*place)?, line))).collect();
    for pair in known.windows(2) {
        // The replay computes the stamps from the scanner's clock alone, and the scanner makes ten revolutions per
        // second.
        let turns = (pair[1].0 - pair[0].0) as f64;
        let passed_s = (stamps(pair[1].1) - stamps(pair[0].1)) as f64 / 1e9;
        assert!((0.08..0.12).contains(&(passed_s / turns)), "{passed_s} s for {turns} turns");
    }
}

#[test]
fn refuses_recordings_of_another_family() {
    let env = TestEnv::new();
    record(&env, "ld19", &[], 25);
    let recording = env.path_argument("telegrams.mcap");
    let refused = |words: &[&str], code: i32, message: &str| {
        let outcome = env.run(&[words, &["--no-system-config"]].concat());
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        assert!(outcome.stderr.contains(message), "{outcome}");
    };
    refused(
        &["replay", &recording, "--set=link.front.family=lms"],
        78,
        "of family ld, and link front is of family lms",
    );
    refused(
        &["run", &format!("--link=front=file:{recording},family=lms")],
        78,
        "set link.front.family = \"ld\"",
    );
    let outcome = env.run(&["convert", &recording, &env.path_argument("x.log")]);
    assert_eq!(
        (outcome.exit_code, outcome.stderr.contains("a CARMEN log cannot hold")),
        (Some(66), true),
        "{outcome}"
    );
    let outcome = env.run(&["telegram", "decode", &recording]);
    assert_eq!((outcome.exit_code, outcome.stderr.contains("of family ld")), (Some(66), true), "{outcome}");
    let port = format!("--port={}", env.path_argument("other"));
    let outcome = env.run(&["simulate", &port, "--replay", &recording]);
    assert_eq!(
        (outcome.exit_code, outcome.stderr.contains("not a recording of an LMS")),
        (Some(66), true),
        "{outcome}"
    );
    // A recording of a family that this version does not support.
    let later = env.path("later.mcap");
    let mut writer = Writer::begin(std::fs::File::create(&later).expect("a file"), "", BTreeMap::new())
        .expect("a new recording");
    let header = Header { family: 99, hub_pid: 1, ..Header::default() };
    writer.write_sample("front", Topic::Telegram, &header, &[2; 47]).expect("a written sample");
    writer.finish().expect("a complete recording");
    let later = env.path_argument("later.mcap");
    refused(&["replay", &later], 66, "family number 99");
    let outcome = env.run(&["convert", &later, &env.path_argument("later.csv")]);
    assert_eq!(
        (outcome.exit_code, outcome.stderr.contains("family number 99")),
        (Some(66), true),
        "{outcome}"
    );
}

#[test]
fn convert_and_replay_give_the_same_scans() {
    let env = TestEnv::new();
    record(&env, "ld19", &[], 30);
    let rows = |name: &str| -> Vec<Vec<String>> {
        let (file, out) = (env.path_argument(name), env.path_argument("out.csv"));
        let outcome = env.run(&["convert", &file, &out, "--force"]);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let text = std::fs::read_to_string(env.path("out.csv")).expect("a CSV file");
        text.lines().skip(1).map(|row| row.split(',').map(str::to_owned).collect()).collect()
    };
    let (published, computed) = (rows("all.mcap"), rows("telegrams.mcap"));
    let ranges =
        |rows: &[Vec<String>]| rows.iter().map(|row| row[row.len() - 450..].to_vec()).collect::<Vec<_>>();
    // The recorder of `telegrams.mcap` ended last, so this file may have more scans at the end.
    assert!(
        published.len() > 20 && ranges(&computed).starts_with(&ranges(&published)),
        "{} {}",
        published.len(),
        computed.len()
    );
    // A stream file has no stamps, and it may start within a revolution.
    let (bytes, again) = (env.path_argument("telegrams.bin"), env.path_argument("again.mcap"));
    for (from, to) in [(&env.path_argument("telegrams.mcap"), &bytes), (&bytes, &again)] {
        assert_eq!(env.run(&["convert", from, to]).exit_code, Some(0));
    }
    let all = |name: &str| {
        samples(&env.path(name), "front/telegram")
            .into_iter()
            .flat_map(|(_, bytes)| bytes)
            .collect::<Vec<_>>()
    };
    assert!(all("again.mcap") == all("telegrams.mcap"));
    let ranges_again = ranges(&rows("again.mcap"));
    let same = ranges_again.iter().filter(|row| ranges(&computed).contains(row)).count();
    assert!(same + 2 >= ranges_again.len() && same > 20, "{same} of {}", ranges_again.len());
}
