//! Tests of `scanhub track` and `scanhub site`, from telegrams to tracks. A person walks from room to room, a replay
//! gives identical tracks, a site file names an unknown sensor, and a plan is drawn only once.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::thread;

use crate::pages::examples_on;
use crate::recorded_world::{START_NS, recorded_world};
use crate::testkit::{
    INT, Program, TERM, TestEnv, WAIT_TIMEOUT, in_own_process, is_class, number, wait_until,
};
use scanhub_config::Sources;
use scanhub_daemon::{PlaybackOptions, Player, Replay};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Event, EventKind, TrackState, Tracks};
use scanhub_shm::{Node, Payload, Subscriber};
use scanhub_sim::world::World;

pub(crate) const SITE_FILE: &str = r#"
[[sensor]]
name = "hall"
pose = { x = 0.1, y = 0.1, yaw = 0.7854 }
[[sensor]]
name = "kitchen"
pose = { x = 11.9, y = 0.1, yaw = 2.3562 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 5], [0, 5]]
[[room]]
name = "kitchen"
polygon = [[6, 0], [12, 0], [12, 5], [6, 5]]
[[door]]
name = "middle"
from = "hall"
to = "kitchen"
between = [[6, 2], [6, 3]]
"#;

const WORLD: &str = r#"
[[sensor]]
pose = [100, 100, 45]
[[sensor]]
pose = [11900, 100, 135]
[[thing]]
line = [[0, 0], [12000, 0], [12000, 5000], [0, 5000], [0, 0]]
[[thing]]
line = [[6000, 0], [6000, 2000]]
[[thing]]
line = [[6000, 3000], [6000, 5000]]
[[person]]
path = [[2000, 3500, 2], [5000, 2500], [7000, 2500], [9500, 2000, 60]]
speed_mm_s = 1000
from_s = 12
"#;

/// Writes a recording of both sensors that covers this number of seconds, and returns its path.
pub(crate) fn record_people(env: &TestEnv, seconds: u64) -> String {
    record_world(env, WORLD, seconds)
}

fn record_world(env: &TestEnv, world: &str, seconds: u64) -> String {
    let world = World::of_toml("world.toml", world).expect("a world");
    recorded_world(env, &world, &["hall", "kitchen"], seconds)
}

const SHORT_LEARNING: &str = "--set=background.scans=100";

/// Starts a paused replay of `file`.
pub(crate) fn replay(env: &TestEnv, file: &str) -> Program {
    env.start(&["replay", file, "--json", "--paused", "--hold", SHORT_LEARNING]).ready()
}

#[test]
fn person_is_tracked_between_rooms_and_counted_once() {
    let env = TestEnv::new();
    let site = env.file("site.toml", SITE_FILE);
    let _replay = replay(&env, &record_people(&env, 28));
    let mut counts = env.start(&["track", "--site", &site, "--count=middle", "--delay=2s", "--json"]);
    let (mut track, _record) = track_and_record(&env, &site, &env.path_argument("tracks.mcap"));
    let program = examples_on("docs/tracks.md", "house/tracks", &env).pop();
    let program = program.map(|example| Program::start(example.command(&env)));
    wait_until("a subscriber to counts", || {
        let listed = env.run(&["list", "--json"]).of_class("topic");
        let scans = listed.iter().filter(|line| line["topic"] == "scan" || line["topic"] == "foreground");
        scans.map(|line| number(line, "subscribers")).all(|subscribers| subscribers == 2)
    });
    for name in ["house", "hall"] {
        let refused = env.run(&["track", "--site", &site, "--as", name, "--for=20s"]);
        let words = format!("the name {name} is published by process ");
        assert!(refused.exit_code == Some(75) && refused.stderr.contains(&words), "{refused}");
    }
    env.run(&["control", "hall", "resume"]);
    let event =
        |kind: &'static str| move |line: &serde_json::Value| line["class"] == "event" && line["kind"] == kind;
    let appeared = track.await_line("a person", event("appeared"));
    assert_eq!((&appeared["room"], &appeared["sensor"]), (&"hall".into(), &"house".into()));
    let door = track.await_line("a person who goes through the door", event("door"));
    assert_eq!(door["id"], appeared["id"], "the same person: {door}");
    assert_eq!((&door["from"], &door["to"]), (&"hall".into(), &"kitchen".into()));
    assert_eq!(door["door"], "middle");
    let counted = counts.await_line("the count", is_class("count"));
    assert_eq!((number(&counted, "forth"), number(&counted, "back")), (1, 0));
    let stands = |line: &serde_json::Value| {
        let one = &line["tracks"][0];
        let near = |key: &str, at: f64| one[key].as_f64().is_some_and(|value| (value - at).abs() < 0.15);
        one["id"] == door["id"] && one["state"] == "confirmed" && near("x_m", 9.5) && near("y_m", 2.0)
    };
    let last = track.await_line("the place where the person stands", stands);
    assert_eq!((&last["class"], &last["sensor"]), (&"tracks".into(), &"house".into()));
    if let Some(mut program) = program {
        while !program.next_text().contains("1 confirmed kitchen") {}
        assert_eq!(program.end(TERM).stderr, "");
    }
    let outcome = track.end(INT);
    let summary = &outcome.of_class("summary")[0];
    assert_eq!((number(summary, "appeared"), number(summary, "invalid")), (1, 0), "{summary}");
    assert!(number(summary, "scans") > 500, "{summary}");
    assert_eq!(summary["doors"][0]["forth"], 1);
    assert!(counts.end(INT).of_class("tracks").is_empty(), "only counts must be printed");
}

