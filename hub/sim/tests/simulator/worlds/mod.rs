//! Tests of worlds. Every file in the directory is a valid world. The simulator rejects an invalid file with the name
//! of the file and the position of the error. The true targets agree with the geometry of the world.

mod layers;

use std::collections::BTreeSet;

use proptest::prelude::*;
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_schema::{Failure, Nanos, Scan, ScanHead};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::mount::Mount;
use scanhub_sim::room::{BeamTarget, LabeledScan, Room};
use scanhub_sim::world::World;

/// The directory of the built-in worlds.
const WORLDS_FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/worlds");

/// Period of the scans of 361 beams.
const SCAN_PERIOD_NS: Nanos = 26_640_000;

/// Returns the room of a world in TOML.
fn room(text: &str, seed: u64) -> Room {
    Room::new(&world(text), seed)
}

fn world(text: &str) -> World {
    World::of_toml("world", text).unwrap_or_else(|failure| panic!("{failure}"))
}

/// Measures a scan of 361 beams in millimeters, with levels.
fn scan_at(room: &Room, end_ns: Nanos) -> LabeledScan {
    room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), end_ns)
}

/// Returns the text of the built-in world with this name.
fn text(name: &str) -> String {
    std::fs::read_to_string(format!("{WORLDS_FOLDER}/{name}.toml")).expect("a file of this name")
}

#[test]
fn every_world_file_is_built_in() {
    let files: BTreeSet<String> = std::fs::read_dir(WORLDS_FOLDER)
        .expect("the directory of worlds")
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "toml"))
        .map(|path| path.file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    let brought: BTreeSet<String> = World::names().map(str::to_owned).collect();
    let coded: Vec<_> = brought.difference(&files).collect();
    assert_eq!(coded, ["empty", "random", "wall640"]);
    assert!(files.is_subset(&brought), "{files:?}");
    for name in &files {
        assert_eq!(name.parse::<World>(), format!("{WORLDS_FOLDER}/{name}.toml").parse(), "{name}");
    }
}

#[test]
fn every_world_shows_its_objects_within_a_minute() {
    let targets_of = |name: &str| {
        let world: World = name.parse().unwrap();
        let mut kinds = BTreeSet::new();
        for port in 0..world.sensors() as u64 {
            let room = Room::of_port(&world, 3, port);
            for scan in (0..2_250).step_by(25) {
                let end_ns = scan * SCAN_PERIOD_NS;
                let first = scan_at(&room, end_ns);
                assert_eq!(first, scan_at(&room, end_ns), "{name} at {end_ns}");
                kinds.extend(first.truth.iter().map(|target| match target {
                    BeamTarget::Static { since_ns: 0 } => "static",
                    BeamTarget::Static { .. } => "uncovered",
                    BeamTarget::Person => "person",
                    BeamTarget::Box { .. } => "box",
                    BeamTarget::Grazed => "grazed",
                    BeamTarget::Invalid => "invalid",
                }));
            }
        }
        kinds.into_iter().collect::<Vec<_>>().join(" ")
    };
    for name in ["room", "standing", "approach", "corridor", "glass", "faint", "sun"] {
        assert_eq!(targets_of(name), "grazed invalid person static", "{name}");
    }
    for name in ["fig8", "door", "chair", "crowd", "demo", "house"] {
        assert_eq!(targets_of(name), "box grazed invalid person static uncovered", "{name}");
    }
    assert_eq!(
        (targets_of("bare"), targets_of("strips")),
        ("invalid static".into(), "invalid static".into())
    );
}

#[test]
fn each_seed_gives_a_different_run() {
    for name in
        ["fig8", "standing", "approach", "door", "corridor", "glass", "faint", "sun", "chair", "crowd"]
    {
        let world: World = name.parse().unwrap();
        let world = world.with_noise(scanhub_sim::beam::NoiseModel::NONE);
        let scan = |seed| Room::new(&world, seed).scan(Variant::HALF, Unit::Mm, Mode(1), 17_000_000_000);
        let runs: BTreeSet<Vec<u16>> = (0..10).map(scan).collect();
        assert_eq!(runs.len(), 10, "{name}");
    }
}

