//! What the tracker says: tracks at an instant, and what happened to them; and as it is published. Refuses to know how they
//! are found.

use scanhub_schema::{EventKind, Pose, TrackSensor, TrackState, Tracks};

use crate::track::geometry::Point;
use crate::track::site::{Sensor, Site};

/// A person at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// Never used again.
    pub id: u64,
    /// How well he is known.
    pub state: TrackState,
    /// The middle between the legs, metres in the map.
    pub place: Point,
    /// Metres per second.
    pub velocity: Point,
    /// Covariance of the place, m2: xx, xy, yy.
    pub covariance: [f64; 3],
    /// Number of the room in the site.
    pub room: Option<usize>,
    /// Sensors that see him, as bits by their number in the site.
    pub sensors: u32,
    /// Seconds since he was first seen.
    pub age_s: f64,
    /// How sure it is that this is a person, 0 to 1.
    pub score: f64,
}

/// What happened to a person.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// He is known from now on.
    Appeared,
    /// He is gone.
    Left,
    /// He went through the door with this number, from room to room; none: outside.
    Door {
        /// Number of the door in the site.
        door: usize,
        /// Where he was.
        from: Option<usize>,
        /// Where he is.
        to: Option<usize>,
    },
}

/// One event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// When, ns since 1970.
    pub wall_ns: u64,
    /// Whom.
    pub id: u64,
    /// Number of the room where he then is.
    pub room: Option<usize>,
    /// What.
    pub kind: Kind,
}

/// A sensor that is not where the site says, as far as another one tells that sees the same people. From now on it is taken
/// to be where that one says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Misplaced {
    /// Number of the sensor in the site.
    pub sensor: usize,
    /// Of the earlier one that it was compared with.
    pub other: usize,
    /// How far the people that it sees are beside those that the other sees, in metres in the map.
    pub off: Point,
}

/// All persons at an instant, and what happened since the last picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// The instant that all places hold for, ns since 1970.
    pub wall_ns: u64,
    /// By identity.
    pub tracks: Vec<Track>,
    /// In their order.
    pub events: Vec<Event>,
    /// Sensors that were found not to be where the site says, since the last picture.
    pub misplaced: Vec<Misplaced>,
}

impl Picture {
    /// Returns the picture as it is published, with the names that `site` gives.
    pub fn payload(&self, site: &Site) -> Tracks {
        let mut tracks = Tracks::default();
        site.sensors.iter().for_each(|sensor| tracks.push_sensor(sensor.payload()));
        self.tracks.iter().for_each(|track| tracks.push(track.payload(site)));
        tracks
    }
}

impl Sensor {
    fn payload(&self) -> TrackSensor {
        let [x_m, y_m] = self.place;
        let upside_down = u8::from(self.is_upside_down);
        let pose = Pose { x_m, y_m, yaw_rad: self.yaw_rad, upside_down, ..Pose::default() };
        TrackSensor::new(&self.name, &pose)
    }
}

impl Track {
    fn payload(&self, site: &Site) -> scanhub_schema::Track {
        let mut track = scanhub_schema::Track {
            id: self.id,
            x_m: self.place[0] as f32,
            y_m: self.place[1] as f32,
            vx_m_s: self.velocity[0] as f32,
            vy_m_s: self.velocity[1] as f32,
            covariance: self.covariance.map(|value| value as f32),
            score: self.score as f32,
            age_ms: (1000.0 * self.age_s) as u32,
            sensors: self.sensors,
            state: self.state as u8,
            ..scanhub_schema::Track::default()
        };
        track.set_room(self.room.and_then(|room| site.rooms.get(room)).map_or("", |room| &room.name));
        track
    }
}

impl Event {
    /// Returns the event as it is published, with the names that `site` gives.
    pub fn payload(&self, site: &Site) -> scanhub_schema::Event {
        let room = self.room.and_then(|room| site.rooms.get(room)).map(|room| room.name.as_str());
        let of = |kind| scanhub_schema::Event::new(kind, self.id, room);
        match self.kind {
            Kind::Appeared => of(EventKind::Appeared),
            Kind::Left => of(EventKind::Left),
            Kind::Door { door, from, to } => {
                let name = site.doors.get(door).map_or("", |door| &door.name);
                of(EventKind::Door).through(name, site.room_name(from), site.room_name(to))
            }
        }
    }
}

const _: () = assert!(
    crate::track::tracker::PERSONS == scanhub_schema::TRACKS
        && crate::track::site::SENSORS == scanhub_schema::TRACK_SENSORS
);