/// Starts a tracker named `house`, and a recorder that writes telegrams and tracks to `file`. Waits until both are
/// attached to all of their topics.
fn track_and_record(env: &TestEnv, site: &str, file: &str) -> (Program, Program) {
    let track = env.start(&["track", "--site", site, "--as=house", "--delay=2s", "--json"]);
    await_tracker(env);
    let topics = ["hall/telegram", "kitchen/telegram", "house/tracks", "house/events"];
    let record = env.start(&[&["record", "--json", "-o", file][..], &topics].concat());
    for topic in topics {
        wait_until("a subscriber to each topic", || env.subscribers(topic) > 0);
    }
    (track, record)
}

/// Waits until the tracker `house` publishes its topics and is subscribed to those of the sensors.
fn await_tracker(env: &TestEnv) {
    wait_until("the tracker publishes", || {
        let listed = env.run(&["list", "--json"]).of_class("topic");
        listed.iter().any(|line| line["sensor"] == "house" && line["topic"] == "events")
    });
    for topic in ["hall/scan", "kitchen/scan", "hall/foreground", "kitchen/foreground"] {
        wait_until("subscriptions to the sensors", || env.subscribers(topic) > 0);
    }
}

/// Wall-clock stamps and payloads of the samples of a tracker's topic.
type PublishedSamples = Vec<(u64, Vec<u8>)>;