/// Two sensors at the same position see the same people, each sensor with its own noise. If there are more ports than
/// sensors, the next port belongs to a copy of the world with other people.
#[test]
fn ports_beyond_the_last_sensor_have_another_world() {
    let text = format!("{}[[sensor]]\npose = [0, 100, 90]\n", text("fig8"));
    let quiet = world(&text).with_noise(scanhub_sim::beam::NoiseModel::NONE);
    let noisy = world(&text);
    let scan = |world, port| scan_at(&Room::of_port(world, 5, port), 20_000_000_000).words;
    assert_eq!(quiet.sensors(), 2);
    assert_eq!(scan(&quiet, 0), scan(&quiet, 1));
    assert_ne!(scan(&noisy, 0), scan(&noisy, 1));
    assert_ne!(scan(&quiet, 0), scan(&quiet, 2));
    assert_eq!(scan(&quiet, 2), scan_at(&Room::new(&quiet, 6), 20_000_000_000).words);
}

#[test]
fn empty_world_has_only_invalid_beams() {
    let look = scan_at(&room("", 1), SCAN_PERIOD_NS);
    assert!(
        look.words.iter().all(|&word| word == 8191)
            && look.truth.iter().all(|&target| target == BeamTarget::Invalid)
    );
}

#[test]
fn refuses_invalid_worlds_with_location_and_remedy() {
    let refused = |text: &str| -> Failure { World::of_toml("w.toml", text).expect_err(text) };
    for (text, place, remedy) in [
        (
            "[[thing]]\nradius_m = 3\npose = [0, 0]",
            "w.toml:2:1: unknown key `radius_m`",
            "did you mean `radius_mm`?",
        ),
        ("[[persn]]\n", "w.toml:1:3: unknown key `persn`", "did you mean `person`?"),
        ("[noise]\nsigma_mm = -1", "w.toml:2:12: -1 is out of range", "from 0 to 1000"),
        ("[noise]\nerrors = 1.5", "w.toml:2:10: 1.5", "from 0 to 1"),
        ("[noise]\nspot = 1", "w.toml:2:8: ", "docs/worlds.md"),
        ("[[sensor]]\npose = [1]", "w.toml:2:8: a pose of 1 numbers", "[x, y] in millimeters"),
        ("[[sensor]]\npose = [nan, 2]", "w.toml:2:8: NaN is not between", "docs/worlds.md"),
        ("\n[[thing]]\npose = [1, 2]", "w.toml:2:1: a thing with no shape", "one of: line"),
        ("[[thing]]\nline = [[0, 0]]", "w.toml:1:1: a thing", "one of: line"),
        ("[[thing]]\nline = [[0, 0], [1, 1]]\nbox = [1, 1]", "w.toml:1:1: a thing", "one of: line"),
        ("[[thing]]\nbox = [1, -1]", "w.toml:2:7: -1 is not between 1", "docs/worlds.md"),
        ("[[thing]]\nlegs = [400, 400]", "w.toml:1:1: a thing", "radius_mm of each"),
        ("[[thing]]\nradius_mm = 10\nsurface = \"wood\"", "w.toml:3:11: surface = \"wood\"", "plain, dark"),
        ("[[thing]]\nradius_mm = 10\nfrom_s = 3\nuntil_s = 2", "w.toml:4:11: until_s = 2", "after the start"),
        (
            "[[thing]]\nradius_mm = 10\nmoves = [{ from_s = 2, until_s = 1, by = [1, 1] }]",
            "w.toml:3:21: a move",
            "from_s <= until_s",
        ),
        (
            "[[thing]]\nradius_mm = 10\nfrom_s = 3\nmoves = [{ from_s = 2, until_s = 4, by = [1, 1] }]",
            "w.toml:4:21: a move from 2 s until 4 s, after 3 s",
            "once it is put down",
        ),
        (
            "[[thing]]\nradius_mm = 10\nuntil_s = 3\nmoves = [{ from_s = 2, until_s = 4, by = [1, 1] }]",
            "w.toml:4:34: a move until 4 s of a thing that is removed at 3 s",
            "before the thing is removed",
        ),
        (
            "[[thing]]\nradius_mm = 10\nmoves = [{ from_s = 2, until_s = 4, by = [1, 1] }]\nrepeat_s = 5",
            "w.toml:4:12: moves that cannot be repeated every 5 s",
            "end where they began",
        ),
        (
            "[[thing]]\nradius_mm = 10\nrepeat_s = 1\n\
             moves = [{ from_s = 2, until_s = 3, by = [1, 1] }, { from_s = 3, until_s = 4, by = [-1, -1] }]",
            "w.toml:3:12: moves that cannot be repeated every 1 s",
            "within repeat_s",
        ),
        ("[[thing]]\nradius_mm = 10\nrepeat_s = 5", "w.toml:3:12: moves that", "within repeat_s"),
        ("\n[[person]]\nfrom_s = 3", "w.toml:2:1: a person with no path", "path = "),
        (
            "[[person]]\npath = []\nuntil_s = 3",
            "w.toml:2:8: a path without points",
            "[x, y, seconds of rest]",
        ),
        (
            "[[person]]\npath = [[0, 0], [1, 1]]",
            "w.toml:2:8: the person's speed is not set",
            "speed_mm_s or until_s",
        ),
        (
            "[[person]]\npath = [[0, 0, 2], [1, 1, 3]]\nfrom_s = 1\nuntil_s = 6",
            "w.toml:2:8: 5 s of rest from 1 s until 6 s",
            "time to walk",
        ),
        (
            "[[person]]\npath = [[0, 0, 1, 90, 2]]\nuntil_s = 3",
            "w.toml:2:8: a path without points",
            "[x, y, seconds, degrees that a sitter faces]",
        ),
        (
            "[[person]]\npath = [[0, 0], [1, 1, 2.3, 90]]\nspeed_mm_s = 900",
            "w.toml:2:8: a person who sits for 2.3 s",
            "2.4 s or more",
        ),
        (
            "[[person]]\npath = [[0, 0], [1, 1]]\nspeed_mm_s = [9, 1]",
            "w.toml:3:14: speed",
            "the slower one first",
        ),
        (
            "[[person]]\npath = [[0, 0], [1, 1]]\nuntil_s = 9\nrepeat = true",
            "w.toml:4:10: a path that cannot",
            "several corners and speed_mm_s",
        ),
        (
            "[[person]]\npath = [[0, 0], [0, 0]]\nspeed_mm_s = 900\nrepeat = true",
            "w.toml:4:10: a path that cannot",
            "several corners and speed_mm_s",
        ),
        ("[[person]]\npath = [[0, 0], [1, 1]]\nspeed_mm_s = \"fast\"", "w.toml:3:14: ", "docs/worlds.md"),
        ("[[person]]\ncentre = [0, 0]\nreach = [0, 1]", "w.toml:3:9: 0 is not between 1", "docs/worlds.md"),
        ("[[sun]]\nfrom_deg = 9\nto_deg = -1", "w.toml:3:10: from_deg", "the smaller one first"),
        ("[[sun]]\nsector_deg = [93, 116]", "w.toml:2:14: sector_deg", "from_deg = 3.0, to_deg = 26.0"),
        ("[[sun]\n", "w.toml:1:7: ", "docs/worlds.md"),
    ] {
        let failure = refused(text);
        assert_eq!(failure.kind.exit_code(), 78);
        assert!(failure.message.starts_with(place), "{text}\n{failure}");
        assert!(failure.hint.contains(remedy), "{text}\n{failure}");
    }
    let nowhere = "moon".parse::<World>().unwrap_err();
    assert!(nowhere.message.contains("\"moon\"") && nowhere.hint.contains("fig8"), "{nowhere}");
}

