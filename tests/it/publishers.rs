//! Programs in Python and in C that publish the angles of a mount: whoever follows them gets what those in Rust send, is woken,
//! and sees one that was killed come back. A name has one publisher, in whatever language.

use std::io::{PipeWriter, Write};
use std::process::Command;

use scanhub_client::{ErrorKind, PublishSession, Subscriber, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Maker, Quality, Tilt, Topic};
use scanhub_shm::Bell;

use crate::client_c::installed::{Installed, source};
use crate::python::check_on;
use crate::testkit::{KILL, Outcome, Program, TestEnv, is_class, is_there, until};

/// A program that publishes `mount/tilt`, and the end of the pipe at which it is told what.
pub(crate) struct Mount {
    program: Program,
    told: PipeWriter,
}

impl Mount {
    fn start(command: Command) -> Mount {
        let (stdin, told) = std::io::pipe().expect("a pipe");
        Mount { program: Program::start_with(command, stdin), told }
    }

    /// One that publishes already.
    pub(crate) fn publishing(command: Command) -> Mount {
        let mut mount = Mount::start(command);
        mount.program.await_line("it publishes", is_class("open"));
        mount
    }

    /// Has it send an angle with its stamp, and waits until that is done.
    pub(crate) fn send(&mut self, tilt: &Tilt, stamp_ns: u64) {
        let Tilt { angle_rad, rate_rad_s } = tilt;
        writeln!(self.told, "{angle_rad} {rate_rad_s} {stamp_ns}").expect("it reads");
        self.program.await_line("it was sent", is_class("sent"));
    }

    /// It ends by itself, because nobody tells it anything more.
    pub(crate) fn end(self) -> Outcome {
        drop(self.told);
        self.program.wait()
    }
}

/// How one that publishes under a name is started, in each language that this machine has.
pub(crate) fn languages(env: &TestEnv) -> Vec<impl Fn(&str) -> Command + use<'_>> {
    let python = check_on(env, "publish").is_some().then_some(None);
    let c = Installed::once().map(|installed| Some(installed.compile(env, &source("publish.c"), &[])));
    let starts = python.into_iter().chain(c).map(move |compiled| {
        move |name: &str| {
            let mut command = match &compiled {
                None => check_on(env, "publish").expect("it was there"),
                Some(program) => Command::new(program),
            };
            command.arg(name).env("SCANHUB_DOMAIN", env.place().name()).env_remove("XDG_RUNTIME_DIR");
            command.env("RUNTIME_DIRECTORY", env.place().root().parent().expect("it has one"));
            command
        }
    });
    starts.collect()
}

/// A place that somebody else holds, so that it lives.
fn listener(env: &TestEnv) -> PublishSession {
    PublishSession::open(&env.place(), &[Topic::Marks], TopicLimits::default()).expect("nobody else")
}

fn follow(env: &TestEnv) -> Subscriber<Tilt> {
    Subscriber::builder("mount").in_domain(&env.place()).open().expect("a name")
}

#[test]
fn angles_arrive_with_their_stamps_and_wake_who_sleeps() {
    let env = TestEnv::new();
    for start in languages(&env) {
        let _listener = listener(&env);
        let mut mount = Mount::publishing(start("mount"));
        let mut followed = follow(&env);
        until("it follows the mount", || {
            assert!(followed.try_next().expect("a domain").is_none());
            env.subscribers("mount/tilt") == 1
        });
        let node = scanhub_shm::client_node(&env.place()).expect("a domain");
        let bell = Bell::open(&node, "mount").expect("it is ours").expect("it has one");
        let wake = scanhub_shm::open_wake(&node, "mount").expect("it is ours").expect("it has one");
        let woken = scanhub_shm::listener(&node, &wake).expect("room for one more");
        let mut lives = Vec::new();
        let begin_ns = clock::now_ns();
        for (number, rate_rad_s) in [0.25, f64::NAN, -1.5].into_iter().enumerate() {
            let tilt = Tilt { angle_rad: 0.1 * number as f64 - 0.05, rate_rad_s };
            let stamp_ns = if number == 2 { 0 } else { begin_ns - 300_000_000 };
            let rung = Topic::ALL.map(|topic| bell.rung(topic.row().ring));
            mount.send(&tilt, stamp_ns);
            let ring = |topic: Topic| bell.rung(topic.row().ring).wrapping_sub(rung[topic as usize]);
            assert_eq!([Topic::Tilt, Topic::Scan, Topic::Early].map(ring), [1, 0, 0]);
            assert_eq!(scanhub_shm::take_wakeups(&[&woken]), Ok(true));
            let sample = followed.next().expect("a domain").expect("it was sent");
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
            lives.push(header.boot);
        }
        assert!(lives[0] != 0 && lives.iter().all(|life| *life == lives[0]), "{lives:?}");
        let path = std::path::PathBuf::from("/dev/shm");
        let bell_file = path.join(format!("{}mount.bell", node.config().global.prefix));
        assert!(is_there(&bell_file) && !bell.is_closed());
        let outcome = mount.end();
        assert_eq!((outcome.code, outcome.errors.as_str()), (Some(0), ""), "{outcome}");
        assert!(!is_there(&bell_file) && bell.is_closed(), "nobody waits at it any more");
    }
}

