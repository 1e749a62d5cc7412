//! A link that plays a recording. Telegrams are played in order, with the recorded times between them or as fast as
//! they can be read. The hub sends no requests, because nothing could reply to them.
//!
//! `recorded.rs` opens recordings and computes the media time of their telegrams. Recordings with stamps are played by
//! `frames.rs`, and a stream of bytes by `bytes.rs`. A [`ReplayTiming`] defines when a telegram is due:
//! [`PlayerTiming`] waits for the player of a hub, and `reader.rs` has a timing that never waits.
//!
//! [`RecordedMount`] plays the angles of a mount. Another program publishes them, because a hub has no topic for them.

mod bytes;
mod frames;
mod recorded;

use std::os::fd::AsFd;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use scanhub_drivers::PortSession;
use scanhub_port::clock;
use scanhub_recording::{Frame, MountRecord, Recording};
use scanhub_schema::{Failure, Flags, Header, MILLIS, Nanos, State, Tilt};

use crate::control::PauseTarget;
use crate::link::LinkState;
use crate::platform::{Platform, WakeReason};
use crate::player::{DueTime, PlaybackAction, PlaybackOptions, PlaybackRate, Player, PlayerHandle};
use crate::system::System;

use bytes::BytesLap;
pub(crate) use frames::CLOCK_START;
use frames::FramesLap;
use recorded::Timeline;
pub(crate) use recorded::{Origin, RecordedSensor, log_damage};

/// Part of a recording that a link plays together with other links.
pub(crate) struct ReplayPart<'a> {
    pub(crate) recorded: RecordedSensor,
    pub(crate) handle: PlayerHandle<'a>,
}

/// Plays `part`, or the recording at `path` alone, into the topics of `link`, and then stays silent until the hub ends.
/// `report` is called once, with the result of opening the recording.
pub(crate) fn run<'a>(
    mut link: LinkState<'a, System<'a>>,
    part: Option<ReplayPart<'_>>,
    path: &Path,
    paced: bool,
    report: impl FnOnce(Result<(), Failure>),
) {
    begin(&mut link);
    if let Some(ReplayPart { recorded, handle }) = part {
        report(Ok(()));
        let mut replay = ReplayLink::new(link, &recorded, PlayerTiming::new(handle));
        replay.play(&recorded);
        return replay.link.end();
    }
    let rate = if paced { PlaybackRate::default() } else { PlaybackRate::Max };
    let alone = || {
        let recorded = RecordedSensor::open(path, link.link)?;
        let player =
            Player::new(PlaybackOptions { rate, ..PlaybackOptions::default() }, 1, recorded.length())?;
        Ok((recorded, player))
    };
    match alone() {
        Ok((recorded, player)) => {
            report(Ok(()));
            let timing = PlayerTiming::new(PlayerHandle { player: &player, number: 0 });
            let mut replay = ReplayLink::new(link, &recorded, timing);
            if replay.await_subscriber() != WakeReason::Stop {
                player.begin();
                replay.play(&recorded);
            }
            replay.link.end();
        }
        Err(failure) => {
            report(Err(failure));
            link.end();
        }
    }
}

/// Publishes the state of `link` before the first telegram of a recording.
pub(crate) fn begin<S: Platform>(link: &mut LinkState<'_, S>) {
    link.output.topics.set_flags(Flags::REPLAYED);
    link.begin();
}

/// Times at which the telegrams of a recording are due.
pub(crate) trait ReplayTiming<S: Platform> {
    /// Returns the start of the played part, and its end if this is not the end of the recording, as media times.
    fn range(&self) -> (Nanos, Option<Nanos>);

    /// Waits until a telegram of time `media` is due. Meanwhile, `link` publishes the status that `description`
    /// describes. Returns `None` if the hub must end.
    fn wait_until_due(
        &mut self,
        link: &mut LinkState<'_, S>,
        media: Nanos,
        description: LinkDescription<'_>,
    ) -> Option<DueTime>;

    /// Handles requests while telegrams are skipped. Returns whether to continue.
    fn continue_skipping(&mut self, link: &mut LinkState<'_, S>, problem: &str) -> bool;

    /// Notes that a telegram of time `media` was published.
    fn note_played(&mut self, media: Nanos);
}

/// Description of a link for its status.
#[derive(Clone, Copy)]
pub(crate) struct LinkDescription<'a> {
    session: Option<&'a PortSession>,
    state: State,
    /// Message about a problem; otherwise empty.
    problem: &'a str,
}

/// A link that plays a recording at a [`ReplayTiming`].
pub(crate) struct ReplayLink<'a, S: Platform, P> {
    pub(crate) link: LinkState<'a, S>,
    pub(crate) timing: P,
    /// Message about a problem of the recording; otherwise empty.
    problem: String,
}

