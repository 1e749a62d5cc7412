//! Library for C and C++, tested from outside. The tests compare the header of the library with `schema`. They also
//! build programs in C and C++ as users do, and run these programs with a hub. If no C compiler is installed, the tests
//! are skipped.

pub(crate) mod installed;
mod layout;

use std::collections::HashSet;
use std::path::Path;
use std::process::{Command, Output};

use crate::testkit::{INT, KILL, Program, TERM, TestEnv, hash, is_class, number, output};
use installed::{InstalledLibrary, header_directory, is_installed, source};
use scanhub_schema::{ArrayFlags, Code, Header, Scan};
use serde_json::Value;

fn expect_success(output: &Output) -> String {
    let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}{}", text(&output.stdout), text(&output.stderr));
    text(&output.stdout)
}

/// Starts `program` with the arguments `words`, in an environment in which the program finds the hub of `env`.
fn program(env: &TestEnv, program: &Path, words: &[&str]) -> Program {
    let mut command = Command::new(program);
    command.args(words).env("SCANHUB_DOMAIN", env.domain().name()).env_remove("XDG_RUNTIME_DIR");
    command
        .env("RUNTIME_DIRECTORY", env.domain().root().parent().expect("the domain has a parent directory"));
    Program::start(command)
}

/// Returns the bytes in the field `data` of a JSON line, which has them as hexadecimal digits.
fn data(line: &Value) -> Vec<u8> {
    let text = line["data"].as_str().unwrap_or_else(|| panic!("no data in {line}"));
    (0..text.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&text[at..at + 2], 16).expect("the text is hexadecimal"))
        .collect()
}

/// Compiles the header with every language standard that users have.
#[test]
fn header_has_the_layout_of_schema() {
    if !is_installed("cc") {
        return;
    }
    let env = TestEnv::new();
    env.file("layout.c", layout::program());
    for (compiler, standard) in
        [("cc", "-std=c99"), ("cc", "-std=c11"), ("c++", "-std=c++11"), ("c++", "-std=c++20")]
    {
        if !is_installed(compiler) {
            continue;
        }
        let mut cc = Command::new(compiler);
        cc.args([standard, "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion"]);
        if compiler == "c++" {
            cc.args(["-x", "c++"]);
        }
        cc.arg("-I").arg(header_directory()).arg(env.path("layout.c")).arg("-o").arg(env.path("layout"));
        expect_success(&output(cc).expect("a compiler starts"));
        let printed = expect_success(&output(Command::new(env.path("layout"))).expect("the program runs"));
        assert_eq!(printed.lines().collect::<Vec<_>>(), layout::expected(), "{compiler} {standard}");
    }
}

/// A program may use the headers for datagrams and for topics together.
#[test]
fn program_can_include_both_c_headers() {
    if !is_installed("cc") {
        return;
    }
    let env = TestEnv::new();
    let [lan, attach] = ["#include <scanhub.h>\n", "#include <scanhub/attach.h>\n"];
    for text in [format!("{lan}{attach}"), format!("{attach}{lan}{attach}")] {
        let file = env.file("both.c", format!("{text}int both(void);\nint both(void) {{ return 0; }}\n"));
        let mut cc = Command::new("cc");
        cc.args(["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", &file, "-o"]);
        cc.arg(env.path("both.o")).arg("-I").arg(header_directory());
        cc.arg("-I").arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/c"));
        expect_success(&output(cc).expect("a compiler starts"));
    }
}

