//! The player of a recording. The threads of its links query when their next telegram is due. Keys and requests of
//! users pause the player, play single telegrams, and change the rate. At maximum rate, links play without a query, and
//! nothing is locked.
//!
//! [`Playback`] is the clock of the player. It preserves the intervals between the telegrams of all links while the
//! recording is paused, stepped, played faster or slower, and repeated. The current time is an argument.
//!
//! Media time is the time since the first telegram of the recording, in nanoseconds.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use scanhub_port::clock;
use scanhub_schema::{Failure, Nanos};

use crate::process::EventFd;
use crate::replay::RecordedMount;

/// Speed of playback.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PlaybackRate {
    /// Multiple of the recorded speed.
    Times(f64),
    /// As fast as it can be read.
    Max,
}

/// Options of a user for playing a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlaybackOptions {
    /// Speed of playback.
    pub rate: PlaybackRate,
    /// Media time, in ns, before which nothing is published.
    pub start_ns: Nanos,
    /// Media time, in ns, at which playback ends.
    pub end_ns: Option<Nanos>,
    /// Whether playback restarts at its end.
    pub is_looped: bool,
    /// Whether playback pauses before the first telegram.
    pub is_paused: bool,
}

/// Player of a recording for all of its links.
pub struct Player {
    playback: Mutex<Playback>,
    /// Whether every telegram is due at once.
    is_unthrottled: AtomicBool,
    links: Vec<LinkProgress>,
    /// Event that is readable after playback has ended.
    over: EventFd,
    /// Whether a user has ended playback.
    is_ended: AtomicBool,
    length_ns: Option<Nanos>,
    /// Mounts whose angles are in the recording.
    mounts: Vec<RecordedMount>,
}

/// Progress of one link.
struct LinkProgress {
    /// Event that is readable when the link must call [`PlayerHandle::next_action`] again.
    event: EventFd,
    /// Media time of the last telegram.
    media: AtomicU64,
    has_ended: AtomicBool,
    /// Number of published telegrams.
    telegrams: AtomicU64,
    /// Value of `telegrams` at the end of the last lap.
    telegrams_of_laps: AtomicU64,
}

/// Access of one link to its player.
#[derive(Clone, Copy)]
pub(crate) struct PlayerHandle<'a> {
    pub(crate) player: &'a Player,
    pub(crate) number: usize,
}

/// Progress of a player.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Media time, in ns.
    pub position_ns: u64,
    /// Media time of the end, in ns, if it is known.
    pub length_ns: Option<u64>,
    /// Speed of playback.
    pub rate: PlaybackRate,
    /// Whether playback is paused.
    pub is_paused: bool,
    /// Whether everything was played.
    pub is_over: bool,
    /// Number of restarts.
    pub lap: u32,
    /// Number of published telegrams of all links and laps.
    pub telegrams: u64,
    /// Time that the recording has played, in ns, without pauses.
    pub took_ns: u64,
    /// Time that playback has been paused since all links were ready to play, in ns.
    pub paused_ns: u64,
    /// Time of this report, CLOCK_MONOTONIC in ns.
    pub now_ns: u64,
}

impl Default for PlaybackRate {
    fn default() -> PlaybackRate {
        PlaybackRate::Times(1.0)
    }
}

impl PlaybackRate {
    /// Returns twice this rate. A rate above [`MAX_FACTOR`](Self::MAX_FACTOR) becomes [`Max`](Self::Max).
    fn doubled(self) -> PlaybackRate {
        match self {
            PlaybackRate::Times(rate) if rate < PlaybackRate::MAX_FACTOR => {
                PlaybackRate::Times((2.0 * rate).min(PlaybackRate::MAX_FACTOR))
            }
            _ => PlaybackRate::Max,
        }
    }

    /// Returns half this rate.
    fn halved(self) -> PlaybackRate {
        match self {
            PlaybackRate::Times(rate) => PlaybackRate::Times((rate / 2.0).max(PlaybackRate::MIN_FACTOR)),
            PlaybackRate::Max => PlaybackRate::Times(PlaybackRate::MAX_FACTOR),
        }
    }

    /// Minimum rate.
    pub const MIN_FACTOR: f64 = 1.0 / 64.0;
    /// Maximum rate at which playback still waits between telegrams.
    pub const MAX_FACTOR: f64 = 64.0;
}

