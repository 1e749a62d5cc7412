//! Tests of Python and C programs that publish the angles of a mount. Subscribers receive the same samples as from Rust
//! programs, the samples wake them, and they continue when a killed publisher is restarted. A name has at most one
//! publisher, whatever the language of the publisher.

use std::io::{PipeWriter, Write};
use std::process::Command;

use scanhub_client::{ErrorKind, PublishSession, Subscriber, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{PublisherKind, Quality, Tilt, Topic};
use scanhub_shm::Doorbell;

use crate::client_c::installed::{InstalledLibrary, source};
use crate::python::check_on;
use crate::testkit::{KILL, Outcome, Program, TestEnv, exists_or_is_symlink, is_class, wait_until};

/// A program that publishes `mount/tilt`, and the pipe through which it receives the angles.
pub(crate) struct TestPublisher {
    program: Program,
    commands: PipeWriter,
}

impl TestPublisher {
    fn start(command: Command) -> TestPublisher {
        let (stdin, commands) = std::io::pipe().expect("a pipe");
        TestPublisher { program: Program::start_with(command, stdin), commands }
    }

    /// Starts `command` and waits until the program is ready to publish.
    pub(crate) fn start_and_publish(command: Command) -> TestPublisher {
        let mut mount = TestPublisher::start(command);
        mount.program.await_line("an open publisher", is_class("open"));
        mount
    }

    /// Sends an angle with its stamp to the program, and waits until the program has published the sample.
    pub(crate) fn send(&mut self, tilt: &Tilt, stamp_ns: u64) {
        let Tilt { angle_rad, rate_rad_s } = tilt;
        writeln!(self.commands, "{angle_rad} {rate_rad_s} {stamp_ns}").expect("an open pipe");
        self.program.await_line("a sent sample", is_class("sent"));
    }

    /// Closes the program's standard input and waits until it ends.
    pub(crate) fn end(self) -> Outcome {
        drop(self.commands);
        self.program.wait()
    }
}

/// Returns a function for each programming language that is available on this machine. Each function takes a name and
/// returns the command of a program that publishes under this name.
pub(crate) fn languages(env: &TestEnv) -> Vec<impl Fn(&str) -> Command + use<'_>> {
    let python = check_on(env, "publish").is_some().then_some(None);
    let c = InstalledLibrary::installed()
        .map(|installed| Some(installed.compile(env, &source("publish.c"), &[])));
    let starts = python.into_iter().chain(c).map(move |compiled| {
        move |name: &str| {
            let mut command = match &compiled {
                None => check_on(env, "publish").expect("the script"),
                Some(program) => Command::new(program),
            };
            command.arg(name).env("SCANHUB_DOMAIN", env.domain().name()).env_remove("XDG_RUNTIME_DIR");
            command.env("RUNTIME_DIRECTORY", env.domain().root().parent().expect("a parent directory"));
            command
        }
    });
    starts.collect()
}

/// Joins the domain as its listener, so that the domain stays in use while publishers come and go.
fn listener(env: &TestEnv) -> PublishSession {
    PublishSession::open(&env.domain(), &[Topic::Marks], TopicLimits::default()).expect("the only publisher")
}

fn subscribe(env: &TestEnv) -> Subscriber<Tilt> {
    Subscriber::builder("mount").in_domain(&env.domain()).open().expect("a name")
}

#[test]
fn angles_arrive_with_their_stamps_and_wake_waiters() {
    let env = TestEnv::new();
    for start in languages(&env) {
        let _listener = listener(&env);
        let mut mount = TestPublisher::start_and_publish(start("mount"));
        let mut subscriber = subscribe(&env);
        wait_until("a subscription to the mount", || {
            assert!(subscriber.try_next().expect("a working subscriber").is_none());
            env.subscribers("mount/tilt") == 1
        });
        let node = scanhub_shm::client_node(&env.domain()).expect("a node in the domain");
        let doorbell = Doorbell::open(&node, "mount").expect("a readable doorbell").expect("a doorbell");
        let wake = scanhub_shm::open_wake(&node, "mount").expect("a readable event").expect("an event");
        let wake_listener = scanhub_shm::listener(&node, &wake).expect("a free slot");
        let mut boots = Vec::new();
        let begin_ns = clock::now_ns();
        for (number, rate_rad_s) in [0.25, f64::NAN, -1.5].into_iter().enumerate() {
            let tilt = Tilt { angle_rad: 0.1 * number as f64 - 0.05, rate_rad_s };
            let stamp_ns = if number == 2 { 0 } else { begin_ns - 300_000_000 };
            let counts = Topic::ALL.map(|topic| doorbell.ring_count(topic.spec().doorbell_word));
            mount.send(&tilt, stamp_ns);
            let ring = |topic: Topic| {
                doorbell.ring_count(topic.spec().doorbell_word).wrapping_sub(counts[topic as usize])
            };
            assert_eq!([Topic::Tilt, Topic::Scan, Topic::Early].map(ring), [1, 0, 0]);
            assert_eq!(scanhub_shm::take_wakeups(&[&wake_listener]), Ok(true));
            let sample = subscriber.next().expect("a working subscriber").expect("a sent sample");
            assert_eq!((sample.angle_rad, sample.rate_rad_s()), (tilt.angle_rad, tilt.rate_rad_s()));
            let header = *sample.header();
            assert_eq!(header.stamp_first_ns, header.stamp_last_ns);
            if stamp_ns > 0 {
                assert_eq!(header.stamp_first_ns, stamp_ns);
            } else {
                assert!((begin_ns..=clock::now_ns()).contains(&header.stamp_first_ns), "{header:?}");
            }
            let now_ns = clock::wall_ns() - (clock::now_ns() - header.stamp_first_ns);
            assert!(header.wall_ns.abs_diff(now_ns) < 1_000_000_000, "{header:?} at {now_ns}");
            assert_eq!((header.seq, header.topic_seq), (number as u64, number as u64));
            assert_eq!((header.hub_pid, header.quality()), (mount.program.pid(), Quality::Clean));
            assert_eq!((sample.missed, sample.restarted, header.flags), (0, false, 0));
            boots.push(header.boot);
        }
        assert!(boots[0] != 0 && boots.iter().all(|run| *run == boots[0]), "{boots:?}");
        let path = std::path::PathBuf::from("/dev/shm");
        let bell_file = path.join(format!("{}mount.bell", node.config().global.prefix));
        assert!(exists_or_is_symlink(&bell_file) && !doorbell.is_closed());
        let outcome = mount.end();
        assert_eq!((outcome.exit_code, outcome.stderr.as_str()), (Some(0), ""), "{outcome}");
        assert!(!exists_or_is_symlink(&bell_file) && doorbell.is_closed(), "the doorbell still exists");
    }
}

