//! Messages of a hub, without one.

use scanhub_ros::{Value, read};
use scanhub_schema::{
    CloudHead, CloudPoint, ForegroundHead, Marks, ScanHead, State, Track, TrackState, Tracks, Verdict, Zones,
};

use super::*;

/// So long after the start of both clocks.
fn at(ns: u64) -> Stamp {
    Stamp { monotonic_ns: ns, wall_ns: ns }
}

const SECOND_NS: u64 = 1_000_000_000;

fn header(seq: u64) -> Header {
    Header { seq, wall_ns: 100 * SECOND_NS + seq, period_us: 13_320, ..Header::default() }
}

fn sample<'a>(header: &'a Header, payload: PayloadRef<'a>) -> Sample<'a> {
    Sample { header: Some(header), missed: 0, payload }
}

fn scan(range: u16) -> Box<Scan> {
    Scan::of(ScanHead::lms(181, -90_000, 1000, 10, 13), &[range; 181])
}

/// A foreground of the beam ahead.
fn foreground() -> Box<Foreground> {
    let mut foreground = Foreground::of(181);
    let head = ForegroundHead { unit_um: 10_000, count: 181, beams: 1, ..ForegroundHead::default() };
    let arrays = foreground.begin(head);
    (arrays.bits[11], arrays.ranges[0]) = (0b100, 200);
    foreground
}

fn graph(every: impl Fn(Topic) -> Option<u64>) -> Graph {
    let mut graph = Graph::new(Names::default(), false);
    let of_links = |topic: Topic| {
        every(topic).filter(|_| topic.maker() != scanhub_schema::Maker::Tracker).and_then(NonZeroU64::new)
    };
    assert_eq!(graph.follow("front", &of_links), 0);
    graph
}

/// All that waits: name of the topic and message.
fn handed(graph: &mut Graph) -> Vec<(String, Value)> {
    let mut all = Vec::new();
    while let Some(Handed { topic, message }) = graph.hand(at(0)) {
        let message = message.to_vec();
        let topic = &graph.topics()[topic];
        all.push((topic.name.clone(), read(&topic.of, &message).expect("a message of its type")));
    }
    all
}

fn names(handed: &[(String, Value)]) -> Vec<&str> {
    handed.iter().map(|(name, _)| &**name).collect()
}

#[test]
fn each_topic_of_the_hub_becomes_topics_of_the_graph() {
    let mut graph = graph(|_| Some(1));
    let topics: Vec<_> = graph.topics().iter().map(|topic| (&*topic.name, topic.qos)).collect();
    let best = Qos::SensorData;
    assert_eq!(
        topics,
        [
            ("/front/scan", best),
            ("/front/foreground", best),
            ("/front/marks", best),
            ("/front/zones", best),
            ("/front/verdict", best),
            ("/front/cloud", best),
            ("/diagnostics", Qos::Reliable(10)),
        ]
    );
    let (first, scan, foreground) = (header(1), scan(300), foreground());
    let zones = Zones { verdict: Verdict::Slow as u8, ..Zones::unknown() };
    let status = Status { state: State::Streaming as u8, ..Status::default() };
    for payload in [
        PayloadRef::Scan(&scan),
        PayloadRef::Foreground(&foreground),
        PayloadRef::Marks(&Marks::default()),
        PayloadRef::Zones(&zones),
        PayloadRef::Status(&status),
    ] {
        graph.sample(0, &sample(&first, payload), at(101 * SECOND_NS));
    }
    let told = handed(&mut graph);
    let wanted = ["/front/scan", "/front/foreground", "/front/marks", "/front/zones", "/front/verdict"];
    assert_eq!(names(&told), [&wanted[..], &["/diagnostics", "/tf_static"]].concat());
    assert_eq!(told[0].1.number("ranges.90"), Some(f64::from(3_f32)));
    assert_eq!((told[1].1.number("width"), told[1].1.text("header.frame_id")), (Some(1.0), Some("front")));
    assert_eq!(told[4].1.text("data"), Some("slow"));
    assert_eq!(told[5].1.text("status.0.message"), Some("streaming"));
    assert_eq!(told[6].1.text("transforms.0.child_frame_id"), Some("front"));
    // The pose is told again when it is another one, and how the sensor is each time.
    graph.sample(0, &sample(&first, PayloadRef::Status(&status)), at(102 * SECOND_NS));
    assert_eq!(names(&handed(&mut graph)), ["/diagnostics"]);
    let moved = Status { pose: Pose { x_m: 0.5, ..Pose::default() }, ..status };
    graph.sample(0, &sample(&first, PayloadRef::Status(&moved)), at(103 * SECOND_NS));
    let told = handed(&mut graph);
    assert_eq!(names(&told), ["/diagnostics", "/tf_static"]);
    assert_eq!(told[1].1.number("transforms.0.transform.translation.x"), Some(0.5));
}

