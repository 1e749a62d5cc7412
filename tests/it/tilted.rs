//! Tests of the topics that mounts and `tilt` publish. A program next to a hub publishes them here. Every reader
//! reports the same values, on the same machine, on another machine and in a recording.

use std::cell::RefCell;
use std::path::Path;

use scanhub_client::{Publication, PublishSession, SensorPublisher};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{
    Cloud, CloudHead, CloudPoint, Header, Obstacle, Obstacles, PointClass, PublisherKind, Tilt, WakeEvent,
};
use serde_json::{Value, json};

use crate::testkit::{
    INT, Outcome, Program, Recording, TestEnv, client_python, in_a_network, number, wait_until,
};

/// Publisher of the mount's angles and of the clouds and obstacles from `tilt`, in one program.
pub(crate) struct TiltedPublisher {
    tilt: Publication<Tilt>,
    cloud: Publication<Cloud>,
    obstacles: Publication<Obstacles>,
    mount: SensorPublisher,
    room: SensorPublisher,
    pub(crate) round_count: u32,
}

/// Number of points in a sample of topic `cloud`. It is the maximum number of beams of an LMS. A sample with this
/// number of points does not fit into one datagram.
const POINT_COUNT: u16 = 401;

impl TiltedPublisher {
    pub(crate) fn start_publisher(env: &TestEnv) -> TiltedPublisher {
        let open_publisher = |name: &str, maker: PublisherKind| {
            PublishSession::open_named(&env.domain(), name, maker.topics(), TopicLimits::default()).unwrap()
        };
        let (mount, room) =
            (open_publisher("mount", PublisherKind::Mount), open_publisher("room", PublisherKind::Tilted));
        let (cloud, obstacles) = (room.topic().unwrap(), room.topic().unwrap());
        TiltedPublisher { tilt: mount.topic().unwrap(), cloud, obstacles, mount, room, round_count: 0 }
    }

    /// Publishes an angle, obstacles and two clouds. Their values are different in each round.
    pub(crate) fn publish_round(&mut self) {
        let (sweep, k) = (self.round_count, self.round_count as f32 / 8.0);
        let at = |header: Header, sensor| Header { sensor, ..header };
        let angle = Tilt { angle_rad: 0.5 + f64::from(k), rate_rad_s: [f64::NAN, -0.25][sweep as usize % 2] };
        self.tilt.send_with(&at(self.tilt.header(), 200), |sample| *sample = angle).unwrap();
        let mut found = Obstacles { sweep, flags: Obstacles::COMPLETE, ..Obstacles::default() };
        for i in 0..sweep % 3 {
            let middle = [1.0 + k, -2.0, i as f32];
            found.push(Obstacle {
                middle,
                low: middle,
                high: middle,
                points: 9,
                flags: 1,
                ..Obstacle::default()
            });
        }
        self.obstacles.send_with(&at(self.obstacles.header(), 201), |sample| *sample = found).unwrap();
        for flags in [Cloud::FIRST, Cloud::LAST] {
            let head = CloudHead {
                sweep,
                flags: flags | Cloud::COMPLETE,
                count: POINT_COUNT,
                ..CloudHead::default()
            };
            let fill = |sample: &mut Cloud| {
                for (point, beam) in sample.begin(head).iter_mut().zip(0..) {
                    let point_class = PointClass::ALL[usize::from(beam % 4)] as u8;
                    *point =
                        CloudPoint { at: [k, f32::from(beam) / 64.0, 0.5], beam, point_class, reserved: 0 };
                }
            };
            let header = at(self.cloud.header(), 201);
            self.cloud.send_len_with(&header, Cloud::len(POINT_COUNT.into()), fill).unwrap();
        }
        self.mount.wake(WakeEvent::Telegram).unwrap();
        self.room.wake(WakeEvent::Telegram).unwrap();
        self.round_count += 1;
    }

    /// Publishes rounds until each of `programs` has printed lines of every class in [`CLASSES`]. Then continues until
    /// each program has also printed lines of every class that belong to the additional rounds.
    fn publish_until_received(&mut self, programs: &mut [&mut Program]) {
        for since in [0, 1] {
            let since = since * u64::from(self.round_count);
            wait_until("all classes in all outputs", || {
                self.publish_round();
                let is_new = |line: &Value, class| line["class"] == class && round_of(line) >= since;
                programs
                    .iter_mut()
                    .all(|program| CLASSES.iter().all(|class| program.prints(|line| is_new(line, *class))))
            });
        }
    }
}

/// Returns the round in which the sample of `line` was published.
pub(crate) fn round_of(line: &Value) -> u64 {
    match line["angle_deg"].as_f64() {
        Some(angle_deg) => (8.0 * (angle_deg.to_radians() - 0.5)).round() as u64,
        None => number(line, "sweep"),
    }
}

pub(crate) const CLASSES: [&str; 3] = ["tilt", "cloud", "obstacles"];
pub(crate) const TOPICS: [&str; 3] = ["mount/tilt", "room/cloud", "room/obstacles"];

/// Starts a hub whose only port does not exist.
pub(crate) fn hub(env: &TestEnv) -> Program {
    env.hub(&[env.link("front")])
}

/// Asserts that the lines of `class` that both programs have printed have the same values for `keys`. Returns the
/// number of these lines.
fn assert_same_lines(first: &Outcome, other: &Outcome, class: &str, keys: &[&str]) -> usize {
    let others = other.of_class(class);
    let mut same = 0;
    for line in first.of_class(class) {
        let is_same = |other: &&Value| round_of(other) == round_of(&line) && other["first"] == line["first"];
        if let Some(other) = others.iter().find(is_same) {
            keys.iter().for_each(|key| assert_eq!(line[*key], other[*key], "{key} of {class}"));
            same += 1;
        }
    }
    same
}

