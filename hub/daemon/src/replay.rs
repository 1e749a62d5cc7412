//! A link that plays a recording. Telegrams are played in order, with the recorded times between them or as fast as
//! they can be read. The hub sends no requests, because nothing could reply to them.
//!
//! `recorded.rs` opens recordings and computes the media time of their telegrams. Recordings with stamps are played by
//! `frames.rs`. A stream of bytes is played here: it passes through a session like the bytes of a line. The session
//! also finds out what is damaged in it.
//!
//! [`RecordedMount`] plays the angles of a mount. Another program publishes them, because a hub has no topic for them.

mod frames;
mod recorded;

use std::os::fd::AsFd;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use scanhub_drivers::line::{Event, Output, Protocol as _};
use scanhub_drivers::{PortSession, Settings};
use scanhub_port::clock;
use scanhub_recording::{Frame, MountRecord, Recording};
use scanhub_schema::{Failure, Flags, Header, MILLIS, Nanos, State, Tilt};

use crate::control::PauseTarget;
use crate::link::LinkCore;
use crate::link_output::RecordedMetadata;
use crate::platform::WakeReason;
use crate::player::{Due, PlaybackAction, PlaybackOptions, PlaybackRate, Player, PlayerHandle};
use crate::system::System;

pub(crate) use recorded::{Origin, Recorded, log_damage};
use recorded::{Stream, Timeline, read};

/// Part of a recording that a link plays together with other links.
pub(crate) struct ReplayPart<'a> {
    pub(crate) recorded: Recorded,
    pub(crate) handle: PlayerHandle<'a>,
}

/// Plays `part`, or the recording at `path` alone, into the topics of `link`, and then stays silent until the hub ends.
/// `report` is called once, with the result of opening the recording.
pub(crate) fn run<'a>(
    mut link: LinkCore<'a, System<'a>>,
    part: Option<ReplayPart<'_>>,
    path: &Path,
    paced: bool,
    report: impl FnOnce(Result<(), Failure>),
) {
    link.output.topics.set_flags(Flags::REPLAYED);
    link.begin();
    if let Some(ReplayPart { recorded, handle }) = part {
        report(Ok(()));
        let mut replay = ReplayLink::new(link, &recorded, handle);
        replay.play(recorded);
        return replay.link.end();
    }
    let rate = if paced { PlaybackRate::default() } else { PlaybackRate::Max };
    let alone = || {
        let recorded = Recorded::open(path, link.link)?;
        let player =
            Player::new(PlaybackOptions { rate, ..PlaybackOptions::default() }, 1, recorded.length())?;
        Ok((recorded, player))
    };
    match alone() {
        Ok((recorded, player)) => {
            report(Ok(()));
            let mut replay = ReplayLink::new(link, &recorded, PlayerHandle { player: &player, number: 0 });
            if replay.await_subscriber() != WakeReason::Stop {
                player.begin();
                replay.play(recorded);
            }
            replay.link.end();
        }
        Err(failure) => {
            report(Err(failure));
            link.end();
        }
    }
}

/// A link that plays a recording.
struct ReplayLink<'a, 'p> {
    link: LinkCore<'a, System<'a>>,
    handle: PlayerHandle<'p>,
    /// Message about a problem of the recording; otherwise empty.
    problem: String,
    /// Time of the next check for requests while the link plays without a wait.
    check_at: Nanos,
}

impl<'a, 'p> ReplayLink<'a, 'p> {
    fn new(mut link: LinkCore<'a, System<'a>>, recorded: &Recorded, handle: PlayerHandle<'p>) -> Self {
        link.output.topics.set_family(Some(recorded.family()));
        link.stats.set_family(recorded.family());
        link.stats.status_mut().set_sensor_type(recorded.sensor_type().unwrap_or_default());
        let problem = recorded.problem(&link.link.name);
        ReplayLink { link, handle, problem, check_at: 0 }
    }

    /// Waits for a short time until a subscriber is attached: a user who starts a hub and a subscriber together wants
    /// the recording from its beginning.
    fn await_subscriber(&mut self) -> WakeReason {
        let (mut until, mut has_subscribers) = (clock::now() + FIRST_SUBSCRIBER_TIMEOUT, false);
        while clock::now() < until {
            if !has_subscribers && self.link.output.topics.has_subscribers() {
                has_subscribers = true;
                // A program subscribes to several topics, and others may start with it.
                until = until.min(clock::now() + OTHER_TOPICS_TIME);
            }
            self.link.show(None, State::Starting, "");
            let next = (clock::now() + POLL_INTERVAL).min(until);
            if self.rest(next) == WakeReason::Stop {
                return WakeReason::Stop;
            }
        }
        WakeReason::Timeout
    }

    /// Plays `recorded`, lap by lap, until the hub ends.
    fn play(&mut self, mut recorded: Recorded) {
        let mut lap = 0;
        if let Some(wall_ns) = recorded.begin_ns() {
            self.link.output.topics.set_recorded_time(wall_ns, Flags::REPLAYED);
        }
        loop {
            self.check_at = 0;
            let ended = match &mut recorded {
                Recorded::Stream(stream) => self.play_stream(stream),
                Recorded::Frames(frames) => frames::play(self, frames),
            };
            let Some(lifetime) = ended else { return };
            self.link.output.extend_verdict(lifetime.map_or(Nanos::MAX, |lifetime| clock::now() + lifetime));
            loop {
                if let PlaybackAction::Restart(next) = self.handle.end(lap, clock::now()) {
                    lap = next;
                    self.restart();
                    break;
                }
                if self.rest(clock::now() + IDLE_INTERVAL) == WakeReason::Stop {
                    return;
                }
                self.link.show(None, State::Silent, "the recording is at its end");
            }
        }
    }

