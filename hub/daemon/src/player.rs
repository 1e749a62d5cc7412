//! A player as its users and its links see it: the links' threads ask whose turn it is, keys and requests change how it
//! goes on. Where nothing is waited for, nobody asks and nothing is locked. Refuses to know what is played.

mod playback;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use port::clock;
use schema::{Failure, Nanos};

use crate::process::EventFd;
use crate::replay::RecordedMount;
pub use playback::Play;
use playback::Playback;
pub(crate) use playback::{Due, Turn};

/// How fast a recording is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// So many times as fast as it was recorded.
    Times(f64),
    /// As fast as it can be read.
    Max,
}

/// The player of a recording, for all links that are in it.
pub struct Player {
    playback: Mutex<Playback>,
    /// Whether it is everybody's turn.
    flows: AtomicBool,
    links: Vec<LinkPlace>,
    /// Rings at the end.
    over: EventFd,
    /// Somebody wants it to end now.
    is_ended: AtomicBool,
    length_ns: Option<Nanos>,
    /// Mounts whose angles are in the recording.
    mounts: Vec<RecordedMount>,
}

/// Where a link is.
struct LinkPlace {
    event: EventFd,
    media: AtomicU64,
    has_ended: AtomicBool,
    telegrams: AtomicU64,
    /// Those of them that were published when a lap ended last.
    of_laps: AtomicU64,
}

/// A link's place at a player.
#[derive(Clone, Copy)]
pub(crate) struct PlayerHandle<'a> {
    pub(crate) player: &'a Player,
    pub(crate) number: usize,
}

/// How far a player is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Media time, in ns, from the first telegram of the recording.
    pub position_ns: u64,
    /// Media time of the end, where it is known.
    pub length_ns: Option<u64>,
    /// How fast.
    pub pace: Pace,
    /// Whether it waits.
    pub is_paused: bool,
    /// Whether everything was played.
    pub is_over: bool,
    /// Times that it started again.
    pub lap: u32,
    /// Telegrams published, of all links and laps.
    pub telegrams: u64,
    /// Time that it has played, in ns, without pauses.
    pub took_ns: u64,
    /// Time that it has been paused since everything was ready to play, in ns.
    pub paused_ns: u64,
    /// CLOCK_MONOTONIC of this answer, in ns.
    pub now_ns: u64,
}

impl Default for Pace {
    fn default() -> Pace {
        Pace::Times(1.0)
    }
}

impl Pace {
    /// Twice as fast; more than [`Pace::FASTEST`] is [`Pace::Max`].
    fn doubled(self) -> Pace {
        match self {
            Pace::Times(rate) if rate < Pace::FASTEST => Pace::Times((2.0 * rate).min(Pace::FASTEST)),
            _ => Pace::Max,
        }
    }

    fn halved(self) -> Pace {
        match self {
            Pace::Times(rate) => Pace::Times((rate / 2.0).max(Pace::SLOWEST)),
            Pace::Max => Pace::Times(Pace::FASTEST),
        }
    }

    /// The slowest that can be asked for.
    pub const SLOWEST: f64 = 1.0 / 64.0;
    /// The fastest that is waited for.
    pub const FASTEST: f64 = 64.0;
}

impl Player {
    /// A player of `links` links that together last `length_ns`, if that is known.
    ///
    /// [`Kind::Short`](schema::Kind) if descriptors are.
    pub(crate) fn new(play: Play, links: usize, length_ns: Option<Nanos>) -> Result<Player, Failure> {
        let place = |_| -> Result<LinkPlace, Failure> {
            let (media, telegrams, of_laps) = Default::default();
            let (event, has_ended) = (EventFd::new()?, AtomicBool::new(false));
            Ok(LinkPlace { event, media, has_ended, telegrams, of_laps })
        };
        Ok(Player {
            playback: Mutex::new(Playback::new(play, links)),
            flows: AtomicBool::new(false),
            links: (0..links).map(place).collect::<Result<_, _>>()?,
            over: EventFd::new()?,
            is_ended: AtomicBool::new(false),
            length_ns,
            mounts: Vec::new(),
        })
    }

    /// Returns the player with `mounts`.
    pub(crate) fn with_mounts(self, mounts: Vec<RecordedMount>) -> Player {
        Player { mounts, ..self }
    }

    /// Returns the mounts whose angles are in the recording. The caller publishes their angles.
    pub fn mounts(&self) -> &[RecordedMount] {
        &self.mounts
    }

    /// Returns how the recording is played.
    pub(crate) fn play(&self) -> Play {
        *self.lock().play()
    }

    /// Returns the number of restarts.
    pub(crate) fn lap(&self) -> u32 {
        self.lock().lap()
    }

    /// Returns when something of `media` is due that belongs to no link. No link waits for it.
    pub(crate) fn due(&self, media: Nanos, now: Nanos) -> Turn {
        self.lock().due(media, now, self.position())
    }

    /// Everything is up: the first telegram may come.
    pub(crate) fn begin(&self) {
        self.change(|playback, now, _| playback.begin(now));
    }

    /// Waits after the telegram that is played, until it is resumed.
    pub fn pause(&self) {
        self.change(|playback, now, position| playback.pause(true, now, position));
    }

    /// Goes on.
    pub fn resume(&self) {
        self.change(|playback, now, position| playback.pause(false, now, position));
    }

