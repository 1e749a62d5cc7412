//! A player as its users and its links see it: the links' threads ask whose turn it is, keys and requests change how it
//! goes on. Where nothing is waited for, nobody asks and nothing is locked. Refuses to know what is played.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use port::clock;
use schema::{Failure, Nanos};

use crate::process::EventFd;
use crate::replay::RecordedMount;

/// How fast a recording is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// So many times as fast as it was recorded.
    Times(f64),
    /// As fast as it can be read.
    Max,
}

/// What a user wants of a player.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Play {
    /// How fast.
    pub pace: Pace,
    /// Media time, in ns, before which nothing is published.
    pub start_ns: Nanos,
    /// Media time, in ns, from which on nothing is published.
    pub end_ns: Option<Nanos>,
    /// Whether it starts again at its end.
    pub is_looped: bool,
    /// Whether it waits to be resumed before the first telegram.
    pub is_paused: bool,
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

/// What a link is to do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Turn {
    /// It is its turn.
    Now(Due),
    /// It will be its turn then.
    At(Nanos),
    /// It is to ask again when something has changed.
    Wait,
    /// The silence that contains its time was skipped. Only samples that belong to no link are skipped.
    Skipped,
    /// It starts again, with this lap.
    Restart(u32),
    /// Nothing comes any more, for nobody.
    Over,
}

/// When something plays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Due {
    /// The moment for which it stands.
    pub(crate) at: Nanos,
    /// How many times longer than in the recording it takes until the next.
    pub(crate) stretch: f64,
}

impl Due {
    /// What nobody waits for.
    pub(crate) fn at_once(now: Nanos) -> Due {
        Due { at: now, stretch: 1.0 }
    }
}

/// Where all links of a recording are.
#[derive(Clone, Debug)]
struct Playback {
    play: Play,
    /// Whether everything is up that shall be there at the first telegram.
    is_begun: bool,
    /// When, and what media time it was then; nothing until every link has said what it has first.
    anchor: Option<(Nanos, Nanos)>,
    links: Vec<Next>,
    /// Times that it started again.
    lap: u32,
    /// Whether this lap had a telegram, also of a link that did not ask whose turn it was.
    has_played: bool,
    /// When the first lap began, and when nothing came any more.
    began_at: Option<Nanos>,
    over_at: Option<Nanos>,
    /// Start of the current pause, and total duration of the earlier ones, both within the time since `began_at`.
    paused_at: Option<Nanos>,
    paused: Nanos,
    /// Whether what comes next is to be played, as soon as all have said what they have.
    owes_step: bool,
    /// Whether links that wait have to ask again.
    is_news: bool,
    /// End of the last silence that was skipped in this lap, as media time; 0 if there was none. Angles before it are not played.
    skipped_until: Nanos,
}

/// What a link has next.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Next {
    /// It looks for it.
    Unknown,
    /// Something of this media time.
    At(Nanos),
    Ended,
}

impl Playback {
    fn new(play: Play, links: usize) -> Playback {
        Playback {
            play,
            is_begun: false,
            anchor: None,
            links: vec![Next::Unknown; links],
            lap: 0,
            has_played: false,
            began_at: None,
            over_at: None,
            paused_at: None,
            paused: 0,
            owes_step: false,
            is_news: false,
            skipped_until: 0,
        }
    }

    /// Everything is up.
    fn begin(&mut self, now: Nanos) {
        self.is_begun = true;
        self.start(now);
    }

    /// Whose turn it is, if `link` has something of `media` next.
    fn turn(&mut self, link: usize, media: Nanos, now: Nanos) -> Turn {
        self.links[link] = Next::At(media);
        self.start(now);
        self.pay_step();
        let Some((since, from)) = self.anchor else { return Turn::Wait };
        if self.play.is_paused {
            return if media < from { self.play_now(link, Due::at_once(now)) } else { Turn::Wait };
        }
        let Pace::Times(rate) = self.play.pace else { return self.play_now(link, Due::at_once(now)) };
        if self.skip_silence(now) {
            return self.turn(link, media, now);
        }
        let due = due(since, from, media, rate);
        if due > now {
            return Turn::At(due);
        }
        self.play_now(link, Due { at: due, stretch: (1.0 / rate).max(1.0) })
    }