#[test]
fn echo_python_and_recording_have_equal_samples() {
    let env = TestEnv::new();
    let _hub = hub(&env);
    let mut made = TiltedPublisher::start_publisher(&env);
    let mut echo = env.echo(&TOPICS);
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python/tests");
    let mut subscriber = client_python().map(|mut command| {
        let domain = env.domain();
        let root = domain.root().parent().expect("a parent directory");
        command.arg(scripts.join("follow.py")).arg(domain.name()).arg(root).args(TOPICS);
        command.env_remove("SCANHUB_DOMAIN");
        Program::start(command)
    });
    let file = env.path_argument("tilted.mcap");
    let record = env.start(&[&["record", "--json", "-o", &file][..], &TOPICS].concat());
    let subscribers = 2 + u64::from(subscriber.is_some());
    wait_until("all subscribers", || TOPICS.iter().all(|topic| env.subscribers(topic) == subscribers));
    made.publish_until_received(&mut std::iter::once(&mut echo).chain(&mut subscriber).collect::<Vec<_>>());
    let (echo, record) = (echo.end(INT), record.end(INT));
    assert_eq!(record.exit_code, Some(0), "{record}");
    let line = &echo.of_class("cloud")[0];
    let points = line["points"].as_array().expect("points");
    assert_eq!((points.len(), &points[1], &line["classes"][1]), (401, &json!([0.0, 0.016, 0.5]), &json!(1)));
    assert_eq!(
        (&line["sensor"], &line["first"], &line["beams"][400]),
        (&json!("room"), &json!(true), &json!(400))
    );
    if let Some(subscriber) = subscriber.map(|subscriber| subscriber.end(INT)) {
        for class in CLASSES {
            let line = echo.of_class(class).remove(0);
            let keys: Vec<&str> = line.as_object().expect("an object").keys().map(String::as_str).collect();
            assert!(assert_same_lines(&echo, &subscriber, class, &keys) >= 2, "{class}");
        }
    }
    // All subscribers were attached before the first sample was published, so the recording has the same samples as
    // `echo` has printed.
    let recording = Recording::read_complete(file.as_ref());
    let [tilt, clouds, obstacles] = TOPICS.map(|topic| recording.of(topic));
    for (i, line) in echo.of_class("cloud").iter().enumerate() {
        let mut cloud = Box::<Cloud>::default();
        assert!(Cloud::unpack_into(&mut cloud, clouds[i].payload()));
        let metres =
            cloud.points().iter().map(|point| point.at.map(f64::from).map(|x| (1e3 * x).round() / 1e3));
        assert_eq!(line["points"], json!(metres.collect::<Vec<_>>()));
    }
    for (i, line) in echo.of_class("obstacles").iter().enumerate() {
        let mut found = Obstacles::default();
        assert!(found.unpack(obstacles[i].payload()));
        assert_eq!(line["obstacles"].as_array().map(Vec::len), Some(found.obstacles().len()));
    }
    assert!(tilt.len() >= 2 && Tilt::default().unpack(tilt[0].payload()));
}

/// A cloud takes several datagrams. On the other machine, `listen --publish` must publish the same values.
#[test]
fn remote_machine_receives_equal_tilted_samples() {
    in_a_network("tilted::remote_machine_receives_equal_tilted_samples", || {
        let (env, there) = (TestEnv::new(), TestEnv::new());
        let _hub = hub(&env);
        let mut made = TiltedPublisher::start_publisher(&env);
        let mut listen = there.start(&["listen", "--json", "--publish"]).ready();
        let lines = there.start(&["listen", "--json"]).ready();
        let mut echo = env.echo(&TOPICS);
        let flags = CLASSES.map(|topic| format!("--topic=*/{topic}"));
        let flags: Vec<&str> = flags.iter().map(String::as_str).chain(["--interface=lo"]).collect();
        let _gateway = env.gateway(&flags);
        let names = TOPICS.map(|topic| {
            let (name, topic) = topic.split_once('/').expect("a topic");
            let published = RefCell::default();
            wait_until("a published sample", || {
                made.publish_round();
                let is_it = |sensor: &str| sensor.ends_with(&format!(".{name}"));
                listen.prints(|line| {
                    let sensor = line["sensor"].as_str().filter(|sensor| is_it(sensor));
                    let sensor = sensor.filter(|_| line["kind"] == "published");
                    sensor.is_some_and(|sensor| {
                        *published.borrow_mut() = format!("{sensor}/{topic}");
                        true
                    })
                })
            });
            published.into_inner()
        });
        let mut again = there.echo(&names.each_ref().map(String::as_str));
        made.publish_until_received(&mut [&mut echo, &mut again]);
        let [echo, again, lines] = [echo, again, lines].map(|program| program.end(INT));
        let keys = ["sweep", "generation", "first", "last", "complete", "points", "beams", "classes"];
        for other in [&lines, &again] {
            assert!(assert_same_lines(&echo, other, "cloud", &keys) >= 2);
            assert!(assert_same_lines(&echo, other, "tilt", &["angle_deg", "rate_deg_s"]) >= 1);
            assert!(
                assert_same_lines(&echo, other, "obstacles", &["sweep", "complete", "obstacles", "dropped"])
                    >= 1
            );
        }
        assert!(lines.of_class("cloud").iter().all(|line| line["sensor"] == "room"));
    });
}
