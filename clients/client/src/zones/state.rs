//! The zones of one sensor as samples and time say. Time is an argument; this file does not know where samples come from.

use std::time::Duration;

use scanhub_schema::{Header, Zones};

use super::Heard;
use crate::clock::Moment;
use crate::freshness::Freshness;

/// What is known of one sensor's zones: for programs that get samples another way than from a session.
///
/// # Examples
///
/// ```
/// use scanhub_client::clock::Moment;
/// use scanhub_client::streams::ZonesState;
/// use scanhub_client::{Header, Robot, Verdict, Zones};
///
/// let at = |ms: u64| Moment { monotonic_ns: ms * 1_000_000, boottime_ns: ms * 1_000_000 };
/// let (mut front, mut robot) = (ZonesState::new(at(0)), Robot::default());
/// let position = robot.expect("front");
/// let clear = Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() };
/// let header = Header { stamp_last_ns: 10_000_000, period_us: 26_640, ..Header::default() };
/// robot.hear(position, front.take(&header, &clear, 0, at(10)).zones);
/// assert_eq!(robot.verdict(), Verdict::Clear);
/// // Two periods and 40 ms later.
/// if let Some(silence) = front.silence(at(104)) {
///     robot.hear(position, silence.zones);
/// }
/// assert_eq!(robot.verdict(), Verdict::Unknown);
/// ```
#[derive(Clone, Debug)]
pub struct ZonesState {
    freshness: Freshness,
    spoken: bool,
}

impl ZonesState {
    /// Makes the state of a sensor of which nothing was heard yet, and nobody listened before `now`.
    pub fn new(now: Moment) -> ZonesState {
        ZonesState { freshness: Freshness::new(now), spoken: false }
    }

    /// Takes a sample that came in at `now`, and says what is known by it. `missed` samples were sent before it and did not
    /// come.
    pub fn take(&mut self, header: &Header, zones: &Zones, missed: u64, now: Moment) -> Heard {
        self.spoken = true;
        let fresh = self.freshness.heard(header, zones.verdict(), now);
        let known = if fresh { *zones } else { Zones::unknown() };
        Heard { zones: known, header: Some(*header), missed, stale: !fresh, said: *zones }
    }

    /// Returns that nothing is known any more, if that is so since just now; said once per silence.
    pub fn silence(&mut self, now: Moment) -> Option<Heard> {
        let silence = self.freshness.silence(now).then(Heard::nothing);
        self.spoken |= silence.is_some();
        silence
    }

    /// Returns whether there was a sample, or the silence of one that does not come.
    pub fn has_spoken(&self) -> bool {
        self.spoken
    }

    /// Returns how long [`silence`](Self::silence) need not be asked; nothing if only a sample can change anything.
    pub fn left(&self, now: Moment) -> Option<Duration> {
        self.freshness.left(now)
    }
}