    /// Returns when something of `media` is due that belongs to no link. `position` is the media time at the fastest pace.
    fn due(&self, media: Nanos, now: Nanos, position: Nanos) -> Turn {
        if media < self.skipped_until {
            return Turn::Skipped;
        }
        let at_once = |is_due| if is_due { Turn::Now(Due::at_once(now)) } else { Turn::Wait };
        match (self.anchor, self.play.pace) {
            (None, _) => Turn::Wait,
            (Some((_, from)), _) if self.play.is_paused => at_once(media < from),
            (_, Pace::Max) => at_once(media <= position),
            (Some((since, from)), Pace::Times(rate)) => match due(since, from, media, rate) {
                at if at > now => Turn::At(at),
                at => Turn::Now(Due { at, stretch: (1.0 / rate).max(1.0) }),
            },
        }
    }

    /// `link`, which plays lap number `lap`, has nothing more in it.
    fn end(&mut self, link: usize, lap: u32, now: Nanos) -> Turn {
        if self.lap != lap {
            return Turn::Restart(self.lap);
        }
        if self.is_over() {
            return Turn::Over;
        }
        self.links[link] = Next::Ended;
        self.start(now);
        if !self.is_over() {
            self.pay_step();
            return Turn::Wait;
        }
        self.is_news = true;
        // What has nothing in it would start again for ever.
        if !(self.play.is_looped && self.has_played) {
            self.over_at = Some(now);
            return Turn::Over;
        }
        self.lap += 1;
        self.links.fill(Next::Unknown);
        (self.anchor, self.has_played, self.skipped_until) = (None, false, 0);
        Turn::Restart(self.lap)
    }

    /// Plays, or waits; `position` is the media time where nothing is waited for.
    fn pause(&mut self, is_paused: bool, now: Nanos, position: Nanos) {
        self.hold(now, position);
        self.set_paused(is_paused, now);
        self.owes_step = false;
    }

    /// Pauses after what comes next.
    fn step(&mut self, now: Nanos, position: Nanos) {
        self.hold(now, position);
        self.set_paused(true, now);
        self.owes_step = true;
        self.pay_step();
    }

    /// Goes on so fast.
    fn set_pace(&mut self, pace: Pace, now: Nanos, position: Nanos) {
        self.hold(now, position);
        self.play.pace = pace;
    }

    fn play(&self) -> &Play {
        &self.play
    }

    fn lap(&self) -> u32 {
        self.lap
    }

    /// Whether it is everybody's turn until something changes.
    fn flows(&self) -> bool {
        self.anchor.is_some() && !self.play.is_paused && self.play.pace == Pace::Max
    }

    /// Whether nothing comes any more.
    fn is_over(&self) -> bool {
        self.links.iter().all(|next| *next == Next::Ended)
    }

    /// Returns how long it has played, without pauses.
    fn took(&self, now: Nanos) -> Nanos {
        let until = self.over_at.unwrap_or(now);
        let since_start = self.began_at.map_or(0, |began_at| until.saturating_sub(began_at));
        since_start.saturating_sub(self.paused(now))
    }

    /// Returns how long it has been paused since everything was ready to play.
    fn paused(&self, now: Nanos) -> Nanos {
        let until = self.over_at.unwrap_or(now);
        self.paused + self.paused_at.map_or(0, |paused_at| until.saturating_sub(paused_at))
    }

    /// Sets whether it is paused. A pause counts from the moment at which playback could have run.
    fn set_paused(&mut self, is_paused: bool, now: Nanos) {
        self.paused = self.paused(now);
        self.play.is_paused = is_paused;
        self.paused_at = self.began_at.filter(|_| is_paused).map(|_| now);
    }

    /// Whether links that wait have to ask again since the last call.
    fn take_news(&mut self) -> bool {
        std::mem::take(&mut self.is_news)
    }

    /// The media time at `now`; `position` where nothing is waited for.
    fn media(&self, now: Nanos, position: Nanos) -> Nanos {
        let Some((since, from)) = self.anchor else { return self.play.start_ns };
        match self.play.pace {
            _ if self.play.is_paused => from,
            Pace::Max => position.max(from),
            Pace::Times(rate) => from.saturating_add((now.saturating_sub(since) as f64 * rate) as Nanos),
        }
    }

    /// It is the turn of `link`, which then looks for what it has next.
    fn play_now(&mut self, link: usize, due: Due) -> Turn {
        self.has_played = true;
        self.links[link] = Next::Unknown;
        Turn::Now(due)
    }

    /// Lets what comes next play in a pause, if that was asked for and all have said what they have.
    fn pay_step(&mut self) {
        if self.owes_step
            && !self.links.contains(&Next::Unknown)
            && let Some(((_, media), next)) = self.anchor.as_mut().zip(next_of(&self.links))
        {
            let before = *media;
            *media = before.max(next.saturating_add(1));
            (self.owes_step, self.is_news) = (false, true);
            if next > before.saturating_add(LONGEST_SILENCE) {
                self.skipped_until = next - LONGEST_SILENCE;
            }
        }
    }