    /// Pauses, or goes on.
    pub fn toggle(&self) {
        self.change(|playback, now, position| {
            let is_paused = playback.play().is_paused;
            playback.pause(!is_paused, now, position);
        });
    }

    /// Plays the next telegram of all links, and pauses.
    pub fn step(&self) {
        self.change(Playback::step);
    }

    /// Goes on twice as fast.
    pub fn speed_up(&self) {
        self.change(|playback, now, position| {
            playback.set_pace(playback.play().pace.doubled(), now, position);
        });
    }

    /// Goes on half as fast.
    pub fn slow_down(&self) {
        self.change(|playback, now, position| {
            playback.set_pace(playback.play().pace.halved(), now, position);
        });
    }

    /// Ends, wherever it is.
    pub fn end(&self) {
        self.is_ended.store(true, Ordering::Relaxed);
        self.over.signal();
    }

    /// How far it is.
    pub fn progress(&self) -> Progress {
        let playback = self.lock();
        let length_ns = playback.play().end_ns.into_iter().chain(self.length_ns).min();
        let now = clock::now();
        let is_over = playback.is_over();
        let position = self.position();
        // What follows the end is no place in it.
        let media = playback.media(now, position).min(length_ns.unwrap_or(Nanos::MAX)).max(position);
        Progress {
            position_ns: if is_over { position } else { media },
            length_ns,
            pace: playback.play().pace,
            is_paused: playback.play().is_paused,
            is_over,
            lap: playback.lap(),
            telegrams: self.links.iter().map(|link| link.telegrams.load(Ordering::Relaxed)).sum(),
            took_ns: playback.took(now),
            paused_ns: playback.paused(now),
            now_ns: now,
        }
    }

    /// What becomes readable when it [`is_over`](Self::is_over) or shall end.
    pub(crate) fn over(&self) -> &EventFd {
        &self.over
    }

    /// Whether a user wants it to end now.
    pub(crate) fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }

    /// Whether everything was played.
    pub(crate) fn is_over(&self) -> bool {
        self.lock().is_over()
    }

    fn change(&self, how: impl FnOnce(&mut Playback, Nanos, Nanos)) {
        let mut playback = self.lock();
        how(&mut playback, clock::now(), self.position());
        self.tell(playback);
    }

    /// Lets go of `playback`, and everybody know what is new of it.
    fn tell(&self, mut playback: MutexGuard<'_, Playback>) {
        self.flows.store(playback.flows(), Ordering::Relaxed);
        let (is_news, is_over) = (playback.take_news(), playback.is_over());
        drop(playback);
        if is_news {
            self.links.iter().for_each(|link| link.event.signal());
        }
        if is_over {
            self.over.signal();
        }
    }

    /// The media time of the link that has come the least far of those that go on.
    fn position(&self) -> Nanos {
        let media = |link: &LinkPlace| link.media.load(Ordering::Relaxed);
        let going = self.links.iter().filter(|link| !link.has_ended.load(Ordering::Relaxed));
        going.map(media).min().or_else(|| self.links.iter().map(media).max()).unwrap_or(0)
    }

    fn lock(&self) -> MutexGuard<'_, Playback> {
        self.playback.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PlayerHandle<'_> {
    /// Whether it is the link's turn without asking.
    pub(crate) fn flows(self) -> bool {
        self.player.flows.load(Ordering::Relaxed)
    }

    /// Whether it is the link's turn, which has something of `media` next.
    pub(crate) fn turn(self, media: Nanos, now: Nanos) -> Turn {
        self.ask(|playback| playback.turn(self.number, media, now))
    }

    /// The link is at the end of lap number `lap`.
    pub(crate) fn end(self, lap: u32, now: Nanos) -> Turn {
        let place = self.place();
        place.has_ended.store(true, Ordering::Relaxed);
        let telegrams = place.telegrams.load(Ordering::Relaxed);
        let has_played = place.of_laps.swap(telegrams, Ordering::Relaxed) < telegrams;
        let turn = self.ask(|playback| {
            playback.has_played |= has_played;
            playback.end(self.number, lap, now)
        });
        if let Turn::Restart(_) = turn {
            self.place().media.store(0, Ordering::Relaxed);
            self.place().has_ended.store(false, Ordering::Relaxed);
        }
        turn
    }

    /// The link has published something of `media`.
    pub(crate) fn played(self, media: Nanos) {
        let place = self.place();
        place.media.store(media, Ordering::Relaxed);
        place.has_ended.store(false, Ordering::Relaxed);
        place.telegrams.fetch_add(1, Ordering::Relaxed);
    }

    /// What was asked for.
    pub(crate) fn play(self) -> Play {
        *self.player.lock().play()
    }

    /// Whether the player waits.
    pub(crate) fn is_paused(self) -> bool {
        self.player.lock().play().is_paused
    }

    /// What becomes readable when it is worth asking again.
    pub(crate) fn news(&self) -> &EventFd {
        &self.place().event
    }

    fn ask(self, question: impl FnOnce(&mut Playback) -> Turn) -> Turn {
        let mut playback = self.player.lock();
        let turn = question(&mut playback);
        self.player.tell(playback);
        turn
    }

    fn place(&self) -> &LinkPlace {
        &self.player.links[self.number]
    }
}

impl Due {
    /// What nobody waits for.
    pub(crate) fn at_once(now: Nanos) -> Due {
        Due { at: now, stretch: 1.0 }
    }
}
