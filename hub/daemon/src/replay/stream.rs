//! Plays bytes as they came down a line: they take the way that a line's bytes take, at the pace of the scans. What is
//! damaged in them is found out as on a line.

use port::clock;
use scanhub_drivers::line::{Output, Session as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::measured::MEASURED;
use schema::{Nanos, State};

use super::recorded::{Stream, read};
use super::{ReplayLink, STANDS, variant_of};
use crate::driver::{Driver, Heard};
use crate::process_telegram::RecordedContext;

/// Plays `stream` into the topics of `replay`. At the end, for how long the last verdict stands; nothing if the hub shall
/// end.
pub(super) fn play(replay: &mut ReplayLink<'_, '_>, stream: &Stream) -> Option<Option<Nanos>> {
    let play = replay.handle.play();
    let mut bytes = match stream.bytes() {
        Ok(bytes) => bytes,
        Err(failure) => {
            tracing::warn!("{}: {}", replay.link.link.name, failure.message);
            return Some(None);
        }
    };
    let mut session = Driver::new(replay.link.link, true, clock::now());
    let mut recorded = RecordedContext { mode: stream.mode, ..RecordedContext::default() };
    let (mut media, mut limit) = (0, None);
    let state = if stream.has_telegrams() { State::Streaming } else { State::Probing };
    loop {
        if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
            break;
        }
        let is_skipped = media < play.start_ns;
        if is_skipped {
            if !replay.pass() {
                return None;
            }
        } else {
            recorded.stretch = replay.wait_turn(Some(&session), media, state)?.stretch;
        }
        let room = session.spare();
        let piece = room.len().min(PIECE);
        let len = read(&mut *bytes, &mut room[..piece]);
        let now = clock::now();
        session.commit(now, len);
        if len == 0 {
            // Nothing will come that could refute a telegram held back.
            session.handle_timeout(now + lms::framer::VETO_HOLD);
        }
        while let Output::Heard(Heard::Lms(received)) = session.poll_output() {
            let (is_scan, variant) = (
                received.message.telegram.command() == MEASURED,
                variant_of(received.message.reply.as_ref()),
            );
            if is_skipped {
                replay
                    .link
                    .output
                    .learn(received.message.reply.as_ref(), received.message.mode.or(recorded.mode));
            } else {
                limit = replay.link.publish(&received, &recorded, false).or(limit);
                replay.link.output.stand_until(STANDS);
                replay.handle.played(media);
            }
            if is_scan {
                media += stream.period(variant);
            }
        }
        if !is_skipped {
            replay.link.show(Some(&session), state, &replay.trouble);
        }
        if len == 0 {
            break;
        }
    }
    replay.link.stats.close(&session);
    Some(limit)
}

/// Bytes given to the session at a time: less than a telegram, so that stamps stay near.
const PIECE: usize = 128;
