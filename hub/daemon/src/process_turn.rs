//! What a link makes of a scanner whose head turns and that sends packets: the packets themselves, and of each turn a scan and
//! what follows from it. Refuses to know how packets become turns.

use scanhub_drivers::line::{Received, Turn};
use scanhub_drivers::scanner::Turning;
use schema::{Nanos, Scan};

use crate::early::Begun;
use crate::process_telegram::{LinkOutput, Processed, RecordedContext, limit};
use crate::surroundings::Surroundings;

impl<S: Surroundings> LinkOutput<'_, S> {
    /// Publishes packets that arrived together; what `recorded` knows goes before what the link knows.
    pub(crate) fn process_packets<M>(
        &mut self,
        received: &Received<'_, M>,
        recorded: &RecordedContext,
    ) -> Processed {
        self.recall(recorded);
        self.topics.packets(received, received.reasons);
        Processed { is_suspect: received.reasons != 0, stands_for: None }
    }

    /// Publishes the scan of `turn`, and what is made of it; what `recorded` knows goes before what the link knows. One that
    /// `is_behind` waited in the port for an unknown time.
    pub(crate) fn process_turn(
        &mut self,
        turn: &Turn<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Processed {
        self.recall(recorded);
        let period_us = recorded.stretched(micros(turn.period));
        if self.has_warned() {
            // Points that came last may show that what seemed near is the robot's own body.
            self.foresee(Some(&Begun::Turn(*turn)));
        }
        self.topics.begin_scan(turn.first, turn.last, turn.reasons, period_us);
        let (turning, beams) = (Turning::of(turn, self.family()), turn.beams);
        let decode = |scan: &mut Scan| turning.decode(beams, scan);
        let stands_for = limit(period_us);
        self.publish_scan(beams, Turning::len(beams), decode, stands_for, is_behind);
        self.early.confirm(turn.number);
        Processed { is_suspect: turn.reasons != 0, stands_for: Some(stands_for) }
    }

    /// Lets all that has a memory learn from a turn that is not published.
    pub(crate) fn learn_turn(&mut self, turn: &Turn<'_>) {
        let (turning, beams) = (Turning::of(turn, self.family()), turn.beams);
        self.learn_scan(Turning::len(beams), |scan: &mut Scan| turning.decode(beams, scan));
    }
}

pub(crate) fn micros(period: Nanos) -> u32 {
    u32::try_from(period / schema::MICROS).unwrap_or(u32::MAX)
}
