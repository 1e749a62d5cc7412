//! Where memory, descriptors or places for consumers are short, nothing more is followed for a while: to try takes as long as
//! receiving a thousand samples. Refuses to know what was short.

use std::time::{Duration, Instant};

/// Whether something was short a moment ago.
#[derive(Default)]
pub(super) struct Shortage {
    until: Option<Instant>,
}

impl Shortage {
    /// Something is short at `now`.
    pub(super) fn begin(&mut self, now: Instant) {
        self.until = Some(now + PAUSE);
    }

    /// Whether it is too early at `now` to try again.
    pub(super) fn lasts(&self, now: Instant) -> bool {
        self.until.is_some_and(|until| now < until)
    }
}

const PAUSE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_tried_again_after_a_pause() {
        let (mut shortage, now) = (Shortage::default(), Instant::now());
        assert!(!shortage.lasts(now));
        shortage.begin(now);
        assert!(shortage.lasts(now) && !shortage.lasts(now + PAUSE));
    }
}