/// Plays `file` to a tracker. Plays each telegram only when the tracker has nearly processed the earlier ones, so that
/// the tracker misses nothing, however busy the machine is. Returns the tracks and the events that the tracker
/// published for the first twenty seconds of the world.
fn track_locally_and_remotely(env: &TestEnv, site: &str, file: &str) -> [PublishedSamples; 2] {
    let sources = Sources { set: vec!["background.scans=100".to_owned()], ..Sources::default() };
    let play = PlaybackOptions { is_paused: true, ..PlaybackOptions::default() };
    let replay = Replay {
        file: Path::new(file),
        sensor: None,
        family: None,
        sources: &sources,
        options: play,
        holds: true,
    };
    let domain = env.domain();
    let (sender, ready) = channel();
    thread::scope(|scope| {
        let hub = scope.spawn(|| {
            scanhub_daemon::replay(&replay, &domain, |_, player| sender.send(player.clone()).expect("a test"))
        });
        let player = StopPlayerOnDrop(ready.recv_timeout(WAIT_TIMEOUT).expect("a started player"));
        let delay = format!("--delay={}ms", DELAY_NS / 1_000_000);
        let track = env.start(&["track", "--site", site, "--as=house", &delay, "--json"]);
        await_tracker(env);
        let node = scanhub_shm::client_node(&domain).expect("a node");
        let telegrams = ["hall", "kitchen"].map(|sensor| attach::<[u8]>(&node, sensor));
        let (tracks, events) = (attach::<Tracks>(&node, "house"), attach::<Event>(&node, "house"));
        let (mut published, mut played_ns) = ([PublishedSamples::new(), PublishedSamples::new()], 0);
        while played_ns < START_NS + END_NS + DELAY_NS + LEAD_NS {
            let before = player.0.progress().telegrams;
            player.0.step();
            wait_until("the next telegram is played", || player.0.progress().telegrams > before);
            wait_until("the tracker catches up", || {
                for telegram in &telegrams {
                    take::<[u8]>(telegram, |wall_ns, _| played_ns = played_ns.max(wall_ns));
                }
                take::<Tracks>(&tracks, |wall_ns, payload| published[0].push((wall_ns, packed(payload))));
                take::<Event>(&events, |wall_ns, payload| published[1].push((wall_ns, packed(payload))));
                let shown_ns = published[0].last().map(|(wall_ns, _)| wall_ns + LEAD_NS);
                played_ns < shown_ns.unwrap_or(START_NS + 1_000_000_000 + FIRST_LEAD_NS) + DELAY_NS
            });
        }
        let outcome = track.end(INT);
        let summary = &outcome.of_class("summary")[0];
        assert!(["missed", "late", "failed"].iter().all(|key| number(summary, key) == 0), "{summary}");
        drop(player);
        hub.join().expect("a thread that does not panic").expect("a run without an error");
        published.iter_mut().for_each(|samples| samples.retain(|(wall_ns, _)| *wall_ns <= START_NS + END_NS));
        published
    })
}

/// Time that the tracker waits for scans of other sensors, in nanoseconds.
const DELAY_NS: u64 = 300_000_000;
/// Time in nanoseconds by which the played scans may be ahead of the tracker's last sample, in addition to
/// [`DELAY_NS`]. It is less than [`DELAY_NS`] and more than the interval of the tracker's samples (40 ms).
const LEAD_NS: u64 = 160_000_000;
/// Time in place of [`LEAD_NS`] before the tracker's first sample, in nanoseconds. In this time, no sample shows what
/// the tracker has received. The sum of this time and [`DELAY_NS`] is long enough for the first sample. It is shorter
/// than the time of the 16 foregrounds that can be buffered for the tracker (426 ms).
const FIRST_LEAD_NS: u64 = 100_000_000;
/// End of the time whose samples are compared, in nanoseconds from the start of the world.
const END_NS: u64 = 20_000_000_000;

/// Ends the player when it is dropped, even in a panic. Otherwise the test would wait forever for the hub's thread.
struct StopPlayerOnDrop(Arc<Player>);

impl Drop for StopPlayerOnDrop {
    fn drop(&mut self) {
        self.0.end();
    }
}

fn attach<P: Payload + ?Sized>(node: &Node, sensor: &str) -> Subscriber<P> {
    let topic = P::open(node, sensor).expect("a topic").expect("an existing topic");
    P::subscriber(node, &topic).expect("a free slot")
}

fn take<P: Payload + ?Sized>(from: &Subscriber<P>, mut each: impl FnMut(u64, &P)) {
    while let Some(sample) = P::receive(from).expect("a working subscriber") {
        each(sample.user_header().wall_ns, P::read(&sample));
    }
}

fn packed(payload: &impl DatagramPayload) -> Vec<u8> {
    let mut room = vec![0; 100_000];
    let len = payload.pack(&mut room).expect("a buffer that is large enough");
    room.truncate(len);
    room
}

#[test]
fn replay_gives_identical_tracks_and_events() {
    in_own_process("track::replay_gives_identical_tracks_and_events", || {
        let env = TestEnv::new();
        let site = env.file("site.toml", SITE_FILE);
        let file = record_people(&env, 22);
        let [tracks, events] = track_locally_and_remotely(&env, &site, &file);
        assert!(tracks.len() > 300 && events.len() >= 2, "{} tracks, {} events", tracks.len(), events.len());
        let [tracks_again, events_again] = track_locally_and_remotely(&env, &site, &file);
        assert!(tracks == tracks_again, "{} and {} tracks", tracks.len(), tracks_again.len());
        assert_eq!(events, events_again);
        // The samples must have the same content as the lines that the tracker has printed.
        let is_door = |(_, payload): &&(u64, Vec<u8>)| {
            let mut event = Event::default();
            assert!(event.unpack(payload));
            event.kind() == Some(EventKind::Door) && event.door() == Some(("middle", "hall", "kitchen"))
        };
        assert_eq!(events.iter().filter(is_door).count(), 1);
        let mut last = Box::<Tracks>::default();
        assert!(tracks.iter().any(|(_, payload)| {
            assert!(last.unpack(payload));
            last.tracks().iter().any(|track| track.state() == TrackState::Confirmed)
        }));
        assert!(last.sensors().iter().map(|sensor| sensor.name()).eq(["hall", "kitchen"]));
    });
}