#[test]
fn page_shows_a_world_with_every_key() {
    let page = include_str!("../../../../../docs/worlds.md");
    let example =
        page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
    world(example);
    // The example has keys that exclude each other. Some of them are in comments, which count as shown.
    let shown = |key: &str| example.lines().any(|line| line.trim_start_matches("# ").starts_with(key));
    let failure = World::of_toml("w.toml", "[[thing]]\nx = 1").unwrap_err();
    let persons = World::of_toml("w.toml", "[[person]]\nx = 1").unwrap_err();
    for known in
        [failure, persons].iter().flat_map(|failure| failure.hint.rsplit(": ").next().unwrap().split(", "))
    {
        assert!(shown(known), "{known} is not on the page");
    }
    for name in World::names() {
        assert!(page.contains(&format!("`{name}`")), "{name} is not on the page");
    }
}

proptest! {
    /// The simulator rejects a damaged file with a position, or the file is still a valid world.
    #[test]
    fn damaged_file_is_refused_or_runs(
        file in 0..13usize,
        at in any::<prop::sample::Index>(),
        cut in 0..12usize,
        patch in "[-0-9.,=a-z_\\[\\]\"é# \n]{0,8}",
    ) {
        let names = ["fig8", "door", "crowd", "sun", "approach", "room", "standing", "corridor", "glass", "chair", "strips", "bare", "faint"];
        let mut characters: Vec<char> = text(names[file]).chars().collect();
        let from = at.index(characters.len());
        let until = (from + cut).min(characters.len());
        characters.splice(from..until, patch.chars());
        match World::of_toml("w.toml", &characters.into_iter().collect::<String>()) {
            Ok(world) => {
                for port in 0..world.sensors() as u64 {
                    let look = scan_at(&Room::of_port(&world, 1, port), 16_000_000_000);
                    prop_assert_eq!(look.words.len(), 361);
                }
            }
            Err(failure) => prop_assert!(failure.message.starts_with("w.toml:"), "{}", failure),
        }
    }
}

