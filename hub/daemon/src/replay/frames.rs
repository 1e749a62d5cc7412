//! Plays a recording frame by frame: each telegram, or group of packets, once, in order and bit for bit, with the
//! header that was recorded. The link reports the silences of the recording, at any rate of the replay.
//!
//! A whole telegram is a scan or a reply by itself. The packets of a rotating scanner pass through a session that runs
//! in the time of the recording. The session builds the same scans as the hub that recorded the packets, with the same
//! intervals between the scans.

use std::iter::Peekable;

use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Event, RawScan, ReceivedTelegram, ScannerSession as _, suspect};
use scanhub_recording::{Frame, VirtualTime};
use scanhub_schema::{Failure, Flags, Header, MILLIS, Nanos, State};

use super::recorded::{Frames, Timeline};
use super::{MAX_GAP, MAX_STAMP, ReplayLink, ReplayTiming, VALID_UNTIL_NEXT};
use crate::link_output::{RecordedMetadata, micros, verdict_lifetime};
use crate::platform::Platform;
use crate::player::DueTime;

/// One pass through telegrams or packets.
pub(crate) struct FramesLap<'f> {
    pub(super) frames: &'f Frames,
    read: Peekable<Box<dyn Iterator<Item = Frame> + Send>>,
    timeline: Timeline,
    /// The next frame and its media time; `None` at the end.
    next: Option<(Frame, Nanos)>,
    /// Media times between which frames are published. The processors only learn from earlier frames.
    start_ns: Nanos,
    end_ns: Option<Nanos>,
    /// Number of frames that were read.
    pub(super) read_frames: u64,
    /// Number of frames that a scanner of another family has sent. They are not played.
    foreign_frames: u64,
    /// Run of the hub that recorded the last frame.
    run: Option<u64>,
    has_begun: bool,
    /// Number of the first whole telegram whose values the hub could read in this run.
    understood_from: u64,
    /// The session that reads all whole telegrams, or the packets of this run.
    session: Option<VirtualTime<PortSession>>,
    /// Stamp of the last published frame; stamps never go back.
    last_stamp: Nanos,
    verdict: Option<PendingVerdict>,
    /// Duration for which the last published verdict stays valid.
    verdict_lifetime: Option<Nanos>,
    state: State,
}

/// Validity of the verdict on the last scan.
#[derive(Clone, Copy)]
struct PendingVerdict {
    /// Media time of that scan.
    media: Nanos,
    /// End of its validity, by the clock of the hub that recorded it.
    until_ns: Nanos,
    /// End of its validity, as media time.
    until: Nanos,
}

/// Times of a frame.
#[derive(Clone, Copy)]
struct FrameTime {
    /// Stamps of its first and last byte, by the clock of the hub that recorded it.
    first: Nanos,
    last: Nanos,
    /// Media time of its first byte.
    begin: Nanos,
    /// Media time of its last byte.
    media: Nanos,
    /// Whether the frame is before the start of the played part.
    is_skipped: bool,
}

impl<'f> FramesLap<'f> {
    /// Starts a pass of `replay` through `frames`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`](scanhub_schema::Kind) if the file cannot be opened.
    pub(super) fn new<S: Platform>(
        replay: &ReplayLink<'_, S, impl ReplayTiming<S>>,
        frames: &'f Frames,
    ) -> Result<Self, Failure> {
        let (start_ns, end_ns) = replay.timing.range();
        let mut lap = FramesLap {
            frames,
            read: frames.read()?.peekable(),
            timeline: frames.timeline(),
            next: None,
            start_ns,
            end_ns,
            read_frames: 0,
            foreign_frames: 0,
            run: None,
            has_begun: false,
            understood_from: 0,
            session: None,
            last_stamp: 0,
            verdict: None,
            verdict_lifetime: None,
            state: if frames.is_whole { State::Streaming } else { State::Starting },
        };
        lap.advance();
        Ok(lap)
    }

