//! The loop of every verb that follows topics: receives, counts, reports problems, and ends at the bounds. Refuses to
//! know how samples are used.

mod discovery;
mod lines;
mod notice;
mod shortage;
mod track;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use scanhub_client::streams::{GRACE, Sample, Session, Who};
use scanhub_client::{Wait, clock};
use scanhub_schema::{Failure, Kind, Status, Topic, is_remote};
use scanhub_shm::Domain;

use crate::discovery::Discovery;
use crate::names::TopicName;
use crate::output::End;
use lines::{LineTrack, watch_parts};
use shortage::Shortage;
use track::Track;

pub use crate::receive_stats::ReceiveStats;
pub use notice::Notice;

/// When a verb that follows ends by itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bounds {
    /// After so many samples, of all topics together (`-n`).
    pub count: Option<u64>,
    /// After this time (`--for`).
    pub run_for: Option<Duration>,
    /// As a failure, after a silence this long, before the first sample or between two (`--timeout`).
    pub timeout: Option<Duration>,
}

impl Bounds {
    /// The run ends by itself: no hub at its start is a failure, an interrupt too.
    pub fn bounded(&self) -> bool {
        self.count.is_some() || self.run_for.is_some()
    }
}

/// What a verb does with what it follows.
pub trait Sink {
    /// A topic will be followed.
    fn begin(&mut self, _name: &TopicName) {}
    /// The topic is there, and what is sent from now on will be received.
    fn subscribed(&mut self, _name: &TopicName) {}
    /// A sample was received just now; who it is from and what was missed before it comes next.
    fn arrived(&mut self) {}
    /// A sample came, or one that stands for a silence and does not count.
    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End>;
    /// Something went wrong, or right again, in the streams of `names`; none as long as it is not known what is followed.
    fn notice(&mut self, names: &[&TopicName], notice: Notice) -> Result<(), End>;
    /// Called about ten times a second and after every sample.
    fn tick(&mut self, _now: Instant) -> Result<(), End> {
        Ok(())
    }
    /// When [`tick`](Self::tick) has something to do before that.
    fn wake_at(&self) -> Option<Instant> {
        None
    }
    /// Whether `topic` is wanted now: what is not is not subscribed to.
    fn wants(&self, _topic: Topic) -> bool {
        true
    }
    /// Whether the statuses of what is followed are wanted too, for what its lines take away.
    fn wants_lines(&self) -> bool {
        false
    }
    /// Memory, descriptors or places are too short to follow `name`, which is tried again; unless it goes on without that, the
    /// run ends.
    fn short(&mut self, _name: &TopicName, failure: Failure) -> Result<(), End> {
        Err(failure.into())
    }
    /// A status of `sensor` came.
    fn line(&mut self, _sensor: &str, _status: &Status) -> Result<(), End> {
        Ok(())
    }
    /// The run is over, for good or ill; nothing comes any more.
    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), End>;
}