const ONE_SECOND: Nanos = 1_000_000_000;
/// No noise, but beams as wide as those of a real scanner.
const WIDE_BEAMS: NoiseModel = NoiseModel { spot: true, ..NoiseModel::NONE };

/// Returns the scans of two worlds: the world of `text`, and the world of `text` without the part that starts with
/// `cut`.
fn with_and_without(text: &str, cut: &str, end_ns: Nanos) -> (LabeledScan, LabeledScan) {
    let (without, _) = text.split_once(cut).expect("the part to remove");
    let look_at = |text: &str| scan_at(&Room::new(&world(text).with_noise(WIDE_BEAMS), 4), end_ns);
    (look_at(text), look_at(without))
}

/// Returns the built-in world with this name, without displacements that depend on the seed. Otherwise, the objects
/// that [`with_and_without`] removes would change the random numbers of the other objects.
fn without_randomness(name: &str) -> String {
    text(name).lines().filter(|line| !line.starts_with("jitter_mm")).collect::<Vec<_>>().join("\n")
}

#[test]
fn person_beams_differ_from_the_empty_room() {
    let (mut persons, mut grazed) = (0, 0);
    for tenth in 0..530 {
        let (with, without) =
            with_and_without(&without_randomness("fig8"), "[[person]]", tenth * ONE_SECOND / 10);
        let inside = (80..290).contains(&tenth);
        for (beam, target) in with.truth.iter().enumerate() {
            let (range, empty) = (with.words[beam], without.words[beam]);
            match target {
                BeamTarget::Person => {
                    assert!(inside && range < empty, "beam {beam} at {tenth}: {range} before {empty}");
                    persons += 1;
                }
                BeamTarget::Grazed if inside || without.truth[beam] != BeamTarget::Grazed => {
                    assert!(inside, "beam {beam} at {tenth}");
                    grazed += 1;
                }
                // A beam on two surfaces far apart can lose its signal.
                BeamTarget::Invalid if inside => {}
                _ => assert_eq!((range, target), (empty, &without.truth[beam]), "beam {beam} at {tenth}"),
            }
        }
    }
    assert!(persons > 800 && grazed > 200 && grazed < persons, "{persons} {grazed}");
}

#[test]
fn truth_of_a_box_has_its_placement_time() {
    let room = Room::new(&"fig8".parse().unwrap(), 2);
    let boxes = |end_ns| {
        scan_at(&room, end_ns).truth.into_iter().filter(|target| matches!(target, BeamTarget::Box { .. }))
    };
    assert_eq!(boxes(15 * ONE_SECOND).count(), 0);
    for end_ns in [15 * ONE_SECOND + ONE_SECOND / 10, 50 * ONE_SECOND] {
        assert!(boxes(end_ns).count() > 10);
        assert!(boxes(end_ns).all(|target| target == BeamTarget::Box { since_ns: 15 * ONE_SECOND }));
    }
}

#[test]
fn surface_uncovered_by_a_box_is_static_and_new() {
    let room = Room::new(&"fig8".parse().unwrap(), 2);
    let gone_ns = 22 * ONE_SECOND + ONE_SECOND / 2;
    let uncovered = |end_ns: Nanos| -> Vec<usize> {
        let truth = scan_at(&room, end_ns).truth;
        (0..361).filter(|&beam| truth[beam] == BeamTarget::Static { since_ns: gone_ns }).collect()
    };
    assert!(uncovered(gone_ns - ONE_SECOND).is_empty());
    let beams = uncovered(50 * ONE_SECOND);
    assert!(beams.len() > 10, "{beams:?}");
    let (before, after) = (scan_at(&room, 5 * ONE_SECOND), scan_at(&room, 50 * ONE_SECOND));
    for beam in beams {
        let is_valid_twice =
            before.truth[beam] != BeamTarget::Invalid && after.truth[beam] != BeamTarget::Invalid;
        // A beam at an edge of the box may have reported the surface behind the box already before the removal.
        let edge = before.truth[beam - 2..beam + 3] != [BeamTarget::Static { since_ns: 0 }; 5];
        let [then, now] = [&before, &after].map(|look| i32::from(look.words[beam] & 8191));
        assert!(
            !is_valid_twice || edge || now > then + 30 || (now - then).abs() < 60,
            "beam {beam}: {then} to {now}"
        );
    }
}