    pub(super) fn next_media(&self) -> Option<Nanos> {
        let time = self.next_time()?;
        let stale = self.verdict.filter(|verdict| verdict.until_ns < time.last && !time.is_skipped);
        Some(stale.map_or(time.media, |verdict| self.stale_at(&verdict, time)))
    }

    /// Returns the times of the next frame; `None` at the end.
    fn next_time(&self) -> Option<FrameTime> {
        let (frame, media) = self.next.as_ref()?;
        Some(FrameTime::of(frame, *media, *media < self.start_ns))
    }

    /// Returns the media time at which `verdict` becomes stale, but at the latest the end of the frame at `time`.
    fn stale_at(&self, verdict: &PendingVerdict, time: FrameTime) -> Nanos {
        verdict.until.clamp(self.start_ns, time.media)
    }

    pub(super) fn step<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
    ) -> Option<()> {
        let Some(time) = self.next_time() else { return Some(()) };
        if let Some(verdict) = self.verdict.take_if(|verdict| verdict.until_ns < time.last) {
            return self.note_silence(replay, verdict, time);
        }
        let Some((frame, _)) = self.next.take() else { return Some(()) };
        self.note_run(replay, &frame, time);
        if self.frames.is_whole {
            let beams = self.play_telegram(replay, &frame, time)?;
            if !self.frames.has_stamps() && frame.is_scan() {
                self.timeline.advance(self.frames.period(beams));
            }
        } else {
            self.play_packets(replay, &frame, time)?;
        }
        self.advance();
        Some(())
    }

    /// Returns how long the last verdict stays valid.
    pub(super) fn end<S: Platform>(
        &self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
    ) -> Option<Nanos> {
        if self.foreign_frames > 0 {
            tracing::warn!(
                "{}: {} telegrams are dropped, because their scanner is not of family {}",
                replay.link.link.name,
                self.foreign_frames,
                self.frames.family.name()
            );
        }
        if let Some(session) = self.shown_session() {
            replay.link.stats.close_session(session);
        }
        self.verdict_lifetime
    }

    /// Reads the next frame of the scanner's family.
    fn advance(&mut self) {
        self.next = None;
        for frame in self.read.by_ref() {
            self.read_frames += 1;
            if frame.header.is_some_and(|header| header.family != self.frames.family as u8) {
                self.foreign_frames += 1;
                continue;
            }
            let media = self.timeline.media(&frame);
            if self.end_ns.is_none_or(|end_ns| media < end_ns) {
                self.next = Some((frame, media));
            }
            return;
        }
    }

    /// Publishes that `verdict` is stale if it is not valid until the frame at `time`. Returns `None` if the hub must
    /// end.
    fn note_silence<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
        verdict: PendingVerdict,
        time: FrameTime,
    ) -> Option<()> {
        if time.is_skipped {
            replay.link.output.note_silence();
            return Some(());
        }
        let at = self.stale_at(&verdict, time);
        let due = replay.wait_until_due(self.shown_session(), at, self.state)?;
        replay.link.output.publish_stale(due.at);
        // If a scan was lost on the line, the verdict becomes stale, but the sensor is not silent.
        if time.media.saturating_sub(verdict.media) >= SILENCE_TIME.max(verdict.until - verdict.media) {
            self.state = State::Silent;
        }
        Some(())
    }

    /// Resets the processors if another run of the hub recorded `frame`, because a hub starts without learned data.
    fn note_run<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
        frame: &Frame,
        time: FrameTime,
    ) {
        let run = frame.header.map(|header| header.boot);
        if !self.has_begun || self.run != run {
            if std::mem::replace(&mut self.has_begun, true) {
                self.verdict = None;
                if time.is_skipped { replay.link.output.reset() } else { replay.restart() }
            }
            if let Some(session) = self.shown_session() {
                replay.link.stats.close_session(session);
                (self.session, self.state) = (None, State::Starting);
            }
            self.run = run;
            self.understood_from = frame.header.map_or(0, |header| self.frames.first_understood(&header));
        }
        self.session.get_or_insert_with(|| {
            let link = replay.link.link;
            let settings = self.frames.settings(link);
            let session = PortSession::begin(Some(self.frames.family), &settings, None, time.first);
            VirtualTime::new(session, time.first)
        });
    }

    /// Returns the session that the status describes. A session that reads whole telegrams only decodes them.
    fn shown_session(&self) -> Option<&PortSession> {
        self.session.as_ref().filter(|_| !self.frames.is_whole).map(VirtualTime::session)
    }

    /// Waits until the frame at `time` is due. Returns `Some(None)` if it is skipped, and `None` if the hub must end.
    fn wait<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
        time: FrameTime,
    ) -> Option<Option<DueTime>> {
        if time.is_skipped {
            return replay.continue_skipping().then_some(None);
        }
        let due = replay.wait_until_due(self.shown_session(), time.media, self.state)?;
        self.last_stamp = due.at.max(self.last_stamp);
        Some(Some(due))
    }

    /// Plays a whole telegram. Returns the number of beams of its measured data, or
    /// `None` if the hub must end.
    fn play_telegram<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
        frame: &Frame,
        when: FrameTime,
    ) -> Option<usize> {
        let due = self.wait(replay, when)?;
        let header = frame.header;
        let is_readable = header.is_none_or(|header| header.seq >= self.understood_from);
        let status = due.map(|_| replay.link.stats.status_mut());
        let session = self.session.as_mut()?.session_mut();
        let Some(received) = session.read_recorded(&frame.telegram, is_readable, status) else {
            return Some(0);
        };
        let whole = received.contents?;
        match due {
            None => whole.scan.iter().for_each(|scan| replay.link.output.learn(scan, when.first)),
            Some(due) => {
                let at = self.last_stamp;
                let received = ReceivedTelegram {
                    first: at.saturating_sub(when.last - when.first),
                    last: at,
                    estimated: header.is_some_and(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
                    reasons: received.reasons | frame.reasons,
                    ..received
                };
                replay.link.stats.note_recorded(received.bytes.len());
                let gap = self.read.peek().and_then(|next| time_to_next(frame, next));
                let recorded = RecordedMetadata {
                    period_us: header.map(|header| header.period_us),
                    gap_us: gap.map_or(0, |gap| (gap / 1000) as u32),
                    stretch: due.stretch,
                    measured_ns: Some(when.first),
                    ..recorded_metadata(frame)
                };
                self.verdict_lifetime =
                    replay.link.publish(&received, &recorded, false).or(self.verdict_lifetime);
                replay.link.output.extend_verdict(VALID_UNTIL_NEXT);
                replay.timing.note_played(when.begin);
                self.state = State::Streaming;
                replay.link.publish_status(None, self.state, &replay.problem);
            }
        }
        // A scan whose values could not be read had no verdict.
        if whole.scan.is_some() {
            self.verdict = header.map(|header| PendingVerdict::of(&header, when.begin)).or(self.verdict);
        }
        Some(whole.beams)
    }

    /// Plays packets of a rotating scanner, and the revolutions that end with them. Returns `None` if the hub must end.
    fn play_packets<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
        frame: &Frame,
        when: FrameTime,
    ) -> Option<()> {
        let at = self.wait(replay, when)?.map(|due| {
            let recorded = RecordedMetadata { stretch: due.stretch, ..recorded_metadata(frame) };
            (self.last_stamp, recorded)
        });
        if let Some((at, recorded)) = &at {
            let received = ReceivedTelegram {
                bytes: &frame.telegram,
                first: at.saturating_sub(when.last - when.first),
                last: *at,
                estimated: frame.header.is_none_or(|header| header.flags & Flags::STAMP_ESTIMATED != 0),
                reasons: frame.reasons,
                count: 0,
                is_checked: false,
                is_reply: false,
                contents: None,
            };
            replay.link.publish(&received, recorded, false);
            replay.timing.note_played(when.begin);
        }
        let FramesLap { session, verdict, verdict_lifetime: last_limit, state, .. } = self;
        let session = session.as_mut()?;
        // As in the hub, an error of the line affects only the packets, not the revolution.
        session.session_mut().mark_suspect(frame.reasons & !suspect::LINE_ERROR);
        session.take(when.last, &frame.telegram, |event| {
            let Event::Scan(scan) = event else { return };
            let Some((at, recorded)) = at else { return replay.link.output.learn(&scan, scan.first) };
            let in_media_time = |stamp: Nanos| at.saturating_sub(when.last.saturating_sub(stamp));
            let wall_ns = recorded.wall_ns.map(|ns| ns.saturating_add(scan.first).saturating_sub(when.first));
            let (first, last) = (in_media_time(scan.first), in_media_time(scan.last));
            let recorded = RecordedMetadata { wall_ns, measured_ns: Some(scan.first), ..recorded };
            *last_limit = Some(replay.link.publish_scan(&RawScan { first, last, ..scan }, &recorded, false));
            replay.link.output.extend_verdict(VALID_UNTIL_NEXT);
            let valid = verdict_lifetime(micros(scan.period));
            let (until_ns, until) = (when.last.saturating_add(valid), when.media.saturating_add(valid));
            *verdict = Some(PendingVerdict { media: when.media, until_ns, until });
            *state = State::Streaming;
        });
        if !when.is_skipped {
            replay.link.publish_status(Some(session.session()), *state, &replay.problem);
        }
        Some(())
    }
}

