//! Tests that run every example on every page, exactly as the page has it. Programs run next to a hub, in a room with
//! walls and in an empty world, with sensors that measure in mm and in cm. Shell lines are run, and configurations and
//! worlds are parsed. Examples that cannot run are listed with the reason.

mod blocks;
mod data_blocks;
mod lines;
mod names;
mod output_page;
mod program;
mod reference;
mod shell;

use crate::testkit::{INT, Outcome, Program, TERM, TestEnv, is_class, run_concurrently, wait_until};
use blocks::{Block, blocks};
pub(crate) use program::Example;
use rustix::time::{ClockId, clock_gettime};

/// A simulated room and the sensor in the room.
#[derive(Clone, Copy, Debug)]
struct ExampleScene {
    world: &'static str,
    sensor: &'static str,
    unit: &'static str,
    /// Range of every beam in meters, or `None` in an empty world.
    wall_m: Option<f64>,
}

const EXAMPLE_SCENES: [ExampleScene; 5] = [
    ExampleScene { world: "empty", sensor: "lms200", unit: "mm", wall_m: None },
    ExampleScene { world: "empty", sensor: "lms291", unit: "cm", wall_m: None },
    ExampleScene { world: "wall640", sensor: "lms200", unit: "mm", wall_m: Some(0.64) },
    ExampleScene { world: "wall640", sensor: "lms200", unit: "cm", wall_m: Some(6.4) },
    ExampleScene { world: "wall640", sensor: "lms291", unit: "cm", wall_m: Some(6.4) },
];

impl ExampleScene {
    /// Starts a simulator and a hub, and waits until the sensor `front` streams.
    fn start(&self, env: &TestEnv) -> [Program; 2] {
        let ExampleScene { world, sensor, unit, .. } = self;
        let flags = [
            format!("--world={world}"),
            format!("--type={sensor}"),
            format!("--unit={unit}"),
            "--seed=81".to_owned(),
            "--baud=500000".to_owned(),
        ];
        let simulator = env.simulator(&["front"], &flags);
        let hub = env.hub(&[env.link("front"), format!("--set=link.front.type={sensor}")]);
        env.await_info("front", |info| info["state"] == "streaming");
        [simulator, hub]
    }

    /// Runs `examples` in this scene and returns a description of each failure.
    fn check_examples(&self, examples: &[Example]) -> Vec<String> {
        let env = TestEnv::new();
        let _running = self.start(&env);
        let mut recorder = env.start(&["record", "--ros2", "--json", "-o", &env.path_argument("ros.mcap")]);
        recorder
            .await_line("scans", |line| is_class("recording")(line) && line["samples"].as_u64() > Some(20));
        let recorded = recorder.end(INT);
        assert_eq!(recorded.exit_code, Some(0), "{recorded}");
        let mut verdicts = env.echo(&["front/zones"]);
        let mut run = |example| run(example, &env, &mut verdicts, self.needs_distance(example));
        examples.iter().filter_map(|example| self.check_example(example, &run(example)).err()).collect()
    }

    /// Returns whether `example` must print a distance or a verdict. An example must print one of them if the room has
    /// walls and the example prints anything.
    fn needs_distance(&self, example: &Example) -> bool {
        self.wall_m.is_some() && example.text.contains("print")
    }

    /// Returns an error that describes what is wrong with the output of `example`, if anything.
    fn check_example(&self, example: &Example, outcome: &Outcome) -> Result<(), String> {
        let wrong =
            |description: &str| Err(format!("{}, {self:?}: {description}\n{outcome}", example.location));
        // An example exits with 0 by itself, or runs until the test ends it by a signal.
        if !matches!(outcome.exit_code, None | Some(0)) || !outcome.stderr.is_empty() {
            return wrong("the example failed");
        }
        let text = String::from_utf8_lossy(&outcome.stdout);
        for (line, distance) in text.lines().filter_map(|line| Some((line, distance_m(line)?))) {
            let is_right = match self.wall_m {
                Some(wall) => (distance - wall).abs() < 0.001,
                None => !distance.is_finite(),
            };
            if !is_right {
                return wrong(&format!("wrong distance in {line:?}"));
            }
        }
        let has_result =
            |line: &str| distance_m(line).is_some() || VERDICTS.iter().any(|word| line.contains(word));
        if self.needs_distance(example) && !text.lines().any(has_result) {
            return wrong("the output has no distance with its unit, and no verdict");
        }
        Ok(())
    }
}

const VERDICTS: [&str; 4] = ["clear", "slow", "stop", "unknown"];

/// Returns the first distance in `line`, in meters: a number before the unit `m` or `mm`.
fn distance_m(line: &str) -> Option<f64> {
    let words: Vec<&str> = line.split_whitespace().collect();
    words.windows(2).find_map(|pair| {
        let metres = match pair[1] {
            "m" => 1.0,
            "mm" => 0.001,
            _ => return None,
        };
        Some(pair[0].parse::<f64>().ok()? * metres)
    })
}

/// Runs `example` next to the hub of `env` until it has received some scans, and until it has printed something if
/// `must_print` is set. `verdicts` receives the verdicts of the same scans.
fn run(example: &Example, env: &TestEnv, verdicts: &mut Program, must_print: bool) -> Outcome {
    // The example's stdin stays open, but has no data.
    let (stdin, _typed) = std::io::pipe().expect("a pipe");
    let mut program = Program::start_with(example.command(env), stdin);
    // An example that has mapped the hub's memory is attached to the hub.
    let maps = format!("/proc/{}/maps", program.pid());
    let follows = || {
        let maps = std::fs::read_to_string(&maps).unwrap_or_default();
        maps.lines().any(|map| map.contains("/dev/shm/sh_") && map.ends_with(".data"))
    };
    wait_until("a subscription to the hub", || follows() || program.has_ended());
    let now_ns = monotonic_ns();
    verdicts.await_lines(10, "a scan that began after that", |line| line["stamp_ns"].as_u64() > Some(now_ns));
    if must_print && !program.has_ended() {
        program.await_bytes(0);
    }
    if program.has_ended() { program.wait() } else { program.end(TERM) }
}