#[test]
fn truth_of_a_door_has_its_last_motion_time() {
    let room = Room::new(
        &world(&without_randomness("door")).with_noise(NoiseModel { comb: false, ..WIDE_BEAMS }),
        1,
    );
    let since = |end_ns| {
        let mut since: Vec<Nanos> = scan_at(&room, end_ns)
            .truth
            .iter()
            .filter_map(|target| match target {
                BeamTarget::Box { since_ns } => Some(*since_ns),
                _ => None,
            })
            .collect();
        since.dedup();
        since
    };
    assert!(since(10 * ONE_SECOND).is_empty());
    // While the box moves, its target has the time of the mirror's revolution that measures it.
    assert_eq!(since(14 * ONE_SECOND + ONE_SECOND / 2), [14 * ONE_SECOND + ONE_SECOND / 2 - 13_320_000]);
    assert_eq!(since(20 * ONE_SECOND), [15 * ONE_SECOND + ONE_SECOND / 2]);
    assert_eq!(since(50 * ONE_SECOND), [35 * ONE_SECOND + ONE_SECOND / 2]);
}

#[test]
fn receding_box_is_static_and_approaching_one_a_box() {
    let text =
        "[[thing]]\nbox = [600, 200]\npose = [0, 2000]\nmoves = [{ from_s = 5, until_s = 6, by = [0, DY] }]";
    let truth = |by: &str| {
        let room = Room::new(&world(&text.replace("DY", by)).with_noise(WIDE_BEAMS), 1);
        scan_at(&room, 10 * ONE_SECOND).truth[180]
    };
    assert_eq!(truth("-50"), BeamTarget::Box { since_ns: 6 * ONE_SECOND });
    assert_eq!(truth("50"), BeamTarget::Static { since_ns: 6 * ONE_SECOND });
}

#[test]
fn truth_of_a_code_is_invalid() {
    let mut codes = 0;
    let room = Room::new(&"sun".parse().unwrap(), 1);
    for end_ns in (13..40).map(|s| s * ONE_SECOND) {
        let look = scan_at(&room, end_ns);
        for (word, target) in look.words.iter().zip(&look.truth) {
            assert_eq!(word & 8191 >= 8183, *target == BeamTarget::Invalid);
            codes += usize::from(*target == BeamTarget::Invalid);
        }
    }
    assert!(codes > 500, "{codes}");
}

/// No noise, and beams without width, each measured at its own time.
const THIN_BEAMS: NoiseModel = NoiseModel { comb: true, ..NoiseModel::NONE };

/// Returns a world with `things` and one sensor at a height of 1 m, whose mount swings from 0 to 40 degrees.
fn tilted_world(things: &str) -> World {
    let mount = "[sensor.mount]\nheight_mm = 1000\nfrom_deg = 0\nto_deg = 40\ndeg_s = 20\n";
    world(&format!("[[sensor]]\npose = [0, 0, 90]\n{mount}\n{things}")).with_noise(THIN_BEAMS)
}

fn mount(world: &World) -> &Mount {
    world.mount(0).expect("its sensor has a mount")
}

/// Returns index, end point and true target of each beam with a range, in the scan that ended at `end_ns`. A point has
/// the coordinates right, ahead and up, with the origin on the floor below the mount's axis. It is computed with the
/// angle of the mount at the time of its beam.
fn points(world: &World, end_ns: Nanos) -> Vec<(usize, [f64; 3], BeamTarget)> {
    let scan = scan_at(&Room::new(world, 1), end_ns);
    let head = ScanHead::lms(361, -90_000, 500, 1, 13);
    let times = Scan::of(head, &[0; 361]);
    let point = |beam: usize| {
        let range = f64::from(scan.words[beam] & 0x1FFF);
        let down = mount(world).angle_rad(end_ns.saturating_add_signed(times.beam_ns(beam)));
        let (left, ahead) = times.angle(beam).sin_cos();
        [-left * range, ahead * range * down.cos(), 1000.0 - ahead * range * down.sin()]
    };
    let valid = (0..361).filter(|&beam| scan.truth[beam] != BeamTarget::Invalid);
    valid.map(|beam| (beam, point(beam), scan.truth[beam])).collect()
}

