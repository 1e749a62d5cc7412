//! Where a mount turns back, and whether it stands: from its angles, with hysteresis, so that a play of the gears is neither.
//! Refuses to know what is measured meanwhile.

use crate::tilt::settings::Settings;

/// What an angle tells of the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Told {
    Nothing,
    /// The mount turned back at this time.
    Turned(u64),
    /// It has been standing since this time.
    Stands(u64),
}

/// Where an angle was so far.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    stamp_ns: u64,
    rad: f64,
}

/// Which way the mount goes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    /// Not known: the least and greatest angle since that is so.
    Open { least: Place, most: Place },
    /// To greater angles: the greatest so far.
    Up(Place),
    /// To lesser angles: the least so far.
    Down(Place),
}

/// The way of a mount.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Swing {
    way: Option<Way>,
    /// Where it was when it moved last.
    moved: Option<Place>,
}

impl Swing {
    /// Nothing is known of the way until the next angle.
    pub(crate) fn forget(&mut self) {
        *self = Swing::default();
    }

    /// Takes the next angle of a way that is known.
    pub(crate) fn take(&mut self, stamp_ns: u64, rad: f64, settings: &Settings) -> Told {
        let here = Place { stamp_ns, rad };
        let moved = *self.moved.get_or_insert(here);
        if (rad - moved.rad).abs() > settings.turn_rad / 10.0 {
            self.moved = Some(here);
        } else if stamp_ns - moved.stamp_ns > settings.standing_ns {
            self.way = None;
            return Told::Stands(moved.stamp_ns);
        }
        let back = settings.turn_rad;
        let (way, told) = match self.way.unwrap_or(Way::Open { least: here, most: here }) {
            Way::Open { least, .. } if rad > least.rad + back => (Way::Up(here), Told::Nothing),
            Way::Open { most, .. } if rad < most.rad - back => (Way::Down(here), Told::Nothing),
            Way::Open { least, most } => {
                let least = if rad <= least.rad { here } else { least };
                let most = if rad >= most.rad { here } else { most };
                (Way::Open { least, most }, Told::Nothing)
            }
            Way::Up(most) if rad < most.rad - back => (Way::Down(here), Told::Turned(most.stamp_ns)),
            Way::Up(most) => (Way::Up(if rad >= most.rad { here } else { most }), Told::Nothing),
            Way::Down(least) if rad > least.rad + back => (Way::Up(here), Told::Turned(least.stamp_ns)),
            Way::Down(least) => (Way::Down(if rad <= least.rad { here } else { least }), Told::Nothing),
        };
        self.way = Some(way);
        told
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn told(degrees: impl Iterator<Item = f64>) -> Vec<Told> {
        let mut swing = Swing::default();
        let settings = Settings::default();
        let told =
            degrees.enumerate().map(|(i, deg)| swing.take(10 * i as u64 * MS, deg.to_radians(), &settings));
        told.filter(|told| *told != Told::Nothing).collect()
    }

    /// To and fro by 20 degrees in a second, with a play of half a degree.
    fn triangle(i: u32) -> f64 {
        let phase = f64::from(i % 200) / 100.0;
        20.0 * if phase < 1.0 { phase } else { 2.0 - phase } + if i.is_multiple_of(2) { 0.25 } else { -0.25 }
    }

    #[test]
    fn it_turns_where_the_angle_was_farthest() {
        let turns = told((0..500).map(triangle));
        let times: Vec<u64> = turns
            .iter()
            .map(|told| match told {
                Told::Turned(ns) => ns / MS,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(times.len(), 4, "where it began may be anywhere: {times:?}");
        for (time, expected) in times.iter().zip([1000, 2000, 3000, 4000]) {
            assert!(time.abs_diff(expected) <= 20, "{times:?}");
        }
    }

    #[test]
    fn it_stands_when_the_angle_does() {
        let stands = told((0..200).map(|i| f64::from(i.min(100)) * 0.3));
        let Told::Stands(since) = stands[0] else { panic!("{stands:?}") };
        assert_eq!(since / MS, 1000);
        assert!(stands[1..].iter().all(|told| *told == Told::Stands(since)), "as long as it does");
    }
}