#[test]
fn c_header_computes_the_same_values_as_schema() {
    if !is_installed("cc") {
        return;
    }
    let env = TestEnv::new();
    let header = Header { stamp_first_ns: 5_000_000_000, ..Header::default() };
    for scan in layout::scans() {
        env.file("computes.c", layout::computed_values_c(&header, &scan));
        let mut cc = Command::new("cc");
        cc.args(["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsanitize=undefined"]);
        cc.args(["-fno-sanitize-recover=all", "-I"]).arg(header_directory()).arg(env.path("computes.c"));
        expect_success(&output(cc.arg("-o").arg(env.path("computes"))).expect("a compiler starts"));
        let printed = expect_success(&output(Command::new(env.path("computes"))).expect("the program runs"));
        let mut lines = printed.lines();
        let head = format!("{} {} {}", scan.beams(), scan.collisions, u8::from(scan.is_incomplete()));
        assert_eq!(lines.next(), Some(head.as_str()));
        for (i, line) in lines.enumerate() {
            let mut words = line.split(' ');
            let mut number = || words.next().and_then(|word| word.parse::<f64>().ok()).expect("a number");
            let (range_m, angle) = (number(), number());
            assert_eq!(range_m.is_nan(), scan.distance_m(i).is_none(), "{line}");
            assert!(range_m.is_nan() || Some(range_m) == scan.distance_m(i), "{line}");
            // Compilers differ in when they round intermediate results.
            assert!((angle - scan.angle(i)).abs() <= 1e-12, "{line}: {}", scan.angle(i));
            let rest: Vec<_> = words.collect();
            let code = scan.code(i).map_or("reading", Code::name).to_owned();
            let intensity = scan.intensities().get(i).map_or(-1, i32::from).to_string();
            let at_ns = header.stamp_first_ns.saturating_add_signed(scan.beam_ns(i)).to_string();
            assert_eq!(rest, [code, intensity, at_ns], "beam {i}");
        }
        assert_eq!(printed.lines().count(), scan.beams() + 4);
    }
}

/// Programs receive the same samples with each wait method: `doorbell`, `poll`, `event` and `spin`. The program reads
/// each sample in the shared memory to which the hub wrote it.
#[test]
fn c_program_receives_every_sample_in_shared_memory() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let follow = installed.compile(&env, &source("follow.c"), &[]);
    let simulator = env.simulator(&["front"], &["--seed=31"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let mut subscribers: Vec<_> = ["doorbell", "event", "spin", "poll"]
        .iter()
        .map(|wait_method| program(&env, &follow, &["front", "1", wait_method, "60"]))
        .collect();
    for subscriber in &mut subscribers {
        subscriber.await_line("line of class open", is_class("open"));
    }
    let outcomes: Vec<_> = subscribers.into_iter().map(Program::wait).collect();
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    let sent: HashSet<String> = env.truth("front").into_iter().map(|sent| sent.hash).collect();
    for outcome in &outcomes {
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let samples = outcome.of_class("sample");
        assert_eq!(samples.len(), 60, "{outcome}");
        assert!(samples.iter().all(|line| line["shared"] == true && line["restarted"] == 0), "{outcome}");
        assert!(
            samples.iter().all(|line| sent.contains(&hash(&data(line)))),
            "a sample differs from all that were sent: {outcome}"
        );
        for pair in samples.windows(2) {
            let gap = number(&pair[1], "topic_seq") - number(&pair[0], "topic_seq") - 1;
            assert_eq!(gap, number(&pair[1], "missed"), "{outcome}");
        }
    }
}

#[test]
fn c_program_continues_after_a_hub_restart() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let follow = installed.compile(&env, &source("follow.c"), &[]);
    // The hub has not started yet.
    let mut subscribers =
        ["doorbell", "poll"].map(|wait_method| program(&env, &follow, &["front", "2", wait_method, "0"]));
    for subscriber in &mut subscribers {
        subscriber.await_line("line of class open", is_class("open"));
    }
    let simulator = env.simulator(&["front"], &["--seed=32"]);
    let mut boots = Vec::new();
    for how in [KILL, TERM, KILL] {
        let hub = env.hub(&[env.link("front")]);
        for subscriber in &mut subscribers {
            let is_new = |line: &Value| is_class("sample")(line) && !boots.contains(&line["boot"]);
            let first = subscriber.await_line("a scan of this hub", is_new);
            assert_eq!(first["restarted"], u64::from(!boots.is_empty()), "{first}");
            assert_eq!(
                (number(&first, "missed"), data(&first).len()),
                (0, Scan::len(361, ArrayFlags::UPPER)),
                "{first}"
            );
            subscriber
                .await_lines(20, "scans", |line| line["boot"] == first["boot"] && line["restarted"] == 0);
        }
        let info = env.info("front");
        boots.push(subscribers[0].await_line("a sample of the next hub", is_class("sample"))["boot"].clone());
        assert_eq!(info["state"], "streaming");
        hub.end(how);
    }
    for subscriber in subscribers {
        assert_eq!(subscriber.end(INT).exit_code, None);
    }
    drop(simulator);
}

