//! A link whose other end is a recording, and the player that all links of a recording share. What is recorded comes in
//! its order and at its times to each other, or as fast as it can be read. Nobody hears what the hub would say, so
//! nothing is asked.

mod frames;
mod recorded;
mod stream;

use std::path::Path;

use lms::variant::Variant;
use lms::{MILLIS, Nanos, Session};
use port::clock;
use schema::{Failure, Flags, State, Wake};

use crate::control::Flow;
use crate::link::{LinkThread, Woken};
use crate::player::{Due, Pace, Play, Player, PlayerHandle, Turn};

pub(crate) use recorded::{Origin, Recorded, tell_of_damage};

/// What a link plays together with others.
pub(crate) struct ReplayPart<'a> {
    pub(crate) recorded: Recorded,
    pub(crate) handle: PlayerHandle<'a>,
}

/// Plays the part of `part`, or the recording at `path` alone, into the topics of `link`; then stays silent until the
/// hub ends. `report` is called once, when it is clear whether it can be read.
pub(crate) fn run(
    link: &mut LinkThread<'_>,
    part: Option<ReplayPart<'_>>,
    path: &Path,
    paced: bool,
    report: impl FnOnce(Result<(), Failure>),
) {
    if let Some(ReplayPart { recorded, handle }) = part {
        report(Ok(()));
        return play(link, recorded, handle);
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
            let handle = PlayerHandle { player: &player, number: 0 };
            if await_consumer(link, handle) == Woken::Stop {
                return;
            }
            player.begin();
            play(link, recorded, handle);
        }
        Err(failure) => report(Err(failure)),
    }
}

/// Waits a moment until somebody is attached: who starts a hub and a consumer together wants the recording from its
/// beginning.
fn await_consumer(link: &mut LinkThread<'_>, handle: PlayerHandle<'_>) -> Woken {
    let (mut until, mut is_heard) = (clock::now() + FIRST_CONSUMER, false);
    while clock::now() < until {
        if !is_heard && link.topics.is_heard() {
            is_heard = true;
            // One consumer follows several topics, and others are started with it.
            until = until.min(clock::now() + OTHER_TOPICS);
        }
        link.show(None, State::Starting, "");
        let next = (clock::now() + LOOK).min(until);
        if rest(link, handle, next) == Woken::Stop {
            return Woken::Stop;
        }
    }
    Woken::Timeout
}

fn play(link: &mut LinkThread<'_>, mut recorded: Recorded, handle: PlayerHandle<'_>) {
    let mut lap = 0;
    let trouble = recorded.trouble(&link.link.name);
    if let Some(wall_ns) = recorded.begin_ns() {
        link.topics.recall(wall_ns, Flags::REPLAYED);
    }
    loop {
        let ended = match &mut recorded {
            Recorded::Stream(stream) => stream::play(link, stream, handle, &trouble),
            Recorded::Frames(frames) => frames::play(link, frames, handle, &trouble),
        };
        let Some(limit) = ended else { return };
        link.stale_at = limit.map_or(Nanos::MAX, |limit| clock::now() + limit);
        loop {
            if let Turn::Anew(next) = handle.end(lap, clock::now()) {
                lap = next;
                begin_anew(link);
                break;
            }
            if rest(link, handle, clock::now() + IDLE) == Woken::Stop {
                return;
            }
            link.show(None, State::Silent, "the recording is at its end");
        }
    }
}

/// Nothing is known any more, as at the hub's start.
fn begin_anew(link: &mut LinkThread<'_>) {
    let now = clock::now();
    link.pipeline.begin_anew();
    link.stale_at = STANDS;
    link.topics.stale(&mut link.pipeline, now);
    link.topics.background(&mut link.pipeline, now);
    link.topics.wake(Wake::Status);
}

/// How a link waits for its turns.
struct Turns<'a> {
    handle: PlayerHandle<'a>,
    /// When it is looked, where nothing is waited for, whether somebody wants something.
    look_at: Nanos,
    /// What is wrong with the recording, in words.
    trouble: &'a str,
}

impl<'a> Turns<'a> {
    fn new(handle: PlayerHandle<'a>, trouble: &'a str) -> Turns<'a> {
        Turns { handle, look_at: 0, trouble }
    }

    /// Waits for the turn of what is of `media`; meanwhile the link's state is `state`. Nothing if the hub shall end.
    fn wait(
        &mut self,
        link: &mut LinkThread<'_>,
        session: Option<&Session>,
        media: Nanos,
        state: State,
    ) -> Option<Due> {
        loop {
            let now = clock::now();
            if self.handle.flows() && now < self.look_at {
                return Some(Due::at_once(now));
            }
            let until = match self.handle.turn(media, now) {
                Turn::Now(due) if now < self.look_at => return Some(due),
                Turn::Now(_) => 0,
                Turn::At(at) => at.min(now + IDLE),
                Turn::Wait | Turn::Anew(_) | Turn::Over => now + IDLE,
            };
            if rest(link, self.handle, until) == Woken::Stop {
                return None;
            }
            self.look_at = clock::now() + LOOK;
            let state = if self.handle.is_paused() { State::Paused } else { state };
            link.show(session, state, self.trouble);
        }
    }

    /// As [`wait`](Self::wait) where nothing is published: whether to go on.
    fn pass(&mut self, link: &mut LinkThread<'_>) -> bool {
        let now = clock::now();
        if now < self.look_at {
            return true;
        }
        self.look_at = now + LOOK;
        link.show(None, State::Starting, self.trouble);
        rest(link, self.handle, 0) != Woken::Stop
    }
}

/// Waits until `until`, the hub's end, or news of the player.
fn rest(link: &mut LinkThread<'_>, handle: PlayerHandle<'_>, until: Nanos) -> Woken {
    use rustix::event::PollFlags;
    use std::os::fd::AsFd;
    match link.wait(Some((handle.news().as_fd(), PollFlags::IN)), until) {
        Woken::Order => link.obey(Flow::Recording(handle.player)),
        Woken::Ready => handle.news().clear(),
        Woken::Stop => return Woken::Stop,
        Woken::Timeout => {}
    }
    Woken::Timeout
}

/// From one scan to the next, as streams without stamps are played.
fn period(variant: Option<Variant>) -> Nanos {
    let rate = lms::variant::Baud::B500000.rate();
    Nanos::from(scanner::period_us(variant.or(Some(Variant::HALF)), rate)) * 1000
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
