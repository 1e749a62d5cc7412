//! Tests that a replay with the same parameters publishes the same samples as during the recording, byte for byte, and
//! that other parameters change them. Two sensors in simulated rooms with people are recorded in virtual time. The
//! recording is then replayed telegram by telegram.

#[path = "../testkit/recorded_rooms.rs"]
pub(crate) mod recorded_rooms;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::thread;
use std::time::{Duration, Instant};

use crate::testkit::{TestEnv, WAIT_TIMEOUT, in_own_process};
use recorded_rooms::{PublishedSample, SENSORS, SHORT_LEARNING, Subscribers};
use scanhub_config::Sources;
use scanhub_daemon::{PlaybackOptions, Player, Replay};
use scanhub_schema::{Flags, Topic};
use scanhub_shm::{Domain, Node};

const SCAN_COUNT: u64 = 400;
/// Index of the scan before which both sensors are silent for a second.
const SILENCE_AT_SCAN: u64 = 300;

/// Records two sensors. Returns the path of the file, and the samples that each sensor published.
fn record(env: &TestEnv) -> (PathBuf, Vec<Vec<PublishedSample>>) {
    let (file, mut published) = (env.path("two.mcap"), vec![Vec::new(), Vec::new()]);
    recorded_rooms::record(&env.domain(), &file, SCAN_COUNT, Some(SILENCE_AT_SCAN), |number, sample| {
        published[number].push(sample)
    });
    (file, published)
}

/// Replays `file` step by step. Returns the samples that were published for each sensor.
fn replay(env: &TestEnv, file: &Path, play: PlaybackOptions, set: &[&str]) -> Vec<Vec<PublishedSample>> {
    let set = set.iter().map(|word| (*word).to_owned()).collect();
    let sources = Sources { set, ..Sources::default() };
    let replay = Replay { file, sensor: None, family: None, sources: &sources, options: play, holds: false };
    let mut published = vec![Vec::new(), Vec::new()];
    let mut telegrams = 0;
    step_through(
        &env.domain(),
        &replay,
        |node| SENSORS.map(|(name, _)| Subscribers::attach(node, name)),
        |subscribers| {
            for (subscribers, published) in subscribers.iter().zip(&mut published) {
                let samples = subscribers.take();
                telegrams += samples.iter().filter(|sample| sample.topic == Topic::Telegram).count() as u64;
                published.extend(samples);
            }
            telegrams
        },
    );
    // Leave out samples that do not belong to a telegram: those before the first telegram, and those of the silence
    // after the end.
    let is_around =
        |it: &PublishedSample| it.header.hub_time_ns().is_none() && [0, SCAN_COUNT].contains(&it.header.seq);
    published.iter_mut().for_each(|published| published.retain(|it| !is_around(it)));
    published
}

/// Plays a recording step by step, with subscribers attached before the first telegram. `take` takes the samples that
/// have arrived, and returns the number of telegrams that have arrived since the start.
pub(crate) fn step_through<T>(
    domain: &Domain,
    replay: &Replay<'_>,
    attach: impl FnOnce(&Node) -> T,
    mut take: impl FnMut(&T) -> u64,
) {
    let replay = Replay { options: PlaybackOptions { is_paused: true, ..replay.options }, ..replay.clone() };
    let (sender, ready) = channel();
    thread::scope(|scope| {
        let replay = &replay;
        let hub = scope.spawn(move || {
            let result = scanhub_daemon::replay(replay, domain, |_, player| {
                sender.send(player.clone()).expect("a waiting test")
            });
            result.inspect_err(|failure| eprintln!("{failure}"))
        });
        let player: Arc<Player> = ready.recv_timeout(WAIT_TIMEOUT).expect("a started player");
        let node = scanhub_shm::client_node(domain).expect("a node");
        let subscribers = attach(&node);
        let give_up_at = Instant::now() + 3 * WAIT_TIMEOUT;
        while !player.progress().is_over {
            assert!(Instant::now() < give_up_at, "the recording does not end");
            let before = take(&subscribers);
            player.step();
            // If this step is a silence, it publishes no telegram. Therefore wait only for a short time.
            let patience = Instant::now() + Duration::from_millis(50);
            while take(&subscribers) == before && !player.progress().is_over && Instant::now() < patience {
                thread::yield_now();
            }
        }
        // If the replay holds at the end, wait until the hub has reported the silence after the end.
        let until = Instant::now() + Duration::from_millis(if replay.holds { 1_000 } else { 0 });
        while Instant::now() <= until {
            take(&subscribers);
            thread::sleep(Duration::from_millis(10));
        }
        take(&subscribers);
        player.end();
        hub.join().expect("a thread that does not panic").expect("a run without an error");
    });
}

