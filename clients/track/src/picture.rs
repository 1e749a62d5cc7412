//! What the tracker says: tracks at an instant, and what happened to them. Refuses to know how they are found.

use crate::geometry::Point;

/// How well a person is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Perhaps a person.
    Tentative,
    /// A person who is seen.
    Confirmed,
    /// A person who is not seen, where nobody could be seen either.
    Hidden,
    /// A person on a way that no sensor sees.
    BetweenRooms,
}

impl State {
    /// Returns the name in JSON.
    pub fn name(self) -> &'static str {
        match self {
            State::Tentative => "tentative",
            State::Confirmed => "confirmed",
            State::Hidden => "hidden",
            State::BetweenRooms => "between_rooms",
        }
    }
}

/// A person at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// Never used again.
    pub id: u64,
    /// How well he is known.
    pub state: State,
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

/// All persons at an instant, and what happened since the last picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// The instant that all places hold for, ns since 1970.
    pub wall_ns: u64,
    /// By identity.
    pub tracks: Vec<Track>,
    /// In their order.
    pub events: Vec<Event>,
}
