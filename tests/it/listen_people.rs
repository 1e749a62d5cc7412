//! `scanhub listen` with people: the listener prints tracks and events of another machine in the same format as local
//! ones.

use crate::testkit::{INT, TestEnv, TestGateway, in_a_network, is_class};
use scanhub_schema::{Event, EventKind, Pose, PublisherKind, Topic, Track, TrackSensor, Tracks};
use serde_json::json;

#[test]
fn listen_prints_tracks_and_events_of_a_remote_hub() {
    in_a_network("listen_people::listen_prints_tracks_and_events_of_a_remote_hub", || {
        let env = TestEnv::new();
        let mut program = env.start(&["listen", "--json"]).ready();
        let mut sender = TestGateway::new(0x5f3a_12bc_00d1_e2f3, 7, 200, "house");
        sender.announce(PublisherKind::Tracker.topics());
        let mut tracks = Tracks::default();
        tracks.push_sensor(TrackSensor::new("front", &Pose::default()));
        tracks.push(Track { id: 9, x_m: 1.5, sensors: 1, state: 2, ..Track::default() });
        sender.send(Topic::Tracks, &tracks);
        sender.send(Topic::Events, &Event::new(EventKind::Left, 9, Some("hall")));
        let event = program.await_line("an event", is_class("event"));
        let line = &program.end(INT).of_class("tracks")[0];
        let track = &line["tracks"][0];
        assert_eq!([&line["sensor"], &line["hub"]], [&json!("house"), &json!("5f3a12bc00d1e2f3")]);
        assert_eq!(
            [&track["id"], &track["x_m"], &track["sensors"]],
            [&json!(9), &json!(1.5), &json!(["front"])]
        );
        assert_eq!((&track["state"], &track["room"]), (&json!("hidden"), &json!(null)));
        assert_eq!(
            [&event["kind"], &event["room"], &event["id"]],
            [&json!("left"), &json!("hall"), &json!(9)]
        );
    });
}