impl PendingVerdict {
    /// Returns how long the verdict on the scan with `header`, at `media`, was valid in the hub that recorded it.
    fn of(header: &Header, media: Nanos) -> PendingVerdict {
        let published = header.stamp_last_ns.saturating_add(header.hub_time_ns().unwrap_or(0));
        let until_ns = published.saturating_add(verdict_lifetime(header.period_us));
        let after = until_ns.saturating_sub(header.stamp_first_ns);
        PendingVerdict { media, until_ns, until: media.saturating_add(after) }
    }
}

impl FrameTime {
    /// Returns the times of `frame`, which begins at `begin`. A frame without stamps has a clock that starts at
    /// [`CLOCK_START`].
    fn of(frame: &Frame, begin: Nanos, is_skipped: bool) -> FrameTime {
        let start = CLOCK_START.saturating_add(begin);
        let (first, last) =
            frame.header.map_or((start, start), |header| (header.stamp_first_ns, header.stamp_last_ns));
        let (first, last) = (first.min(MAX_STAMP), last.min(MAX_STAMP));
        let duration = last.saturating_sub(first);
        // A hub has received a frame when its last byte has arrived.
        let media = begin.saturating_add(duration.min(MAX_GAP));
        FrameTime { first, last: last.max(first), begin, media, is_skipped }
    }
}

fn recorded_metadata(frame: &Frame) -> RecordedMetadata {
    RecordedMetadata {
        wall_ns: frame.wall_ns,
        flags: frame.header.map_or(0, |header| header.flags & Flags::SIMULATED),
        ..RecordedMetadata::default()
    }
}

/// Returns the time from `frame` to the `next` scan of a log. A log may lack scans, so the time may be longer than the
/// period of the scanner. `None` for a recording with headers.
fn time_to_next(frame: &Frame, next: &Frame) -> Option<Nanos> {
    if frame.header.is_some() {
        return None;
    }
    let (from, to) = frame.wall_ns.zip(next.wall_ns)?;
    Some(to.saturating_sub(from).min(MAX_GAP))
}

/// A scanner is silent after this time without a scan.
const SILENCE_TIME: Nanos = 1_000 * MILLIS;
/// Time at which the clock of a frame without stamps starts, as on a machine that has run for a while.
pub(crate) const CLOCK_START: Nanos = 10_000_000_000;