/// Returns a condition that a JSON line meets if it has this reason (a value SCANHUB_SILENCE_.. of the header) and a
/// text that contains `text`.
fn has_reason(reason: u64, text: &str) -> impl Fn(&Value) -> bool {
    move |line| line["reason"] == reason && line["text"].as_str().is_some_and(|it| it.contains(text))
}

#[test]
fn c_program_reports_a_domain_of_another_user() {
    if !rustix::process::getuid().is_root() {
        eprintln!("skipped: only root can create a directory of another user");
        return;
    }
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let silence = installed.compile(&env, &source("silence.c"), &[]);
    let domain = env.domain();
    std::fs::create_dir_all(domain.root()).expect("a directory");
    std::os::unix::fs::chown(domain.root(), Some(65_534), Some(65_534)).expect("root can change the owner");
    let other_user = 2;
    for wait_method in ["doorbell", "event"] {
        let mut subscriber = program(&env, &silence, &["front", wait_method]);
        let line = subscriber.await_line("the other user", has_reason(other_user, "belongs to user"));
        assert!(has_reason(other_user, "\n  ")(&line), "no remedy: {line}");
    }
}

#[test]
fn c_program_receives_the_reason_for_a_silence() {
    let [waiting, no_hub, unknown_sensor, paused] = [0, 1, 3, 6];
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let silence = installed.compile(&env, &source("silence.c"), &[]);
    let start = |sensor, wait_method| program(&env, &silence, &[sensor, wait_method]);
    let mut scans = start("front", "doorbell");
    let mut mistyped = ["doorbell", "event"].map(|wait_method| start("frnot", wait_method));
    for subscriber in mistyped.iter_mut().chain([&mut scans]) {
        let line = subscriber.await_line("the reason that no hub runs", has_reason(no_hub, "scanhub run"));
        assert_eq!((&line["sensors"], &line["topics"]), (&"".into(), &"".into()), "{line}");
        let earlier = number(&line, "silent_ns");
        let later = subscriber.await_line("another line", is_class("silence"));
        assert!(number(&later, "silent_ns") > earlier, "{line}, {later}");
    }
    // Without a hub, `poll` does not return before its timeout of half a second. The program prints a line only after
    // each timeout.
    let polled = mistyped[1].await_lines(6, "timeouts", is_class("silence"));
    let wakeups: u64 = polled.iter().map(|line| number(line, "wakeups")).sum();
    assert!(wakeups <= 5, "{polled:?}");

    let _simulators = ["front", "rear"].map(|name| env.simulator(&[name], &["--baud=500000"]));
    let _hub = env.hub(&[env.link("front"), env.link("rear")]);
    for subscriber in &mut mistyped {
        let is_it = has_reason(unknown_sensor, "no sensor frnot\n  the sensors are front, rear");
        let line = subscriber.await_line("the names that exist", is_it);
        assert_eq!(line["sensors"], "front rear", "{line}");
        let topics: Vec<&str> = line["topics"].as_str().expect("a text").split(' ').collect();
        assert!(topics.contains(&"front/scan") && topics.contains(&"rear/status"), "{line}");
        // Topics are sorted by sensor.
        assert!(topics.is_sorted_by_key(|topic| topic.split('/').next()), "{line}");
    }
    let is_streaming =
        |line: &Value| has_reason(waiting, "")(line) && number(line, "silent_ns") < 100_000_000;
    scans.await_line("scans", is_streaming);
    assert_eq!(env.run(&["control", "front", "pause"]).exit_code, Some(0));
    let line =
        scans.await_line("the pause", has_reason(paused, "front is paused\n  scanhub control front resume"));
    assert!(number(&line, "silent_ns") > 0, "{line}");
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    scans.await_line("scans again", is_streaming);
}

