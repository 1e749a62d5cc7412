//! What a picture is made of, and how it comes into a scene: the same for the terminal and the browser. Refuses to know how
//! it is drawn.

use scanhub_client::clock;
use scanhub_client::streams::Sample;
use scene::Scene;
use schema::Topic;

use crate::follow::Notice;
use crate::names::TopicName;

/// What is followed; the status first, because it says where the sensor sits. [`Topic::Lines`] costs the hub something as soon as somebody follows it, so that is only done while
/// they are looked at.
pub(crate) const TOPICS: [Topic; 7] = [
    Topic::Status,
    Topic::Scan,
    Topic::Marks,
    Topic::Zones,
    Topic::Foreground,
    Topic::Background,
    Topic::Lines,
];

/// What is followed of `sensors`; of all of a hub if there are none.
pub(crate) fn followed(sensors: &[String]) -> (Vec<TopicName>, &'static [Topic]) {
    let named = |sensor: &String| TOPICS.map(|topic| TopicName { sensor: sensor.clone(), topic });
    let names: Vec<_> = sensors.iter().flat_map(named).collect();
    let topics: &[Topic] = if names.is_empty() { &TOPICS } else { &[] };
    (names, topics)
}

/// Takes a `sample` of `name`.
pub(crate) fn take(scene: &mut Scene, name: &TopicName, sample: &Sample) {
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
pub(crate) fn note(scene: &mut Scene, names: &[&TopicName], notice: Notice) {
    match (notice, names) {
        (Notice::Missed(missed), [name]) if name.topic == Topic::Scan => {
            scene.sensor(&name.sensor).lost += missed;
        }
        (Notice::HubGone, _) => scene.hub_gone(),
        (Notice::HubBack, _) => scene.hub_lives = true,
        _ => {}
    }
}
