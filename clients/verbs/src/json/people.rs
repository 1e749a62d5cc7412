//! The classes of people: where they are, and what happened to them. A contract, like its parent module.

use scanhub_schema::{Event, Header, Tracks};
use serde::{Serialize, Serializer};

use super::processed::millionths;
use super::{Stamp, Words};

/// Class `tracks`.
pub fn tracks<'a>(sensor: &'a str, header: &Header, tracks: &'a Tracks) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        #[serde(serialize_with = "track_list")]
        tracks: &'a Tracks,
        #[serde(flatten)]
        flags: Words,
    }
    Line { stamp: Stamp::new("tracks", sensor, header), tracks, flags: Words::of(header) }
}

/// Class `event`.
pub fn event<'a>(sensor: &'a str, header: &Header, event: &'a Event) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        kind: Option<&'static str>,
        id: u64,
        room: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        to: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        door: Option<&'a str>,
        #[serde(flatten)]
        flags: Words,
    }
    let way = event.door();
    Line {
        stamp: Stamp::new("event", sensor, header),
        kind: event.kind().map(|kind| kind.name()),
        id: event.id,
        room: event.room_name(),
        from: way.map(|(_, from, _)| from),
        to: way.map(|(.., to)| to),
        door: way.map(|(door, ..)| door),
        flags: Words::of(header),
    }
}

fn track_list<S: Serializer>(tracks: &Tracks, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item<'a> {
        id: u64,
        state: &'static str,
        x_m: f64,
        y_m: f64,
        vx_m_s: f64,
        vy_m_s: f64,
        cov: [f64; 3],
        room: Option<&'a str>,
        sensors: Vec<&'a str>,
        age_s: f64,
        score: f64,
    }
    serializer.collect_seq(tracks.tracks().iter().map(|track| Item {
        id: track.id,
        state: track.state().name(),
        x_m: thousandths(track.x_m),
        y_m: thousandths(track.y_m),
        vx_m_s: thousandths(track.vx_m_s),
        vy_m_s: thousandths(track.vy_m_s),
        cov: track.covariance.map(millionths),
        room: track.room_name(),
        sensors: tracks.seen_by(track).collect(),
        age_s: f64::from(track.age_ms) / 1000.0,
        score: thousandths(track.score),
    }))
}

/// A millimetre is as much as there is sense in.
pub(super) fn thousandths(value: f32) -> f64 {
    (1e3 * f64::from(value)).round() / 1e3
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{EventKind, Pose, Track, TrackSensor, TrackState};

    const HEAD: &str = r#""sensor":"house","seq":7,"topic_seq":6,"stamp_ns":5,"wall_ns":4,"boot":"00000000000000ab","quality":"clean","#;

    fn header() -> Header {
        Header { seq: 7, topic_seq: 6, stamp_first_ns: 5, wall_ns: 4, boot: 0xAB, ..Header::default() }
    }

    #[test]
    fn tracks_to_the_letter() {
        let mut all = Tracks::default();
        for name in ["front", "kitchen.rear"] {
            all.push_sensor(TrackSensor::new(name, &Pose::default()));
        }
        let mut track = Track {
            id: 3,
            x_m: 1.2344,
            y_m: -2.0,
            vx_m_s: 0.5,
            covariance: [0.01, 0.0, 0.02],
            score: 0.75,
            age_ms: 12_345,
            sensors: 2,
            state: TrackState::Confirmed as u8,
            ..Track::default()
        };
        track.set_room("hall");
        all.push(track);
        all.push(Track { id: 4, ..Track::default() });
        let line = serde_json::to_string(&tracks("house", &header(), &all)).unwrap();
        let first = r#"{"id":3,"state":"confirmed","x_m":1.234,"y_m":-2.0,"vx_m_s":0.5,"vy_m_s":0.0,"cov":[0.01,0.0,0.02],"room":"hall","sensors":["kitchen.rear"],"age_s":12.345,"score":0.75}"#;
        let second = r#"{"id":4,"state":"tentative","x_m":0.0,"y_m":0.0,"vx_m_s":0.0,"vy_m_s":0.0,"cov":[0.0,0.0,0.0],"room":null,"sensors":[],"age_s":0.0,"score":0.0}"#;
        assert_eq!(line, format!(r#"{{"class":"tracks",{HEAD}"tracks":[{first},{second}]}}"#));
    }

    #[test]
    fn events_to_the_letter() {
        let door = Event::new(EventKind::Door, 3, Some("hall")).through("left", "outside", "hall");
        let line = serde_json::to_string(&event("house", &header(), &door)).unwrap();
        let rest = r#""kind":"door","id":3,"room":"hall","from":"outside","to":"hall","door":"left"}"#;
        assert_eq!(line, format!(r#"{{"class":"event",{HEAD}{rest}"#));
        let left = Event::new(EventKind::Left, 4, None);
        let line = serde_json::to_string(&event("house", &header(), &left)).unwrap();
        assert_eq!(line, format!(r#"{{"class":"event",{HEAD}"kind":"left","id":4,"room":null}}"#));
    }
}
