//! `scanhub leds`: shows the zones and marks of a robot in a terminal and on LEDs. A directory of files stands in for
//! the real LEDs.

use std::fs;
use std::io::Read;
use std::path::PathBuf;
use std::process::Stdio;

use crate::testkit::{
    INT, KILL, Program, TERM, TestEnv, TestGateway, in_a_network, is_class, number, spawn, terminal,
    wait_until,
};
use rustix::process::Signal;
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::Value;

/// Returns the flag for a world that has the walls of a room, far from the sensor, and the object `thing`.
fn world(env: &TestEnv, name: &str, thing: &str) -> String {
    let room = "[noise]\ntail = 0\n\n[[thing]]\nline = [[3000, -3000], [3000, 3000], [-3000, 3000], [-3000, -3000]]\n";
    format!("--world={}", env.file(name, format!("{room}\n{thing}")))
}

const POST_WORLD: &str = "[[thing]]\nradius_mm = 20\npose = [0, 400]\n";
const STRIP_WORLD: &str = "[[thing]]\nline = [[-50, 2000], [50, 2000]]\nsurface = \"reflector\"\n";

fn simulator(env: &TestEnv, world: &str) -> Program {
    env.simulator(&["front"], &["--seed=61", "--baud=500000", world])
}

/// Directory that stands in for the LEDs of Linux.
struct FakeLeds(PathBuf);

const LED_NAMES: [&str; 4] = ["gn", "ye", "rd", "mk"];

impl FakeLeds {
    fn new(env: &TestEnv) -> FakeLeds {
        let diodes = FakeLeds(env.path("leds"));
        fs::create_dir(&diodes.0).unwrap();
        LED_NAMES.iter().for_each(|name| diodes.create_led(name));
        diodes
    }

    /// Creates an LED with all its files in one step, by renaming a directory, because the kernel creates an LED in one
    /// step, too.
    fn create_led(&self, name: &str) {
        let aside = self.0.with_extension(name);
        fs::create_dir(&aside).unwrap();
        for (file, content) in
            [("max_brightness", "255\n"), ("trigger", "[none] timer\n"), ("brightness", "9\n")]
        {
            fs::write(aside.join(file), content).unwrap();
        }
        fs::rename(&aside, self.0.join(name)).unwrap();
    }

    fn remove_led(&self, name: &str) {
        fs::remove_dir_all(self.0.join(name)).unwrap();
    }

    /// Returns the names of the LEDs that are lit, or `None` if an LED is neither on nor off, or is missing.
    fn lit_names(&self) -> Option<String> {
        let mut lit = Vec::new();
        for name in LED_NAMES {
            match fs::read_to_string(self.0.join(name).join("brightness")).ok()?.as_str() {
                "255\n" => lit.push(name),
                "0\n" => {}
                _ => return None,
            }
        }
        Some(lit.join(" "))
    }

    fn wait_until_lit(&self, names: &str) {
        wait_until(&format!("{names} lit"), || self.lit_names().as_deref() == Some(names));
    }

    fn flags(&self) -> [String; 2] {
        let root = format!("--led-root={}", self.0.display());
        [root, "--led=green=gn,yellow=ye,red=rd,mark=mk".to_owned()]
    }
}

