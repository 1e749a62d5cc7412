//! What is a world and what is none.

use std::collections::BTreeSet;

use proptest::prelude::*;
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_schema::Failure;
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

use super::{SCAN_NS, WORLDS, look, room, text, world};

#[test]
fn every_file_is_a_world_that_the_program_brings_along() {
    let files: BTreeSet<String> = std::fs::read_dir(WORLDS)
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
        assert_eq!(name.parse::<World>(), format!("{WORLDS}/{name}.toml").parse(), "{name}");
    }
}

#[test]
fn every_world_runs_for_a_minute_as_its_name_says() {
    let met = |name: &str| {
        let world: World = name.parse().unwrap();
        let mut kinds = BTreeSet::new();
        for port in 0..world.sensors() as u64 {
            let room = Room::of_port(&world, 3, port);
            for scan in (0..2_250).step_by(25) {
                let end_ns = scan * SCAN_NS;
                let first = look(&room, end_ns);
                assert_eq!(first, look(&room, end_ns), "{name} at {end_ns}");
                kinds.extend(first.truth.iter().map(|met| match met {
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
        assert_eq!(met(name), "grazed invalid person static", "{name}");
    }
    for name in ["fig8", "door", "chair", "crowd", "demo", "house"] {
        assert_eq!(met(name), "box grazed invalid person static uncovered", "{name}");
    }
    assert_eq!((met("bare"), met("strips")), ("invalid static".into(), "invalid static".into()));
}

#[test]
fn ten_seeds_are_ten_runs() {
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

/// Two sensors at the same place see the same people, each through its own noise; a port too many is another world.
#[test]
fn ports_share_a_world_until_its_sensors_are_taken() {
    let text = format!("{}[[sensor]]\npose = [0, 100, 90]\n", text("fig8"));
    let quiet = world(&text).with_noise(scanhub_sim::beam::NoiseModel::NONE);
    let noisy = world(&text);
    let scan = |world, port| look(&Room::of_port(world, 5, port), 20_000_000_000).words;
    assert_eq!(quiet.sensors(), 2);
    assert_eq!(scan(&quiet, 0), scan(&quiet, 1));
    assert_ne!(scan(&noisy, 0), scan(&noisy, 1));
    assert_ne!(scan(&quiet, 0), scan(&quiet, 2));
    assert_eq!(scan(&quiet, 2), look(&Room::new(&quiet, 6), 20_000_000_000).words);
}

#[test]
fn a_world_without_anything_is_one() {
    let look = look(&room("", 1), SCAN_NS);
    assert!(
        look.words.iter().all(|&word| word == 8191)
            && look.truth.iter().all(|&met| met == BeamTarget::Invalid)
    );
}

#[test]
fn what_is_no_world_is_refused_by_name_place_and_remedy() {
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
        ("[[sensor]]\npose = [1]", "w.toml:2:8: 1 numbers are no pose", "[x, y] in millimetres"),
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
            "w.toml:4:34: a move until 4 s of what is taken away at 3 s",
            "while it is there",
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
fn the_page_shows_a_world_with_every_key() {
    let page = include_str!("../../../../../docs/worlds.md");
    let example =
        page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
    world(example);
    // The shapes and ways that exclude those shown are in comments.
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
    /// Whatever a file has become, it is refused with a place or it runs.
    #[test]
    fn a_damaged_file_is_refused_or_runs(
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
                    let look = look(&Room::of_port(&world, 1, port), 16_000_000_000);
                    prop_assert_eq!(look.words.len(), 361);
                }
            }
            Err(failure) => prop_assert!(failure.message.starts_with("w.toml:"), "{}", failure),
        }
    }
}