#[test]
fn as_many_wait_as_are_kept_and_old_ones_give_way() {
    let mut graph = graph(|topic| (topic == Topic::Scan).then_some(1));
    let ranges = |told: Vec<(String, Value)>| {
        told.iter().map(|(_, scan)| scan.number("ranges.0").unwrap().round() as u64).collect::<Vec<_>>()
    };
    let counts = |graph: &Graph| {
        let Published { sent, replaced, failed, .. } = graph.topics()[0];
        (sent, replaced, failed)
    };
    let take = |graph: &mut Graph, now_ns| {
        for seq in 1..=7 {
            let stamp = at(now_ns + seq * 20_000_000);
            graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan(100 * seq as u16))), stamp);
        }
    };
    take(&mut graph, 0);
    assert_eq!(ranges(handed(&mut graph)), [3, 4, 5, 6, 7]);
    graph.settle(false);
    assert_eq!(counts(&graph), (4, 2, 1));
    // Of those that came 60 to 140 ms after the start, two are old at 190 ms; later on the newest is not, as the only one.
    take(&mut graph, 0);
    let first = graph.hand(at(190_000_000)).map(|handed| handed.message.to_vec()).unwrap();
    assert_eq!(read(&scanhub_ros::LASER_SCAN, &first).unwrap().number("ranges.0"), Some(5.0));
    let last = graph.hand(at(SECOND_NS)).map(|handed| handed.message.to_vec()).unwrap();
    assert_eq!(read(&scanhub_ros::LASER_SCAN, &last).unwrap().number("ranges.0"), Some(7.0));
    assert!(!graph.is_waiting());
    assert_eq!(counts(&graph), (6, 7, 1));
}

#[test]
fn samples_are_thinned_by_their_telegrams() {
    let mut graph = graph(|topic| (topic == Topic::Scan).then_some(4));
    let mut sent = Vec::new();
    for seq in 0..9 {
        graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan(100))), at(0));
        if !handed(&mut graph).is_empty() {
            sent.push(seq);
        }
    }
    assert_eq!(sent, [0, 4, 8]);
    assert!(
        graph.wants(0, Topic::Status) && !graph.wants(0, Topic::Zones) && !graph.wants(0, Topic::Telegram)
    );
}

#[test]
fn a_foreground_waits_for_its_scan_alone() {
    let mut graph = graph(|topic| (topic == Topic::Foreground).then_some(1));
    assert!(graph.wants(0, Topic::Scan), "it says where beams point");
    let (scan, foreground) = (scan(500), foreground());
    graph.sample(0, &sample(&header(1), PayloadRef::Foreground(&foreground)), at(0));
    assert!(handed(&mut graph).is_empty());
    graph.sample(0, &sample(&header(1), PayloadRef::Scan(&scan)), at(0));
    assert_eq!(names(&handed(&mut graph)), ["/front/foreground"]);
    for seq in 2..5 {
        graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan)), at(0));
    }
    graph.sample(0, &sample(&header(2), PayloadRef::Foreground(&foreground)), at(0));
    let told = handed(&mut graph);
    assert_eq!((told.len(), told[0].1.number("header.stamp.sec")), (1, Some(99.0)));
    // That of a scan that was missed, or is long gone, is none.
    graph.sample(0, &sample(&header(6), PayloadRef::Foreground(&foreground)), at(0));
    graph.sample(0, &sample(&header(7), PayloadRef::Scan(&scan)), at(0));
    graph.sample(0, &sample(&header(1), PayloadRef::Foreground(&foreground)), at(0));
    assert!(handed(&mut graph).is_empty());
}

#[test]
fn two_sensors_do_not_take_each_others_place_in_a_topic_that_they_share() {
    let names = Names::new("robot1", "lidars", vec![("rear".to_owned(), "back".to_owned())]).unwrap();
    let mut graph = Graph::new(names, false);
    for (position, sensor) in ["front", "rear"].into_iter().enumerate() {
        graph.follow(sensor, &|topic| (topic == Topic::Status).then_some(NonZeroU64::MIN));
        graph.sample(position, &sample(&header(1), PayloadRef::Status(&Status::default())), at(SECOND_NS));
    }
    let told = handed(&mut graph);
    let of_sensors: Vec<_> = told.iter().filter_map(|(_, value)| value.text("status.0.name")).collect();
    assert_eq!(of_sensors, ["scanhub: front", "scanhub: rear"]);
    assert_eq!(graph.topics().len(), 2, "{:?}", graph.topics());
    let poses = &told.iter().find(|(name, _)| name == "/robot1/tf_static").unwrap().1;
    assert_eq!(poses.text("transforms.1.child_frame_id"), Some("back"));
}

