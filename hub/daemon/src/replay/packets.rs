//! Plays packets of a scanner whose head turns: each sample as it was recorded, and the turns that a session makes of them,
//! which lives in the time of the recording. So scans are those of the hub that recorded it, and stand to each other as
//! they did, however fast they are played.

use line::{Heard, Nanos, Received, Turn, suspect};
use lms::SILENCE;
use recording::{Frame, VirtualTime};
use schema::{Flags, State};

use super::recorded::Frames;
use super::{LONGEST_GAP, ReplayLink, STANDS};
use crate::driver::{self, Driver};
use crate::process_telegram::{RecordedContext, limit};
use crate::process_turn::micros;

/// What the last scan left.
#[derive(Clone, Copy)]
struct Verdict {
    /// Media time of that scan.
    of: Nanos,
    /// Until when it stands, by the clock of the recording, and as media time.
    until_ns: Nanos,
    until: Nanos,
}

/// When a frame is due.
#[derive(Clone, Copy)]
struct When {
    /// By the clock of the hub that recorded it.
    first: Nanos,
    last: Nanos,
    /// Media time of its last byte.
    media: Nanos,
}

/// Plays `frames` into the topics of `replay`. At the end, for how long the last verdict stands; nothing if the hub shall
/// end.
pub(super) fn play(replay: &mut ReplayLink<'_, '_>, frames: &Frames) -> Option<Option<Nanos>> {
    let play = replay.handle.play();
    let telegrams = match frames.read() {
        Ok(telegrams) => telegrams,
        Err(failure) => {
            tracing::warn!("{}: {}", replay.link.link.name, failure.message);
            return Some(None);
        }
    };
    let mut timeline = frames.timeline();
    let mut played: Option<VirtualTime<Driver>> = None;
    let (mut last_stamp, mut boot) = (0, None);
    let (mut verdict, mut standing): (Option<Verdict>, Option<Nanos>) = (None, None);
    let mut state = State::Starting;
    for frame in telegrams {
        let media = timeline.media(&frame);
        if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
            break;
        }
        let is_skipped = media < play.start_ns;
        let when = When::of(&frame, media);
        if let Some(silence) = verdict.take_if(|verdict| when.last > verdict.until_ns) {
            if is_skipped {
                replay.link.output.learn_silence();
            } else {
                let at = silence.until.clamp(play.start_ns, when.media.max(play.start_ns));
                let due = replay.wait_turn(played.as_ref().map(VirtualTime::session), at, state)?;
                replay.link.output.publish_stale(due.at);
                if when.media.saturating_sub(silence.of) >= SILENCE.max(silence.until - silence.of) {
                    state = State::Silent;
                }
            }
        }
        // Another life of the hub, which knew nothing at its start.
        let life = frame.header.map(|header| header.boot);
        let has_begun = played.is_some();
        if boot != life || !has_begun {
            boot = life;
            if let Some(played) = played.take() {
                replay.link.stats.close(played.session());
            }
            (verdict, state) = (None, State::Starting);
            match (has_begun, is_skipped) {
                (false, _) => {}
                (true, true) => replay.link.output.forget(),
                (true, false) => replay.restart(),
            }
        }
        let link = replay.link.link;
        let new = || VirtualTime::new(Driver::new(link, true, when.first), when.first);
        let session = played.get_or_insert_with(new);
        let at = if is_skipped {
            if !replay.pass() {
                return None;
            }
            None
        } else {
            let due = replay.wait_turn(Some(session.session()), when.media, state)?;
            last_stamp = due.at.max(last_stamp);
            let recorded = RecordedContext { stretch: due.stretch, ..recorded(&frame) };
            replay.link.publish_packets(&received(&frame, when, last_stamp), &recorded);
            replay.handle.played(media);
            Some((last_stamp, recorded))
        };
        // As on a line, where an error of the line is a doubt of the packets alone.
        session.session_mut().doubt(frame.reasons & !suspect::LINE_ERROR);
        session.take(when.last, &frame.telegram, |heard| {
            let driver::Heard::Turning(Heard::Turn(turn)) = heard else { return };
            let Some((at, recorded)) = at else { return replay.link.output.learn_turn(&turn) };
            let here = |stamp: Nanos| at.saturating_sub(when.last.saturating_sub(stamp));
            let wall_ns = recorded.wall_ns.map(|ns| ns.saturating_add(turn.first).saturating_sub(when.first));
            let (first, last) = (here(turn.first), here(turn.last));
            let recorded = RecordedContext { wall_ns, ..recorded };
            standing = replay.link.publish_turn(&Turn { first, last, ..turn }, &recorded, false).or(standing);
            replay.link.output.stand_until(STANDS);
            let stands = limit(micros(turn.period));
            let (until_ns, until) = (when.last.saturating_add(stands), when.media.saturating_add(stands));
            verdict = Some(Verdict { of: when.media, until_ns, until });
            state = State::Streaming;
        });
        if !is_skipped {
            replay.link.show(Some(session.session()), state, &replay.trouble);
        }
    }
    if let Some(played) = played {
        replay.link.stats.close(played.session());
    }
    Some(standing)
}

impl When {
    /// Of `frame`, at `media`. What has no stamps has a clock that begins at some time.
    fn of(frame: &Frame, media: Nanos) -> When {
        let begun = BEGIN.saturating_add(media);
        let (first, last) =
            frame.header.map_or((begun, begun), |header| (header.stamp_first_ns, header.stamp_last_ns));
        let took = last.saturating_sub(first);
        // A hub has it with its last byte.
        When { first, last: last.max(first), media: media.saturating_add(took.min(LONGEST_GAP)) }
    }
}

/// The sample of `frame`, whose last byte comes at `at` here.
fn received<'a>(frame: &'a Frame, when: When, at: Nanos) -> Received<'a, ()> {
    let header = frame.header;
    Received {
        bytes: &frame.telegram,
        message: (),
        first: at.saturating_sub(when.last - when.first),
        last: at,
        estimated: header.is_none_or(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
        reasons: frame.reasons,
    }
}

fn recorded(frame: &Frame) -> RecordedContext {
    RecordedContext {
        wall_ns: frame.wall_ns,
        flags: frame.header.map_or(0, |header| header.flags & Flags::SIMULATED),
        ..RecordedContext::default()
    }
}

/// The clock of what has no stamps begins when a machine has run for a while.
const BEGIN: Nanos = 10_000_000_000;
