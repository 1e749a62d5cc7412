//! What a fault did that the account of telegrams does not show: a scene that finds nothing of it is about nothing.

use scanhub_drivers::lms;
use scanhub_drivers::lms::telegram::NAK;
use scanhub_drivers::lms::variant::MIRROR_TURN;
use scanhub_schema::{MILLIS, Nanos};

use crate::session::bench::{Bench, Sent};

/// How often each happened.
#[derive(Debug, Default)]
pub(crate) struct Effects {
    /// Requests that reached the sensor and were not acknowledged.
    pub(crate) unheard: usize,
    pub(crate) naks: usize,
    /// Replies beyond one for each ACK.
    pub(crate) doubled: usize,
    /// Replies 92h.
    pub(crate) refused: usize,
    /// Acknowledgements, and replies, later than the sensor usually has them.
    pub(crate) late_acknowledgements: usize,
    pub(crate) late_replies: usize,
    /// Scans that came at another time than the mirror has them.
    pub(crate) off_grid: usize,
    /// Telegrams that came a second time.
    pub(crate) copies: usize,
    /// Bytes between telegrams that the sensor did not send.
    pub(crate) foreign: usize,
}

impl Effects {
    /// What shows on `bench`.
    pub(crate) fn of(bench: &Bench) -> Effects {
        let Bench { asked, acknowledged, sent, foreign, .. } = bench;
        let naks = acknowledged.iter().filter(|(_, byte)| *byte == NAK).count();
        let replies: Vec<&Sent> = sent.iter().filter(|sent| sent.is_reply).collect();
        let acks: Vec<Nanos> =
            acknowledged.iter().filter(|(_, byte)| *byte != NAK).map(|(at, _)| *at).collect();
        let mut effects = Effects {
            unheard: asked.len().saturating_sub(acknowledged.len()),
            naks,
            doubled: replies.len().saturating_sub(acks.len()),
            refused: replies.iter().filter(|sent| sent.telegram[4] == lms::reply::REFUSED).count(),
            late_acknowledgements: acks.iter().filter(|&&at| at > after(asked, at) + 40 * MILLIS).count(),
            late_replies: replies
                .iter()
                .filter(|sent| sent.at > after(&acks, sent.at) + 250 * MILLIS)
                .count(),
            foreign: *foreign,
            ..Effects::default()
        };
        for pair in sent.windows(2).filter(|pair| pair.iter().all(|sent| !sent.is_reply && !sent.aborted)) {
            let gap = pair[1].at - pair[0].at;
            effects.copies += usize::from(gap == 0 && pair[0].telegram == pair[1].telegram);
            effects.off_grid += usize::from(gap == 0 || (gap + MILLIS) % (2 * MIRROR_TURN) > 2 * MILLIS);
        }
        effects
    }

    pub(crate) fn add(&mut self, other: &Effects) {
        self.unheard += other.unheard;
        self.naks += other.naks;
        self.doubled += other.doubled;
        self.refused += other.refused;
        self.late_acknowledgements += other.late_acknowledgements;
        self.late_replies += other.late_replies;
        self.off_grid += other.off_grid;
        self.copies += other.copies;
        self.foreign += other.foreign;
    }
}

/// The last of `times` that is not after `at`; `at` itself if there is none.
fn after(times: &[Nanos], at: Nanos) -> Nanos {
    times.iter().rev().copied().find(|&time| time <= at).unwrap_or(at)
}