    /// Lets the time run as soon as all are there.
    fn start(&mut self, now: Nanos) {
        if self.is_begun && self.anchor.is_none() && !self.links.contains(&Next::Unknown) {
            self.anchor = Some((now, self.play.start_ns));
            if self.began_at.is_none() {
                self.began_at = Some(now);
                self.set_paused(self.play.is_paused, now);
            }
            self.is_news = true;
        }
    }

    /// From now on the time runs another way.
    fn hold(&mut self, now: Nanos, position: Nanos) {
        let media = self.media(now, position);
        if let Some(anchor) = &mut self.anchor {
            *anchor = (now, media);
        }
        self.is_news = true;
    }

    /// Where all were silent for long, for the recording was interrupted, listeners wait less.
    fn skip_silence(&mut self, now: Nanos) -> bool {
        let media = self.media(now, 0);
        match next_of(&self.links).filter(|_| !self.links.contains(&Next::Unknown)) {
            Some(next) if next > media.saturating_add(LONGEST_SILENCE) => {
                self.anchor = Some((now, next - LONGEST_SILENCE));
                self.is_news = true;
                self.skipped_until = next - LONGEST_SILENCE;
                true
            }
            _ => false,
        }
    }
}

/// Returns when `media` is due at this rate, where media time was `from` at `since`.
fn due(since: Nanos, from: Nanos, media: Nanos, rate: f64) -> Nanos {
    since.saturating_add_signed(((media as f64 - from as f64) / rate) as i64)
}

/// Media time of what comes next of all.
fn next_of(links: &[Next]) -> Option<Nanos> {
    let next = |next: &Next| if let Next::At(media) = next { Some(*media) } else { None };
    links.iter().filter_map(next).min()
}

