//! Plays a recording frame by frame: each telegram, or group of packets, once, in order and bit for bit, with the header that
//! was recorded. Silences are those of the recording, however fast it is played.
//!
//! A telegram of an LMS is a scan by itself. The packets of a rotating scanner pass through a session that runs in the time of
//! the recording. It builds the same scans as the hub that recorded them, with the same times between them.

use recording::{Frame, VirtualTime};
use scanhub_drivers::line::{Heard, Received, Turn, suspect};
use scanhub_drivers::lms::SILENCE;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::session::Message;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::Mode;
use schema::{Flags, Header, Nanos, State};

use super::recorded::{Frames, told};
use super::{LONGEST_GAP, ReplayLink, STANDS, period, variant_of};
use crate::driver::{self, Driver};
use crate::player::Due;
use crate::process_telegram::{RecordedContext, limit};
use crate::process_turn::micros;

/// Plays `frames` into the topics of `replay`. Returns how long the last verdict stays valid at the end; `None` if the hub
/// must end.
pub(super) fn play(replay: &mut ReplayLink<'_, '_>, frames: &Frames) -> Option<Option<Nanos>> {
    let play = replay.handle.play();
    let mut read = match frames.read() {
        Ok(read) => read.peekable(),
        Err(failure) => {
            tracing::warn!("{}: {}", replay.link.link.name, failure.message);
            return Some(None);
        }
    };
    let mut timeline = frames.timeline();
    let mut lap = Lap {
        frames,
        start_ns: play.start_ns,
        run: None,
        has_begun: false,
        mode: frames.first_mode(),
        understood_from: 0,
        session: None,
        last_stamp: 0,
        verdict: None,
        limit: None,
        state: if frames.is_lms { State::Streaming } else { State::Starting },
    };
    while let Some(frame) = read.next() {
        let media = timeline.media(&frame);
        if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
            break;
        }
        let when = When::of(&frame, media, media < play.start_ns);
        lap.note_silence(replay, when)?;
        lap.note_run(replay, &frame, when);
        if !frames.is_lms {
            lap.play_packets(replay, &frame, when)?;
        } else if let Some(telegram) = Telegram::check(&frame.telegram) {
            let reply = Reply::decode(telegram);
            lap.play_telegram(replay, (&frame, read.peek()), (telegram, reply), when)?;
            if !frames.has_stamps() && frame.is_scan() {
                timeline.pass(period(variant_of(reply.as_ref())));
            }
        }
    }
    if let Some(session) = lap.session {
        replay.link.stats.close(session.session());
    }
    Some(lap.limit)
}

/// State while the recording is played once.
struct Lap<'f> {
    frames: &'f Frames,
    /// Media time before which frames are only learned from, not published.
    start_ns: Nanos,
    /// Run of the hub that recorded the last frame.
    run: Option<u64>,
    has_begun: bool,
    /// For an LMS: the measuring mode.
    mode: Option<Mode>,
    /// For an LMS: number of the first telegram whose mode the hub knew in this run.
    understood_from: u64,
    /// For a rotating scanner: the session of this run.
    session: Option<VirtualTime<Driver>>,
    /// Stamp of the last published frame; stamps never go back.
    last_stamp: Nanos,
    verdict: Option<Verdict>,
    /// Duration for which the last published verdict stays valid.
    limit: Option<Nanos>,
    state: State,
}

/// Validity of the verdict on the last scan.
#[derive(Clone, Copy)]
struct Verdict {
    /// Media time of that scan.
    of: Nanos,
    /// End of its validity, by the clock of the hub that recorded it.
    until_ns: Nanos,
    /// That end as media time.
    until: Nanos,
}

/// Times of a frame.
#[derive(Clone, Copy)]
struct When {
    /// Stamps by the clock of the hub that recorded it.
    first: Nanos,
    last: Nanos,
    /// Media time of its first byte.
    begin: Nanos,
    /// Media time of its last byte.
    media: Nanos,
    /// Whether it is before the start of the played part.
    is_skipped: bool,
}

