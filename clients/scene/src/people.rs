//! The people of a tracker: where they are, and the tails of where they were. Time is an argument. Refuses to know what tracks
//! them.

use std::collections::VecDeque;

use schema::{TrackState, Tracks};

/// The people of one tracker.
#[derive(Clone, Debug, Default)]
pub struct People {
    persons: Vec<Person>,
    /// When nothing was heard for too long, in ns of CLOCK_MONOTONIC.
    old_at_ns: u64,
}

/// One of them.
#[derive(Clone, Debug)]
pub struct Person {
    /// His number.
    pub id: u64,
    /// How well he is known.
    pub state: TrackState,
    /// Where he is: metres in the map of the site.
    pub place: (f64, f64),
    /// When, in ns of CLOCK_MONOTONIC, and where he was, the oldest first.
    tail: VecDeque<(u64, (f64, f64))>,
}

impl Person {
    /// Returns whether he is more than perhaps a person.
    pub fn is_known(&self) -> bool {
        self.state != TrackState::Tentative
    }

    /// Where he was over the last seconds, the oldest first.
    pub fn tail(&self) -> impl Iterator<Item = (f64, f64)> {
        self.tail.iter().map(|(_, place)| *place)
    }
}

impl People {
    /// Takes where they are, which arrived at `now_ns`.
    pub(crate) fn take(&mut self, tracks: &Tracks, now_ns: u64) {
        let mut before = std::mem::take(&mut self.persons);
        self.persons = tracks
            .tracks()
            .iter()
            .map(|track| {
                let known = before.iter().position(|person| person.id == track.id);
                let mut tail = known.map(|at| before.swap_remove(at).tail).unwrap_or_default();
                let place = (track.x_m.into(), track.y_m.into());
                if tail.back().is_none_or(|(at_ns, _)| now_ns >= at_ns + STEP_NS) {
                    tail.push_back((now_ns, place));
                }
                Person { id: track.id, state: track.state(), place, tail }
            })
            .collect();
        self.old_at_ns = now_ns + OLD_NS;
        self.age(now_ns);
    }

    /// Forgets what is too long ago at `now_ns`; whether there was such.
    pub(crate) fn age(&mut self, now_ns: u64) -> bool {
        let steps =
            |people: &People| people.persons.iter().map(|person| person.tail.len() + 1).sum::<usize>();
        let before = steps(self);
        if now_ns >= self.old_at_ns {
            self.persons.clear();
        }
        for person in &mut self.persons {
            person.tail.retain(|(at_ns, _)| now_ns < at_ns + TAIL_NS);
        }
        before != steps(self)
    }

    /// Who is there.
    pub fn persons(&self) -> &[Person] {
        &self.persons
    }
}

/// Between two steps of a tail.
const STEP_NS: u64 = 150_000_000;
/// Of a whole tail.
const TAIL_NS: u64 = 5_000_000_000;
/// A tracker that says nothing for so long knows nothing.
const OLD_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use schema::Track;

    fn of(places: &[(u64, f32)]) -> Tracks {
        let mut tracks = Tracks::default();
        let track = |&(id, x_m): &(u64, f32)| Track { id, x_m, state: 1, ..Track::default() };
        places.iter().map(track).for_each(|track| tracks.push(track));
        tracks
    }

    #[test]
    fn a_tail_goes_with_its_number_and_has_an_end() {
        let mut people = People::default();
        for n in 0..300 {
            let x_m = n as f32 / 100.0;
            // The order changes, and the second one leaves.
            let places = [(7, x_m), (3, -x_m)];
            let here = if n % 2 == 0 { &places[..] } else { &[places[1], places[0]] };
            people.take(&of(if n < 200 { here } else { &places[..1] }), n * 40_000_000);
        }
        assert_eq!(people.persons().len(), 1);
        let tail: Vec<f64> = people.persons()[0].tail().map(|(x, _)| x).collect();
        assert!(tail.len() > 25 && tail.len() < 36 && tail.is_sorted(), "{tail:?}");
        assert!(people.persons()[0].is_known());
        let last_ns = 299 * 40_000_000;
        assert!(!people.age(last_ns + 1) && people.age(last_ns + OLD_NS));
        assert!(people.persons().is_empty());
    }
}