/// A recording that was interrupted does not keep its listeners waiting for longer, at its own pace.
const LONGEST_SILENCE: Nanos = 10_000 * schema::MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000 * schema::MILLIS;

    /// One of `links` that is up, from `start` seconds on.
    fn begun(links: usize, play: Play) -> Playback {
        let mut playback = Playback::new(play, links);
        playback.begin(100 * SECOND);
        playback
    }

    fn is_now(turn: Turn, at: Nanos) -> bool {
        matches!(turn, Turn::Now(due) if due.at == at)
    }

    #[test]
    fn nobody_begins_before_all_are_there() {
        let mut playback = Playback::new(Play::default(), 2);
        assert_eq!(playback.turn(0, 0, 90 * SECOND), Turn::Wait);
        assert_eq!(playback.turn(1, 5 * SECOND, 95 * SECOND), Turn::Wait);
        assert!(!playback.take_news());
        playback.begin(100 * SECOND);
        assert!(playback.take_news());
        assert!(is_now(playback.turn(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.turn(1, 5 * SECOND, 101 * SECOND), Turn::At(105 * SECOND));
        assert!(is_now(playback.turn(1, 5 * SECOND, 106 * SECOND), 105 * SECOND), "it stands for its moment");
    }

    #[test]
    fn what_belongs_to_no_link_is_due_with_them() {
        let mut playback = Playback::new(Play::default(), 1);
        assert_eq!(playback.due(0, 90 * SECOND, 0), Turn::Wait);
        playback.begin(100 * SECOND);
        assert!(is_now(playback.turn(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.due(3 * SECOND, 101 * SECOND, 0), Turn::At(103 * SECOND));
        assert!(is_now(playback.due(3 * SECOND, 104 * SECOND, 0), 103 * SECOND), "it stands for its moment");
        playback.pause(true, 105 * SECOND, 0);
        assert_eq!(playback.due(6 * SECOND, 120 * SECOND, 0), Turn::Wait);
        assert!(is_now(playback.due(4 * SECOND, 120 * SECOND, 0), 120 * SECOND));
        playback.pause(false, 120 * SECOND, 0);
        playback.set_pace(Pace::Max, 120 * SECOND, 0);
        assert_eq!(playback.due(6 * SECOND, 121 * SECOND, 5 * SECOND), Turn::Wait);
        assert!(is_now(playback.due(6 * SECOND, 121 * SECOND, 6 * SECOND), 121 * SECOND));
    }

    #[test]
    fn a_pace_changes_from_where_it_is() {
        let mut playback = begun(1, Play { pace: Pace::Times(2.0), ..Play::default() });
        assert!(is_now(playback.turn(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.turn(0, 8 * SECOND, 101 * SECOND), Turn::At(104 * SECOND));
        playback.set_pace(Pace::Times(0.5), 102 * SECOND, 0);
        assert!(playback.take_news());
        assert_eq!(playback.media(102 * SECOND, 0), 4 * SECOND);
        assert_eq!(playback.turn(0, 8 * SECOND, 103 * SECOND), Turn::At(110 * SECOND));
        let Turn::Now(due) = playback.turn(0, 8 * SECOND, 111 * SECOND) else { panic!("not due") };
        assert_eq!(due, Due { at: 110 * SECOND, stretch: 2.0 });
        playback.set_pace(Pace::Max, 112 * SECOND, 0);
        assert!(playback.flows());
        assert!(is_now(playback.turn(0, 9999 * SECOND, 112 * SECOND), 112 * SECOND));
        playback.set_pace(Pace::Times(1.0), 113 * SECOND, 9999 * SECOND);
        assert_eq!(playback.turn(0, 10_000 * SECOND, 113 * SECOND), Turn::At(114 * SECOND));
    }

    #[test]
    fn a_pause_takes_no_media_time_and_a_step_is_one_of_all() {
        let mut playback = begun(2, Play { is_paused: true, ..Play::default() });
        assert_eq!(playback.turn(0, 0, 101 * SECOND), Turn::Wait);
        assert_eq!(playback.turn(1, SECOND, 101 * SECOND), Turn::Wait, "the first one waits too");
        playback.step(110 * SECOND, 0);
        assert_eq!(playback.turn(1, SECOND, 110 * SECOND), Turn::Wait);
        assert!(is_now(playback.turn(0, 0, 111 * SECOND), 111 * SECOND));
        assert_eq!(playback.turn(0, 2 * SECOND, 111 * SECOND), Turn::Wait);
        playback.step(112 * SECOND, 0);
        assert!(is_now(playback.turn(1, SECOND, 112 * SECOND), 112 * SECOND));
        assert_eq!(playback.turn(1, 3 * SECOND, 112 * SECOND), Turn::Wait);
        playback.pause(false, 200 * SECOND, 0);
        assert_eq!(playback.turn(0, 2 * SECOND, 200 * SECOND), Turn::At(201 * SECOND - 1));
        playback.pause(true, 200 * SECOND + 5, 0);
        assert_eq!(playback.turn(0, 2 * SECOND, 300 * SECOND), Turn::Wait);
    }

    #[test]
    fn pauses_are_not_playing_time() {
        let mut playback = Playback::new(Play { pace: Pace::Max, is_paused: true, ..Play::default() }, 1);
        assert_eq!(playback.turn(0, 0, 90 * SECOND), Turn::Wait);
        // Time before the start does not count at all.
        playback.pause(true, 95 * SECOND, 0);
        playback.begin(100 * SECOND);
        let times =
            |playback: &Playback, at: Nanos| (playback.took(at * SECOND), playback.paused(at * SECOND));
        assert_eq!(times(&playback, 130), (0, 30 * SECOND));
        playback.pause(false, 160 * SECOND, 0);
        assert_eq!(times(&playback, 162), (2 * SECOND, 60 * SECOND));
        playback.pause(true, 163 * SECOND, 0);
        playback.step(164 * SECOND, 0);
        assert!(is_now(playback.turn(0, 0, 165 * SECOND), 165 * SECOND));
        playback.pause(false, 170 * SECOND, 0);
        assert_eq!(times(&playback, 170), (3 * SECOND, 67 * SECOND));
        assert_eq!(playback.end(0, 0, 171 * SECOND), Turn::Over);
        playback.pause(true, 172 * SECOND, 0);
        assert_eq!(times(&playback, 180), (4 * SECOND, 67 * SECOND), "it is over");
    }

    #[test]
    fn a_step_waits_for_all_to_say_what_they_have() {
        let mut playback = begun(2, Play { is_paused: true, ..Play::default() });
        assert_eq!(playback.turn(0, 0, 100 * SECOND), Turn::Wait);
        assert_eq!(playback.turn(1, 3 * SECOND, 100 * SECOND), Turn::Wait);
        playback.step(101 * SECOND, 0);
        assert!(is_now(playback.turn(0, 0, 101 * SECOND), 101 * SECOND));
        // Pressed again before it has read on.
        playback.step(101 * SECOND, 0);
        assert_eq!(playback.turn(1, 3 * SECOND, 101 * SECOND), Turn::Wait);
        assert!(is_now(playback.turn(0, 2 * SECOND, 102 * SECOND), 102 * SECOND));
        // As fast as it goes nobody asks.
        playback.set_pace(Pace::Max, 103 * SECOND, 0);
        playback.pause(false, 103 * SECOND, 0);
        assert!(is_now(playback.turn(0, 4 * SECOND, 103 * SECOND), 103 * SECOND));
        assert!(is_now(playback.turn(1, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        playback.step(104 * SECOND, 700 * SECOND);
        assert_eq!(playback.turn(0, 800 * SECOND, 104 * SECOND), Turn::Wait);
        assert!(is_now(playback.turn(1, 701 * SECOND, 104 * SECOND), 104 * SECOND));
    }

    #[test]
    fn after_years_of_uptime_distances_are_those_of_the_recording() {
        let (mut playback, up) = (Playback::new(Play::default(), 1), 100_000_000 * SECOND + 1);
        playback.begin(up);
        for media in (0..100).map(|scan| scan * 26_640_001) {
            assert!(is_now(playback.turn(0, media, up + media), up + media), "{media}");
        }
    }

    #[test]
    fn a_lap_begins_when_all_are_at_the_end_and_something_was_played() {
        let mut playback = begun(2, Play { is_looped: true, start_ns: SECOND, ..Play::default() });
        assert_eq!(playback.turn(0, SECOND, 100 * SECOND), Turn::Wait);
        assert_eq!(playback.end(1, 0, 100 * SECOND), Turn::Wait, "it has nothing");
        assert!(is_now(playback.turn(0, SECOND, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.end(0, 0, 101 * SECOND), Turn::Restart(1));
        assert!(playback.take_news());
        assert_eq!(playback.turn(0, SECOND, 102 * SECOND), Turn::Wait);
        assert_eq!(playback.end(1, 0, 102 * SECOND), Turn::Restart(1));
        assert_eq!(playback.end(1, 1, 103 * SECOND), Turn::Wait);
        assert!(is_now(playback.turn(0, SECOND, 104 * SECOND), 103 * SECOND));
        let mut empty = begun(1, Play { is_looped: true, ..Play::default() });
        assert_eq!(empty.end(0, 0, 100 * SECOND), Turn::Over);
        assert!(empty.is_over());
    }

    #[test]
    fn angles_of_a_skipped_silence_are_not_played() {
        let mut playback = begun(1, Play::default());
        assert!(is_now(playback.turn(0, 0, 100 * SECOND), 100 * SECOND));
        assert!(is_now(playback.turn(0, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        assert_eq!(playback.due(5 * SECOND, 104 * SECOND, 0), Turn::At(105 * SECOND));
        assert_eq!(playback.turn(0, 3600 * SECOND, 104 * SECOND), Turn::At(114 * SECOND));
        let at = |playback: &Playback, media| playback.due(media, 104 * SECOND, 0);
        assert_eq!([4 * SECOND - 1, 5 * SECOND].map(|media| at(&playback, media)), [Turn::Skipped; 2]);
        assert_eq!(at(&playback, 3589 * SECOND), Turn::Skipped);
        assert_eq!(at(&playback, 3591 * SECOND), Turn::At(105 * SECOND));
        // A step over a silence skips it, too, but not the time just before the next telegram.
        let mut playback = begun(1, Play { is_paused: true, ..Play::default() });
        assert_eq!(playback.turn(0, 0, 100 * SECOND), Turn::Wait);
        playback.step(101 * SECOND, 0);
        assert!(is_now(playback.turn(0, 0, 101 * SECOND), 101 * SECOND));
        assert_eq!(playback.turn(0, 3600 * SECOND, 102 * SECOND), Turn::Wait);
        playback.step(103 * SECOND, 0);
        assert_eq!(playback.due(2000 * SECOND, 103 * SECOND, 0), Turn::Skipped);
        assert!(is_now(playback.due(3599 * SECOND, 103 * SECOND, 0), 103 * SECOND));
    }

    #[test]
    fn what_was_interrupted_is_not_waited_for() {
        let mut playback = begun(2, Play::default());
        playback.turn(1, 3 * SECOND, 100 * SECOND);
        assert!(is_now(playback.turn(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(
            playback.turn(0, 3600 * SECOND, 101 * SECOND),
            Turn::At(3700 * SECOND),
            "another one plays"
        );
        assert!(is_now(playback.turn(1, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        playback.take_news();
        assert_eq!(playback.turn(1, 3601 * SECOND, 103 * SECOND), Turn::At(114 * SECOND));
        assert!(playback.take_news());
        assert_eq!(playback.turn(0, 3600 * SECOND, 103 * SECOND), Turn::At(113 * SECOND));
    }
}