impl Player {
    /// Creates a player of `links` links, with a total length of `length_ns` if that is known.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if no descriptors are left.
    pub(crate) fn new(
        play: PlaybackOptions,
        links: usize,
        length_ns: Option<Nanos>,
    ) -> Result<Player, Failure> {
        let progress = |_| -> Result<LinkProgress, Failure> {
            let (media, telegrams, telegrams_of_laps) = Default::default();
            let (event, has_ended) = (EventFd::new()?, AtomicBool::new(false));
            Ok(LinkProgress { event, media, has_ended, telegrams, telegrams_of_laps })
        };
        Ok(Player {
            playback: Mutex::new(Playback::new(play, links)),
            is_unthrottled: AtomicBool::new(false),
            links: (0..links).map(progress).collect::<Result<_, _>>()?,
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
    pub(crate) fn options(&self) -> PlaybackOptions {
        *self.lock().options()
    }

    /// Returns the number of restarts.
    pub(crate) fn lap(&self) -> u32 {
        self.lock().lap()
    }

    /// Returns when a sample of time `media` is due that belongs to no link, such as the angle of a mount. No link
    /// waits for this sample.
    pub(crate) fn due(&self, media: Nanos, now: Nanos) -> PlaybackAction {
        self.lock().due(media, now, self.position())
    }

    /// Starts playback, because all topics exist.
    pub(crate) fn begin(&self) {
        self.change(|playback, now, _| playback.begin(now));
    }

    /// Pauses after the current telegram.
    pub fn pause(&self) {
        self.change(|playback, now, position| playback.pause(true, now, position));
    }

    /// Resumes playback.
    pub fn resume(&self) {
        self.change(|playback, now, position| playback.pause(false, now, position));
    }

    /// Pauses or resumes playback.
    pub fn toggle(&self) {
        self.change(|playback, now, position| {
            let is_paused = playback.options().is_paused;
            playback.pause(!is_paused, now, position);
        });
    }

    /// Plays the next telegram of all links, and pauses.
    pub fn step(&self) {
        self.change(Playback::step);
    }

    /// Doubles the rate.
    pub fn speed_up(&self) {
        self.change(|playback, now, position| {
            playback.set_rate(playback.options().rate.doubled(), now, position);
        });
    }

    /// Halves the rate.
    pub fn slow_down(&self) {
        self.change(|playback, now, position| {
            playback.set_rate(playback.options().rate.halved(), now, position);
        });
    }

    /// Ends playback now.
    pub fn end(&self) {
        self.is_ended.store(true, Ordering::Relaxed);
        self.over.signal();
    }

    /// Returns the progress.
    pub fn progress(&self) -> Progress {
        let playback = self.lock();
        let length_ns = playback.options().end_ns.into_iter().chain(self.length_ns).min();
        let now = clock::now();
        let is_over = playback.is_over();
        let position = self.position();
        // Media time continues after the end, but the position stays there.
        let media = playback.media(now, position).min(length_ns.unwrap_or(Nanos::MAX)).max(position);
        Progress {
            position_ns: if is_over { position } else { media },
            length_ns,
            rate: playback.options().rate,
            is_paused: playback.options().is_paused,
            is_over,
            lap: playback.lap(),
            telegrams: self.links.iter().map(|link| link.telegrams.load(Ordering::Relaxed)).sum(),
            took_ns: playback.elapsed(now),
            paused_ns: playback.paused_time(now),
            now_ns: now,
        }
    }

    /// Returns the event that is readable when playback [`is_over`](Self::is_over), or a user has ended it.
    pub(crate) fn over(&self) -> &EventFd {
        &self.over
    }

    /// Returns whether a user has ended playback.
    pub(crate) fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }

    /// Returns whether everything was played.
    pub(crate) fn is_over(&self) -> bool {
        self.lock().is_over()
    }

    /// Changes the playback by `how`, and notifies the links.
    fn change(&self, how: impl FnOnce(&mut Playback, Nanos, Nanos)) {
        let mut playback = self.lock();
        how(&mut playback, clock::now(), self.position());
        self.notify(playback);
    }

    /// Unlocks `playback`, and wakes the links whose next action may have changed, and the supervisor at the end.
    fn notify(&self, mut playback: MutexGuard<'_, Playback>) {
        self.is_unthrottled.store(playback.is_unthrottled(), Ordering::Relaxed);
        let (has_changed, is_over) = (playback.take_change(), playback.is_over());
        drop(playback);
        if has_changed {
            self.links.iter().for_each(|link| link.event.signal());
        }
        if is_over {
            self.over.signal();
        }
    }

    /// Returns the minimum media time of the links that still play; if no link still plays, the maximum of all links.
    fn position(&self) -> Nanos {
        let media = |link: &LinkProgress| link.media.load(Ordering::Relaxed);
        let playing = self.links.iter().filter(|link| !link.has_ended.load(Ordering::Relaxed));
        playing.map(media).min().or_else(|| self.links.iter().map(media).max()).unwrap_or(0)
    }

    fn lock(&self) -> MutexGuard<'_, Playback> {
        self.playback.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PlayerHandle<'_> {
    /// Returns whether the link may play everything without a query.
    pub(crate) fn is_unthrottled(self) -> bool {
        self.player.is_unthrottled.load(Ordering::Relaxed)
    }

    /// Returns the next action of the link, whose next telegram has time `media`.
    pub(crate) fn next_action(self, media: Nanos, now: Nanos) -> PlaybackAction {
        self.query(|playback| playback.next_action(self.number, media, now))
    }

    /// Handles that the link is at the end of lap number `lap`. Returns the next action of the link.
    pub(crate) fn end(self, lap: u32, now: Nanos) -> PlaybackAction {
        let progress = self.progress();
        progress.has_ended.store(true, Ordering::Relaxed);
        let telegrams = progress.telegrams.load(Ordering::Relaxed);
        let has_played = progress.telegrams_of_laps.swap(telegrams, Ordering::Relaxed) < telegrams;
        let action = self.query(|playback| {
            playback.has_played |= has_played;
            playback.end(self.number, lap, now)
        });
        if let PlaybackAction::Restart(_) = action {
            progress.media.store(0, Ordering::Relaxed);
            progress.has_ended.store(false, Ordering::Relaxed);
        }
        action
    }

    /// Notes that the link has published a telegram of time `media`.
    pub(crate) fn note_played(self, media: Nanos) {
        let progress = self.progress();
        progress.media.store(media, Ordering::Relaxed);
        progress.has_ended.store(false, Ordering::Relaxed);
        progress.telegrams.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns how the recording is played.
    pub(crate) fn options(self) -> PlaybackOptions {
        *self.player.lock().options()
    }

    /// Returns whether the player is paused.
    pub(crate) fn is_paused(self) -> bool {
        self.player.lock().options().is_paused
    }

    /// Returns the event that is readable when the next action of the link may have changed.
    pub(crate) fn event(&self) -> &EventFd {
        &self.progress().event
    }

    fn query(self, query: impl FnOnce(&mut Playback) -> PlaybackAction) -> PlaybackAction {
        let mut playback = self.player.lock();
        let action = query(&mut playback);
        self.player.notify(playback);
        action
    }

    fn progress(&self) -> &LinkProgress {
        &self.player.links[self.number]
    }
}

/// Next action of a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum PlaybackAction {
    /// Plays its next telegram now.
    Now(DueTime),
    /// Waits until this time.
    At(Nanos),
    /// Waits until the player changes.
    Wait,
    /// Skips the angle of a mount, because the silence that contains its time was skipped. A link never gets this
    /// action.
    Skipped,
    /// Restarts with this lap.
    Restart(u32),
    /// Ends, because everything was played.
    Over,
}

/// Time at which a telegram is played.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DueTime {
    /// Time at which it was due, CLOCK_MONOTONIC in ns.
    pub(crate) at: Nanos,
    /// Factor by which the time to the next telegram is longer than in the recording.
    pub(crate) stretch: f64,
}

impl DueTime {
    /// Creates the time of a telegram that does not wait.
    pub(crate) fn at_once(now: Nanos) -> DueTime {
        DueTime { at: now, stretch: 1.0 }
    }
}

/// Clock of a recording, for all of its links.
#[derive(Clone, Debug)]
struct Playback {
    options: PlaybackOptions,
    /// Whether playback has been started.
    is_begun: bool,
    /// A time and its media time; `None` until every link has reported its first telegram.
    anchor: Option<(Nanos, Nanos)>,
    links: Vec<NextTelegram>,
    /// Number of restarts.
    lap: u32,
    /// Whether this lap had a telegram, including those of links that played without a query.
    has_played: bool,
    /// Start of the first lap, and the end of the last one.
    began_at: Option<Nanos>,
    over_at: Option<Nanos>,
    /// Start of the current pause, and total duration of the earlier ones, both within the time since `began_at`.
    paused_at: Option<Nanos>,
    paused: Nanos,
    /// Whether a step is pending: the next telegram is played as soon as all links have reported theirs.
    is_step_pending: bool,
    /// Whether the next actions of waiting links may have changed.
    has_changed: bool,
    /// End of the last silence that was skipped in this lap, as media time; 0 if there was none. Angles before it are
    /// not played.
    skipped_until: Nanos,
}

/// Next telegram of a link.
#[derive(Clone, Copy, Debug, PartialEq)]
enum NextTelegram {
    /// The link has not reported it yet.
    Unknown,
    /// A telegram with this media time.
    At(Nanos),
    Ended,
}

impl Playback {
    fn new(play: PlaybackOptions, links: usize) -> Playback {
        Playback {
            options: play,
            is_begun: false,
            anchor: None,
            links: vec![NextTelegram::Unknown; links],
            lap: 0,
            has_played: false,
            began_at: None,
            over_at: None,
            paused_at: None,
            paused: 0,
            is_step_pending: false,
            has_changed: false,
            skipped_until: 0,
        }
    }

