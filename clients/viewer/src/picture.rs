//! What a picture is made of, and how it comes into a scene: the same for the terminal and the browser. Refuses to know how
//! it is drawn.

use crate::scene::Scene;
use scanhub_client::streams::Sample;
use scanhub_client::{clock, live_topics};
use scanhub_schema::{Maker, Topic};
use scanhub_shm::Domain;
use std::rc::Rc;

use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::TopicName;

/// What is followed; the status first, because it says where the sensor sits. [`Topic::Lines`] costs the hub something as soon
/// as somebody follows it, so that is only done while they are looked at.
pub(crate) const TOPICS: [Topic; 8] = [
    Topic::Status,
    Topic::Scan,
    Topic::Marks,
    Topic::Zones,
    Topic::Foreground,
    Topic::Background,
    Topic::Lines,
    Topic::Tracks,
];

/// Which of the `wanted` topics are followed of `sensors`; of all of a hub and all that publish beside it, if there are none. Who
/// names one that is no sensor, in the first live one of `places`, wants to see the sensors, too.
pub(crate) fn followed(
    sensors: &[String],
    wanted: &[Topic],
    places: &[Domain],
) -> (Vec<TopicName>, Vec<Topic>) {
    let live = live_topics(places);
    let maker = |sensor: &str| {
        let is_live = |topic: &&Topic| live.contains(&format!("{sensor}/{}", topic.name()));
        wanted.iter().find(is_live).map_or(Maker::Link, |topic| topic.maker())
    };
    let named = |sensor: &String| {
        let maker = maker(sensor);
        let of = wanted.iter().filter(move |topic| topic.maker() == maker);
        of.map(|topic| TopicName { sensor: sensor.clone(), topic: *topic }).collect::<Vec<_>>()
    };
    let names: Vec<_> = sensors.iter().flat_map(named).collect();
    let has_other = names.iter().any(|name| name.topic.maker() != Maker::Link);
    let of_all = |topic: &&Topic| names.is_empty() || has_other && topic.maker() == Maker::Link;
    let of_all = wanted.iter().filter(of_all).copied().collect();
    (names, of_all)
}

/// A topic of `name` will be followed: of a link its sensor is there from now on.
pub(crate) fn begin(scene: &mut Scene, name: &TopicName) {
    if name.topic.maker() == Maker::Link {
        scene.sensor(&name.sensor);
    }
}

/// Takes a `sample` of `name`.
pub(crate) fn take(scene: &mut Scene, name: &TopicName, sample: &Sample) {
    if let Sample::Tracks(tracks) = sample {
        return scene.take_tracks(&name.sensor, tracks, clock::now_ns());
    }
    let sensor = scene.heard(&name.sensor, sample.header());
    match sample {
        Sample::Scan(scan) => sensor.take_scan(scan.header(), scan, clock::now_ns()),
        Sample::Marks(marks) => sensor.marks = marks.is_available().then_some(**marks),
        Sample::Zones(heard) => sensor.zones = heard.zones,
        Sample::Foreground(found) => sensor.take_foreground(found.header(), found, clock::now_ns()),
        Sample::Background(model) => sensor.background = Some(model.boxed()),
        Sample::Lines(lines) => sensor.lines = Some(Box::new(**lines)),
        Sample::Status(status) => sensor.take_status(status),
        // No picture shows it.
        _ => {}
    }
}

/// Takes note of what went wrong in the streams of `names`.
pub(crate) fn note(scene: &mut Scene, names: &[Rc<TopicName>], notice: &Notice) {
    match (notice, names) {
        (Notice::Missed(missed), [name]) if name.topic == Topic::Scan => {
            scene.sensor(&name.sensor).lost += *missed;
        }
        (Notice::NoHub(_) | Notice::HubGone, _) => scene.hub_gone(),
        (Notice::HubBack, _) => scene.hub_lives = true,
        _ => {}
    }
}
