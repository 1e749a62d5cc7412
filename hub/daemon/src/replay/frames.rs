//! Plays telegrams that are known to be whole: each comes once, in order, bit for bit, with what was known of it when it
//! was recorded. Silences are those of the recording, however fast it is played.

use lms::reply::Reply;
use lms::session::{Message, Received};
use lms::telegram::Telegram;
use lms::variant::Mode;
use lms::{Nanos, SILENCE};
use recording::Frame;
use schema::{Flags, Header, State};

use super::recorded::{Frames, told};
use super::{LONGEST_GAP, ReplayLink, STANDS, period, variant_of};
use crate::process_telegram::{self, RecordedContext};

/// What the last scan left.
#[derive(Clone, Copy)]
struct Verdict {
    /// Media time of that scan.
    of: Nanos,
    /// Until when it stands, by the clock of the recording, and as media time.
    until_ns: Nanos,
    until: Nanos,
}

/// Plays `frames` into the topics of `replay`. At the end, for how long the last verdict stands; nothing if the hub shall
/// end.
pub(super) fn play(replay: &mut ReplayLink<'_, '_>, frames: &Frames) -> Option<Option<Nanos>> {
    let play = replay.handle.play();
    let mut telegrams = match frames.read() {
        Ok(telegrams) => telegrams.peekable(),
        Err(failure) => {
            tracing::warn!("{}: {}", replay.link.link.name, failure.message);
            return Some(None);
        }
    };
    let (mut told_mode, mut understood_from) = (frames.first_mode(), 0);
    let mut timeline = frames.timeline();
    let (mut last_stamp, mut boot) = (0, None);
    let (mut verdict, mut limit): (Option<Verdict>, Option<Nanos>) = (None, None);
    let mut state = State::Streaming;
    while let Some(frame) = telegrams.next() {
        let media = timeline.media(&frame);
        if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
            break;
        }
        let is_skipped = media < play.start_ns;
        let header = frame.header;
        let took = header.map_or(0, |header| header.stamp_last_ns.saturating_sub(header.stamp_first_ns));
        // A hub has it with its last byte.
        let turn = media.saturating_add(took.min(LONGEST_GAP));
        if let Some(silence) = verdict.take_if(|verdict| is_silence(verdict, header.as_ref())) {
            if is_skipped {
                replay.link.output.learn_silence();
            } else {
                let due = replay.wait_turn(None, silence.until.clamp(play.start_ns, turn), state)?;
                replay.link.output.publish_stale(due.at);
                // A scan that was lost on the line makes the verdict old, and the sensor not silent.
                if turn.saturating_sub(silence.of) >= SILENCE.max(silence.until - silence.of) {
                    state = State::Silent;
                }
            }
        }
        // Another life of the hub, which knew nothing at its start.
        if let Some(header) = header.filter(|header| boot != Some(header.boot)) {
            if boot.replace(header.boot).is_some() {
                verdict = None;
                if is_skipped { replay.link.output.forget() } else { replay.restart() }
            }
            understood_from = frames.understood_from(&header);
        }
        let checked = Telegram::check(&frame.telegram);
        let reply = checked.and_then(Reply::decode);
        told_mode = reply.as_ref().and_then(told).unwrap_or(told_mode);
        let mode = told_mode.filter(|_| header.is_none_or(|header| header.seq >= understood_from));
        let Some(telegram) = checked else { continue };
        if is_skipped {
            if !replay.pass() {
                return None;
            }
            replay.link.output.learn(reply.as_ref(), mode);
        } else {
            let due = replay.wait_turn(None, turn, state)?;
            let at = due.at.max(last_stamp);
            let received = Received {
                bytes: telegram.bytes(),
                message: Message { telegram, reply, mode, offset: 0 },
                first: at.saturating_sub(took),
                last: at,
                estimated: header.is_some_and(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
                reasons: header.map_or(0, |header| header.reasons),
            };
            last_stamp = at;
            let gap = telegrams.peek().and_then(|next| gap(&frame, next));
            replay.link.stats.recall(telegram, reply.as_ref(), mode);
            let recorded = recorded(&frame, mode, gap, due.stretch);
            limit = replay.link.publish(&received, &recorded, false).or(limit);
            replay.link.output.stand_until(STANDS);
            replay.handle.played(media);
            state = State::Streaming;
            replay.link.show(None, state, &replay.trouble);
        }
        // One whose values nobody could read had none.
        if frame.is_scan() && mode.is_some_and(Mode::has_ranges) {
            verdict = header.map(|header| stands(&header, media)).or(verdict);
        }
        if !frames.has_stamps() && frame.is_scan() {
            timeline.pass(period(variant_of(reply.as_ref())));
        }
    }
    Some(limit)
}

fn recorded(frame: &Frame, mode: Option<Mode>, gap: Option<Nanos>, stretch: f64) -> RecordedContext {
    RecordedContext {
        mode,
        wall_ns: frame.wall_ns,
        period_us: frame.header.map(|header| header.period_us),
        gap_us: gap.map_or(0, |gap| (gap / 1000) as u32),
        stretch,
        flags: frame.header.map_or(0, |header| header.flags & Flags::SIMULATED),
    }
}

/// The time to the next scan of a log, which may leave scans out: so long nothing newer can be known.
fn gap(frame: &Frame, next: &Frame) -> Option<Nanos> {
    if frame.header.is_some() {
        return None;
    }
    let (from, to) = frame.wall_ns.zip(next.wall_ns)?;
    Some(to.saturating_sub(from).min(LONGEST_GAP))
}

/// For how long the verdict on the scan of `header`, at `media`, stood in the hub that recorded it.
fn stands(header: &Header, media: Nanos) -> Verdict {
    let published = header.stamp_last_ns.saturating_add(header.hub_time_ns().unwrap_or(0));
    let until_ns = published.saturating_add(process_telegram::limit(header.period_us));
    let after = until_ns.saturating_sub(header.stamp_first_ns);
    Verdict { of: media, until_ns, until: media.saturating_add(after) }
}

/// Whether the verdict was over when the telegram of `header` came.
fn is_silence(verdict: &Verdict, header: Option<&Header>) -> bool {
    header.is_some_and(|header| header.stamp_last_ns > verdict.until_ns)
}
