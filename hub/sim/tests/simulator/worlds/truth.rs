//! The truth beside the words, against a world that lacks the thing or the person in question.

use scanhub_schema::Nanos;
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::room::Room;
use scanhub_sim::room::{BeamTarget, LabeledScan};

use super::{look, text, world};

const SECOND: Nanos = 1_000_000_000;
/// No noise, but beams as wide as real ones.
const WIDE: NoiseModel = NoiseModel { spot: true, ..NoiseModel::NONE };

/// The looks at `text` with and without everything from `cut` on, which stands at its end.
fn beside(text: &str, cut: &str, end_ns: Nanos) -> (LabeledScan, LabeledScan) {
    let (without, _) = text.split_once(cut).expect("what is to be cut");
    let look_at = |text: &str| look(&Room::new(&world(text).with_noise(WIDE), 4), end_ns);
    (look_at(text), look_at(without))
}

/// Nothing in the world may depend on the seed, or what is cut would move the rest.
fn fixed(name: &str) -> String {
    text(name).lines().filter(|line| !line.starts_with("jitter_mm")).collect::<Vec<_>>().join("\n")
}

#[test]
fn persons_are_where_the_room_without_them_looks_different() {
    let (mut persons, mut grazed) = (0, 0);
    for tenth in 0..530 {
        let (with, without) = beside(&fixed("fig8"), "[[person]]", tenth * SECOND / 10);
        let inside = (80..290).contains(&tenth);
        for (beam, met) in with.truth.iter().enumerate() {
            let (told, empty) = (with.words[beam], without.words[beam]);
            match met {
                BeamTarget::Person => {
                    assert!(inside && told < empty, "beam {beam} at {tenth}: {told} before {empty}");
                    persons += 1;
                }
                BeamTarget::Grazed if inside || without.truth[beam] != BeamTarget::Grazed => {
                    assert!(inside, "beam {beam} at {tenth}");
                    grazed += 1;
                }
                // Two surfaces far apart can cost a beam its signal.
                BeamTarget::Invalid if inside => {}
                _ => assert_eq!((told, met), (empty, &without.truth[beam]), "beam {beam} at {tenth}"),
            }
        }
    }
    assert!(persons > 800 && grazed > 200 && grazed < persons, "{persons} {grazed}");
}

#[test]
fn a_box_says_since_when_it_stands() {
    let room = Room::new(&"fig8".parse().unwrap(), 2);
    let boxes =
        |end_ns| look(&room, end_ns).truth.into_iter().filter(|met| matches!(met, BeamTarget::Box { .. }));
    assert_eq!(boxes(15 * SECOND).count(), 0);
    for end_ns in [15 * SECOND + SECOND / 10, 50 * SECOND] {
        assert!(boxes(end_ns).count() > 10);
        assert!(boxes(end_ns).all(|met| met == BeamTarget::Box { since_ns: 15 * SECOND }));
    }
}

#[test]
fn what_a_box_hid_is_static_and_new() {
    let room = Room::new(&"fig8".parse().unwrap(), 2);
    let gone_ns = 22 * SECOND + SECOND / 2;
    let uncovered = |end_ns: Nanos| -> Vec<usize> {
        let truth = look(&room, end_ns).truth;
        (0..361).filter(|&beam| truth[beam] == BeamTarget::Static { since_ns: gone_ns }).collect()
    };
    assert!(uncovered(gone_ns - SECOND).is_empty());
    let beams = uncovered(50 * SECOND);
    assert!(beams.len() > 10, "{beams:?}");
    let (before, after) = (look(&room, 5 * SECOND), look(&room, 50 * SECOND));
    for beam in beams {
        let away = before.truth[beam] != BeamTarget::Invalid && after.truth[beam] != BeamTarget::Invalid;
        // At its edges a beam may have told what is behind it before.
        let edge = before.truth[beam - 2..beam + 3] != [BeamTarget::Static { since_ns: 0 }; 5];
        let [then, now] = [&before, &after].map(|look| i32::from(look.words[beam] & 8191));
        assert!(!away || edge || now > then + 30 || (now - then).abs() < 60, "beam {beam}: {then} to {now}");
    }
}

#[test]
fn a_door_is_a_box_while_it_turns_and_since_it_rests() {
    let room = Room::new(&world(&fixed("door")).with_noise(NoiseModel { comb: false, ..WIDE }), 1);
    let since = |end_ns| {
        let mut since: Vec<Nanos> = look(&room, end_ns)
            .truth
            .iter()
            .filter_map(|met| match met {
                BeamTarget::Box { since_ns } => Some(*since_ns),
                _ => None,
            })
            .collect();
        since.dedup();
        since
    };
    assert!(since(10 * SECOND).is_empty());
    // While it moves, the time of the mirror turn.
    assert_eq!(since(14 * SECOND + SECOND / 2), [14 * SECOND + SECOND / 2 - 13_320_000]);
    assert_eq!(since(20 * SECOND), [15 * SECOND + SECOND / 2]);
    assert_eq!(since(50 * SECOND), [35 * SECOND + SECOND / 2]);
}

#[test]
fn what_moves_away_is_no_box_but_uncovered() {
    let text =
        "[[thing]]\nbox = [600, 200]\npose = [0, 2000]\nmoves = [{ from_s = 5, until_s = 6, by = [0, DY] }]";
    let truth = |by: &str| {
        let room = Room::new(&world(&text.replace("DY", by)).with_noise(WIDE), 1);
        look(&room, 10 * SECOND).truth[180]
    };
    assert_eq!(truth("-50"), BeamTarget::Box { since_ns: 6 * SECOND });
    assert_eq!(truth("50"), BeamTarget::Static { since_ns: 6 * SECOND });
}

#[test]
fn a_code_is_invalid_whatever_the_beam_met() {
    let mut codes = 0;
    let room = Room::new(&"sun".parse().unwrap(), 1);
    for end_ns in (13..40).map(|s| s * SECOND) {
        let look = look(&room, end_ns);
        for (word, met) in look.words.iter().zip(&look.truth) {
            assert_eq!(word & 8191 >= 8183, *met == BeamTarget::Invalid);
            codes += usize::from(*met == BeamTarget::Invalid);
        }
    }
    assert!(codes > 500, "{codes}");
}
