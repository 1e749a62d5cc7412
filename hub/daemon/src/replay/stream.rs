//! Plays bytes as they came down a line: they take the way that a line's bytes take, at the pace of the scans. What is
//! damaged in them is found out as on a line.

use port::clock;
use scanhub_drivers::line::{Event, Output, Protocol as _};
use scanhub_drivers::{PortSession, Settings};
use schema::{MILLIS, Nanos, State};

use super::recorded::{Stream, read};
use super::{ReplayLink, STANDS};
use crate::link_output::RecordedMetadata;

/// Plays `stream` into the topics of `replay`. At the end, for how long the last verdict stands; nothing if the hub
/// shall end.
pub(super) fn play(replay: &mut ReplayLink<'_, '_>, stream: &Stream) -> Option<Option<Nanos>> {
    let play = replay.handle.play();
    let mut bytes = match stream.bytes() {
        Ok(bytes) => bytes,
        Err(failure) => {
            tracing::warn!("{}: {}", replay.link.link.name, failure.message);
            return Some(None);
        }
    };
    let link = replay.link.link;
    let settings = Settings { mode_number: stream.mode, ..link.settings() };
    let mut session = PortSession::begin(Some(stream.family), &settings, None, clock::now());
    let mut recorded = RecordedMetadata::default();
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
            // No more bytes can refute a telegram that is held back.
            session.handle_timeout(now + IDLE);
        }
        while let Output::Event(Event::Telegram(received)) = session.poll_output() {
            if !is_skipped {
                recorded.measured_ns = Some(media);
                limit = replay.link.publish(&received, &recorded, false).or(limit);
                replay.link.output.extend_verdict(STANDS);
                replay.handle.played(media);
            } else if let Some(scan) = received.whole.and_then(|whole| whole.scan) {
                replay.link.output.learn(&scan, media);
            }
            if !received.is_reply {
                media += stream.period(received.whole.map_or(0, |whole| whole.beams));
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
/// Time without a byte after which a session no longer holds a telegram back.
const IDLE: Nanos = 100 * MILLIS;
