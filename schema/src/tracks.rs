//! People across the sensors of a site: their positions at an instant, and events such as a person passing a door.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::payload::{FixedPayload, UsedElements, are_finite, used_elements};
use crate::text::named;
use crate::{Pose, text};

/// Maximum number of people in a sample.
pub const MAX_TRACKS: usize = 64;
/// Maximum number of sensors that a sample names.
pub const MAX_TRACK_SENSORS: usize = 32;

/// The payload of topic `tracks`, 7432 bytes: all people at one instant, on the map of the site. The instant is the
/// sample's `wall_ns`.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Tracks.v2"))]
#[repr(C)]
pub struct Tracks {
    /// Number of people, at most [`MAX_TRACKS`].
    pub count: u8,
    /// Number of sensors of the site, at most [`MAX_TRACK_SENSORS`].
    pub sensors: u8,
    /// 0.
    pub reserved: [u8; 6],
    /// The people by ID; 0 beyond `count`.
    pub track_array: [Track; MAX_TRACKS],
    /// The sensors in the order of the site; 0 beyond `sensors`.
    pub sensor_array: [TrackSensor; MAX_TRACK_SENSORS],
}

/// One person.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Track.v2"))]
#[repr(C)]
pub struct Track {
    /// ID of the person. No other person gets the same ID while the tracker runs.
    pub id: u64,
    /// Midpoint between the legs, along x, in meters on the map.
    pub x_m: f32,
    /// Midpoint between the legs, along y, in meters on the map.
    pub y_m: f32,
    /// Velocity along x, in meters per second.
    pub vx_m_s: f32,
    /// Velocity along y, in meters per second.
    pub vy_m_s: f32,
    /// Covariance of the position, in m2: xx, xy, yy.
    pub covariance: [f32; 3],
    /// Probability that this is a person, 0 to 1.
    pub score: f32,
    /// Time since the person was first seen, in milliseconds.
    pub age_ms: u32,
    /// Bit i is set if sensor i of the sample sees the person.
    pub sensors: u32,
    /// Name of the room; empty outside of all rooms. See [`room_name`](Track::room_name).
    pub room_text: [u8; 24],
    /// State of the track: [`TrackState`]. Treat every other number as tentative.
    pub state: u8,
    /// 0.
    pub reserved: [u8; 7],
}

/// One sensor of the site, with its pose on the map.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.TrackSensor.v2"))]
#[repr(C)]
pub struct TrackSensor {
    /// Position along x, in meters on the map.
    pub x_m: f32,
    /// Position along y, in meters on the map.
    pub y_m: f32,
    /// Direction ahead of the sensor, in radians counterclockwise from x.
    pub yaw_rad: f32,
    /// 1 if the sensor is mounted upside down.
    pub upside_down: u8,
    /// 0.
    pub reserved: [u8; 3],
    /// Name as clients use it. See [`name`](TrackSensor::name).
    pub name_text: [u8; 56],
}

/// State of a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum TrackState {
    /// The track may not be a person.
    Tentative,
    /// The person is seen.
    Confirmed,
    /// The person is not seen, and is at a position that no sensor can see.
    Hidden,
    /// The person is on a path that no sensor covers.
    BetweenRooms,
}

named! {
    TrackState:
    Tentative "tentative",
    Confirmed "confirmed",
    Hidden "hidden",
    BetweenRooms "between_rooms",
}

impl Default for Tracks {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Default for TrackSensor {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl FixedPayload for Tracks {
    const ARRAYS: &'static [UsedElements] = &[
        used_elements!(Tracks, track_array: [Track; MAX_TRACKS], count),
        used_elements!(Tracks, sensor_array: [TrackSensor; MAX_TRACK_SENSORS], sensors),
    ];

    fn is_valid(&self) -> bool {
        let is_track = |track: &Track| {
            let &Track { x_m, y_m, vx_m_s, vy_m_s, score, sensors, .. } = track;
            let numbers = [x_m, y_m, vx_m_s, vy_m_s, score];
            are_finite(numbers.iter().chain(&track.covariance)) && u64::from(sensors) >> self.sensors == 0
        };
        let is_sensor = |sensor: &TrackSensor| are_finite(&[sensor.x_m, sensor.y_m, sensor.yaw_rad]);
        self.tracks().iter().all(is_track) && self.sensors().iter().all(is_sensor)
    }
}

impl Tracks {
    /// Returns the people.
    pub fn tracks(&self) -> &[Track] {
        &self.track_array[..usize::from(self.count).min(MAX_TRACKS)]
    }

