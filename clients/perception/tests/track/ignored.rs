//! Tests of ignored areas: no person is detected in an ignored area, and a person who walks through an ignored area
//! keeps their ID.

use crate::hall::{DoorKind, HALL_SITE, SCANNERS, Scene, Walker, run};
use scanhub_perception::track::Kind;

const FOUNTAIN_AREA: &str = r#"
[[ignore]]
name = "fountain"
polygon = [[2, -1], [4, -1], [4, 1], [2, 1]]
"#;

/// Returns an object in the fountain that moves like a person, from second 25 on.
fn fountain_walker() -> Walker {
    let corners = [[2.4, -0.6], [3.6, -0.6], [3.6, 0.6], [2.4, 0.6]];
    let path = corners.into_iter().cycle().take(60).map(|corner| (corner, 0.0)).collect();
    Walker { from_s: 25.0, path, speed: 0.8, phase: 0.0 }
}

/// Returns a person who walks across the hall through the fountain, and stands in the fountain for `stands_s` seconds.
fn visitor(stands_s: f64) -> Walker {
    let path = vec![([3.0, 3.5], 0.0), ([3.0, 0.0], stands_s), ([3.0, -3.5], 5.0), ([3.2, -3.5], 0.0)];
    Walker { from_s: 26.0, path, speed: 1.1, phase: 0.3 }
}

/// Runs the hall of `site` with `walkers`. Returns the IDs that appear, and the IDs that leave.
fn appeared_and_left(site: &str, walkers: &[Walker]) -> (Vec<u64>, Vec<u64>) {
    let scene = Scene {
        site,
        leaves: DoorKind::Slide(0.05),
        scanner: SCANNERS[0],
        at: [0.0, 0.0],
        seed: 5,
        seconds: 48,
        is_door_moving: false,
        opens_m: 0.0,
        open_time_s: 0.0,
        walkers,
    };
    let (mut appeared, mut left) = (Vec::new(), Vec::new());
    run(&scene, |sample| {
        for event in &sample.events {
            match event.kind {
                Kind::Appeared => appeared.push(event.id),
                Kind::Left => left.push(event.id),
                Kind::Door { .. } => panic!("{event:?}"),
            }
        }
    });
    (appeared, left)
}

fn with_fountain() -> String {
    format!("{HALL_SITE}{FOUNTAIN_AREA}")
}

#[test]
fn no_person_is_found_in_an_ignored_area() {
    let (appeared, _) = appeared_and_left(HALL_SITE, &[fountain_walker()]);
    assert!(!appeared.is_empty(), "the fountain looks like a person");
    assert_eq!(appeared_and_left(&with_fountain(), &[fountain_walker()]), (vec![], vec![]));
}

#[test]
fn person_crossing_an_ignored_area_keeps_their_id() {
    for walkers in [vec![visitor(0.0)], vec![visitor(1.0)]] {
        let (appeared, left) = appeared_and_left(&with_fountain(), &walkers);
        assert_eq!((appeared.len(), left.len()), (1, 1), "{appeared:?} {left:?}");
    }
}

#[test]
fn person_staying_in_an_ignored_area_gets_a_new_id() {
    let (appeared, left) = appeared_and_left(&with_fountain(), &[visitor(9.0)]);
    assert_eq!((appeared.len(), left.len()), (2, 2), "before and after: {appeared:?} {left:?}");
    assert_eq!(left, appeared);
}
