//! The runs ("lives") of gateways that are distinguished: which of them continue, and which one is dropped when there is
//! no room for another. Refuses to know what they sent.

use core::cmp::Ordering;

use super::standing::{Arrival, Standing};
use super::voices::Voices;

/// The most lives of gateways that are distinguished.
pub const LIVES: usize = 64;

/// Gateway and epoch.
pub(super) type Life = (u64, u32);

/// Of each gateway the greatest epoch that was taken, which goes on, and smaller ones, which are retired.
pub(super) struct Lives {
    /// The retired ones in the order in which they were, behind them those that go on.
    all: [Place; LIVES],
    records: [Record; LIVES],
    retired: usize,
    count: usize,
}

/// A life, and where its record is.
#[derive(Clone, Copy)]
struct Place {
    life: Life,
    slot: usize,
}

/// What is known of a life.
#[derive(Clone, Copy)]
pub(super) struct Record {
    /// When it was taken.
    since_ns: u64,
    pub(super) standing: Standing,
    pub(super) voices: Voices,
}

/// How a life stands to what is known of its gateway.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Found {
    /// A greater epoch of the same gateway was taken, and not given up.
    Over,
    /// It goes on, and its record is there.
    At(usize),
    /// Nothing of it, or of its gateway, was taken.
    New,
}

/// A life that was given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Gone {
    pub(super) life: Life,
    /// Nobody knows that it was over: it had to make room.
    pub(super) is_displaced: bool,
}

impl Lives {
    /// None.
    pub(super) fn new() -> Lives {
        Lives {
            all: core::array::from_fn(|slot| Place { life: (0, 0), slot }),
            records: [Record::new(0); LIVES],
            retired: 0,
            count: 0,
        }
    }

    /// Since when it is known, if it was taken and not given up.
    pub(super) fn since_ns(&self, life: Life) -> Option<u64> {
        let place = self.all[..self.count].iter().find(|place| place.life == life)?;
        Some(self.records[place.slot].since_ns)
    }

    /// How `life` stands to the one of its gateway that goes on.
    pub(super) fn find(&self, (hub, epoch): Life) -> Found {
        let Some(place) = self.going_on().iter().find(|place| place.life.0 == hub) else { return Found::New };
        match place.life.1.cmp(&epoch) {
            Ordering::Greater => Found::Over,
            Ordering::Equal => Found::At(place.slot),
            Ordering::Less => Found::New,
        }
    }

    /// What is known of the life that was found there.
    pub(super) fn record(&self, slot: usize) -> &Record {
        &self.records[slot]
    }

    /// As [`record`](Lives::record), to be changed.
    pub(super) fn record_mut(&mut self, slot: usize) -> &mut Record {
        &mut self.records[slot]
    }

    /// Whether one can be given up for what came of `life`.
    pub(super) fn can_give_up(&self, life: Life, arrival: Arrival) -> bool {
        let (hub, epoch) = life;
        let is_older = |place: &Place| place.life.0 == hub && place.life.1 < epoch;
        self.retired > 0 || self.going_on().iter().any(is_older) || self.least(life, arrival).is_some()
    }

    /// There is no place for one more.
    pub(super) fn is_full(&self) -> bool {
        self.count == LIVES
    }

    /// Takes `life`, which is not over and not there, and retires the one of its gateway that went on until now. Then
    /// there is room, or one to give up: the caller has looked. Answers where it is, and what was given up.
    pub(super) fn take(&mut self, life: Life, arrival: Arrival) -> (usize, Option<Gone>) {
        if let Some(at) = self.going_on().iter().position(|place| place.life.0 == life.0) {
            self.all[self.retired..=self.retired + at].rotate_right(1);
            self.retired += 1;
        }
        let gone = if self.is_full() { self.give_up(life, arrival) } else { None };
        let place = &mut self.all[self.count];
        place.life = life;
        self.records[place.slot] = Record::new(arrival.now_ns);
        self.count += 1;
        (place.slot, gone)
    }

    /// Forgets the one that has been retired longest; if there is none, that which is worth least, but not `life`, of which
    /// something came. Nothing if all others are known to deliver, or only deliver what they announced a moment ago and
    /// what came is no sample.
    pub(super) fn give_up(&mut self, life: Life, arrival: Arrival) -> Option<Gone> {
        let is_displaced = self.retired == 0;
        let at = if is_displaced { self.least(life, arrival)? } else { 0 };
        Some(Gone { life: self.remove(at), is_displaced })
    }

    /// Forgets `life`.
    pub(super) fn forget(&mut self, life: Life) {
        if let Some(at) = self.all[..self.count].iter().position(|place| place.life == life) {
            self.remove(at);
        }
    }

    fn remove(&mut self, at: usize) -> Life {
        self.all[at..self.count].rotate_left(1);
        self.count -= 1;
        self.retired -= usize::from(at < self.retired);
        self.all[self.count].life
    }

    /// Where that stands which is worth least of those that go on and may be put out.
    fn least(&self, life: Life, arrival: Arrival) -> Option<usize> {
        let may_go = |at: &usize| {
            let Place { life: other, slot } = self.all[*at];
            other != life && self.records[slot].standing.may_go(arrival)
        };
        let worth = |at: &usize| self.records[self.all[*at].slot].standing.worth_ns();
        (self.retired..self.count).filter(may_go).min_by_key(worth)
    }