/// Compares the output of the program on the page with the lines of `track`, while both run.
#[test]
fn python_program_gets_all_events_live_and_in_order() {
    let env = TestEnv::new();
    let Some(example) = examples_on("docs/tracks.md", "house/events", &env).pop() else { return };
    let site = env.file("site.toml", SITE_FILE);
    let to_and_fro =
        WORLD.replace("[9500, 2000, 60]]", "[9500, 2000], [7000, 2500], [5000, 2500]]\nrepeat = true");
    let _replay = replay(&env, &record_world(&env, &to_and_fro, 45));
    let (mut track, record) = track_and_record(&env, &site, &env.path_argument("tracks.mcap"));
    let mut program = Program::start(example.command(&env));
    wait_until("two subscribers to events", || env.subscribers("house/events") == 2);
    env.run(&["control", "hall", "resume"]);
    let mut doors = 0;
    while doors < 3 {
        let event = track.await_line("an event", is_class("event"));
        let word = |key: &str| event[key].as_str().expect("a string").to_owned();
        let (id, kind, room) = (&event["id"], word("kind"), event["room"].as_str().unwrap_or("None"));
        let door = match kind.as_str() {
            "door" => format!(" from {} through {}", word("from"), word("door")),
            _ => String::new(),
        };
        doors += usize::from(kind == "door");
        assert_eq!(program.next_text(), format!("0 missed, {id} {kind} {room}{door}"), "{event}");
    }
    assert!(!track.has_ended() && !program.has_ended(), "it was live");
    drop((track, record));
}

#[test]
fn rejects_unknown_doors_sites_and_sensors() {
    let env = TestEnv::new();
    let site = env.file("site.toml", SITE_FILE);
    let wrong = env.run(&["track", "--site", &site, "--count=rear"]);
    assert_eq!(wrong.exit_code, Some(78), "{wrong}");
    assert!(wrong.stderr.contains("rear") && wrong.stderr.contains("middle"), "{wrong}");
    let missing = env.run(&["track", "--site", &env.path_argument("none.toml")]);
    assert_eq!(missing.exit_code, Some(66), "{missing}");
    let _hub = env.hub(&[env.link("hall")]);
    let unknown = env.run(&["track", "--site", &site, "--for=20s"]);
    assert_eq!(unknown.exit_code, Some(3), "{unknown}");
    assert!(unknown.stderr.contains("kitchen") && unknown.stderr.contains("hall"), "{unknown}");
}

#[test]
fn site_check_draws_a_valid_plan_once() {
    let env = TestEnv::new();
    let (site, svg) = (env.file("site.toml", SITE_FILE), env.path_argument("site.svg"));
    let checked = env.run(&["site", "check", &site, "--svg", &svg, "--json"]);
    assert_eq!(checked.exit_code, Some(0), "{checked}");
    assert_eq!(checked.lines()[0]["doors"][0], "middle");
    let drawn = std::fs::read_to_string(&svg).expect("a drawing");
    assert!(drawn.starts_with("<svg ") && drawn.contains(">kitchen<"), "{drawn}");
    assert_eq!(env.run(&["site", "check", &site, "--svg", &svg]).exit_code, Some(73), "it is there");
    let overlapping = env.file("bad.toml", SITE_FILE.replace("[[6, 0], [12, 0]", "[[5, 0], [12, 0]"));
    let refused = env.run(&["site", "check", &overlapping]);
    assert_eq!(refused.exit_code, Some(78), "{refused}");
    assert!(refused.stderr.contains("bad.toml:13:11: rooms hall and kitchen overlap"), "{refused}");
}