impl<'a, S: Platform, P: ReplayTiming<S>> ReplayLink<'a, S, P> {
    pub(crate) fn new(mut link: LinkState<'a, S>, recorded: &RecordedSensor, timing: P) -> Self {
        link.output.topics.set_family(Some(recorded.family()));
        link.stats.set_family(recorded.family());
        link.stats.status_mut().set_sensor_type(recorded.sensor_type().unwrap_or_default());
        let problem = recorded.problem(&link.link.name);
        ReplayLink { link, timing, problem }
    }

    /// Sets the wall clock of the next samples to the start of `recorded`.
    pub(crate) fn set_begin(&mut self, recorded: &RecordedSensor) {
        if let Some(wall_ns) = recorded.begin_ns() {
            self.link.output.topics.set_recorded_time(wall_ns, Flags::REPLAYED);
        }
    }

    /// Resets the processors, as at the start of the hub.
    fn restart(&mut self) {
        self.link.output.restart(self.link.platform.now(), VALID_UNTIL_NEXT);
    }

    /// Waits until a telegram of time `media` is due. Meanwhile, the link publishes `state`. Returns `None` if the
    /// hub must end.
    fn wait_until_due(
        &mut self,
        session: Option<&PortSession>,
        media: Nanos,
        state: State,
    ) -> Option<DueTime> {
        let description = LinkDescription { session, state, problem: &self.problem };
        self.timing.wait_until_due(&mut self.link, media, description)
    }

    /// Handles requests while telegrams are skipped. Returns whether to continue.
    fn continue_skipping(&mut self) -> bool {
        self.timing.continue_skipping(&mut self.link, &self.problem)
    }
}

/// One pass through a recording.
pub(crate) enum Lap<'f> {
    Bytes(Box<BytesLap<'f>>),
    Frames(Box<FramesLap<'f>>),
}

impl<'f> Lap<'f> {
    /// Starts a pass of `replay` through `recorded`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`](scanhub_schema::Kind) if the file cannot be opened.
    pub(crate) fn new<S: Platform>(
        replay: &ReplayLink<'_, S, impl ReplayTiming<S>>,
        recorded: &'f RecordedSensor,
    ) -> Result<Lap<'f>, Failure> {
        Ok(match recorded {
            RecordedSensor::Stream(stream) => Lap::Bytes(Box::new(BytesLap::new(replay, stream)?)),
            RecordedSensor::Frames(frames) => Lap::Frames(Box::new(FramesLap::new(replay, frames)?)),
        })
    }

    /// Returns the media time of the next [`step`](Self::step); `None` at the end.
    pub(crate) fn next_media(&self) -> Option<Nanos> {
        match self {
            Lap::Bytes(lap) => lap.next_media(),
            Lap::Frames(lap) => lap.next_media(),
        }
    }

    /// Plays the next telegram, or the next few bytes of a stream. If the last verdict becomes stale before the next
    /// telegram ends, publishes only this change. Returns `None` if the hub must end.
    pub(crate) fn step<S: Platform>(
        &mut self,
        replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>,
    ) -> Option<()> {
        match self {
            Lap::Bytes(lap) => lap.step(replay),
            Lap::Frames(lap) => lap.step(replay),
        }
    }

    /// Returns the number of telegrams or bytes that the file contained when it was opened, and lacked in this pass.
    /// `None` if it was read to its end.
    pub(crate) fn shortfall(&self) -> Option<String> {
        let (read, whole, unit) = match self {
            Lap::Bytes(lap) => (lap.read_len, lap.stream.len(), "bytes"),
            Lap::Frames(lap) => (lap.read_frames, lap.frames.count(), "telegrams"),
        };
        (read < whole).then(|| format!("{} of {whole} {unit}", whole - read))
    }

    /// Ends the pass. The last verdict stays valid for a while.
    pub(crate) fn end<S: Platform>(&self, replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>) {
        let lifetime = match self {
            Lap::Bytes(lap) => lap.end(replay),
            Lap::Frames(lap) => lap.end(replay),
        };
        expire_after(replay, lifetime);
    }
}

/// Keeps the last verdict valid for `lifetime` from now on. `None` means that there was no verdict.
fn expire_after<S: Platform>(replay: &mut ReplayLink<'_, S, impl ReplayTiming<S>>, lifetime: Option<Nanos>) {
    let now = replay.link.platform.now();
    replay.link.output.extend_verdict(lifetime.map_or(Nanos::MAX, |lifetime| now.saturating_add(lifetime)));
}