/// A program that acts on zones does not need its own timeout, because the library reports `unknown` when the hub is
/// killed.
#[test]
fn c_zones_are_unknown_after_the_hub_is_killed() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let follow = installed.compile(&env, &source("follow.c"), &[]);
    let _simulator = env.simulator(&["front"], &["--seed=33"]);
    let hub = env.hub(&[env.link("front")]);
    let mut subscribers =
        ["doorbell", "poll"].map(|wait_method| program(&env, &follow, &["front", "4", wait_method, "0"]));
    for subscriber in &mut subscribers {
        subscriber.await_line("a verdict", |line| {
            is_class("sample")(line) && line["stale"] == 0 && data(line)[0] < 3
        });
    }
    hub.end(KILL);
    for subscriber in &mut subscribers {
        let unknown = subscriber.await_line("silence", |line| line["stale"] == 1);
        assert_eq!((data(&unknown)[0], unknown.get("seq")), (3, None), "{unknown}");
    }
}

/// The combined verdict of a robot is the verdict of its worst sensor. The test first switches off one sensor and then
/// kills the hub.
#[test]
fn c_robot_has_the_verdict_of_its_worst_sensor() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let robot = installed.compile(&env, &source("robot.c"), &[]);
    let mut subscribers =
        [&["doorbell"][..], &["poll"], &["event", "front rear"]].map(|words| program(&env, &robot, words));
    for subscriber in &mut subscribers {
        let first = subscriber.await_line("the reason that no hub runs", is_class("robot"));
        assert_eq!((&first["verdict"], &first["nearest_mm"]), (&3.into(), &Value::Null), "{first}");
    }
    // The verdict is clear, because the simulated room has nothing within the zones.
    let _front = env.simulator(&["front"], &["--seed=36", "--baud=500000"]);
    let rear =
        env.start(&["simulate", "--json", "--baud=500000", &format!("--port={}", env.path_argument("rear"))]);
    let rear = rear.ready();
    let hub = env.hub(&[&env.link("front"), &env.link("rear"), "--set=zones.radii=[0.02,0.01]"]);
    let verdicts = |line: &Value| {
        let sensors = line["sensors"].as_array().expect("a list");
        let of = |sensor: &Value| (sensor["sensor"].as_str().map(str::to_owned), number(sensor, "verdict"));
        let mut sensors: Vec<_> = sensors.iter().map(of).collect();
        // Sensors are listed in the order in which their topics were created.
        sensors.sort();
        (number(line, "verdict"), sensors)
    };
    let both = |front, rear| vec![(Some("front".to_owned()), front), (Some("rear".to_owned()), rear)];
    for subscriber in &mut subscribers {
        let line = subscriber.await_line("the verdict clear", |line| verdicts(line) == (0, both(0, 0)));
        assert_eq!(line["worst"], line["sensors"][0]["sensor"], "{line}");
        let nearest =
            line["sensors"].as_array().expect("a list").iter().min_by_key(|it| number(it, "nearest_mm"));
        let nearest = nearest.expect("one of the sensors has a distance");
        assert_eq!(
            (&line["nearest_mm"], &line["nearest_sensor"]),
            (&nearest["nearest_mm"], &nearest["sensor"])
        );
    }
    env.kill_port_simulator(rear, "rear");
    for subscriber in &mut subscribers {
        let line =
            subscriber.await_line("the loss of the rear sensor", |line| verdicts(line) == (3, both(0, 3)));
        assert_eq!(line["worst"], "rear", "{line}");
    }
    assert_eq!(hub.end(KILL).exit_code, None);
    for subscriber in &mut subscribers {
        subscriber.await_line("the exit of the hub", |line| verdicts(line) == (3, both(3, 3)));
    }
}

