//! How long a verdict is shown: always the worst one of the last moments. A worse one is shown at once, a better one
//! after it has lasted, so that the light does not flicker. Time is an argument; refuses to know lights.

use std::time::{Duration, Instant};

use scanhub_schema::Verdict;

/// A verdict, and the sensor that it is of, where there are several.
pub(crate) type Said = (Verdict, Option<String>);

/// The verdicts of the last moments.
pub(crate) struct Hold {
    moments: Duration,
    now: Said,
    /// Worse ones that stood before, and until when; of each verdict the last time.
    before: Vec<(Said, Instant)>,
}

impl Hold {
    /// Nothing is known yet; a verdict counts for `moments` after its end.
    pub(crate) fn new(moments: Duration) -> Hold {
        Hold { moments, now: (Verdict::Unknown, None), before: Vec::new() }
    }

    /// From `now` on the verdict is `said`.
    pub(crate) fn take(&mut self, said: Said, now: Instant) {
        let is_worse = |verdict: Verdict| verdict != said.0 && verdict.worse(said.0) == verdict;
        self.before.retain(|((verdict, _), _)| is_worse(*verdict));
        let ended = std::mem::replace(&mut self.now, said);
        if ended.0 != self.now.0 && ended.0.worse(self.now.0) == ended.0 {
            self.before.retain(|((verdict, _), _)| *verdict != ended.0);
            self.before.push((ended, now));
        }
    }

    /// What is to be shown at `now`.
    pub(crate) fn shown(&mut self, now: Instant) -> &Said {
        let moments = self.moments;
        self.before.retain(|(_, until)| now.saturating_duration_since(*until) < moments);
        let said = self.before.iter().map(|(said, _)| said);
        said.fold(&self.now, |worst, said| if worst.0.worse(said.0) == said.0 { said } else { worst })
    }

    /// When that may change without a new verdict.
    pub(crate) fn changes_at(&self) -> Option<Instant> {
        self.before.iter().filter_map(|(_, until)| until.checked_add(self.moments)).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Verdict::{Clear, Slow, Stop, Unknown};

    const HOLD_MS: u64 = 300;

    /// What is shown after each of these times and verdicts, and at each time without one.
    fn shown(steps: &[(u64, Option<Verdict>)]) -> Vec<Verdict> {
        let (mut hold, start) = (Hold::new(Duration::from_millis(HOLD_MS)), Instant::now());
        let at = |ms| start + Duration::from_millis(ms);
        let step = |&(ms, said): &(u64, Option<Verdict>)| {
            if let Some(verdict) = said {
                hold.take((verdict, None), at(ms));
            }
            hold.shown(at(ms)).0
        };
        steps.iter().map(step).collect()
    }

    #[test]
    fn a_worse_verdict_is_shown_at_once_and_a_better_one_after_it_has_stood() {
        let steps = [(0, Some(Clear)), (299, None), (300, None), (400, Some(Slow)), (401, Some(Stop))];
        assert_eq!(shown(&steps), [Unknown, Unknown, Clear, Slow, Stop]);
        let steps = [(0, Some(Stop)), (100, Some(Clear)), (399, Some(Clear)), (400, None)];
        assert_eq!(shown(&steps), [Stop, Stop, Stop, Clear]);
    }

    #[test]
    fn whoever_flickers_stays_worst() {
        let steps: Vec<_> = (0..20).map(|n| (n * 200, Some(if n % 2 == 0 { Stop } else { Clear }))).collect();
        assert!(shown(&steps).iter().all(|verdict| *verdict == Stop));
    }

    #[test]
    fn it_gets_better_by_steps() {
        let steps =
            [(0, Some(Stop)), (10, Some(Slow)), (110, Some(Clear)), (309, None), (310, None), (409, None)];
        assert_eq!(shown(&steps), [Stop, Stop, Stop, Stop, Slow, Slow]);
        assert_eq!(shown(&[&steps[..], &[(410, None)]].concat()).last(), Some(&Clear));
    }

    #[test]
    fn what_is_shown_is_of_the_sensor_that_said_it_and_its_end_is_known() {
        let (mut hold, now) = (Hold::new(Duration::from_millis(HOLD_MS)), Instant::now());
        hold.take((Stop, Some("rear".into())), now);
        assert_eq!(hold.changes_at(), None);
        hold.take((Clear, Some("front".into())), now);
        assert_eq!(hold.shown(now), &(Stop, Some("rear".into())));
        let end = now + Duration::from_millis(HOLD_MS);
        assert_eq!((hold.changes_at(), hold.shown(end).clone()), (Some(end), (Clear, Some("front".into()))));
        assert_eq!(hold.changes_at(), None);
    }

    #[test]
    fn without_a_hold_all_is_shown_as_it_is_said() {
        let (mut hold, now) = (Hold::new(Duration::ZERO), Instant::now());
        for verdict in [Clear, Stop, Slow, Clear, Unknown, Clear] {
            hold.take((verdict, None), now);
            assert_eq!(hold.shown(now).0, verdict);
        }
    }
}