#[test]
fn leds_show_the_verdict_and_red_without_one() {
    let env = TestEnv::new();
    let diodes = FakeLeds::new(&env);
    let [root, led] = diodes.flags();
    // At first, no hub runs.
    let leds = env.start(&["leds", "front", "--json", &root, &led]);
    diodes.wait_until_lit("rd");
    let open = world(&env, "open", STRIP_WORLD);
    let sensor = simulator(&env, &open);
    let hub = env.hub(&[env.link("front")]);
    diodes.wait_until_lit("gn mk");
    // First the scanner stops sending. Later, the hub is killed.
    assert_eq!(sensor.end(TERM).exit_code, Some(0));
    diodes.wait_until_lit("rd");
    let _sensor = simulator(&env, &open);
    diodes.wait_until_lit("gn mk");
    drop(hub.end(KILL));
    diodes.wait_until_lit("rd");
    let hub = env.hub(&[env.link("front")]);
    diodes.wait_until_lit("gn mk");
    // When `leds` exits, it switches to red, because it no longer monitors the verdict.
    let outcome = leds.end(INT);
    assert_eq!((outcome.exit_code, diodes.lit_names().as_deref()), (Some(0), Some("rd")), "{outcome}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));

    let lines = outcome.of_class("leds");
    let verdicts: Vec<_> = lines.iter().map(|line| line["verdict"].as_str().unwrap()).collect();
    assert_eq!((verdicts[0], verdicts[verdicts.len() - 1]), ("unknown", "unknown"), "{outcome}");
    for line in &lines {
        let is_clear = line["verdict"] == "clear";
        assert_eq!((&line["green"], &line["red"]), (&is_clear.into(), &(!is_clear).into()), "{line}");
        assert_eq!(line["mark"], line["marks"].as_u64().is_some_and(|marks| marks > 0), "{line}");
    }
    for pair in lines.windows(2) {
        // On a busy machine, scans may be lost. `leds` then prints a line in which only the reason has changed.
        let shown = |line: &Value| ["verdict", "marks", "reason"].map(|key| line[key].clone());
        assert!(shown(&pair[0]) != shown(&pair[1]), "no change: {pair:#?}");
    }
}

#[test]
fn mark_led_turns_off_when_scans_end() {
    let env = TestEnv::new();
    let diodes = FakeLeds::new(&env);
    let [root, led] = diodes.flags();
    let sensor = simulator(&env, &world(&env, "open", STRIP_WORLD));
    let hub = env.hub(&[env.link("front")]);
    let leds = env.start(&["leds", "front", "--json", &root, &led]);
    diodes.wait_until_lit("gn mk");
    // While `leds` is stopped, both the last marks and the zones that report missing scans queue up. `leds` must not
    // show the old marks after these zones.
    leds.signal(Signal::STOP);
    assert_eq!(env.run(&["echo", "front/marks", "-n", "5"]).exit_code, Some(0));
    assert_eq!(sensor.end(TERM).exit_code, Some(0));
    env.echo(&["front/zones"]).await_line("unknown", |line| line["verdict"] == "unknown");
    leds.signal(Signal::CONT);
    diodes.wait_until_lit("rd");
    let outcome = leds.end(INT);
    let last = outcome.of_class("leds").pop().expect("a line");
    assert_eq!((outcome.exit_code, &last["mark"], &last["marks"]), (Some(0), &false.into(), &Value::Null));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn stop_lights_red_and_slow_lights_yellow() {
    let env = TestEnv::new();
    let diodes = FakeLeds::new(&env);
    let [root, led] = diodes.flags();
    let _sensor = simulator(&env, &world(&env, "post", POST_WORLD));
    let hub = env.hub(&[env.link("front")]);
    let mut leds = env.start(&["leds", "front", "--json", &root, &led]);
    leds.await_line("stop", |line| line["verdict"] == "stop" && line["red"] == true);
    assert_eq!(diodes.lit_names().as_deref(), Some("rd"));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    let _hub = env.hub(&[&env.link("front"), "--set=zones.radii=[1.0, 0.2]"]);
    leds.await_line("slow", |line| line["verdict"] == "slow" && line["yellow"] == true);
    diodes.wait_until_lit("ye");
    assert_eq!(leds.end(TERM).exit_code, Some(0));
    assert_eq!(diodes.lit_names().as_deref(), Some("rd"));
}

#[test]
fn reports_unplugged_led_and_drives_the_others() {
    let env = TestEnv::new();
    let diodes = FakeLeds::new(&env);
    let [root, led] = diodes.flags();
    let sensor = simulator(&env, &world(&env, "open", STRIP_WORLD));
    let _hub = env.hub(&[env.link("front")]);
    let mut leds = env.start(&["leds", "front", "--json", &root, &led]);
    diodes.wait_until_lit("gn mk");
    diodes.remove_led("gn");
    assert_eq!(sensor.end(TERM).exit_code, Some(0));
    let failed = leds.await_line("report that an LED failed", |line| line["class"] == "led");
    assert_eq!(
        (&failed["light"], &failed["name"], &failed["state"]),
        (&"green".into(), &"gn".into(), &"failed".into())
    );
    assert!(failed["message"].as_str().is_some_and(|message| message.contains("gn/brightness")), "{failed}");
    assert_eq!(fs::read_to_string(diodes.0.join("rd/brightness")).unwrap(), "255\n", "the stop light");
    diodes.create_led("gn");
    let back = leds.await_line("report that the LED works again", |line| line["class"] == "led");
    assert_eq!((&back["name"], &back["state"]), (&"gn".into(), &"recovered".into()));
    assert_eq!(diodes.lit_names().as_deref(), Some("rd"));
    let _sensor = simulator(&env, &world(&env, "open", STRIP_WORLD));
    diodes.wait_until_lit("gn mk");
    assert_eq!(leds.end(INT).exit_code, Some(0));
}

#[test]
fn leds_of_a_robot_show_its_worst_sensor() {
    let env = TestEnv::new();
    let open = world(&env, "open", "");
    let _front = simulator(&env, &open);
    let rear = env.simulator(&["rear"], &["--seed=62", "--baud=500000", &open]);
    let _hub = env.hub(&[env.link("front"), env.link("rear")]);
    let mut leds = env.start(&["leds", "robot", "--json"]);
    leds.await_line("clear", |line| line["verdict"] == "clear" && line["green"] == true);
    assert_eq!(rear.end(TERM).exit_code, Some(0));
    // On a busy machine, the scans of `front` may be late for a short time. Wait for the line about `rear`, which
    // remains absent.
    let lost = leds.await_line("unknown", |line| line["verdict"] == "unknown" && line["worst"] == "rear");
    assert_eq!(
        (&lost["sensor"], &lost["worst"], &lost["red"]),
        (&"robot".into(), &"rear".into(), &true.into())
    );
    assert_eq!(leds.end(INT).exit_code, Some(0));
}

fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// The test sends each verdict itself, so the test can measure how long a verdict was valid before it was shown.
#[test]
fn only_a_better_verdict_waits_for_the_hold_time() {
    in_a_network("leds::only_a_better_verdict_waits_for_the_hold_time", || {
        let env = TestEnv::new();
        let mut front = TestGateway::new(1, 7, 0, "front");
        let mut listener =
            env.start(&["listen", "--json", "--publish", "--name=robot1=0000000000000001"]).ready();
        front.wait_until_published(&mut listener, &[Topic::Zones]);
        let mut send_verdict = |verdict: Verdict| {
            front.send(Topic::Zones, &Zones { verdict: verdict as u8, ..Zones::unknown() });
        };
        // Starts `leds` with a hold time. All of these programs receive the same verdicts.
        let leds = |hold: &[&str]| {
            let before = env.subscribers("robot1.front/zones");
            let program = env.start(&[&["leds", "robot1.front", "--json"], hold].concat());
            wait_until("leds is attached", || env.subscribers("robot1.front/zones") > before);
            program
        };
        let (mut usual, mut long, mut none) = (leds(&[]), leds(&["--hold=1h"]), leds(&["--hold=0s"]));
        send_verdict(Verdict::Stop);
        let is =
            |verdict: &'static str| move |line: &Value| is_class("leds")(line) && line["verdict"] == verdict;
        for program in [&mut usual, &mut long, &mut none] {
            program.await_line("immediate stop", is("stop"));
        }
        let sent_ns = now_ns();
        let mut shown = Value::Null;
        // Send the verdict again and again, because it is valid only for a short time.
        wait_until("clear is shown after the hold time", || {
            send_verdict(Verdict::Clear);
            usual.printed(is("clear")).map(|line| shown = line).is_some()
        });
        none.await_line("immediate clear", is("clear"));
        let valid_ns = number(&shown, "stamp_ns") - sent_ns;
        assert!(valid_ns > 250_000_000, "clear was shown after {} ms", valid_ns / 1_000_000);
        let outcome = long.end(INT);
        let verdicts: Vec<_> = outcome.of_class("leds").iter().map(|line| line["verdict"].clone()).collect();
        assert_eq!(verdicts, ["unknown", "stop", "unknown"], "leds must show unknown at its end: {outcome}");
        assert_eq!((usual.end(INT).exit_code, none.end(INT).exit_code), (Some(0), Some(0)));
    });
}

#[test]
fn rejects_unknown_leds_and_sensors() {
    let env = TestEnv::new();
    let diodes = FakeLeds::new(&env);
    let [root, _] = diodes.flags();
    for (sensor, led, what) in [
        ("front", "red=nd", "has no LED \"nd\""),
        ("front", "red=rd,green=nd", "has no LED \"nd\""),
        ("front", "blue=rd", "--led blue=rd cannot be shown"),
        ("front", "red", "--led red cannot be shown"),
        ("robot", "mark=mk", "--led mark=mk cannot be shown"),
        ("front", "yellow=rd,red=rd", "--led red=rd cannot be shown"),
    ] {
        let outcome = env.run(&["leds", sensor, "--json", &root, "--led", led]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(78), &"configuration".into()), "{outcome}");
        assert!(error["message"].as_str().is_some_and(|message| message.contains(what)), "{outcome}");
        assert!(error["hint"].as_str().is_some_and(|hint| !hint.is_empty()), "{outcome}");
    }
    let misspelt = env.run(&["leds", "front", "--json", "--led=gren=rd"]);
    let hint = misspelt.of_class("error")[0]["hint"].clone();
    assert!(
        hint.as_str().is_some_and(|hint| hint.starts_with("no light \"gren\": green=NAME")),
        "{misspelt}"
    );
    // `leds` opened this LED before it refused another one, so the LED shows red.
    assert_eq!(fs::read_to_string(diodes.0.join("rd/brightness")).unwrap(), "255\n");
    // `leds` exits like all subscribers: a run with a time limit fails without a running hub, and an unknown sensor is
    // an error.
    assert_eq!(env.run(&["leds", "front", "--for=1s"]).exit_code, Some(3));
    let _hub = env.hub(&[env.link("front")]);
    let unknown = env.run(&["leds", "side", "--json"]);
    assert_eq!(
        (unknown.exit_code, &unknown.of_class("error")[0]["hint"]),
        (Some(3), &"there are front".into())
    );
}

#[test]
fn leds_update_a_single_line_on_a_terminal() {
    for (no_color, colour) in [(None, "\x1b[1;31m● red\x1b[0m"), (Some("1"), "  ● red  ")] {
        let env = TestEnv::new();
        let (mut keys, screen) = terminal();
        let mut command = env.command(&["leds", "front", "--for=1s", "--timeout=200ms"]);
        command.env_remove("NO_COLOR").envs(no_color.map(|value| ("NO_COLOR", value)));
        command.stdin(Stdio::null()).stderr(Stdio::null()).stdout(Stdio::from(screen));
        let mut process = spawn(command).unwrap();
        let mut printed = Vec::new();
        // Reading fails as soon as no program has the terminal open.
        let _ = keys.read_to_end(&mut printed);
        assert_eq!(process.wait().unwrap().code(), Some(3));
        let text = String::from_utf8(printed).unwrap();
        assert!(text.starts_with("\r\x1b[K\x1b[?7lfront"), "{text:?}");
        assert!(text.contains(colour) && text.ends_with("unknown\x1b[?7h\r\n"), "{text:?}");
        assert_eq!(text.matches('\n').count(), 1, "{text:?}");
    }
}