    /// Starts playback.
    fn begin(&mut self, now: Nanos) {
        self.is_begun = true;
        self.start_clock(now);
    }

    /// Returns the next action of `link`, whose next telegram has time `media`.
    fn next_action(&mut self, link: usize, media: Nanos, now: Nanos) -> PlaybackAction {
        self.links[link] = NextTelegram::At(media);
        self.start_clock(now);
        self.apply_step();
        let Some((since, from)) = self.anchor else { return PlaybackAction::Wait };
        if self.options.is_paused {
            return if media < from {
                self.play_now(link, DueTime::at_once(now))
            } else {
                PlaybackAction::Wait
            };
        }
        let PlaybackRate::Times(rate) = self.options.rate else {
            return self.play_now(link, DueTime::at_once(now));
        };
        if self.skip_silence(now) {
            return self.next_action(link, media, now);
        }
        let due = due_time(since, from, media, rate);
        if due > now {
            return PlaybackAction::At(due);
        }
        self.play_now(link, DueTime { at: due, stretch: (1.0 / rate).max(1.0) })
    }

    /// Returns when a sample of time `media` is due that belongs to no link, such as the angle of a mount. `position`
    /// is the media time at maximum rate.
    fn due(&self, media: Nanos, now: Nanos, position: Nanos) -> PlaybackAction {
        if media < self.skipped_until {
            return PlaybackAction::Skipped;
        }
        let at_once =
            |is_due| if is_due { PlaybackAction::Now(DueTime::at_once(now)) } else { PlaybackAction::Wait };
        match (self.anchor, self.options.rate) {
            (None, _) => PlaybackAction::Wait,
            (Some((_, from)), _) if self.options.is_paused => at_once(media < from),
            (_, PlaybackRate::Max) => at_once(media <= position),
            (Some((since, from)), PlaybackRate::Times(rate)) => match due_time(since, from, media, rate) {
                at if at > now => PlaybackAction::At(at),
                at => PlaybackAction::Now(DueTime { at, stretch: (1.0 / rate).max(1.0) }),
            },
        }
    }

