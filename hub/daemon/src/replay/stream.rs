//! Plays bytes as they came down a line: they take the way that a line's bytes take, at the pace of the scans. What is
//! damaged in them is found out as on a line.

use lms::measured::{MEASURED, Measured};
use lms::session::Output;
use lms::variant::Variant;
use lms::{Nanos, Session};
use port::clock;
use schema::State;

use super::recorded::{Stream, read};
use super::{PlayerHandle, STANDS, Turns};
use crate::link::LinkThread;
use crate::process_telegram::RecordedContext;

/// Plays `stream` into the topics of `link`. At the end, for how long the last verdict stands; nothing if the hub shall
/// end.
pub(super) fn play(
    link: &mut LinkThread<'_>,
    stream: &Stream,
    handle: PlayerHandle<'_>,
    trouble: &str,
) -> Option<Option<Nanos>> {
    let play = handle.play();
    let mut turns = Turns::new(handle, trouble);
    let mut bytes = match stream.bytes() {
        Ok(bytes) => bytes,
        Err(failure) => {
            tracing::warn!("{}: {}", link.link.name, failure.message);
            return Some(None);
        }
    };
    let mut session = Session::new(link.settings(true), clock::now());
    let mut past = RecordedContext { mode: stream.mode, ..RecordedContext::default() };
    let (mut media, mut limit) = (0, None);
    let state = if stream.has_telegrams() { State::Streaming } else { State::Probing };
    loop {
        if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
            break;
        }
        let is_skipped = media < play.start_ns;
        if is_skipped {
            if !turns.pass(link) {
                return None;
            }
        } else {
            past.stretch = turns.wait(link, Some(&session), media, state)?.stretch;
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
        while let Output::Telegram(received) = session.poll_output() {
            let telegram = received.telegram;
            if is_skipped {
                link.learn(telegram, received.mode.or(past.mode));
            } else {
                limit = link.publish(&received, &past).or(limit);
                link.stale_at = STANDS;
                link.wake(schema::Wake::Telegram);
                handle.played(media);
            }
            if telegram.command() == MEASURED {
                let variant = Measured::decode(telegram).and_then(|it| Variant::of_beams(it.count()));
                media += stream.period(variant);
            }
        }
        if !is_skipped {
            link.show(Some(&session), state, trouble);
        }
        if len == 0 {
            break;
        }
    }
    link.account.close(&session);
    Some(limit)
}

/// Bytes given to the session at a time: less than a telegram, so that stamps stay near.
const PIECE: usize = 128;
