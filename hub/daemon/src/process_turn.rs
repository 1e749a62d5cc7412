//! What a link makes of a scanner whose head turns and that sends packets: the packets themselves, and of each turn a scan and
//! what follows from it. Refuses to know how packets become turns.

use ld::{Packets, Turn};
use line::Received;
use lms::Nanos;
use scanner::Turning;
use schema::{Family, Scan};

use crate::process_telegram::{LinkOutput, Processed, limit};
use crate::surroundings::Surroundings;

impl<S: Surroundings> LinkOutput<'_, S> {
    /// Publishes packets that arrived together.
    pub(crate) fn process_packets(&mut self, received: &Received<'_, Packets>) -> Processed {
        // Packets are no scans: how long one takes, their turn says.
        self.topics.telegram(received, received.reasons, 0);
        Processed { is_suspect: received.reasons != 0, stands_for: None }
    }

    /// Publishes the scan of `turn`, and what is made of it. One that `is_behind` waited in the port for an unknown time.
    pub(crate) fn process_turn(&mut self, turn: &Turn<'_>, is_behind: bool) -> Processed {
        let beams = turn.beams;
        let turning = Turning {
            family: Family::Ld,
            points: turn.points,
            period_ns: turn.period,
            points_per_second: turn.points_per_second,
            incomplete: turn.incomplete,
        };
        self.topics.begin_scan(turn.first, turn.last, turn.reasons, micros(turn.period));
        let decode = |scan: &mut Scan| turning.decode(beams, scan);
        let stands_for = limit(micros(turn.period));
        self.publish_scan(beams, Turning::len(beams), decode, stands_for, is_behind);
        Processed { is_suspect: turn.reasons != 0, stands_for: Some(stands_for) }
    }
}

fn micros(period: Nanos) -> u32 {
    u32::try_from(period / line::MICROS).unwrap_or(u32::MAX)
}
