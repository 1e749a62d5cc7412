//! People of a tracker: each has a position with its uncertainty, a room, and the positions of the last seconds.
//! Callers pass the time.

use std::collections::VecDeque;

use scanhub_schema::{Track, TrackState, Tracks};

/// The people of one tracker.
#[derive(Clone, Debug, Default)]
pub struct People {
    people: Vec<Person>,
    /// Time from which on the last sample is too old, in ns of CLOCK_MONOTONIC.
    old_at_ns: u64,
}

/// One person.
#[derive(Clone, Debug)]
pub struct Person {
    /// ID of the track.
    pub id: u64,
    /// State of the track.
    pub state: TrackState,
    /// Position in the map of the site, in meters.
    pub position: (f64, f64),
    /// Uncertainty of the position.
    pub ellipse: Ellipse,
    /// Name of the room; `None` if the person is outside all rooms.
    pub room: Option<String>,
    /// Positions of the last seconds, the oldest first, each with its time in ns of CLOCK_MONOTONIC.
    tail: VecDeque<(u64, (f64, f64))>,
}

/// Ellipse around a position that contains the true position in 95 of 100 cases.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipse {
    /// Half of the longer axis, in meters.
    pub long_m: f64,
    /// Half of the shorter axis, in meters.
    pub short_m: f64,
    /// Direction of the longer axis, in radians counterclockwise from x.
    pub yaw_rad: f64,
}

impl Ellipse {
    /// Computes the ellipse of a normal distribution with this covariance in m2: xx, xy, yy. The axes have the
    /// directions of the eigenvectors. Half of an axis is the square root of the product of its eigenvalue and the 95 %
    /// quantile of chi-squared with two degrees of freedom.
    pub fn of(covariance: [f32; 3]) -> Ellipse {
        let [xx, xy, yy] = covariance.map(f64::from);
        let (mean, half) = ((xx + yy) / 2.0, ((xx - yy) / 2.0).hypot(xy));
        let axis = |eigenvalue: f64| (CHI_SQUARED_95 * eigenvalue.max(0.0)).sqrt();
        let yaw_rad = 0.5 * (2.0 * xy).atan2(xx - yy);
        Ellipse { long_m: axis(mean + half), short_m: axis(mean - half), yaw_rad }
    }
}

impl Person {
    /// Returns whether the track is not tentative.
    pub fn is_known(&self) -> bool {
        self.state != TrackState::Tentative
    }

    /// Returns whether a sensor sees the person.
    pub fn is_seen(&self) -> bool {
        self.state == TrackState::Confirmed
    }

    /// Returns the positions of the last seconds, the oldest first.
    pub fn tail(&self) -> impl Iterator<Item = (f64, f64)> {
        self.tail.iter().map(|(_, position)| *position)
    }

    fn of(track: &Track, tail: VecDeque<(u64, (f64, f64))>) -> Person {
        Person {
            id: track.id,
            state: track.state(),
            position: (track.x_m.into(), track.y_m.into()),
            ellipse: Ellipse::of(track.covariance),
            room: track.room_name().map(str::to_owned),
            tail,
        }
    }
}

impl People {
    /// Stores the people of a sample that arrived at `now_ns`.
    pub(crate) fn take(&mut self, tracks: &Tracks, now_ns: u64) {
        let mut before = std::mem::take(&mut self.people);
        self.people = tracks
            .tracks()
            .iter()
            .map(|track| {
                let known = before.iter().position(|person| person.id == track.id);
                let mut person =
                    Person::of(track, known.map(|at| before.swap_remove(at).tail).unwrap_or_default());
                if person.tail.back().is_none_or(|(at_ns, _)| now_ns >= at_ns + STEP_INTERVAL_NS) {
                    person.tail.push_back((now_ns, person.position));
                }
                person
            })
            .collect();
        self.old_at_ns = now_ns + MAX_AGE_NS;
        self.expire(now_ns);
    }

    /// Deletes positions and people that are too old at `now_ns`. Returns whether any were deleted.
    pub(crate) fn expire(&mut self, now_ns: u64) -> bool {
        let steps = |people: &People| people.people.iter().map(|person| person.tail.len() + 1).sum::<usize>();
        let before = steps(self);
        if now_ns >= self.old_at_ns {
            self.people.clear();
        }
        for person in &mut self.people {
            person.tail.retain(|(at_ns, _)| now_ns < at_ns + TAIL_NS);
        }
        before != steps(self)
    }

    /// Returns all people, even tentative ones.
    pub fn people(&self) -> &[Person] {
        &self.people
    }

