//! The times of a header: the wall clock of a stamp, and the header of what is said at a moment without a telegram. Refuses to know
//! topics.

use schema::{Flags, Header, Nanos, Quality};

use crate::surroundings::Surroundings;

/// Nanoseconds since 1970 of the moment that the clock of `around` called `stamp`; it says `now`.
pub(super) fn wall(around: &impl Surroundings, stamp: Nanos, now: Nanos) -> u64 {
    around.wall_ns().saturating_sub(now.saturating_sub(stamp))
}

/// The header of what is said at `now` without a telegram: its number is that of `last`, the last one's.
pub(super) fn of_moment(last: &Header, now: u64, wall_ns: u64) -> Header {
    Header {
        stamp_first_ns: now,
        stamp_last_ns: now,
        wall_ns,
        quality: Quality::Clean as u8,
        reasons: 0,
        flags: last.flags & !Flags::STAMP_ESTIMATED,
        hub_time: [0; 3],
        ..*last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_without_a_telegram_has_nothing_of_its_doubts() {
        let flags = Flags::SIMULATED | Flags::STAMP_ESTIMATED;
        let last = Header {
            seq: 7,
            period_us: 26_640,
            quality: 1,
            reasons: 4,
            flags,
            hub_time: [9; 3],
            ..Header::default()
        };
        let header = of_moment(&last, 5, 6);
        assert_eq!((header.quality, header.reasons, header.flags), (0, 0, Flags::SIMULATED));
        assert_eq!(header.hub_time_ns(), None);
        assert_eq!(
            (header.seq, header.period_us, header.stamp_first_ns, header.stamp_last_ns, header.wall_ns),
            (7, 26_640, 5, 5, 6)
        );
    }
}