/// Runs a program that misuses the library three times: without memory checks, with the checks that the compiler adds,
/// and in valgrind. Memory checks matter because the library shares memory with the program.
#[test]
fn c_library_rejects_misuse() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=34"]);
    let _hub = env.hub(&[env.link("front")]);
    let misuse = installed.compile(&env, &source("misuse.c"), &[]);
    let plain = misuse.display().to_string();
    let mut ways = vec![vec![plain.clone()]];
    let watch = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"];
    match installed.try_compile(&env, &source("misuse.c"), &watch) {
        Ok(watched) => ways.push(vec![watched.display().to_string()]),
        Err(_) => eprintln!("not run with memory checks of the compiler, which has none"),
    }
    if is_installed("valgrind") {
        // A child process has pointers into the middle of memory blocks that its parent allocated. Valgrind reports
        // these blocks as possible leaks. Only definite leaks are errors here.
        let leaks = ["--leak-check=full", "--show-leak-kinds=definite", "--errors-for-leak-kinds=definite"];
        let known =
            concat!("--suppressions=", env!("CARGO_MANIFEST_DIR"), "/tests/it/client_c/valgrind.supp");
        let frames = "--num-callers=40";
        let words =
            ["valgrind", "--quiet", leaks[0], leaks[1], leaks[2], known, frames, "--error-exitcode=9"];
        ways.push(words.into_iter().map(str::to_owned).chain([plain]).collect());
    }
    for wait_method in ways {
        let words: Vec<&str> = wait_method[1..].iter().map(String::as_str).chain(["front"]).collect();
        let outcome = program(&env, Path::new(&wait_method[0]), &words).wait();
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert_eq!(outcome.stdout, b"all refused\n", "{outcome}");
    }
}

/// Builds the examples in the ways that their page describes. Also builds a program that links the library statically.
#[test]
fn examples_build_and_run() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=35"]);
    let _hub = env.hub(&[env.link("front")]);
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/c/examples");
    let mut built = vec![installed.compile(&env, &examples.join("nearest.c"), &[])];
    built.extend(installed.compile_static(&env, &examples.join("nearest.c")));
    built.extend(installed.compile_with_pkg_config(&env, &examples.join("nearest.c")));
    let cmake = installed.cmake(&env, &examples);
    built.extend(cmake.iter().map(|build| build.join("nearest")));
    // Only CMake's build from the sources has the static library. The installed library lacks it, because a copy would
    // take 100 MB.
    built.extend(cmake.iter().skip(1).map(|build| build.join("nearest_static")));
    for nearest in &built {
        let outcome = program(&env, nearest, &["front", "5"]).wait();
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let printed = String::from_utf8_lossy(&outcome.stdout).into_owned();
        assert_eq!(printed.lines().count(), 5, "{printed}");
        assert!(
            printed.lines().all(|line| line.contains(" m at ") && line.ends_with(" degrees")),
            "{printed}"
        );
    }
    let mut mounts = vec![installed.compile(&env, &examples.join("mount.c"), &[])];
    mounts.extend(cmake.iter().map(|build| build.join("mount")));
    for path in &mounts {
        let mount = program(&env, path, &["swing"]);
        let lines = env.echo(&["swing/tilt"]).await_lines(20, "angles", is_class("tilt"));
        assert!(
            lines.iter().all(|line| (0.0..28.7).contains(&line["angle_deg"].as_f64().expect("a number")))
        );
        let again = program(&env, path, &["swing"]).wait();
        let held = format!("the name swing is published by process {} (", mount.pid());
        assert!(again.exit_code == Some(1) && again.stderr.contains(&held), "{again}");
        assert_eq!(mount.end(INT).stderr, "");
    }
    let Some(stop) = installed.compile_cpp(&env, &examples.join("stop.cpp")) else { return };
    for stop in cmake.iter().map(|build| build.join("stop")).chain([stop]) {
        let outcome = program(&env, &stop, &["Front"]).wait();
        assert_eq!(outcome.exit_code, Some(1), "{outcome}");
        assert!(outcome.stderr.contains("\"Front\" is not possible"), "{outcome}");
        let (feed, _keep) = std::io::pipe().expect("a pipe");
        let mut command = Command::new(&stop);
        command.arg("front").env("SCANHUB_DOMAIN", env.domain().name()).env_remove("XDG_RUNTIME_DIR");
        command.env(
            "RUNTIME_DIRECTORY",
            env.domain().root().parent().expect("the domain has a parent directory"),
        );
        let mut stop = Program::start_with(command, feed);
        let verdict = stop.next_text();
        assert!(
            ["clear", "slow", "stop", "unknown"].iter().any(|name| verdict.starts_with(name)),
            "{verdict}"
        );
    }
}