#[test]
fn a_name_has_one_publisher_in_all_languages() {
    let env = TestEnv::new();
    let hub = env.hub(&[&env.link("front"), &env.link("rear")]);
    let starts = languages(&env);
    let beside =
        || PublishSession::beside(&env.place(), "mount", Maker::Mount.topics(), TopicLimits::default());
    let held = |name: &str, pid: u32| {
        let program = std::fs::read_to_string(format!("/proc/{pid}/comm")).expect("it runs");
        let process = format!("process {pid} ({})", program.trim_end());
        format!("the name {name} is published by {process}\n  end it, or choose another name")
    };
    let refused = |pid: u32| held("mount", pid);
    for start in &starts {
        let mount = Mount::publishing(start("mount"));
        for other in &starts {
            let outcome = Mount::start(other("mount")).program.wait();
            assert!(
                outcome.code == Some(1) && outcome.errors.contains(&refused(mount.program.pid())),
                "{outcome}"
            );
        }
        let failure = beside().map(drop).expect_err("it is taken");
        assert_eq!(
            (failure.kind(), failure.to_string()),
            (ErrorKind::NameHeld, refused(mount.program.pid()))
        );
        assert_eq!(mount.end().code, Some(0));
        // It is free at once.
        let in_rust = beside().expect("the name is free");
        for other in &starts {
            let outcome = Mount::start(other("mount")).program.wait();
            assert!(
                outcome.code == Some(1) && outcome.errors.contains(&refused(std::process::id())),
                "{outcome}"
            );
        }
        drop(in_rust);
        let outcome = Mount::start(start("front")).program.wait();
        let words = held("front", hub.pid());
        assert!(outcome.code == Some(1) && outcome.errors.contains(&words), "{outcome}");
    }
}

/// Who has settled how the names of shared memory begin has joined as well, before another one that ends looks who is there.
#[test]
fn who_comes_while_another_goes_is_found() {
    let env = TestEnv::new();
    let place = env.place();
    std::thread::scope(|scope| {
        for name in ["left", "right"] {
            let place = &place;
            scope.spawn(move || {
                for round in 0..100 {
                    let topics = Maker::Mount.topics();
                    let sensor = PublishSession::beside(place, name, topics, TopicLimits::default());
                    let mount = sensor.expect("the name is free").topic::<Tilt>().expect("it is alone");
                    let published = scanhub_shm::published(place).expect("a domain");
                    assert!(published.contains(&(name.to_owned(), Topic::Tilt)), "{name} in {round}");
                    drop(mount);
                }
            });
        }
    });
    assert_eq!(env.left_behind(), Vec::<std::path::PathBuf>::new());
}

#[test]
fn one_that_is_killed_leaves_its_name_and_its_followers() {
    let env = TestEnv::new();
    for start in languages(&env) {
        let listener = listener(&env);
        let mut followed = follow(&env);
        let mut boots = Vec::new();
        for life in 0..3 {
            let mut mount = Mount::publishing(start("mount"));
            until("it is followed", || {
                let _ = followed.try_next().expect("a domain");
                env.subscribers("mount/tilt") == 1
            });
            mount.send(&Tilt { angle_rad: f64::from(life), ..Tilt::default() }, 0);
            let sample = followed.next().expect("a domain").expect("it was sent");
            assert_eq!((sample.angle_rad, sample.header().topic_seq), (f64::from(life), 0));
            assert_eq!((sample.missed, sample.restarted), (0, life > 0));
            assert!(!boots.contains(&sample.header().boot), "another life");
            boots.push(sample.header().boot);
            drop(sample);
            assert_eq!(mount.program.end(KILL).code, None);
        }
        drop((followed, listener));
        // The last one of all takes everything along, also what the dead have left.
        assert_eq!(Mount::publishing(start("mount")).end().code, Some(0));
        assert_eq!(env.left_behind(), Vec::<std::path::PathBuf>::new());
        assert!(!is_there(&env.place().root().join("prefix")), "the next one has other names");
    }
}