#[test]
fn tilted_floor_points_have_height_zero() {
    let bare = tilted_world("");
    let mut count = 0;
    for tenth in 8..80 {
        for (beam, [_, _, up], _) in points(&bare, tenth * ONE_SECOND / 10) {
            assert!(up.abs() < 1.0, "beam {beam} at {tenth}: {up} mm");
            count += 1;
        }
    }
    assert!(count > 10_000, "{count}");
}

#[test]
fn objects_have_a_height_and_boards_a_gap_below() {
    let all = |things: &str| {
        let world = tilted_world(things);
        (0..160)
            .flat_map(|tenth| points(&world, 3 * ONE_SECOND + tenth * ONE_SECOND / 40))
            .collect::<Vec<_>>()
    };
    let on_it = |points: &[(usize, [f64; 3], BeamTarget)], from: f64, until: f64| {
        let within = |p: &[f64; 3]| p[0].abs() < 290.0 && (1400.0..2000.0).contains(&p[1]);
        points.iter().filter(|(_, p, _)| within(p) && (from..until).contains(&p[2])).count()
    };
    let crate_points = all("[[thing]]\nbox = [600, 400]\nheight_mm = 500\npose = [0, 1700]");
    assert!(on_it(&crate_points, 5.0, 490.0) > 300, "its front");
    assert!(on_it(&crate_points, 499.0, 501.0) > 300, "its lid");
    assert_eq!(on_it(&crate_points, 502.0, 2000.0) + on_it(&crate_points, -9.0, -2.0), 0);
    let board = all("[[thing]]\nbox = [600, 400]\nabove_mm = 450\nheight_mm = 500\npose = [0, 1700]");
    assert_eq!(on_it(&board, 5.0, 445.0), 0, "no surface below it");
    assert!(on_it(&board, -1.0, 1.0) > 50, "the floor is visible");
}

#[test]
fn ground_truth_marks_people_and_placed_boxes() {
    let world: World = "tilt".parse().expect("built in");
    let world = world.with_noise(THIN_BEAMS);
    let count = |second: Nanos, is: &dyn Fn(&BeamTarget) -> bool| {
        let room = Room::new(&world, 1);
        let scans = (0..80).map(|i| scan_at(&room, second * ONE_SECOND + i * 26_640_000));
        scans.flat_map(|scan| scan.truth).filter(|target| is(target)).count()
    };
    let is_person = |target: &BeamTarget| *target == BeamTarget::Person;
    let is_box = |target: &BeamTarget| matches!(target, BeamTarget::Box { .. });
    assert_eq!((count(10, &is_person), count(10, &is_box)), (0, 0));
    assert!(count(40, &is_person) > 100);
    assert!(count(40, &is_box) > 300);
}

#[test]
fn refuses_invalid_mounts_with_name_and_location() {
    let refused = |mount: &str| {
        let text = format!("[[sensor]]\npose = [0, 0]\n[sensor.mount]\nheight_mm = 900\n{mount}\n");
        World::of_toml("w.toml", &text).expect_err("it is none").to_string()
    };
    assert!(refused("from_deg = 10\nto_deg = 10").contains("from 10 to 10 degrees"));
    assert!(
        refused("from_deg = 0\nto_deg = 30\nfaults = [{ kind = \"sleeps\" }]").contains("kind = \"sleeps\"")
    );
    assert!(refused("from_deg = 0\nto_deg = 90").contains("w.toml:6"));
    let low = "[[thing]]\nradius_mm = 10\nabove_mm = 300\nheight_mm = 200\n";
    let failure = World::of_toml("w.toml", low).expect_err("upside down");
    assert!(failure.to_string().contains("above_mm = 300"), "{failure}");
}

#[test]
fn heights_have_no_effect_without_a_mount() {
    let low = text("fig8").replace("[[thing]]", "[[thing]]\nheight_mm = 10");
    let of = |text: &str| scan_at(&Room::new(&world(text), 3), 20 * ONE_SECOND);
    assert_eq!(of(&low), of(&text("fig8")));
}
