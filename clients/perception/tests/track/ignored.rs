//! Ignored areas: no one is found in them, and a person who walks through one keeps their identity.

use crate::hall::{Leaves, SCANNERS, SITE, Scene, Walker, run};
use scanhub_perception::track::Kind;

const FOUNTAIN: &str = r#"
[[ignore]]
name = "fountain"
polygon = [[2, -1], [4, -1], [4, 1], [2, 1]]
"#;

/// Something in the fountain that moves like a person, from second 25 on.
fn fountain() -> Walker {
    let corners = [[2.4, -0.6], [3.6, -0.6], [3.6, 0.6], [2.4, 0.6]];
    let way = corners.into_iter().cycle().take(60).map(|corner| (corner, 0.0)).collect();
    Walker { from_s: 25.0, way, pace: 0.8, phase: 0.0 }
}

/// A person who walks across the hall through the fountain, or stops in it.
fn visitor(stands_s: f64) -> Walker {
    let way = vec![([3.0, 3.5], 0.0), ([3.0, 0.0], stands_s), ([3.0, -3.5], 5.0), ([3.2, -3.5], 0.0)];
    Walker { from_s: 26.0, way, pace: 1.1, phase: 0.3 }
}

/// Returns what happens in a hall with these people: identities that appear, and those that leave.
fn seen(site: &str, walkers: &[Walker]) -> (Vec<u64>, Vec<u64>) {
    let scene = Scene {
        site,
        leaves: Leaves::Slide(0.05),
        scanner: SCANNERS[0],
        at: [0.0, 0.0],
        seed: 5,
        seconds: 48,
        moves: false,
        opens_m: 0.0,
        stays_s: 0.0,
        walkers,
    };
    let (mut appeared, mut left) = (Vec::new(), Vec::new());
    run(&scene, |picture| {
        for event in &picture.events {
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
    format!("{SITE}{FOUNTAIN}")
}

#[test]
fn nobody_is_found_in_an_ignored_area() {
    let (appeared, _) = seen(SITE, &[fountain()]);
    assert!(!appeared.is_empty(), "the fountain looks like a person");
    assert_eq!(seen(&with_fountain(), &[fountain()]), (vec![], vec![]));
}

#[test]
fn a_person_who_crosses_an_ignored_area_keeps_their_identity() {
    for walkers in [vec![visitor(0.0)], vec![visitor(1.0)]] {
        let (appeared, left) = seen(&with_fountain(), &walkers);
        assert_eq!((appeared.len(), left.len()), (1, 1), "{appeared:?} {left:?}");
    }
}

#[test]
fn a_person_who_stays_in_an_ignored_area_is_not_followed_there() {
    let (appeared, left) = seen(&with_fountain(), &[visitor(9.0)]);
    assert_eq!((appeared.len(), left.len()), (2, 2), "before and after: {appeared:?} {left:?}");
    assert_eq!(left, appeared);
}