#[test]
fn second_publisher_of_a_name_is_refused() {
    let env = TestEnv::new();
    let hub = env.hub(&[&env.link("front"), &env.link("rear")]);
    let starts = languages(&env);
    let other_publisher = || {
        PublishSession::open_named(
            &env.domain(),
            "mount",
            PublisherKind::Mount.topics(),
            TopicLimits::default(),
        )
    };
    let held = |name: &str, pid: u32| {
        let program =
            std::fs::read_to_string(format!("/proc/{pid}/comm")).expect("the name of a running process");
        let process = format!("process {pid} ({})", program.trim_end());
        format!("the name {name} is published by {process}\n  end it, or choose another name")
    };
    let refused = |pid: u32| held("mount", pid);
    for start in &starts {
        let mount = TestPublisher::start_and_publish(start("mount"));
        for other in &starts {
            let outcome = TestPublisher::start(other("mount")).program.wait();
            assert!(
                outcome.exit_code == Some(1) && outcome.stderr.contains(&refused(mount.program.pid())),
                "{outcome}"
            );
        }
        let failure = other_publisher().map(drop).expect_err("a name that is taken");
        assert_eq!(
            (failure.kind(), failure.to_string()),
            (ErrorKind::NameHeld, refused(mount.program.pid()))
        );
        assert_eq!(mount.end().exit_code, Some(0));
        // After the publisher has exited, its name is free at once.
        let in_rust = other_publisher().expect("the name is free");
        for other in &starts {
            let outcome = TestPublisher::start(other("mount")).program.wait();
            assert!(
                outcome.exit_code == Some(1) && outcome.stderr.contains(&refused(std::process::id())),
                "{outcome}"
            );
        }
        drop(in_rust);
        let outcome = TestPublisher::start(start("front")).program.wait();
        let words = held("front", hub.pid());
        assert!(outcome.exit_code == Some(1) && outcome.stderr.contains(&words), "{outcome}");
    }
}

/// While a publisher joins the domain, it holds the lock for the prefix of shared memory. Another publisher that leaves
/// at the same time therefore detects it, and does not remove the prefix.
#[test]
fn publisher_is_visible_while_another_exits() {
    let env = TestEnv::new();
    let domain = env.domain();
    std::thread::scope(|scope| {
        for name in ["left", "right"] {
            let place = &domain;
            scope.spawn(move || {
                for round in 0..100 {
                    let topics = PublisherKind::Mount.topics();
                    let sensor = PublishSession::open_named(place, name, topics, TopicLimits::default());
                    let mount =
                        sensor.expect("the name is free").topic::<Tilt>().expect("the only publisher");
                    let published = scanhub_shm::published_topics(place).expect("a readable domain");
                    assert!(published.contains(&(name.to_owned(), Topic::Tilt)), "{name} in {round}");
                    drop(mount);
                }
            });
        }
    });
    assert_eq!(env.leftover_files(), Vec::<std::path::PathBuf>::new());
}

#[test]
fn subscribers_survive_a_killed_publisher() {
    let env = TestEnv::new();
    for start in languages(&env) {
        let listener = listener(&env);
        let mut subscriber = subscribe(&env);
        let mut boots = Vec::new();
        for run in 0..3 {
            let mut mount = TestPublisher::start_and_publish(start("mount"));
            wait_until("a subscriber", || {
                let _ = subscriber.try_next().expect("a working subscriber");
                env.subscribers("mount/tilt") == 1
            });
            mount.send(&Tilt { angle_rad: f64::from(run), ..Tilt::default() }, 0);
            let sample = subscriber.next().expect("a working subscriber").expect("a sent sample");
            assert_eq!((sample.angle_rad, sample.header().topic_seq), (f64::from(run), 0));
            assert_eq!((sample.missed, sample.restarted), (0, run > 0));
            assert!(!boots.contains(&sample.header().boot), "the boot ID is not new");
            boots.push(sample.header().boot);
            drop(sample);
            assert_eq!(mount.program.end(KILL).exit_code, None);
        }
        drop((subscriber, listener));
        // The last publisher in a domain removes everything when it exits, including the files that killed publishers
        // left.
        assert_eq!(TestPublisher::start_and_publish(start("mount")).end().exit_code, Some(0));
        assert_eq!(env.leftover_files(), Vec::<std::path::PathBuf>::new());
        assert!(!exists_or_is_symlink(&env.domain().root().join("prefix")), "the next one has other names");
    }
}