    /// Handles the end of lap number `lap` for `link`. Returns the next action of the link.
    fn end(&mut self, link: usize, lap: u32, now: Nanos) -> PlaybackAction {
        if self.lap != lap {
            return PlaybackAction::Restart(self.lap);
        }
        if self.is_over() {
            return PlaybackAction::Over;
        }
        self.links[link] = NextTelegram::Ended;
        self.start_clock(now);
        if !self.is_over() {
            self.apply_step();
            return PlaybackAction::Wait;
        }
        self.has_changed = true;
        // An empty recording would restart forever.
        if !(self.options.is_looped && self.has_played) {
            self.over_at = Some(now);
            return PlaybackAction::Over;
        }
        self.lap += 1;
        self.links.fill(NextTelegram::Unknown);
        (self.anchor, self.has_played, self.skipped_until) = (None, false, 0);
        PlaybackAction::Restart(self.lap)
    }

    /// Pauses or resumes. `position` is the media time at maximum rate.
    fn pause(&mut self, is_paused: bool, now: Nanos, position: Nanos) {
        self.set_anchor(now, position);
        self.set_paused(is_paused, now);
        self.is_step_pending = false;
    }

    /// Pauses after the next telegram.
    fn step(&mut self, now: Nanos, position: Nanos) {
        self.set_anchor(now, position);
        self.set_paused(true, now);
        self.is_step_pending = true;
        self.apply_step();
    }

    /// Continues at another rate.
    fn set_rate(&mut self, rate: PlaybackRate, now: Nanos, position: Nanos) {
        self.set_anchor(now, position);
        self.options.rate = rate;
    }