#[test]
fn without_a_hub_nobody_knows_how_a_sensor_is() {
    let mut graph = graph(|topic| matches!(topic, Topic::Status | Topic::Zones).then_some(1));
    graph.sample(0, &sample(&header(1), PayloadRef::Status(&Status::default())), at(10 * SECOND_NS));
    handed(&mut graph);
    graph.look(true, at(12 * SECOND_NS));
    assert!(handed(&mut graph).is_empty());
    let unknown = Zones::unknown();
    let silence = Sample { header: None, missed: 0, payload: PayloadRef::Zones(&unknown) };
    graph.sample(0, &silence, at(12 * SECOND_NS));
    let told = handed(&mut graph);
    assert_eq!((names(&told), told[0].1.text("data")), (vec!["/front/verdict"], Some("unknown")));
    let mut said = 0;
    for tenth in 130..160 {
        graph.look(true, at(tenth * SECOND_NS / 10));
        let told = handed(&mut graph);
        said += told.len();
        assert!(told.iter().all(|(_, value)| value.number("status.0.level") == Some(3.0)), "{told:?}");
    }
    assert_eq!(said, 3);
}

#[test]
fn that_there_is_no_hub_is_said_within_a_second_and_again() {
    let mut graph = Graph::new(Names::default(), true);
    let mut hear = |tenths: std::ops::Range<u64>, is_there| {
        let mut told = Vec::new();
        for tenth in tenths {
            graph.look(is_there, at(tenth * SECOND_NS / 10));
            told.extend(handed(&mut graph).into_iter().map(|(topic, value)| {
                assert_eq!((&*topic, value.text("status.0.name")), ("/diagnostics", Some("scanhub: hub")));
                (tenth, value.number("status.0.level"))
            }));
        }
        told
    };
    assert_eq!(hear(100..120, false), [(105, Some(3.0)), (115, Some(3.0))]);
    assert_eq!(hear(120..140, true), [(125, Some(0.0)), (135, Some(0.0))]);
    // One that goes and comes at once is not gone.
    assert_eq!(hear(140..144, false), []);
    assert_eq!(hear(144..150, true), [(145, Some(0.0))]);
    assert_eq!(hear(150..160, false), [(155, Some(3.0))]);
}

#[test]
fn of_sensors_without_a_hub_it_is_said_as_soon() {
    let mut graph = graph(|topic| (topic == Topic::Status).then_some(1));
    graph.sample(0, &sample(&header(1), PayloadRef::Status(&Status::default())), at(10 * SECOND_NS));
    handed(&mut graph);
    for ms in [10_100, 10_500] {
        graph.look(false, at(ms * SECOND_NS / 1000));
        assert!(handed(&mut graph).is_empty(), "{ms}");
    }
    graph.look(false, at(11 * SECOND_NS));
    let told = handed(&mut graph);
    let said = told.last().map(|(_, value)| (value.text("status.0.name"), value.number("status.0.level")));
    assert_eq!(said, Some((Some("scanhub: front"), Some(3.0))), "{told:?}");
}

#[test]
fn a_sweep_is_one_cloud() {
    let mut graph = graph(|topic| (topic == Topic::Cloud).then_some(1));
    assert_eq!(graph.topics().len(), 1);
    assert!(graph.wants(0, Topic::Cloud) && !graph.wants(0, Topic::Scan));
    for (topic_seq, flags) in [(4, Cloud::LAST), (5, Cloud::FIRST), (6, 0), (7, Cloud::LAST)] {
        let cloud = Cloud::of(CloudHead { flags, ..CloudHead::default() }, &[CloudPoint::default(); 3]);
        let header = Header { topic_seq, ..header(topic_seq) };
        graph.sample(0, &sample(&header, PayloadRef::Cloud(&cloud)), at(0));
    }
    let told = handed(&mut graph);
    assert_eq!(names(&told), ["/front/cloud"]);
    assert_eq!(
        (told[0].1.number("width"), told[0].1.text("header.frame_id")),
        (Some(9.0), Some("base_link"))
    );
    assert_eq!(told[0].1.number("header.stamp.nanosec"), Some(7.0));
}

#[test]
fn people_of_a_tracker_are_shapes_and_poses_in_its_map() {
    let mut graph = Graph::new(Names::default(), false);
    graph.follow("house", &|topic| {
        (topic.maker() == scanhub_schema::Maker::Tracker).then_some(NonZeroU64::MIN)
    });
    assert!(graph.wants(0, Topic::Tracks) && !graph.wants(0, Topic::Scan));
    let topics: Vec<_> = graph.topics().iter().map(|topic| (&*topic.name, topic.of)).collect();
    assert_eq!(
        topics,
        [("/house/tracks", scanhub_ros::MARKER_ARRAY), ("/house/poses", scanhub_ros::POSE_ARRAY)]
    );
    let mut tracks = Tracks::default();
    tracks.push(Track { id: 5, state: TrackState::Confirmed as u8, x_m: 2.0, ..Track::default() });
    graph.sample(0, &sample(&header(1), PayloadRef::Tracks(&tracks)), at(101 * SECOND_NS));
    let told = handed(&mut graph);
    assert_eq!(names(&told), ["/house/tracks", "/house/poses"]);
    assert_eq!(
        (told[0].1.text("markers.1.text"), told[0].1.text("markers.1.header.frame_id")),
        (Some("5"), Some("house"))
    );
    assert_eq!(
        (told[1].1.number("poses.0.position.x"), told[1].1.text("header.frame_id")),
        (Some(2.0), Some("house"))
    );
}