    /// Returns the sensors of the site.
    pub fn sensors(&self) -> &[TrackSensor] {
        &self.sensor_array[..usize::from(self.sensors).min(MAX_TRACK_SENSORS)]
    }

    /// Returns the names of the sensors that see `track`.
    pub fn sensor_names_of<'a>(&'a self, track: &Track) -> impl Iterator<Item = &'a str> + use<'a> {
        let bits = track.sensors;
        let sensors = self.sensors().iter().enumerate();
        sensors.filter(move |(i, _)| bits >> i & 1 == 1).map(|(_, sensor)| sensor.name())
    }

    /// Adds a person, unless there are [`MAX_TRACKS`] already.
    pub fn push(&mut self, track: Track) {
        if let Some(slot) = self.track_array.get_mut(usize::from(self.count)) {
            *slot = track;
            self.count += 1;
        }
    }

    /// Adds a sensor of the site, unless there are [`MAX_TRACK_SENSORS`] already.
    pub fn push_sensor(&mut self, sensor: TrackSensor) {
        if let Some(slot) = self.sensor_array.get_mut(usize::from(self.sensors)) {
            *slot = sensor;
            self.sensors += 1;
        }
    }
}

impl Track {
    /// Returns the state; [`TrackState::Tentative`] if this version does not know its number.
    pub fn state(&self) -> TrackState {
        TrackState::ALL.get(usize::from(self.state)).copied().unwrap_or(TrackState::Tentative)
    }

    /// Returns the name of the person's room, or `None` outside of all rooms.
    pub fn room_name(&self) -> Option<&str> {
        Some(text::read(&self.room_text)).filter(|room| !room.is_empty())
    }

    /// Sets the room.
    pub fn set_room(&mut self, room: &str) {
        text::write(&mut self.room_text, room);
    }
}

impl TrackSensor {
    /// Creates the sensor `name` at `pose` on the map.
    pub fn new(name: &str, pose: &Pose) -> TrackSensor {
        let Pose { x_m, y_m, yaw_rad, upside_down, .. } = *pose;
        let (x_m, y_m, yaw_rad) = (x_m as f32, y_m as f32, yaw_rad as f32);
        let mut sensor = TrackSensor { x_m, y_m, yaw_rad, upside_down, ..TrackSensor::default() };
        text::write(&mut sensor.name_text, name);
        sensor
    }

    /// Returns the pose on the map.
    pub fn pose(&self) -> Pose {
        let TrackSensor { x_m, y_m, yaw_rad, upside_down, .. } = *self;
        let (x_m, y_m, yaw_rad) = (x_m.into(), y_m.into(), yaw_rad.into());
        Pose { x_m, y_m, yaw_rad, upside_down, ..Pose::default() }
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        text::read(&self.name_text)
    }
}

/// The payload of topic `events`, 112 bytes. The time of the event is the sample's `wall_ns`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Event.v2"))]
#[repr(C)]
pub struct Event {
    /// ID of the person in topic `tracks`.
    pub id: u64,
    /// Kind of the event: [`EventKind`].
    pub kind: u8,
    /// 0.
    pub reserved: [u8; 7],
    /// Name of the room after the event; empty outside of all rooms. See [`room_name`](Event::room_name).
    pub room_text: [u8; 24],
    /// Name of the door; empty if the kind is not `door`.
    pub door_text: [u8; 24],
    /// Room that the person came from, or `outside`; empty if the kind is not `door`.
    pub from_text: [u8; 24],
    /// Room that the person went to, or `outside`; empty if the kind is not `door`.
    pub to_text: [u8; 24],
}

/// Kind of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum EventKind {
    /// A person was confirmed.
    Appeared,
    /// A person was removed.
    Left,
    /// A person went through a door.
    Door,
}

named! {
    EventKind:
    Appeared "appeared",
    Left "left",
    Door "door",
}