    fn options(&self) -> &PlaybackOptions {
        &self.options
    }

    fn lap(&self) -> u32 {
        self.lap
    }

    /// Returns whether every telegram is due at once until something changes.
    fn is_unthrottled(&self) -> bool {
        self.anchor.is_some() && !self.options.is_paused && self.options.rate == PlaybackRate::Max
    }

    /// Returns whether everything was played.
    fn is_over(&self) -> bool {
        self.links.iter().all(|next| *next == NextTelegram::Ended)
    }

    /// Returns how long the recording has played, without pauses.
    fn elapsed(&self, now: Nanos) -> Nanos {
        let until = self.over_at.unwrap_or(now);
        let since_start = self.began_at.map_or(0, |began_at| until.saturating_sub(began_at));
        since_start.saturating_sub(self.paused_time(now))
    }

    /// Returns how long playback has been paused since all links were ready to play.
    fn paused_time(&self, now: Nanos) -> Nanos {
        let until = self.over_at.unwrap_or(now);
        self.paused + self.paused_at.map_or(0, |paused_at| until.saturating_sub(paused_at))
    }

    /// Sets whether playback is paused. A pause counts from the moment at which playback could have run.
    fn set_paused(&mut self, is_paused: bool, now: Nanos) {
        self.paused = self.paused_time(now);
        self.options.is_paused = is_paused;
        self.paused_at = self.began_at.filter(|_| is_paused).map(|_| now);
    }

    /// Returns whether the next actions of waiting links may have changed since the last call.
    fn take_change(&mut self) -> bool {
        std::mem::take(&mut self.has_changed)
    }

    /// Returns the media time at `now`: `position` at maximum rate.
    fn media(&self, now: Nanos, position: Nanos) -> Nanos {
        let Some((since, from)) = self.anchor else { return self.options.start_ns };
        match self.options.rate {
            _ if self.options.is_paused => from,
            PlaybackRate::Max => position.max(from),
            PlaybackRate::Times(rate) => {
                from.saturating_add((now.saturating_sub(since) as f64 * rate) as Nanos)
            }
        }
    }

    /// Lets `link` play. Its next telegram is unknown until the link reports it.
    fn play_now(&mut self, link: usize, due: DueTime) -> PlaybackAction {
        self.has_played = true;
        self.links[link] = NextTelegram::Unknown;
        PlaybackAction::Now(due)
    }

    /// Plays the next telegram during a pause, if a step is pending and all links have reported their next telegrams.
    fn apply_step(&mut self) {
        if self.is_step_pending
            && !self.links.contains(&NextTelegram::Unknown)
            && let Some(((_, media), next)) = self.anchor.as_mut().zip(next_media(&self.links))
        {
            let before = *media;
            *media = before.max(next.saturating_add(1));
            (self.is_step_pending, self.has_changed) = (false, true);
            if next > before.saturating_add(MAX_SILENCE) {
                self.skipped_until = next - MAX_SILENCE;
            }
        }
    }

    /// Starts the clock once all links have reported their first telegram.
    fn start_clock(&mut self, now: Nanos) {
        if self.is_begun && self.anchor.is_none() && !self.links.contains(&NextTelegram::Unknown) {
            self.anchor = Some((now, self.options.start_ns));
            if self.began_at.is_none() {
                self.began_at = Some(now);
                self.set_paused(self.options.is_paused, now);
            }
            self.has_changed = true;
        }
    }

    /// Anchors the clock at `now`, before its rate changes.
    fn set_anchor(&mut self, now: Nanos, position: Nanos) {
        let media = self.media(now, position);
        if let Some(anchor) = &mut self.anchor {
            *anchor = (now, media);
        }
        self.has_changed = true;
    }

    /// Shortens the current silence of all links if it is so long that the recording must have been interrupted.
    /// Returns whether it was shortened.
    fn skip_silence(&mut self, now: Nanos) -> bool {
        let media = self.media(now, 0);
        match next_media(&self.links).filter(|_| !self.links.contains(&NextTelegram::Unknown)) {
            Some(next) if next > media.saturating_add(MAX_SILENCE) => {
                self.anchor = Some((now, next - MAX_SILENCE));
                self.has_changed = true;
                self.skipped_until = next - MAX_SILENCE;
                true
            }
            _ => false,
        }
    }
}

/// Returns the time at which media time `media` is due at `rate`, if the media time was `from` at `since`.
fn due_time(since: Nanos, from: Nanos, media: Nanos, rate: f64) -> Nanos {
    since.saturating_add_signed(((media as f64 - from as f64) / rate) as i64)
}

/// Returns the earliest media time of the next telegrams of all links; `None` if no link has one.
fn next_media(links: &[NextTelegram]) -> Option<Nanos> {
    let next = |next: &NextTelegram| if let NextTelegram::At(media) = next { Some(*media) } else { None };
    links.iter().filter_map(next).min()
}

/// Maximum media time that passes while all links are silent.
const MAX_SILENCE: Nanos = 10_000 * scanhub_schema::MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000 * scanhub_schema::MILLIS;