/// Returns sequence number, topic, reasons and payload of all samples, sorted, so that samples of one telegram are
/// adjacent.
fn sorted_samples(published: &[PublishedSample]) -> Vec<(u64, Topic, u8, &[u8])> {
    let of = |it: &'_ PublishedSample| (it.header.seq, it.topic, it.header.reasons);
    let mut samples: Vec<_> = published.iter().map(|it| (of(it), &it.payload[..])).collect();
    samples.sort();
    samples.into_iter().map(|((seq, topic, reasons), payload)| (seq, topic, reasons, payload)).collect()
}

/// Returns the payloads of one topic.
fn payloads(published: &[PublishedSample], topic: Topic) -> Vec<&[u8]> {
    published.iter().filter(|it| it.topic == topic).map(|it| &it.payload[..]).collect()
}

#[test]
fn replay_equals_recording_with_the_same_parameters() {
    in_own_process("replayed::replay_equals_recording_with_the_same_parameters", || {
        let env = TestEnv::new();
        let (file, recorded) = record(&env);
        let replayed = replay(&env, &file, PlaybackOptions::default(), &[SHORT_LEARNING]);
        for ((recorded, replayed), (name, _)) in recorded.iter().zip(&replayed).zip(SENSORS) {
            let count = |topic| [replayed, recorded].map(|published| payloads(published, topic).len());
            for topic in [Topic::Telegram, Topic::Scan, Topic::Marks, Topic::Foreground, Topic::Background] {
                let [replayed, recorded] = count(topic);
                assert_eq!(replayed, recorded, "{name}/{}", topic.name());
            }
            let [_, zones] = count(Topic::Zones);
            assert_eq!(zones, SCAN_COUNT as usize + 1, "one sample must report that no scans arrived");
            assert!(count(Topic::Background)[1] > 5, "the background did not change");
            assert!(sorted_samples(recorded) == sorted_samples(replayed), "{name} differs");
            assert!(replayed.iter().all(|it| it.header.flags & Flags::REPLAYED != 0));
            let walls = |published: &[PublishedSample]| -> Vec<u64> {
                published
                    .iter()
                    .filter(|it| it.topic == Topic::Telegram)
                    .map(|it| it.header.wall_ns)
                    .collect()
            };
            assert_eq!(walls(recorded), walls(replayed), "{name}");
        }
        let others =
            replay(&env, &file, PlaybackOptions::default(), &[SHORT_LEARNING, "zones.radii=[2.5,1.5]"]);
        assert!(payloads(&others[0], Topic::Zones) != payloads(&recorded[0], Topic::Zones));
        assert!(payloads(&others[0], Topic::Foreground) == payloads(&recorded[0], Topic::Foreground));
    });
}

#[test]
fn background_learns_from_skipped_scans() {
    in_own_process("replayed::background_learns_from_skipped_scans", || {
        let env = TestEnv::new();
        let (file, recorded) = record(&env);
        let play = PlaybackOptions { start_ns: 5_000_000_000, ..PlaybackOptions::default() };
        let replayed = replay(&env, &file, play, &[SHORT_LEARNING]);
        for (recorded, replayed) in recorded.iter().zip(&replayed) {
            for topic in [Topic::Scan, Topic::Marks, Topic::Zones, Topic::Foreground] {
                let (all, late) = (payloads(recorded, topic), payloads(replayed, topic));
                assert!(
                    late.len() > 100 && late.len() < 300 && all.ends_with(&late),
                    "{}: {}",
                    topic.name(),
                    late.len()
                );
            }
        }
    });
}