/// Returns the time of CLOCK_MONOTONIC in nanoseconds, which is the clock of stamps.
fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Returns the arguments of the shell lines on `page` that begin with one of `begins`, without the program's name.
pub(crate) fn commands_on(page: &str, begins: &[&str]) -> Vec<Vec<String>> {
    let blocks =
        blocks().into_iter().filter(|block| block.language == "sh" && block.location.starts_with(page));
    let lines = blocks.flat_map(|block| shell::lines(&block.text));
    let lines = lines.filter(|line| begins.iter().any(|begin| line.starts_with(begin)));
    lines.map(|line| shell::commands(&line).remove(0).split_off(1)).collect()
}

/// Returns the block of `page` in `language` that begins with `begin`.
pub(crate) fn text_on(page: &str, language: &str, begin: &str) -> String {
    let is_it = |block: &Block| {
        block.location.starts_with(page) && block.language == language && block.text.starts_with(begin)
    };
    blocks().into_iter().find(is_it).unwrap_or_else(|| panic!("{page} has no {begin:?}")).text
}

fn is_program(block: &Block) -> bool {
    ["python", "rust", "c", "cpp"].contains(&block.language.as_str())
}

/// Pages whose programs do not read from a hub. They subscribe to a tracker or publish the angles of a mount, and
/// `track.rs` and `tilt.rs` run them.
const PAGES_TESTED_ELSEWHERE: [&str; 2] = ["docs/tracks.md", "docs/tilt.md"];

/// Builds the programs on `page` that contain `words`, except the programs that this machine cannot build.
pub(crate) fn examples_on(page: &str, words: &str, env: &TestEnv) -> Vec<Example> {
    let is_wanted = |block: &Block| block.location.starts_with(page) && block.text.contains(words);
    let blocks = blocks().into_iter().filter(is_wanted).map(|block| match block.language.as_str() {
        "rust,no_run" => Block { language: "rust".to_owned(), ..block },
        _ => block,
    });
    let programs: Vec<Block> = blocks.filter(is_program).collect();
    assert!(!programs.is_empty(), "{page} has no program with {words}");
    programs.iter().filter_map(|block| Example::build(block, env).expect("a compiled example")).collect()
}

#[test]
fn page_programs_run_and_print_only_real_distances() {
    let is_of_others =
        |block: &Block| PAGES_TESTED_ELSEWHERE.iter().any(|page| block.location.starts_with(page));
    let is_of_hubs = |block: &Block| is_program(block) && !is_of_others(block);
    let blocks: Vec<Block> = blocks().into_iter().filter(is_of_hubs).collect();
    assert!(blocks.len() > 10, "{blocks:#?}");
    let wrong = failures(&blocks, &EXAMPLE_SCENES);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Builds the programs in `blocks`, runs them in each of `scenes`, and returns a description of each failure, with its
/// location.
fn failures(blocks: &[Block], scenes: &[ExampleScene]) -> Vec<String> {
    let shop = TestEnv::new();
    let (mut examples, mut wrong) = (Vec::new(), Vec::new());
    for block in blocks {
        match Example::build(block, &shop) {
            Ok(example) => examples.extend(example),
            Err(refused) => wrong.push(format!("{}: {refused}", block.location)),
        }
    }
    // Run the scenes concurrently. Each scene has its own hub, and the programs wait most of the time.
    wrong.extend(run_concurrently(scenes, |situation| situation.check_examples(&examples)).concat());
    wrong
}

/// Examples with mistakes that pages once had. The test must report the expected error for each of them.
#[test]
fn page_program_that_misuses_codes_is_detected() {
    let block = |language: &str, text: &str| Block {
        location: format!("planted.md:{}", text.len()),
        language: language.to_owned(),
        text: text.to_owned(),
    };
    let follow = "import scanhub\nfor scan in scanhub.subscribe('front/scan'):\n    ";
    let planted = [
        (
            block("python", &format!("{follow}print(scan.ranges.min() * (scan.unit_um / 1000), 'mm')\n")),
            "wrong distance in",
        ),
        (
            block("python", &format!("{follow}print(scan.ranges_m[scan.valid].min(), 'm')\n")),
            "the example failed",
        ),
        (block("python", &format!("{follow}print(scan.ranges[180])\n")), "no distance with its unit"),
        (
            block("rust", "scanhub_client::subscribe::<scanhub_client::Scan>(\"front\").unwrap();\n"),
            "mismatched types",
        ),
        (block("c", "puts(scanhub_open());\n"), "too few arguments"),
    ];
    let situations = [EXAMPLE_SCENES[0], EXAMPLE_SCENES[4]];
    let blocks = planted.each_ref().map(|(block, _)| block.clone());
    let wrong = failures(&blocks, &situations);
    for (block, what) in planted {
        let is_skipped = Example::build(&block, &TestEnv::new()).is_ok_and(|example| example.is_none());
        let of_it = |wrong: &&String| {
            wrong.strip_prefix(&block.location).is_some_and(|rest| rest.starts_with([',', ':']))
        };
        let is_found = wrong.iter().filter(of_it).any(|wrong| wrong.contains(what));
        assert!(is_skipped || is_found, "{block:#?}: {wrong:#?}");
    }
}
