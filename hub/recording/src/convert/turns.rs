//! Scans of a scanner whose head turns, from its packets: as the hub makes them. Refuses to know where packets are from.

use line::family::Wanted;
use line::{Heard, Nanos};
use scanner::Turning;
use schema::{Failure, Family, Header, Quality, Scan};

use crate::{Recording, VirtualTime};

/// The turns of one scanner.
pub(super) struct Turns {
    family: Family,
    wanted: Wanted,
    /// In the life of the hub with this number.
    session: Option<(u64, VirtualTime<scanner::Session>)>,
    scan: Box<Scan>,
}

impl Turns {
    /// Of the only sensor of `recording`; nothing if its head does not turn.
    pub(super) fn of(recording: &Recording) -> Result<Option<Turns>, Failure> {
        let Some(family) = recording.family().filter(|family| *family != Family::Lms) else {
            return Ok(None);
        };
        let model = recording.model()?.map(|model| model.name);
        let (beams, mode) = (recording.beams(), recording.contents().way);
        let wanted = Wanted { model, mode, beams, fixed_rate: true, listen_only: true, ..Wanted::default() };
        Ok(Some(Turns { family, wanted, session: None, scan: Box::default() }))
    }

    /// Takes the packets of a sample with this `header`; `tell` gets each scan that is whole with them, with its own.
    pub(super) fn each(
        &mut self,
        header: &Header,
        packets: &[u8],
        mut tell: impl FnMut(Header, &Scan) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        let Turns { family, wanted, session, scan } = self;
        // Another life of the hub has another clock.
        if session.as_ref().is_none_or(|(boot, _)| *boot != header.boot) {
            let begin = scanner::Session::begin(*family, *wanted, header.stamp_first_ns);
            *session = begin.map(|begin| (header.boot, VirtualTime::new(begin, header.stamp_first_ns)));
        }
        let Some((_, session)) = session else { return Ok(()) };
        session.session_mut().doubt(header.reasons & !line::suspect::LINE_ERROR);
        let mut told = Ok(());
        session.take(header.stamp_last_ns, packets, |heard| {
            let Heard::Turn(turn) = heard else { return };
            let turning = Turning {
                family: *family,
                points: turn.points,
                period_ns: turn.period,
                points_per_second: turn.points_per_second,
                incomplete: turn.incomplete,
            };
            Scan::grow(scan, Turning::len(turn.beams));
            turning.decode(turn.beams, scan);
            let quality = if turn.reasons == 0 { Quality::Clean } else { Quality::Suspect };
            let wall_ns = |stamp: Nanos| (header.wall_ns + stamp).saturating_sub(header.stamp_first_ns);
            let header = Header {
                stamp_first_ns: turn.first,
                stamp_last_ns: turn.last,
                wall_ns: wall_ns(turn.first),
                period_us: u32::try_from(turn.period / line::MICROS).unwrap_or(u32::MAX),
                quality: quality as u8,
                reasons: turn.reasons,
                hub_time: [0; 3],
                ..*header
            };
            if told.is_ok() {
                told = tell(header, scan);
            }
        });
        told
    }
}