/// Follows `names`, and `topics` of each sensor that a hub has when it comes, in the first live one of `places` until
/// `bounds` or `stop` end it.
pub fn follow(
    names: &[TopicName],
    topics: &[Topic],
    places: &[Domain],
    bounds: &Bounds,
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<(), End> {
    carry(Run::new(names, topics, places, bounds), names, stop, sink)
}

/// As [`follow`], and zones with the early warnings of their sensors.
pub(crate) fn follow_with_early(
    names: &[TopicName],
    places: &[Domain],
    bounds: &Bounds,
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<(), End> {
    let mut run = Run::new(names, &[], places, bounds);
    run.tracks.iter_mut().for_each(Track::take_early);
    carry(run, names, stop, sink)
}

/// As [`follow`], woken by `wait`, and for the shortest latency: what is there is taken before it is asked whether the hub
/// still is, which takes longer than receiving.
pub(crate) fn follow_closely(
    wait: Wait,
    names: &[TopicName],
    places: &[Domain],
    bounds: &Bounds,
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<(), End> {
    let run = Run::new(names, &[], places, bounds);
    carry(Run { session: run.session.by(wait), closely: true, ..run }, names, stop, sink)
}

fn carry(mut run: Run<'_>, names: &[TopicName], stop: &AtomicBool, sink: &mut dyn Sink) -> Result<(), End> {
    names.iter().for_each(|name| sink.begin(name));
    let end = run.run(stop, sink);
    if !matches!(end, Err(End::ReaderGone)) {
        run.take_lines(sink)?;
        for track in &run.tracks {
            let mut stats = track.stats.clone();
            stats.loss = run.loss(&track.name.sensor);
            sink.summary(&track.name, &stats)?;
        }
    }
    end
}

struct Run<'a> {
    session: Session,
    tracks: Vec<Track>,
    /// The lines of the sensors, if they are wanted, and for how many tracks that was looked after.
    lines: Vec<LineTrack>,
    lined: usize,
    /// What is followed of each sensor that a hub has.
    topics: &'a [Topic],
    discovery: Discovery,
    /// Samples come before news of the hub.
    closely: bool,
    bounds: &'a Bounds,
    started: Instant,
    last_sample: Instant,
    hub_seen: Option<Instant>,
    /// Since when there is a hub, and not only a listener, as far as it was looked at.
    hub_lives_since: Option<Instant>,
    /// When it was looked last which sensors there are.
    asked_at: Option<Instant>,
    waiting_said: bool,
    received: u64,
    shortage: Shortage,
}

/// Who brings the sensor that is called so.
fn brings(sensor: &str) -> Who {
    if is_remote(sensor) { Who::Listener } else { Who::Hub }
}

/// Whether `who` publishes `name`; the sensors of a robot may come from any publisher.
fn is_of(name: &TopicName, who: Who) -> bool {
    name.is_robot() || brings(&name.sensor) == who
}

/// Samples taken from one topic before the next one has its turn.
const TURN: usize = 32;

impl<'a> Run<'a> {
    fn new(names: &[TopicName], topics: &'a [Topic], places: &[Domain], bounds: &'a Bounds) -> Run<'a> {
        let now = Instant::now();
        Run {
            session: Session::new(places.to_vec()),
            tracks: names.iter().cloned().map(Track::new).collect(),
            lines: Vec::new(),
            lined: 0,
            topics,
            discovery: Discovery::default(),
            closely: false,
            bounds,
            started: now,
            last_sample: now,
            hub_seen: None,
            hub_lives_since: None,
            asked_at: None,
            waiting_said: false,
            received: 0,
            shortage: Shortage::default(),
        }
    }

    fn run(&mut self, stop: &AtomicBool, sink: &mut dyn Sink) -> Result<(), End> {
        self.look(sink)?;
        loop {
            if !self.closely {
                self.look(sink)?;
            }
            if self.take(stop, sink)? {
                return Ok(());
            }
            if self.closely {
                self.look(sink)?;
            }
            if sink.wants_lines() {
                self.watch_lines();
                self.take_lines(sink)?;
            }
            let now = Instant::now();
            sink.tick(now)?;
            self.check(sink, now)?;
            if stop.load(Ordering::Relaxed) {
                return self.stopped();
            }
            if self.bounds.run_for.is_some_and(|limit| now - self.started >= limit) {
                return self.time_is_over();
            }
            self.session.wait(self.wake_at().into_iter().chain(sink.wake_at()).min())?;
        }
    }

    /// News of the hub, and the topics of one that was waited for.
    fn look(&mut self, sink: &mut dyn Sink) -> Result<(), End> {
        let change = self.session.look()?;
        if let Some(who) = change.gone {
            self.discovery.end();
            self.tell(sink, Notice::HubGone, |name| is_of(name, who))?;
        }
        if let Some(who) = change.back {
            if self.hub_seen.is_some() || self.waiting_said {
                self.tell(sink, Notice::HubBack, |name| is_of(name, who))?;
            }
            self.hub_seen = Some(Instant::now());
            // What the new one said before anybody looked for it waited for that.
            let now_ns = clock::now_ns();
            self.tracks
                .iter_mut()
                .filter(|track| track.source.subscribed())
                .for_each(|track| track.since_ns = now_ns);
            self.discovery.begin(Instant::now());
        }
        self.discover(sink)
    }

    /// Receives what waits; true if that was all that was asked for.
    fn take(&mut self, stop: &AtomicBool, sink: &mut dyn Sink) -> Result<bool, End> {
        let mut more = true;
        while more && !stop.load(Ordering::Relaxed) {
            more = false;
            let mut subscribed = false;
            for track in &mut self.tracks {
                if !sink.wants(track.name.topic) {
                    track.let_go();
                    continue;
                }
                // That takes a thousand times as long as receiving: what waits of others comes before the next one.
                if !track.source.subscribed() && (subscribed || self.shortage.lasts(Instant::now())) {
                    more |= subscribed;
                    continue;
                }
                for turn in 0..TURN {
                    let was_subscribed = track.source.subscribed();
                    let received = match track.source.receive(&mut self.session) {
                        Err(failure) if failure.kind == Kind::Short => {
                            sink.short(&track.name, failure)?;
                            self.shortage.begin(Instant::now());
                            None
                        }
                        received => received?,
                    };
                    if received.is_some() {
                        sink.arrived();
                    }
                    if !was_subscribed && track.source.subscribed() {
                        subscribed = true;
                        track.since_ns = clock::now_ns();
                        sink.subscribed(&track.name);
                    }
                    let Some(sample) = received else { break };
                    more |= turn + 1 == TURN;
                    let now = Instant::now();
                    if sample.is_silence() {
                        sink.sample(&track.name, &sample)?;
                        continue;
                    }
                    let missed = sample.missed();
                    track.stats.count(now, missed, sample.period_us(), sample.is_of_before(track.since_ns));
                    if missed > 0 {
                        sink.notice(&[&track.name], Notice::Missed(missed))?;
                    }
                    sink.sample(&track.name, &sample)?;
                    if track.name.is_robot() && sink.wants_lines() {
                        watch_parts(&mut self.lines, &sample);
                    }
                    self.last_sample = now;
                    self.received += 1;
                    if self.bounds.count.is_some_and(|count| self.received >= count) {
                        return Ok(true);
                    }
                }
            }
            let now = Instant::now();
            sink.tick(now)?;
            more &= self.bounds.run_for.is_none_or(|limit| now - self.started < limit);
        }
        Ok(self.bounds.count == Some(0))
    }

    /// Everything that is wrong because nothing comes.
    fn check(&mut self, sink: &mut dyn Sink, now: Instant) -> Result<(), End> {
        if self.session.domain().is_some() {
            for track in &mut self.tracks {
                if track.stats.stale(now) {
                    sink.notice(&[&track.name], Notice::Stale)?;
                }
            }
        }
        match self.hub_seen {
            None if now - self.started >= GRACE => {
                if self.bounds.bounded() {
                    return Err(self.session.no_hub().into());
                }
                if !self.waiting_said {
                    self.waiting_said = true;
                    self.notice(sink, Notice::NoHub(self.session.no_hub()))?;
                }
            }
            Some(seen) if now - seen >= GRACE => self.check_sensors(sink)?,
            _ => {}
        }
        if self.bounds.timeout.is_some_and(|limit| now - self.last_sample >= limit) {
            let limit = self.bounds.timeout.unwrap_or_default();
            let hint =
                if self.session.domain().is_some() { "`scanhub info` shows why" } else { "there is no hub" };
            return Err(Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), hint).into());
        }
        Ok(())
    }

    /// News of the hub concern every stream.
    fn notice(&self, sink: &mut dyn Sink, notice: Notice) -> Result<(), End> {
        self.tell(sink, notice, |_| true)
    }

    /// As [`notice`](Self::notice), to those streams alone that it concerns.
    fn tell(
        &self,
        sink: &mut dyn Sink,
        notice: Notice,
        concerns: impl Fn(&TopicName) -> bool,
    ) -> Result<(), End> {
        let names: Vec<_> =
            self.tracks.iter().map(|track| &track.name).filter(|name| concerns(name)).collect();
        if names.is_empty() && !self.tracks.is_empty() { Ok(()) } else { sink.notice(&names, notice) }
    }

    fn wake_at(&self) -> Option<Instant> {
        let end = self.bounds.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = self.bounds.timeout.and_then(|limit| self.last_sample.checked_add(limit));
        let left = self.tracks.iter().filter_map(|track| track.source.left()).min();
        let left = left.into_iter().chain(self.discovery.left()).min();
        let unheard = left.and_then(|left| Instant::now().checked_add(left));
        [end, silence, unheard].into_iter().flatten().min()
    }

    fn stopped(&self) -> Result<(), End> {
        if self.bounds.bounded() {
            return Err(Failure::new(Kind::Interrupted, "interrupted before it was done", "").into());
        }
        Ok(())
    }

    fn time_is_over(&self) -> Result<(), End> {
        match self.bounds.count {
            Some(count) => {
                let what = format!("{} of {count} samples arrived in time", self.received);
                Err(Failure::new(Kind::Timeout, what, "`scanhub info` shows why").into())
            }
            None => Ok(()),
        }
    }
}
