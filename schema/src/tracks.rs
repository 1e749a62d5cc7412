//! Where people are at an instant, across the sensors of a site. Refuses to know how they are found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::{Pose, text};

/// The most persons in a sample.
pub const TRACKS: usize = 64;
/// The most sensors that a sample names.
pub const TRACK_SENSORS: usize = 32;

/// The payload of topic `tracks`, 7432 bytes: all persons at one instant, in the map of the site. The instant is the sample's
/// `wall_ns`.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Tracks.v2"))]
#[repr(C)]
pub struct Tracks {
    /// Persons, at most [`TRACKS`].
    pub count: u8,
    /// Sensors of the site, at most [`TRACK_SENSORS`].
    pub sensors: u8,
    /// 0.
    pub reserved: [u8; 6],
    /// The persons by their numbers; 0 beyond `count`.
    pub track_array: [Track; TRACKS],
    /// The sensors in the order of the site; 0 beyond `sensors`.
    pub sensor_array: [TrackSensor; TRACK_SENSORS],
}

/// One person.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Track.v2"))]
#[repr(C)]
pub struct Track {
    /// His number, which nobody else ever gets while the tracker runs.
    pub id: u64,
    /// The middle between his legs: metres in the map.
    pub x_m: f32,
    /// The same, along y.
    pub y_m: f32,
    /// Metres per second along x.
    pub vx_m_s: f32,
    /// Metres per second along y.
    pub vy_m_s: f32,
    /// Covariance of the place, m2: xx, xy, yy.
    pub covariance: [f32; 3],
    /// How sure it is that this is a person, 0 to 1.
    pub score: f32,
    /// Milliseconds since he was first seen.
    pub age_ms: u32,
    /// Bit i: sensor i of the sample sees him.
    pub sensors: u32,
    /// Name of the room, UTF-8 and 0 behind it; see [`room_name`](Track::room_name).
    pub room_text: [u8; 24],
    /// See [`TrackState`].
    pub state: u8,
    /// 0.
    pub reserved: [u8; 7],
}

/// One sensor of the site, and where it is in the map.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.TrackSensor.v2"))]
#[repr(C)]
pub struct TrackSensor {
    /// Metres in the map.
    pub x_m: f32,
    /// The same, along y.
    pub y_m: f32,
    /// Where it looks, in radians counter-clockwise from x.
    pub yaw_rad: f32,
    /// 1: it hangs upside down.
    pub upside_down: u8,
    /// 0.
    pub reserved: [u8; 3],
    /// As consumers know it, 0 behind it; see [`name`](TrackSensor::name).
    pub name_text: [u8; 56],
}

/// How well a person is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum TrackState {
    /// Perhaps a person.
    Tentative,
    /// A person who is seen.
    Confirmed,
    /// A person who is not seen, where nobody could be seen either.
    Hidden,
    /// A person on a way that no sensor sees.
    BetweenRooms,
}

impl TrackState {
    /// All, in the order of their numbers.
    pub const ALL: [TrackState; 4] =
        [TrackState::Tentative, TrackState::Confirmed, TrackState::Hidden, TrackState::BetweenRooms];

    /// Returns the word for it in all output.
    pub const fn name(self) -> &'static str {
        match self {
            TrackState::Tentative => "tentative",
            TrackState::Confirmed => "confirmed",
            TrackState::Hidden => "hidden",
            TrackState::BetweenRooms => "between_rooms",
        }
    }
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

impl Tracks {
    /// Returns the persons.
    pub fn tracks(&self) -> &[Track] {
        &self.track_array[..usize::from(self.count).min(TRACKS)]
    }

    /// Returns the sensors of the site.
    pub fn sensors(&self) -> &[TrackSensor] {
        &self.sensor_array[..usize::from(self.sensors).min(TRACK_SENSORS)]
    }

    /// Returns the names of the sensors that see `track`.
    pub fn seen_by<'a>(&'a self, track: &Track) -> impl Iterator<Item = &'a str> + use<'a> {
        let bits = track.sensors;
        let sensors = self.sensors().iter().enumerate();
        sensors.filter(move |(i, _)| bits >> i & 1 == 1).map(|(_, sensor)| sensor.name())
    }

    /// Adds a person; leaves him out if there are [`TRACKS`] already.
    pub fn push(&mut self, track: Track) {
        if let Some(place) = self.track_array.get_mut(usize::from(self.count)) {
            *place = track;
            self.count += 1;
        }
    }

    /// Adds a sensor of the site; leaves it out if there are [`TRACK_SENSORS`] already.
    pub fn push_sensor(&mut self, sensor: TrackSensor) {
        if let Some(place) = self.sensor_array.get_mut(usize::from(self.sensors)) {
            *place = sensor;
            self.sensors += 1;
        }
    }
}

impl Track {
    /// Returns how well he is known; a number that is not known says as little as can be.
    pub fn state(&self) -> TrackState {
        TrackState::ALL.get(usize::from(self.state)).copied().unwrap_or(TrackState::Tentative)
    }

    /// Returns the room that he is in; nothing if he is in none.
    pub fn room_name(&self) -> Option<&str> {
        Some(text::read(&self.room_text)).filter(|room| !room.is_empty())
    }

    /// Sets the room.
    pub fn set_room(&mut self, room: &str) {
        text::write(&mut self.room_text, room);
    }
}

impl TrackSensor {
    /// Makes the sensor called `name`, which sits at `pose` in the map.
    pub fn new(name: &str, pose: &Pose) -> TrackSensor {
        let Pose { x_m, y_m, yaw_rad, upside_down, .. } = *pose;
        let (x_m, y_m, yaw_rad) = (x_m as f32, y_m as f32, yaw_rad as f32);
        let mut sensor = TrackSensor { x_m, y_m, yaw_rad, upside_down, ..TrackSensor::default() };
        text::write(&mut sensor.name_text, name);
        sensor
    }

    /// Returns where it sits in the map.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_states_of_a_sample() {
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
        assert!(tracks.seen_by(track).eq(["kitchen.rear"]));
        for (number, state) in TrackState::ALL.into_iter().enumerate() {
            assert_eq!(state as usize, number);
        }
        assert_eq!(Track { state: 4, ..Track::default() }.state(), TrackState::Tentative);
    }

    #[test]
    fn what_is_too_many_is_left_out() {
        let mut tracks = Tracks::default();
        (0..=TRACKS as u64).for_each(|id| tracks.push(Track { id, ..Track::default() }));
        (0..=TRACK_SENSORS).for_each(|_| tracks.push_sensor(TrackSensor::default()));
        assert_eq!((tracks.tracks().len(), tracks.sensors().len()), (TRACKS, TRACK_SENSORS));
        assert_eq!(tracks.tracks()[TRACKS - 1].id, TRACKS as u64 - 1);
    }
}