impl Lap<'_> {
    /// Publishes that the last verdict is stale, if its validity ended before the frame at `when`. Returns `None` if the hub
    /// must end.
    fn note_silence(&mut self, replay: &mut ReplayLink<'_, '_>, when: When) -> Option<()> {
        let Some(silence) = self.verdict.take_if(|verdict| when.last > verdict.until_ns) else {
            return Some(());
        };
        if when.is_skipped {
            replay.link.output.learn_silence();
            return Some(());
        }
        let at = silence.until.clamp(self.start_ns, when.media);
        let due = replay.wait_turn(self.session.as_ref().map(VirtualTime::session), at, self.state)?;
        replay.link.output.publish_stale(due.at);
        // A scan that was lost on the line makes the verdict stale, and the sensor not silent.
        if when.media.saturating_sub(silence.of) >= SILENCE.max(silence.until - silence.of) {
            self.state = State::Silent;
        }
        Some(())
    }

    /// Forgets everything if another run of the hub recorded `frame`, because a hub knows nothing at its start.
    fn note_run(&mut self, replay: &mut ReplayLink<'_, '_>, frame: &Frame, when: When) {
        let run = frame.header.map(|header| header.boot);
        if !self.has_begun || self.run != run {
            if std::mem::replace(&mut self.has_begun, true) {
                self.verdict = None;
                if when.is_skipped { replay.link.output.forget() } else { replay.restart() }
            }
            if let Some(session) = self.session.take() {
                replay.link.stats.close(session.session());
                self.state = State::Starting;
            }
            self.run = run;
            self.understood_from = frame.header.map_or(0, |header| self.frames.understood_from(&header));
        }
        if !self.frames.is_lms && self.session.is_none() {
            let driver = Driver::new(replay.link.link, true, when.first);
            self.session = Some(VirtualTime::new(driver, when.first));
        }
    }

    /// Waits until the frame at `when` is due: `Some(None)` if it is skipped, `None` if the hub must end.
    fn wait(&mut self, replay: &mut ReplayLink<'_, '_>, when: When) -> Option<Option<Due>> {
        if when.is_skipped {
            return replay.pass().then_some(None);
        }
        let session = self.session.as_ref().map(VirtualTime::session);
        let due = replay.wait_turn(session, when.media, self.state)?;
        self.last_stamp = due.at.max(self.last_stamp);
        Some(Some(due))
    }

    /// Plays a telegram of an LMS; the frame after it is known, too. Returns `None` if the hub must end.
    fn play_telegram(
        &mut self,
        replay: &mut ReplayLink<'_, '_>,
        (frame, next): (&Frame, Option<&Frame>),
        (telegram, reply): (Telegram<'_>, Option<Reply<'_>>),
        when: When,
    ) -> Option<()> {
        let header = frame.header;
        self.mode = reply.as_ref().and_then(told).unwrap_or(self.mode);
        let mode = self.mode.filter(|_| header.is_none_or(|header| header.seq >= self.understood_from));
        match self.wait(replay, when)? {
            None => replay.link.output.learn(reply.as_ref(), mode),
            Some(due) => {
                let at = self.last_stamp;
                let received = Received {
                    bytes: telegram.bytes(),
                    message: Message { telegram, reply, mode, baud: replay.link.link.baud, offset: 0 },
                    first: at.saturating_sub(when.last - when.first),
                    last: at,
                    estimated: header.is_some_and(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
                    reasons: frame.reasons,
                };
                replay.link.stats.recall(telegram, reply.as_ref(), mode);
                let gap = next.and_then(|next| gap(frame, next));
                let recorded = RecordedContext {
                    mode,
                    period_us: header.map(|header| header.period_us),
                    gap_us: gap.map_or(0, |gap| (gap / 1000) as u32),
                    stretch: due.stretch,
                    ..recorded(frame)
                };
                self.limit = replay.link.publish(&received, &recorded, false).or(self.limit);
                replay.link.output.stand_until(STANDS);
                replay.handle.played(when.begin);
                self.state = State::Streaming;
                replay.link.show(None, self.state, &replay.trouble);
            }
        }
        // A scan whose values could not be read had no verdict.
        if frame.is_scan() && mode.is_some_and(Mode::has_ranges) {
            self.verdict = header.map(|header| Verdict::of(&header, when.begin)).or(self.verdict);
        }
        Some(())
    }

    /// Plays packets of a rotating scanner, and the revolutions that end with them. Returns `None` if the hub must end.
    fn play_packets(&mut self, replay: &mut ReplayLink<'_, '_>, frame: &Frame, when: When) -> Option<()> {
        let at = self.wait(replay, when)?.map(|due| {
            let recorded = RecordedContext { stretch: due.stretch, ..recorded(frame) };
            (self.last_stamp, recorded)
        });
        if let Some((at, recorded)) = &at {
            let received = Received {
                bytes: &frame.telegram,
                message: (),
                first: at.saturating_sub(when.last - when.first),
                last: *at,
                estimated: frame.header.is_none_or(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
                reasons: frame.reasons,
            };
            replay.link.publish_packets(&received, recorded);
            replay.handle.played(when.begin);
        }
        let Lap { session, verdict, limit: last_limit, state, .. } = self;
        let session = session.as_mut()?;
        // As on a line, an error of the line concerns the packets alone, not the revolution.
        session.session_mut().doubt(frame.reasons & !suspect::LINE_ERROR);
        session.take(when.last, &frame.telegram, |heard| {
            let driver::Heard::Turning(Heard::Turn(turn)) = heard else { return };
            let Some((at, recorded)) = at else { return replay.link.output.learn_turn(&turn) };
            let here = |stamp: Nanos| at.saturating_sub(when.last.saturating_sub(stamp));
            let wall_ns = recorded.wall_ns.map(|ns| ns.saturating_add(turn.first).saturating_sub(when.first));
            let (first, last) = (here(turn.first), here(turn.last));
            let recorded = RecordedContext { wall_ns, ..recorded };
            let published = replay.link.publish_turn(&Turn { first, last, ..turn }, &recorded, false);
            *last_limit = published.or(*last_limit);
            replay.link.output.stand_until(STANDS);
            let valid = limit(micros(turn.period));
            let (until_ns, until) = (when.last.saturating_add(valid), when.media.saturating_add(valid));
            *verdict = Some(Verdict { of: when.media, until_ns, until });
            *state = State::Streaming;
        });
        if !when.is_skipped {
            replay.link.show(Some(session.session()), *state, &replay.trouble);
        }
        Some(())
    }
}

impl Verdict {
    /// Returns how long the verdict on the scan with `header`, at `media`, was valid in the hub that recorded it.
    fn of(header: &Header, media: Nanos) -> Verdict {
        let published = header.stamp_last_ns.saturating_add(header.hub_time_ns().unwrap_or(0));
        let until_ns = published.saturating_add(limit(header.period_us));
        let after = until_ns.saturating_sub(header.stamp_first_ns);
        Verdict { of: media, until_ns, until: media.saturating_add(after) }
    }
}

impl When {
    /// Returns the times of `frame`, which begins at `begin`. A frame without stamps has a clock that starts at [`BEGIN`].
    fn of(frame: &Frame, begin: Nanos, is_skipped: bool) -> When {
        let begun = BEGIN.saturating_add(begin);
        let (first, last) =
            frame.header.map_or((begun, begun), |header| (header.stamp_first_ns, header.stamp_last_ns));
        let took = last.saturating_sub(first);
        // A hub has a frame with its last byte.
        let media = begin.saturating_add(took.min(LONGEST_GAP));
        When { first, last: last.max(first), begin, media, is_skipped }
    }
}

fn recorded(frame: &Frame) -> RecordedContext {
    RecordedContext {
        wall_ns: frame.wall_ns,
        flags: frame.header.map_or(0, |header| header.flags & Flags::SIMULATED),
        ..RecordedContext::default()
    }
}

/// Returns the time to the next scan of a log, which may leave scans out. Until then, nothing newer can be known.
fn gap(frame: &Frame, next: &Frame) -> Option<Nanos> {
    if frame.header.is_some() {
        return None;
    }
    let (from, to) = frame.wall_ns.zip(next.wall_ns)?;
    Some(to.saturating_sub(from).min(LONGEST_GAP))
}

/// Time at which the clock of a frame without stamps starts: that of a machine that has run for a while.
const BEGIN: Nanos = 10_000_000_000;
