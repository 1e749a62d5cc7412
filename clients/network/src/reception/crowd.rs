//! That more is sent than there is room for: told when it happens first, and then now and then how often, for it may be
//! done on purpose, a thousand times a second. Time is an argument; refuses to know who made room for whom.

use std::time::{Duration, Instant};

use crate::lan::republish::SENSORS;
use crate::lan::{LIVES, ROWS};

/// How often there was no room, since the begin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Crowding {
    /// Gateways that were given up for others.
    pub(super) gateways: u64,
    /// Datagrams that were refused.
    pub(super) refused: u64,
    /// Published sensors that were put out for others.
    pub(super) sensors: u64,
    /// Samples of sensors that were not published.
    pub(super) samples: u64,
}

/// What was told of it.
#[derive(Default)]
pub(super) struct Crowd {
    told: Crowding,
    told_at: Option<Instant>,
}

/// Between two lines.
const TELL_EVERY: Duration = Duration::from_secs(60);

impl Crowd {
    /// What is to be told now, if anything is.
    pub(super) fn look(&mut self, so_far: Crowding, now: Instant) -> Option<String> {
        if so_far == self.told || self.told_at.is_some_and(|at| now - at < TELL_EVERY) {
            return None;
        }
        let Crowding { gateways, refused, sensors, samples } = self.told;
        let parts = [
            (so_far.gateways - gateways, "gateways were given up for others"),
            (so_far.refused - refused, "datagrams of others were refused"),
            (so_far.sensors - sensors, "published sensors were put out for others"),
            (so_far.samples - samples, "samples of other sensors were not published"),
        ];
        let parts = parts.iter().filter(|(count, _)| *count > 0);
        let parts: Vec<_> = parts.map(|(count, what)| format!("{count} {what}")).collect();
        self.told = so_far;
        self.told_at = Some(now);
        Some(format!(
            "more is sent than there is room for ({LIVES} gateways, {ROWS} of their sensors and topics; {SENSORS} published \
             sensors): {}; gateways that are known to deliver stay. If somebody invents them, use --hub to receive only those that it names",
            parts.join(", ")
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_told_at_once_and_then_once_a_minute() {
        let (mut crowd, begin) = (Crowd::default(), Instant::now());
        let mut told = Vec::new();
        for n in 0..180_000_u64 {
            // Nothing happens in the second minute.
            let gateways = n.min(60_000) + n.saturating_sub(120_000);
            let so_far = Crowding { gateways, ..Crowding::default() };
            if let Some(line) = crowd.look(so_far, begin + Duration::from_millis(n)) {
                assert!(line.contains(" gateways were given") && !line.contains("samples"), "{line}");
                told.push(n);
            }
        }
        assert_eq!(told, [1, 60_001, 120_001]);
    }
}