    /// Returns the people whose track is not tentative.
    pub fn known(&self) -> impl Iterator<Item = &Person> {
        self.people.iter().filter(|person| person.is_known())
    }
}

/// Returns the number of people in each room as text, sorted by the room's name. People outside all rooms are at the
/// end. Returns `None` if there are no people.
pub fn rooms<'a>(people: impl Iterator<Item = &'a Person>) -> Option<String> {
    let mut rooms: Vec<_> = people.map(|person| person.room.as_deref()).collect();
    rooms.sort_by_key(|room| (room.is_none(), *room));
    let count = rooms.len();
    let words = rooms.chunk_by(|a, b| a == b);
    let words: Vec<_> =
        words.map(|room| format!("{} {}", room[0].unwrap_or("elsewhere"), room.len())).collect();
    let persons = if count == 1 { "person" } else { "people" };
    (count > 0).then(|| format!("{count} {persons}: {}", words.join(", ")))
}

/// Minimum interval between two positions of a tail, in ns.
const STEP_INTERVAL_NS: u64 = 150_000_000;
/// Duration of a tail, in ns.
const TAIL_NS: u64 = 5_000_000_000;
/// Maximum age of the last sample of a tracker, in ns.
const MAX_AGE_NS: u64 = 1_000_000_000;
/// 95 % quantile of chi-squared with two degrees of freedom: -2 ln 0.05.
const CHI_SQUARED_95: f64 = 5.991_464_547_107_979;

#[cfg(test)]
mod tests {
    use super::*;

    fn of(places: &[(u64, f32)]) -> Tracks {
        let mut tracks = Tracks::default();
        let track = |&(id, x_m): &(u64, f32)| Track { id, x_m, state: 1, ..Track::default() };
        places.iter().map(track).for_each(|track| tracks.push(track));
        tracks
    }

    #[test]
    fn tail_belongs_to_an_id_and_expires() {
        let mut people = People::default();
        for n in 0..300 {
            let x_m = n as f32 / 100.0;
            // The order changes, and the second person leaves.
            let places = [(7, x_m), (3, -x_m)];
            let here = if n % 2 == 0 { &places[..] } else { &[places[1], places[0]] };
            people.take(&of(if n < 200 { here } else { &places[..1] }), n * 40_000_000);
        }
        assert_eq!(people.people().len(), 1);
        let tail: Vec<f64> = people.people()[0].tail().map(|(x, _)| x).collect();
        assert!(tail.len() > 25 && tail.len() < 36 && tail.is_sorted(), "{tail:?}");
        assert!(people.people()[0].is_known());
        let last_ns = 299 * 40_000_000;
        assert!(!people.expire(last_ns + 1) && people.expire(last_ns + MAX_AGE_NS));
        assert!(people.people().is_empty());
    }

    #[test]
    fn ellipse_has_the_axes_of_the_covariance() {
        let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
        let along = Ellipse::of([0.25, 0.0, 0.01]);
        assert!(near(along.long_m, 0.5 * CHI_SQUARED_95.sqrt()) && near(along.short_m, 0.2 * along.long_m));
        assert!(near(along.yaw_rad, 0.0));
        let across = Ellipse::of([0.01, 0.0, 0.25]);
        assert!(near(across.long_m, along.long_m) && near(across.yaw_rad.abs(), 90_f64.to_radians()));
        // Rotated by 30 degrees.
        let (sin, cos) = 30_f64.to_radians().sin_cos();
        let turned =
            [0.25 * cos * cos + 0.01 * sin * sin, 0.24 * sin * cos, 0.25 * sin * sin + 0.01 * cos * cos];
        let turned = Ellipse::of(turned.map(|value| value as f32));
        assert!(near(turned.yaw_rad.to_degrees(), 30.0) && near(turned.short_m, along.short_m), "{turned:?}");
        // An invalid covariance gives a point.
        assert_eq!(Ellipse::of([-1.0, 0.0, -1.0]).long_m, 0.0);
    }

    #[test]
    fn people_are_counted_by_room_name() {
        let mut tracks = of(&[(1, 0.0), (2, 0.0), (3, 0.0), (4, 0.0)]);
        for (track, room) in tracks.track_array.iter_mut().zip(["kitchen", "", "hall", "kitchen"]) {
            track.set_room(room);
        }
        let mut people = People::default();
        people.take(&tracks, 0);
        assert_eq!(rooms(people.known()).as_deref(), Some("4 people: hall 1, kitchen 2, elsewhere 1"));
        assert_eq!(rooms(people.known().take(1)).as_deref(), Some("1 person: kitchen 1"));
        assert_eq!(rooms(std::iter::empty()), None);
    }
}