    fn going_on(&self) -> &[Place] {
        &self.all[self.retired..self.count]
    }
}

impl Record {
    fn new(since_ns: u64) -> Record {
        Record { since_ns, standing: Standing::NONE, voices: Voices::NONE }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contains(lives: &Lives, life: Life) -> bool {
        lives.since_ns(life).is_some()
    }

    const MS: u64 = 1_000_000;

    fn is_over(lives: &Lives, life: Life) -> bool {
        lives.find(life) == Found::Over
    }

    fn announces(at_ms: u64) -> Arrival {
        Arrival { delivers: false, now_ns: at_ms * MS }
    }

    fn delivers(at_ms: u64) -> Arrival {
        Arrival { delivers: true, now_ns: at_ms * MS }
    }

    /// Takes it, known or not; who was put out.
    fn hear(lives: &mut Lives, life: Life, arrival: Arrival) -> Option<Life> {
        let (slot, gone) = match lives.find(life) {
            Found::At(slot) => (slot, None),
            _ => lives.take(life, arrival),
        };
        lives.record_mut(slot).standing.take(arrival);
        gone.map(|gone| gone.life)
    }

    #[test]
    fn the_longest_retired_one_is_given_up() {
        let mut lives = Lives::new();
        for life in [(1, 5), (2, 5), (3, 5), (2, 6), (1, 9), (2, 7)] {
            assert_eq!(hear(&mut lives, life, delivers(0)), None);
        }
        assert!(contains(&lives, (2, 5)) && is_over(&lives, (1, 8)) && !is_over(&lives, (1, 9)));
        let mut give_up = || lives.give_up((9, 9), announces(0)).map(|gone| (gone.life, gone.is_displaced));
        let retired = [(2, 5), (1, 5), (2, 6)].map(|life| Some((life, false)));
        assert_eq!([(); 3].map(|()| give_up()), retired);
        assert_eq!(give_up(), None, "the others deliver");
        assert!(
            is_over(&lives, (2, 6)) && !contains(&lives, (2, 6)),
            "its gateway goes on with a greater epoch"
        );
        assert!(contains(&lives, (1, 9)) && contains(&lives, (2, 7)) && contains(&lives, (3, 5)));
    }

    #[test]
    fn who_starts_again_makes_its_own_room() {
        let mut lives = Lives::new();
        for hub in 0..LIVES as u64 {
            assert!(!lives.is_full());
            assert_eq!(hear(&mut lives, (hub, 1), delivers(0)), None);
            hear(&mut lives, (hub, 1), delivers(1000));
        }
        let now = delivers(1001);
        assert!(lives.is_full() && !lives.can_give_up((99, 1), now) && lives.can_give_up((7, 2), now));
        assert_eq!(hear(&mut lives, (7, 2), now), Some((7, 1)));
        assert!(lives.is_full() && is_over(&lives, (7, 1)) && !lives.can_give_up((9, 1), announces(1002)));
    }

    #[test]
    fn who_only_announces_never_puts_out_who_delivers() {
        let mut lives = Lives::new();
        assert_eq!(hear(&mut lives, (1, 1), delivers(0)), None);
        assert_eq!(hear(&mut lives, (2, 1), delivers(0)), None);
        for n in 1..30_000 {
            // One delivers ten times a second, the other did once; somebody invents a gateway each millisecond.
            if n % 100 == 0 {
                assert_eq!(hear(&mut lives, (1, 1), delivers(n)), None, "{n}");
            }
            let gone = hear(&mut lives, (1000 + n, 1), announces(n));
            assert!(gone.is_none_or(|(hub, _)| hub >= 1000 || hub == 2 && n >= 3000), "{n}: {gone:?}");
        }
        assert!(contains(&lives, (1, 1)) && !contains(&lives, (2, 1)));
    }

    #[test]
    fn who_is_known_to_deliver_is_not_put_out_by_one_that_begins_to() {
        let mut lives = Lives::new();
        let mut displaced = 0;
        for n in 0..30_000 {
            if n % 100 == 0 && !(10_000..20_000).contains(&n) {
                assert_eq!(
                    hear(&mut lives, (1, 1), delivers(n)),
                    None,
                    "{n}: and its silence is not that long"
                );
            }
            if n > 1000 {
                displaced += u32::from(hear(&mut lives, (1000 + n, 1), delivers(n)).is_some());
            }
        }
        assert!(contains(&lives, (1, 1)) && displaced > 28_000);
    }

    #[test]
    fn the_oldest_silence_goes_first() {
        let mut lives = Lives::new();
        for hub in 0..LIVES as u64 {
            for at_ms in [0, 2000 + hub] {
                assert_eq!(hear(&mut lives, (hub, 1), delivers(at_ms)), None);
            }
        }
        assert!(!lives.can_give_up((99, 1), delivers(4999)));
        assert_eq!(hear(&mut lives, (99, 1), delivers(5000)), Some((0, 1)));
        assert_eq!(hear(&mut lives, (100, 1), announces(6000)), Some((1, 1)));
        assert_eq!(hear(&mut lives, (101, 1), announces(6001)), Some((100, 1)), "it never delivered");
    }
}