    /// Creates a playback of `links` links that was started at 100 s.
    fn begun(links: usize, play: PlaybackOptions) -> Playback {
        let mut playback = Playback::new(play, links);
        playback.begin(100 * SECOND);
        playback
    }

    fn is_now(action: PlaybackAction, at: Nanos) -> bool {
        matches!(action, PlaybackAction::Now(due) if due.at == at)
    }

    #[test]
    fn starts_when_all_links_have_reported() {
        let mut playback = Playback::new(PlaybackOptions::default(), 2);
        assert_eq!(playback.next_action(0, 0, 90 * SECOND), PlaybackAction::Wait);
        assert_eq!(playback.next_action(1, 5 * SECOND, 95 * SECOND), PlaybackAction::Wait);
        assert!(!playback.take_change());
        playback.begin(100 * SECOND);
        assert!(playback.take_change());
        assert!(is_now(playback.next_action(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.next_action(1, 5 * SECOND, 101 * SECOND), PlaybackAction::At(105 * SECOND));
        assert!(
            is_now(playback.next_action(1, 5 * SECOND, 106 * SECOND), 105 * SECOND),
            "the time at which it was due"
        );
    }

    #[test]
    fn samples_without_a_link_are_due_with_the_links() {
        let mut playback = Playback::new(PlaybackOptions::default(), 1);
        assert_eq!(playback.due(0, 90 * SECOND, 0), PlaybackAction::Wait);
        playback.begin(100 * SECOND);
        assert!(is_now(playback.next_action(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.due(3 * SECOND, 101 * SECOND, 0), PlaybackAction::At(103 * SECOND));
        assert!(
            is_now(playback.due(3 * SECOND, 104 * SECOND, 0), 103 * SECOND),
            "the time at which it was due"
        );
        playback.pause(true, 105 * SECOND, 0);
        assert_eq!(playback.due(6 * SECOND, 120 * SECOND, 0), PlaybackAction::Wait);
        assert!(is_now(playback.due(4 * SECOND, 120 * SECOND, 0), 120 * SECOND));
        playback.pause(false, 120 * SECOND, 0);
        playback.set_rate(PlaybackRate::Max, 120 * SECOND, 0);
        assert_eq!(playback.due(6 * SECOND, 121 * SECOND, 5 * SECOND), PlaybackAction::Wait);
        assert!(is_now(playback.due(6 * SECOND, 121 * SECOND, 6 * SECOND), 121 * SECOND));
    }

    #[test]
    fn rate_changes_at_the_current_media_time() {
        let mut playback =
            begun(1, PlaybackOptions { rate: PlaybackRate::Times(2.0), ..PlaybackOptions::default() });
        assert!(is_now(playback.next_action(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.next_action(0, 8 * SECOND, 101 * SECOND), PlaybackAction::At(104 * SECOND));
        playback.set_rate(PlaybackRate::Times(0.5), 102 * SECOND, 0);
        assert!(playback.take_change());
        assert_eq!(playback.media(102 * SECOND, 0), 4 * SECOND);
        assert_eq!(playback.next_action(0, 8 * SECOND, 103 * SECOND), PlaybackAction::At(110 * SECOND));
        let PlaybackAction::Now(due) = playback.next_action(0, 8 * SECOND, 111 * SECOND) else {
            panic!("not due")
        };
        assert_eq!(due, DueTime { at: 110 * SECOND, stretch: 2.0 });
        playback.set_rate(PlaybackRate::Max, 112 * SECOND, 0);
        assert!(playback.is_unthrottled());
        assert!(is_now(playback.next_action(0, 9999 * SECOND, 112 * SECOND), 112 * SECOND));
        playback.set_rate(PlaybackRate::Times(1.0), 113 * SECOND, 9999 * SECOND);
        assert_eq!(playback.next_action(0, 10_000 * SECOND, 113 * SECOND), PlaybackAction::At(114 * SECOND));
    }

    #[test]
    fn pause_stops_media_time_and_step_plays_one_telegram() {
        let mut playback = begun(2, PlaybackOptions { is_paused: true, ..PlaybackOptions::default() });
        assert_eq!(playback.next_action(0, 0, 101 * SECOND), PlaybackAction::Wait);
        assert_eq!(
            playback.next_action(1, SECOND, 101 * SECOND),
            PlaybackAction::Wait,
            "the first one waits too"
        );
        playback.step(110 * SECOND, 0);
        assert_eq!(playback.next_action(1, SECOND, 110 * SECOND), PlaybackAction::Wait);
        assert!(is_now(playback.next_action(0, 0, 111 * SECOND), 111 * SECOND));
        assert_eq!(playback.next_action(0, 2 * SECOND, 111 * SECOND), PlaybackAction::Wait);
        playback.step(112 * SECOND, 0);
        assert!(is_now(playback.next_action(1, SECOND, 112 * SECOND), 112 * SECOND));
        assert_eq!(playback.next_action(1, 3 * SECOND, 112 * SECOND), PlaybackAction::Wait);
        playback.pause(false, 200 * SECOND, 0);
        assert_eq!(playback.next_action(0, 2 * SECOND, 200 * SECOND), PlaybackAction::At(201 * SECOND - 1));
        playback.pause(true, 200 * SECOND + 5, 0);
        assert_eq!(playback.next_action(0, 2 * SECOND, 300 * SECOND), PlaybackAction::Wait);
    }

    #[test]
    fn paused_time_does_not_count_as_elapsed() {
        let mut playback = Playback::new(
            PlaybackOptions { rate: PlaybackRate::Max, is_paused: true, ..PlaybackOptions::default() },
            1,
        );
        assert_eq!(playback.next_action(0, 0, 90 * SECOND), PlaybackAction::Wait);
        // Time before the start does not count at all.
        playback.pause(true, 95 * SECOND, 0);
        playback.begin(100 * SECOND);
        let times = |playback: &Playback, at: Nanos| {
            (playback.elapsed(at * SECOND), playback.paused_time(at * SECOND))
        };
        assert_eq!(times(&playback, 130), (0, 30 * SECOND));
        playback.pause(false, 160 * SECOND, 0);
        assert_eq!(times(&playback, 162), (2 * SECOND, 60 * SECOND));
        playback.pause(true, 163 * SECOND, 0);
        playback.step(164 * SECOND, 0);
        assert!(is_now(playback.next_action(0, 0, 165 * SECOND), 165 * SECOND));
        playback.pause(false, 170 * SECOND, 0);
        assert_eq!(times(&playback, 170), (3 * SECOND, 67 * SECOND));
        assert_eq!(playback.end(0, 0, 171 * SECOND), PlaybackAction::Over);
        playback.pause(true, 172 * SECOND, 0);
        assert_eq!(times(&playback, 180), (4 * SECOND, 67 * SECOND), "it is over");
    }

    #[test]
    fn step_waits_until_all_links_have_reported() {
        let mut playback = begun(2, PlaybackOptions { is_paused: true, ..PlaybackOptions::default() });
        assert_eq!(playback.next_action(0, 0, 100 * SECOND), PlaybackAction::Wait);
        assert_eq!(playback.next_action(1, 3 * SECOND, 100 * SECOND), PlaybackAction::Wait);
        playback.step(101 * SECOND, 0);
        assert!(is_now(playback.next_action(0, 0, 101 * SECOND), 101 * SECOND));
        // The user steps again before the link has reported its next telegram.
        playback.step(101 * SECOND, 0);
        assert_eq!(playback.next_action(1, 3 * SECOND, 101 * SECOND), PlaybackAction::Wait);
        assert!(is_now(playback.next_action(0, 2 * SECOND, 102 * SECOND), 102 * SECOND));
        // At maximum rate, links play without a query.
        playback.set_rate(PlaybackRate::Max, 103 * SECOND, 0);
        playback.pause(false, 103 * SECOND, 0);
        assert!(is_now(playback.next_action(0, 4 * SECOND, 103 * SECOND), 103 * SECOND));
        assert!(is_now(playback.next_action(1, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        playback.step(104 * SECOND, 700 * SECOND);
        assert_eq!(playback.next_action(0, 800 * SECOND, 104 * SECOND), PlaybackAction::Wait);
        assert!(is_now(playback.next_action(1, 701 * SECOND, 104 * SECOND), 104 * SECOND));
    }

    #[test]
    fn telegram_intervals_are_exact_after_long_uptime() {
        let (mut playback, up) = (Playback::new(PlaybackOptions::default(), 1), 100_000_000 * SECOND + 1);
        playback.begin(up);
        for media in (0..100).map(|scan| scan * 26_640_001) {
            assert!(is_now(playback.next_action(0, media, up + media), up + media), "{media}");
        }
    }

    #[test]
    fn restarts_when_all_links_end_and_one_has_played() {
        let mut playback =
            begun(2, PlaybackOptions { is_looped: true, start_ns: SECOND, ..PlaybackOptions::default() });
        assert_eq!(playback.next_action(0, SECOND, 100 * SECOND), PlaybackAction::Wait);
        assert_eq!(playback.end(1, 0, 100 * SECOND), PlaybackAction::Wait, "it has nothing");
        assert!(is_now(playback.next_action(0, SECOND, 100 * SECOND), 100 * SECOND));
        assert_eq!(playback.end(0, 0, 101 * SECOND), PlaybackAction::Restart(1));
        assert!(playback.take_change());
        assert_eq!(playback.next_action(0, SECOND, 102 * SECOND), PlaybackAction::Wait);
        assert_eq!(playback.end(1, 0, 102 * SECOND), PlaybackAction::Restart(1));
        assert_eq!(playback.end(1, 1, 103 * SECOND), PlaybackAction::Wait);
        assert!(is_now(playback.next_action(0, SECOND, 104 * SECOND), 103 * SECOND));
        let mut empty = begun(1, PlaybackOptions { is_looped: true, ..PlaybackOptions::default() });
        assert_eq!(empty.end(0, 0, 100 * SECOND), PlaybackAction::Over);
        assert!(empty.is_over());
    }

    #[test]
    fn angles_of_a_skipped_silence_are_not_played() {
        let mut playback = begun(1, PlaybackOptions::default());
        assert!(is_now(playback.next_action(0, 0, 100 * SECOND), 100 * SECOND));
        assert!(is_now(playback.next_action(0, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        assert_eq!(playback.due(5 * SECOND, 104 * SECOND, 0), PlaybackAction::At(105 * SECOND));
        assert_eq!(playback.next_action(0, 3600 * SECOND, 104 * SECOND), PlaybackAction::At(114 * SECOND));
        let at = |playback: &Playback, media| playback.due(media, 104 * SECOND, 0);
        assert_eq!(
            [4 * SECOND - 1, 5 * SECOND].map(|media| at(&playback, media)),
            [PlaybackAction::Skipped; 2]
        );
        assert_eq!(at(&playback, 3589 * SECOND), PlaybackAction::Skipped);
        assert_eq!(at(&playback, 3591 * SECOND), PlaybackAction::At(105 * SECOND));
        // A step also skips a long silence, except for the time just before the next telegram.
        let mut playback = begun(1, PlaybackOptions { is_paused: true, ..PlaybackOptions::default() });
        assert_eq!(playback.next_action(0, 0, 100 * SECOND), PlaybackAction::Wait);
        playback.step(101 * SECOND, 0);
        assert!(is_now(playback.next_action(0, 0, 101 * SECOND), 101 * SECOND));
        assert_eq!(playback.next_action(0, 3600 * SECOND, 102 * SECOND), PlaybackAction::Wait);
        playback.step(103 * SECOND, 0);
        assert_eq!(playback.due(2000 * SECOND, 103 * SECOND, 0), PlaybackAction::Skipped);
        assert!(is_now(playback.due(3599 * SECOND, 103 * SECOND, 0), 103 * SECOND));
    }

    #[test]
    fn interruption_of_the_recording_is_shortened() {
        let mut playback = begun(2, PlaybackOptions::default());
        playback.next_action(1, 3 * SECOND, 100 * SECOND);
        assert!(is_now(playback.next_action(0, 0, 100 * SECOND), 100 * SECOND));
        assert_eq!(
            playback.next_action(0, 3600 * SECOND, 101 * SECOND),
            PlaybackAction::At(3700 * SECOND),
            "another one plays"
        );
        assert!(is_now(playback.next_action(1, 3 * SECOND, 103 * SECOND), 103 * SECOND));
        playback.take_change();
        assert_eq!(playback.next_action(1, 3601 * SECOND, 103 * SECOND), PlaybackAction::At(114 * SECOND));
        assert!(playback.take_change());
        assert_eq!(playback.next_action(0, 3600 * SECOND, 103 * SECOND), PlaybackAction::At(113 * SECOND));
    }
}