impl<'a> ReplayLink<'a, System<'a>, PlayerTiming<'_>> {
    /// Waits for a short time until a subscriber is attached, because a user who starts a hub and a subscriber together
    /// wants to receive the recording from its beginning.
    fn await_subscriber(&mut self) -> WakeReason {
        let (mut until, mut has_subscribers) = (clock::now() + FIRST_SUBSCRIBER_TIMEOUT, false);
        while clock::now() < until {
            if !has_subscribers && self.link.output.topics.has_subscribers() {
                has_subscribers = true;
                // A program may subscribe to several topics, and other programs may start together with it.
                until = until.min(clock::now() + OTHER_TOPICS_TIME);
            }
            self.link.publish_status(None, State::Starting, "");
            let next = (clock::now() + POLL_INTERVAL).min(until);
            if self.timing.wait(&mut self.link, next) == WakeReason::Stop {
                return WakeReason::Stop;
            }
        }
        WakeReason::Timeout
    }

    /// Plays `recorded`, lap by lap, until the hub ends.
    fn play(&mut self, recorded: &RecordedSensor) {
        let mut number = 0;
        self.set_begin(recorded);
        loop {
            self.timing.check_at = 0;
            match Lap::new(self, recorded) {
                Ok(mut lap) => {
                    while lap.next_media().is_some() {
                        if lap.step(self).is_none() {
                            return;
                        }
                    }
                    lap.end(self);
                }
                Err(failure) => {
                    tracing::warn!("{}: {}", self.link.link.name, failure.message);
                    expire_after(self, None);
                }
            }
            loop {
                if let PlaybackAction::Restart(next) = self.timing.handle.end(number, clock::now()) {
                    number = next;
                    self.restart();
                    break;
                }
                if self.timing.wait(&mut self.link, clock::now() + IDLE_STATUS_INTERVAL) == WakeReason::Stop {
                    return;
                }
                self.link.publish_status(None, State::Silent, "the recording is at its end");
            }
        }
    }
}

/// Timing of the player of a hub.
struct PlayerTiming<'p> {
    handle: PlayerHandle<'p>,
    /// Time of the next check for requests while the link plays without a wait.
    check_at: Nanos,
}

impl<'p> PlayerTiming<'p> {
    fn new(handle: PlayerHandle<'p>) -> Self {
        PlayerTiming { handle, check_at: 0 }
    }

    /// Waits until `until`, the end of the hub, or a change of the player.
    fn wait(&mut self, link: &mut LinkState<'_, System<'_>>, until: Nanos) -> WakeReason {
        let event = self.handle.event();
        match link.wait(event.as_fd(), until) {
            WakeReason::Request => link.handle_requests(PauseTarget::Recording(self.handle.player)),
            WakeReason::Ready => event.clear(),
            WakeReason::Stop => return WakeReason::Stop,
            WakeReason::Timeout => {}
        }
        WakeReason::Timeout
    }
}

impl<'a> ReplayTiming<System<'a>> for PlayerTiming<'_> {
    fn range(&self) -> (Nanos, Option<Nanos>) {
        let play = self.handle.options();
        (play.start_ns, play.end_ns)
    }

    fn wait_until_due(
        &mut self,
        link: &mut LinkState<'_, System<'a>>,
        media: Nanos,
        shown: LinkDescription<'_>,
    ) -> Option<DueTime> {
        loop {
            let now = clock::now();
            if self.handle.is_unthrottled() && now < self.check_at {
                return Some(DueTime::at_once(now));
            }
            let until = match self.handle.next_action(media, now) {
                PlaybackAction::Now(due) if now < self.check_at => return Some(due),
                PlaybackAction::Now(_) => 0,
                PlaybackAction::At(at) => at.min(now + IDLE_STATUS_INTERVAL),
                PlaybackAction::Wait
                | PlaybackAction::Restart(_)
                | PlaybackAction::Skipped
                | PlaybackAction::Over => now + IDLE_STATUS_INTERVAL,
            };
            if self.wait(link, until) == WakeReason::Stop {
                return None;
            }
            self.check_at = clock::now() + POLL_INTERVAL;
            let state = if self.handle.is_paused() { State::Paused } else { shown.state };
            link.publish_status(shown.session, state, shown.problem);
        }
    }

    fn continue_skipping(&mut self, link: &mut LinkState<'_, System<'a>>, problem: &str) -> bool {
        let now = clock::now();
        if now < self.check_at {
            return true;
        }
        self.check_at = now + POLL_INTERVAL;
        link.publish_status(None, State::Starting, problem);
        self.wait(link, 0) != WakeReason::Stop
    }

    fn note_played(&mut self, media: Nanos) {
        self.handle.note_played(media);
    }
}