#[test]
fn cpp_20_has_optional_samples_and_spans() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let Some(modern) = installed.compile_cpp20(&env, &source("modern.cpp")) else { return };
    let _simulator = env.simulator(&["front"], &["--seed=37"]);
    let _hub = env.hub(&[env.link("front")]);
    let outcome = program(&env, &modern, &["front"]).wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert_eq!(String::from_utf8_lossy(&outcome.stdout), "361\n".repeat(5), "{outcome}");
}

#[test]
fn install_script_prints_the_linker_flag() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let flag = format!("link programs with -Wl,-rpath,{}", installed.prefix.join("lib").display());
    assert!(installed.messages.trim_end().ends_with(&flag), "{}", installed.messages);
}

#[test]
fn install_script_removes_every_file_it_installs() {
    let Some(installed) = InstalledLibrary::installed() else { return };
    let env = TestEnv::new();
    let destination = env.path("machine");
    let run = |words: &[&str]| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/c/install.sh");
        let mut command = Command::new(script);
        command.args(words).arg("--library").arg(&installed.library).env("DESTDIR", &destination);
        output(command).expect("sh starts")
    };
    for _ in 0..2 {
        expect_success(&run(&["--prefix", "/opt/robot"]));
    }
    let below = destination.join("opt/robot");
    for file in [
        "lib/libscanhub.so",
        "lib/libscanhub.so.0",
        "include/scanhub/attach.h",
        "include/scanhub/attach.hpp",
        "lib/cmake/scanhub/scanhub-config.cmake",
    ] {
        assert!(below.join(file).is_file(), "{file}");
    }
    let description =
        std::fs::read_to_string(below.join("lib/pkgconfig/scanhub.pc")).expect("the file exists");
    assert!(description.contains("prefix=/opt/robot\n"), "{description}");
    assert!(description.contains(concat!("Version: ", env!("CARGO_PKG_VERSION"), "\n")), "{description}");
    let version = below.join("lib/cmake/scanhub/scanhub-config-version.cmake");
    let version = std::fs::read_to_string(version).expect("a version file");
    let line = concat!("set(PACKAGE_VERSION \"", env!("CARGO_PKG_VERSION"), "\")\n");
    assert!(version.contains(line), "{version}");
    expect_success(&run(&["--prefix", "/opt/robot", "--remove"]));
    let left = output(Command::new("find").arg(&destination).args(["!", "-type", "d"])).expect("find starts");
    assert_eq!(expect_success(&left), "");
    assert_eq!(run(&["--prefix", "here"]).status.code(), Some(2));
}