impl EventKind {
    /// Returns the kind with this number, or `None` if this version does not know it.
    pub fn of_number(number: u8) -> Option<EventKind> {
        EventKind::ALL.get(usize::from(number)).copied()
    }
}

impl FixedPayload for Event {
    fn is_valid(&self) -> bool {
        self.kind().is_some()
    }
}

impl Event {
    /// Creates an event of person `id`, who is in `room` after the event.
    pub fn new(kind: EventKind, id: u64, room: Option<&str>) -> Event {
        let mut event = Event { id, kind: kind as u8, ..Event::default() };
        text::write(&mut event.room_text, room.unwrap_or_default());
        event
    }

    /// Adds the door, and the rooms on both sides of the door.
    pub fn with_door(mut self, door: &str, from: &str, to: &str) -> Event {
        text::write(&mut self.door_text, door);
        text::write(&mut self.from_text, from);
        text::write(&mut self.to_text, to);
        self
    }

    /// Returns the kind of the event, or `None` if this version does not know it.
    pub fn kind(&self) -> Option<EventKind> {
        EventKind::of_number(self.kind)
    }

    /// Returns the name of the person's room after the event, or `None` outside of all rooms.
    pub fn room_name(&self) -> Option<&str> {
        Some(text::read(&self.room_text)).filter(|room| !room.is_empty())
    }

    /// Returns the door, the room that the person came from, and the room that they went to. Returns `None` if the kind
    /// is not `door`.
    pub fn door(&self) -> Option<(&str, &str, &str)> {
        let [door, from, to] =
            [&self.door_text, &self.from_text, &self.to_text].map(|field| text::read(field));
        (self.kind() == Some(EventKind::Door)).then_some((door, from, to))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracks_sample_has_names_and_states() {
        let mut tracks = Tracks::default();
        let pose = Pose { x_m: 1.5, y_m: -2.0, yaw_rad: 0.5, upside_down: 1, ..Pose::default() };
        for name in ["front", "kitchen.rear"] {
            tracks.push_sensor(TrackSensor::new(name, &pose));
        }
        assert_eq!((tracks.sensors()[1].pose(), tracks.sensors()[1].name()), (pose, "kitchen.rear"));
        let mut track = Track { id: 7, sensors: 2, state: 3, ..Track::default() };
        assert_eq!(track.room_name(), None);
        track.set_room("hall");
        tracks.push(track);
        assert_eq!((tracks.tracks().len(), tracks.sensors().len()), (1, 2));
        let track = &tracks.tracks()[0];
        assert_eq!((track.room_name(), track.state()), (Some("hall"), TrackState::BetweenRooms));
        assert!(tracks.sensor_names_of(track).eq(["kitchen.rear"]));
        for (number, state) in TrackState::ALL.into_iter().enumerate() {
            assert_eq!(state as usize, number);
        }
        assert_eq!(Track { state: 4, ..Track::default() }.state(), TrackState::Tentative);
    }

    #[test]
    fn surplus_tracks_and_sensors_are_dropped() {
        let mut tracks = Tracks::default();
        (0..=MAX_TRACKS as u64).for_each(|id| tracks.push(Track { id, ..Track::default() }));
        (0..=MAX_TRACK_SENSORS).for_each(|_| tracks.push_sensor(TrackSensor::default()));
        assert_eq!((tracks.tracks().len(), tracks.sensors().len()), (MAX_TRACKS, MAX_TRACK_SENSORS));
        assert_eq!(tracks.tracks()[MAX_TRACKS - 1].id, MAX_TRACKS as u64 - 1);
    }

    #[test]
    fn event_reports_its_kind_room_and_door() {
        let appeared = Event::new(EventKind::Appeared, 3, None);
        assert_eq!(
            (appeared.kind(), appeared.room_name(), appeared.door()),
            (Some(EventKind::Appeared), None, None)
        );
        let door = Event::new(EventKind::Door, 3, Some("kitchen")).with_door("left", "hall", "kitchen");
        assert_eq!((door.room_name(), door.door()), (Some("kitchen"), Some(("left", "hall", "kitchen"))));
        for (number, kind) in EventKind::ALL.into_iter().enumerate() {
            assert_eq!((kind as usize, EventKind::of_number(number as u8)), (number, Some(kind)));
        }
        assert_eq!(EventKind::of_number(3), None);
    }
}
