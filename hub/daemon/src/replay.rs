//! A link whose other end is a recording. Telegrams are played in their order, with the times between them that were
//! recorded, or as fast as they can be read. The hub sends no requests, because nothing could answer them.

mod frames;
mod mounts;
mod recorded;
mod stream;

use std::os::fd::AsFd;
use std::path::Path;

use port::clock;
use scanhub_drivers::PortSession;
use schema::{Failure, Flags, MILLIS, Nanos, State};

use crate::control::Flow;
use crate::link::LinkCore;
use crate::player::{Due, Pace, Play, Player, PlayerHandle, Turn};
use crate::surroundings::Woken;
use crate::system::System;

pub use mounts::{RecordedAngle, RecordedMount};
pub(crate) use recorded::{Origin, Recorded, tell_of_damage};

/// What a link plays together with others.
pub(crate) struct ReplayPart<'a> {
    pub(crate) recorded: Recorded,
    pub(crate) handle: PlayerHandle<'a>,
}

/// Plays `part`, or the recording at `path` alone, into the topics of `link`; then stays silent until the hub ends.
/// `report` is called once, when it is clear whether it can be read.
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
    let pace = if paced { Pace::default() } else { Pace::Max };
    let alone = || {
        let recorded = Recorded::open(path, link.link)?;
        let player = Player::new(Play { pace, ..Play::default() }, 1, recorded.length())?;
        Ok((recorded, player))
    };
    match alone() {
        Ok((recorded, player)) => {
            report(Ok(()));
            let mut replay = ReplayLink::new(link, &recorded, PlayerHandle { player: &player, number: 0 });
            if replay.await_consumer() != Woken::Stop {
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

/// A link whose other end is a recording.
struct ReplayLink<'a, 'p> {
    link: LinkCore<'a, System<'a>>,
    handle: PlayerHandle<'p>,
    /// What is wrong with the recording, in words.
    trouble: String,
    /// When it is looked, where nothing is waited for, whether somebody wants something.
    look_at: Nanos,
}

impl<'a, 'p> ReplayLink<'a, 'p> {
    fn new(mut link: LinkCore<'a, System<'a>>, recorded: &Recorded, handle: PlayerHandle<'p>) -> Self {
        link.output.topics.set_family(Some(recorded.family()));
        link.stats.set_family(recorded.family());
        link.stats.status_mut().set_sensor_type(recorded.sensor_type().unwrap_or_default());
        let trouble = recorded.trouble(&link.link.name);
        ReplayLink { link, handle, trouble, look_at: 0 }
    }

    /// Waits for a short time until a subscriber is attached: a user who starts a hub and a subscriber together wants
    /// the recording from its beginning.
    fn await_consumer(&mut self) -> Woken {
        let (mut until, mut has_subscribers) = (clock::now() + FIRST_CONSUMER, false);
        while clock::now() < until {
            if !has_subscribers && self.link.output.topics.has_subscribers() {
                has_subscribers = true;
                // A program subscribes to several topics, and others may start with it.
                until = until.min(clock::now() + OTHER_TOPICS);
            }
            self.link.show(None, State::Starting, "");
            let next = (clock::now() + LOOK).min(until);
            if self.rest(next) == Woken::Stop {
                return Woken::Stop;
            }
        }
        Woken::Timeout
    }

    fn play(&mut self, mut recorded: Recorded) {
        let mut lap = 0;
        if let Some(wall_ns) = recorded.begin_ns() {
            self.link.output.topics.set_recorded_time(wall_ns, Flags::REPLAYED);
        }
        loop {
            self.look_at = 0;
            let ended = match &mut recorded {
                Recorded::Stream(stream) => stream::play(self, stream),
                Recorded::Frames(frames) => frames::play(self, frames),
            };
            let Some(limit) = ended else { return };
            self.link.output.extend_verdict(limit.map_or(Nanos::MAX, |limit| clock::now() + limit));
            loop {
                if let Turn::Restart(next) = self.handle.end(lap, clock::now()) {
                    lap = next;
                    self.restart();
                    break;
                }
                if self.rest(clock::now() + IDLE) == Woken::Stop {
                    return;
                }
                self.link.show(None, State::Silent, "the recording is at its end");
            }
        }
    }

    /// Nothing is known any more, as at the hub's start.
    fn restart(&mut self) {
        self.link.output.restart(clock::now(), STANDS);
    }

    /// Waits for the turn of what is of `media`; meanwhile the link's state is `state`. Nothing if the hub shall end.
    fn wait_turn(&mut self, session: Option<&PortSession>, media: Nanos, state: State) -> Option<Due> {
        loop {
            let now = clock::now();
            if self.handle.flows() && now < self.look_at {
                return Some(Due::at_once(now));
            }
            let until = match self.handle.turn(media, now) {
                Turn::Now(due) if now < self.look_at => return Some(due),
                Turn::Now(_) => 0,
                Turn::At(at) => at.min(now + IDLE),
                Turn::Wait | Turn::Restart(_) | Turn::Skipped | Turn::Over => now + IDLE,
            };
            if self.rest(until) == Woken::Stop {
                return None;
            }
            self.look_at = clock::now() + LOOK;
            let state = if self.handle.is_paused() { State::Paused } else { state };
            self.link.show(session, state, &self.trouble);
        }
    }

    /// As [`wait_turn`](Self::wait_turn) where nothing is published: whether to go on.
    fn pass(&mut self) -> bool {
        let now = clock::now();
        if now < self.look_at {
            return true;
        }
        self.look_at = now + LOOK;
        self.link.show(None, State::Starting, &self.trouble);
        self.rest(0) != Woken::Stop
    }

    /// Waits until `until`, the hub's end, or news of the player.
    fn rest(&mut self, until: Nanos) -> Woken {
        let news = self.handle.news();
        match self.link.wait(news.as_fd(), until) {
            Woken::Request => self.link.handle_requests(Flow::Recording(self.handle.player)),
            Woken::Ready => news.clear(),
            Woken::Stop => return Woken::Stop,
            Woken::Timeout => {}
        }
        Woken::Timeout
    }
}

/// A verdict stands until the recording says otherwise, also while the player waits.
const STANDS: Nanos = Nanos::MAX - 1;
/// A period that is longer is not believed.
const LONGEST_GAP: Nanos = 10_000 * MILLIS;
/// Between two statuses while nothing plays.
const IDLE: Nanos = 100 * MILLIS;
/// The recording of a link begins without a consumer after so long.
const FIRST_CONSUMER: Nanos = 1_000 * MILLIS;
/// After its first topic a consumer has time for the others.
const OTHER_TOPICS: Nanos = 100 * MILLIS;
/// Between two looks at requests and the hub's end where nothing is waited for.
const LOOK: Nanos = 5 * MILLIS;