    /// Plays the bytes of `stream` at the pace of its scans. Returns how long the last verdict stays valid at the
    /// end; `None` if the hub must end.
    fn play_stream(&mut self, stream: &Stream) -> Option<Option<Nanos>> {
        let play = self.handle.play();
        let mut bytes = match stream.bytes() {
            Ok(bytes) => bytes,
            Err(failure) => {
                tracing::warn!("{}: {}", self.link.link.name, failure.message);
                return Some(None);
            }
        };
        let link = self.link.link;
        let settings = Settings { mode_number: stream.mode, ..link.settings() };
        let mut session = PortSession::begin(Some(stream.family), &settings, None, clock::now());
        let mut recorded = RecordedMetadata::default();
        let (mut media, mut lifetime) = (0, None);
        let state = if stream.has_telegrams() { State::Streaming } else { State::Probing };
        loop {
            if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
                break;
            }
            let is_skipped = media < play.start_ns;
            if is_skipped {
                if !self.pass() {
                    return None;
                }
            } else {
                recorded.stretch = self.wait_turn(Some(&session), media, state)?.stretch;
            }
            let room = session.spare();
            let chunk_len = room.len().min(CHUNK_LEN);
            let len = read(&mut *bytes, &mut room[..chunk_len]);
            let now = clock::now();
            session.commit(now, len);
            if len == 0 {
                // Without further bytes, the session has no reason to hold a telegram back.
                session.handle_timeout(now + HOLD_TIME);
            }
            while let Output::Event(Event::Telegram(received)) = session.poll_output() {
                if !is_skipped {
                    recorded.measured_ns = Some(media);
                    lifetime = self.link.publish(&received, &recorded, false).or(lifetime);
                    self.link.output.extend_verdict(VALID_UNTIL_NEXT);
                    self.handle.played(media);
                } else if let Some(scan) = received.whole.and_then(|whole| whole.scan) {
                    self.link.output.learn(&scan, media);
                }
                if !received.is_reply {
                    media += stream.period(received.whole.map_or(0, |whole| whole.beams));
                }
            }
            if !is_skipped {
                self.link.show(Some(&session), state, &self.problem);
            }
            if len == 0 {
                break;
            }
        }
        self.link.stats.close(&session);
        Some(lifetime)
    }

    /// Resets the processors, as at the start of the hub.
    fn restart(&mut self) {
        self.link.output.restart(clock::now(), VALID_UNTIL_NEXT);
    }

    /// Waits until a telegram of time `media` is due. Meanwhile, the link publishes `state`. Returns `None` if the
    /// hub must end.
    fn wait_turn(&mut self, session: Option<&PortSession>, media: Nanos, state: State) -> Option<Due> {
        loop {
            let now = clock::now();
            if self.handle.is_unthrottled() && now < self.check_at {
                return Some(Due::at_once(now));
            }
            let until = match self.handle.next_action(media, now) {
                PlaybackAction::Now(due) if now < self.check_at => return Some(due),
                PlaybackAction::Now(_) => 0,
                PlaybackAction::At(at) => at.min(now + IDLE_INTERVAL),
                PlaybackAction::Wait
                | PlaybackAction::Restart(_)
                | PlaybackAction::Skipped
                | PlaybackAction::Over => now + IDLE_INTERVAL,
            };
            if self.rest(until) == WakeReason::Stop {
                return None;
            }
            self.check_at = clock::now() + POLL_INTERVAL;
            let state = if self.handle.is_paused() { State::Paused } else { state };
            self.link.show(session, state, &self.problem);
        }
    }

    /// Handles requests while telegrams are skipped. Returns whether to continue.
    fn pass(&mut self) -> bool {
        let now = clock::now();
        if now < self.check_at {
            return true;
        }
        self.check_at = now + POLL_INTERVAL;
        self.link.show(None, State::Starting, &self.problem);
        self.rest(0) != WakeReason::Stop
    }

    /// Waits until `until`, the end of the hub, or a change of the player.
    fn rest(&mut self, until: Nanos) -> WakeReason {
        let event = self.handle.event();
        match self.link.wait(event.as_fd(), until) {
            WakeReason::Request => self.link.handle_requests(PauseTarget::Recording(self.handle.player)),
            WakeReason::Ready => event.clear(),
            WakeReason::Stop => return WakeReason::Stop,
            WakeReason::Timeout => {}
        }
        WakeReason::Timeout
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
    /// Time at which it is due in the replay, CLOCK_MONOTONIC in ns.
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
        let play = player.play();
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
                let media = timeline.media_beside(&header);
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

/// Waits until something of `media` is due or skipped, or until the lap ends: [`PlaybackAction::Over`].
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
/// Maximum recorded period that is accepted.
const MAX_GAP: Nanos = 10_000 * MILLIS;
/// Interval of the statuses while nothing plays.
const IDLE_INTERVAL: Nanos = 100 * MILLIS;
/// Time after which the recording of a link begins without a subscriber.
const FIRST_SUBSCRIBER_TIMEOUT: Nanos = 1_000 * MILLIS;
/// Time that a subscriber to the first topic has for the others.
const OTHER_TOPICS_TIME: Nanos = 100 * MILLIS;
/// Interval of the checks for requests and the end of the hub while a link plays without a wait.
const POLL_INTERVAL: Nanos = 5 * MILLIS;
/// Maximum number of bytes given to the session at a time: less than a telegram, so that stamps stay accurate.
const CHUNK_LEN: usize = 128;
/// Time without bytes after which a session no longer holds a telegram back.
const HOLD_TIME: Nanos = 100 * MILLIS;
/// Interval at which a mount checks whether the player was paused, or has ended.
const ANGLE_POLL_INTERVAL: Duration = Duration::from_millis(5);
