//! Quality of the background method `multi`: it separates people from a room, and does this better than the paper's
//! method. This file runs each scene once, with limits for its quality. `benches/perception` runs each scene ten times.
//! Changes of the simulated world or of a method show here first.

#[path = "../testkit/foreground.rs"]
mod scenes;

use scanhub_drivers::lms::variant::Unit;
use scanhub_preprocess::background::{BackgroundModel, Class, Method as Kind, Settings};
use scanhub_schema::{Background, Foreground};

use scenes::{Boxes, Detector, ExpectedAnswer, HubDetector, LabeledScan, Scene, Score, play};

/// Seed of the scenes. No parameter of a method was tuned with this seed.
const SCENE_SEED: u64 = 20;

fn hub_detector(method: Kind) -> Box<dyn Detector> {
    Box::new(HubDetector::new(Settings { method, ..Settings::default() }))
}

fn scores(frames: &[LabeledScan]) -> (Score, Score) {
    (Score::of(&mut *hub_detector(Kind::Multi), frames), Score::of(&mut *hub_detector(Kind::Paper), frames))
}

#[test]
fn multi_method_separates_people_from_rooms() {
    // The limits are slightly below the average of ten runs, because the result of a single run varies.
    for (name, world, unit, recall, precision, wrong_per_scan) in [
        ("the room of Fig. 8", "fig8", Unit::Mm, 0.98, 0.95, 0.1),
        ("a corridor", "corridor", Unit::Cm, 0.9, 0.95, 0.1),
        ("a person walks toward the sensor", "approach", Unit::Mm, 0.98, 0.98, 0.1),
        ("a glass wall", "glass", Unit::Mm, 0.97, 0.98, 0.1),
        ("a wall seldom seen", "faint", Unit::Mm, 0.97, 0.95, 0.1),
    ] {
        let scene = Scene { name, world, unit, mixed: true };
        let (multi, paper) = scores(&play(&scene, SCENE_SEED));
        let scores_text = format!("{}: {multi:?}, paper {paper:?}", scene.name);
        assert!(multi.recall() >= recall && multi.precision() >= precision, "{scores_text}");
        assert!(multi.wrong_per_scan() <= wrong_per_scan, "{scores_text}");
        assert!(multi.recall() > paper.recall(), "{scores_text}");
    }
}

#[test]
fn placed_and_removed_boxes_become_background() {
    let scene = Scene { name: "the room of Fig. 8", world: "fig8", unit: Unit::Mm, mixed: true };
    let mut boxes = Boxes::default();
    boxes.add(|| hub_detector(Kind::Multi), &play(&scene, SCENE_SEED));
    let [new, _, left] = boxes.percents();
    assert!(
        new == 0.0 && left == 0.0,
        "{new} % of the new box is foreground after N scans, {left} % of the removed one remains after 2N"
    );
}

/// A saved background has only one range per beam, less than the model in memory. A model that starts with the saved
/// background reports no more wrong beams than a model that was not interrupted.
#[test]
fn reloaded_background_is_right_at_once() {
    for world in ["fig8", "faint"] {
        let frames = play(&Scene { name: world, world, unit: Unit::Mm, mixed: true }, SCENE_SEED);
        // Replace the model once before a person enters, and once while a person is present.
        for at in [LEARNING_SCANS, 800] {
            let mut model = BackgroundModel::new(Settings::default(), BEAM_COUNT);
            let mut out = Foreground::of(BEAM_COUNT);
            frames[..at].iter().for_each(|frame| model.update(&frame.scan, &mut out));
            let mut shown = Background::zeroed(Background::len(BEAM_COUNT));
            model.write(&mut shown);
            let mut next = BackgroundModel::new(Settings::default(), BEAM_COUNT);
            next.load(&shown).expect("the payload fits");
            let [on, anew] = [model, next].map(|mut model| {
                let (mut found, mut wrong) = (0, 0);
                for frame in &frames[at..at + 200] {
                    model.update(&frame.scan, &mut out);
                    for (class, due) in model.classes().iter().zip(&frame.expected) {
                        found += u32::from(*class == Class::Foreground && *due == ExpectedAnswer::Foreground);
                        wrong += u32::from(*class == Class::Foreground && *due == ExpectedAnswer::Other);
                    }
                }
                (found, wrong)
            });
            let scores_text =
                format!("{world} from scan {at}: {anew:?} instead of {on:?} beams of people and others");
            assert!(anew.1 <= on.1 + 5 && anew.0 * 100 >= on.0 * 99, "{scores_text}");
            assert!(at == LEARNING_SCANS || on.0 > 100, "{scores_text}");
        }
    }
}

/// Number of beams of each scan.
const BEAM_COUNT: usize = 361;
/// Number of scans after which the background of all beams in these rooms is known.
const LEARNING_SCANS: usize = 560;