/// A mount whose angles are in a recording.
#[derive(Clone, Debug)]
pub struct RecordedMount {
    /// Name in the recording.
    recorded: String,
    name: String,
    recording: Recording,
    /// Start of the media time.
    origin: Origin,
}

/// An angle that is due.
#[derive(Clone, Copy, Debug)]
pub struct RecordedAngle {
    /// Time at which the angle is due in the replay, CLOCK_MONOTONIC in ns.
    pub stamp_ns: u64,
    /// Header of the sample in the recording.
    pub header: Header,
    /// The recorded angle.
    pub tilt: Tilt,
}

impl RecordedMount {
    /// Returns the mount with the name `recorded` in `recording`, which is published as `name`.
    pub(crate) fn new(recorded: &str, name: String, recording: &Recording, origin: Origin) -> RecordedMount {
        RecordedMount { recorded: recorded.to_owned(), name, recording: recording.clone(), origin }
    }

    /// Returns the name under which its angles are published.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Passes each angle to `publish` when it is due, lap by lap, until `stop` is set.
    pub fn play(&self, player: &Player, stop: &AtomicBool, mut publish: impl FnMut(RecordedAngle)) {
        let play = player.options();
        while !stop.load(Ordering::Relaxed) {
            let lap = player.lap();
            let is_current = || player.lap() == lap && !stop.load(Ordering::Relaxed);
            let records = match self.recording.angles(&self.recorded) {
                Ok(records) => records,
                Err(failure) => return tracing::warn!("{}: {}", self.name, failure.message),
            };
            let mut timeline = Timeline::new(Some(self.origin));
            for record in records {
                let (header, tilt) = match record {
                    MountRecord::Angle(header, tilt) => (header, tilt),
                    MountRecord::Telegram(header) => {
                        let frame =
                            Frame { header: Some(header), wall_ns: Some(header.wall_ns), ..Frame::default() };
                        timeline.media(&frame);
                        continue;
                    }
                };
                let media = timeline.media_of_sample(&header);
                let Some(media) = media.filter(|media| *media >= play.start_ns) else { continue };
                if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
                    break;
                }
                match wait(player, media, &is_current) {
                    PlaybackAction::Now(due) => publish(RecordedAngle { stamp_ns: due.at, header, tilt }),
                    PlaybackAction::Skipped => {}
                    _ => break,
                }
            }
            while is_current() {
                thread::sleep(ANGLE_POLL_INTERVAL);
            }
        }
    }
}

/// Waits until a sample of time `media` is due or skipped, or until the lap ends. Returns [`PlaybackAction::Over`] at
/// the end of the lap.
fn wait(player: &Player, media: Nanos, is_current: &impl Fn() -> bool) -> PlaybackAction {
    while is_current() {
        let now = clock::now();
        match player.due(media, now) {
            turn @ (PlaybackAction::Now(_) | PlaybackAction::Skipped) => return turn,
            PlaybackAction::At(at) => {
                thread::sleep(Duration::from_nanos(at.saturating_sub(now)).min(ANGLE_POLL_INTERVAL))
            }
            _ => thread::sleep(ANGLE_POLL_INTERVAL),
        }
    }
    PlaybackAction::Over
}

/// Validity of a verdict while a recording plays: until the next verdict, even while the player waits.
const VALID_UNTIL_NEXT: Nanos = Nanos::MAX - 1;
/// Latest stamp. A later stamp in a file is replaced by this one, so that sums with durations do not overflow.
pub(crate) const MAX_STAMP: Nanos = i64::MAX as Nanos - (1 << 56);
/// Maximum duration of a frame and maximum time to the next scan that are taken over from a recording. Within this
/// time, an earlier wall clock does not count as set back.
const MAX_GAP: Nanos = 10_000 * MILLIS;
/// Interval of the statuses while nothing plays.
const IDLE_STATUS_INTERVAL: Nanos = 100 * MILLIS;
/// Time after which the recording of a link begins without a subscriber.
const FIRST_SUBSCRIBER_TIMEOUT: Nanos = 1_000 * MILLIS;
/// Time between the first subscription and the start of the recording, in which programs can subscribe to further
/// topics.
const OTHER_TOPICS_TIME: Nanos = 100 * MILLIS;
/// Interval of the checks for requests and the end of the hub while a link plays without a wait.
const POLL_INTERVAL: Nanos = 5 * MILLIS;
/// Interval at which a mount checks whether the player was paused, or has ended.
const ANGLE_POLL_INTERVAL: Duration = Duration::from_millis(5);
